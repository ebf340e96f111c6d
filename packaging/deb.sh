#!/bin/sh
# Makes a Debian package of slag-encoder or slag-edge: program, ONNX Runtime, manual pages, completions; of slag-edge
# also unit, configuration and the scripts in packaging/slag-edge. The same files make the same bytes.
# usage: deb.sh amd64|arm64 BINARY OUT      OUT/PROGRAM_VERSION_ARCH.deb is written, and its path printed
set -eu
cd "$(dirname "$0")/.."
[ $# = 3 ] || { echo "usage: packaging/deb.sh amd64|arm64 BINARY OUT" >&2; exit 2; }
case $1 in
amd64) machine=x86_64 ;;
arm64) machine=aarch64 ;;
*) echo "deb: no package for '$1', expected amd64 or arm64" >&2; exit 2 ;;
esac
arch=$1 binary=$2 out=$3
program=$(basename "$binary")
depends=
case $program in
slag-edge)
    about="offline text search in the Gaussian splats around a robot"
    more="Fetches the shards around a robot from a store and answers questions such as
 \"where is the chair\" without a network."
    # Its postinst makes a user.
    depends=", passwd"
    ;;
slag-encoder)
    about="makes Gaussian splats searchable by words"
    more="Encodes photos, poses and a trained splat into a store of signed shards, serves it to
 robots, and shows it on a page."
    ;;
*) echo "deb: no package for '$program', expected slag-encoder or slag-edge" >&2; exit 2 ;;
esac
# DEB_VERSION: for tests of upgrades.
version=${DEB_VERSION:-$(sh scripts/version.sh)}
# The time of all files; a commit's own where git knows it.
SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct 2>/dev/null || echo 0)}
export SOURCE_DATE_EPOCH
[ -f "target/manual/$program.1" ] || {
    echo "deb: no manual pages in target/manual; make them: cargo run -p slag-manual --locked -- target/manual" >&2
    exit 1
}
runtime=$(sh scripts/get-onnxruntime.sh "$machine")

root=$(mktemp -d)
trap 'rm -rf "$root"' EXIT
put() {
    install -D -m "$1" "$2" "$root/$3"
}
put 755 "$binary" "usr/bin/$program"
put 644 "$runtime" "usr/lib/$program/libonnxruntime.so"
put 644 LICENSE-MIT "usr/share/doc/$program/copyright"
sed -n '1,$p' LICENSE-APACHE >>"$root/usr/share/doc/$program/copyright"
gzip -9n <CHANGELOG.md >"$root/usr/share/doc/$program/changelog.gz"
chmod 644 "$root/usr/share/doc/$program/changelog.gz"
for page in target/manual/"$program"*.1; do
    install -d "$root/usr/share/man/man1"
    gzip -9n <"$page" >"$root/usr/share/man/man1/${page##*/}.gz"
    chmod 644 "$root/usr/share/man/man1/${page##*/}.gz"
done
put 644 "target/manual/$program.bash" "usr/share/bash-completion/completions/$program"
put 644 "target/manual/_$program" "usr/share/zsh/vendor-completions/_$program"
put 644 "target/manual/$program.fish" "usr/share/fish/vendor_completions.d/$program.fish"
install -d "$root/DEBIAN"
if [ "$program" = slag-edge ]; then
    put 644 jetson/slag-edge.service usr/lib/systemd/system/slag-edge.service
    put 644 jetson/edge.toml etc/slag/edge.toml
    echo /etc/slag/edge.toml >"$root/DEBIAN/conffiles"
    for script in packaging/slag-edge/*; do put 755 "$script" "DEBIAN/${script##*/}"; done
fi

# The newest interface of the C library that program and runtime name.
glibc=$(readelf -V "$binary" "$runtime" | grep -o 'GLIBC_[0-9.]*' | sed 's/GLIBC_//' | sort -V | tail -n 1)
cat >"$root/DEBIAN/control" <<CONTROL
Package: $program
Version: $version
Architecture: $arch
Maintainer: SLAG <slag@localhost>
Installed-Size: $(du -sk --exclude=DEBIAN "$root" | cut -f1)
Depends: libc6 (>= $glibc), libgcc-s1, libstdc++6$depends
Section: science
Priority: optional
Description: $about
 $more
CONTROL
find "$root" -type d -exec chmod 755 {} +
find "$root" -exec touch -h -d "@$SOURCE_DATE_EPOCH" {} +
mkdir -p "$out"
deb=$out/${program}_${version}_$arch.deb
dpkg-deb --root-owner-group -Zgzip --build "$root" "$deb" >/dev/null
echo "$deb"
