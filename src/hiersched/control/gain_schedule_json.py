"""JSON form of gain schedules: lossless for every float, with errors that name the field."""

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

if TYPE_CHECKING:
    from hiersched.control.gain_table import GainSchedule

FORMAT = "hiersched gain schedule 2"
_WITNESSES: dict[str, type[RazumikhinWitness | DelayRazumikhinWitness | KrasovskiiWitness]] = {
    witness.criterion: witness
    for witness in (RazumikhinWitness, DelayRazumikhinWitness, KrasovskiiWitness)
}


def dump_schedule(schedule: GainSchedule) -> str:
    """Return the schedule as JSON text.

    Parameters
    ----------
    schedule : GainSchedule
        The table.

    Returns
    -------
    str
        JSON; floats in their shortest form that reads back exactly.
    """
    entries = [
        {
            "delay_steps": delay,
            "status": schedule.status[delay],
            "gain": schedule.gains[delay].tolist(),
            "input_gains": schedule.input_gains[delay, :delay].tolist(),
            "certificate": _dump_certificate(schedule.certificates[delay]),
        }
        for delay in range(schedule.max_delay_steps + 1)
    ]
    document = {
        "format": FORMAT,
        "key": schedule.key,
        "kind": schedule.kind,
        "method": schedule.method,
        "decay_rate": schedule.decay_rate,
        "sampling_s": schedule.sampling_s,
        "nominal": schedule.nominal.tolist(),
        "operator_gain": None
        if schedule.operator_gain is None
        else schedule.operator_gain.tolist(),
        "entries": entries,
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def parse_schedule(text: str, kind: type[GainSchedule]) -> GainSchedule:
    """Return the schedule that `dump_schedule` wrote.

    Parameters
    ----------
    text : str
        JSON text.
    kind : type
        `GainSchedule`.

    Returns
    -------
    GainSchedule
        The table.

    Raises
    ------
    ValueError
        If the text is no schedule; the message names the field.
    """
    document = json.loads(text)
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ValueError(f"not a gain schedule: its format must be {FORMAT!r}")
    entries = _field(document, "entries", list)
    for delay, entry in enumerate(entries):
        if not isinstance(entry, dict) or entry.get("delay_steps") != delay:
            raise ValueError(f"entries[{delay}] must be an object with delay_steps {delay}")
    rate, nominal = document.get("decay_rate"), _array(document, "nominal")
    operator_gain = document.get("operator_gain")
    return kind(
        gains=np.array([_array(entry, "gain") for entry in entries]),
        status=tuple(_field(entry, "status", str) for entry in entries),
        certificates=tuple(
            _parse_certificate(delay, _field(entry, "certificate", dict))
            for delay, entry in enumerate(entries)
        ),
        nominal=nominal,
        input_gains=_parse_input_gains(entries, len(nominal)),
        operator_gain=None if operator_gain is None else _array(document, "operator_gain"),
        kind=_field(document, "kind", str),
        method=_field(document, "method", str),
        decay_rate=None if rate is None else _field(document, "decay_rate", float),
        sampling_s=_field(document, "sampling_s", float),
        key=_field(document, "key", str),
    )


def _parse_input_gains(entries: list[Any], inputs: int) -> FloatArray:
    """Return the table, zero from the delay on, from the entries' shorter lists."""
    steps = len(entries) - 1
    table = np.zeros((len(entries), steps, inputs, inputs))
    for delay, entry in enumerate(entries):
        gains = _array(entry, "input_gains")
        if gains.shape != (delay, inputs, inputs) and not gains.size == delay == 0:
            raise ValueError(
                f"entries[{delay}].input_gains has shape {gains.shape}; "
                f"it must be {(delay, inputs, inputs)}"
            )
        table[delay, :delay] = gains.reshape(delay, inputs, inputs)
    return table


def _dump_certificate(certificate: Certificate) -> dict[str, Any]:
    witness = certificate.witness
    return {
        "certified": certificate.certified,
        "criterion": certificate.criterion,
        "margins": dict(certificate.margins),
        "tolerance": certificate.tolerance,
        "spectral_radii": certificate.spectral_radii.tolist(),
        "witness": None
        if witness is None
        else {
            field.name: value.tolist() if isinstance(value, np.ndarray) else value
            for field in fields(witness)
            for value in [getattr(witness, field.name)]
        },
    }


def _parse_certificate(delay: int, document: Mapping[str, Any]) -> Certificate:
    criterion = _field(document, "criterion", str)
    witness: Witness | None = None
    if criterion != "none":
        if criterion not in _WITNESSES:
            raise ValueError(f"criterion is {criterion!r}; it must be one of {list(_WITNESSES)}")
        kind, values = _WITNESSES[criterion], _field(document, "witness", dict)
        arguments: dict[str, Any] = {
            field.name: _array(values, field.name)
            if isinstance(values.get(field.name), list)
            else _field(values, field.name, float)
            for field in fields(kind)
        }
        witness = kind(**arguments)
    radii = _array(document, "spectral_radii")
    return Certificate(
        certified=_field(document, "certified", bool),
        criterion=criterion,
        delay_steps=delay,
        margins=_field(document, "margins", dict),
        tolerance=_field(document, "tolerance", float),
        spectral_radii=radii,
        witness=witness,
    )


def _field(document: Mapping[str, Any], name: str, kind: type) -> Any:
    value = document.get(name)
    if not isinstance(value, kind):
        raise ValueError(f"{name} is {value!r:.60}; it must be a {kind.__name__}")
    return value


def _array(document: Mapping[str, Any], name: str) -> FloatArray:
    try:
        return np.array(_field(document, name, list), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} is no array of numbers: {error}") from error
