"""Recordings that show no rig: nothing is corrected by them, and nothing is made of late ones."""

from dataclasses import replace

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.errors import CalibrationError, MatchingError, SourceError
from recon.look.findings import Finding, find_faults
from recon.look.geometry import Rigidity
from recon.look.look import look_at, refine_rig
from recon.odometry.settings import RigSettings
from recon.rig.audit import (
    audit_source,
    check_related,
    correct_calibration,
)
from recon.sources.registry import open_source
from recon.sources.settings import SourceSettings
from recon.sources.source import SourcePart, StereoSource
from tests.hostile.refusals import assert_refused, run
from tests.look import faults
from tests.rig.test_audit_run import CONFIG, rendered
from tests.sources import drives

pytestmark = pytest.mark.usefixtures("blank_figures")
FRAMES = 16


def findings(source: StereoSource) -> list[Finding]:
    return find_faults(look_at(source, CONFIG), CONFIG)


def codes(source: StereoSource) -> set[str]:
    return {finding.code for finding in findings(source)}


@pytest.fixture(scope="module")
def street():
    return rendered(5, FRAMES)


def loose(street: faults.Spoiled, sizes_px: tuple[int, ...] = (-9, 0, 6, 12)) -> faults.Spoiled:
    """The right camera nods against the left one, every few frames by another angle."""

    def take(index: int):
        pair = street.take(index)
        rows = sizes_px[index * len(sizes_px) // len(street)]
        return replace(pair, right=np.roll(pair.right, rows, axis=0))

    return faults.Spoiled(street.camera, len(street), take)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (lambda s: faults.offset(s, 2), "right camera is 2 frames late"),
        (lambda s: faults.changed(s, lambda left, right: (right, left)), "swapped"),
        (faults.silently_wrong_size, "of another size"),
        (loose, "move against each other"),
    ],
)
def test_a_recording_that_does_not_show_the_rig_corrects_none(street, tmp_path, fault, words):
    spoiled = fault(street)
    audit = audit_source(spoiled, CONFIG)
    with pytest.raises(CalibrationError, match=f"^spoiled: .* does not show the rig.*{words}"):
        correct_calibration(spoiled, CONFIG, audit, tmp_path / "rig.yaml")
    assert not (tmp_path / "rig.yaml").exists()


@pytest.fixture
def late(street, tmp_path):
    """A folder with a drive whose right images are two frames late."""
    pairs = list(faults.offset(street, 2).frames())
    grey = [replace(p, left=p.left[:, :, 0], right=p.right[:, :, 0]) for p in pairs]
    return drives.write_kitti(grey, faults.rectified(street), tmp_path)


@pytest.mark.slow
def test_a_late_drive_is_paired_as_it_belongs_together_and_says_so_first(late, tmp_path):
    found = "right camera is 2 frames late: its images are paired"
    out = tmp_path / "out"
    paired = run_map(open_source(late), CONFIG, MapOptions(out=out, mesh=False))
    assert found in paired.warnings[0]
    assert "source.shift_frames=2" in paired.warnings[0]
    assert "shift_frames: 2" in (out / "config.yaml").read_text()
    shifted = open_source(late, settings=SourceSettings(shift_frames=2))
    assert codes(shifted) == set()
    same = run_map(shifted, CONFIG, MapOptions(out=tmp_path / "set", mesh=False))
    assert found not in str(same.warnings)
    poses = [run.mapped.trajectory.T_world_camera for run in (paired, same)]
    np.testing.assert_array_equal(*poses)
    audit = audit_source(open_source(late), CONFIG)
    assert (audit.verdict, [one.code for one in audit.findings]) == ("usable", ["lag"])
    assert_refused(run("audit", late, "--repair", tmp_path / "rig.yaml"), found)
    assert not (tmp_path / "rig.yaml").exists()


def test_a_late_drive_that_cannot_be_paired_otherwise_is_refused(street, tmp_path):
    with pytest.raises(SourceError, match=r"of different moments.*right camera is 2 frames late"):
        run_map(faults.offset(street, 2), CONFIG, MapOptions(out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_clean_drive_a_part_of_it_and_one_that_stands_are_not_refused(street):
    part = SourcePart(street, 3, FRAMES)
    still = faults.Spoiled(street.camera, FRAMES, lambda _: street.take(4))
    assert codes(street) == codes(part) == set()
    assert "lag" not in codes(still)


def test_cameras_that_move_against_each_other_are_found_and_keep_their_calibration(street):
    moved = loose(street)
    (finding,) = [one for one in findings(moved) if one.code == "nonrigid"]
    assert finding.fatal
    assert "-9 px in frame 3" in finding.text
    found = refine_rig(moved, CONFIG, RigSettings())
    assert found.not_rigid == (finding.text,)
    assert not found.refined
    assert not found.applied(moved).rigid


@pytest.mark.parametrize("fault", ["none", "a turn", "one wrong pair"])
def test_a_rig_that_is_only_turned_or_one_odd_pair_is_rigid(street, fault):
    plant = {
        "none": lambda s: s,
        "a turn": lambda s: faults.turned(s, pitch_deg=0.6, roll_deg=1.5),
        "one wrong pair": lambda s: loose(s, (0,) * (FRAMES - 1) + (20,)),
    }[fault]
    found = look_at(plant(street), CONFIG).rig.rigidity
    assert len(found.frames) >= 5
    assert found.kept
    assert found.spread_px < 1.0


def test_too_few_pairs_say_nothing_of_the_rig():
    epipolar_error_px = np.array([-9.0, 0.0, 9.0])
    assert Rigidity((0, 9), epipolar_error_px[::2], epipolar_error_px[::2]).kept
    assert not Rigidity((0, 5, 9), epipolar_error_px, epipolar_error_px).kept
    assert Rigidity((0, 5, 9), epipolar_error_px, 0 * epipolar_error_px).kept


def test_a_drive_of_two_drives_is_refused_and_one_in_the_dark_is_not_for_that(street, tmp_path):
    other = rendered(7, FRAMES)
    mixed = faults.Spoiled(
        street.camera, FRAMES, lambda k: replace(street.take(k), right=other.take(k).right)
    )
    with pytest.raises(
        MatchingError, match=r"^spoiled, frame 12: nothing shows that left and right"
    ):
        run_map(mixed, CONFIG, MapOptions(out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()
    black = faults.changed(street, lambda left, right: (0 * left, 0 * right))
    check_related(look_at(black, CONFIG), CONFIG)
    check_related(look_at(street, CONFIG), CONFIG)


def test_a_small_or_large_rig_is_no_fault_and_none_once_its_unit_is_set(street):
    for baseline_m, widened in ((0.004, "[0.002,0.008]"), (2000.0, "[1000,4000]")):
        camera = replace(faults.rectified(street), baseline_m=baseline_m)
        look = look_at(replace(street, camera=camera), CONFIG)
        found = {one.code: one for one in find_faults(look, CONFIG)}
        assert not found["baseline"].fatal
        assert f"--set audit.baseline_m={widened} says so" in found["baseline"].text
        for known in (f"audit.baseline_m={widened}", "source.metres_per_unit=0.001"):
            config = load_config(None, [known])
            assert "baseline" not in {one.code for one in find_faults(look, config)}
