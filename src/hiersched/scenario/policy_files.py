"""Entries of `policies` that name files: where these lie, and what is left to `learning`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hiersched.policies.files import CONVENTIONS, FILE_POLICIES, PolicyFileError, note_file

Sources = Sequence[tuple[Path, Mapping[str, Any]]]
"""Files of a scenario, the one that stands over the others first, and what each holds."""


def with_policy_files(merged: Mapping[str, Any], sources: Sources) -> dict[str, Any]:
    """Put the hashes of policies' files into a scenario, and what `learning` says of their actions.

    A file is looked for beside the one that names it, then beside the others and, for a resolved
    scenario, in the working directory. PolicyFileError if it is not there, or its hash is another
    than the scenario's.
    """
    policies, learning = merged.get("policies"), merged.get("learning")
    if not isinstance(policies, Mapping) or not isinstance(learning, Mapping):
        return dict(merged)  # validation says what is wrong
    left = {key: learning[there] for key, there in CONVENTIONS.items() if there in learning}
    whole = dict(policies)
    for name, entry in policies.items():
        kinds = [kind for key, kind in FILE_POLICIES.items() if _holds(entry, key)]
        for kind in kinds[:1]:
            named = [key for key in kind.file_keys if isinstance(entry.get(key), str)]
            hashes = {f"{key}_sha256": _sha256(name, key, entry, sources) for key in named}
            whole[name] = {**left, **entry, **hashes}
    return {**merged, "policies": whole}


def _holds(entry: Any, key: str) -> bool:
    return isinstance(entry, Mapping) and key in entry


def _sha256(policy: str, key: str, entry: Mapping[str, Any], sources: Sources) -> str:
    """Hash a file of an entry, and remember where it lies."""
    written_in = [
        file
        for file, data in sources
        if _holds(data.get("policies"), policy) and _holds(data["policies"][policy], key)
    ]
    files = dict.fromkeys((*written_in, *(file for file, _ in sources)))
    places = [folder / entry[key] for folder in (*(file.parent for file in files), Path())]
    where = f"{next(iter(files))}: policies.{policy}.{key} = {entry[key]!r}"
    try:
        found = next((path for path in places if path.is_file()), places[0])
        sha256 = note_file(found)
    except (OSError, ValueError) as error:
        raise PolicyFileError(f"{where}: cannot be read: {error}") from error
    written = entry.get(f"{key}_sha256", sha256)
    if written != sha256:
        raise PolicyFileError(
            f"{where}: the SHA-256 of {found} is {sha256}: must be {key}_sha256 = {written!r} (or "
            "leave that key out)"
        )
    return sha256
