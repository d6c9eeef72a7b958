"""A source of one's own: a subclass with a calibration, a length and frames; nothing else works."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import recon
from recon.core.errors import SourceError
from recon.core.values import StereoPair
from recon.map.localize.sequence import localize_sequence
from recon.rig.audit.audit import audit_source
from recon.sources.source import SourcePart
from recon.street.settings import StreetScene
from tests.scenery.film import RIG, Film, film


class Own(recon.StereoSource):
    """No more than has to be there."""

    def __init__(self, street: Film) -> None:
        self.calibration, self.street = street.calibration, street

    def __len__(self) -> int:
        return len(self.street)

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        return self.street.frames(start)


@pytest.fixture(scope="module")
def own() -> Own:
    return Own(film(StreetScene(frames=3, seed=1, **RIG)))


def test_a_subclass_is_mapped_and_has_defaults_for_the_rest(own: Own) -> None:
    mapped = recon.map_sequence(own, recon.load_config())
    assert len(mapped.trajectory) == 3
    assert repr(own) == "Own(Own, pairs: 3, a source)"
    assert (own.files, own.truth, own.stamps_s, own.left_out) == ((), None, None, 0)
    assert (own.live, own.lead, own.hurried(), own.warnings(), own.figures()) == (
        *(False, 0, False),
        *([], {}),
    )
    assert [own.lines(count) for count in (2, 3, 4)] == [None, [0, 1, 2], [0, 1, 2]]


def test_a_part_has_the_pairs_of_its_range(own: Own) -> None:
    part = SourcePart(own, 1, 3, lead=1)
    assert repr(part) == "SourcePart(Own 1 to 2, pairs: 2, a source)"
    assert ([p.index for p in part], [p.index for p in part.frames(1)]) == ([1, 2], [2])
    assert part.lead == 1


CALLS: dict[str, Callable[[Any], Any]] = {
    "map_sequence": lambda source: recon.map_sequence(source, recon.load_config()),
    "run_map": lambda source: recon.run_map(source, options=recon.MapOptions(audit=False)),
    "run_live": recon.run_live,
    "run_audit": lambda source: recon.run_audit(source, recon.load_config()),
    "audit_source": lambda source: audit_source(source, recon.load_config()),
    "localize_sequence": lambda source: localize_sequence(source, None, None),  # type: ignore[arg-type]
}


@pytest.mark.parametrize("call", CALLS.values(), ids=list(CALLS))
@pytest.mark.parametrize("other", [Path("drive"), SimpleNamespace(frames=list, name="mine")])
def test_anything_else_is_refused_in_one_line(call: Callable[[Any], Any], other: Any) -> None:
    with pytest.raises(SourceError, match=r"subclass of recon\.StereoSource") as refused:
        call(other)
    assert type(other).__name__ in str(refused.value)
