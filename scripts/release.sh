#!/bin/sh
# Makes a release: programs, packages and images of both, bills of materials, notes from CHANGELOG.md, and checksums
# signed by a key of yours (ssh-keygen -t ed25519 makes one). Nothing is uploaded.
# usage: release.sh KEY OUT [--built DIR] [--without PART]...
#   KEY            private key, in the form of ssh-keygen; one in an agent works by its public file
#   --built DIR    takes the programs for this machine, slag-lab among them, from DIR, built before, instead of building them; a trial: CHANGELOG may have
#                  no section of this version yet, and the tree may be changed
#   --without PART leaves out arm64 (package of the Jetson), image or sbom
# The version is that of the workspace (Cargo.toml); CHANGELOG.md needs its section, as "## 0.1.0".
set -eu
cd "$(dirname "$0")/.."
# Everything below expects the programs in target.
unset CARGO_TARGET_DIR
fail() {
    echo "release: $*" >&2
    exit 1
}
[ $# -ge 2 ] || { sed -n '4,9s/^# //p' "$0" >&2; exit 2; }
key=$1 out=$2
shift 2
built= without=
while [ $# -gt 0 ]; do
    [ $# -ge 2 ] || fail "$1 needs a value"
    case $1 in
    --built) built=$2 ;;
    --without)
        case $2 in
        arm64 | image | sbom) without="$without $2 " ;;
        *) fail "there is no part '$2', expected arm64, image or sbom" ;;
        esac
        ;;
    *) fail "unknown flag $1" ;;
    esac
    shift 2
done
has() {
    case $without in *" $1 "*) return 1 ;; esac
}
[ "$(uname -m)" = x86_64 ] || fail "releases are made on x86_64; the Jetson's package is cross-built"
[ -f "$key" ] || fail "$key is no file; make a key: ssh-keygen -t ed25519 -f $key"
version=$(sh scripts/version.sh)

# The section of this version, without its heading.
mkdir -p "$out"
[ -z "$(ls -A "$out")" ] || fail "$out is not empty"
section() {
    awk -v wanted="$1" '/^## / { open = ($2 == wanted) ; next } open' CHANGELOG.md | sed '/./,$!d'
}
section "$version" >"$out/notes.md"
if [ -n "$built" ]; then
    [ -s "$out/notes.md" ] || section Unreleased >"$out/notes.md"
else
    [ -z "$(git status --porcelain)" ] || fail "the tree has changes; commit them"
fi
[ -s "$out/notes.md" ] || fail "CHANGELOG.md has no section '## $version'; rename 'Unreleased'"

SOURCE_DATE_EPOCH=$(git log -1 --format=%ct)
export SOURCE_DATE_EPOCH
if [ -z "$built" ]; then
    sh scripts/setup.sh
    sh scripts/setup.sh page
    sh scripts/build-page.sh
    cargo build --profile dist --locked -p slag-encoder -p slag-edge -p slag-mcap -p slag-mcp -p slag-ros -p slag-manual -p slag-lab
    built=target/dist
fi
rm -rf target/manual
"$built/slag-manual" target/manual
for program in slag-encoder slag-edge slag-mcap slag-mcp slag-ros; do
    [ "$("$built/$program" --version)" = "$program $version" ] || fail "$built/$program is of another version"
done

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
name=slag_${version}_amd64
mkdir "$work/$name"
for program in slag-encoder slag-edge slag-mcap slag-mcp slag-ros; do
    cp "$built/$program" "$work/$name/"
done
cp -r target/manual LICENSE-MIT LICENSE-APACHE "$work/$name/"
tar --create --directory "$work" --sort=name --owner=0 --group=0 --numeric-owner --mtime="@$SOURCE_DATE_EPOCH" "$name" |
    gzip -9n >"$out/$name.tar.gz"
for program in slag-encoder slag-edge; do packaging/deb.sh amd64 "$built/$program" "$out"; done
if has arm64; then
    sh scripts/setup.sh cross
    jetson/build.sh
    packaging/deb.sh arm64 target/aarch64-unknown-linux-gnu/dist/slag-edge "$out"
fi
if has image; then
    sh scripts/setup.sh image
    for program in slag-encoder slag-edge; do packaging/image.sh amd64 "$built/$program" "$out"; done
    as_root=
    [ "$(id -u)" = 0 ] || as_root=sudo
    $as_root packaging/test-image.sh "$out/slag-encoder_${version}_amd64.oci.tar" \
        "$out/slag-edge_${version}_amd64.oci.tar" "$built/slag-lab"
fi
if has sbom; then
    sh scripts/supply-chain.sh
    for bill in target/sbom/*.cdx.json; do
        cp "$bill" "$out/"
    done
fi

# One signature for all files.
(cd "$out" && find . -type f ! -name 'SHA256SUMS*' -printf '%P\n' | LC_ALL=C sort | xargs sha256sum >SHA256SUMS)
ssh-keygen -Y sign -q -f "$key" -n slag-release "$out/SHA256SUMS"
public=$(ssh-keygen -y -f "$key" 2>/dev/null || cat "$key.pub")
echo "slag-release $public" >"$out/allowed_signers"
(cd "$out" && ssh-keygen -Y verify -q -f allowed_signers -I slag-release -n slag-release -s SHA256SUMS.sig <SHA256SUMS && sha256sum --quiet --check SHA256SUMS) ||
    fail "what was written does not verify"
ls -l "$out"
cat <<TEXT
Users who have the public key from you (allowed_signers) verify a download by
  ssh-keygen -Y verify -f allowed_signers -I slag-release -n slag-release -s SHA256SUMS.sig <SHA256SUMS
  sha256sum --check --ignore-missing SHA256SUMS
TEXT
