"""Whether a single pair can give what is asked of it, said before anybody believes the result."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from recon.audit import Finding
from recon.errors import CalibrationError, MatchingError
from recon.pipeline.audit_run import run_audit
from recon.pipeline.config import ReconConfig
from recon.structures import (
    Disparity,
    Reason,
    RectifiedCamera,
    SequenceTruth,
    StereoCalibration,
    StereoPair,
)

#: What pictures tell by themselves, and what a calibration adds. Swapped eyes and rows are told by
#: the inspection of the frame; few features mean little where the disparity is dense all the same.
_BY_PICTURES: Final = frozenset({"black", "gain", "blur"})
_BY_CALIBRATION: Final = frozenset({"size", "baseline", "near", "far"})

FEW_VALID_SHARE: Final = 0.25
"""Share of pixels with a disparity under which the two are hardly a pair: real ones, of bare walls
too, have over 40 %, and pictures of different moments or swapped ones under 15 %."""


@dataclass(frozen=True, eq=False)
class OnePair:
    """A pair as a source of one frame.

    Attributes:
        pair: The pictures.
        calibration: Of the two cameras.
        files: What they were read from.
    """

    pair: StereoPair
    calibration: RectifiedCamera | StereoCalibration
    files: tuple[Path, ...] = ()
    description: str = "two pictures"
    truth: SequenceTruth | None = None

    @property
    def name(self) -> str:
        """That of the pair."""
        return self.pair.name

    def __len__(self) -> int:
        return 1

    def __iter__(self) -> Iterator[StereoPair]:
        return self.frames()

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """Yield the pair, or nothing from any later start."""
        yield from (self.pair,)[start:]


def find_pair_faults(given: OnePair, config: ReconConfig, *, metric: bool) -> tuple[Finding, ...]:
    """What a quick look finds; nothing where it is switched off.

    Args:
        given: The pair.
        config: Its ``audit`` and ``rectification`` count.
        metric: Whether depth is wanted, so that the calibration counts.
    """
    if not config.audit.quick:
        return ()
    telling = _BY_PICTURES | _BY_CALIBRATION if metric else _BY_PICTURES
    try:
        audit = run_audit(given, config, quick=True)
    except CalibrationError:
        return ()  # the run says so itself when it gets there
    return tuple(finding for finding in audit.findings if finding.code in telling)


def check_found(
    disparity: Disparity, pair: StereoPair, faults: tuple[Finding, ...] = ()
) -> tuple[str, ...]:
    """Warnings about how much was found.

    Args:
        disparity: What was found.
        pair: In which pictures.
        faults: What is known to be wrong with them.

    Raises:
        MatchingError: Nothing was found at all.
    """
    share = float(disparity.valid.mean())
    if share >= FEW_VALID_SHARE:
        return ()
    found = f"{100 * share:.0f} % of the pixels have a disparity ({_reasons(disparity)})"
    advice = (
        "check that both pictures show the same moment, that left and right are not swapped, that "
        "the calibration is theirs, and the range (--ndisp)"
    )
    if share > 0:
        return (f"only {found}; {advice}",)
    if np.array_equal(pair.left, pair.right):
        advice = "left and right are the same picture"
    raise MatchingError(
        "no pixel has a match in the other image",
        where=pair.name or None,
        got=_reasons(disparity),
        hint=next((fault.text for fault in faults if fault.fatal), advice),
    )


def _reasons(disparity: Disparity) -> str:
    """The two most common reasons for having no disparity."""
    count = np.bincount(disparity.reason.ravel(), minlength=len(Reason))
    percent = 100 * count / disparity.reason.size
    most = sorted((r for r in Reason if r and percent[r] >= 1), key=lambda r: -percent[r])[:2]
    return ", ".join(f"{percent[r]:.0f} % {r.name.lower().replace('_', ' ')}" for r in most)
