#!/bin/sh
# Makes a Debian package of slag-edge: program, unit, ONNX Runtime, configuration, manual pages, completions.
# The same files make the same bytes.
# usage: deb.sh amd64|arm64 BINARY OUT      OUT/slag-edge_VERSION_ARCH.deb is written, and its path printed
set -eu
cd "$(dirname "$0")/.."
[ $# = 3 ] || { echo "usage: jetson/deb.sh amd64|arm64 BINARY OUT" >&2; exit 2; }
case $1 in
amd64) machine=x86_64 ;;
arm64) machine=aarch64 ;;
*) echo "deb: no package for '$1', expected amd64 or arm64" >&2; exit 2 ;;
esac
arch=$1 binary=$2 out=$3
# DEB_VERSION: for tests of upgrades.
version=${DEB_VERSION:-$(sh scripts/version.sh)}
# The time of all files; a commit's own where git knows it.
SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct 2>/dev/null || echo 0)}
export SOURCE_DATE_EPOCH
[ -f target/manual/slag-edge.1 ] || {
    echo "deb: no manual pages in target/manual; make them: cargo run -p slag-manual --locked -- target/manual" >&2
    exit 1
}
runtime=$(sh scripts/get-onnxruntime.sh "$machine")

root=$(mktemp -d)
trap 'rm -rf "$root"' EXIT
put() {
    install -D -m "$1" "$2" "$root/$3"
}
put 755 "$binary" usr/bin/slag-edge
put 644 "$runtime" usr/lib/slag/libonnxruntime.so
put 644 jetson/slag-edge.service usr/lib/systemd/system/slag-edge.service
put 644 jetson/edge.toml etc/slag/edge.toml
put 644 LICENSE-MIT usr/share/doc/slag-edge/copyright
sed -n '1,$p' LICENSE-APACHE >>"$root/usr/share/doc/slag-edge/copyright"
gzip -9n <CHANGELOG.md >"$root/usr/share/doc/slag-edge/changelog.gz"
chmod 644 "$root/usr/share/doc/slag-edge/changelog.gz"
for page in target/manual/slag-edge*.1; do
    install -d "$root/usr/share/man/man1"
    gzip -9n <"$page" >"$root/usr/share/man/man1/${page##*/}.gz"
    chmod 644 "$root/usr/share/man/man1/${page##*/}.gz"
done
put 644 target/manual/slag-edge.bash usr/share/bash-completion/completions/slag-edge
put 644 target/manual/_slag-edge usr/share/zsh/vendor-completions/_slag-edge
put 644 target/manual/slag-edge.fish usr/share/fish/vendor_completions.d/slag-edge.fish

# The newest interface of the C library that program and runtime name.
glibc=$(readelf -V "$binary" "$runtime" | grep -o 'GLIBC_[0-9.]*' | sed 's/GLIBC_//' | sort -V | tail -n 1)
install -d "$root/DEBIAN"
echo /etc/slag/edge.toml >"$root/DEBIAN/conffiles"
cat >"$root/DEBIAN/control" <<CONTROL
Package: slag-edge
Version: $version
Architecture: $arch
Maintainer: SLAG <slag@localhost>
Installed-Size: $(du -sk --exclude=DEBIAN "$root" | cut -f1)
Depends: libc6 (>= $glibc), libgcc-s1, libstdc++6, passwd
Section: science
Priority: optional
Description: offline text search in the Gaussian splats around a robot
 Fetches the shards around a robot from a store and answers questions such as
 "where is the chair" without a network.
CONTROL
# Debian's helpers (init-system-helpers is essential) remember whether an operator disabled or masked the unit.
cat >"$root/DEBIAN/postinst" <<'SCRIPT'
#!/bin/sh
set -e
if [ "$1" = configure ]; then
    getent passwd slag >/dev/null ||
        useradd --system --user-group --home-dir /var/lib/slag --no-create-home --shell /usr/sbin/nologin slag
    install -d -o slag -g slag -m 755 /var/lib/slag
    if deb-systemd-helper --quiet was-enabled slag-edge.service; then
        deb-systemd-helper enable slag-edge.service >/dev/null
    else
        deb-systemd-helper update-state slag-edge.service >/dev/null
    fi
    if [ -d /run/systemd/system ]; then
        systemctl daemon-reload
        # The new program takes over; what an operator disabled is left alone.
        deb-systemd-invoke restart slag-edge.service ||
            echo "slag-edge does not start: journalctl -u slag-edge" >&2
    fi
fi
SCRIPT
cat >"$root/DEBIAN/prerm" <<'SCRIPT'
#!/bin/sh
set -e
if [ "$1" = remove ] && [ -d /run/systemd/system ]; then
    deb-systemd-invoke stop slag-edge.service
fi
SCRIPT
# What was fetched and whom the robot trusts stay until the package is purged; the user stays for good, as
# Debian advises.
cat >"$root/DEBIAN/postrm" <<'SCRIPT'
#!/bin/sh
set -e
[ ! -d /run/systemd/system ] || systemctl daemon-reload
if [ "$1" = purge ]; then
    deb-systemd-helper purge slag-edge.service >/dev/null
    rm -rf /var/lib/slag
fi
SCRIPT
chmod 755 "$root"/DEBIAN/postinst "$root"/DEBIAN/prerm "$root"/DEBIAN/postrm
find "$root" -type d -exec chmod 755 {} +
find "$root" -exec touch -h -d "@$SOURCE_DATE_EPOCH" {} +
mkdir -p "$out"
deb=$out/slag-edge_${version}_$arch.deb
dpkg-deb --root-owner-group -Zgzip --build "$root" "$deb" >/dev/null
echo "$deb"
