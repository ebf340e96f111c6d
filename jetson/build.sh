#!/bin/sh
# Cross-builds slag-edge for the Jetson Orin (aarch64, JetPack 6: glibc 2.35) and checks its glibc version.
# usage: build.sh [dist|dev]      dist, the default: the packaged program; dev: built in a third of the time, for checks
set -eu
cd "$(dirname "$0")/.."
target=aarch64-unknown-linux-gnu
max_glibc=2.35
profile=${1:-dist}

export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc
export CC_aarch64_unknown_linux_gnu=aarch64-linux-gnu-gcc
cargo build --profile "$profile" --locked --target $target --package slag-edge --bin slag-edge
folder=$profile
[ "$profile" != dev ] || folder=debug
binary=target/$target/$folder/slag-edge

highest=$(aarch64-linux-gnu-objdump -T "$binary" | grep -o 'GLIBC_[0-9.]*' | sed 's/GLIBC_//' | sort -V | tail -n 1)
if [ "$(printf '%s\n' "$highest" $max_glibc | sort -V | tail -n 1)" != $max_glibc ]; then
    echo "jetson: $binary needs glibc $highest, but JetPack 6 has $max_glibc" >&2
    exit 1
fi
echo "jetson: $binary, $(wc -c <"$binary") bytes, needs glibc $highest"
