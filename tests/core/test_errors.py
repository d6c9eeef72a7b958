from __future__ import annotations

from pathlib import Path

import pytest

from recon.core.errors import FormatError, MissingDependencyError, ReconError, require


def test_a_line_tells_where_what_got_expected_and_what_to_do_in_that_order() -> None:
    error = FormatError(
        "wrong size", where=Path("a/b.png"), got="2x2", expected="3x3", hint="crop it"
    )
    assert str(error) == "a/b.png: wrong size (got 2x2, expected 3x3); crop it"


@pytest.mark.parametrize(
    ("parts", "line"),
    [
        ({}, "wrong"),
        ({"where": "f"}, "f: wrong"),
        ({"got": 0}, "wrong (got 0)"),
        ({"expected": "3"}, "wrong (expected 3)"),
        ({"hint": "mend it"}, "wrong; mend it"),
    ],
)
def test_parts_that_are_not_known_leave_no_trace(parts: dict[str, object], line: str) -> None:
    assert str(ReconError("wrong", **parts)) == line  # type: ignore[arg-type]


def test_a_message_with_line_breaks_is_still_one_line() -> None:
    assert str(ReconError("wrong", got="a\n  b\t c")) == "wrong (got a b c)"


def test_an_optional_package_that_is_there_is_imported() -> None:
    assert require("json", extra="ros").dumps([1]) == "[1]"


def test_an_optional_package_that_is_missing_gets_the_pip_line() -> None:
    with pytest.raises(
        MissingDependencyError, match=r"'no_such_thing'.*pip install 'recon\[ros\]'"
    ):
        require("no_such_thing", extra="ros")
