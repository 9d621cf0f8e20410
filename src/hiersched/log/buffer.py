"""Collects the messages of one topic until they fill a chunk."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiersched.log.container import INDEX_ENTRY_BYTES, Container
from hiersched.log.layout import RecordLayout, raw_columns


class TopicBuffer:
    """Message records of one topic on their way into a chunk.

    Parameters
    ----------
    layout
        How the records lie.
    slot_ns
        Slot length [ns].
    chunk_bytes
        Room for records [bytes]; there is room for one in any case.
    channel_id
        MCAP channel id of the topic.
    stored
        Whether its chunks are never compressed.
    """

    def __init__(
        self,
        layout: RecordLayout,
        slot_ns: int,
        chunk_bytes: int,
        channel_id: int,
        *,
        stored: bool,
    ) -> None:
        self.layout = layout
        self._slot_ns = slot_ns
        self._channel_id = channel_id
        self._stored = stored
        self._rows = np.repeat(layout.template, max(1, chunk_bytes // layout.dtype.itemsize))
        self._columns = raw_columns(self._rows, layout)
        self._offsets = np.arange(len(self._rows), dtype=np.uint64) * layout.dtype.itemsize
        self._used = 0

    @property
    def free(self) -> int:
        """Slots that still fit."""
        return len(self._rows) - self._used

    @property
    def capacity_bytes(self) -> int:
        """Bytes of a full chunk's messages and their index entries, uncompressed."""
        return len(self._rows) * (self.layout.dtype.itemsize + INDEX_ENTRY_BYTES)

    def fill(
        self, first_slot: int, blocks: Mapping[str, NDArray[Any]], start: int, stop: int
    ) -> None:
        """Take slots of a block; there has to be room for them.

        Parameters
        ----------
        first_slot
            Number of the block's first slot.
        blocks
            Name -> raw bytes of each slot (`as_raw`), shape (T,).
        start, stop
            The slots to take, counted from the start of the block.
        """
        rows = slice(self._used, self._used + stop - start)
        slots = np.arange(first_slot + start, first_slot + stop, dtype=np.uint64)
        times = slots * np.uint64(self._slot_ns)
        self._rows["sequence"][rows] = slots
        self._rows["slot"][rows] = slots
        self._rows["log_time"][rows] = times
        self._rows["publish_time"][rows] = times
        for name, column in self._columns.items():
            column[rows] = blocks[name][start:stop]
        self._used += stop - start

    def flush(self, container: Container) -> None:
        """Write what there is as a chunk."""
        if self._used:
            rows = self._rows[: self._used]
            container.add_chunk(
                self._channel_id,
                rows.view(np.uint8).data,
                rows["log_time"].astype(np.uint64),
                self._offsets[: self._used],
                stored=self._stored,
            )
            self._used = 0
