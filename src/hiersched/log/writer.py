"""Writes the log of a run: blocks of slots in, ordinary MCAP files out."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from hiersched.core.model_fields import fields_from_text
from hiersched.log.events import Event
from hiersched.log.layout import as_raw
from hiersched.log.part import LogPart, PartSettings
from hiersched.log.schema import (
    MODEL_FIELDS,
    PROFILES,
    SCHEMA_VERSION,
    TOPICS,
    LogDims,
    proto_source,
)

COMPRESSIONS = ("zstd", "none")
MAX_CHUNK_BYTES = 1 << 28  # a viewer holds whole chunks in memory
MAX_SLOT = 1 << 32  # the sequence number of a message has 32 bits
_KNOWN_FIELDS = {field.name for topic in TOPICS.values() for field in topic.fields} - {"slot"}


class LogWriter:
    """Log of one run, written to ``<path>.part`` and renamed when it is complete.

    The bytes depend on the arguments alone: not on the clock, nor on how the slots were cut
    into blocks (but on the version of zstandard, if it compresses).

    Parameters
    ----------
    path
        The file to be; its folder must exist.
    dims
        Numbers of users and PRBs.
    profile
        ``full``, ``compact`` with what a study reads of a run, or ``decisions`` with those and sums
        alone; what the smaller ones leave out can be computed again.
    metadata
        Text about the run: scenario, seed, policy, stage and the like. The schema version, the
        dimensions, the profile and the slot length are added.
    attachments
        Name -> content; ``hiersched.proto`` is added.
    slot_ns
        Slot length [ns] of simulated time, the only clock in the file.
    compression
        ``zstd`` (level 3; topics of random numbers are stored all the same) or ``none``.
    chunk_bytes
        Size of a chunk before compression [bytes]; a chunk has at least one message.
    flush_slots
        After every so many slots all that is buffered goes to the operating system: so many slots
        at most are lost when the process is killed.
    max_bytes
        No file becomes larger than this [bytes]: ``run.mcap`` becomes ``run_000.mcap``,
        ``run_001.mcap`` and so on, complete files that carry their number as ``part`` in the
        metadata. None writes one file, of any size.

    Raises
    ------
    ValueError
        If an argument is none of the allowed.
    """

    def __init__(  # noqa: PLR0913  (what a file is, by keyword; a class of options would hide it)
        self,
        path: str | os.PathLike[str],
        dims: LogDims,
        profile: str = "full",
        metadata: Mapping[str, str] | None = None,
        attachments: Mapping[str, bytes] | None = None,
        *,
        slot_ns: int,
        compression: str = "zstd",
        chunk_bytes: int = 1 << 20,
        flush_slots: int = 1 << 12,
        max_bytes: int | None = None,
    ) -> None:
        _check_choice("profile", profile, PROFILES)
        _check_choice("compression", compression, COMPRESSIONS)
        _check_range("slot_ns", slot_ns, 1, 1 << 31)
        _check_range("chunk_bytes", chunk_bytes, 1, MAX_CHUNK_BYTES)
        _check_range("flush_slots", flush_slots, 1, MAX_SLOT)
        self.path = Path(path)
        self._max_bytes = max_bytes
        self._flush_slots = flush_slots
        self._unflushed = 0
        self._next_slot = 0
        self._finished: list[Path] = []
        files = dict(sorted({**(attachments or {}), "hiersched.proto": proto_source()}.items()))
        self._settings = PartSettings(
            dims=dims,
            profile=profile,
            slot_ns=slot_ns,
            compression=compression,
            chunk_bytes=chunk_bytes,
            attachments=files,
        )
        self._metadata = self._full_metadata(dims, metadata or {})
        self._part = self._open_part()
        if max_bytes is not None and self._part.most_bytes > max_bytes:
            least = self._part.most_bytes
            self._part.discard()
            raise ValueError(
                f"max_bytes is {max_bytes}; allowed: at least {least}, room for the attachments "
                f"and one chunk of each topic (smaller chunk_bytes, now {chunk_bytes}, need less)"
            )

    def _full_metadata(self, dims: LogDims, given: Mapping[str, str]) -> dict[str, str]:
        """Join the caller's metadata and our own."""
        own = {
            "schema_version": str(SCHEMA_VERSION),
            "slot_ns": str(self._settings.slot_ns),
            **{name: str(size) for name, size in asdict(dims).items()},
            "profile": self._settings.profile,
        }
        for key, value in given.items():
            if not isinstance(value, str):
                raise TypeError(f"metadata {key} is {value!r}; allowed: a string")
            if own.get(key, value) != value:
                raise ValueError(f"metadata {key} is {value!r}, but the log has {own[key]!r}")
        if dims.num_model_values:
            try:
                fields_from_text(given.get(MODEL_FIELDS, "[]"), dims.num_model_values)
            except ValueError as error:
                raise ValueError(f"metadata {MODEL_FIELDS}: {error}") from error
        else:
            del own["num_model_values"]  # so that logs without such models stay as they were
        return {**given, **own}

    def _open_part(self) -> LogPart:
        """Open the next file."""
        path, metadata = self.path, self._metadata
        if self._max_bytes is not None:
            number = len(self._finished)
            path = path.with_name(f"{path.stem}_{number:03d}{path.suffix}")
            metadata = {**metadata, "part": str(number)}
        return LogPart(path, self._settings, dict(sorted(metadata.items())))

    @property
    def profile(self) -> str:
        """One of `PROFILES`."""
        return self._settings.profile

    @property
    def paths(self) -> tuple[Path, ...]:
        """Files that are complete."""
        return tuple(self._finished)

    def write_block(self, first_slot: int, fields: Mapping[str, NDArray[Any]]) -> None:
        """Write consecutive slots.

        Parameters
        ----------
        first_slot
            Number of the first slot; after all slots written before.
        fields
            Name -> values, shape (T, ...) with the shape of `TOPICS` behind T. Fields that the
            profile does not contain may be there: they are left out.

        Raises
        ------
        TypeError
            If a type cannot become the logged one without a risk for its bits.
        ValueError
            If a field is missing or unknown, a shape is wrong, or slots run backwards. Nothing
            of the block is written then.
        """
        self._check_open()
        blocks, count = self._prepare(fields)
        if first_slot < self._next_slot or first_slot + count > MAX_SLOT:
            raise ValueError(
                f"slots {first_slot} to {first_slot + count - 1}; "
                f"allowed: {self._next_slot} to {MAX_SLOT - 1}"
            )
        done = 0
        while done < count:
            # All topics advance together, so that the order of chunks does not depend on blocks.
            step = min(count - done, self._part.free, self._flush_slots - self._unflushed)
            self._part.fill(first_slot, blocks, done, done + step)
            done += step
            self._next_slot = first_slot + done
            self._unflushed += step
            if self._unflushed == self._flush_slots:
                self.flush()
            self._rotate_if_full()

    def _rotate_if_full(self) -> None:
        """Go on in a new file when another chunk of each topic might be too much for this one."""
        if self._max_bytes is not None and self._part.most_bytes > self._max_bytes:
            self._finish_part()
            self._part = self._open_part()

    def _finish_part(self) -> None:
        self._unflushed = 0
        self._part.finish()
        self._finished.append(self._part.path)

    def _prepare(self, fields: Mapping[str, NDArray[Any]]) -> tuple[dict[str, NDArray[Any]], int]:
        """Check a block and turn its fields into arrays of raw bytes, shape (T,)."""
        layouts = [buffer.layout for buffer in self._part.buffers]
        expected = {name for layout in layouts for name in layout.values}
        unknown, missing = sorted(set(fields) - _KNOWN_FIELDS), sorted(expected - set(fields))
        if unknown or missing:
            raise ValueError(f"fields unknown to the log: {unknown}; fields missing: {missing}")
        count = np.shape(fields[next(iter(layouts[0].values))])[0]
        blocks = {}
        for layout in layouts:
            for name, (dtype, shape) in layout.values.items():
                values = np.asarray(fields[name])
                if values.shape != (count, *shape):
                    raise ValueError(f"{name} has shape {values.shape}; allowed: {(count, *shape)}")
                if values.dtype != dtype:
                    _check_lossless(name, values.dtype, dtype)
                    values = values.astype(dtype)
                blocks[name] = as_raw(values)
        return blocks, count

    def event(self, slot: int, level: str, name: str, message: str) -> None:
        """Log something that happens now and then.

        Parameters
        ----------
        slot
            Slot in which it happened.
        level
            DEBUG, INFO, WARNING, ERROR or FATAL.
        name
            Part of the system that speaks.
        message
            One line.
        """
        self._check_open()
        _check_range("slot", slot, 0, MAX_SLOT - 1)
        self._part.add_event(Event(slot, level, name, message))
        self._rotate_if_full()

    def flush(self) -> None:
        """Hand all that is buffered to the operating system: a killed process does not lose it."""
        self._check_open()
        self._part.flush()
        self._unflushed = 0

    def close(self) -> None:
        """Complete the file and give it its name."""
        self._check_open()
        self._finish_part()

    def abort(self) -> None:
        """Leave ``<path>.part`` behind, with every slot written so far but no summary."""
        if not self._part.closed:
            self._part.abort()

    def _check_open(self) -> None:
        if self._part.closed:
            raise ValueError(f"{self.path}: the log is closed")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if exc_type is not None:
            self.abort()
        elif not self._part.closed:
            self.close()


def _check_lossless(name: str, given: np.dtype[Any], wanted: np.dtype[Any]) -> None:
    """Refuse a conversion that can lose bits (NumPy calls int64 to float64 safe)."""
    wide_integer = given.kind in "iu" and given.itemsize == 8 and wanted.kind == "f"
    if wide_integer or not np.can_cast(given, wanted, "safe"):
        raise TypeError(
            f"{name} has type {given}; allowed: {wanted}, or what converts to it without loss"
        )


def _check_choice(name: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise ValueError(f"{name} is {value!r}; allowed: {', '.join(allowed)}")


def _check_range(name: str, value: int, least: int, most: int) -> None:
    if not least <= value <= most:
        raise ValueError(f"{name} is {value}; allowed: {least} to {most}")
