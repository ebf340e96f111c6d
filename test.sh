#!/bin/sh
# Sets everything up, runs the tests, and sums up: how many passed, failed and did not run, and why; and which were slow.
# usage: test.sh [flags of `cargo test`]
set -eu
cd "$(dirname "$0")"
sh scripts/setup.sh
# So that the programs need not be built again for the page's own tests; the Rust tests do without it.
sh scripts/build-page.sh --if-possible
# Mesa's Vulkan layer for the choice of a device asks libwayland, which prints an error on machines without a desktop.
export NODEVICE_SELECT=1

# All programs are built before the tests, which need not build them again.
export SLAG_PROGRAMS_ARE_BUILT=1

target=${CARGO_TARGET_DIR:-target}
log=$target/test-output.txt
mkdir -p "$target"
# .ci/nightly sets this variable, and then no test is left to it.
features=${SLAG_NIGHTLY:+--features=slag-tests/nightly}
started=$(date +%s)
cargo test --workspace --locked $features --no-run "$@"
cargo build --workspace --locked $features --bins
echo "built in $(($(date +%s) - started)) s"
runner=CARGO_TARGET_$(rustc -vV | sed -n 's/^host: //p' | tr 'a-z-' 'A-Z_')_RUNNER
export "$runner=$PWD/scripts/timed-test.sh"
# A pipeline returns the exit code of its last command, so cargo's goes through a file.
{
    code=0
    cargo test --workspace --locked $features --no-fail-fast "$@" 2>&1 || code=$?
    echo "$code" >"$log.code"
} | tee "$log"

# test the_name ... ok <1.234s>
sed -n 's/^test \(.*\) \.\.\. [a-zA-Z]* <\([0-9.]*\)s>$/\2 \1/p' "$log" | sort -rn >"$target/test-times.txt"
printf '\nslowest tests, in seconds:\n'
head -n 20 "$target/test-times.txt"
awk '
    # test result: ok. 12 passed; 0 failed; 1 ignored; ...
    /^test result: / { passed += $4; failed += $6; ignored += $8 }
    # test the_name ... ignored, the reason
    /^test .* \.\.\. ignored/ {
        reason = $0
        if (!sub(/^.* \.\.\. ignored, /, "", reason)) reason = "no reason given"
        reasons[reason]++
    }
    /^test .* \.\.\. FAILED/ { failures = failures "\n  failed: " $2 }
    END {
        printf "\n%d did not run", ignored
        for (reason in reasons) printf "\n  %d not run: %s", reasons[reason], reason
        print failures
        printf "%d passed, %d failed\n", passed, failed
    }
' "$log"
exit "$(cat "$log.code")"
