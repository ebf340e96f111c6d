#!/bin/sh
# Fills the paper's table of query times on this machine, an Orin or any other: OUT/robot.md and OUT/robot.json
# bear its name.
#
#     jetson/bench.sh OUT [FLAGS OF slag-lab bench robot]
#
# The first run builds the programs and the other engine with cargo, which takes an hour on an Orin. Graphs of
# more than a million vectors take hours more: --engines compact,balanced,dense,qdrant-scan,qdrant-hnsw=1000000
# leaves them out.
set -eu
cd "$(dirname "$0")/.."
if [ $# -lt 1 ]; then
    echo "usage: jetson/bench.sh OUT [--gaussians N,...] [--engines NAME[=MOST],...] [--models DIR]" >&2
    exit 2
fi
out=$1
shift
cargo build --release --locked --bin slag-encoder --bin slag-lab --bin slag-edge
# Beside the project's own builds, so that neither makes the other build again.
cargo build --release --locked --manifest-path edge/benches/rivals/Cargo.toml --target-dir target/rivals
exec target/release/slag-lab bench robot --out "$out" --rivals target/rivals/release/slag-bench-rivals "$@"
