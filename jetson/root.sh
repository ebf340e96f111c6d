#!/bin/sh
# Makes a Debian 12 root file system, from the mirror that this machine installs from. Needs root and
# debootstrap; for another machine's also qemu-user-static with binfmt.
# usage: root.sh amd64|arm64 ROOT [PACKAGE,PACKAGE...]
set -eu
[ $# -ge 2 ] || { echo "usage: jetson/root.sh amd64|arm64 ROOT [PACKAGE,...]" >&2; exit 2; }
arch=$1 packages=${3:-}
mkdir -p "$2"
root=$(realpath "$2")
site=$(apt-get indextargets --format '$(REPO_URI) $(CODENAME)' 'Created-By: Packages' | awk '$2 == "bookworm" { print $1; exit }')
log=$(mktemp)
trap 'rm -f "$log"' EXIT
debootstrap --variant=minbase --arch="$arch" ${packages:+--include="$packages"} bookworm "$root" "$site" >"$log" 2>&1 || {
    tail "$log" >&2
    echo "root: debootstrap fails" >&2
    exit 1
}
