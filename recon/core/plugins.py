"""Parts of recon that others write: registered by an installed package, or given as an object."""

from __future__ import annotations

import inspect
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from itertools import chain
from typing import Any, Final

from recon.core.errors import ReconError, SettingsError

_GROUPS: Final = "recon."  # what the names of our entry point groups begin with


@dataclass(frozen=True)
class Plugins:
    """What others write of one kind."""

    kind: str  # what one is called in errors
    group: str  # the entry point group in which packages register it
    methods: tuple[str, ...]  # what it must have, as it is called: ``match(pair)``

    def check(self, given: object, ours: Collection[str] = ()) -> None:
        """Refuse an unknown name, and an object that is none, without making anything."""
        if isinstance(given, str):
            if given not in ours and given not in (others := self.names()):
                choices = ", ".join(sorted({*ours, *others}))
                what = f"unknown {self.kind}"
                raise SettingsError(what, got=repr(given), expected=f"one of: {choices}")
        elif inspect.isclass(given):
            name = given.__name__
            what, expected = f"{self.kind} is a class", f"an object: {name}()"
            raise SettingsError(what, got=name, expected=expected)
        elif not self._fits(given):
            what, expected = f"not usable as {self.kind}", f"a name, or {self._expected}"
            raise SettingsError(what, got=type(given).__name__, expected=expected)

    def names(self) -> Collection[str]:
        """Return the names that installed packages register, without loading anything."""
        return entry_points(group=self.group).names

    def registered(self, name: str) -> Any:
        """Return what a package registers, usually a class, before anything is made of it."""
        with calling(SettingsError, "the plug-in does not load", where=self._origin(name)):
            return self._point(name).load()

    def load(self, given: str | object, *arguments: object) -> Any:
        """Return an object as it is, and make that of a name which a package registers."""
        if not isinstance(given, str):
            return given
        origin, make = self._origin(given), self.registered(given)
        with calling(SettingsError, "the plug-in does not load", where=origin):
            made = make(*arguments)
        if inspect.isclass(made) or not self._fits(made):
            raise SettingsError(
                f"the plug-in makes no {self.kind}",
                where=origin,
                got=type(made).__name__,
                expected="a class or function that takes no argument, or the settings that it "
                f"brings, and gives {self._expected}",
            )
        return made

    def _origin(self, name: str) -> str:
        return f"{self.kind} {name!r} ({_origin(self._point(name))})"

    def _point(self, name: str) -> EntryPoint:
        point, *others = sorted(entry_points(group=self.group, name=name), key=_origin)
        if others:
            raise SettingsError(
                "two plug-ins have the same name",
                where=f"{self.kind} {name!r}",
                got=" and ".join(map(_origin, (point, *others))),
                hint="uninstall one of them",
            )
        return point

    @property
    def _expected(self) -> str:
        return f"an object with {', '.join(self.methods)}"

    def _fits(self, given: object) -> bool:
        names = (method.partition("(")[0] for method in self.methods)
        return all(callable(getattr(given, name, None)) for name in names)


def packages() -> tuple[str, ...]:
    """Return the installed packages that register parts, in the order of their names."""
    ours = [group for group in entry_points().groups if group.startswith(_GROUPS)]
    points = chain.from_iterable(entry_points(group=group) for group in ours)
    return tuple(sorted({point.dist.name for point in points if point.dist is not None}))


def name_of(given: str | object) -> str:
    """Return the name that results have: an object's attribute ``name``, else that of its class."""
    if isinstance(given, str):
        return given
    name = getattr(given, "name", None)
    return name if isinstance(name, str) and name else type(given).__name__


@contextmanager
def calling(kind: type[ReconError], what: str, *, where: str) -> Iterator[None]:
    """Raise errors of code that is not ours as one of ours.

    Its ``sys.exit`` too: with 0 a command would end as if it had succeeded. What the user asks for
    (Ctrl-C), and a lack of memory, are no errors of that code.
    """
    try:
        yield
    except (ReconError, MemoryError):
        raise
    except (Exception, SystemExit) as error:
        got = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        raise kind(what, where=where, got=got) from error


def kind_of(found: Any) -> str:
    """Return what a value is that should have been another one."""
    shape = f" {found.dtype} {found.shape}" if hasattr(found, "dtype") else ""
    return f"{type(found).__name__}{shape}"


def _origin(point: EntryPoint) -> str:
    package = "" if point.dist is None else f" of package {point.dist.name}"
    return f"{point.value}{package}"
