"""The one error that reading a log raises."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager

import zstandard
from google.protobuf.message import DecodeError
from mcap.exceptions import McapError

from hiersched.core.faults import InputError

# What decoding bytes that are no such record can raise.
_DECODING_ERRORS = (
    McapError,
    DecodeError,
    ValueError,
    KeyError,
    IndexError,
    EOFError,
    OverflowError,
    MemoryError,
    struct.error,
    zstandard.ZstdError,
)


class LogError(InputError):
    """A file is not a log that can be trusted, or not one that holds what was asked for.

    It names `file`, `offset`, the byte at which the trouble lies, and `what` is wrong.
    """

    def __init__(self, file: str | os.PathLike[str], offset: int, what: str) -> None:
        super().__init__(file, offset, what)
        self.file = os.fspath(file)
        self.offset = offset
        self.what = what

    def __str__(self) -> str:
        return f"{self.file}: at byte {self.offset}: {self.what}"


@contextmanager
def reading(file: str | os.PathLike[str], offset: int, what: str) -> Iterator[None]:
    """Turn the many errors of decoders into a LogError."""
    try:
        yield
    except _DECODING_ERRORS as error:
        raise LogError(file, offset, f"{what} cannot be read: {error!r}") from error
