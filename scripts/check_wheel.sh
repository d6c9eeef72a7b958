#!/usr/bin/env bash
# Install the package as a user does, in a fresh environment, and run it in another folder.
#
# Neither the checkout nor what the extra `dev` brings is there: what is used has to be declared.
#   scripts/check_wheel.sh              with .venv's Python, without extras
#   scripts/check_wheel.sh PYTHON…      with each of these, without extras and with each extra alone
set -euo pipefail
cd "$(dirname "$0")/.."
unset PYTHONPATH NUMBA_CACHE_DIR

readonly CHECKOUT=$PWD SMALL=(street.frames=6 street.width_px=192 street.height_px=96 street.focal_px=120)
FOLDER=$(mktemp -d)
readonly FOLDER
trap 'rm -rf "$FOLDER"' EXIT
LOG=$FOLDER/log

say() { printf 'check_wheel: %s\n' "$*"; }

# Run a command whose output matters only if it fails.
quietly() {
    "$@" >"$LOG" 2>&1 && return
    cat "$LOG" >&2
    say "failed: $*" >&2
    return 1
}

# What the commands read: a pair, the true path of the demo, its positions in a survey, a bag, a network.
write_input() {
    .venv/bin/python - "$FOLDER" "${SMALL[@]}" <<'PYTHON'
import sys
from pathlib import Path

import numpy as np

import recon
from recon.commands.config import load_config
from recon.commands.demo import demo_source
from recon.core.geometry.se3 import apply
from recon.io.images.image import write_image
from recon.io.trajectory import write_kitti_poses
from tests.sources.bags import Recording, write_bag
from tests.sources.drives import rendered
from tests.stereo.match.test_onnx_matcher import write_network

folder, source = Path(sys.argv[1]), demo_source(load_config(None, sys.argv[2:]))
pair = next(iter(source))
for side in ("left", "right"):
    write_image(folder / f"{side}.png", getattr(pair, side))
write_kitti_poses(folder / "truth.txt", source.trajectory)
path = source.trajectory
east_north_up = path.positions_m[:, [0, 2, 1]] * [1, 1, -1] + [4e5, 5e6, 100]
np.savetxt(folder / "gnss.txt", np.column_stack([path.timestamps_s, east_north_up]), fmt="%.6f")
write_bag(*rendered(6, width_px=192, height_px=96, focal_px=120.0), folder, Recording("ros1"))
write_network(folder / "net.onnx", ["left", "right"], [(["left", "right"], "d", "Max")])
PYTHON
}

# An environment of a Python, with the wheel and the tested versions of what it declares.
install() {
    local begun=$SECONDS
    rm -rf "$FOLDER/env"
    "$1" -m venv "$FOLDER/env"
    quietly pip "$FOLDER"/*.whl
    say "$("$FOLDER/env/bin/python" -V): installed in $((SECONDS - begun)) s"
}

pip() {
    "$FOLDER/env/bin/python" -m pip install --quiet --no-compile --disable-pip-version-check \
        -c "$CHECKOUT/constraints.txt" "$@"
}

recon() { (cd "$FOLDER" && "$FOLDER/env/bin/recon" "$@"); }

check_commands() {
    local begun=$SECONDS
    rm -rf "$FOLDER"/{demo,pair,mesh}
    quietly recon doctor
    quietly recon demo --quiet "${SMALL[@]/#/--set=}" --out demo
    quietly recon pair left.png right.png --focal 120 --baseline 0.54 --quiet --out pair
    quietly recon mesh demo/map/cloud.ply --quiet --out mesh
    quietly recon evaluate trajectory demo/trajectory_kitti.txt truth.txt
    say "doctor, demo, pair, mesh, evaluate: run, in $((SECONDS - begun)) s"
}

# A command that needs an extra: refused with what to type, and run once that was typed.
check_extra() {
    local extra=$1 python=$FOLDER/env/bin/python
    shift
    "$python" -m pip freeze --all | sort >"$FOLDER/before"
    if recon "$@" --quiet --out "$extra" >"$LOG" 2>&1 || ! grep -qF "pip install 'recon-stereo[$extra]'" "$LOG"; then
        cat "$LOG" >&2
        say "without the extra $extra this should have failed, and said what to install: $*" >&2
        return 1
    fi
    quietly pip "recon-stereo[$extra]"
    quietly recon "$@" --quiet --out "$extra"
    "$python" -m pip freeze --all | sort | comm -13 "$FOLDER/before" - >"$FOLDER/brought"
    say "extra $extra: runs, with $(wc -l <"$FOLDER/brought") more packages"
    quietly "$python" -m pip uninstall --quiet --yes -r "$FOLDER/brought"
    rm -r "${FOLDER:?}/$extra"
}

check_extras() {
    check_extra cluster export demo --to grid --workers 2
    check_extra onnx pair left.png right.png --focal 120 --baseline 0.54 \
        --matcher onnx --set matching.onnx.model=net.onnx
    check_extra ros map drive.bag --no-mesh
    check_extra survey export demo --to laz --georeference gnss.txt --antenna=0,0,0 --crs EPSG:25832
}

write_input
quietly .venv/bin/python -m pip wheel --quiet --no-deps --wheel-dir "$FOLDER" .
if (($# == 0)); then
    install .venv/bin/python
    check_commands
fi
for python; do
    install "$python"
    check_commands
    check_extras
done
