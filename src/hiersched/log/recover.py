"""Gets back what a killed writer left, or what damage spared, as a log that can be trusted."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from hiersched.log import schema
from hiersched.log.errors import LogError
from hiersched.log.logfile import LogFile
from hiersched.log.reader import LogReader
from hiersched.log.schema import TOPICS_CRC
from hiersched.log.writer import LogWriter

_BLOCK_SLOTS = 4096


@dataclass(frozen=True)
class Recovery:
    """What `recover` did.

    `losses` say what could not be read or was left out, one line each: none if nothing is missing
    but what never reached the file.
    """

    path: Path  # of the new log
    spans: tuple[tuple[int, int], ...]  # first slot, and slot behind the last, of each stretch
    num_events: int
    losses: tuple[str, ...]

    @property
    def num_slots(self) -> int:
        """Slots in the new log."""
        return sum(stop - start for start, stop in self.spans)


def recovered_path(path: Path) -> Path:
    """Name of the recovered log: ``run.mcap`` and ``run.mcap.part`` give ``run.recovered.mcap``."""
    name = path.name.removesuffix(".part")
    return path.with_name(f"{Path(name).stem}.recovered.mcap")


def recover(path: str | os.PathLike[str], out: str | os.PathLike[str] | None = None) -> Recovery:
    """Write the slots of a damaged or unfinished log that are whole into a new log.

    A slot is whole when its message is there on every topic of the log. The log is not changed. The
    new one, at `out` or `recovered_path`, has the schema of the old one, with all fields, also
    those that this version does not know.

    Raises
    ------
    LogError
        If the file is no log, or its metadata or topics cannot be read.
    FileExistsError
        If `out` exists.
    """
    source = Path(path)
    if not source.name:
        raise LogError(source, 0, "there is no such file")
    target = recovered_path(source) if out is None else Path(out)
    for taken in (target, target.with_name(target.name + ".part")):
        if taken.exists():
            raise FileExistsError(f"{taken}: exists; recover never overwrites a file")
    file = LogFile(source)
    try:
        losses = _load(file)
        losses += _drop_unreadable(file)
        with LogReader.of(file) as log:
            losses += _drop_undecodable(log, file)
            return _rewrite(log, target, losses)
    finally:
        file.close()


def _load(file: LogFile) -> list[str]:
    """Read the summary or, without one, all records."""
    losses: list[LogError] = []
    try:
        file.load(whole=False)
    except LogError as complaint:
        losses = file.load_without_summary()
        if TOPICS_CRC not in file.metadata and not _are_own(file):
            what = "nothing vouches for its topics and fields: an earlier version wrote the log"
            losses.append(file.fail(0, what))
        if not any(topic.chunks for topic in file.topics.values()):
            losses.append(complaint)
    return [f"at byte {loss.offset}: {loss.what}" for loss in losses]


def _are_own(file: LogFile) -> bool:
    """Whether all topics are as this version describes them."""
    own = {schema.TOPICS[name].message: schema.descriptors() for name in schema.TOPICS}
    own[schema.EVENTS_SCHEMA] = schema.event_descriptors()
    topics = {name: topic.schema for name, topic in file.topics.items()}
    names = {t.message: name for name, t in schema.TOPICS.items()}
    return all(
        own.get(topic.message) == topic.descriptors
        and names.get(topic.message, schema.EVENTS_TOPIC) == name
        for name, topic in topics.items()
    )


def _drop_unreadable(file: LogFile) -> list[str]:
    """Forget chunks and attachments that are damaged, and say which."""
    losses = []
    for name, topic in file.topics.items():
        for chunk in list(topic.chunks):
            try:
                file.chunk_data(chunk)
            except LogError as error:
                topic.chunks.remove(chunk)
                losses.append(f"at byte {error.offset}: {name}: {error.what}{_span(file, chunk)}")
    for index in list(file.attachment_indexes):
        try:
            file.attachment(index)
        except LogError as error:
            file.attachment_indexes.remove(index)
            losses.append(f"at byte {error.offset}: attachment {index.name}: {error.what}")
    return losses


def _drop_undecodable(log: LogReader, file: LogFile) -> list[str]:
    """Forget chunks whose messages are not what their topic has, and say which."""
    losses = []
    for name in log.topics:
        chunks = file.topics[name].chunks
        for chunk in list(chunks):
            try:
                log.check_chunk(name, chunk)
            except LogError as error:
                chunks.remove(chunk)
                losses.append(f"at byte {error.offset}: {name}: {error.what}{_span(file, chunk)}")
    return losses


def _span(file: LogFile, chunk: ChunkIndex) -> str:
    first, last = (t // file.slot_ns for t in (chunk.message_start_time, chunk.message_end_time))
    return f" (slots {first} to {last})"


def _rewrite(log: LogReader, target: Path, losses: list[str]) -> Recovery:
    """Copy the whole slots, the events and the attachments."""
    slots = {topic: log.read(topic, [])["slot"] for topic in log.topics}
    whole = reduce(np.intersect1d, slots.values())
    for topic, present in slots.items():
        if len(present) > len(whole):
            losses.append(f"{topic}: {len(present) - len(whole)} slots that other topics lack")
    spans = _spans(whole)
    events = log.events()
    writer = LogWriter(
        target,
        log.dims,
        log.profile,
        {**log.metadata, "recovered_losses": "; ".join(losses)},
        log.attachments,
        slot_ns=log.slot_ns,
        like=log,
    )
    try:
        for start, stop in spans:
            for first in range(start, stop, _BLOCK_SLOTS):
                part = first, min(stop, first + _BLOCK_SLOTS)
                fields: dict[str, NDArray[Any]] = {}
                for topic in log.topics:
                    fields |= log.read(topic, None, *part)
                del fields["slot"]
                writer.write_block(first, fields)
        for event in events:
            writer.event(*event)
        writer.close()
    except BaseException:
        writer.abort()
        target.with_name(target.name + ".part").unlink(missing_ok=True)
        raise
    return Recovery(target, spans, len(events), tuple(losses))


def _spans(slots: NDArray[np.uint64]) -> tuple[tuple[int, int], ...]:
    """Cut ascending slots into stretches without a gap."""
    if not len(slots):
        return ()
    breaks = np.flatnonzero(np.diff(slots) != 1) + 1
    return tuple((int(part[0]), int(part[-1]) + 1) for part in np.split(slots, breaks))
