"""Matchers by name."""

from __future__ import annotations

import pytest

from recon.core.errors import SettingsError
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.registry import MATCHERS, MatchingSettings, field_of, make_matcher


@pytest.mark.parametrize("name", MATCHERS)
def test_every_name_has_settings_and_gives_a_matcher(name: str) -> None:
    settings = getattr(MatchingSettings(), field_of(name))
    assert isinstance(MATCHERS[name](settings, 1), Matcher)


@pytest.mark.parametrize("name", MATCHERS)
def test_a_matcher_whose_range_is_estimated_is_a_matcher(name: str) -> None:
    assert isinstance(make_matcher(name, MatchingSettings(), threads=1), Matcher)


def test_default_matcher_exists() -> None:
    assert MatchingSettings().matcher in MATCHERS


def test_unknown_name_lists_the_choices() -> None:
    with pytest.raises(SettingsError, match="one of: onnx, opencv-bm, opencv-sgbm, sad, sgm"):
        make_matcher("census")
