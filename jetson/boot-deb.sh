#!/bin/sh
# Boots a Debian 12 with the package installed, and checks the unit as shipped under its systemd: it starts by
# itself and is ready, answers from a scene, scores 2.5 or better, and is started again when it falls silent. As
# it is, on an emulated machine with Debian's own kernel: some 15 minutes for arm64 on 2 cores. With --container
# in namespaces of this machine's kernel (container.sh), as CI does: a minute. Another machine's programs are
# emulated there one by one, and qemu neither makes a user namespace nor takes filters of system calls: the
# container test of arm64 leaves out PrivateUsers by a drop-in, systemd itself all directives that are such
# filters. Memory limits need control groups of version 2. Needs root, debootstrap, the programs in
# target/debug, for another machine's packages qemu-user-static with binfmt, and without --container e2fsprogs
# and qemu-system-arm or qemu-system-x86.
# usage: boot-deb.sh [--container] amd64|arm64 DEB [ROOT]       ROOT: a root file system to install into, instead of a new one; needs
#                                                               PACKAGES
set -eu
cd "$(dirname "$0")/.."
. jetson/room.sh
container=
[ "${1:-}" != --container ] || { container=yes; shift; }
[ $# -ge 2 ] || { echo "usage: jetson/boot-deb.sh [--container] amd64|arm64 DEB [ROOT]" >&2; exit 2; }
arch=$1 deb=$2
PACKAGES=systemd,systemd-sysv,curl
BOOT_SECS=600
if [ -z "$container" ]; then
    PACKAGES=$PACKAGES,linux-image-$arch,initramfs-tools
    BOOT_SECS=1500
fi
case $arch in
arm64)
    emulator="qemu-system-aarch64 -machine virt -cpu cortex-a76"
    console=/dev/ttyAMA0
    ;;
amd64)
    emulator="qemu-system-x86_64 -machine q35 -cpu Haswell-v4"
    console=/dev/ttyS0
    [ ! -w /dev/kvm ] || emulator="qemu-system-x86_64 -machine q35,accel=kvm -cpu host"
    ;;
*)
    echo "boot-deb: no machine for '$arch', expected amd64 or arm64" >&2
    exit 2
    ;;
esac
[ -z "$container" ] || console=/var/log/slag-check
fail() {
    echo "boot-deb: $*" >&2
    exit 1
}
work=$(mktemp -d)
server=
trap '[ -z "$server" ] || kill "$server" 2>/dev/null || true; umount "$root/proc" 2>/dev/null || true; rm -rf "$work"' EXIT
root=${3:-$work/root}
if [ $# -lt 3 ]; then
    if [ -z "$container" ]; then
        # Only what the emulated disk needs: with all modules, making the initial file system takes half an hour
        # under emulation.
        mkdir -p "$root/etc/initramfs-tools/conf.d" "$root/usr/share/initramfs-tools/modules.d"
        echo MODULES=list >"$root/etc/initramfs-tools/conf.d/slag"
        printf '%s\n' virtio_pci virtio_blk ext4 >"$root/usr/share/initramfs-tools/modules.d/slag"
    fi
    jetson/root.sh "$arch" "$root" "$PACKAGES"
fi
mountpoint -q "$root/proc" || mount -t proc proc "$root/proc"
inside() {
    chroot "$root" /usr/bin/env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root DEBIAN_FRONTEND=noninteractive "$@"
}
cp "$deb" "$root/slag.deb"
inside dpkg --install /slag.deb
rm "$root/slag.deb"
[ -L "$root/etc/systemd/system/multi-user.target.wants/slag-edge.service" ] || fail "the unit is not enabled"
serve_room "$work/scene"
inside setpriv --reuid slag --regid slag --clear-groups slag-edge fetch --trust-first --from "$url" --at 3.5,2.7,0 --radius 3
umount "$root/proc"

# What the machine runs once it is up; the last line says how it ended.
cat >"$root/usr/local/sbin/slag-check" <<'CHECK'
#!/bin/sh
fail() {
    systemctl status --no-pager --lines=30 slag-edge
    echo "slag-check: FAILED: $*"
    systemctl poweroff
    exit 1
}
until_true() { # SECONDS COMMAND...
    left=$1
    shift
    until "$@" >/dev/null 2>&1; do
        left=$((left - 1))
        [ "$left" -gt 0 ] || return 1
        sleep 1
    done
}
is_ready() { curl --silent --fail --max-time 60 http://127.0.0.1:7734/readyz; }
property() { systemctl show --property "$1" --value slag-edge; }
until_true 300 systemctl is-active slag-edge || fail "the unit is not active"
until_true 120 is_ready || fail "not ready"
echo "slag-check: $(uname -srm), systemd $(systemctl --version | head -n 1): active, /readyz says $(is_ready)"
answer=$(curl --silent --fail --max-time 120 "http://127.0.0.1:7734/query?text=blue&limit=1") || fail "no answer"
echo "slag-check: answered $(echo "$answer" | head -c 300)"
systemd-analyze security --no-pager --threshold=25 slag-edge.service >/tmp/security || fail "its exposure is $(tail -n 1 /tmp/security)"
echo "slag-check: $(tail -n 1 /tmp/security)"
first=$(property MainPID) restarts=$(property NRestarts)
kill -STOP "$first"
is_another() { [ "$(property MainPID)" != "$first" ] && [ "$(property NRestarts)" -gt "$restarts" ] && systemctl is-active slag-edge; }
until_true 300 is_another || fail "silent for 300 s and not started again"
until_true 120 is_ready || fail "not ready after it was started again"
echo "slag-check: stopped, and started again: $(journalctl --no-pager --unit slag-edge --grep 'atchdog' --output cat | head -n 1)"
echo "slag-check: PASSED"
systemctl poweroff
CHECK
chmod 755 "$root/usr/local/sbin/slag-check"
cat >"$root/etc/systemd/system/slag-check.service" <<UNIT
[Unit]
After=multi-user.target
[Service]
Type=oneshot
ExecStart=/usr/local/sbin/slag-check
StandardOutput=file:$console
StandardError=inherit
TimeoutStartSec=infinity
[Install]
WantedBy=default.target
UNIT
inside systemctl enable slag-check.service
if [ -n "$container" ]; then
    overrides=$root/etc/systemd/system/slag-edge.service.d
    if [ "$arch" != "$(dpkg --print-architecture)" ]; then
        mkdir -p "$overrides"
        printf '[Service]\nPrivateUsers=no\n' >"$overrides/emulated.conf"
    fi
    jetson/container.sh "$root" $BOOT_SECS || true
    rm -rf "$overrides"
    mv "$root$console" "$work/console" || fail "systemd did not come up"
    where="in a container"
else
    mke2fs -q -t ext4 -d "$root" "$work/disk" 2500M
    # Emulated, the first start may take minutes.
    timeout $BOOT_SECS $emulator -smp 2 -m 2048 -nographic -no-reboot -nic none \
        -kernel "$(ls "$root"/boot/vmlinuz-* | tail -n 1)" -initrd "$(ls "$root"/boot/initrd.img-* | tail -n 1)" \
        -append "root=/dev/vda rw console=${console#/dev/} systemd.default_timeout_start_sec=600" \
        -drive if=virtio,format=raw,file="$work/disk" </dev/null >"$work/console" 2>&1 || true
    where="on an emulated machine"
fi
grep -a 'slag-check:' "$work/console" || true
grep -aq 'slag-check: PASSED' "$work/console" || { tail -n 60 "$work/console" >&2; fail "the unit does not hold on Debian 12 $arch"; }
echo "boot-deb: started by systemd, ready, answered, and started again on Debian 12 $arch $where"
