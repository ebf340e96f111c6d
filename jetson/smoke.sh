#!/bin/sh
# Runs the aarch64 slag-edge under emulation: fetches a small generated scene from a real server and compares the
# answers with those of a native build.
# usage: smoke.sh [dist|dev]      as for build.sh
set -eu
cd "$(dirname "$0")/.."
. jetson/room.sh
native=target/debug/slag-edge
folder=${1:-dist}
[ "$folder" != dev ] || folder=debug
# After `test.sh` they are there; alone, cargo would build them again, with the features of fewer packages.
[ -n "${SLAG_PROGRAMS_ARE_BUILT:-}" ] || cargo build --locked --bin slag-encoder --bin slag-lab --bin slag-edge
arm() {
    qemu-aarch64-static -L /usr/aarch64-linux-gnu "target/aarch64-unknown-linux-gnu/$folder/slag-edge" "$@"
}

work=$(mktemp -d)
server=
trap '[ -z "$server" ] || kill "$server" 2>/dev/null; rm -rf "$work"' EXIT
serve_room "$work" --models colours

$native fetch --trust-first --from "$url" --at 3.5,2.7,0 --radius 3 --cache "$work/native" --json >/dev/null
arm fetch --trust-first --from "$url" --at 3.5,2.7,0 --radius 3 --cache "$work/arm" --json
for question in red blue pink; do
    $native query "$question" --models colours --cache "$work/native" --near 3.5,2.7,0 --json >"$work/native.json" || true
    arm query "$question" --models colours --cache "$work/arm" --near 3.5,2.7,0 --json >"$work/arm.json" || true
    # Times may differ, answers must not.
    sed 's/"[a-z_]*_\(ms\|secs\|us\)":[0-9.e-]*,\{0,1\}//g' "$work/native.json" >"$work/native.answers"
    sed 's/"[a-z_]*_\(ms\|secs\|us\)":[0-9.e-]*,\{0,1\}//g' "$work/arm.json" >"$work/arm.answers"
    cmp "$work/native.answers" "$work/arm.answers" || { cat "$work"/*.answers >&2; exit 1; }
done
echo "jetson: slag-edge on aarch64 fetched, verified and answered as on $(uname -m)"
