"""What viewers show of a log: the plots for which it has the fields, lines in users' colours."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiersched.core.colours import user_colours
from hiersched.log import LogDims, LogError, LogReader
from hiersched.log.schema import TOPICS
from hiersched.replay.viewer_topics import TRACKS, has_owners, read_tracks

Colour = tuple[int, int, int]

SLICE_COLOURS: tuple[Colour, Colour] = ((240, 150, 40), (70, 150, 240))
"""Of URLLC and eMBB, where a line is of a whole slice."""


class Plot(NamedTuple):
    """A plot over time: a line for each user or robot of a field, or of each field a slice."""

    title: str
    topic: str
    fields: tuple[str, ...]
    if_any: bool = False  # only where the log has a number that is not 0


class Line(NamedTuple):
    """A line of a plot."""

    field: str
    place: int | None  # among the numbers of the field; None if it has one
    name: str
    colour: Colour


PLOTS = (
    Plot("Queue [packets]", "/queue", ("backlog_packets",)),
    Plot("Mean queue [packets]", "/delay", ("backlog_urllc_packets", "backlog_embb_packets")),
    Plot("Wait of the oldest packet [s]", "/delay", ("hol_delay_s",)),
    Plot("Late packets [per slot]", "/delay", ("late_packets",)),
    Plot("Late packets [per slot]", "/delay", ("late_urllc_packets", "late_embb_packets")),
    Plot("Superseded packets [per slot]", "/queue", ("superseded_packets",), if_any=True),
    Plot("Network delay in force [samples]", "/robots", ("delay_steps",)),
    Plot("Gain in force [samples]", "/robots", ("gain_delay_steps",)),
    Plot("Age of the set-point in force [s]", "/robots", ("set_point_age_s",), if_any=True),
    Plot("Saturated control [samples per slot]", "/robots", ("control_saturated",), if_any=True),
    Plot("Tracking error [m]", "/robots", ("tracking_error_m",)),
    Plot("Multiplier λ [1]", "/delay", ("multiplier",), if_any=True),
    Plot("Reward [1]", "/delay", ("reward_urllc", "reward_embb")),
)


def lines_of(plot: Plot, dims: LogDims) -> list[Line]:
    """Lines of a plot: a user, and its robot, has the same colour in every one."""
    fields = {field.name: field for field in TOPICS[plot.topic].fields}
    if not fields[plot.fields[0]].shape:
        slices = zip(plot.fields, ("URLLC", "eMBB"), SLICE_COLOURS, strict=True)
        return [Line(name, None, text, colour) for name, text, colour in slices]
    ((name, shape),) = ((name, fields[name].shape) for name in plot.fields)
    urllc, embb = dims.num_urllc, dims.num_embb
    names = [f"URLLC {i}" for i in range(urllc)] + [f"eMBB {urllc + i}" for i in range(embb)]
    if shape == ("R",):
        names = [f"robot {i}" for i in range(urllc)]
    colours = [(int(r), int(g), int(b)) for r, g, b in user_colours(urllc, embb)]
    return [Line(name, i, text, colours[i]) for i, text in enumerate(names)]


TITLES = {
    "plane": "Robots, references pale [grid: 1 m]",
    "image": "Owner of each PRB (down), last 100 slots",
    "events": "Events",
}
"""Titles of the panels that are no plots."""


class Panels(NamedTuple):
    """What a log has for viewers.

    `tracks` are those of `TRACKS` that can be drawn; `centre` and `size` [m] are of the part of the
    plane in which they lie.
    """

    dims: LogDims
    plots: tuple[Plot, ...]
    tracks: tuple[str, ...]
    centre: tuple[float, float]
    size: tuple[float, float]
    has_image: bool
    has_events: bool

    @property
    def rows(self) -> list[tuple[Plot, ...]]:
        """The plots row by row: one row of up to three, else two."""
        width = len(self.plots) if len(self.plots) <= 3 else (len(self.plots) + 1) // 2
        return (
            [self.plots[i : i + width] for i in range(0, len(self.plots), width)] if width else []
        )

    def has_legend(self, plot: Plot) -> bool:
        """Whether a plot says whose its lines are: the first one with a line a user or robot.

        The others have the same lines in the same colours, and legends hide what lies below.
        """
        per_user = [p for p in self.plots if len(p.fields) == 1]
        return len(plot.fields) > 1 or plot == per_user[0]


def panels_of(log: LogReader) -> Panels:
    """Find out what a log has for viewers; LogError if it is damaged, or has no slots."""
    if not log.num_slots:
        raise LogError(log.path, 0, "has no slots, so there is nothing to show")
    tracks = read_tracks(log)
    places = [track[..., :2].reshape(-1, 2) for track in tracks.values()]
    low, high = np.zeros(2), np.ones(2)
    if places:
        low = np.min([place.min(axis=0) for place in places], axis=0)
        high = np.max([place.max(axis=0) for place in places], axis=0)
    (x, y), (width, height) = ((low + high) / 2).tolist(), (high - low).tolist()
    return Panels(
        dims=log.dims,
        plots=tuple(plot for plot in PLOTS if _has(log, plot)),
        tracks=tuple(name for name in TRACKS if name in tracks),
        centre=(x, y),
        size=(width, height),
        has_image=has_owners(log),
        has_events=bool(log.events()),
    )


def _has(log: LogReader, plot: Plot) -> bool:
    known = log.known_fields(plot.topic) if plot.topic in log.topics else ()
    if not set(plot.fields) <= set(known) or not lines_of(plot, log.dims):
        return False
    return not plot.if_any or any(log.read(plot.topic, [f])[f].any() for f in plot.fields)
