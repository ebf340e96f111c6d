#!/bin/sh
# Builds the page from common/view/web into common/view/dist, which the programs embed, and states its size.
# usage: build-page.sh [--if-possible]
# Needs Node.js 18 or newer and npm (`scripts/setup.sh page` installs them). With --if-possible a machine without them is told, and
# a page that is newer than its source stays as it is: the programs work without the page.
set -eu
cd "$(dirname "$0")/../common/view/web"

if [ "${1:-}" = --if-possible ]; then
    [ -f ../dist/index.html ] && [ -z "$(find . -path ./node_modules -prune -o -type f -newer ../dist/index.html -print)" ] && exit 0
    if ! command -v npm >/dev/null 2>&1 || ! node -e 'process.exit(process.versions.node.split(".")[0] >= 18 ? 0 : 1)'; then
        echo "page: left out, because Node.js 18 and npm are not here; \`scripts/setup.sh page && scripts/build-page.sh\` brings it" >&2
        exit 0
    fi
    cd - >/dev/null
    sh "$0" || echo "page: left out, because it does not build here" >&2
    exit 0
fi

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
