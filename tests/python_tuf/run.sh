#!/bin/sh
# Checks stores and robots against python-tuf, both ways. Needs debug builds of slag-lab, slag-encoder and slag-edge.
#
# 1. python-tuf verifies what a store publishes: after the encode, after `store refresh`, after `keys rotate`.
# 2. A robot follows a repository that python-tuf publishes, and refuses its attacks.
#   tests/python_tuf/run.sh [PORT]     (uses PORT and PORT + 1)
set -eu
here=$(cd "$(dirname "$0")" && pwd)
bin=${SLAG_BIN:-$here/../../target/debug}
port=${1:-7799}
work=$(mktemp -d)
server=
publisher=
trap 'kill $server $publisher 2>/dev/null || true; rm -rf "$work"' EXIT
fail() { echo "python-tuf: $*" >&2; exit 1; }

python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check --requirement "$here/requirements.txt"
"$bin/slag-lab" generate scene --out "$work/room" --n-views 3 > /dev/null
"$bin/slag-encoder" encode --scene "$work/room/scene.ply" --views "$work/room/transforms.json" --masks graph \
    --models colours --metric --device cpu --quiet --store "$work/store" > /dev/null
"$bin/slag-encoder" serve --quiet --store "$work/store" --listen "127.0.0.1:$port" > /dev/null &
server=$!
sleep 3

expected=$(wc -c < "$work/store/manifest")
verify() {
    found=$("$work/venv/bin/python" "$here/verify.py" "http://127.0.0.1:$port" "$work/store/metadata/1.root.json")
    [ "$found" = "$expected" ] || fail "$1: the manifest has $expected bytes, $found arrived"
}
verify "after the encode"
"$bin/slag-encoder" store refresh --quiet --store "$work/store" --days 1 > /dev/null
verify "after a refresh"
"$bin/slag-encoder" keys rotate root targets snapshot timestamp --quiet --store "$work/store" > /dev/null
verify "after a change of all keys"

mkdir "$work/published"
mkfifo "$work/open"
echo first > "$work/published/state"
"$work/venv/bin/python" "$here/publish.py" "http://127.0.0.1:$port" "$work/store/manifest" "$work/published" \
    "$((port + 1))" < "$work/open" &
publisher=$!
exec 9> "$work/open"
sleep 3
cache="$work/cache"
fetch() { "$bin/slag-edge" fetch --from "http://127.0.0.1:$((port + 1))" --at 3.5,2.7,0 --radius 50 --cache "$cache" --json; }
accepts() {
    echo "$1" > "$work/published/state"
    fetch > "$work/answer" || fail "$1 is refused: $(cat "$work/answer")"
    grep -q "\"root_version\":$2" "$work/answer" || fail "$1: expected root $2: $(cat "$work/answer")"
}
refuses() {
    echo "$1" > "$work/published/state"
    if fetch > "$work/answer"; then fail "$1 is accepted"; fi
    grep -q "$2" "$work/answer" || fail "$1 is refused for another reason than $2: $(cat "$work/answer")"
}
"$bin/slag-edge" trust add --root "$work/published/1.root.json" --cache "$cache" > /dev/null
accepts first 1
accepts rotated 2
refuses rollback "version 1 is offered after 2"
refuses stolen "0 of its keys signed it, expected 1"
refuses mixed "files of different states are mixed"
refuses expired "expired at"
refuses first "0 of its keys signed it, expected 1"
accepts latest 2
"$bin/slag-edge" query blue --models colours --cache "$cache" > /dev/null || fail "the robot does not answer"
echo "python-tuf verified the manifest of $expected bytes three times, and a robot followed what python-tuf published"
