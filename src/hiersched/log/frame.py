"""Topics of a log as pandas tables: one row a slot, one column a number."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hiersched.core.extras import naming_extras
from hiersched.log.reader import LogReader
from hiersched.log.schema import EVENTS_TOPIC, MODELS_TOPIC

if TYPE_CHECKING:
    from pandas import DataFrame


def slot_span(log: LogReader, start_s: float, stop_s: float) -> tuple[int, int]:
    """Slots that start from `start_s` to before `stop_s` [s] of simulated time.

    Infinity is the end of the log. Returns the first slot and the one behind the last, as
    `LogReader.read` wants them; ValueError if the span runs backwards or starts before 0.
    """
    if not 0 <= start_s <= stop_s:
        raise ValueError(f"times {start_s:g} s to {stop_s:g} s; allowed: 0 <= start <= stop")
    # A nanosecond of tolerance: 0.07 s / 10 ms is 7.000000000000001 slots.
    start, stop = (
        1 << 32 if t * 1e9 > log.slot_ns * 2.0**32 else math.ceil((t * 1e9 - 1.0) / log.slot_ns)
        for t in (start_s, stop_s)
    )
    return max(start, 0), max(stop, 0)


def topic_frame(
    log: LogReader,
    topic: str,
    fields: Iterable[str] | None = None,
    start_s: float = 0.0,
    stop_s: float = math.inf,
) -> DataFrame:
    """Read a topic, or ``/events``, into a table.

    Parameters
    ----------
    fields
        Names of the fields; all of the topic by default. Those of ``/models`` are those of
        `LogReader.model_fields`. Events have no choice.
    start_s, stop_s
        Slots that start in this span of simulated time [s].

    Returns
    -------
    DataFrame
        ``slot`` (uint64), ``time_s`` (start of the slot), then ``backlog_packets[3]`` and
        ``fading_power[3,24]`` for the elements of arrays, in the types of the log; of ``/models``
        ``radio.fading/coherence[3]``. Events have ``level``, ``name`` and ``message``.

    Raises
    ------
    LogError
        If the log has no such topic or field, or is damaged.
    MissingExtraError
        If there is no pandas.
    ValueError
        If the span runs backwards.
    """
    with naming_extras():
        import pandas as pd

    start, stop = slot_span(log, start_s, stop_s)
    if topic == EVENTS_TOPIC:
        events = [event for event in log.events() if start <= event.slot < stop]
        table = pd.DataFrame(events, columns=["slot", "level", "name", "message"])
        table["slot"] = table["slot"].astype(np.uint64)
        table.insert(1, "time_s", _times(table["slot"].to_numpy(), log.slot_ns))
        return table
    if topic == MODELS_TOPIC:
        values = log.read_models(fields, start, stop)
    else:
        values = log.read(topic, fields, start, stop)
    columns: dict[str, NDArray[Any]] = {"slot": values.pop("slot")}
    columns["time_s"] = _times(columns["slot"], log.slot_ns)
    for name, array in values.items():
        columns.update(_flat(name, array))
    return pd.DataFrame(columns)


def _times(slots: NDArray[np.uint64], slot_ns: int) -> NDArray[np.float64]:
    return (slots * np.uint64(slot_ns)) / 1e9


def _flat(name: str, array: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Cut an array (T, ...) into columns (T,)."""
    if array.ndim == 1:
        return {name: array}
    return {
        f"{name}[{','.join(map(str, place))}]": array[(slice(None), *place)]
        for place in np.ndindex(*array.shape[1:])
    }
