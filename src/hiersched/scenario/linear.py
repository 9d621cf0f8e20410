"""Robots that are a linear plant: from the matrices of a scenario to the plant of the gains."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hiersched.scenario.schema import Scenario

if TYPE_CHECKING:
    from hiersched.control import DelayedPlant

REQUIRED = ("A", "B", "Q", "R", "process_noise", "measurement_noise", "error_states")


def linear_plant(scenario: Scenario) -> DelayedPlant:
    """Return the plant of section `linear_plant`.

    Without A_d the whole feedback crosses the network (``network``); with it the feedback K, the
    regulator of (A, B), acts at once, and A_d x(k-d) is what the network delays (``split``).

    Raises
    ------
    ValueError
        As `hiersched.control.DelayedPlant` and `dlqr`; the message begins with the matrix.
    """
    from hiersched.control import DelayedPlant, dlqr, network_plant

    section, sampling_s = scenario.linear_plant, scenario.control.sampling_s
    A, B, Q, R = (getattr(section, name) for name in ("A", "B", "Q", "R"))
    if section.A_d is None:
        return network_plant(A, B, Q, R, sampling_s=sampling_s)
    return DelayedPlant(
        A=A,
        B=B,
        Q=Q,
        R=R,
        kind="split",
        nominal_gain=dlqr(A, B, Q, R)[0],
        A_d=section.A_d,  # type: ignore[arg-type]  # converted there
        sampling_s=sampling_s,
    )


def linear_faults(scenario: Scenario) -> list[str]:
    """Say what is wrong with the section `linear_plant`, where the scenario uses it."""
    control, section = scenario.control, scenario.linear_plant
    if control.plant != "linear":
        return []
    missing = [name for name in REQUIRED if getattr(section, name) is None]
    if missing:
        return [
            f"linear_plant.{name} = null: needed by control.plant = 'linear'" for name in missing
        ]
    ragged = [
        f"linear_plant.{name}: rows of {sorted({len(row) for row in matrix})} values, must be "
        "as long as each other"
        for name in ("A", "A_d", "B", "Q", "R")
        if (matrix := getattr(section, name)) is not None and len({len(r) for r in matrix}) != 1
    ]
    if ragged:
        return ragged
    try:
        plant = linear_plant(scenario)
    except ValueError as error:
        text = str(error)
        return [f"linear_plant.{text}" if text[0].isalpha() else f"linear_plant: {text}"]
    n, m = plant.B.shape
    return [*_vector_faults(scenario, n, m), *_time_faults(scenario)]


def _vector_faults(scenario: Scenario, n: int, m: int) -> list[str]:
    section = scenario.linear_plant
    faults = [
        f"linear_plant.{name} = {list(values)}: {len(values)} values, must be {count}, one a {what}"
        for name, values, count, what in (
            ("process_noise", section.process_noise, n, "state"),
            ("measurement_noise", section.measurement_noise, n, "state"),
            ("input_limits", section.input_limits, m, "input"),
        )
        if values is not None and len(values) != count
    ]
    states = section.error_states or ()
    if len(set(states)) != len(states) or any(state >= n for state in states):
        faults.append(
            f"linear_plant.error_states = {list(states)}: must be different, from 0 to {n - 1}"
        )
    return faults


def _time_faults(scenario: Scenario) -> list[str]:
    sampling_s, slot_s = scenario.control.sampling_s, scenario.radio.slot_s
    faults = []
    if abs(sampling_s / slot_s - round(sampling_s / slot_s)) > 1e-9 or sampling_s < 0.5 * slot_s:
        faults.append(
            f"control.sampling_s = {sampling_s}: must be a multiple of radio.slot_s = {slot_s} "
            "with control.plant = 'linear'"
        )
    if scenario.sweeps.sampling_s != (sampling_s,):
        faults.append(
            f"sweeps.sampling_s = {list(scenario.sweeps.sampling_s)}: must be [{sampling_s}] "
            "with control.plant = 'linear', whose matrices hold for control.sampling_s alone"
        )
    return faults
