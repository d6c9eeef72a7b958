"""Settings of one frame: what determines a cloud from a pair."""

from __future__ import annotations

from pydantic import Field
from typing_extensions import Self

from recon.core.settings import Settings
from recon.stereo.cloud.back_project import CloudSettings
from recon.stereo.cloud.filters import FilterSettings
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.registry import MatchingSettings, check_matcher
from recon.stereo.rectify.rectifier import RectificationSettings


class StereoSettings(Settings):
    """Everything that determines the cloud of one frame."""

    rectification: RectificationSettings = RectificationSettings()
    matching: MatchingSettings = MatchingSettings()
    cloud: CloudSettings = CloudSettings()
    filters: FilterSettings = Field(
        default=FilterSettings(),
        description="Filters of the cloud of one frame, in this order; none turns one off. "
        "Fusion thins and cleans the clouds of a drive anyway.",
    )

    def with_matcher(self, matcher: str | Matcher | None) -> Self:
        """Return the settings with another matcher, by name or as an object; None = unchanged.

        ``config.yaml`` has the name of an object only, so such a run is repeated from Python.
        `map_sequence` and `run_map` call it from one thread, one pair after the other.
        """
        if matcher is None:
            return self
        check_matcher(matcher)
        matching = self.matching.model_copy(update={"matcher": matcher})
        return self.model_copy(update={"matching": matching})
