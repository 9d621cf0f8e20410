"""Faults of what users give: one message each, without a traceback, that terminals can show."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches
from typing import TextIO


class InputError(Exception):
    """A file or a value that a user gave is at fault: the message says what and what is allowed."""


@contextmanager
def blaming_input(
    kinds: type[Exception] | tuple[type[Exception], ...] = ValueError, prefix: str = ""
) -> Iterator[None]:
    """Turn errors of these kinds into an `InputError`."""
    try:
        yield
    except kinds as error:
        raise InputError(f"{prefix}{error}") from error


def did_you_mean(name: str, names: Iterable[str], cutoff: float = 0.6) -> str:
    """Ask, at the end of a message, for the one of some names that was probably meant, if any.

    What is asked for is what a mapping has under the name. A higher `cutoff`, up to 1, asks for
    more likeness.
    """
    found = get_close_matches(name, list(names), n=1, cutoff=cutoff)
    shown = names if isinstance(names, Mapping) else {}
    return f"; did you mean {shown.get(found[0], found[0])}?" if found else ""


def printable(text: str) -> str:
    """Escape what a terminal would act on: all control characters but new line and tab."""
    return "".join(
        c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in text
    )


class PrintableStream:
    """A stream that escapes, on their way to another one, what a terminal would act on.

    Also what the other stream's encoding does not have.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write text; returns how many characters it has."""
        encoding = self._stream.encoding or "utf-8"
        shown = printable(text).encode(encoding, "backslashreplace").decode(encoding)
        self._stream.write(shown)
        return len(text)

    def flush(self) -> None:
        """Flush the other stream."""
        self._stream.flush()
