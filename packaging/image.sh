#!/bin/sh
# Lays out an OCI image of slag-encoder or slag-edge without a container service: a Debian 12 base by mmdebstrap, the program
# with ONNX Runtime above it. The same files and the same state of the mirror make the same digests. Needs
# mmdebstrap and root, or user namespaces.
# usage: image.sh amd64|arm64 BINARY OUT      OUT/PROGRAM_VERSION_ARCH.oci.tar is written, and its path printed
#   IMAGE_PACKAGES: more Debian packages, such as "libvulkan1 mesa-vulkan-drivers" for a GPU that mesa drives
# Load it: skopeo copy oci-archive:FILE docker://registry.example/PROGRAM:VERSION, or podman load --input FILE
set -eu
cd "$(dirname "$0")/.."
[ $# = 3 ] || { echo "usage: packaging/image.sh amd64|arm64 BINARY OUT" >&2; exit 2; }
case $1 in
amd64) machine=x86_64 ;;
arm64) machine=aarch64 ;;
*) echo "image: no image for '$1', expected amd64 or arm64" >&2; exit 2 ;;
esac
arch=$1 binary=$2 out=$3
program=$(basename "$binary")
case $program in
slag-encoder | slag-edge) ;;
*) echo "image: no image for '$program', expected slag-encoder or slag-edge" >&2; exit 2 ;;
esac
command -v mmdebstrap >/dev/null || { echo "image: needs mmdebstrap (Debian: apt-get install mmdebstrap)" >&2; exit 1; }
version=$(sh scripts/version.sh)
# The time of all files and of the image; a commit's own where git knows it.
SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct 2>/dev/null || echo 0)}
export SOURCE_DATE_EPOCH
created=$(date -u -d "@$SOURCE_DATE_EPOCH" +%Y-%m-%dT%H:%M:%SZ)
runtime=$(sh scripts/get-onnxruntime.sh "$machine")

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
trap 'exit 130' INT TERM
layout=$work/layout
mkdir -p "$layout/blobs/sha256"

# Moves a file among the blobs; prints its digest and size, as descriptors have them.
blob() {
    digest=$(sha256sum "$1" | cut -d' ' -f1)
    size=$(stat -c %s "$1")
    mv "$1" "$layout/blobs/sha256/$digest"
    echo "\"digest\":\"sha256:$digest\",\"size\":$size"
}

# The base: what Debian calls essential, the C++ library, and authorities for https://.
site=$(apt-get indextargets --format '$(REPO_URI) $(CODENAME)' 'Created-By: Packages' | awk '$2 == "bookworm" { print $1; exit }')
mmdebstrap --quiet --architectures="$arch" --variant=essential --include="libstdc++6 ca-certificates ${IMAGE_PACKAGES:-}" \
    --dpkgopt='path-exclude=/usr/share/man/*' --dpkgopt='path-exclude=/usr/share/locale/*' \
    --customize-hook='rm -rf "$1"/var/cache/* "$1"/var/log/* "$1"/etc/hostname "$1"/etc/resolv.conf' \
    bookworm "$work/base.tar" "${site:-http://deb.debian.org/debian}" >&2

put() {
    install -D -m "$1" "$2" "$work/program/$3"
}
put 755 "$binary" "usr/bin/$program"
put 644 "$runtime" "usr/lib/$program/libonnxruntime.so"
put 644 LICENSE-MIT "usr/share/doc/$program/LICENSE-MIT"
put 644 LICENSE-APACHE "usr/share/doc/$program/LICENSE-APACHE"
find "$work/program" -type d -exec chmod 755 {} +
tar --create --file "$work/program.tar" --directory "$work/program" --sort=name --owner=0 --group=0 --numeric-owner \
    --mtime="@$SOURCE_DATE_EPOCH" --format=gnu usr

layers= diff_ids=
for layer in base program; do
    diff_ids="$diff_ids${diff_ids:+,}\"sha256:$(sha256sum "$work/$layer.tar" | cut -d' ' -f1)\""
    gzip -9n "$work/$layer.tar"
    layers="$layers${layers:+,}{\"mediaType\":\"application/vnd.oci.image.layer.v1.tar+gzip\",$(blob "$work/$layer.tar.gz")}"
done
cat >"$work/config" <<JSON
{"created":"$created","architecture":"$arch","os":"linux","config":{"Entrypoint":["$program"],"Cmd":["--help"],"Env":["PATH=/usr/sbin:/usr/bin:/sbin:/bin"],"Labels":{"org.opencontainers.image.title":"$program","org.opencontainers.image.version":"$version","org.opencontainers.image.licenses":"Apache-2.0 OR MIT"}},"rootfs":{"type":"layers","diff_ids":[$diff_ids]},"history":[{"created":"$created","created_by":"mmdebstrap bookworm"},{"created":"$created","created_by":"packaging/image.sh"}]}
JSON
config=$(blob "$work/config")
cat >"$work/manifest" <<JSON
{"schemaVersion":2,"mediaType":"application/vnd.oci.image.manifest.v1+json","config":{"mediaType":"application/vnd.oci.image.config.v1+json",$config},"layers":[$layers]}
JSON
manifest=$(blob "$work/manifest")
cat >"$layout/index.json" <<JSON
{"schemaVersion":2,"manifests":[{"mediaType":"application/vnd.oci.image.manifest.v1+json",$manifest,"platform":{"architecture":"$arch","os":"linux"},"annotations":{"org.opencontainers.image.ref.name":"$program:$version"}}]}
JSON
echo '{"imageLayoutVersion":"1.0.0"}' >"$layout/oci-layout"
mkdir -p "$out"
image=$out/${program}_${version}_$arch.oci.tar
tar --create --file "$image" --directory "$layout" --sort=name --owner=0 --group=0 --numeric-owner \
    --mtime="@$SOURCE_DATE_EPOCH" blobs index.json oci-layout
echo "$image"
