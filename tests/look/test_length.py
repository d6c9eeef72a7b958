"""The baseline follows from lengths that were measured, as far as they are known better."""

from dataclasses import replace

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.core.errors import RegistrationError, SettingsError
from recon.core.values import Trajectory
from recon.look.length import check_length, see_baseline
from recon.look.rig import RefinedRig
from recon.odometry.prior import MotionPrior
from recon.odometry.settings import PriorSettings, RigSettings
from recon.sources.live import LiveSource
from recon.stereo.rectify.epipolar import as_raw
from recon.street.settings import StreetScene
from tests.scenery.film import Film, film

CONFIG = load_config()
FRAMES = 24
TYRES = 1.004  # wheels that are worn see a longer path
SIZE = {"width_px": 400, "height_px": 136, "focal_px": 225.0, "smooth_edges": False}


@pytest.fixture(scope="module")
def street():
    return film(StreetScene(frames=FRAMES, seed=3, **SIZE))


def measured(street, how: str):
    path = street.trajectory
    if how == "tape":
        ends_m = path.positions_m[[0, FRAMES - 1]]
        return (0, FRAMES - 1, float(np.linalg.norm(ends_m[1] - ends_m[0])))
    poses = path.T_world_camera.copy()
    poses[:, :3, 3] *= TYRES
    settings = PriorSettings(sigma_m=0.01, sigma_ratio=0.004 if how == "wheels" else 0.03)
    return MotionPrior(Trajectory(poses, path.timestamps_s), settings)


@pytest.mark.parametrize("how", ["tape", "wheels"])
@pytest.mark.parametrize("wider", [0.95, 1.0, 1.03])
def test_measured_lengths_show_the_baseline(street, wider, how):
    camera = street.calibration
    given = replace(camera, baseline_m=wider * camera.baseline_m)
    seen = see_baseline(street.with_calibration(given), CONFIG, measured(street, how), 0.0)
    assert seen.longer == pytest.approx(1.0 / wider - 1.0, abs=3.0 * seen.longer_sigma)
    assert seen.longer_sigma < 0.01
    kept = RefinedRig(given, given, given)
    used, only_said = (kept.with_baseline(seen, RigSettings(refine=on)) for on in (True, False))
    assert only_said.calibration is given
    assert used.calibration.baseline_m == pytest.approx(camera.baseline_m, rel=3.0 * seen.sigma)
    assert used.refined == bool(used.warnings()) == bool(only_said.warnings()) == bool(seen.ratio)
    assert bool(seen.ratio) or wider == 1.0
    assert used.figures().to_json()["baseline"]["percent"] == pytest.approx(100.0 * seen.ratio)
    raw = seen.applied(as_raw(given))
    assert raw.T_right_left[0, 3] == pytest.approx(-given.baseline_m * (1.0 + seen.ratio))


def test_wheels_that_are_known_no_better_than_a_baseline_do_not_show_it(street):
    assert see_baseline(street, CONFIG, measured(street, "unknown wheels")) is None
    gap = MotionPrior(
        Trajectory(np.stack(2 * [np.eye(4)]), np.array([50.0, 51.0])), PriorSettings(sigma_ratio=0)
    )
    assert see_baseline(street, CONFIG, gap) is None


def test_lengths_that_show_nothing_are_refused(street):
    for source, known in (
        (street, (0, FRAMES, 9.0)), (street, (5, 5, 9.0)), (LiveSource(street), (0, 5, 9.0)),
    ):  # fmt: skip
        with pytest.raises(SettingsError, match=r"source\.length"):
            check_length(source, known)
    still = Film(4 * street.pairs[:1], street.calibration, np.stack(4 * [np.eye(4)]))
    with pytest.raises(RegistrationError, match=r"source\.length"):
        see_baseline(still, CONFIG, (0, 3, 9.0))
