#!/bin/sh
# Tests the built page in Chromium, without a GPU.
# usage: test-page.sh      after `scripts/setup.sh page` and `scripts/build-page.sh`
set -eu
cd "$(dirname "$0")/.."
timeout 180 node --test --test-timeout=60000 tests/page/page.test.mjs
