"""Files that vouch for themselves: the first line has the SHA-256 of all bytes below it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from typing import Any


class SealError(ValueError):
    """A file does not hold what was written there: the message says what is wrong."""


def seal(data: bytes) -> bytes:
    """Put a line with the checksum before some bytes."""
    return f"sha256 {hashlib.sha256(data).hexdigest()}\n".encode() + data


def unseal(sealed: bytes) -> bytes:
    """Return the bytes below the line that `seal` put before them; SealError if they differ."""
    first, _, data = sealed.partition(b"\n")
    return _checked(first + b"\n", seal(data), data)


def seal_json(document: Mapping[str, Any], default: Callable[[Any], Any] | None = None) -> str:
    """Write a mapping, not empty, as JSON whose first line is the checksum of the others.

    A line a key. Floats are in their shortest form that reads back exactly; `default` makes JSON of
    what is none. ValueError if a number is not finite.
    """
    lines = (
        f"{json.dumps(key)}:"
        + json.dumps(value, allow_nan=False, default=default, separators=(",", ":"))
        for key, value in document.items()
    )
    return _with_checksum(",\n".join(lines) + "\n}\n")


def unseal_json(sealed: bytes) -> dict[str, Any]:
    """Return the mapping that `seal_json` wrote, without the checksum; SealError if it differs."""
    first, _, below = sealed.partition(b"\n")
    try:
        whole = _with_checksum(below.decode()).encode()
        document: dict[str, Any] = json.loads(_checked(first + b"\n", whole, sealed))
    except (ValueError, RecursionError) as error:  # of text, of JSON
        if isinstance(error, SealError):
            raise
        raise SealError(f"its content cannot be read: {error}") from error
    document.pop("sha256")
    return document


def _with_checksum(below: str) -> str:
    return f'{{"sha256": "{hashlib.sha256(below.encode()).hexdigest()}",\n{below}'


def _checked(first: bytes, wanted: bytes, data: bytes) -> bytes:
    if b"sha256" not in first or len(first) > 100:
        raise SealError("its first line is no checksum: it is another kind of file, or an old one")
    if not wanted.startswith(first):
        raise SealError("it does not match its checksum: it has been damaged, or edited")
    return data
