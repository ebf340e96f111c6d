#!/bin/sh
# Sets everything up, builds, and shows the whole system at work on a house and yard that it generates.
# usage: demo.sh [flags of `slag-lab demo`]
# The build leaves out evaluation and benchmarks, the GPU rasteriser, Qdrant and Arrow, which the demo does not use: `cargo build --release` has them.
set -eu
cd "$(dirname "$0")"
sh scripts/setup.sh demo
cargo build --locked --profile quick --no-default-features -p slag-lab -p slag-encoder -p slag-edge --bins
exec "${CARGO_TARGET_DIR:-target}/quick/slag-lab" demo "$@"
