"""Builds the page of a log: what it says of the run, and the numbers that its panels draw."""

from __future__ import annotations

import base64
import math
import os
import re
import zlib
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from yaml import YAMLError

from hiersched.core.colours import SLICE_COLOURS, user_colours
from hiersched.core.fields import FIELDS
from hiersched.core.files import refuse_existing, write_bytes
from hiersched.core.html import asset, page
from hiersched.log import Event, LogReader, log_digest, slot_span
from hiersched.log.schema import MODELS_TOPIC
from hiersched.replay.panels import ALLOCATION, PANELS, Plot, left_out
from hiersched.scenario.strict_yaml import parse_yaml

MAX_SLOTS = 10_000
"""As many slots are drawn one by one; of a longer log the least and greatest of several."""
MAX_EVENTS = 20_000
"""As many events are on a page, the first ones."""

_MEANINGS = {field.name: field.meaning for field in FIELDS} | {
    "late_packets": "packets whose deadline fell in the slot, and that were late"
}
_OF_A_USER = re.compile(r"(?:user|robot) (\d+):")


class Numbers:
    """Arrays on their way into a page: one after the other, compressed together."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, values: NDArray[Any]) -> dict[str, Any]:
        """Take an array (lines, points); returns where it is. Fractions become float32."""
        values = np.ascontiguousarray(values, _small_type(values))
        place = {"at": self._size, "type": values.dtype.name, "count": values.size}
        # Float32 starts at multiples of four bytes; bytes of the same place compress better.
        data = values.view(np.uint8).reshape(-1, values.itemsize).T.tobytes()
        self._parts.append(data + bytes(-len(data) % 4))
        self._size += len(self._parts[-1])
        return place

    def text(self) -> str:
        """Return all of them, deflated, to the base 64."""
        return base64.b64encode(zlib.compress(b"".join(self._parts), 9)).decode()


def _small_type(values: NDArray[Any]) -> type[np.generic]:
    if values.dtype.kind == "f":
        return np.float32
    greatest = int(values.max(initial=0))
    return np.uint8 if greatest < 1 << 8 else np.uint16 if greatest < 1 << 16 else np.uint32


def write_log_page(
    path: str | os.PathLike[str],
    out: str | os.PathLike[str],
    start_s: float = 0.0,
    stop_s: float = math.inf,
    *,
    overwrite: bool = False,
) -> Path:
    """Write a log, or its slots from `start_s` to before `stop_s` [s], as one HTML page.

    The page has all panels that the log has fields for, whatever its profile, and asks no network
    for anything. Returns its path.

    Raises
    ------
    FileExistsError
        If the file is there already, unless told to `overwrite` it, or is the log.
    LogError
        If the log is damaged.
    ValueError
        If the span runs backwards, or a log with slots has none in it.
    """
    refuse_existing(out, overwrite=overwrite, source=path)
    with LogReader(path) as log:
        start, stop = slot_span(log, start_s, stop_s)
        content = log_content(log, start, stop)
    own = (asset(__package__, name) for name in ("uPlot.min.css", "log.css"))
    scripts = (asset(__package__, name) for name in ("uPlot.iife.min.js", "log.js"))
    text = page(
        content["title"],
        asset(__package__, "log.html"),
        data=content,
        styles=tuple(own),
        scripts=tuple(scripts),
    )
    return write_bytes(Path(out), text.encode())


def log_content(log: LogReader, start: int | None, stop: int | None) -> dict[str, Any]:
    """Return what the script of the page draws, of the slots from `start` to before `stop`."""
    numbers, notes = Numbers(), list[str]()
    fields = _read(log, start, stop)
    slots = fields.pop("slot")
    if log.num_slots and not len(slots):
        length_s = log.num_slots * log.slot_ns * 1e-9
        raise ValueError(f"{log.path}: no slot starts in that span; the log lasts {length_s:g} s")
    step = math.ceil(len(slots) / MAX_SLOTS) if len(slots) > MAX_SLOTS else 1
    if step > 1:
        step *= 2  # two points of each: the least and the greatest
        notes.append(
            f"Lines show the least and greatest value of every {step} slots, the image of the "
            f"allocation every {step}th slot: of fewer slots (--from, --to) a page shows each."
        )
    deadlines = _deadlines(log)
    return {
        "title": " · ".join(log.metadata.get(k, "?") for k in ("scenario", "policy"))
        + f" · seed {log.metadata.get('seed', '?')}",
        "about": _about(log, slots),
        "metadata": sorted(log.metadata.items()),
        "users": _users(log),
        "slices": [
            {"name": name, "colour": colour}
            for name, colour in zip(("URLLC", "eMBB"), _css(SLICE_COLOURS), strict=True)
        ],
        "slot_s": log.slot_ns * 1e-9,
        "step": step,
        "spans": _spans(slots),
        "warmup_slots": _whole_number(log.metadata.get("warmup_slots", "")),
        "panels": _panels(log, fields, deadlines, step, numbers, notes),
        "events": _events(log, slots, notes),
        "notes": notes,
        "numbers": numbers.text(),
    }


def _read(log: LogReader, start: int | None, stop: int | None) -> dict[str, NDArray[Any]]:
    """Read what the panels draw, as far as the log has it, and its slots."""
    wanted = {name for panel in PANELS for name in panel.fields}
    found: dict[str, NDArray[Any]] = {"slot": np.empty(0, np.uint64)}
    for topic in log.topics:
        if topic == MODELS_TOPIC:
            found |= log.read_models(None, start, stop)
        elif names := wanted & {*log.known_fields(topic)}:
            found |= log.read(topic, names, start, stop)
    return found


def _about(log: LogReader, slots: NDArray[Any]) -> list[tuple[str, str]]:
    """Return what the log is, as lines of label and text."""
    text, dims = log.metadata, log.dims
    axis = f"{text['axis']} = {text['value']}" if text.get("axis") else "as configured"
    shown = ""
    if len(slots) < log.num_slots:
        shown = f"; here slots {slots[0]} to {slots[-1]}"
    return [
        ("Scenario", f"{text.get('scenario', '?')}, {axis}"),
        ("Run", f"{text.get('stage', '?')}, policy {text.get('policy', '?')}"),
        ("Seed", text.get("seed", "?")),
        ("Cell", f"{dims.num_urllc} URLLC and {dims.num_embb} eMBB users, {dims.num_prb} PRBs"),
        (
            "Length",
            f"{log.num_slots} slots of {log.slot_ns / 1e6:g} ms, "
            f"{log.num_slots * log.slot_ns / 1e9:g} s{shown}",
        ),
        ("Profile", f"{log.profile}, schema version {text['schema_version']}"),
        ("Digest", log_digest(log.path)),
        ("File", f"{log.path.name}, {log.path.stat().st_size:,} bytes"),
        ("Page by", f"hiersched {version('hiersched')}"),
    ]


def _users(log: LogReader) -> list[dict[str, Any]]:
    """Name and colour of each user; of robots that run alone, of each robot."""
    dims = log.dims
    colours = _css(user_colours(dims.num_urllc, dims.num_embb))
    alone = log.profile == "robots"
    return [
        {
            "name": f"robot {i}" if alone else f"{'URLLC' if i < dims.num_urllc else 'eMBB'} {i}",
            "slice": int(i >= dims.num_urllc),
            "colour": colour,
        }
        for i, colour in enumerate(colours)
        if not (alone and i >= dims.num_urllc)
    ]


def _css(colours: NDArray[np.uint8]) -> list[str]:
    """Return colours, shape (N, 3), as ``#rrggbb``, dark enough for white."""
    return ["#" + bytes(colour.tolist()).hex() for colour in readable_colours(colours)]


def readable_colours(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Darken what is too pale on white, hues as they are; shape (N, 3).

    A colour has a contrast of at least 3:1 then, as WCAG 2 asks of graphics.
    """
    most = 1.05 / 3.0 - 0.05
    shown = colours.copy()
    for row in shown:
        while _luminance(row) > most:
            row[:] = np.floor(0.97 * row)
    return shown


def _luminance(rgb: NDArray[np.uint8]) -> float:
    """Return the relative luminance of WCAG 2."""
    part = rgb / 255.0
    linear = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def _whole_number(text: str) -> int:
    return int(text) if text.isascii() and text.isdigit() else 0


def _spans(slots: NDArray[Any]) -> list[tuple[int, int]]:
    """First slot and length of every run of slots: a recovered log may lack some between."""
    if not len(slots):
        return []
    starts = np.concatenate(([0], np.flatnonzero(np.diff(slots) != 1) + 1))
    lengths = np.diff(np.concatenate((starts, [len(slots)])))
    return list(zip(slots[starts].tolist(), lengths.tolist(), strict=True))


def _deadlines(log: LogReader) -> dict[str, float]:
    """Deadlines of the slices [s], as far as the scenario in the log says them.

    It is read as text: to look at a log loads no plug-in.
    """
    text = log.attachments.get("scenario.yaml", b"").decode(errors="replace")
    try:
        traffic = parse_yaml(text)["traffic"]
        found = {"URLLC": traffic["deadline_s"], "eMBB": traffic["embb_deadline_s"]}
        return {name: float(value) for name, value in found.items()}
    except (ValueError, LookupError, TypeError, YAMLError):  # none, or another version's
        return {}


def _panels(
    log: LogReader,
    fields: Mapping[str, NDArray[Any]],
    deadlines: Mapping[str, float],
    step: int,
    numbers: Numbers,
    notes: list[str],
) -> list[dict[str, Any]]:
    """Return every panel that the log has numbers for; those of zeros alone are only named."""
    counts = {log.dims.num_urllc, log.dims.num_urllc + log.dims.num_embb} - {0}
    of_models = [
        Plot(f.name, MODELS_TOPIC, (f.name,), "" if f.unit == "1" else f.unit)
        for f in log.model_fields
        if f.count in counts
    ]
    found, silent = [], []
    for plot in (*PANELS, *of_models):
        if not {*plot.fields} <= fields.keys() or not len(fields[plot.fields[0]]):
            continue
        content = {"title": plot.title, "unit": plot.page_unit or plot.unit}
        if plot is ALLOCATION:
            owners = numbers.add(fields["prb_owner"][::step])
            found.append({**content, "prbs": log.dims.num_prb, "numbers": owners})
            continue
        values = np.concatenate([fields[f].reshape(len(fields[f]), -1).T for f in plot.fields])
        if not values.any():
            silent.append(plot.title)
            continue
        found.append({**content, **_lines(plot, values, deadlines, step, numbers)})
    if silent:
        notes.append(f"Zero throughout, so not drawn: {', '.join(silent)}.")
    if not deadlines and "hol_delay_s" in fields:
        notes.append("The log does not say the deadlines of its packets.")
    if text := left_out(log, log.path.name):
        notes.append(f"This is {text}.")
    return found


def _lines(
    plot: Plot,
    values: NDArray[Any],
    deadlines: Mapping[str, float],
    step: int,
    numbers: Numbers,
) -> dict[str, Any]:
    """Return what is drawn of a plot; `values` has shape (lines, T)."""
    if values.dtype.kind == "f":  # what is not finite leaves a gap
        values = np.where(np.isfinite(values), plot.scale * values, np.nan)
    drawn = [
        {
            "name": f"deadline of {name}: {plot.scale * s:g} {plot.page_unit}",
            "value": plot.scale * s,
        }
        for name, s in deadlines.items()
        if plot.deadline
    ]
    texts = [_MEANINGS.get(name, "of a model") for name in plot.fields]
    return {
        "meaning": "; ".join([*texts, *(str(line["name"]) for line in drawn)]),
        "slices": len(plot.fields) > 1,
        "lines": len(values),
        "deadlines": drawn,
        "numbers": numbers.add(extremes(values, step)),
    }


def extremes(values: NDArray[Any], step: int) -> NDArray[Any]:
    """Least and greatest of every `step` columns, in the order in which they came.

    Shape (N, T) to (N, 2 ceil(T / step)); as they are for a step of 1.
    """
    if step == 1:
        return values
    short = -values.shape[1] % step
    blocks = np.pad(values, ((0, 0), (0, short)), mode="edge").reshape(len(values), -1, step)
    first = np.minimum(blocks.argmin(axis=2), blocks.argmax(axis=2))
    last = np.maximum(blocks.argmin(axis=2), blocks.argmax(axis=2))
    both = np.stack((first, last), axis=2)
    taken: NDArray[Any] = np.take_along_axis(blocks, both, axis=2).reshape(len(values), -1)
    return taken


def _events(
    log: LogReader, slots: NDArray[Any], notes: list[str]
) -> list[tuple[int, str, str, int, str]]:
    """Return slot, level, name, user (-1 if it is no single one's) and text of every event."""
    if not len(slots):
        return []
    within: Iterable[Event] = (e for e in log.events() if slots[0] <= e.slot <= slots[-1])
    found = [(e.slot, e.level, e.name, _user(e.message), e.message) for e in within]
    if len(found) > MAX_EVENTS:
        notes.append(f"The first {MAX_EVENTS:,} of {len(found):,} events.")
    if not found:
        notes.append("The log has no events.")
    return found[:MAX_EVENTS]


def _user(message: str) -> int:
    match = _OF_A_USER.match(message)
    return int(match.group(1)) if match else -1
