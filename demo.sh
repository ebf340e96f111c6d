#!/bin/sh
# Sets everything up, builds, and shows the whole system at work on a house and yard that it generates.
# usage: demo.sh [flags of `slag-lab demo`]
# The page at /view is part of it where Node.js is here or can be downloaded. The build leaves out evaluation
# and benchmarks, the GPU rasteriser, Qdrant and Arrow, which the demo does not use: `cargo build --release` has
# them.
set -eu
cd "$(dirname "$0")"
sh scripts/setup.sh demo
sh scripts/build-page.sh --if-possible
cargo build --locked --profile quick --no-default-features --features slag-encoder/view,slag-edge/view -p slag-lab -p slag-encoder -p slag-edge --bins
exec "${CARGO_TARGET_DIR:-target}/quick/slag-lab" demo "$@"
