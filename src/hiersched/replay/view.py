"""Logs in viewers: a blueprint for Rerun, a layout for Foxglove."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hiersched.core.colours import user_colours
from hiersched.log import LogDims, LogReader
from hiersched.log.schema import TOPICS
from hiersched.replay.viewer_topics import (
    FRAME,
    IMAGE_TOPIC,
    pose_topics,
    write_viewer_topics,
)

APPLICATION = "hiersched"


class Plot(NamedTuple):
    """A plot over time of one field: a line for each user, or for each robot."""

    title: str
    topic: str
    field: str


PLOTS = (
    Plot("Queue [packets]", "/queue", "backlog_packets"),
    Plot("Wait of the oldest packet [s]", "/delay", "hol_delay_s"),
    Plot("Late packets in the slot", "/delay", "late_packets"),
    Plot("Packets superseded in the slot", "/queue", "superseded_packets"),
    Plot("Network delay [samples]", "/robots", "delay_steps"),
    Plot("Gain in force [samples]", "/robots", "gain_delay_steps"),
    Plot("Age of the set-point in force [s]", "/robots", "set_point_age_s"),
    Plot("Tracking error [m]", "/robots", "tracking_error_m"),
)


def series_names(plot: Plot, dims: LogDims) -> list[str]:
    """Names of a plot's lines."""
    field = next(f for f in TOPICS[plot.topic].fields if f.name == plot.field)
    if field.shape == ("R",):
        return [f"robot {i}" for i in range(dims.num_urllc)]
    urllc, embb = dims.num_urllc, dims.num_embb
    return [f"URLLC {i}" for i in range(urllc)] + [f"eMBB {urllc + i}" for i in range(embb)]


def rerun_blueprint(dims: LogDims) -> Any:
    """Lay out the views of Rerun: plots, the plane with the robots, the allocation, the events.

    Returns a `rerun.blueprint.Blueprint`, to be sent with the data; ImportError without rerun-sdk.
    """
    import rerun.blueprint as rrb

    plots = [_time_series(plot, dims) for plot in PLOTS]
    scene = rrb.Spatial3DView(
        name="Robots and references",
        origin="/robots",
        contents=[f"+ {topic}" for pair in pose_topics(dims.num_posed) for topic in pair],
        spatial_information=rrb.SpatialInformation(target_frame=FRAME),
    )
    image = rrb.Spatial2DView(name="PRBs by owner: last 100 slots", origin=IMAGE_TOPIC)
    events = rrb.TextLogView(name="Events", origin="/events")
    rows = rrb.Grid(*plots, grid_columns=4), rrb.Horizontal(scene, image, events)
    return rrb.Blueprint(
        rrb.Vertical(*rows, row_shares=[2, 1]),
        rrb.TimePanel(timeline="message_log_time", state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def _time_series(plot: Plot, dims: LogDims) -> Any:
    """Plot one field of a topic's message."""
    import rerun as rr
    import rerun.blueprint as rrb
    from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

    mapping = VisualizerComponentMapping(
        target="Scalars:scalars",
        source_kind=ComponentSourceKind.SourceComponent,
        source_component=f"{TOPICS[plot.topic].message}:message",
        selector=f".{plot.field}[]",
    )
    lines = rr.SeriesLines(names=series_names(plot, dims))
    return rrb.TimeSeriesView(
        name=plot.title,
        origin=plot.topic,
        contents=[f"+ {plot.topic}"],
        overrides={plot.topic: lines.visualizer(mappings=[mapping])},
    )


def show_in_rerun(path: str | os.PathLike[str], save: str | os.PathLike[str] | None = None) -> None:
    """Open a log in Rerun, with the poses and images that the log does not have.

    With `save` a recording (``.rrd``) that opens with the same views is written instead.
    ImportError without rerun-sdk, LogError if the log is damaged.
    """
    import rerun as rr
    from rerun.chunk import McapReader

    with LogReader(path) as log:
        dims = log.dims
    recording = rr.RecordingStream(APPLICATION)
    part = None if save is None else Path(f"{os.fspath(save)}.part")
    if part is None:
        recording.spawn(default_blueprint=rerun_blueprint(dims))
    else:
        recording.save(part, default_blueprint=rerun_blueprint(dims))
    with tempfile.TemporaryDirectory() as folder:
        viewer = Path(folder, "viewer.mcap")
        write_viewer_topics(path, viewer)
        for file in (path, viewer):
            recording.send_chunks(McapReader(file).stream())
    _mark_robots(recording, dims)
    recording.flush()
    recording.disconnect()
    if part is not None:
        os.replace(part, os.fspath(save or ""))


def _mark_robots(recording: Any, dims: LogDims) -> None:
    """Give every pose a mark to be drawn with.

    Robots have their user's colour, references are grey, set-points in force black.
    """
    import rerun as rr

    colours = user_colours(dims.num_urllc, dims.num_embb)
    for robot, topics in enumerate(pose_topics(dims.num_posed)):
        marks = (colours[robot], 0.2), (160, 0.1), (0, 0.05)
        for topic, (colour, radius) in zip(topics, marks, strict=True):
            recording.log(
                topic,
                rr.Points3D([[0.0, 0.0, 0.0]], colors=[[*np.broadcast_to(colour, 3)]], radii=radius,
                            labels=f"robot {robot}", show_labels=radius > 0.1),
                static=True,
            )  # fmt: skip


def foxglove_layout(dims: LogDims) -> dict[str, Any]:
    """Lay out the panels of Foxglove (and Lichtblick): the views of Rerun, as JSON to import."""
    configs: dict[str, Any] = {}
    line = {"enabled": True, "timestampMethod": "receiveTime"}
    for number, plot in enumerate(PLOTS):
        paths = [
            {"value": f"{plot.topic}.{plot.field}[{i}]", "label": name, **line}
            for i, name in enumerate(series_names(plot, dims))
        ]
        panel = {"title": plot.title, "paths": paths, "showLegend": False, "isSynced": True}
        configs[f"Plot!{number}"] = panel
    topics = [topic for pair in pose_topics(dims.num_posed) for topic in pair]
    configs["3D!0"] = {"topics": {topic: {"visible": True} for topic in topics}}
    configs["Image!0"] = {"imageMode": {"imageTopic": IMAGE_TOPIC}}
    configs["RosOut!0"] = {"topicToRender": "/events"}
    rows = _stack(
        [_stack([f"Plot!{i}" for i in row], "row") for row in ((0, 1, 2, 3), (4, 5, 6, 7))]
    )
    below = _stack(["3D!0", "Image!0", "RosOut!0"], "row")
    return {
        "configById": configs,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _stack([rows, below]),
    }


def _stack(parts: list[Any], direction: str = "column") -> Any:
    """Share the space evenly among panels, as a tree of pairs."""
    if len(parts) == 1:
        return parts[0]
    return {
        "first": parts[0],
        "second": _stack(parts[1:], direction),
        "direction": direction,
        "splitPercentage": 100.0 / len(parts),
    }
