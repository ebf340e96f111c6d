#!/bin/sh
# Installs, runs, upgrades, removes and purges the package in a new Debian 12 root file system. Needs root and
# debootstrap; for another machine's packages also qemu-user-static with binfmt.
# usage: test-deb.sh amd64|arm64 DEB NEWER_DEB [ROOT]       ROOT: a root file system to use, instead of a new one
set -eu
cd "$(dirname "$0")/.."
[ $# -ge 3 ] || { echo "usage: jetson/test-deb.sh amd64|arm64 DEB NEWER_DEB [ROOT]" >&2; exit 2; }
arch=$1 deb=$2 newer=$3
fail() {
    echo "test-deb: $*" >&2
    exit 1
}
work=$(mktemp -d)
service=
trap '[ -z "$service" ] || kill "$service" 2>/dev/null || true; umount "$root/proc" 2>/dev/null || true; rm -rf "$work"' EXIT
root=${4:-$work/root}
[ $# -ge 4 ] || jetson/root.sh "$arch" "$root"
mount -t proc proc "$root/proc"
inside() {
    chroot "$root" /usr/bin/env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root DEBIAN_FRONTEND=noninteractive "$@"
}
# In place of the shell that runs it in the background, so that ending that ends the service.
as_slag() {
    exec chroot "$root" /usr/bin/env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root setpriv --reuid slag --regid slag --clear-groups "$@"
}

cp "$deb" "$root/old.deb"
cp "$newer" "$root/new.deb"
inside dpkg --install /old.deb
inside getent passwd slag >/dev/null || fail "there is no user slag"
[ "$(inside stat -c %U /var/lib/slag)" = slag ] || fail "/var/lib/slag is not slag's"
[ "$(inside slag-edge --version)" = "slag-edge $(dpkg-deb --field "$deb" Version)" ] || fail "program and package have different versions"
# Debian's minimal systems leave manual pages out unless asked to, so the package itself is read.
for file in $(sed -n 's/^Documentation=man:\(.*\)(\(.\))$/.\/usr\/share\/man\/man\2\/\1.\2.gz/p' jetson/slag-edge.service) \
    ./usr/share/man/man1/slag-edge-fetch.1.gz ./usr/share/bash-completion/completions/slag-edge; do
    dpkg-deb --fsys-tarfile "$deb" | tar -tf - "$file" >/dev/null || fail "the package lacks $file"
done
# The unit's own command, as its user; the configuration names the folder, and the model opens ONNX Runtime from
# the package.
as_slag slag-edge serve --listen 127.0.0.1:0 >"$work/out" 2>"$work/err" &
service=$!
for _ in $(seq 120); do
    grep -q listening "$work/out" && break
    kill -0 "$service" 2>/dev/null || break
    sleep 0.5
done
url=$(sed -n 's/^listening on //p' "$work/out")
[ -n "$url" ] || { cat "$work/err" >&2; fail "the service does not start"; }
python3 - "$url" <<'PYTHON' || { cat "$work/err" >&2; fail "the service does not answer"; }
import sys, urllib.request
assert urllib.request.urlopen(sys.argv[1] + "/healthz", timeout=30).read() == b"alive\n"
PYTHON
kill "$service"
wait "$service" || true
service=

wanted=$root/etc/systemd/system/multi-user.target.wants/slag-edge.service
[ -L "$wanted" ] || fail "the unit is not enabled"
# As `systemctl disable` does.
rm "$wanted"
echo '# kept' >>"$root/etc/slag/edge.toml"
inside dpkg --force-confold --install /new.deb
[ "$(tail -n 1 "$root/etc/slag/edge.toml")" = '# kept' ] || fail "the upgrade lost the configuration"
[ ! -e "$wanted" ] && [ ! -L "$wanted" ] || fail "the upgrade enabled a unit that was disabled"
inside dpkg-query --show slag-edge
inside dpkg --remove slag-edge
[ ! -e "$root/usr/bin/slag-edge" ] || fail "remove left the program"
[ -e "$root/etc/slag/edge.toml" ] || fail "remove took the configuration"
inside dpkg --purge slag-edge
[ ! -e "$root/etc/slag/edge.toml" ] || fail "purge left the configuration"
[ ! -e "$root/var/lib/slag" ] || fail "purge left what was fetched"
echo "test-deb: installed, started, upgraded, removed and purged on Debian 12 $arch"
