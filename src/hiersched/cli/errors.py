"""What ends a command with one message."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class InputError(Exception):
    """The input is at fault; the message says what and what is allowed."""


@contextmanager
def blaming_input(
    kinds: type[Exception] | tuple[type[Exception], ...] = ValueError, prefix: str = ""
) -> Iterator[None]:
    """Turn errors of these kinds into an `InputError`."""
    try:
        yield
    except kinds as error:
        raise InputError(f"{prefix}{error}") from error
