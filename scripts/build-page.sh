#!/bin/sh
# Builds the page from common/view/web into common/view/dist, which the programs embed, and states its size.
# usage: build-page.sh [--if-possible]
# Node.js comes from scripts/get-node.sh. With --if-possible a page that is newer than its source stays as it
# is, and where it does not build (no network), a line says so: the programs work without it.
set -eu
cd "$(dirname "$0")/../common/view/web"

if [ "${1:-}" = --if-possible ]; then
    [ -f ../dist/index.html ] && [ -z "$(find . -path ./node_modules -prune -o -type f -newer ../dist/index.html -print)" ] && exit 0
    cd - >/dev/null
    sh "$0" || echo "page: left out, because it does not build here" >&2
    exit 0
fi

node=$(sh ../../../scripts/get-node.sh)
PATH=$node:$PATH
export PATH
npm ci --no-fund --no-audit --ignore-scripts >&2
npm run --silent build >&2

max_bytes=1600000
bytes=$(find ../dist -type f -exec gzip -9nc {} + | wc -c)
echo "page: $bytes bytes compressed, at most $max_bytes"
[ "$bytes" -le "$max_bytes" ] || {
    echo "build-page: the page is too large; see what the last change added" >&2
    exit 1
}
# Cargo embeds the page anew: it does not watch a folder that may be missing.
touch ../build.rs
