"""Writes a verified log again with all that its profile left out."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from hiersched.log import LogReader, LogWriter
from hiersched.replay.verify import Difference, verify
from hiersched.runs.logged import Batch, LoggedRun
from hiersched.runs.logging import log_dims
from hiersched.simulator import SlotRecord


def expand(run: LoggedRun, out: str | os.PathLike[str]) -> Difference | None:
    """Verify a log and write the same run in the profile ``full`` to `out`.

    Metadata and attachments stay as they are; of a full log this is a copy with the same digest.
    Weights that the log does not have are NaN in the new one, which has the schema of this version
    and so not the log's `unknown_fields`. Returns and raises as `verify`: there is no new log then.

    Raises
    ------
    FileExistsError
        If `out` exists.
    """
    path = Path(out)
    part = path.with_name(path.name + ".part")
    for taken in (path, part):
        if taken.exists():
            raise FileExistsError(f"{taken}: exists; expanding a log never overwrites a file")
    path.parent.mkdir(parents=True, exist_ok=True)
    scenario = run.scenario
    own = ("profile", "schema_version")
    writer = LogWriter(
        path,
        log_dims(scenario),
        "full",
        {key: text for key, text in run.metadata.items() if key not in own},
        run.attachments,
        slot_ns=round(scenario.radio.slot_s * 1e9),
        compression=scenario.log.compression,
        chunk_bytes=scenario.log.chunk_bytes,
    )

    def write(batch: Batch, record: SlotRecord) -> None:
        count = batch.num_envs * batch.num_slots
        fields = {
            name: np.ascontiguousarray(values).reshape(count, *values.shape[2:])
            for name, values in record._asdict().items()
        }
        writer.write_block(batch.first_slot, fields)

    try:
        difference = verify(run, write)
        if difference is None:
            with LogReader(run.path, verify="chunks") as log:
                for event in log.events():  # those that were computed, too
                    writer.event(*event)
            writer.close()
        return difference
    finally:
        writer.abort()  # nothing to do where it is closed
        part.unlink(missing_ok=True)
