"""The name of a calibration file tells its format, in which a refined rig comes back."""

from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import SettingsError
from recon.core.values import RectifiedCamera
from recon.io.cameras.calibration import read_calibration
from recon.look.fault import RigFault, without_fault
from recon.look.rig import compare_rigs
from recon.rig.written import form_of, nearest_of_kalibr, targets_of, write_rig
from recon.stereo.rectify.rectifier import RectificationSettings, turns_of

CAMERA = RectifiedCamera(720.0, 610.0, 180.0, 610.0, 0.54, 1242, 375)
SETTINGS = RectificationSettings()
NAMES = {
    "rig.yaml": "recon", "rig.yml": "opencv", "rig.XML": "opencv", "rig.json": "opencv",
    "opencv.yaml": "opencv", "camchain.yaml": "kalibr", "camchain-2.yml": "kalibr",
    "kalibr_rig.yaml": "kalibr", "camera_info.yaml": "ros", "left.yaml": "ros",
    "rig_right.yml": "ros", "upright.yaml": "recon",
}  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_a_refined_rig_comes_back_from_the_format_that_a_name_asks_for(tmp_path, name):
    # As far off as the lenses of KITTI, with prisms.
    values = RigFault(CAMERA).sigmas * np.random.default_rng(1).normal(size=22) * 0.5
    rig = without_fault(CAMERA, turns_of(CAMERA, SETTINGS), values)
    assert form_of(tmp_path / name) == NAMES[name]
    limit_px, wanted = 1e-6, rig
    if NAMES[name] == "kalibr":
        wanted, limit_px = nearest_of_kalibr(rig)
        assert 0.01 < limit_px < 0.5
    files = write_rig(tmp_path / name, wanted, SETTINGS, quality={"windows": 12})
    assert files == targets_of(tmp_path / name)
    assert sorted(tmp_path.iterdir()) == sorted(files)
    read = read_calibration(files[-1], CAMERA.width_px, CAMERA.height_px)
    assert compare_rigs(rig, read, 10.0, SETTINGS).moved_px < 2.0 * limit_px


@pytest.mark.parametrize("name", ["rig", "rig.txt", "rig.yaml.bak"])
def test_a_name_of_no_format_is_refused_with_those_that_are(name):
    with pytest.raises(SettingsError, match=r"tells its format.*camchain\.yaml kalibr's"):
        form_of(Path(name))
