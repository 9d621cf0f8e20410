"""Topics of a log as files that other tools read."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hiersched.core.extras import naming_extras
from hiersched.log import LogReader, topic_frame
from hiersched.log.schema import EVENTS_TOPIC

if TYPE_CHECKING:
    from pandas import DataFrame

FORMS = ("csv", "parquet")


def export_tables(
    path: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    form: str,
    topics: Sequence[str] | None = None,
    start_s: float = 0.0,
    stop_s: float = math.inf,
) -> list[Path]:
    """Write topics as tables, each file whole or not at all.

    Parameters
    ----------
    path
        The log.
    folder
        Where ``queue.csv`` and so on go; it is made.
    form
        ``csv``, of which every number reads back to the same bits, or ``parquet``.
    topics
        Topics to write; all, events included, by default.
    start_s, stop_s
        Slots that start in this span of simulated time [s].

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    LogError
        If the log is damaged or has no such topic.
    ImportError
        If there is no pyarrow, which Parquet needs.
    ValueError
        On an unknown form, or a span that runs backwards.
    """
    if form not in FORMS:
        raise ValueError(f"form is {form!r}; allowed: {', '.join(FORMS)}")
    if form == "parquet":
        _need_pyarrow()
    written = []
    with LogReader(path) as log:
        tables = topics or [*log.topics, EVENTS_TOPIC]
        for topic in tables:
            table = topic_frame(log, topic, None, start_s, stop_s)
            Path(folder).mkdir(parents=True, exist_ok=True)
            file = Path(folder, f"{topic.removeprefix('/')}.{form}")
            part = file.with_name(file.name + ".part")
            _write(table, part, form)
            os.replace(part, file)
            written.append(file)
    return written


def export_for_viewers(path: str | os.PathLike[str], folder: str | os.PathLike[str]) -> list[Path]:
    """Write what Foxglove and other viewers open beside a log.

    Parameters
    ----------
    path
        The log.
    folder
        Where ``viewer.mcap`` (poses, images of the allocation) and ``foxglove.json`` (a layout
        for both files) go; it is made.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    LogError
        If the log is damaged.
    """
    from hiersched.replay.view import foxglove_layout
    from hiersched.replay.viewer_topics import write_viewer_topics

    with LogReader(path) as log:
        layout = foxglove_layout(log.dims)
    Path(folder).mkdir(parents=True, exist_ok=True)
    topics, panels = Path(folder, "viewer.mcap"), Path(folder, "foxglove.json")
    write_viewer_topics(path, topics)
    part = panels.with_name(panels.name + ".part")
    part.write_text(json.dumps(layout, indent=2) + "\n", encoding="utf-8")
    os.replace(part, panels)
    return [topics, panels]


def _need_pyarrow() -> None:
    with naming_extras():
        import pyarrow  # noqa: F401


def _write(table: DataFrame, part: Path, form: str) -> None:
    if form == "parquet":
        table.to_parquet(part, index=False)
    else:
        # float32 as the shortest text that reads back to the same float32, as doubles are.
        table.to_csv(part, index=False)
