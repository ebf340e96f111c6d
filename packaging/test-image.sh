#!/bin/sh
# Judges both images by skopeo and umoci, unpacks them, and runs the programs in them: a generated room becomes a store, and a
# robot fetches it and answers. Needs root.
# usage: test-image.sh ENCODER_IMAGE EDGE_IMAGE LAB      LAB: the program slag-lab, to generate the room
set -eu
[ $# = 3 ] || { echo "usage: packaging/test-image.sh ENCODER_IMAGE EDGE_IMAGE LAB" >&2; exit 2; }
encoder_image=$1 edge_image=$2 lab=$3
version=$(sh "$(dirname "$0")/../scripts/version.sh")
fail() {
    echo "test-image: $*" >&2
    exit 1
}
work=$(mktemp -d)
service=
clean_up() {
    [ -z "$service" ] || kill "$service" 2>/dev/null || true
    umount "$work"/*/bundle/rootfs/proc 2>/dev/null || true
    rm -rf "$work"
}
trap clean_up EXIT

unpack() {
    program=$1 image=$2
    mkdir -p "$work/$program/layout"
    skopeo inspect --config "oci-archive:$image" >"$work/$program/config"
    python3 - "$work/$program/config" "$version" "$program" <<'PYTHON' || fail "the configuration of $image is not as expected"
import json, sys
config = json.load(open(sys.argv[1]))
assert config["os"] == "linux" and config["config"]["Entrypoint"] == [sys.argv[3]], config
assert config["config"]["Labels"]["org.opencontainers.image.version"] == sys.argv[2], config
PYTHON
    tar -xf "$image" -C "$work/$program/layout"
    # By the name that podman load gives it. umoci compares every blob with its digest, and the layers with the
    # configuration.
    umoci unpack --image "$work/$program/layout:$program:$version" "$work/$program/bundle" >/dev/null 2>"$work/log" ||
        { cat "$work/log" >&2; fail "umoci does not unpack $image"; }
    mount -t proc proc "$work/$program/bundle/rootfs/proc"
    [ "$(inside "$program" --version)" = "$program $version" ] || fail "another version answers in $image"
}
# Runs a program in its image; the network is this machine's.
inside() {
    chroot "$work/$1/bundle/rootfs" /usr/bin/env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/tmp "$@"
}

unpack slag-encoder "$encoder_image"
unpack slag-edge "$edge_image"
# The demo's encode: masks and vectors from the embedded models, so that ONNX Runtime is opened.
room=$work/slag-encoder/bundle/rootfs/tmp/room
"$lab" generate scene --out "$room" --n-views 3 >/dev/null
inside slag-encoder encode --scene /tmp/room/scene.ply --views /tmp/room/transforms.json --metric --device cpu --store /tmp/store --json >"$work/summary"
python3 -c 'import json, sys; s = json.load(open(sys.argv[1])); assert s["generation"] == 1 and s["n_masks"] > 0, s' "$work/summary" ||
    fail "the encode in the image is not as expected"
inside slag-encoder store verify --store /tmp/store >/dev/null
inside slag-encoder serve --store /tmp/store --listen 127.0.0.1:0 >"$work/listening" 2>"$work/log" &
service=$!
for _ in $(seq 60); do
    grep -q listening "$work/listening" && break
    sleep 0.5
done
url=$(sed -n 's/^listening on //p' "$work/listening")
[ -n "$url" ] || { cat "$work/log" >&2; fail "the service does not start"; }
inside slag-edge fetch --from "$url" --at 0,0,0 --radius 50 --trust-first >/dev/null
inside slag-edge doctor >"$work/log" || { cat "$work/log" >&2; fail "the robot cannot answer"; }
inside slag-edge query chair --json | python3 -c 'import json, sys; json.load(sys.stdin)' || fail "the robot does not answer"
echo "test-image: inspected and unpacked both; a room was encoded, served, fetched and asked"
