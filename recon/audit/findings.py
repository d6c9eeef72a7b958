"""What an audit says: findings, each with what to do, and one verdict."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Verdict = Literal["good", "usable", "not usable"]


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong.

    Attributes:
        code: What kind of thing, one word, for programs.
        fatal: Whether depth is wrong or missing because of it.
        text: What was found and what to do, for people.
    """

    code: str
    fatal: bool
    text: str


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """Good without findings, not usable with a fatal one."""
    found = list(findings)
    if any(finding.fatal for finding in found):
        return "not usable"
    return "usable" if found else "good"
