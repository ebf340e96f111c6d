#!/bin/sh
# Boots a root file system in namespaces of its own, with its systemd as process 1, until it powers itself off.
# It has no network but its own loopback, and neither clock, modules nor kernel variables of this machine. Of
# another machine's programs, binfmt runs each. Needs root.
# usage: container.sh ROOT SECONDS       after SECONDS it is killed
set -eu
[ $# -eq 2 ] || { echo "usage: jetson/container.sh ROOT SECONDS" >&2; exit 2; }
root=$1 secs=$2
work=$(mktemp -d)
# systemd needs a control group of version 2 that it may divide; where the controllers are in version 1, it has
# none, and limits of memory are not enforced.
mount -t cgroup2 none "$work"
group=$work/slag-boot-$$
trap 'find "$group" -depth -type d -exec rmdir {} + 2>/dev/null || true; umount "$work"; rmdir "$work"' EXIT
mkdir "$group"
export root secs group
sh -c 'echo $$ >"$group/cgroup.procs"
exec timeout --signal=KILL "$secs" unshare --pid --fork --kill-child --mount --uts --ipc --net --cgroup sh -eu -c "$0"' '
mount --make-rprivate /
mount --bind "$root" "$root"
cd "$root"
mount -t proc proc proc
for path in proc/sys proc/sysrq-trigger; do
    [ ! -e $path ] || mount --bind -o ro $path $path
done
mount -t sysfs -o ro sysfs sys
# Emulated programs must not take this processor for theirs: ONNX Runtime looks here for one of its own kind.
mount -t tmpfs -o ro tmpfs sys/devices/system/cpu
mount -t cgroup2 cgroup2 sys/fs/cgroup
mount -t tmpfs -o mode=755 tmpfs run
mount -t tmpfs -o mode=755 tmpfs dev
while read -r name minor; do mknod -m 666 dev/$name c 1 $minor; done <<NODES
null 3
zero 5
full 7
random 8
urandom 9
NODES
mkdir dev/pts dev/shm run/outside
mount -t devpts -o newinstance,ptmxmode=0666 devpts dev/pts
ln -s pts/ptmx dev/ptmx
pivot_root . run/outside
exec setpriv --bounding-set=-sys_module,-sys_time,-sys_rawio,-mknod env -i container=slag \
    sh -c "umount -l /run/outside; exec /lib/systemd/systemd"
'
