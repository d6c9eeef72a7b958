"""Which image of which drive a list of control points means."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from recon.core.errors import EvaluationError
from recon.export.control import _Images

LIST = Path("gcp.txt")


def drive(number, name, *images, placed=None):
    def number_of(image):
        stem = Path(image).stem
        return images.index(stem) if stem in images else None

    session = SimpleNamespace(number=number, info=SimpleNamespace(source=name))
    placed = [True] * len(images) if placed is None else placed
    return SimpleNamespace(
        session=session, source=SimpleNamespace(number_of=number_of), placed=placed
    )


def found(image, *drives):
    images = _Images.__new__(_Images)
    images._drives, images._where = drives, LIST
    return images._frame(image)


MONDAY = drive(0, "monday", "a", "b", "c")
FRIDAY = drive(2, "friday", "b", "c", "d", placed=[True, False, True])


@pytest.mark.parametrize(
    ("image", "drive_and_frame"),
    [
        ("a.png", (0, 0)),
        ("d.png", (1, 2)),  # of the second one that is linked
        ("photos/d.png", (1, 2)),  # in whatever folder the other program had it
        ("monday/b.png", (0, 1)),
        ("friday/b.png", (1, 0)),
        ("0/b.png", (0, 1)),
        ("2/b.png", (1, 0)),
    ],
)
def test_an_image_is_that_of_the_drive_that_has_it_or_is_named(image, drive_and_frame):
    assert found(image, MONDAY, FRIDAY) == drive_and_frame


@pytest.mark.parametrize(
    ("image", "said"),
    [
        ("b.png", r"several drives have this image .*0/b\.png of monday or 2/b\.png of friday"),
        ("z.png", "no such image"),
        ("monday/d.png", "no such image"),
        ("friday/c.png", "the image has no place in the map"),
    ],
)
def test_an_image_of_two_drives_or_of_none_is_refused(image, said):
    with pytest.raises(EvaluationError, match=rf"gcp\.txt: {said}"):
        found(image, MONDAY, FRIDAY)


def test_a_map_of_one_drive_needs_no_name_of_it():
    assert found("any/b.png", MONDAY) == (0, 1)
