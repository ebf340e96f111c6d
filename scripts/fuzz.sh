#!/bin/sh
# Fuzzes every decoder guided by coverage: fuzz.sh [SECONDS [TARGET...]]
#
# Needs the stable compiler and a C++ compiler, no more. Each target runs SECONDS (600) on a core, as many
# targets at once as there are cores, from its seeds and from fuzz/corpus/TARGET. That folder then has the
# smallest set of inputs with the same coverage, but for the seeds, and for inputs beyond MAX_BYTES and
# MAX_FILES. Prints a line a target; crashing inputs lie in target/fuzz/crashes, and end with a failure.
set -eu
cd "$(dirname "$0")/.."
MAX_INPUT_BYTES=100000
MAX_BYTES=65536 # of a target's corpus
MAX_FILES=200
out=$PWD/target/fuzz
host=$(rustc -vV | sed -n 's/^host: //p')
fuzz=$out/build/$host/release/fuzz

one() { # SECONDS TARGET
    export SLAG_FUZZ_TARGET=$2
    found=$out/found/$2 corpus=fuzz/corpus/$2 log=$out/logs/$2 result=fine
    rm -rf "$found" && mkdir -p "$found" "$corpus"
    # The service closes connections; libFuzzer's program would die of that, as no program of Rust does.
    trap '' PIPE
    options="-max_len=$MAX_INPUT_BYTES -timeout=30 -rss_limit_mb=2048 -artifact_prefix=$out/crashes/$2-"
    "$fuzz" $options -max_total_time="$1" -print_final_stats=1 "$found" "$out/seeds/$2" "$corpus" >"$log" 2>&1 || result=CRASHED
    # The merged corpus: what adds coverage to the seeds, the smallest inputs first.
    rm -rf "$found.merged" && mkdir "$found.merged"
    "$fuzz" $options -merge=1 "$found.merged" "$out/seeds/$2" "$found" "$corpus" >"$log.merge" 2>&1 || result="$result, not merged"
    rm -rf "$corpus" && mkdir "$corpus"
    total=0 n=0
    for file in $(ls -Sr "$found.merged"); do
        [ -s "$found.merged/$file" ] || continue
        [ -z "$(find "$out/seeds/$2" -type f -exec cmp -s {} "$found.merged/$file" \; -print -quit)" ] || continue
        total=$((total + $(wc -c <"$found.merged/$file"))) n=$((n + 1))
        [ $total -le $MAX_BYTES ] && [ $n -le $MAX_FILES ] || break
        cp "$found.merged/$file" "$corpus/"
    done
    rmdir "$corpus" 2>/dev/null || true
    count() {
        sed -n "s/$1/\\1/p" "$log" | tail -n 1
    }
    first=$(count '.*INITED cov: \([0-9]*\) .*') last=$(count '.* cov: \([0-9]*\) .*') n=$(count '^stat::number_of_executed_units: *\(.*\)')
    echo "$2: $result, ${n:-?} executions in $1 s, ${first:-?} -> ${last:-?} edges, $(ls "$corpus" 2>/dev/null | wc -l) inputs kept"
    [ "$result" = fine ]
}
if [ "${1:-}" = --one ]; then
    one "$2" "$3"
    exit
fi

seconds=${1:-600}
[ $# -eq 0 ] || shift
cp Cargo.lock fuzz/Cargo.lock # the versions of the workspace
# The flags of cargo-fuzz, without a sanitizer: programs here have checks of their own. --target keeps them from
# build scripts.
RUSTFLAGS="-Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 -Cllvm-args=-sanitizer-coverage-inline-8bit-counters \
-Cllvm-args=-sanitizer-coverage-pc-table -Cllvm-args=-sanitizer-coverage-trace-compares" \
    cargo build --release --manifest-path fuzz/Cargo.toml --target "$host" --target-dir "$out/build"
rm -rf "$out/seeds"
SLAG_FUZZ_SEEDS=$out/seeds "$fuzz" >/dev/null 2>&1
mkdir -p "$out/crashes" "$out/logs"
[ $# -gt 0 ] || set -- $(ls "$out/seeds")
printf '%s\n' "$@" | xargs -P "$(nproc)" -n 1 sh scripts/fuzz.sh --one "$seconds"
