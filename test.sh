#!/bin/sh
# Sets everything up and runs the tests.
# usage: test.sh [flags of `cargo test`]
set -eu
cd "$(dirname "$0")"
sh scripts/setup.sh
cargo test --workspace --locked "$@"
