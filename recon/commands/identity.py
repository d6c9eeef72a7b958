"""What a run was started with: where it is unchanged, a resumed run gives the same result."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from recon.commands.config import ReconConfig
from recon.core.errors import FormatError, OutputError, ReconError, SettingsError
from recon.core.values import Trajectory
from recon.map.drive.workspace import ANEW
from recon.map.verbs import Map
from recon.run.directory import RECORD, STARTED, state_folder
from recon.run.fingerprint import fingerprint
from recon.run.machine import versions
from recon.sources.source import StereoSource

_OTHER: Final = {
    "config": "other settings",
    "source": "another source",
    "poses": "other poses",
    "prior": "another prior",
    "versions": "other versions",
}
_HEAD_BYTES: Final = 4096
_MEMORY: Final = "memory"
"""The group of settings that a resumed run may change."""


def identity_of(
    source: StereoSource,
    config: ReconConfig,
    known_poses: Trajectory | None,
    prior: Trajectory | None = None,
) -> dict[str, Any]:
    """Return everything that must be unchanged, as plain values."""
    return {
        "config": config.model_dump(mode="json"),
        "source": {"frames": len(source), **fingerprint(source.files, head_bytes=_HEAD_BYTES)},
        "poses": _digest(known_poses),
        "prior": _digest(prior),
        "versions": versions(),
    }


def read_started(folder: Path) -> dict[str, Any]:
    """Read what an unfinished run was started with: its ``identity`` and ``arguments``."""
    path = state_folder(folder) / STARTED
    try:
        with Map.open(path) as map_:
            return _checked(map_.session().info.start)
    except (ReconError, LookupError, TypeError) as error:
        if path.is_file():
            raise FormatError(
                "the unfinished map cannot be read", where=path, got=error, hint=ANEW
            ) from error
        finished = "it is finished; without --resume it runs again"
        hint = finished if (folder / RECORD).is_file() else "start it without --resume"
        raise OutputError(
            "there is no unfinished run to resume", where=folder, hint=hint
        ) from error


def _checked(started: Any) -> dict[str, Any]:
    """Check that it has the form that `begin_or_resume` writes."""
    parts = (started["identity"], started["identity"]["config"], started["arguments"])
    plain = all(isinstance(part, dict) for part in parts)
    if not plain or not all(isinstance(v, str | bool | None) for v in parts[-1].values()):
        raise TypeError("not what a run is started with")
    return {"identity": parts[0], "arguments": parts[-1]}


def refuse_others(now: Mapping[str, Any], then: Mapping[str, Any], folder: Path) -> None:
    """Refuse to resume with inputs or settings that differ.

    Args:
        now: What a run is to be resumed with; parts of an identity.
        then: The identity that it was started with.
        folder: Folder of the run.
    """
    # Through JSON, like the stored values, so that tuples equal lists.
    for part, value in json.loads(json.dumps(dict(now))).items():
        after, before = _without_limit(value), _without_limit(then.get(part))
        if after == before:
            continue
        key, got, expected = _first_difference(after, before, part)
        raise SettingsError(
            f"the run was started with {_OTHER[part]}",
            where=folder,
            got=f"{key} = {got}",
            expected=expected,
            hint="resume with what it was started with, or start anew without --resume",
        )


def _digest(path: Trajectory | None) -> str | None:
    """Return SHA-256 of the poses and timestamps; None = no trajectory."""
    if path is None:
        return None
    return hashlib.sha256(path.T_world_camera.tobytes() + path.timestamps_s.tobytes()).hexdigest()


def _without_limit(part: Any) -> Any:
    if not isinstance(part, dict):
        return part
    return {name: value for name, value in part.items() if name != _MEMORY}


def _first_difference(now: Any, then: Any, key: str) -> tuple[str, Any, Any]:
    """Return the dotted key and the two values of the first leaf that differs."""
    if isinstance(now, dict) and isinstance(then, dict):
        for name in [*now, *(then.keys() - now.keys())]:
            if now.get(name) != then.get(name):
                return _first_difference(now.get(name), then.get(name), f"{key}.{name}")
    return key, now, then
