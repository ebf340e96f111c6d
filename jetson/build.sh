#!/bin/sh
# Cross-builds slag-edge for the Jetson Orin (aarch64, JetPack 6: glibc 2.35) and checks its glibc version.
set -eu
cd "$(dirname "$0")/.."
target=aarch64-unknown-linux-gnu
max_glibc=2.35

export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc
export CC_aarch64_unknown_linux_gnu=aarch64-linux-gnu-gcc
cargo build --profile dist --locked --target $target --package slag-edge --bin slag-edge
binary=target/$target/dist/slag-edge

highest=$(aarch64-linux-gnu-objdump -T "$binary" | grep -o 'GLIBC_[0-9.]*' | sed 's/GLIBC_//' | sort -V | tail -n 1)
if [ "$(printf '%s\n' "$highest" $max_glibc | sort -V | tail -n 1)" != $max_glibc ]; then
    echo "jetson: $binary needs glibc $highest, but JetPack 6 has $max_glibc" >&2
    exit 1
fi
echo "jetson: $binary, $(wc -c <"$binary") bytes, needs glibc $highest"
