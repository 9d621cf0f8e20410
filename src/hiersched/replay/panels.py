"""What viewers and pages show of a log: plots of the fields that it has, users in their colours."""

from __future__ import annotations

import math
import shlex
from typing import NamedTuple

import numpy as np

from hiersched.core.colours import SLICE_COLOURS, user_colours
from hiersched.log import LogDims, LogError, LogReader
from hiersched.log.schema import TOPICS, topics_in
from hiersched.replay.viewer_topics import IMAGE_SLOTS, TRACKS, has_owners, read_tracks

Colour = tuple[int, int, int]


class Plot(NamedTuple):
    """A plot over time: a line for each user or robot of a field, or of each field a slice."""

    title: str
    topic: str
    fields: tuple[str, ...]
    unit: str = ""  # of the log, in which viewers draw it
    page_unit: str = ""  # in which pages draw it, if it is another
    scale: float = 1.0  # from the first unit to the second
    deadline: bool = False  # whether pages draw the users' deadlines

    @property
    def heading(self) -> str:
        """Title and unit in viewers."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title


class Line(NamedTuple):
    """A line of a plot."""

    field: str
    place: int | None  # among the numbers of the field; None if it has one
    name: str
    colour: Colour


_SLICES_QUEUE = "backlog_urllc_packets", "backlog_embb_packets"
_SLICES_LATE = "late_urllc_packets", "late_embb_packets"
ALLOCATION = Plot("Allocation of resource blocks", "/allocation", ("prb_owner",), "PRB")
"""An image: the owner of every PRB over time."""
PANELS = (
    Plot("Queue", "/queue", ("backlog_packets",), "packets"),
    Plot("Mean queue of a slice", "/delay", _SLICES_QUEUE, "packets"),
    Plot("Wait of the oldest packet", "/delay", ("hol_delay_s",), "s", "ms", 1e3, deadline=True),
    Plot("Late packets in a slot", "/delay", ("late_packets",), "packets"),
    Plot("Late packets of a slice", "/delay", _SLICES_LATE, "packets"),
    Plot("Superseded packets in a slot", "/queue", ("superseded_packets",), "packets"),
    ALLOCATION,
    Plot("Rate", "/allocation", ("rate_mbps",), "Mbit/s"),
    Plot("Network delay", "/robots", ("network_delay_s",), "s", "ms", 1e3),
    Plot("Delay in force", "/robots", ("delay_steps",), "samples"),
    Plot("Gain in force", "/robots", ("gain_delay_steps",), "samples"),
    Plot("Age of the set-point in force", "/robots", ("set_point_age_s",), "s", "ms", 1e3),
    Plot("Tracking error", "/robots", ("tracking_error_m",), "m", "cm", 100.0),
    Plot("Saturated commands in a slot", "/robots", ("control_saturated",), "samples"),
    Plot("Dexterity index", "/robots", ("dexterity_index",)),
    Plot("Multiplier", "/delay", ("multiplier",)),
    Plot("Reward of an agent", "/delay", ("reward_urllc", "reward_embb")),
)
"""From top to bottom; plots of what stays 0 throughout are left out of viewers and pages."""
PLOTS = tuple(panel for panel in PANELS if panel is not ALLOCATION)
"""Those that are lines."""


def lines_of(plot: Plot, dims: LogDims) -> list[Line]:
    """Lines of a plot: a user, and its robot, has the same colour in every one."""
    fields = {field.name: field for field in TOPICS[plot.topic].fields}
    if not fields[plot.fields[0]].shape:
        slices = zip(plot.fields, ("URLLC", "eMBB"), SLICE_COLOURS.tolist(), strict=True)
        return [Line(name, None, text, (r, g, b)) for name, text, (r, g, b) in slices]
    ((name, shape),) = ((name, fields[name].shape) for name in plot.fields)
    urllc, embb = dims.num_urllc, dims.num_embb
    names = [f"URLLC {i}" for i in range(urllc)] + [f"eMBB {urllc + i}" for i in range(embb)]
    if shape == ("R",):
        names = [f"robot {i}" for i in range(urllc)]
    colours = [(int(r), int(g), int(b)) for r, g, b in user_colours(urllc, embb)]
    return [Line(name, i, text, colours[i]) for i, text in enumerate(names)]


TITLES = {
    "plane": "Robots, references pale [grid: 1 m]",
    "image": f"{ALLOCATION.title} [PRB, down], last {IMAGE_SLOTS} slots",
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
        """The plots row by row: one row of up to three, else two and more of up to five."""
        count = len(self.plots)
        width = count if count <= 3 else math.ceil(count / max(2, math.ceil(count / 5)))
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
    return any(log.read(plot.topic, [f])[f].any() for f in plot.fields)


def left_out(log: LogReader, path: str) -> str:
    """Say which panels a small log has no fields for, and how to have them; "" if it has all.

    `path` is what the log is called in the command.
    """
    full = topics_in("full")
    lacking = [
        panel.title
        for panel in PANELS
        if log.profile != "robots" or panel.topic == "/robots"  # of which nothing else happens
        if {*panel.fields} <= {field.name for field in full[panel.topic].fields_in("full")}
        if panel.topic not in log.topics or not {*panel.fields} <= {*log.known_fields(panel.topic)}
    ]
    if log.profile == "full" or not lacking:
        return ""
    return (
        f"a log of the profile {log.profile}, which leaves out: {', '.join(lacking)}. For these "
        f"make a full one: hiersched replay {shlex.quote(path)} --out full.mcap"
    )
