"""Topics of a log as files that other tools read."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from pathlib import Path

from hiersched.core.extras import naming_extras
from hiersched.core.files import refuse_existing, write_bytes
from hiersched.log import LogReader, topic_frame
from hiersched.log.frame import slot_span
from hiersched.log.schema import EVENTS_TOPIC

FORMS = ("csv", "parquet")


def export_tables(
    path: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    form: str,
    topics: Sequence[str] | None = None,
    start_s: float = 0.0,
    stop_s: float = math.inf,
    *,
    overwrite: bool = False,
) -> list[Path]:
    """Write topics as tables, ``queue.csv`` and so on, each file whole or not at all.

    The folder is made. `form` is ``csv``, of which every number reads back to the same bits, or
    ``parquet``. All topics are written unless given, events included, and of those the slots that
    start from `start_s` to before `stop_s` [s] of simulated time.

    Raises
    ------
    FileExistsError
        If one of the files is there already, unless told to `overwrite` it.
    LogError
        If the log is damaged or has no such topic.
    MissingExtraError
        If there is no pyarrow, which Parquet needs.
    ValueError
        On an unknown form, or a span that runs backwards.
    """
    if form not in FORMS:
        raise ValueError(f"form is {form!r}; allowed: {', '.join(FORMS)}")
    if form == "parquet":
        with naming_extras():
            import pyarrow  # noqa: F401
    written = []
    with LogReader(path) as log:
        files = {
            topic: Path(folder, f"{topic.removeprefix('/').replace('/', '_')}.{form}")
            for topic in topics or [*log.topics, EVENTS_TOPIC]
        }
        slot_span(log, start_s, stop_s)  # says what is wrong with the times, before anything else
        refuse_existing(*files.values(), overwrite=overwrite)
        for topic, file in files.items():
            table = topic_frame(log, topic, None, start_s, stop_s)
            if form == "parquet":
                data = table.to_parquet(index=False)
            else:
                # float32 as the shortest text that reads back to the same float32, as doubles are.
                data = table.to_csv(index=False).encode()
            written.append(write_bytes(file, data))
    return written


def export_for_viewers(
    path: str | os.PathLike[str], folder: str | os.PathLike[str], *, overwrite: bool = False
) -> list[Path]:
    """Write what Foxglove and other viewers open beside a log into a folder, which is made.

    ``viewer.mcap`` has poses, trails and images of the allocation, ``foxglove.json`` a layout for
    both files: of what the log has fields for. LogError if the log is damaged or has no
    slots; FileExistsError if one of the files is there already, unless told to `overwrite` it, or
    is the log.
    """
    from hiersched.replay.foxglove import foxglove_layout
    from hiersched.replay.panels import panels_of
    from hiersched.replay.viewer_topics import write_viewer_topics

    with LogReader(path) as log:
        layout = foxglove_layout(panels_of(log))
    topics, plan = Path(folder, "viewer.mcap"), Path(folder, "foxglove.json")
    refuse_existing(topics, plan, overwrite=overwrite, source=path)
    topics.parent.mkdir(parents=True, exist_ok=True)
    write_viewer_topics(path, topics)
    text = json.dumps(layout, indent=2) + "\n"
    return [topics, write_bytes(plan, text.encode())]
