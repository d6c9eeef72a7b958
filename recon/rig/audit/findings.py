"""Results of an audit: findings with advice, and a verdict."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Verdict = Literal["good", "usable", "not usable"]


@dataclass(frozen=True)
class Finding:
    """One problem of a recording.

    Attributes:
        code: Kind of problem, one word, for programs.
        fatal: Whether the problem makes depth wrong or impossible.
        text: Description and advice, for people.
    """

    code: str
    fatal: bool
    text: str


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """Return good without findings, not usable with a fatal one, else usable."""
    found = list(findings)
    if any(finding.fatal for finding in found):
        return "not usable"
    return "usable" if found else "good"
