#!/bin/sh
# Installs what SLAG needs beside Rust: a C linker, Python's pip (to unpack ONNX Runtime), ONNX Runtime, and
# Vulkan with a software GPU, on which the GPU rasteriser is tested where there is no other.
# usage: setup.sh [demo|install|test|cross|page|packages|image]      default: test
#   demo, install: without what tests need; cross: also for the aarch64 build and its smoke test; page: also for tests of the
#   page; packages: also for tests of the packages; image: also what lays out and judges the encoder's image
# Does nothing where all is there already. Made for Debian 12; elsewhere install the same by hand.
set -eu
cd "$(dirname "$0")/.."

fail() {
    echo "setup: $*" >&2
    exit 1
}

purpose=${1:-test}
case $purpose in
demo | install | test | cross | page | packages | image) ;;
*) fail "there is no purpose '$purpose'; expected demo, install, test, cross, page, packages or image" ;;
esac

# "command:package" pairs; the packages are Debian 12's, pinned by its major versions where it has several.
wanted="cc:gcc-12 cc:gcc ld:binutils python3:python3 pip3:python3-pip"
case $purpose in
demo | install) ;;
# Tests read manual pages as people do.
*) wanted="$wanted man:man-db" ;;
esac
case $purpose in
cross) wanted="$wanted aarch64-linux-gnu-gcc:gcc-aarch64-linux-gnu aarch64-linux-gnu-gcc:libc6-dev-arm64-cross qemu-aarch64-static:qemu-user-static" ;;
packages) wanted="$wanted debootstrap:debootstrap systemd-analyze:systemd" ;;
image) wanted="$wanted mmdebstrap:mmdebstrap skopeo:skopeo umoci:umoci" ;;
page) wanted="$wanted chromium:chromium" ;;
esac

missing=
for pair in $wanted; do
    command -v "${pair%%:*}" >/dev/null 2>&1 || missing="$missing ${pair#*:}"
done
if command -v apt-get >/dev/null 2>&1 && [ "$purpose" != demo ]; then
    # The GPU's driver brings its own part; without a GPU the programs run all the same.
    ls /usr/lib/*/libvulkan.so.1 >/dev/null 2>&1 || missing="$missing libvulkan1"
fi
case $purpose in
demo | install) ;;
*)
    # Tests install clients of other projects into environments of their own.
    python3 -c 'import ensurepip' 2>/dev/null || missing="$missing python3-venv"
    # Tests of the GPU rasteriser need a GPU, or this.
    find /usr/share/vulkan/icd.d /etc/vulkan/icd.d -name '*.json' 2>/dev/null | grep -q . ||
        missing="$missing mesa-vulkan-drivers"
    ;;
esac
if [ -n "$missing" ]; then
    command -v apt-get >/dev/null 2>&1 || fail "needs these Debian packages, or what they are called here:$missing"
    as_root=
    [ "$(id -u)" = 0 ] || as_root=sudo
    [ -z "$as_root" ] || command -v sudo >/dev/null || fail "needs these Debian packages; have root install them:$missing"
    echo "setup: installing$missing" >&2
    $as_root apt-get update -qq
    # shellcheck disable=SC2086  # a list
    DEBIAN_FRONTEND=noninteractive $as_root apt-get install -y -qq --no-install-recommends libc6-dev $missing >&2
fi

command -v cargo >/dev/null 2>&1 || fail "needs Rust $(sed -n 's/^rust-version = "\(.*\)"/\1/p' Cargo.toml) or newer (cargo is not on the PATH)"
if [ "$purpose" = cross ]; then
    rustup target list --installed | grep -qx aarch64-unknown-linux-gnu ||
        rustup target add aarch64-unknown-linux-gnu >&2
fi
sh scripts/get-onnxruntime.sh >/dev/null
