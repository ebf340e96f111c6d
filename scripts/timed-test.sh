#!/bin/sh
# Runs a test program so that it prints the time of each test. Cargo calls it for `./test.sh`, as its runner.
# Stable compilers keep that flag of their test library behind this variable.
program=$1
shift
RUSTC_BOOTSTRAP=1 exec "$program" -Zunstable-options --report-time "$@"
