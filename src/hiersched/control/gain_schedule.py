"""Gain schedules: gains for every delay, designed once, cached, and looked up online."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from pathlib import Path
from typing import Any

import numpy as np

from hiersched.control.checks import as_delay_steps
from hiersched.control.delayed_plant import DelayedPlant
from hiersched.control.gain_table import GainSchedule
from hiersched.control.methods import DEFAULT_DECAY_RATE, Method

logger = logging.getLogger(__name__)

DESIGN_VERSION = 2
"""Part of the cache key: raise it when the design algorithm changes its results."""


def design_key(plant: DelayedPlant, max_delay_steps: int, method: Method, decay_rate: float) -> str:
    """Return the SHA-256 of everything that a schedule depends on.

    Parameters
    ----------
    plant, max_delay_steps, method, decay_rate
        As for `build_schedule`.

    Returns
    -------
    str
        64 hexadecimal digits.
    """
    inputs: dict[str, Any] = {
        "design_version": DESIGN_VERSION,
        "method": method,
        "decay_rate": decay_rate if method == "razumikhin" else None,
        "max_delay_steps": as_delay_steps("max_delay_steps", max_delay_steps),
        "kind": plant.kind,
        "sampling_s": plant.sampling_s,
    }
    for name in ("A", "B", "Q", "R", "nominal_gain", "A_d", "operator_gain"):
        array = getattr(plant, name)
        inputs[name] = None if array is None else array.tolist()
    text = json.dumps(inputs, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def build_schedule(
    plant: DelayedPlant,
    max_delay_steps: int,
    method: Method = "krasovskii",
    *,
    decay_rate: float = DEFAULT_DECAY_RATE,
) -> GainSchedule:
    """Design the gain of every delay 0..T_max; each is the one `design_gain` returns.

    Parameters
    ----------
    plant : DelayedPlant
        The plant and its nominal gain.
    max_delay_steps : int
        Longest delay T_max in samples.
    method : {"krasovskii", "razumikhin", "predictor", "latency_compensated", "h2"}
        How the gains are chosen; see `GainDesigner`.
    decay_rate : float
        Decay of V per sample that C1 has to certify, in (0, 1); no other method uses it.

    Returns
    -------
    GainSchedule
        The table.

    Raises
    ------
    ValueError
        If the method, the rate or the delay is not allowed.
    """
    from hiersched.control.design import GainDesigner

    designer = GainDesigner(plant, method=method, decay_rate=decay_rate)
    steps = as_delay_steps("max_delay_steps", max_delay_steps)
    designs = [designer.design(delay) for delay in range(steps + 1)]
    logger.info(
        "designed %d gains in %.1f s: %s, %s plant, sampling %.4g s",
        len(designs),
        sum(design.solve_time_s for design in designs),
        method,
        plant.kind,
        plant.sampling_s,
    )
    inputs = plant.B.shape[1]
    input_gains = np.zeros((steps + 1, steps, inputs, inputs))
    for delay, design in enumerate(designs):
        input_gains[delay, :delay] = design.input_gains
    return GainSchedule(
        gains=np.stack([design.gain for design in designs]),
        status=tuple(design.status for design in designs),
        certificates=tuple(design.certificate for design in designs),
        nominal=plant.nominal_gain,
        input_gains=input_gains,
        operator_gain=plant.operator_gain,
        kind=plant.kind,
        method=method,
        decay_rate=decay_rate if method == "razumikhin" else None,
        sampling_s=plant.sampling_s,
        key=design_key(plant, steps, method, decay_rate),
    )


def load_or_build(
    path: str | os.PathLike[str],
    plant: DelayedPlant,
    max_delay_steps: int,
    method: Method = "krasovskii",
    *,
    decay_rate: float = DEFAULT_DECAY_RATE,
) -> GainSchedule:
    """Return the schedule cached at `path` if it is this design's, else build and store it.

    A cached schedule passes its certificates again before it is used. The file is replaced
    atomically.

    Parameters
    ----------
    path : path-like
        The cache file (JSON).
    plant, max_delay_steps, method, decay_rate
        As for `build_schedule`.

    Returns
    -------
    GainSchedule
        The table.

    Raises
    ------
    ValueError
        If the method, the rate or the delay is not allowed.
    OSError
        If the file cannot be read or written.
    """
    target = Path(path)
    key = design_key(plant, max_delay_steps, method, decay_rate)
    if target.exists():
        try:
            schedule = GainSchedule.from_json(target.read_text(encoding="utf-8"))
            if schedule.key == key:
                schedule.verify(plant)
                return schedule
            logger.info("%s holds another design's gains; designing anew", target)
        except ValueError as error:
            logger.warning("%s is not usable (%s); designing anew", target, error)
    schedule = build_schedule(plant, max_delay_steps, method, decay_rate=decay_rate)
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f"{target.name}.{os.getpid()}.part")
    part.write_text(schedule.to_json(), encoding="utf-8")
    os.replace(part, target)
    return schedule
