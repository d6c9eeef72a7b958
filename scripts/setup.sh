#!/usr/bin/env bash
# Prepare this folder: system packages, .venv, the package with the versions of constraints.txt.
#
#   scripts/setup.sh        what commands run
#   scripts/setup.sh dev    what tests run, too
#
# uv installs, where it is there or pip gets it, and checks the hashes of constraints.lock; else pip.
# Safe to repeat: what is there already is left alone, and apt is called only for what is missing.
# PYTHON=/path/to/python3 chooses the interpreter; UV=no leaves all to pip, whose settings uv ignores.
set -euo pipefail
cd "$(dirname "$0")/.."

# Shared libraries that the wheels load but do not bring, and the packages that hold them.
readonly LIBRARIES=(
    libGL.so.1:libgl1           # open3d, pymeshlab
    libEGL.so.1:libegl1         # open3d
    libX11.so.6:libx11-6        # open3d
    libusb-1.0.so.0:libusb-1.0-0 # open3d
    libOpenGL.so.0:libopengl0   # pymeshlab's reader and writer of PLY
)
readonly HEAVY="cv2, kiss_icp, numba, open3d, pymeshlab${1:+, pyoctomap}"

say() { printf 'setup: %s\n' "$*"; }
fail() { printf 'setup: %s\n' "$*" >&2; exit 1; }

is_supported() {
    "$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null
}

find_python() {
    local name
    for name in ${PYTHON:-python3 python3.13 python3.12 python3.11 python3.10}; do
        if is_supported "$name"; then
            command -v "$name"
            return
        fi
    done
}

missing_packages() {
    local entry libraries python
    libraries=$(PATH="$PATH:/sbin:/usr/sbin" ldconfig -p 2>/dev/null || true)
    for entry in "${LIBRARIES[@]}"; do
        [[ $libraries == *"${entry%%:*} "* ]] || echo "${entry##*:}"
    done
    python=$(find_python)
    if [[ -z $python ]]; then
        [[ -n ${PYTHON:-} ]] || printf '%s\n' python3 python3-venv
    elif ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        "$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])'
    fi
}

install_packages() {
    local become=()
    if ((EUID != 0)); then
        become=(sudo)
        [[ -t 0 ]] || become+=(-n) # nobody is there to type a password
    fi
    local apt=("${become[@]}" env DEBIAN_FRONTEND=noninteractive DEBCONF_NOWARNINGS=yes apt-get -qq
        -o DPkg::Lock::Timeout=300 -o Dpkg::Use-Pty=0)
    command -v apt-get >/dev/null && command -v "${become[0]:-env}" >/dev/null || return 1
    say "installing with apt: $*"
    "${apt[@]}" update || true # one broken source of many may not matter
    "${apt[@]}" install -y --no-install-recommends "$@" >/dev/null
}

ensure_system() {
    local missing
    missing=($(missing_packages)) # no package has a space in its name
    if ((${#missing[@]})); then
        install_packages "${missing[@]}" ||
            fail "system packages are missing; run as root: apt-get install -y ${missing[*]}"
    fi
    [[ -n $(find_python) ]] ||
        fail "no Python 3.10 to 3.13 found${PYTHON:+ as $PYTHON}; install one and name it with PYTHON=…"
}

ensure_venv() {
    if is_supported .venv/bin/python && .venv/bin/python -m pip --version >/dev/null 2>&1; then
        return
    fi
    say "creating .venv with $(find_python)"
    "$(find_python)" -m venv --clear .venv
}

# The uv of the machine, else that of the lock, in .venv; nothing where it cannot be had.
find_uv() {
    [[ ${UV:-} != no ]] || return 0
    command -v uv && return
    if [[ ! -x .venv/bin/uv ]]; then
        sed -n '/^uv==/,/[^\\]$/p' constraints.lock >.venv/uv.txt
        pip install --require-hashes -r .venv/uv.txt >&2 || return 0
    fi
    echo "$PWD/.venv/bin/uv"
}

pip() { .venv/bin/python -m pip --quiet --disable-pip-version-check "$@"; }

# Install recon with the extras given, and tell every few seconds that it goes on.
ensure_package() {
    local uv begun=$SECONDS package=".${1:+[$1]}"
    # An earlier checkout installed itself by a name that is another project's.
    pip uninstall --yes recon 2>/dev/null || true
    uv=$(find_uv)
    if [[ -n $uv ]]; then
        say "installing recon and its libraries into .venv with uv (${1:+with all that tests need, }about 2 GB)"
        "$uv" pip install --python .venv/bin/python -c constraints.lock -e "$package"
    else
        say "uv cannot be had: pip takes some minutes, and does not check the hashes of constraints.lock"
        pip install -c constraints.txt -e "$package"
    fi || fail "the libraries could not be installed, as said above; what is there stays: run it again${uv:+, with UV=no where only pip knows the way}"
    say "installed in $((SECONDS - begun)) s"
    .venv/bin/python -W ignore -c "import $HEAVY" ||
        fail "the libraries are installed but one cannot be loaded; the line above names it"
}

ensure_system
ensure_venv
ensure_package "$@"
