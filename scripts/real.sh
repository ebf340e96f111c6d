#!/bin/sh
# Measures SLAG on the real data sets and prints tables beside the paper's rows.
# usage: real.sh MODELS LERF SCANNET     for owners of the data; nothing in CI runs it
#
#   MODELS   image and text encoder and segmenter: NAME[,SEGMENTER] from `models list`, e.g. openclip-vit-b-32-laion2b,sam2.1-tiny
#   LERF     lerf_ovs: NAME/{images,sparse/0,point_cloud.ply} for each scene, label/NAME/frame_*.json; or -
#   SCANNET  scans/NAME as published, and NAME/{images,transforms.json,point_cloud.ply} for each; or -
#
# Rules of the comparison: a scene's threshold is the paper's 0.28, or one that other scenes chose, never the
# scene's own labels; frames are matched with cameras by name; every labelled word is reported. Environment: OUT
# (default real-results), PRESET (default paper), ACCEPT_LICENCE (a licence that restricts use), THRESHOLDS,
# DEVICE and PROVIDER. Encodes that are done already are not repeated.
set -eu
[ $# -eq 3 ] || { sed -n 2,12p "$0" >&2; exit 2; }
models=${1%%,*}
segmenter=${1#*,}
[ "$segmenter" != "$1" ] || segmenter=
lerf=$2
scannet=$3
out=${OUT:-real-results}
preset=${PRESET:-paper}
thresholds=${THRESHOLDS:-0.28}
encoder=${SLAG_ENCODER:-slag-encoder}
lab=${SLAG_LAB:-slag-lab}
mkdir -p "$out"

say() {
    echo "real: $*" >&2
}

# Exit status 3 means: done, with some inputs left out; the reports name them.
done_or_partly() {
    "$@" || [ $? -eq 3 ]
}

for name in "$models" $segmenter; do
    if [ -e "$name/model.toml" ]; then continue; fi
    say "pulling $name"
    "$encoder" models pull "$name" ${ACCEPT_LICENCE:+--accept-licence "$ACCEPT_LICENCE"}
done

# encode SCENE.ply VIEWS IMAGES STORE
encode() {
    if [ -e "$4.done" ]; then return; fi
    say "encoding $4"
    done_or_partly "$encoder" encode --scene "$1" --views "$2" --images "$3" --store "$4" --models "$models" \
        --preset "$preset" ${segmenter:+--segmenter "$segmenter"} ${DEVICE:+--device "$DEVICE"} \
        ${PROVIDER:+--provider "$PROVIDER"}
    touch "$4.done"
}

if [ "$lerf" != - ]; then
    for label in "$lerf"/label/*/; do
        scene=$(basename "$label")
        data=$lerf/$scene
        encode "$data/point_cloud.ply" "$data/sparse/0" "$data/images" "$out/stores/lerf-$scene"
        done_or_partly "$lab" eval lerf --store "$out/stores/lerf-$scene" --scene "$data/point_cloud.ply" \
            --views "$data/sparse/0" --labels "$label" --models "$models" --threshold "$thresholds" |
            tee "$out/lerf-$scene.md"
    done
fi
if [ "$scannet" != - ]; then
    # Names of scans have no spaces; paths may.
    set --
    for scan in "$scannet"/scans/*/; do
        scene=$(basename "$scan")
        data=$scannet/$scene
        encode "$data/point_cloud.ply" "$data/transforms.json" "$data/images" "$out/stores/$scene"
        set -- "$@" --store "$out/stores/$scene" --scene "$data/point_cloud.ply" --scan "$scan"
    done
    done_or_partly "$lab" eval scannet --segments --models "$models" "$@" | tee "$out/scannet.md"
fi
