#!/bin/sh
# Puts libonnxruntime.so, which the encoder and the robot load at run time, into a folder.
# usage: get-onnxruntime.sh [x86_64|aarch64] [DIR]     (default: this machine's, target/onnxruntime/ARCH)
set -eu

VERSION=1.31.1

fail() {
    echo "get-onnxruntime: $*" >&2
    exit 1
}

[ $# -le 2 ] || fail "usage: get-onnxruntime.sh [x86_64|aarch64] [DIR]"
arch=${1:-$(uname -m)}
case $arch in
x86_64) wheel_sha256=1f3dea47f2f0e5117c2404cea7d21fd253ae7836a3bf167a501cdfbb2600d536 ;;
aarch64) wheel_sha256=0b9a492176886992e0e875f06bc0367e333f5fff11711a2d642e18b02f3009cc ;;
*) fail "no pinned library for '$arch'; give x86_64 or aarch64, or install ONNX Runtime yourself" ;;
esac
root=$(cd "$(dirname "$0")/.." && pwd)
dir=${2:-$root/target/onnxruntime/$arch}
library=$dir/libonnxruntime.so
# Written last, so an interrupted run starts over.
stamp=$dir/libonnxruntime.wheel-sha256

if [ -f "$library" ] && [ "$(cat "$stamp" 2>/dev/null)" = "$wheel_sha256" ]; then
    echo "$library"
    exit 0
fi

python3 -m pip --version >/dev/null 2>&1 || fail "needs python3 with pip; install them and run this again"
mkdir -p "$dir"
staging=$(mktemp -d "$dir/staging.XXXXXX")
trap 'rm -rf "$staging"' EXIT
trap 'exit 130' INT TERM

python3 -m pip download --quiet --disable-pip-version-check --no-deps --only-binary=:all: \
    --python-version 3.12 --platform "manylinux_2_28_$arch" --dest "$staging" "onnxruntime==$VERSION" >&2 ||
    fail "download failed; check the network, or put a libonnxruntime.so (1.17 or newer) into $dir"
wheel=$(echo "$staging"/onnxruntime-"$VERSION"-*.whl)
[ -f "$wheel" ] || fail "pip left no single wheel of onnxruntime $VERSION"
found=$(sha256sum "$wheel" | cut -d' ' -f1)
[ "$found" = "$wheel_sha256" ] ||
    fail "$(basename "$wheel"): SHA-256 is $found, expected $wheel_sha256; do not use this file"

python3 -m zipfile -e "$wheel" "$staging/wheel"
mv "$staging/wheel/onnxruntime/capi/libonnxruntime.so.$VERSION" "$library"
echo "$wheel_sha256" >"$stamp"
echo "$library"
