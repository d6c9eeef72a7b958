"""Odometries that are not ours: objects, and plug-ins that packages register."""

import json
from dataclasses import replace

import numpy as np
import pytest

import recon
from recon.core.errors import RegistrationError, SettingsError
from recon.odometry.registry import ODOMETRIES, ForeignOdometry, make_odometry
from tests.stereo.match.test_foreign_matchers import install_plugin


class Ahead:
    """Half a metre forward in each frame, or whatever it is given for the second one."""

    def __init__(self, second: object = None) -> None:
        self.frames, self.second = 0, second

    def register(self, frame: recon.OdometryFrame) -> recon.OdometryResult:
        T = np.eye(4)
        T[2, 3] = 0.5 * self.frames
        self.frames += 1
        if self.frames == 2 and self.second is not None:
            return self.second  # type: ignore[return-value]
        return recon.OdometryResult(T)

    def state(self) -> dict:
        return {"frames": self.frames}

    def restore(self, state: dict) -> None:
        self.frames = state["frames"]


def test_an_odometry_is_never_given_what_was_inferred():
    values = np.full((4, 6), 9.0, np.float32)
    found = recon.Disparity.from_values(values)
    reason = np.where(np.arange(6) < 2, np.uint8(recon.Reason.VALID), np.uint8(recon.Reason.FILLED))
    both = replace(found, reason=np.tile(reason, (4, 1)))
    grey, camera = np.zeros((4, 6), np.uint8), recon.RectifiedCamera(9.0, 3, 2, 3, 0.5, 6, 4)
    pair = recon.RectifiedPair(grey, grey, camera)
    given = recon.OdometryFrame(pair, both).disparity
    assert np.isfinite(given.values).sum() == 4 * 2
    assert given.measured.sum() == given.valid.sum() == 4 * 2
    assert recon.OdometryFrame(pair, found).disparity is found


def posed(**entries: float) -> recon.OdometryResult:
    T = np.eye(4)
    for place, value in entries.items():
        T[int(place[1]), int(place[2])] = value
    return recon.OdometryResult(T)


@pytest.mark.parametrize(
    ("second", "words"),
    [
        (np.eye(4), r"returns no pose.*ndarray float64 \(4, 4\).*recon\.OdometryResult"),
        ((), "returns no pose.*tuple"),
        (recon.OdometryResult(np.eye(3)), "no rigid pose.*1.0.*4, 4"),
        (recon.OdometryResult(np.zeros((0, 4, 4))), r"no rigid pose.*\[\]"),
        (recon.OdometryResult(None), "no rigid pose"),  # type: ignore[arg-type]
        (recon.OdometryResult("here"), "no rigid pose.*str"),  # type: ignore[arg-type]
        (posed(T03=np.nan), "no rigid pose.*nan"),
        (posed(T03=np.inf), "no rigid pose.*inf"),
        (posed(T00=-1.0), "no rigid pose"),  # a mirror
        (posed(T00=1.01), "no rigid pose.*1.01"),
        (posed(T30=1.0), "no rigid pose"),
        (recon.OdometryResult(np.eye(4), None), "invalid OdometryHealth.*None"),  # type: ignore[arg-type]
        (
            recon.OdometryResult(np.eye(4), recon.OdometryHealth(inliers="many")),  # type: ignore[arg-type]
            "invalid OdometryHealth.*many",
        ),
    ],
)
def test_what_is_no_pose_is_refused_with_odometry_and_frame(second, words, blind):
    odometry = ForeignOdometry(Ahead(second), "mine")
    odometry.register(blind(index=3))
    with pytest.raises(RegistrationError, match=rf"^odometry 'mine', frame 4: .*{words}") as told:
        odometry.register(blind(index=4))
    assert "\n" not in str(told.value)


def test_the_first_pose_is_the_identity_and_rotations_are_made_exact(blind):
    late = Ahead()
    late.frames = 4
    with pytest.raises(RegistrationError, match="first pose is not the identity"):
        ForeignOdometry(late, "late").register(blind())
    odometry = ForeignOdometry(Ahead(posed(T01=1e-7, T10=-1e-7)), "rounded")
    odometry.register(blind())
    R = odometry.register(blind()).T_world_camera[:3, :3]
    assert np.abs(R @ R.T - np.eye(3)).max() < 1e-15


def test_an_error_inside_is_reported_and_kept_as_the_cause(blind):
    class Broken(Ahead):
        def register(self, frame):
            raise ZeroDivisionError("by zero")

        def restore(self, state):
            raise KeyError("frames")

    odometry = make_odometry(Broken())
    with pytest.raises(RegistrationError, match=r"'Broken'.*fails.*ZeroDivisionError: by") as told:
        odometry.register(blind())
    assert isinstance(told.value.__cause__, ZeroDivisionError)
    with pytest.raises(RegistrationError, match=r"'Broken'.*fails.*KeyError"):
        odometry.restore({"odometry": {"own": {}, "begun": True}, "last": None})


@pytest.mark.parametrize(
    "state", [None, [1], {1: 2}, {"a": {3}}, {"a": np.array(["x"])}, {"a": [{"b": object()}]}]
)
def test_a_state_that_the_map_cannot_keep_is_refused(state):
    class Odd(Ahead):
        def state(self):
            return state

    with pytest.raises(RegistrationError, match="'odd': the state of the odometry cannot be store"):
        ForeignOdometry(Odd(), "odd").state()


def test_it_goes_on_from_its_state(blind):
    begun, again = ForeignOdometry(Ahead(), "a"), ForeignOdometry(Ahead(), "a")
    for _ in range(3):
        begun.register(blind())
    again.restore(begun.state())
    assert again.register(blind()).T_world_camera[2, 3] == 1.5


@pytest.mark.parametrize(
    ("given", "words"),
    [(Ahead, r"is a class.*Ahead\(\)"), (7, "not usable as odometry.*int.*register")],
)
def test_what_is_no_odometry_is_refused(given, words):
    with pytest.raises(SettingsError, match=words):
        recon.load_config().with_odometry(given)


AHEAD = """
import numpy as np
from recon import OdometryResult

class Ahead:
    T = np.eye(4)
    def register(self, frame):
        T, self.T = self.T, self.T.copy()
        self.T[2, 3] += 0.4
        return OdometryResult(T)
    def state(self):
        return {"T": self.T}
    def restore(self, state):
        self.T = state["T"]

class Worse(Ahead):
    def register(self, frame):
        return OdometryResult(np.full((4, 4), np.nan))

def nothing():
    return 5

def fails():
    raise RuntimeError("no model here")
"""


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    places = {"ahead": "Ahead", "worse": "Worse", "visual": "nothing", "missing": "Nowhere"}
    places |= {"nothing": "nothing", "fails": "fails"}
    points = {name: f"go_ahead:{place}" for name, place in places.items()}
    points["gone"] = "not_there:Ahead"
    install_plugin(tmp_path, "go-ahead", {"go_ahead.py": AHEAD}, points, "odometries")
    monkeypatch.syspath_prepend(str(tmp_path))


@pytest.mark.usefixtures("plugin")
def test_a_registered_odometry_has_a_name_that_is_not_ours_nor_of_two(tmp_path):
    assert isinstance(make_odometry("ahead").odometry, ForeignOdometry)
    assert type(make_odometry("visual").odometry) is type(ODOMETRIES["visual"](None, None))
    with pytest.raises(SettingsError, match=r"unknown odometry.*'orb'.*ahead, .*kiss.*sfm, visual"):
        make_odometry("orb")
    with pytest.raises(SettingsError, match=r"odometry 'ahead': only.* take a prior"):
        make_odometry("ahead", prior=recon.Trajectory(np.eye(4)[None], np.zeros(1)))
    install_plugin(tmp_path, "other", {}, {"ahead": "other:Ahead"}, "odometries")
    with pytest.raises(SettingsError, match=r"same name.*go-ahead.*and.*other"):
        make_odometry("ahead")


@pytest.mark.usefixtures("plugin", "blank_figures")
def test_a_drive_is_mapped_with_a_plugin_and_results_name_it(tmp_path):
    source = recon.SyntheticSource(recon.load_config(overrides=[
        "street.frames=4", "street.width_px=256", "street.height_px=96", "street.focal_px=150",
    ]).street)  # fmt: skip
    options = recon.MapOptions(audit=False, out=tmp_path / "run", mesh=False)
    config = recon.load_config(overrides=["rig.refine=false", "odometry.method=ahead"])
    assert recon.run_map(source, config, options).summary.to_json()["odometry"] == "ahead"
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["odometry"] == "ahead"
    assert "method: ahead" in (tmp_path / "run" / "config.yaml").read_text()
    bad = recon.MapOptions(audit=False, out=tmp_path / "bad", mesh=False)
    with pytest.raises(RegistrationError, match=r"odometry 'worse', frame 0: .*no rigid pose.*nan"):
        recon.run_map(source, recon.load_config(overrides=["odometry.method=worse"]), bad)
    assert not (tmp_path / "bad").exists()
