"""Dates of drives: ISO 8601 texts in UTC, by stamps of images, by a file, or as a user gives them.

A stamp may count from the start of a recording. It is a date only where it is seconds since 1970,
and lies between the first digital cameras and tomorrow.
"""

from __future__ import annotations

import time
from datetime import datetime, timezone
from typing import Final, Literal, NamedTuple

from recon.core.errors import SettingsError

DateFrom = Literal["", "stamps", "file", "given"]
"""By what a date is known; the time of a file may be that of a copy."""
_FIRST_S: Final = 631152000.0  # 1990-01-01
DAY_S: Final = 86400.0


class Date(NamedTuple):
    """When a drive began, in UTC ("" = not known), and by what that is known."""

    text: str = ""
    known_from: DateFrom = ""

    @property
    def seconds(self) -> float:
        """Seconds since 1970, of a date that is known."""
        found = datetime.fromisoformat(self.text.replace("Z", "+00:00"))
        return (found if found.tzinfo else found.replace(tzinfo=timezone.utc)).timestamp()


def date_of_stamp(stamp_s: float, known_from: DateFrom = "stamps") -> Date:
    """Return the date of a time in seconds; none where it cannot be one since 1970."""
    if not _FIRST_S <= stamp_s <= time.time() + DAY_S:
        return Date()
    found = datetime.fromtimestamp(int(stamp_s), timezone.utc)
    return Date(found.strftime("%Y-%m-%dT%H:%M:%SZ"), known_from)


def given_date(text: str, where: str) -> Date:
    """Return the date that a user gives; `SettingsError` if it is none from 1990 to tomorrow."""
    try:
        found = date_of_stamp(Date(text).seconds, "given")
    except (ValueError, OverflowError):
        found = Date()
    if not found.text:
        expected = "2026-11-30 or 2026-11-30T14:05, from 1990 to today"
        raise SettingsError("not the date of a drive", where=where, got=text, expected=expected)
    return found._replace(text=text) if len(text) == len("2026-11-30") else found
