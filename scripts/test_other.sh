#!/usr/bin/env bash
# Run the tests marked `portable` on another Python than that of .venv.
#
#   scripts/test_other.sh 3.12                   the first python3.12 on the path, or of pyenv
#   scripts/test_other.sh /path/to/python3.12    this one
#
# Where there is no such Python, one line says so, and that is no failure.
set -euo pipefail
cd "$(dirname "$0")/.."

say() { printf 'test-other: %s\n' "$*"; }

find_python() {
    local candidate
    for candidate in "$1" "python$1" "${PYENV_ROOT:-$HOME/.pyenv}/versions/$1"*/bin/python; do
        if candidate=$(command -v "$candidate" 2>/dev/null) && "$candidate" -c 'import venv, ensurepip' 2>/dev/null; then
            echo "$candidate"
            return
        fi
    done
}

version_of() { "$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])'; }

python=$(find_python "$1")
if [[ -z $python ]]; then
    say "skipped: there is no Python $1 here; name one with PYTHON=/path/to/python"
    exit
fi
version=$(version_of "$python")
if [[ -x .venv/bin/python && $version == "$(version_of .venv/bin/python)" ]]; then
    say "skipped: $version is the Python of .venv, which make test uses"
    exit
fi

other=.venv-$version
if [[ ! $other/.ready -nt constraints.lock ]]; then
    say "installing recon and what these tests need into $other"
    "$python" -m venv --clear "$other"
    # Neither extras nor what other tests need: it is not asked for by these.
    "$other/bin/python" -m pip install --quiet --disable-pip-version-check -c constraints.txt \
        -e . pytest pytest-timeout hypothesis
    touch "$other/.ready"
fi
say "Python $version"
# Only the files that have such tests are read: others import what is not installed.
mapfile -t files < <(grep -rl 'mark\.portable' tests --include='test_*.py')
"$other/bin/python" -m pytest -q -m portable "${files[@]}"
