#!/bin/sh
# Sets everything up, builds, and shows the whole system at work on a room that it generates itself.
# usage: demo.sh [flags of `slag-lab demo`]
set -eu
cd "$(dirname "$0")"
sh scripts/setup.sh
cargo build --release --locked --bin slag-encoder --bin slag-lab --bin slag-edge
exec target/release/slag-lab demo "$@"
