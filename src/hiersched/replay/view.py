"""Logs in Rerun: a blueprint, and what is drawn beside the log."""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hiersched.core.colours import user_colours
from hiersched.core.extras import naming_extras
from hiersched.core.files import refuse_existing
from hiersched.log import LogReader
from hiersched.log.schema import TOPICS
from hiersched.replay.panels import TITLES, Panels, Plot, lines_of, panels_of
from hiersched.replay.viewer_topics import (
    FRAME,
    IMAGE_TOPIC,
    TRAIL_Z_M,
    read_tracks,
    track_topic,
    trail_topic,
    trails,
    write_viewer_topics,
)

APPLICATION = "hiersched"
TIMELINE = "message_log_time"
"""Simulated time from 0, as Rerun calls the log time of messages."""

_VIEW_RAD = math.radians(55.0)
"""Vertical field of view of Rerun's camera."""
_MARKS = {"pose": (1.0, 6.0, 1.2), "reference": (0.5, 3.5, 3.0), "set_point": (0.75, 4.5, 2.0)}
"""Of each track: share of the user's colour, the rest is grey; radii of point and trail [points]"""
_GREY = 40.0


def rerun_blueprint(panels: Panels) -> Any:
    """Lay out the views of Rerun: plots, the plane with the robots, the allocation, the events.

    Returns a `rerun.blueprint.Blueprint`, to be sent with the data. MissingExtraError without
    rerun-sdk.
    """
    with naming_extras():
        import rerun.blueprint as rrb

    rows = [[_time_series(plot, panels) for plot in row] for row in panels.rows]
    below = list(_views_below(panels))
    rows += [below] if below else []
    return rrb.Blueprint(
        rrb.Vertical(*(rrb.Horizontal(*row) for row in rows)),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def _views_below(panels: Panels) -> Iterator[Any]:
    """Yield the views below the plots."""
    import rerun.blueprint as rrb

    if panels.tracks:
        topics = [
            topic(robot, track)
            for robot in range(panels.dims.num_posed)
            for track in panels.tracks
            for topic in (track_topic, trail_topic)
        ]
        (x, y), (width, height) = panels.centre, panels.size
        distance = 1.2 * max(height, width / 1.6, 0.5) / (2 * math.tan(_VIEW_RAD / 2))
        yield rrb.Spatial3DView(
            name=TITLES["plane"],
            origin="/robots",
            contents=[f"+ {topic}" for topic in topics],
            spatial_information=rrb.SpatialInformation(target_frame=FRAME),
            eye_controls=rrb.EyeControls3D(
                position=(x, y, distance), look_target=(x, y, 0.0), eye_up=(0.0, 1.0, 0.0)
            ),
        )
    if panels.has_image:
        yield rrb.Spatial2DView(name=TITLES["image"], origin=IMAGE_TOPIC)
    if panels.has_events:
        yield rrb.TextLogView(name=TITLES["events"], origin="/events")


def _time_series(plot: Plot, panels: Panels) -> Any:
    """Plot fields of a topic's message."""
    import rerun as rr
    import rerun.blueprint as rrb
    from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

    lines = lines_of(plot, panels.dims)
    visualizers = []
    for field in plot.fields:
        own = [line for line in lines if line.field == field]
        mapping = VisualizerComponentMapping(
            target="Scalars:scalars",
            source_kind=ComponentSourceKind.SourceComponent,
            source_component=f"{TOPICS[plot.topic].message}:message",
            selector=f".{field}" if own[0].place is None else f".{field}[]",
        )
        look = rr.SeriesLines(names=[x.name for x in own], colors=[x.colour for x in own])
        visualizers.append(look.visualizer(mappings=[mapping]))
    return rrb.TimeSeriesView(
        name=plot.heading,
        origin=plot.topic,
        contents=[f"+ {plot.topic}"],
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        plot_legend=rrb.PlotLegend("LeftTop", visible=panels.has_legend(plot)),
        overrides={plot.topic: visualizers},
    )


def show_in_rerun(
    path: str | os.PathLike[str],
    save: str | os.PathLike[str] | None = None,
    *,
    overwrite: bool = False,
) -> Panels:
    """Open a log in Rerun, with the poses, trails and images that the log does not have.

    With `save` a recording (``.rrd``) that opens with the same views is written instead, in full or
    not at all. Time begins at 0. What the log has no fields for is left out; returns what is shown.

    Raises
    ------
    FileExistsError
        If the recording is there already, unless told to `overwrite` it, or is the log.
    LogError
        If the log is damaged or has no slots.
    MissingExtraError
        Without rerun-sdk.
    """
    if save is not None:
        refuse_existing(save, overwrite=overwrite, source=path)
    with naming_extras():
        import rerun as rr

    with LogReader(path) as log:
        panels = panels_of(log)
    recording = rr.RecordingStream(APPLICATION)
    if save is None:
        recording.spawn(default_blueprint=rerun_blueprint(panels))
        _send(recording, path)
        return panels
    part = Path(f"{os.fspath(save)}.part")
    try:
        recording.save(part, default_blueprint=rerun_blueprint(panels))
        _send(recording, path)
        os.replace(part, save)
    finally:
        part.unlink(missing_ok=True)
    return panels


def _send(recording: Any, path: str | os.PathLike[str]) -> None:
    """Send a log, and what is drawn beside it, to the end."""
    from rerun.chunk import McapReader

    try:
        with tempfile.TemporaryDirectory() as folder:
            viewer = Path(folder, "viewer.mcap")
            write_viewer_topics(path, viewer)
            for file in (path, viewer):
                reader = McapReader(file, timeline_type="duration", exclude_topic_regex=["_trail$"])
                recording.send_chunks(reader.stream())
        with LogReader(path) as log:
            _draw_robots(recording, log)
        recording.flush()
    finally:
        recording.disconnect()


def _draw_robots(recording: Any, log: LogReader) -> None:
    """Give every pose a mark to be drawn with, and every track its trails, as lines.

    All of a robot have its user's colour: it the colour itself, reference and set-point paler.
    """
    import rerun as rr

    colours = user_colours(log.dims.num_urllc, log.dims.num_embb)
    tracks = read_tracks(log)
    times = log.read("/robots", [])["slot"] * log.slot_ns if tracks else np.empty(0, np.uint64)
    for name, track in tracks.items():
        share, radius, width = _MARKS[name]
        found = list(trails(track, log.slot_ns * 1e-9))
        ends = times[[index for index, _ in found]].astype("timedelta64[ns]")
        time = rr.TimeColumn(TIMELINE, duration=ends)
        for robot in range(track.shape[1]):
            colour = np.round(share * colours[robot] + (1.0 - share) * _GREY).astype(int).tolist()
            mark = rr.Points3D(
                [[0.0, 0.0, 0.0]],
                colors=[colour],
                radii=rr.Radius.ui_points(radius),
                labels=f"robot {robot}",
                show_labels=name == "pose",
            )
            recording.log(track_topic(robot, name), mark, static=True)
            strips = [
                np.insert(trail[:, robot, :2], 2, TRAIL_Z_M[name], axis=1) for _, trail in found
            ]
            entity = trail_topic(robot, name)
            look = rr.LineStrips3D.from_fields(colors=[colour], radii=rr.Radius.ui_points(width))
            recording.log(entity, look, rr.CoordinateFrame(FRAME), static=True)
            recording.send_columns(entity, [time], rr.LineStrips3D.columns(strips=strips))
