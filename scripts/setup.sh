#!/bin/sh
# Installs what SLAG needs beside Rust: a C linker, Python's pip (to unpack ONNX Runtime), ONNX Runtime, and
# Vulkan with a software GPU, on which the GPU rasteriser is tested where there is no other.
# usage: setup.sh [demo|cross|page|image]     demo: without the software GPU; cross: also what the aarch64 build and its smoke test need;
#                                       page: also what building and testing the page needs; image: also what lays out and judges the encoder's image
# Does nothing where all is there already. Made for Debian 12; elsewhere install the same by hand.
set -eu
cd "$(dirname "$0")/.."

fail() {
    echo "setup: $*" >&2
    exit 1
}

# "command:package" pairs; the packages are Debian 12's, pinned by its major versions where it has several.
wanted="cc:gcc-12 cc:gcc ld:binutils python3:python3 pip3:python3-pip"
# Tests read manual pages as people do.
[ "${1:-}" = demo ] || wanted="$wanted man:man-db"
[ "${1:-}" = cross ] &&
    wanted="$wanted aarch64-linux-gnu-gcc:gcc-aarch64-linux-gnu aarch64-linux-gnu-gcc:libc6-dev-arm64-cross qemu-aarch64-static:qemu-user-static debootstrap:debootstrap systemd-analyze:systemd"

[ "${1:-}" = image ] && wanted="$wanted mmdebstrap:mmdebstrap skopeo:skopeo umoci:umoci"
[ "${1:-}" = page ] && wanted="$wanted node:nodejs npm:npm chromium:chromium"

missing=
for pair in $wanted; do
    command -v "${pair%%:*}" >/dev/null 2>&1 || missing="$missing ${pair#*:}"
done
# Tests install clients of other projects into environments of their own.
[ "${1:-}" = demo ] || python3 -c 'import ensurepip' 2>/dev/null || missing="$missing python3-venv"
# Without a GPU the program runs all the same; tests of the GPU rasteriser need one, or this.
if command -v apt-get >/dev/null 2>&1 && [ "${1:-}" != demo ]; then
    ls /usr/lib/*/libvulkan.so.1 >/dev/null 2>&1 || missing="$missing libvulkan1"
    find /usr/share/vulkan/icd.d /etc/vulkan/icd.d -name '*.json' 2>/dev/null | grep -q . ||
        missing="$missing mesa-vulkan-drivers"
fi
if [ -n "$missing" ]; then
    command -v apt-get >/dev/null 2>&1 || fail "needs these Debian packages, or what they are called here:$missing"
    as_root=
    [ "$(id -u)" = 0 ] || as_root=sudo
    echo "setup: installing$missing" >&2
    $as_root apt-get update -qq
    # shellcheck disable=SC2086  # a list
    DEBIAN_FRONTEND=noninteractive $as_root apt-get install -y -qq --no-install-recommends libc6-dev $missing >&2
fi

command -v cargo >/dev/null 2>&1 || fail "needs Rust $(sed -n 's/^rust-version = "\(.*\)"/\1/p' Cargo.toml) or newer (cargo is not on the PATH)"
if [ "${1:-}" = cross ]; then
    rustup target list --installed | grep -qx aarch64-unknown-linux-gnu ||
        rustup target add aarch64-unknown-linux-gnu >&2
fi
sh scripts/get-onnxruntime.sh >/dev/null
