"""Drives of a few small images, rendered for nothing."""

import numpy as np
import pytest

from recon.core.values import StereoPair
from tests.sources.drives import FRAMES


@pytest.fixture(scope="session")
def noise():
    """Pairs whose content does not matter, but for its being different everywhere."""
    rng = np.random.default_rng(3)
    images = rng.integers(0, 256, (12, 2, 32, 64), dtype=np.uint8)
    return [StereoPair(*both, 0.1 * index, index) for index, both in enumerate(images)]


@pytest.fixture(scope="session")
def numbered():
    """The grey value of both images is ten times the number of the frame."""
    grey = [np.full((32, 64), 10 * index, np.uint8) for index in range(FRAMES)]
    return [StereoPair(image, image, 0.1 * index, index) for index, image in enumerate(grey)]
