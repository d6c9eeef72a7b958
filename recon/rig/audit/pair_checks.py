"""Checks whether a single pair can give a trustworthy result."""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.core.errors import CalibrationError, MatchingError
from recon.core.values import Disparity, StereoPair
from recon.rig.audit.audit import audit_source
from recon.rig.audit.findings import Finding
from recon.rig.audit.settings import AuditedSettings
from recon.sources.one_pair import OnePair, PairInput

#: Findings that images alone support, and those that need a calibration. The inspection of the
#: frame reports swapped cameras and misaligned rows; few features do not matter if the disparity
#: is dense.
_BY_IMAGES: Final = frozenset({"black", "gain", "blur"})
_BY_CALIBRATION: Final = frozenset({"size", "baseline", "near", "far"})

FEW_VALID_SHARE: Final = 0.25
"""Share of pixels with a disparity below which the images are hardly a stereo pair: real pairs,
even of bare walls, exceed 40 %; swapped images, or those of different moments, stay under 15 %."""


def find_pair_faults(
    given: PairInput, config: AuditedSettings, *, metric: bool
) -> tuple[Finding, ...]:
    """Return findings of a quick audit; none if it is switched off.

    Args:
        given: The pair.
        config: The configuration; its ``audit`` and ``rectification`` sections are used.
        metric: Whether depth is wanted, so that the calibration matters.
    """
    _check_two(given.pair)
    if not config.audit.quick:
        return ()
    codes = _BY_IMAGES | _BY_CALIBRATION if metric else _BY_IMAGES
    try:
        audit = audit_source(OnePair(given.pair, given.calibration), config, quick=True)
    except CalibrationError:
        return ()  # the run itself reports this later
    return tuple(finding for finding in audit.findings if finding.code in codes)


def check_found(
    disparity: Disparity, pair: StereoPair, faults: tuple[Finding, ...] = ()
) -> tuple[str, ...]:
    """Return warnings about the share of pixels with a disparity."""
    share = float(disparity.valid.mean())
    if share >= FEW_VALID_SHARE:
        return ()
    found = f"{100 * share:.0f} % of the pixels have a disparity ({_reasons(disparity)})"
    advice = (
        "check that both images show the same moment, that left and right are not swapped, that "
        "the calibration is theirs, and the range (--ndisp)"
    )
    if share > 0:
        return (f"only {found}; {advice}",)
    raise MatchingError(
        "no pixel has a match in the other image",
        where=pair.name or None,
        got=_reasons(disparity),
        hint=next((fault.text for fault in faults if fault.fatal), advice),
    )


def _check_two(pair: StereoPair) -> None:
    """Refuse one image given twice; rectified by two cameras it looks like a swapped pair."""
    if np.array_equal(pair.left, pair.right) and np.ptp(pair.left):
        hint = "name the image of each camera"
        raise MatchingError("left and right are the same image", where=pair.name or None, hint=hint)


def _reasons(disparity: Disparity) -> str:
    """Return the two most common reasons for having no disparity."""
    shares = {r: 100 * share for r, share in disparity.reason_shares.items() if r and share >= 0.01}
    most = list(shares.items())[:2]
    return ", ".join(f"{share:.0f} % {r.name.lower().replace('_', ' ')}" for r, share in most)
