#!/bin/sh
# Sets everything up, runs the tests, and sums up: how many passed, failed and did not run, and why.
# usage: test.sh [flags of `cargo test`]
set -eu
cd "$(dirname "$0")"
sh scripts/setup.sh
# So that the programs need not be built again for the page's own tests; the Rust tests do without it.
sh scripts/build-page.sh --if-possible
# Mesa's Vulkan layer for the choice of a device asks libwayland, which prints an error on machines without a desktop.
export NODEVICE_SELECT=1

# Cargo builds the programs of the whole workspace before its tests; these need not build them again.
export SLAG_PROGRAMS_ARE_BUILT=1

log=${CARGO_TARGET_DIR:-target}/test-output.txt
mkdir -p "${log%/*}"
# A pipeline returns the exit code of its last command, so cargo's goes through a file.
{
    code=0
    cargo test --workspace --locked "$@" 2>&1 || code=$?
    echo "$code" >"$log.code"
} | tee "$log"

awk '
    # test result: ok. 12 passed; 0 failed; 1 ignored; ...
    /^test result: / { passed += $4; failed += $6; ignored += $8 }
    # test the_name ... ignored, the reason
    /^test .* \.\.\. ignored/ {
        reason = $0
        if (!sub(/^.* \.\.\. ignored, /, "", reason)) reason = "no reason given"
        reasons[reason]++
    }
    /^test .* \.\.\. FAILED$/ { failures = failures "\n  failed: " $2 }
    END {
        printf "\n%d tests passed, %d failed, %d did not run", passed, failed, ignored
        for (reason in reasons) printf "\n  %d not run: %s", reasons[reason], reason
        print failures
    }
' "$log"
exit "$(cat "$log.code")"
