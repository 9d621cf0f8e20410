"""What is on disk while a log is being written."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from mcap.exceptions import EndOfFile
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader

from hiersched.log import LogDims, LogWriter
from hiersched.log.schema import topics_in

SLOT_NS = 10_000_000
FLUSH = 50

KILLED = """
import sys, time
import numpy as np
from hiersched.log import LogDims, LogWriter
from hiersched.log.schema import topics_in

dims = LogDims(num_urllc=3, num_embb=2, num_prb=7)
log = LogWriter(sys.argv[1], dims, slot_ns=10_000_000, flush_slots=50)
slot = 0
while True:
    fields = {
        field.name: np.full((1, *field.sized(dims.sizes)), slot, field.dtype)
        for topic in topics_in("full").values() for field in topic.fields_in("full")
    }
    log.write_block(slot, fields)
    log.event(slot, "INFO", "run", f"slot {slot}")
    print(slot, flush=True)
    slot += 1
"""


def slots_on_disk(path: Path) -> dict[int, int]:
    """Messages in the chunks that are complete, by channel."""
    counts: dict[int, int] = dict.fromkeys(range(1, 8), 0)
    with path.open("rb") as stream, contextlib.suppress(EndOfFile):
        for record in StreamReader(stream).records:
            if isinstance(record, Message):
                counts[record.channel_id] += 1
    return counts


def test_a_killed_process_loses_one_flush_interval_at_most(tmp_path: Path) -> None:
    part = tmp_path / "a.mcap.part"
    with subprocess.Popen(
        [sys.executable, "-c", KILLED, str(tmp_path / "a.mcap")], stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        for _ in range(3 * FLUSH + 20):
            last = int(process.stdout.readline())
        process.send_signal(signal.SIGKILL)
        rest = process.stdout.read().split()
        process.wait()
    last = int(rest[-1]) if rest else last
    assert process.returncode == -signal.SIGKILL
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap.part"]
    for count in slots_on_disk(part).values():
        assert last + 1 - FLUSH <= count <= last + 2


def test_flush_writes_what_there_is(tmp_path: Path, random_fields: Any, dims: LogDims) -> None:
    with LogWriter(tmp_path / "a.mcap", dims, slot_ns=SLOT_NS) as log:
        log.write_block(0, random_fields(9))
        log.event(3, "INFO", "run", "text")
        assert set(slots_on_disk(tmp_path / "a.mcap.part").values()) == {0}
        log.flush()
        assert [*slots_on_disk(tmp_path / "a.mcap.part").values()] == [
            *[9] * len(topics_in("full")),
            1,
        ]


def test_chunks_end_at_flushes_however_blocks_are_cut(
    tmp_path: Path, random_fields: Any, write_log: Any
) -> None:
    fields = random_fields(100)
    contents = {
        write_log(tmp_path / "a.mcap", fields, block=block, flush_slots=7).read_bytes()
        for block in (1, 13, 100)
    }
    assert len(contents) == 1
    assert write_log(tmp_path / "a.mcap", fields, flush_slots=8).read_bytes() not in contents


def test_random_topics_are_stored_and_the_others_compressed(
    tmp_path: Path, random_fields: Any, write_log: Any
) -> None:
    path = write_log(tmp_path / "a.mcap", random_fields(100))
    with path.open("rb") as stream:
        chunks = [r for r in StreamReader(stream, emit_chunks=True).records if isinstance(r, Chunk)]
    topics = [*topics_in("full"), "/events"]
    channels = [int.from_bytes(c.data[9:11], "little") for c in chunks if c.compression == ""]
    assert {topics[channel - 1] for channel in channels} == {"/channel", "/world"}
    assert {c.compression for c in chunks} == {"", "zstd"}
