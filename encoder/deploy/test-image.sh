#!/bin/sh
# Judges an image by skopeo and umoci, unpacks it, and runs the encoder in it: a generated room becomes a store.
# Needs root.
# usage: test-image.sh IMAGE LAB      LAB: the program slag-lab, to generate the room
set -eu
[ $# = 2 ] || { echo "usage: encoder/deploy/test-image.sh IMAGE LAB" >&2; exit 2; }
image=$1 lab=$2
version=$(sh "$(dirname "$0")/../../scripts/version.sh")
fail() {
    echo "test-image: $*" >&2
    exit 1
}
work=$(mktemp -d)
trap 'umount "$work/bundle/rootfs/proc" 2>/dev/null || true; rm -rf "$work"' EXIT

skopeo inspect --config "oci-archive:$image" >"$work/config"
python3 - "$work/config" "$version" <<'PYTHON' || fail "the image's configuration is not as expected"
import json, sys
config = json.load(open(sys.argv[1]))
assert config["os"] == "linux" and config["config"]["Entrypoint"] == ["slag-encoder"], config
assert config["config"]["Labels"]["org.opencontainers.image.version"] == sys.argv[2], config
PYTHON
mkdir "$work/layout"
tar -xf "$image" -C "$work/layout"
# By the name that podman load gives it. umoci compares every blob with its digest, and the layers with the
# configuration.
umoci unpack --image "$work/layout:slag-encoder:$version" "$work/bundle" >/dev/null 2>"$work/log" || { cat "$work/log" >&2; fail "umoci does not unpack it"; }
root=$work/bundle/rootfs
mount -t proc proc "$root/proc"
inside() {
    chroot "$root" /usr/bin/env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin ORT_DYLIB_PATH=/usr/lib/slag/libonnxruntime.so HOME=/tmp "$@"
}
[ "$(inside slag-encoder --version)" = "slag-encoder $version" ] || fail "another version answers: $(inside slag-encoder --version)"
# The demo's encode: masks and vectors from the embedded models, so that ONNX Runtime is opened.
"$lab" generate scene --out "$root/tmp/room" --n-views 3 >/dev/null
inside slag-encoder encode --scene /tmp/room/scene.ply --views /tmp/room/transforms.json --metric --device cpu --store /tmp/store --json >"$work/summary"
python3 -c 'import json, sys; s = json.load(open(sys.argv[1])); assert s["generation"] == 1 and s["n_masks"] > 0, s' "$work/summary" ||
    fail "the encode in the image is not as expected"
inside slag-encoder store verify --store /tmp/store >/dev/null
echo "test-image: inspected, unpacked, and encoded a room in $image"
