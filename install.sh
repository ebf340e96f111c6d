#!/bin/sh
# Sets everything up, builds all programs with the page, and puts them under a prefix: programs, ONNX Runtime,
# manual pages and shell completions. Needs Rust; Debian packages that are missing are installed (with sudo
# where you are not root).
# usage: install.sh [--prefix DIR] [--uninstall]      [default prefix: ~/.local]
set -eu
prefix=$HOME/.local uninstall=
while [ $# -gt 0 ]; do
    case $1 in
    --prefix)
        [ $# -ge 2 ] || { echo "install: --prefix needs a folder" >&2; exit 2; }
        prefix=$2
        shift
        ;;
    --uninstall) uninstall=yes ;;
    *) sed -n '4s/^# //p' "$0" >&2; exit 2 ;;
    esac
    shift
done
case $prefix in
/*) ;;
*) prefix=$PWD/$prefix ;;
esac
cd "$(dirname "$0")"
programs="slag-encoder slag-edge slag-mcap slag-mcp slag-ros"
list=$prefix/lib/slag/installed

# Also before an installation: a file that a newer version no longer has must not stay.
if [ -f "$list" ]; then
    (cd "$prefix" && xargs rm -f <lib/slag/installed && rm -f lib/slag/installed && rmdir lib/slag)
elif [ -n "$uninstall" ]; then
    echo "install: nothing is installed under $prefix" >&2
    exit 1
fi
[ -z "$uninstall" ] || exit 0

sh scripts/setup.sh install
sh scripts/build-page.sh
packages=$(for program in $programs slag-manual; do printf ' -p %s' "$program"; done)
# shellcheck disable=SC2086  # a list
cargo build --release --locked $packages
built=${CARGO_TARGET_DIR:-target}
rm -rf "$built/manual"
"$built/release/slag-manual" "$built/manual"

mkdir -p "$prefix/lib/slag"
put() {
    install -D -m "$1" "$2" "$prefix/$3"
    echo "$3" >>"$list"
}
for program in $programs; do
    put 755 "$built/release/$program" "bin/$program"
    put 644 "$built/manual/$program.bash" "share/bash-completion/completions/$program"
    put 644 "$built/manual/_$program" "share/zsh/site-functions/_$program"
    put 644 "$built/manual/$program.fish" "share/fish/vendor_completions.d/$program.fish"
done
for page in "$built"/manual/*.1; do
    put 644 "$page" "share/man/man1/${page##*/}"
done
put 644 "$(sh scripts/get-onnxruntime.sh)" lib/slag/libonnxruntime.so

for program in $programs; do
    "$prefix/bin/$program" --version
done
echo "installed under $prefix"
case :$PATH: in
*:"$prefix/bin":*) ;;
*) echo "$prefix/bin is not on your PATH; for this shell and later ones: export PATH=\"$prefix/bin:\$PATH\"" ;;
esac
