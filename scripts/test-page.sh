#!/bin/sh
# Tests the page in Chromium, without a GPU: over a small known scene with faults, and in the real programs over
# a generated room.
# usage: test-page.sh      after `scripts/setup.sh page` and `scripts/build-page.sh`; builds the programs that embed the page
set -eu
cd "$(dirname "$0")/.."
cargo build --workspace --bins --locked
PATH=$(sh scripts/get-node.sh):$PATH
export PATH
export SLAG_PROGRAMS="${CARGO_TARGET_DIR:-$PWD/target}/debug"
timeout 1200 node --test --test-concurrency=1 --test-timeout=400000 tests/page/*.test.mjs
