"""Matchers by name."""

from __future__ import annotations

import pytest

from recon.errors import SettingsError
from recon.matching import MATCHERS, Matcher, MatchingSettings, field_of, make_matcher


@pytest.mark.parametrize("name", MATCHERS)
def test_every_name_gives_a_matcher_that_has_settings(name: str) -> None:
    assert field_of(name) in MatchingSettings.model_fields
    assert isinstance(make_matcher(name, MatchingSettings(), threads=1), Matcher)


def test_default_matcher_exists() -> None:
    assert MatchingSettings().matcher in MATCHERS


def test_unknown_name_lists_the_choices() -> None:
    with pytest.raises(SettingsError, match="one of: onnx, opencv-bm, opencv-sgbm, sad, sgm"):
        make_matcher("census")
