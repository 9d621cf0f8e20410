"""JSON form of gain schedules: lossless, with a checksum, and errors that name the field."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from hiersched.control.certificate import (
    Certificate,
    DelayRazumikhinWitness,
    KrasovskiiWitness,
    RazumikhinWitness,
    Witness,
)
from hiersched.control.checks import FloatArray
from hiersched.core.sealed import seal_json, unseal_json

if TYPE_CHECKING:
    from hiersched.control.gain_schedule import GainSchedule

FORMAT = "hiersched gain schedule 3"
_UNSEALED = "hiersched gain schedule 2"
"""Of earlier versions, without a checksum: still in their logs."""
_WITNESSES: dict[str, type[Witness]] = {
    witness.criterion: witness
    for witness in (RazumikhinWitness, DelayRazumikhinWitness, KrasovskiiWitness)
}


_HEAD: dict[str, type] = {
    "key": str,
    "kind": str,
    "method": str,
    "decay_rate": float,
    "sampling_s": float,
    "nominal": np.ndarray,
    "operator_gain": np.ndarray,
}
"""Fields of a schedule that are not tables; `_OPTIONAL` ones may be null."""
_OPTIONAL = ("decay_rate", "operator_gain")


def dump_schedule(schedule: GainSchedule) -> str:
    """Return the schedule as JSON, floats in their shortest form that reads back exactly."""
    entries = [
        {
            "delay_steps": delay,
            "status": schedule.status[delay],
            "gain": gain,
            "input_gains": schedule.input_gains[delay, :delay],
            "certificate": schedule.certificates[delay],
        }
        for delay, gain in enumerate(schedule.gains)
    ]
    head = {name: getattr(schedule, name) for name in _HEAD}
    document = {"format": FORMAT, **head, "entries": entries}
    return seal_json(document, default=_plain)


def _plain(value: FloatArray | Certificate | Witness) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Certificate):
        names = "certified", "criterion", "margins", "tolerance", "spectral_radii", "witness"
        return {name: getattr(value, name) for name in names}
    return vars(value)


def parse_schedule(text: str, *, vouched: bool) -> dict[str, Any]:
    """Return the arguments of `GainSchedule` that `dump_schedule` wrote.

    Where something else has `vouched` for the text, such as a log's checksum, it may be one of an
    earlier version without a checksum. ValueError if it is no schedule; the message names the
    field.
    """
    document, wanted = _unsealed(text) if vouched else None, _UNSEALED
    if document is None:
        document, wanted = unseal_json(text.encode()), FORMAT
    if document.get("format") != wanted:
        raise ValueError(f"not a gain schedule: its format must be {wanted!r}")
    entries = _field(document, "entries", list)
    for delay, entry in enumerate(entries):
        if not isinstance(entry, dict) or entry.get("delay_steps") != delay:
            raise ValueError(f"entries[{delay}] must be an object with delay_steps {delay}")
    head = {
        name: _field(document, name, kind)
        for name, kind in _HEAD.items()
        if name not in _OPTIONAL or document.get(name) is not None
    }
    return {
        "decay_rate": None,
        **head,
        "gains": np.array([_field(entry, "gain", np.ndarray) for entry in entries]),
        "status": tuple(_field(entry, "status", str) for entry in entries),
        "certificates": tuple(
            _parse_certificate(_field(entry, "certificate", dict)) for entry in entries
        ),
        "input_gains": _parse_input_gains(entries, len(head["nominal"])),
    }


def _unsealed(text: str) -> dict[str, Any] | None:
    """Read JSON without a checksum; None if it is another text."""
    try:
        document = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return document if isinstance(document, dict) and "sha256" not in document else None


def _parse_input_gains(entries: list[Any], inputs: int) -> FloatArray:
    """Return the table, zero from the delay on, from the entries' shorter lists."""
    table = np.zeros((len(entries), len(entries) - 1, inputs, inputs))
    for delay, entry in enumerate(entries):
        gains = _field(entry, "input_gains", np.ndarray)
        if gains.shape != (delay, inputs, inputs) and not gains.size == delay == 0:
            raise ValueError(
                f"entries[{delay}].input_gains has shape {gains.shape}; "
                f"it must be {(delay, inputs, inputs)}"
            )
        table[delay, :delay] = gains.reshape(delay, inputs, inputs)
    return table


def _parse_certificate(document: Mapping[str, Any]) -> Certificate:
    criterion = _field(document, "criterion", str)
    witness: Witness | None = None
    if criterion != "none":
        if criterion not in _WITNESSES:
            raise ValueError(f"criterion is {criterion!r}; it must be one of {list(_WITNESSES)}")
        kind, values = _WITNESSES[criterion], _field(document, "witness", dict)
        matrices = {name for name, value in values.items() if isinstance(value, list)}
        arguments: dict[str, Any] = {
            part.name: _field(values, part.name, np.ndarray if part.name in matrices else float)
            for part in fields(kind)
        }
        witness = kind(**arguments)
    return Certificate(
        certified=_field(document, "certified", bool),
        margins=_field(document, "margins", dict),
        tolerance=_field(document, "tolerance", float),
        spectral_radii=_field(document, "spectral_radii", np.ndarray),
        witness=witness,
    )


def _field(document: Mapping[str, Any], name: str, kind: type) -> Any:
    """Return a field of this kind; an array is a list of numbers."""
    value, expected = document.get(name), list if kind is np.ndarray else kind
    if not isinstance(value, expected):
        raise ValueError(f"{name} is {value!r:.60}; it must be a {expected.__name__}")
    if kind is not np.ndarray:
        return value
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} is no array of numbers: {error}") from error
