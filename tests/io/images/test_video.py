"""Videos: frames by their number, and what is too large or damaged."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.core.errors import FormatError
from recon.io.images import video
from recon.io.images.video import open_video

GREYS = (30, 90, 150, 210)


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    writer = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (32, 16))
    for grey in GREYS:
        writer.write(np.full((16, 32, 3), grey, np.uint8))
    writer.release()
    return tmp_path / "a.avi"


def test_the_frames_of_some_numbers_are_decoded_with_their_times(clip: Path) -> None:
    opened = open_video(clip)
    assert (opened.frames, opened.width_px, opened.height_px, opened.rate_hz) == (4, 32, 16, 10)
    picked = list(opened.pick([1, 3]))
    assert [round(float(image.mean()) / 30) for _, image in picked] == [3, 7]
    assert [image.shape for _, image in picked] == [(16, 32, 3)] * 2
    assert picked[1][0] - picked[0][0] == pytest.approx(0.2)
    with pytest.raises(FormatError, match=r"a\.avi: .*to its end \(got 4 frames, expected 4"):
        list(opened.pick([4]))


def test_a_video_of_too_many_pixels_is_refused(clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "MAX_MEGAPIXELS", 512e-6)
    assert open_video(clip).frames == 4
    monkeypatch.setattr(video, "MAX_MEGAPIXELS", 511e-6)
    with pytest.raises(FormatError, match=r"too many pixels \(got 32x16"):
        open_video(clip)
