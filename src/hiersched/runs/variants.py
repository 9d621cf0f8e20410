"""Variants of a scenario: the points of its sweeps, the loops of its gain study."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, TypeAlias, TypeVar

import numpy as np

from hiersched.scenario import Scenario, ScenarioError
from hiersched.scenario.consistency import inconsistencies
from hiersched.scenario.schema import Control, GainMethod, Users, hold_of

SWEPT_KEYS = {
    "rayleigh_scale": "radio.fading.scale",
    "sampling_s": "control.sampling_s",
    "reference": "robot.reference",
    "load": "traffic.load",
    "load_ratio": "traffic.embb_offered_mbps / traffic.urllc_offered_mbps",
    "service_coefficient_mbps": "traffic.service_coefficient_mbps, control.sampling_s",
}
"""Axis of a sweep -> what it varies: a key, or more than one."""

Gain = Literal["nominal", "adjusted"]
Cell: TypeAlias = tuple[int, int, int]
"""URLLC users, eMBB users, PRBs."""

STUDY_PLANTS: dict[GainMethod, Literal["network", "split"]] = {
    "krasovskii": "network",
    "razumikhin": "split",
    "predictor": "network",
    "latency_compensated": "network",
    "h2": "network",
}
"""Method of the gain study -> the plant that it is for."""

CLASSICAL_GROUP = "classical"
"""Policies that need no training share a job; each learner's have one of their own."""

STUDY_GAINS: tuple[Gain, ...] = ("nominal", "adjusted")


def value_text(value: float | str) -> str:
    """Return a swept value as it stands in file names: ``0.005``, ``1``, ``zigzag``."""
    return value if isinstance(value, str) else format(value, ".12g")


def swept_values(scenario: Scenario, axis: str) -> tuple[float | str, ...]:
    """Values of a sweep.

    Raises
    ------
    ValueError
        On an unknown axis.
    """
    if axis not in SWEPT_KEYS:
        raise ValueError(f"axis = {axis!r}: must be one of {', '.join(SWEPT_KEYS)}")
    values: tuple[float | str, ...] = getattr(scenario.sweeps, axis)
    if axis == "service_coefficient_mbps":
        intervals = scenario.sweeps.sampling_s
        ends = dict.fromkeys((min(intervals), max(intervals)))
        return tuple(f"beta{value_text(v)}_h{value_text(h)}" for v in values for h in ends)
    return values


def crossed_value(value: str) -> tuple[str, str]:
    """Coefficient beta and sampling interval of a point of the axis service_coefficient_mbps."""
    coefficient, sampling_s = value.split("_")
    return coefficient.removeprefix("beta"), sampling_s.removeprefix("h")


def swept_policies(scenario: Scenario, axis: str) -> tuple[str, ...]:
    """Policies of a sweep: along the load, which decides most, all that are evaluated.

    Along the axes that question a single claim the scenario's own learner and PF run. The exact
    optimum runs where a scenario names it and nowhere else: it is slow.
    """
    named: tuple[str, ...] = scenario.sweeps.policies
    if not swept_values(scenario, axis):
        return ()
    if axis in ("load_ratio", "service_coefficient_mbps"):
        pair = (scenario.learning.algorithm, "pf")
        return tuple(policy for policy in named if policy in pair)
    if axis != "load":
        return named
    evaluated = [policy for policy in scenario.evaluate.policies if policy != "exact"]
    return tuple(dict.fromkeys((*named, *evaluated)))


def swept_scenario(scenario: Scenario, axis: str, value: float | str) -> Scenario:
    """Return the scenario with one value of a sweep in place.

    Raises
    ------
    ScenarioError
        If the value does not fit the rest of the scenario.
    """
    if axis == "load_ratio":
        variant = _with_load_ratio(scenario, float(value))
    elif axis == "service_coefficient_mbps":
        coefficient, sampling_s = map(float, crossed_value(str(value)))
        variant = replace(
            scenario,
            traffic=replace(scenario.traffic, service_coefficient_mbps=coefficient),
            control=replace(scenario.control, sampling_s=sampling_s),
        )
    else:
        variant = replaced(scenario, SWEPT_KEYS[axis], value)
    return _checked(variant, f"sweeps.{axis} = {value_text(value)}")


T = TypeVar("T")


def replaced(thing: T, key: str, value: Any) -> T:
    """Return a scenario, or a part of it, with another value at a dotted key."""
    name, _, rest = key.partition(".")
    inner = replaced(getattr(thing, name), rest, value) if rest else value
    return replace(thing, **{name: inner})  # type: ignore[type-var]  # a dataclass


def _with_load_ratio(scenario: Scenario, ratio: float) -> Scenario:
    """Return the scenario with another ratio of the mean loads of eMBB and URLLC users.

    The sum of both means stays, and so does the spread within each slice.
    """
    traffic = scenario.traffic
    urllc, embb = np.mean(traffic.urllc_offered_mbps), np.mean(traffic.embb_offered_mbps)
    of_urllc = float((urllc + embb) / (1.0 + ratio) / urllc)
    of_embb = float(ratio * (urllc + embb) / (1.0 + ratio) / embb)
    changed = replace(
        traffic,
        urllc_offered_mbps=_times(traffic.urllc_offered_mbps, of_urllc),
        embb_offered_mbps=_times(traffic.embb_offered_mbps, of_embb),
    )
    return replace(scenario, traffic=changed)


def _times(offered_mbps: float | tuple[float, ...], factor: float) -> float | tuple[float, ...]:
    if isinstance(offered_mbps, Sequence):
        return tuple(load * factor for load in offered_mbps)
    return offered_mbps * factor


def cell_text(cell: Cell) -> str:
    """Return a cell as it stands in file names: ``u4_e16_k25``."""
    return "u{}_e{}_k{}".format(*cell)


def cell_scenario(scenario: Scenario, cell: Cell) -> Scenario:
    """Return the scenario in a cell of another size, its PRBs as wide as before.

    The loads of the users are as spread as the scenario's: each is the average of its part of the
    sorted list, so that users of twice as many have every load twice.

    Raises
    ------
    ScenarioError
        If the cell does not fit the rest of the scenario.
    """
    num_urllc, num_embb, num_prb = cell
    radio, traffic = scenario.radio, scenario.traffic
    bandwidth_hz = radio.bandwidth_hz / radio.num_prb * num_prb
    variant = replace(
        scenario,
        users=Users(num_urllc=num_urllc, num_embb=num_embb),
        radio=replace(radio, num_prb=num_prb, bandwidth_hz=bandwidth_hz),
        traffic=replace(
            traffic,
            urllc_offered_mbps=_spread(traffic.urllc_offered_mbps, num_urllc),
            embb_offered_mbps=_spread(traffic.embb_offered_mbps, num_embb),
        ),
    )
    return _checked(variant, f"generalise.cells = {list(cell)}")


def _spread(offered_mbps: float | tuple[float, ...], count: int) -> float | tuple[float, ...]:
    """Averages over `count` equal parts of the sorted loads; one number stays as it is."""
    if not isinstance(offered_mbps, Sequence):
        return offered_mbps
    loads = sorted(offered_mbps)
    each = [load for load in loads for _ in range(count)]  # count parts of len(loads) numbers
    parts = range(0, len(each), len(loads))
    return tuple(sum(each[part : part + len(loads)]) / len(loads) for part in parts)


def study_scenario(scenario: Scenario, method: GainMethod, gain: Gain) -> Scenario:
    """Return the scenario of the gain study: its robots, on the plant that the method is for.

    Raises
    ------
    ScenarioError
        If the method does not fit the rest of the scenario.
    """
    control = replace(_study_control(scenario, method), gain=gain)
    variant = replace(scenario, control=control)
    return robots_alone(variant, scenario.gain_study.num_robots, f"gain_study with {method}")


def _study_control(scenario: Scenario, method: GainMethod) -> Control:
    """Return the section `control` with a method of the gain study and the loop that it is for.

    A plant that decides its loop itself stays what it is; predictors are not held, and what has
    replaced a predictor is held as usual.
    """
    own = scenario.control
    loop = STUDY_PLANTS[method] if scenario.plant.chooses_loop else own.loop
    either = "predictor" in (method, own.method)
    hold_samples = hold_of(method) if either else own.hold_samples
    return replace(own, method=method, loop=loop, hold_samples=hold_samples)


def robots_alone(scenario: Scenario, num_robots: int, what: str) -> Scenario:
    """Return the scenario with so many robots, in a cell just large enough for them.

    Raises
    ------
    ScenarioError
        If the scenario does not hold together; `what` is named.
    """
    traffic = replace(scenario.traffic, urllc_offered_mbps=1.0, embb_offered_mbps=1.0)
    variant = replace(
        scenario,
        users=Users(num_urllc=num_robots, num_embb=1),
        radio=replace(scenario.radio, num_prb=num_robots + 1),
        traffic=traffic,
    )
    return _checked(variant, what)


def baseline_method(scenario: Scenario, method: GainMethod) -> GainMethod:
    """Return the method whose runs with nominal gains serve a method: the first on its plant."""
    plant = STUDY_PLANTS[method]
    return next(name for name in scenario.gain_study.methods if STUDY_PLANTS[name] == plant)


def weighted_scenario(scenario: Scenario, weight: float) -> Scenario:
    """Return the scenario with another weight q of its regulator."""
    return replace(scenario, control=replace(scenario.control, weight=weight))


def gain_designs(scenario: Scenario) -> dict[str, Scenario]:
    """Return the gain schedules of a study: name of the file -> the scenario it is designed for.

    ``schedule`` is the scenario's own; ``schedule_<h>`` are those of the other sampling intervals
    of the sweep; ``schedule_<method>`` those of the gain study that are not the scenario's own, and
    ``schedule_q<q>`` those of its other weights.
    """
    own = scenario.control
    designs = {"schedule": scenario}
    for value in scenario.sweeps.sampling_s:
        if value != own.sampling_s:
            designs[f"schedule_{value_text(value)}"] = swept_scenario(scenario, "sampling_s", value)
    for method in scenario.gain_study.methods:
        control = _study_control(scenario, method)
        if (control.method, control.loop) != (own.method, own.loop):
            designs[f"schedule_{method}"] = _checked(
                replace(scenario, control=control), f"gain_study with {method}"
            )
    for weight in scenario.gain_study.weight:
        if weight != own.weight:
            designs[f"schedule_q{value_text(weight)}"] = weighted_scenario(scenario, weight)
    return designs


def design_of(scenario: Scenario, variant: Scenario) -> str:
    """Return the name of the schedule, among `gain_designs`, that a variant needs."""
    wanted = _designed_for(variant.control)
    for name, design in gain_designs(scenario).items():
        if _designed_for(design.control) == wanted:
            return name
    raise ValueError(f"no gain schedule of this study is designed for {variant.control}")


def _designed_for(control: Control) -> Control:
    """Return what a schedule depends on: not how it is used."""
    return replace(control, gain="adjusted", hold_samples=0)


def learner_scenario(scenario: Scenario, learner: str) -> Scenario:
    """Return the scenario as one learner trains in it: its section `learning`, and no others.

    Lists of policies name this learner, by its algorithm, and the schedulers: the scenario holds
    together on its own, as a log's has to.

    Raises
    ------
    ValueError
        If there is no such learner.
    """
    if learner not in scenario.learned:
        raise ValueError(f"learner = {learner!r}: must be one of {', '.join(scenario.learned)}")
    learning = scenario.learned[learner]

    def own(policies: tuple[str, ...]) -> tuple[str, ...]:
        kept = [policy for policy in policies if policy not in scenario.learned]
        return (learning.algorithm, *kept)

    evaluate, sweeps, cells = scenario.evaluate, scenario.sweeps, scenario.generalise
    return replace(
        scenario,
        learning=learning,
        learners={},
        evaluate=replace(evaluate, policies=own(evaluate.policies)),
        sweeps=replace(sweeps, policies=own(sweeps.policies)),
        generalise=replace(cells, policies=own(cells.policies)),
    )


def policy_groups(scenario: Scenario) -> tuple[str, ...]:
    """List the groups of policies that share a job: the schedulers, and every learner."""
    return (CLASSICAL_GROUP, *scenario.learned)


def group_policies(scenario: Scenario, policies: tuple[str, ...], group: str) -> tuple[str, ...]:
    """Return the policies of a list that belong to a group, in their order."""
    if group == CLASSICAL_GROUP:
        return tuple(policy for policy in policies if policy not in scenario.learned)
    return tuple(policy for policy in policies if policy == group)


def group_runs(scenario: Scenario, group: str) -> bool:
    """Whether a policy of a group runs anywhere."""
    lists = [scenario.evaluate.policies, scenario.generalise.policies]
    lists += [swept_policies(scenario, axis) for axis in SWEPT_KEYS]
    return any(group_policies(scenario, policies, group) for policies in lists)


def check_variants(scenario: Scenario) -> None:
    """Check everything that a study derives from a scenario, before anything runs.

    Raises
    ------
    ScenarioError
        If a swept value does not fit the rest of the scenario; all faults are listed.
    """
    faults = []
    variants = [
        partial(swept_scenario, scenario, axis, value)
        for axis in SWEPT_KEYS
        for value in swept_values(scenario, axis)
    ]
    variants += [partial(cell_scenario, scenario, cell) for cell in scenario.generalise.cells]
    for variant in variants:
        try:
            variant()
        except ScenarioError as error:
            faults.append(str(error))
    if faults:
        raise ScenarioError("\n".join(faults))


def _checked(variant: Scenario, what: str) -> Scenario:
    faults = inconsistencies(variant)
    if faults:
        raise ScenarioError(
            "\n".join(f"scenario {variant.name}: {what}: {fault}" for fault in faults)
        )
    return variant
