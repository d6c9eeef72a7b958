"""The matchers by name."""

from __future__ import annotations

from typing import Final

from pydantic import Field

from recon.errors import SettingsError
from recon.matching.protocol import Matcher
from recon.matching.sad import SadMatcher, SadSettings
from recon.settings import Settings

MATCHERS: Final = {"sad": SadMatcher}


class MatchingSettings(Settings):
    """Which matcher, and the settings of each."""

    matcher: str = Field(default="sad", description="Name of the matcher: sad.")
    sad: SadSettings = Field(default_factory=SadSettings, description="Of the matcher `sad`.")


def make_matcher(
    name: str, settings: MatchingSettings | None = None, threads: int | None = None
) -> Matcher:
    """Make the matcher of a name.

    Args:
        name: A key of `MATCHERS`.
        settings: The settings of all matchers; it takes its own part.
        threads: Threads that it may use; all cores by default.

    Raises:
        SettingsError: There is no such matcher.
    """
    if name not in MATCHERS:
        choices = ", ".join(sorted(MATCHERS))
        raise SettingsError("unknown matcher", got=repr(name), expected=f"one of: {choices}")
    return MATCHERS[name](getattr(settings or MatchingSettings(), name), threads)
