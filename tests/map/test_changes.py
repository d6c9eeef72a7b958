"""What came and went between two days in a street of boxes whose truth is known."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, label

from recon.commands.config import load_config
from recon.commands.diff import run_diff
from recon.commands.map_options import MapOptions
from recon.core.errors import FormatError, MappingError, OutputError, SettingsError
from recon.core.geometry.se3 import make_transform, transform_cloud
from recon.core.values import RectifiedCamera
from recon.export.changes import write_changes
from recon.io.models.ply import read_tables
from recon.map.builders import ray_grain, thin_rays
from recon.map.changes.compare import Comparison, compare, gather
from recon.map.changes.objects import NOT_COMPARED, SAME, ChangedObject, least_cells
from recon.map.drive.mapper import SubmapBuilder
from recon.map.map import Map
from recon.map.sessions.joining import join_sessions
from recon.map.store.session import SessionInfo
from recon.map.store.trees import Link
from recon.odometry.protocol import OdometryHealth
from recon.places.places import Loop
from recon.report.changes_page import write_objects
from tests.map.occupancy.test_moving import HEIGHT_M, RANGE_M, T_MAP_WORLD, Box, look

CONFIG = load_config()
CAMERA = RectifiedCamera(212.5, 169.5, 64.5, 169.5, 0.54, 340, 130)
FRAMES, STEP_M = 20, 0.6
SIZE = (1.8, 1.4, 4.2)
STAYS: Box = ((4.0, 0.0, 10.0), SIZE)
WENT: Box = ((4.0, 0.0, 17.0), SIZE)
CAME: Box = ((-4.0, 0.0, 10.0), SIZE)
MOVED: tuple[Box, Box] = ((-4.0, 0.0, 17.0), SIZE), ((-4.0, 0.0, 19.1), SIZE)
REPLACED: tuple[Box, Box] = ((4.0, 0.0, 3.5), SIZE), ((3.8, 0.0, 3.6), SIZE)
HIDDEN: Box = ((8.0, 0.0, 20.0), (1.0, 1.2, 2.0))
SCREEN: Box = ((6.5, 0.0, 19.5), (0.3, 3.0, 8.0))


def drive(map_: Map, boxes: list[Box], day: int, off_m: float = 0.0, frames: int = FRAMES) -> None:
    """A drive past boxes; its path is off by so much to the right, which nothing knows."""
    config = CONFIG.model_dump(mode="json")
    session = map_.begin(SessionInfo(f"day {day}", "of a test", frames, config))
    session.set_axes(T_MAP_WORLD, CAMERA)
    builder = SubmapBuilder(CONFIG.submaps, CONFIG.fusion, CONFIG.occupancy, T_MAP_WORLD)
    for frame in range(frames):
        z_m = STEP_M * frame
        T = make_transform(np.eye(3), np.array([off_m, 0.0, z_m]))
        cloud = look(boxes, z_m, 1000 * day + frame)
        rays = thin_rays(cloud, CONFIG.occupancy)
        near = cloud.select(cloud.xyz[:, 2] < RANGE_M)
        builder.integrate(transform_cloud(near, T, frame="world"), rays.cloud(), T)
        session.add_frame(T, 1.7e9 + 86_400.0 * day + 0.1 * frame, OdometryHealth())
        session.add_rays(frame, rays, ray_grain(CONFIG.occupancy))
        if builder.full or frame == frames - 1:
            session.submaps.add(builder.close())


def days(before: list[Box], after: list[Box], off_m: float = 0.0) -> Comparison:
    with Map.temporary() as map_:
        drive(map_, before, 0)
        drive(map_, after, 1, off_m)
        same = [Loop(n, n, np.eye(4), 1e6 * np.eye(6), 50, 0.9) for n in (0, FRAMES - 1)]
        join_sessions(map_, [Link((0, 1), loop) for loop in same])
        return compare(map_, [1])


def objects_at(found: Comparison, box: Box, change: str) -> list[ChangedObject]:
    """Return the objects of a kind whose middle is in a box, or within 0.3 m of it."""
    (x, _, z), (wide, _, long) = box
    return [
        one
        for one in found.objects
        if one.change == change
        and abs(-one.centre_m[1] - x) < wide / 2 + 0.3
        and abs(one.centre_m[0] - z) < long / 2 + 0.3
    ]


@pytest.fixture(scope="module")
def changed() -> Comparison:
    before = [STAYS, WENT, MOVED[0], REPLACED[0], HIDDEN]
    return days(before, [STAYS, CAME, MOVED[1], REPLACED[1], HIDDEN, SCREEN], off_m=0.03)


class TestCompare:
    def test_what_came_and_went_is_found_where_it_is(self, changed):
        for box, change in ((WENT, "went"), (CAME, "came"), (SCREEN, "came")):
            found = objects_at(changed, box, change)
            assert len(found) == 1, (box, change)
            assert not objects_at(changed, box, "came" if change == "went" else "went")
        one = objects_at(changed, CAME, "came")[0]
        assert one.length_m == pytest.approx(SIZE[2], abs=0.6)
        assert one.height_m == pytest.approx(SIZE[1], abs=0.45)
        assert one.centre_m[2] == pytest.approx(SIZE[1] / 2 - HEIGHT_M, abs=0.3)

    def test_what_stays_is_the_same_and_nothing_else_is_found(self, changed):
        assert not objects_at(changed, STAYS, "came")
        assert not objects_at(changed, STAYS, "went")
        known = [WENT, CAME, SCREEN, *MOVED, *REPLACED]
        real = [
            one
            for box in known
            for kind in ("came", "went")
            for one in objects_at(changed, box, kind)
        ]
        assert {id(one) for one in changed.objects} == {id(one) for one in real}

    def test_what_moved_by_half_its_length_went_at_one_end_and_came_at_the_other(self, changed):
        assert objects_at(changed, MOVED[0], "went")
        assert objects_at(changed, MOVED[1], "came")

    def test_what_stands_a_voxel_beside_its_place_was_replaced(self, changed):
        assert objects_at(changed, REPLACED[0], "went")
        assert objects_at(changed, REPLACED[1], "came")

    def test_what_was_hidden_is_not_compared(self, changed):
        assert not objects_at(changed, HIDDEN, "went")
        (x, _, z), _ = HIDDEN
        xyz = changed.before.cloud.xyz
        at = np.abs(xyz[:, :2] - [z, -x]).max(axis=1) < 1.2
        at &= xyz[:, 2] > 0.4 - HEIGHT_M
        assert at.sum() > 10
        assert np.mean(changed.before.classes[at] == NOT_COMPARED) > 0.8
        assert 0 < changed.before.not_compared_ratio < 0.5

    def test_an_object_says_when_and_how_much(self, changed):
        one = objects_at(changed, WENT, "went")[0]
        assert (one.first_seen.drive, one.first_seen.session) == ("day 0", 0)
        assert one.first_seen.frame < one.last_seen.frame < FRAMES
        assert one.first_seen.date == "2023-11-14T22:13:20Z"
        # Of what was seen: a side and the front, as thick as their voxels.
        assert 0 < one.volume_m3 < np.prod(SIZE) + 2 * one.volume_sigma_m3
        assert 0 < one.volume_sigma_m3 < one.volume_m3

    def test_the_same_street_has_no_changes(self):
        found = days([STAYS, WENT], [STAYS, WENT], off_m=0.04)
        assert not found.objects
        assert np.mean(found.after.classes == SAME) > 0.9


class TestFiles:
    def test_cloud_and_map_from_above_have_the_classes(self, changed, tmp_path):
        write_changes(changed, tmp_path / "changes")
        _, tables = read_tables(tmp_path / "changes.ply", ["vertex"])
        vertex = tables["vertex"]
        of_day = [day.classes for day in (changed.before, changed.after)]
        np.testing.assert_array_equal(vertex["change"], np.concatenate(of_day))
        assert np.bincount(vertex["day"]).tolist() == [*map(len, of_day)]
        described = (tmp_path / "changes.yaml").read_text()
        assert "mode: scale" in described
        assert "resolution: 0.2" in described

    def test_the_table_has_a_row_an_object(self, changed, tmp_path):
        write_objects(tmp_path / "changes.csv", changed.objects)
        rows = [*csv.DictReader((tmp_path / "changes.csv").open())]
        assert [int(row["number"]) for row in rows] == [*range(1, len(changed.objects) + 1)]
        for row, one in zip(rows, changed.objects, strict=True):
            assert float(row["centre_m_x"]) == one.centre_m[0]
            assert row["first_seen_date"] == one.first_seen.date
        write_objects(tmp_path / "none.csv", [])
        assert (tmp_path / "none.csv").read_text().strip() == ""


class TestRefused:
    @pytest.fixture
    def files(self, tmp_path) -> list[Path]:
        """Map files of two days in places that nothing links."""
        paths = [tmp_path / "one.recon", tmp_path / "other.recon"]
        for day, path in enumerate(paths):
            with Map.create(path) as map_:
                drive(map_, [STAYS], day, frames=2)
                map_.commit()
        return paths

    def test_maps_that_share_no_place(self, files, tmp_path):
        self.refused(files, tmp_path, MappingError, "no place is seen to be")

    def test_the_same_run_twice(self, files, tmp_path):
        self.refused([files[0]] * 2, tmp_path, MappingError, "both maps are of the same drives")

    def test_a_missing_and_a_damaged_map(self, files, tmp_path):
        self.refused([files[0], tmp_path / "nothing"], tmp_path, FormatError, "does not exist")
        files[1].write_bytes(files[1].read_bytes()[:5000])
        self.refused(files, tmp_path, FormatError, "other.recon")

    def test_a_folder_that_cannot_be_made(self, files, tmp_path):
        with pytest.raises(OutputError):
            run_diff(*files, MapOptions("diff", files[0] / "out"))

    def test_voxels_of_another_size(self, files, tmp_path):
        with Map.open(files[0]) as one, Map.open(files[1]) as other, Map.temporary() as map_:
            session = other.sessions[0]
            fusion = {**session.info.config["fusion"], "voxel_m": 0.2}
            session.info = replace(session.info, config={**session.info.config, "fusion": fusion})
            with pytest.raises(SettingsError, match="voxels of different"):
                gather(map_, one, other)

    def refused(self, files: list[Path], folder: Path, error: type[Exception], text: str) -> None:
        with pytest.raises(error, match=text) as found:
            run_diff(*files, MapOptions("diff", folder / "out"))
        assert "\n" not in str(found.value)
        assert not (folder / "out").exists()


class TestLeastCells:
    def test_more_noise_takes_larger_pieces(self):
        sizes = [least_cells(small, 100_000) for small in (0, 30, 300)]
        assert sizes == sorted(set(sizes))
        assert sizes[0] == 10  # more than the cells around one, which err together

    def test_of_noise_alone_there_is_nothing(self):
        assert least_cells(5000, 10_000) > 10_000

    def test_chance_makes_no_object(self):
        """Patches that changed by chance, on a plane: no piece is as large as an object."""
        rng, larger = np.random.default_rng(0), 0
        for _ in range(20):
            cells = binary_dilation(rng.random((300, 300)) < 0.0005, np.ones((3, 3)))
            pieces, _ = label(cells, np.ones((3, 3)))
            sizes = np.bincount(pieces.ravel())[1:]
            larger += sizes.max() >= least_cells(int((sizes <= 9).sum()), cells.size)
        assert larger <= 4
