"""The last slots of a world as a picture: who had which PRB, the queues, the robots' errors."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from hiersched.core.colours import user_colours
from hiersched.scenario.schema import Scenario
from hiersched.simulator import SlotRecord

WINDOW = 100
"""Slots in a picture."""
SIZE = (800, 600)
"""Width and height [pixels]."""

_SCALE = 2  # drawn at twice the size: lines without steps
_INK, _FRAME, _GRID, _PAPER = "#202020", "#909090", "#e4e4e4", "#ffffff"
_LEFT, _WIDTH = 62, 600
_LEGEND_LEFT, _LEGEND_TOP, _LEGEND_HEIGHT, _LINE_HEIGHT = 682, 66, 488, 16


class _Panel(NamedTuple):
    """A plot over the slots of the window: its title, and where it lies [pixels]."""

    title: str
    top: int
    height: int


_ALLOCATION = _Panel("Owner of each PRB", 66, 190)
_QUEUES = _Panel("Queue at the start of the slot [packets]", 290, 112)
_ERRORS = _Panel("Tracking error of each URLLC user's robot [cm]", 436, 112)


class Pictures:
    """The last `WINDOW` slots of E worlds, and what they look like.

    Users have the colours of `core.colours`, robots those of their users. Time runs to the right
    and goes on from the episode's start; the vertical axes grow with the episode's largest value.
    """

    def __init__(self, scenario: Scenario, num_envs: int, num_slots: int) -> None:
        users = scenario.users
        self._num_slots, self._slot_s = num_slots, scenario.radio.slot_s
        self._title, self._num_urllc = scenario.name, users.num_urllc
        self._colours = user_colours(users.num_urllc, users.num_embb)
        lead = num_envs, WINDOW
        self._owners = np.zeros((*lead, scenario.radio.num_prb), np.int64)
        self._backlog = np.zeros((*lead, scenario.num_users))
        self._error_cm = np.zeros((*lead, users.num_urllc))
        self._late_due = np.zeros((num_envs, 2), np.int64)
        self._rewards = np.zeros((num_envs, 2))
        self._tops = np.zeros((num_envs, 2))
        self._count = 0

    def clear(self) -> None:
        """Begin an episode."""
        self._late_due[:] = 0
        self._tops[:] = 0.0
        self._count = 0

    def add(self, record: SlotRecord, task_costs: NDArray[np.float64]) -> None:
        """Take a slot in, leading axes (E, 1), and what its task costs add to the rewards."""
        place, urllc = self._count % WINDOW, slice(self._num_urllc)
        self._owners[:, place] = record.prb_owner[:, 0]
        self._backlog[:, place] = record.backlog_packets[:, 0]
        self._error_cm[:, place] = 100.0 * record.tracking_error_m[:, 0]
        self._late_due[:, 0] += record.late_packets[:, 0, urllc].sum(axis=-1, dtype=np.int64)
        self._late_due[:, 1] += record.due_packets[:, 0, urllc].sum(axis=-1, dtype=np.int64)
        self._rewards[:, 0] = record.reward_urllc[:, 0] - task_costs.mean(axis=1)
        self._rewards[:, 1] = record.reward_embb[:, 0]
        seen = self._backlog[:, place], self._error_cm[:, place]
        for top, values in zip(self._tops.T, seen, strict=True):
            np.maximum(top, values.max(axis=-1), out=top)
        self._count += 1

    def draw(self, env: int) -> NDArray[np.uint8]:
        """Draw a world, shape (height, width, 3)."""
        canvas = _Canvas()
        first = max(0, self._count - WINDOW)
        slots = np.arange(first, self._count)
        self._draw_header(canvas, env)
        self._draw_allocation(canvas, self._owners[env, slots % WINDOW])
        curves = (_QUEUES, self._backlog), (_ERRORS, self._error_cm)
        for (panel, values), top in zip(curves, self._tops[env], strict=True):
            canvas.draw_scale(panel, top)
            canvas.draw_curves(panel, values[env, slots % WINDOW], self._colours, top)
        panels = _ALLOCATION, _QUEUES, _ERRORS
        for panel in panels:
            canvas.draw_frame(panel)
        canvas.draw_time(first, self._slot_s, panels)
        self._draw_legend(canvas)
        return canvas.pixels()

    def _draw_header(self, canvas: _Canvas, env: int) -> None:
        (late, due), (urllc, embb) = self._late_due[env], self._rewards[env]
        canvas.write((_LEFT, 16), f"{self._title}, slot {self._count} of {self._num_slots}", 15)
        if self._count:
            canvas.write(
                (_LEFT, 36),
                f"{late} of {due} URLLC packets late in this episode; "
                f"reward of the slot: URLLC {urllc:.3f}, eMBB {embb:.3f}",
            )

    def _draw_allocation(self, canvas: _Canvas, owners: NDArray[np.int64]) -> None:
        num_prb = self._owners.shape[-1]
        canvas.paste(_ALLOCATION, self._colours[owners.T])
        for prb in (0, num_prb - 1):
            middle = _ALLOCATION.top + _ALLOCATION.height * (prb + 0.5) / num_prb
            canvas.write((_LEFT - 6, middle), f"{prb}", anchor="rm")

    def _draw_legend(self, canvas: _Canvas) -> None:
        """Draw a field a user; with many users only some have their name beside them."""
        num_users = len(self._colours)
        height = min(_LINE_HEIGHT, _LEGEND_HEIGHT / num_users)
        named = math.ceil(_LINE_HEIGHT / height - 1e-9)
        for user, colour in enumerate(self._colours):
            top = _LEGEND_TOP + user * height
            gap = 3 if named == 1 else 0
            canvas.fill((_LEGEND_LEFT, top, _LEGEND_LEFT + 12, top + height - gap), colour)
            if user % named == 0:
                name = f"URLLC {user}" if user < self._num_urllc else f"eMBB {user}"
                middle = top + 0.5 * (height - gap)
                canvas.write((_LEGEND_LEFT + 18, middle), name, anchor="lm")


class _Canvas:
    """A picture in work; places are those of the finished one."""

    def __init__(self) -> None:
        self._image = Image.new("RGB", (SIZE[0] * _SCALE, SIZE[1] * _SCALE), _PAPER)
        self._draw = ImageDraw.Draw(self._image)

    def pixels(self) -> NDArray[np.uint8]:
        """Return the finished picture, shape (height, width, 3)."""
        return np.asarray(self._image.resize(SIZE, Image.Resampling.BOX)).copy()

    def write(
        self, place: tuple[float, float], text: str, size: int = 12, anchor: str = "ls"
    ) -> None:
        """Write one line; `anchor` as Pillow has it."""
        font = ImageFont.load_default(size * _SCALE)
        x, y = place
        self._draw.text((_SCALE * x, _SCALE * y), text, fill=_INK, font=font, anchor=anchor)

    def fill(self, box: tuple[float, float, float, float], colour: NDArray[np.uint8]) -> None:
        """Fill a field: left, top, right, bottom."""
        self._draw.rectangle(_scaled(box), fill=tuple(colour.tolist()))

    def paste(self, panel: _Panel, colours: NDArray[np.uint8]) -> None:
        """Paste an image with a column a slot, shape (rows, slots, 3), into a panel."""
        slots = colours.shape[1]
        if slots:
            size = slots * _slot_width() * _SCALE, panel.height * _SCALE
            fields = Image.fromarray(np.ascontiguousarray(colours))
            fields = fields.resize(size, Image.Resampling.NEAREST)
            self._image.paste(fields, (_LEFT * _SCALE, panel.top * _SCALE))

    def draw_frame(self, panel: _Panel) -> None:
        """Draw the outline of a panel, and its title above it."""
        box = _LEFT, panel.top, _LEFT + _WIDTH, panel.top + panel.height
        self._draw.rectangle(_scaled(box), outline=_FRAME, width=_SCALE)
        self.write((_LEFT, panel.top - 6), panel.title)

    def draw_scale(self, panel: _Panel, top: float) -> None:
        """Draw the vertical axis of a panel from 0 to what holds `top`."""
        step, end = _axis(top)
        for i in range(round(end / step) + 1):
            y = panel.top + panel.height * (1.0 - i * step / end)
            self._draw.line(_scaled((_LEFT, y, _LEFT + _WIDTH, y)), fill=_GRID, width=_SCALE)
            self.write((_LEFT - 6, y), f"{i * step:g}", anchor="rm")

    def draw_curves(
        self,
        panel: _Panel,
        values: NDArray[np.float64],
        colours: NDArray[np.uint8],
        top: float,
    ) -> None:
        """Draw a line a column of `values`, shape (slots, columns), 0 at the panel's foot."""
        _, end = _axis(top)
        x = _LEFT + _slot_width() * (np.arange(len(values)) + 0.5)
        y = panel.top + panel.height * (1.0 - values / end)
        for column, colour in zip(y.T, colours[: y.shape[1]], strict=True):
            points = _SCALE * np.column_stack([x, column])
            line = [(float(a), float(b)) for a, b in points]
            self._draw.line(line, tuple(colour.tolist()), width=3, joint="curve")

    def draw_time(self, first: int, slot_s: float, panels: tuple[_Panel, ...]) -> None:
        """Draw the time axis below each of the panels, whose first slot is `first`."""
        foot = max(panel.top + panel.height for panel in panels)
        for slot in _ticks(first):
            x = _LEFT + _slot_width() * (slot - first)
            for panel in panels:
                end = panel.top + panel.height
                self._draw.line(_scaled((x, end, x, end + 4)), fill=_FRAME, width=_SCALE)
            self.write((x, foot + 9), f"{slot * slot_s:.4g}", anchor="mt")
        self.write((_LEFT + _WIDTH / 2, foot + 27), "Time since the episode began [s]", anchor="mt")


def _ticks(first: int) -> Iterator[int]:
    """Slots of the window that are whole fifths of it."""
    step = WINDOW // 5
    yield from range(-(-first // step) * step, first + WINDOW + 1, step)


def _slot_width() -> int:
    return _WIDTH // WINDOW


def _scaled(place: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(_SCALE * value for value in place)


def _axis(top: float) -> tuple[float, float]:
    """Return step and end of an axis from 0 that holds `top`: two to four round steps."""
    if not top > 0.0:
        return 0.5, 1.0
    rough = top / 4.0
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * digit for digit in (1.0, 2.0, 5.0, 10.0) if power * digit >= rough)
    return step, step * math.ceil(top / step - 1e-9)
