#!/bin/sh
# Checks what a store publishes with python-tuf: encodes the generated room, serves it on PORT, and asks before and after
# `store refresh`. Needs debug builds of slag-lab and slag-encoder.
#   tests/python_tuf/run.sh [PORT]
set -eu
here=$(cd "$(dirname "$0")" && pwd)
bin=${SLAG_BIN:-$here/../../target/debug}
port=${1:-7799}
work=$(mktemp -d)
server=
trap 'if [ -n "$server" ]; then kill "$server"; fi; rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --requirement "$here/requirements.txt"
"$bin/slag-lab" generate scene --out "$work/room" --n-views 3 > /dev/null
"$bin/slag-encoder" encode --scene "$work/room/scene.ply" --views "$work/room/transforms.json" --masks graph \
    --models colours --metric --device cpu --quiet --store "$work/store" > /dev/null
"$bin/slag-encoder" serve --store "$work/store" --listen "127.0.0.1:$port" &
server=$!
sleep 3
verify() { "$work/venv/bin/python" "$here/verify.py" "http://127.0.0.1:$port" "$work/store/metadata/1.root.json"; }
first=$(verify)
"$bin/slag-encoder" store refresh --store "$work/store" --days 1
second=$(verify)
expected=$(wc -c < "$work/store/manifest")
[ "$first" = "$expected" ] && [ "$second" = "$expected" ] || { echo "the manifest has $expected bytes, python-tuf got $first and $second"; exit 1; }
echo "python-tuf verified the manifest of $expected bytes, before and after a refresh"
