#!/bin/sh
# Builds the page from common/view/web into common/view/dist, which the programs embed, and states its size.
# usage: build-page.sh      needs Node.js 18 or newer and npm (`scripts/setup.sh page` installs them)
set -eu
cd "$(dirname "$0")/../common/view/web"
npm ci --no-fund --no-audit --ignore-scripts >&2
npm run --silent build >&2

max_bytes=1600000
bytes=$(find ../dist -type f -exec gzip -9nc {} + | wc -c)
echo "page: $bytes bytes compressed, at most $max_bytes"
[ "$bytes" -le "$max_bytes" ] || {
    echo "build-page: the page is too large; see what the last change added" >&2
    exit 1
}
