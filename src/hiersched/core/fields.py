"""The table of fields: what a slot leaves behind, in the simulator's record and in the log.

From this table come the record's memory (`simulator.record`), and the log's messages, `.proto`
text and documentation (`log.schema`). A new row is all that a new quantity needs. Readers go by the
schema in a file, so rows may come, go and move.
"""
# ruff: noqa: E501  (rows of the table)

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

PROFILES = ("full", "compact", "decisions", "robots")
"""What logs hold. Whatever a smaller one leaves out, replay computes again."""

FULL = ("full",)
DECISIONS = ("full", "compact", "decisions")
COMPACT = ("full", "compact")  # what the study reads of a run, besides the decisions
ROBOTS = ("full", "compact", "robots")  # what the study reads of robots that run alone
SUMS = ("decisions",)  # of slices, in place of the users' numbers

LETTERS = {
    "U": "users, URLLC first",
    "R": "robots, one a URLLC user",
    "K": "PRBs",
    "N": "states of a robot (5: a unicycle)",
    "M": "inputs of a robot (2)",
    "W": "standard normals of a robot and slot (5)",
    "X": "numbers that models add",
}
"""What the letters of shapes count."""

TOPIC_MEANINGS = {
    "/channel": "the radio channel during the slot",
    "/world": "the other random numbers that no policy can influence",
    "/allocation": "the decision and the rates that follow from it",
    "/queue": "backlog F and what happens to it: F(t+1) = max(0, F - S + A - mu)",
    "/delay": "measured delays, deadlines, and the Lyapunov terms and rewards of the slot",
    "/robots": "robots and the gains in force, at the end of the slot unless it says otherwise",
    "/models": "what the scenario's models add of their own; only where they add something",
}
STORED_TOPICS = ("/channel", "/world")
"""Never compressed: random numbers, of which zstd saves 10 % for a quarter of the writer's time."""


@dataclass(frozen=True)
class Field:
    """One quantity of a slot."""

    topic: str  # of the log
    name: str  # unique over all topics
    dtype: str  # little-endian NumPy type: <f8, <f4, <u4 or <u8
    shape: tuple[str | int, ...]  # of one slot's value: `LETTERS` and numbers; () is a scalar
    unit: str
    meaning: str
    profiles: tuple[str, ...]  # those of `PROFILES` that contain it

    def sized(self, sizes: Mapping[str, int]) -> tuple[int, ...]:
        """Shape of one slot's value where each letter stands for a number."""
        return tuple(sizes[n] if isinstance(n, str) else n for n in self.shape)


def _topic(topic: str, *rows: tuple[str, str, str, str, tuple[str, ...], str]) -> list[Field]:
    """Fields of one topic: name, type, shape, unit, profiles, meaning."""
    fields = []
    for name, dtype, letters, unit, profiles, meaning in rows:
        shape: list[Any] = [int(n) if n.isdigit() else n for n in letters.split()]
        fields.append(Field(topic, name, dtype, tuple(shape), unit, meaning, profiles))
    return fields


# fmt: off
FIELDS: tuple[Field, ...] = tuple([
    *_topic(
        "/channel",
        ("fading_power", "<f4", "U K", "1", FULL, "|h|^2, squared amplitude, rounded to float32 before use"),
        ("mean_fading_power", "<f4", "U", "1", COMPACT, "mean of |h|^2 over the PRBs"),
    ),
    *_topic(
        "/world",
        ("arrival_uniform", "<f8", "U", "1", FULL, "uniform on the unit interval, of which the arrivals are a quantile"),
        ("robot_normal", "<f4", "R W", "1", FULL, "standard normals: 2 of the slip, 3 of the measurement noise (linear plants: n of the process, n of the measurement)"),
    ),
    *_topic(
        "/allocation",
        ("prb_owner", "<u4", "K", "1", DECISIONS, "index of the user who has the PRB"),
        ("num_prb", "<u4", "U", "1", COMPACT, "PRBs of each user"),
        ("rate_mbps", "<f8", "U", "Mbit/s", COMPACT, "rate on the PRBs of each user"),
        ("weight", "<f4", "U", "1", COMPACT, "weight of the utility; 1 for classical schedulers, NaN where the log that this one was expanded from did not have it"),
    ),
    *_topic(
        "/queue",
        ("backlog_packets", "<f8", "U", "packet", COMPACT, "F(t), at the start of the slot"),
        ("arrivals_packets", "<u4", "U", "packet", COMPACT, "A(t)"),
        ("superseded_packets", "<u4", "U", "packet", COMPACT, "S(t), waiting packets that newer ones have replaced"),
        ("service_packets", "<f8", "U", "packet", COMPACT, "mu(t), offered service"),
        ("average_rate_mbps", "<f8", "U", "Mbit/s", FULL, "moving average of the rate, before the slot"),
    ),
    *_topic(
        "/delay",
        ("hol_delay_s", "<f8", "U", "s", FULL, "age of the head-of-line packet at the start of the slot"),
        ("delay_s", "<f8", "U", "s", FULL, "sojourn of the last packet delivered, else age of the oldest"),
        ("due_packets", "<u4", "U", "packet", COMPACT, "packets whose deadline fell in this slot"),
        ("late_packets", "<u4", "U", "packet", COMPACT, "those of them that were late"),
        ("arrival_clamped", "<u4", "U", "1", COMPACT, "1 where the mean arrival rate was clamped at 0"),
        ("multiplier", "<f8", "R", "1", DECISIONS, "lambda of each URLLC user"),
        ("constraint", "<f8", "R", "1", FULL, "y of each URLLC user, negative where violated"),
        ("drift_urllc", "<f8", "", "packet^2", COMPACT, "Lyapunov drift of the URLLC queues"),
        ("drift_embb", "<f8", "", "packet^2", COMPACT, "Lyapunov drift of the eMBB queues"),
        ("penalty_urllc", "<f8", "", "s^2/Mbit^2", COMPACT, "h of the URLLC users, sum of 1 / (r^2 + epsilon)"),
        ("penalty_embb", "<f8", "", "s^2/Mbit^2", COMPACT, "h of the eMBB users"),
        ("reward_urllc", "<f8", "", "1", DECISIONS, "reward of the URLLC agent"),
        ("reward_embb", "<f8", "", "1", DECISIONS, "reward of the eMBB agent"),
        ("backlog_urllc_packets", "<f8", "", "packet", SUMS, "mean of F(t) over the URLLC users; 0 where there are none"),
        ("backlog_embb_packets", "<f8", "", "packet", SUMS, "mean of F(t) over the eMBB users; 0 where there are none"),
        ("due_urllc_packets", "<u4", "", "packet", SUMS, "packets of the URLLC users whose deadline fell in this slot"),
        ("due_embb_packets", "<u4", "", "packet", SUMS, "packets of the eMBB users whose deadline fell in this slot"),
        ("late_urllc_packets", "<u4", "", "packet", SUMS, "packets among due_urllc_packets that were late"),
        ("late_embb_packets", "<u4", "", "packet", SUMS, "packets among due_embb_packets that were late"),
    ),
    *_topic(
        "/robots",
        ("network_delay_s", "<f8", "R", "s", FULL, "operator to robot; measured in this slot, in force in the next"),
        ("delay_steps", "<u4", "R", "sample", ROBOTS, "T_d in force in this slot: of the delay measured in the slot before"),
        ("delay_capped", "<u4", "R", "1", ROBOTS, "1 where T_d > T_max: the gain in force is that for T_max"),
        ("gain_delay_steps", "<u4", "R", "sample", FULL, "the delay T whose adjusted gain is in force, 0: the nominal gain"),
        ("set_point_age_s", "<f8", "R", "s", COMPACT, "age of the set-point in force at the slot's end; 0 where the robot knows its reference and no delay is an age"),
        ("set_point", "<f8", "R 3", "m, m, rad", FULL, "x, y, theta of the set-point in force at the slot's end; 0 where the robot knows its reference, and for linear plants"),
        ("state", "<f8", "R N", "m, m, rad, m/s, rad/s", FULL, "error state e_x, e_y, e_theta, dv, domega (of a linear plant its own)"),
        ("reference", "<f8", "R 5", "m, m, rad, m/s, rad/s", FULL, "x, y, theta, v, omega; 0 for linear plants"),
        ("control", "<f8", "R M", "m/s, rad/s", FULL, "u_v, u_omega (of a linear plant its own)"),
        ("control_saturated", "<u4", "R", "sample", ROBOTS, "samples of the slot in which the control was saturated"),
        ("tracking_error_m", "<f8", "R", "m", ROBOTS, "root mean square of the position error over the slot"),
        ("dexterity_index", "<f8", "R", "1", ROBOTS, "dexterity index in force during the slot, in [0, 1]"),
    ),
    *_topic(
        "/models",
        ("model_values", "<f8", "X", "any", COMPACT, "the metadata key model_fields says which fields these are, and their units; 0 where a model wrote nothing"),
    ),
])
# fmt: on

SLICE_FIELDS = tuple(field.name for field in FIELDS if field.profiles == SUMS)


@dataclass(frozen=True)
class ModelField:
    """A field of a model: one number a user, or a robot for a plant."""

    name: str  # such as radio.fading/coherence
    unit: str
    start: int  # of its numbers in `model_values`
    count: int


def fields_to_text(fields: Iterable[ModelField]) -> str:
    """Write fields of models as JSON, as in the metadata of logs."""
    return json.dumps([asdict(field) for field in fields], separators=(",", ":"))


def fields_from_text(text: str, num_values: int) -> tuple[ModelField, ...]:
    """Read what `fields_to_text` wrote.

    ValueError if it is anything else, or the fields are not, one behind the other, those of
    `num_values` numbers.
    """
    found = []
    start = 0
    try:
        for entry in json.loads(text):
            field = ModelField(**entry)
            texts, numbers = (field.name, field.unit), (field.start, field.count)
            if {type(v) for v in texts} != {str} or {type(v) for v in numbers} != {int}:
                raise TypeError(f"{entry} is no field")
            if field.start != start or field.count < 1:
                raise ValueError(f"{field.name} has {field.count} numbers from {field.start} on")
            start += field.count
            found.append(field)
    except TypeError as error:
        raise ValueError(f"{text}: no fields of models") from error
    if start != num_values or len({field.name for field in found}) != len(found):
        raise ValueError(f"{text}: not fields of {num_values} numbers")
    return tuple(found)
