#!/usr/bin/env bash
# Write constraints.lock: the versions of constraints.txt for Python 3.10 to 3.13, with the hashes of
# their files, of what the package and each of its extras need. Where to get them is not written.
set -euo pipefail
cd "$(dirname "$0")/.."

PATH=$PWD/.venv/bin:$PATH
LOCK=$(mktemp)
readonly LOCK
trap 'rm -f "$LOCK"' EXIT
{
    echo "# Written by \`make lock\` from constraints.txt and pyproject.toml."
    uv pip compile --quiet --universal --python-version 3.10 --all-extras --constraint constraints.txt \
        --generate-hashes --no-header --no-annotate --no-emit-index-url \
        pyproject.toml - <<<uv
} >"$LOCK"
cp "$LOCK" constraints.lock
