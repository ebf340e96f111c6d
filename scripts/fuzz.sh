#!/bin/sh
# Fuzzes every decoder guided by coverage: fuzz.sh [SECONDS [TARGET...]]
#
# Needs the stable compiler and a C++ compiler, no more. Each target runs SECONDS (600) on one core, from its seeds and from
# fuzz/corpus/TARGET, which afterwards has the smallest set of inputs with the same coverage, but for the seeds and for inputs beyond
# MAX_BYTES. Prints a line a target; crashing inputs lie in target/fuzz/crashes, and end with exit code 1.
set -eu
cd "$(dirname "$0")/.."
seconds=${1:-600}
[ $# -eq 0 ] || shift
MAX_BYTES=8192 # longest input, and most bytes of a target's corpus
out=$PWD/target/fuzz
host=$(rustc -vV | sed -n 's/^host: //p')

cp Cargo.lock fuzz/Cargo.lock # the versions of the workspace
# The flags of cargo-fuzz, without a sanitizer: programs here have checks of their own. --target keeps them from build scripts.
RUSTFLAGS="-Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 -Cllvm-args=-sanitizer-coverage-inline-8bit-counters \
-Cllvm-args=-sanitizer-coverage-pc-table -Cllvm-args=-sanitizer-coverage-trace-compares" \
    cargo build --release --manifest-path fuzz/Cargo.toml --target "$host" --target-dir "$out/build"
fuzz=$out/build/$host/release/fuzz
SLAG_FUZZ_SEEDS=$out/seeds "$fuzz" >/dev/null 2>&1
[ $# -gt 0 ] || set -- $(ls "$out/seeds")

status=0
mkdir -p "$out/crashes" "$out/logs"
for target; do
    export SLAG_FUZZ_TARGET=$target
    found=$out/found/$target corpus=fuzz/corpus/$target log=$out/logs/$target
    rm -rf "$found" && mkdir -p "$found" "$corpus"
    options="-max_len=$MAX_BYTES -timeout=20 -rss_limit_mb=2048 -malloc_limit_mb=256 -artifact_prefix=$out/crashes/$target-"
    if "$fuzz" $options -max_total_time="$seconds" -print_final_stats=1 "$found" "$out/seeds/$target" "$corpus" >"$log" 2>&1; then
        result=fine
    else
        result=CRASHED status=1
    fi
    # The merged corpus: what adds coverage to the seeds, the smallest inputs first.
    rm -rf "$found.merged" && mkdir "$found.merged"
    "$fuzz" $options -merge=1 "$found.merged" "$out/seeds/$target" "$found" "$corpus" >"$log.merge" 2>&1 || result="$result, not merged"
    rm -rf "$corpus" && mkdir "$corpus"
    total=0
    for file in $(ls -Sr "$found.merged"); do
        cmp -s "$found.merged/$file" /dev/null && continue
        total=$((total + $(wc -c <"$found.merged/$file")))
        [ $total -gt $MAX_BYTES ] && break
        [ -n "$(find "$out/seeds/$target" -type f -exec cmp -s {} "$found.merged/$file" \; -print -quit)" ] ||
            cp "$found.merged/$file" "$corpus/"
    done
    rmdir "$corpus" 2>/dev/null || true
    executions=$(sed -n 's/^stat::number_of_executed_units: *//p' "$log")
    coverage=$(sed -n 's/.* cov: \([0-9]*\) .*/\1/p' "$log" | tail -1)
    echo "$target: $result, ${executions:-?} executions in $seconds s, ${coverage:-?} edges, $(ls "$corpus" 2>/dev/null | wc -l) inputs kept"
done
exit $status
