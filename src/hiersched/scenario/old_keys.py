"""Keys that have another name now: for messages, and for scenarios in logs of older versions."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

OLD_KEYS = {
    "radio.path_loss": "radio.path_loss.model",
    "radio.cell_radius_m": "radio.path_loss.cell_radius_m",
    "radio.min_distance_m": "radio.path_loss.min_distance_m",
    "radio.shadowing_db": "radio.path_loss.shadowing_db",
    "radio.rayleigh_scale": "radio.fading.scale",
    "traffic.batch_packets": "traffic.arrivals.batch_packets",
    "traffic.rate_sensitivity": "traffic.arrivals.rate_sensitivity",
    "traffic.reference_rate_mbps": "traffic.arrivals.reference_rate_mbps",
    "traffic.application_delay_s": "traffic.arrivals.application_delay_s",
    **{
        f"linear_plant.{name}": f"plant.{name}"
        for name in (
            *("A", "A_d", "B", "Q", "R"),
            *("process_noise", "measurement_noise", "input_limits", "error_states"),
        )
    },
    "control.plant": "control.loop",
}
"""Old key -> new key."""

AXES = {
    "rayleigh_scale": "radio.fading.scale",
    "sampling_s": "control.sampling_s",
    "reference": "robot.reference",
    "load": "traffic.load",
    "load_ratio": "traffic.load_ratio",
    "service_coefficient_mbps": "traffic.service_coefficient_mbps",
}
"""Axis that `sweeps` had a key for -> what it varies."""

MODELS = {"radio.fading": "rayleigh", "traffic.arrivals": "poisson"}
"""Section -> the one model there was."""


def new_key(key: str, value: Any) -> str | None:
    """Say what has become of an old key; None for a key that is none."""
    if key == "linear_plant":
        return "the keys of linear_plant are those of plant now, with plant.model: linear"
    if key == "control.plant" and value == "linear":
        return "is plant.model: linear now"
    section, _, axis = key.partition(".")
    if section == "sweeps" and axis in AXES:
        return f"is sweeps.axes.{axis}.vary now: {{{AXES[axis]}: [...]}}"
    return f"is {OLD_KEYS[key]} now" if key in OLD_KEYS else None


def converted(written: Mapping[str, Any]) -> dict[str, Any]:
    """Return a resolved scenario with its old keys in their new places; others stay.

    Keys of models that were not in use are left out.
    """
    data = deepcopy(dict(written))
    path_loss, plant = _at(data, "radio.path_loss"), _at(data, "control.plant")
    unused = set()
    if path_loss == "none":
        unused |= {key for key in OLD_KEYS if OLD_KEYS[key].startswith("radio.path_loss.")}
        unused -= {"radio.path_loss"}
    if plant != "linear":
        unused |= {key for key in OLD_KEYS if key.startswith("linear_plant.")}
    for old, new in OLD_KEYS.items():
        value = _at(data, old)
        if value is _ABSENT or isinstance(value, Mapping):  # a mapping is of the new form
            continue
        section, name = old.split(".")
        del data[section][name]
        if old not in unused:
            _put(data, new, value)
    data.pop("linear_plant", None)
    for section, model in MODELS.items():
        if isinstance(_at(data, section), dict):
            _at(data, section).setdefault("model", model)
    _sweeps_to_axes(data)
    if plant is not _ABSENT:
        _put(data, "control.loop", "network" if plant == "linear" else plant)
        _put(data, "plant.model", "linear" if plant == "linear" else "unicycle")
    return data


def _sweeps_to_axes(data: dict[str, Any]) -> None:
    """Put the keys that sweeps had for what they vary into `axes`, in place."""
    sweeps = data.get("sweeps")
    if isinstance(sweeps, dict) and "axes" not in sweeps:
        if isinstance(data.get("gain_study"), dict) and "sampling_s" in sweeps:
            data["gain_study"].setdefault("sampling_s", sweeps["sampling_s"])
        axes = {name: sweeps.pop(name) for name in AXES if name in sweeps}
        sweeps["axes"] = {
            name: {"vary": {AXES[name]: values}, "policies": None}
            for name, values in axes.items()
            if values
        }


_ABSENT: Any = object()


def _at(data: Any, key: str) -> Any:
    for part in key.split("."):
        if not isinstance(data, Mapping) or part not in data:
            return _ABSENT
        data = data[part]
    return data


def _put(data: dict[str, Any], key: str, value: Any) -> None:
    *parents, name = key.split(".")
    for part in parents:
        data = data.setdefault(part, {})
    data[name] = value
