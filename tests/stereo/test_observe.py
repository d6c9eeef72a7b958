"""What comes after the observer asks nothing but the left view and its disparity."""

from collections.abc import Iterator

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.core.errors import ShapeError
from recon.core.values import Disparity, RectifiedImage
from recon.map.drive.sequence import map_sequence
from recon.sources.source import DerivedSource, StereoSource
from recon.stereo.frame import FrameReconstructor
from recon.stereo.observe import Matching
from recon.stereo.rectify.rectifier import Rectifier
from recon.street.settings import StreetScene
from tests.scenery.film import RIG, film


class Measured(DerivedSource):
    """A drive of which the disparities are delivered that its pairs are matched to."""

    def __init__(self, source: StereoSource, matcher: FrameReconstructor) -> None:
        super().__init__(source)
        self.stereo, self.matcher = False, matcher

    def __len__(self) -> int:
        return len(self.source)

    def frames(self, start: int = 0) -> Iterator[RectifiedImage]:
        for pair, disparity in map(self.matcher.match, self.source.frames(start)):
            colours, when = pair.left_rgb, (pair.timestamp_s, pair.index)
            yield RectifiedImage(pair.left, disparity, pair.camera, colours, pair.valid, *when)


@pytest.fixture(scope="module")
def drive():
    return film(StreetScene(frames=6, threads=1, **RIG))


def test_a_map_of_disparities_that_were_delivered_is_that_of_the_pairs(drive):
    config = load_config(None, ["cloud.remove_flying_edges=false"])
    matched = map_sequence(drive, config)
    measured = Measured(drive, FrameReconstructor(drive.calibration, config))
    delivered = map_sequence(measured, config)
    poses = [one.trajectory.T_world_camera for one in (matched, delivered)]
    assert matched.trusted.all()
    np.testing.assert_array_equal(*poses)
    assert len(matched.cloud) > 1000
    for name in ("xyz", "rgb", "sigma_m", "confidence"):
        np.testing.assert_array_equal(*(getattr(m.cloud, name) for m in (matched, delivered)))
    np.testing.assert_array_equal(matched.voxels.log_odds, delivered.voxels.log_odds)


@pytest.mark.parametrize("again", [None, "sgm"])
def test_keyframes_have_a_matcher_of_their_own_if_one_is_set(drive, again):
    config = load_config(None, {"matching.keyframe_matcher": again})
    reconstructor = FrameReconstructor(drive.calibration, config)
    assert reconstructor.matches_keyframes == (again is not None)
    rectifier = Rectifier(drive.calibration, config.rectification)
    efforts = {"match", "match_roughly"} | ({"match_keyframes"} if again else set())
    assert set(Matching(rectifier, config.matching, 1).matchers) == efforts


def test_an_image_has_no_right_view(drive):
    matcher = FrameReconstructor(drive.calibration, load_config())
    view = next(Measured(drive, matcher).frames())
    ((grey, shown),) = view.views
    np.testing.assert_array_equal(grey, view.left)
    np.testing.assert_array_equal(shown, view.colours)
    with pytest.raises(ShapeError, match="no right image"):
        Rectifier(drive.calibration).rectify(view)


def test_a_disparity_of_another_size_is_refused(drive):
    view = next(drive.frames())
    grey = np.ascontiguousarray(view.left[:, :, 0])
    other = Disparity.from_values(np.ones((4, 5)))
    with pytest.raises(ShapeError, match="differ in size"):
        RectifiedImage(grey, other, drive.calibration)
