"""Checks across keys: what no single range can say."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from importlib import import_module
from inspect import signature
from typing import Any

from pydantic import ValidationError

from hiersched.core.parameters import read_strictly
from hiersched.core.registry import ALGORITHMS, BUILT_IN_ALGORITHMS
from hiersched.models.model import SECTIONS
from hiersched.policies.find import UNTRAINED, ImportedPolicy, untrained_names
from hiersched.scenario.fault_text import own_faults
from hiersched.scenario.reference_file import reference_faults
from hiersched.scenario.schema import (
    Learning,
    Scenario,
    model_at,
)

LEAST_SNR_DB = -80.0
"""Below it, a PRB in a deep fade could carry exactly 0 bit/s, and no logarithm of a rate exists."""
GREATEST_SNR_DB = 300.0
MAX_DELAY_STEPS = 200
SWEPT_SECTIONS = (
    *("users", "radio", "traffic", "objective", "schedulers"),
    *("robot", "plant", "control", "policies"),
)
"""Sections of which a sweep can vary the keys: those that the slot loop reads."""
RESERVED_AXES = (
    *("evaluate", "generalise", "gain_study", "gain_grid", "gain_sampling_s", "gain_noise"),
    *("cell", "measure", "train"),
)
"""Names of other experiments, of what they vary, and of jobs."""
RESERVED_LEARNERS = ("classical", "gains")
"""Names of jobs of policies that are not trained."""
NETWORK_METHODS = ("predictor", "latency_compensated", "h2")
"""Gain methods for plants whose whole feedback crosses the network."""


def inconsistencies(scenario: Scenario, *, swept: bool = False) -> list[str]:
    """Every fault between keys, as ``key = value: what is allowed``; empty when there is none.

    A `swept` scenario is a point of a sweep: nothing else of the study runs in it.
    """
    loads = _loads(scenario)
    return [
        *_users(scenario),
        *loads,
        *_link_budget(scenario),
        *_times(scenario),
        *_control(scenario),
        *reference_faults(scenario, swept=swept),
        *([] if loads else _models(scenario)),  # they read one load a user
        *_own_policies(scenario),
        *_learners(scenario),
        *_worlds(scenario, ("sweeps",) if swept else ("evaluate", "sweeps", "generalise")),
        *([] if swept else [*_studies(scenario), *_full_logs(scenario), *_cells(scenario)]),
    ]


def _users(scenario: Scenario) -> list[str]:
    if scenario.num_users <= scenario.radio.num_prb:
        return []
    return [
        f"users.num_urllc + users.num_embb = {scenario.num_users}: at most radio.num_prb = "
        f"{scenario.radio.num_prb}, since every user gets one PRB or more"
    ]


def _loads(scenario: Scenario) -> list[str]:
    users, traffic = scenario.users, scenario.traffic
    return [
        f"{key} = {list(value)}: {len(value)} numbers, must be one number or {count}"
        for key, value, count in (
            ("traffic.urllc_offered_mbps", traffic.urllc_offered_mbps, users.num_urllc),
            ("traffic.embb_offered_mbps", traffic.embb_offered_mbps, users.num_embb),
        )
        if isinstance(value, Sequence) and len(value) != count
    ]


def _link_budget(scenario: Scenario) -> list[str]:
    radio = scenario.radio
    own = getattr(radio.fading, "scale", None)
    # A fading without a scale is taken to have the mean power 1.
    scale_db = 20.0 * math.log10(1.0 if own is None else own)
    best_db = radio.tx_power_dbm - radio.noise_dbm + scale_db
    least_db = best_db + radio.path_loss.least_gain_db()
    if least_db >= LEAST_SNR_DB and best_db <= GREATEST_SNR_DB:
        return []
    return [
        f"radio.tx_power_dbm = {radio.tx_power_dbm}, radio.noise_dbm = {radio.noise_dbm}: the "
        f"signal-to-noise ratio goes from {least_db:.6g} dB to {best_db:.6g} dB (Rayleigh scale, "
        f"path loss and shadowing included), must stay within {LEAST_SNR_DB:g} dB to "
        f"{GREATEST_SNR_DB:g} dB"
    ]


def _is_multiple(value: float, unit: float) -> bool:
    ratio = value / unit
    return ratio > 0.5 and abs(ratio - round(ratio)) < 1e-9


def _times(scenario: Scenario) -> list[str]:
    substep = scenario.robot.substep_s
    faults = [
        f"{key} = {value}: must be a multiple of robot.substep_s = {substep}"
        for key, value in (
            ("radio.slot_s", scenario.radio.slot_s),
            ("control.sampling_s", scenario.control.sampling_s),
        )
        if not _is_multiple(value, substep)
    ]
    if not _is_multiple(scenario.robot.window_s, scenario.radio.slot_s):
        faults.append(
            f"robot.window_s = {scenario.robot.window_s}: must be a multiple of "
            f"radio.slot_s = {scenario.radio.slot_s}"
        )
    if not _is_multiple(scenario.robot.window_s, scenario.control.sampling_s):
        faults.append(
            f"robot.window_s = {scenario.robot.window_s}: must be a multiple of "
            f"control.sampling_s = {scenario.control.sampling_s}"
        )
    if (longest := scenario.max_delay_steps) > MAX_DELAY_STEPS:
        faults.append(
            f"control.max_delay_s = {scenario.control.max_delay_s}: {longest} samples of "
            f"control.sampling_s, at most {MAX_DELAY_STEPS} (one gain is designed for each)"
        )
    return faults


def _control(scenario: Scenario) -> list[str]:
    control = scenario.control
    if control.method == "predictor" and control.hold_samples:
        return [
            f"control.hold_samples = {control.hold_samples}: must be 0 with control.method = "
            "'predictor' (a prediction over T samples is right for the delay T alone)"
        ]
    kind = scenario.loop_kind
    if control.method == "razumikhin" and kind == "network":
        return [
            "control.method = 'razumikhin': needs control.loop = 'split' (a plant with an "
            "eigenvalue on the unit circle whose whole feedback is delayed has no such "
            "certificate), or plant.A_d"
        ]
    if control.method in NETWORK_METHODS and kind != "network":
        return [
            f"control.method = {control.method!r}: needs control.loop = 'network' (it replaces "
            "the whole feedback by one made for the delay), or a linear plant without A_d"
        ]
    return []


def _models(scenario: Scenario) -> list[str]:
    """List what the models themselves find."""
    faults = []
    for key in SECTIONS:
        faults += _asked(key, model_at(scenario, key).faults, scenario)
    return faults


def _asked(key: str, ask: Callable[[Scenario], list[str]], scenario: Scenario) -> list[str]:
    """Faults that a model names; one of a plug-in may be at fault itself."""
    try:
        return ask(scenario)
    except Exception as error:
        return [f"{key}: its check of the scenario fails: {type(error).__name__}: {error}"]


def _own_policies(scenario: Scenario) -> list[str]:
    faults = []
    taken = dict.fromkeys(UNTRAINED, "a scheduler")
    taken |= dict.fromkeys(scenario.learned, "a learner")
    for name, policy in scenario.policies.items():
        if name in taken:
            faults.append(f"policies.{name}: the name of {taken[name]}: must be another one")
        if isinstance(policy, ImportedPolicy):
            faults += _import_faults(f"policies.{name}", policy)
        else:
            asked = _asked(f"policies.{name}", policy.faults, scenario)
            faults += [f"policies.{name}: {fault}" for fault in asked]
    return faults


def _import_faults(key: str, policy: ImportedPolicy) -> list[str]:
    source = policy.source
    module, _, name = source.partition(":")
    try:
        found = getattr(import_module(module), name)
    except Exception as error:
        return [
            f"{key}.import = {source!r}: cannot be imported: {type(error).__name__}: {error} "
            "(name its file under `plugins`)"
        ]
    if not callable(found):
        return [f"{key}.import = {source!r}: must be a function"]
    try:
        signature(found).bind(None, **policy.parameters)
    except TypeError as error:
        return [f"{key}.parameters of {source}{signature(found)}: {error}"]
    except ValueError:  # a function of a library may have no signature
        pass
    return []


def _learners(scenario: Scenario) -> list[str]:
    faults = _learning(scenario, "learning", scenario.learning)
    taken = {scenario.learning.algorithm: "learning.algorithm"}
    taken |= dict.fromkeys(UNTRAINED, "a scheduler")
    taken |= dict.fromkeys(RESERVED_LEARNERS, "jobs of the study")
    if taken[scenario.learning.algorithm] == "a scheduler":
        faults.append(
            f"learning.algorithm = {scenario.learning.algorithm}: the name of a scheduler"
        )
    for name, learner in scenario.learners.items():
        if name in taken:
            faults.append(f"learners.{name}: the name of {taken[name]}: must be another one")
        if learner.reward_scale != scenario.learning.reward_scale:
            faults.append(
                f"learners.{name}.reward_scale = {learner.reward_scale}: must be "
                f"learning.reward_scale = {scenario.learning.reward_scale}, so that rewards compare"
            )
        faults += _learning(scenario, f"learners.{name}", learner)
    return faults


def _learning(scenario: Scenario, section: str, learning: Learning) -> list[str]:
    faults = _algorithm(section, learning)
    if len(set(learning.seeds)) != len(learning.seeds):
        faults.append(f"{section}.seeds = {list(learning.seeds)}: every seed once")
    if learning.episodes % learning.num_envs:
        faults.append(
            f"{section}.episodes = {learning.episodes}: must be a multiple of "
            f"{section}.num_envs = {learning.num_envs}"
        )
    round_slots = learning.num_envs * learning.slots_per_episode
    if learning.replay_capacity < round_slots:
        faults.append(
            f"{section}.replay_capacity = {learning.replay_capacity}: at least "
            f"{section}.num_envs * {section}.slots_per_episode = {round_slots}"
        )
    if learning.observe_robots and not scenario.plant.has_pose:
        faults.append(
            f"{section}.observe_robots = true: must be false where plant.model = "
            f"{scenario.plant.model}, whose robots have no position"
        )
    if learning.start == "drift_plus_penalty" and learning.algorithm == "ddpg":
        faults.append(
            f"{section}.start = drift_plus_penalty: must be pf or max_weight with "
            f"{section}.algorithm = ddpg, whose actors need the gradient of the allocation"
        )
    if learning.batch_size > learning.replay_capacity:
        faults.append(
            f"{section}.batch_size = {learning.batch_size}: at most {section}.replay_capacity = "
            f"{learning.replay_capacity}"
        )
    return faults


def _algorithm(section: str, learning: Learning) -> list[str]:
    """List an algorithm that nobody has registered, or keys that are not its own."""
    name, parameters = learning.algorithm, learning.parameters
    if name not in ALGORITHMS:
        return [f"{section}.algorithm = {name!r}: {ALGORITHMS.allowed()}"]
    found = None if name in BUILT_IN_ALGORITHMS else ALGORITHMS.loaded(name)
    if found is None and name not in BUILT_IN_ALGORITHMS:
        return []  # an installed one that is imported when it trains
    kind = getattr(found, "Parameters", None)
    if kind is not None:
        return _parameter_faults(kind, f"{section}.parameters", parameters)
    if parameters:
        return [f"{section}.parameters = {dict(parameters)}: must be {{}}: {name} has no own keys"]
    return []


def _parameter_faults(kind: type, place: str, values: Mapping[str, Any]) -> list[str]:
    try:
        read_strictly(kind, values)
    except ValidationError as error:
        return own_faults(error, place, values, [field.name for field in fields(kind)])
    return []


def _studies(scenario: Scenario) -> list[str]:
    faults = []
    held_out = {
        "evaluate.seeds": scenario.evaluate.seeds,
        "sweeps.seeds": scenario.sweeps.seeds,
        "generalise.seeds": scenario.generalise.seeds,
        "gain_study.seeds": scenario.gain_study.seeds,
    }
    for key, seeds in held_out.items():
        if len(set(seeds)) != len(seeds):
            faults.append(f"{key} = {list(seeds)}: every seed once")
    faults.extend(_axes(scenario))
    study = scenario.gain_study
    faults.extend(
        f"gain_study.violation_windows = {window}: at most "
        f"gain_study.num_windows = {study.num_windows}"
        for window in study.violation_windows
        if window > study.num_windows
    )
    faults.extend(_gain_sweeps(scenario))
    for key, (low, high) in (
        ("gain_study.violation_delay_s", study.violation_delay_s),
        ("gain_study.calm_delay_s", study.calm_delay_s),
    ):
        if low > high:
            faults.append(f"{key} = [{low}, {high}]: the lower bound first")
    return faults


def _worlds(scenario: Scenario, names: Sequence[str]) -> list[str]:
    """List durations that are no slots, and policies that nobody is or that stand twice."""
    faults = []
    slot_s = scenario.radio.slot_s
    for name in names:
        section = getattr(scenario, name)
        for key, value in (("warmup_s", section.warmup_s), ("duration_s", section.duration_s)):
            if value != 0.0 and not _is_multiple(value, slot_s):
                faults.append(
                    f"{name}.{key} = {value}: must be a multiple of radio.slot_s = {slot_s}"
                )
        if len(set(section.policies)) != len(section.policies):
            faults.append(f"{name}.policies = {list(section.policies)}: every policy once")
        faults.extend(_policies(scenario, f"{name}.policies", section.policies))
    return faults


def _axes(scenario: Scenario) -> list[str]:
    """List axes whose names or policies cannot be; whether their points can, `points` says."""
    faults = []
    for name, axis in scenario.sweeps.axes.items():
        place = f"sweeps.axes.{name}"
        if name in RESERVED_AXES:
            faults.append(
                f"{place}: must be another name than {', '.join(RESERVED_AXES)}: parts of the "
                "study are called so"
            )
        for key, values in axis.vary.items():
            if any(value in values[:number] for number, value in enumerate(values)):
                faults.append(f"{place}.vary.{key} = {list(values)}: every value once")
            if key == "robot.reference_file":
                faults.append(
                    f"{place}.vary.{key}: cannot be varied: its points are read but once (vary "
                    "robot.reference)"
                )
            if key.partition(".")[0] not in SWEPT_SECTIONS:
                faults.append(
                    f"{place}.vary.{key}: must be a key of {', '.join(SWEPT_SECTIONS)} (what "
                    "learners differ in stands under `learners`)"
                )
        if isinstance(axis.policies, tuple):
            if len(set(axis.policies)) != len(axis.policies):
                faults.append(f"{place}.policies = {list(axis.policies)}: every policy once")
            faults.extend(_policies(scenario, f"{place}.policies", axis.policies))
    return faults


def _full_logs(scenario: Scenario) -> list[str]:
    evaluate, slot_s = scenario.evaluate, scenario.radio.slot_s
    total_s = evaluate.warmup_s + evaluate.duration_s
    faults = []
    if evaluate.full_logs > len(evaluate.seeds):
        faults.append(
            f"evaluate.full_logs = {evaluate.full_logs}: at most as many as evaluate.seeds, "
            f"{len(evaluate.seeds)}"
        )
    if not _is_multiple(evaluate.full_log_s, slot_s):
        faults.append(
            f"evaluate.full_log_s = {evaluate.full_log_s}: must be a multiple of "
            f"radio.slot_s = {slot_s}"
        )
    if evaluate.full_logs and evaluate.full_log_s > total_s + 1e-9:
        faults.append(
            f"evaluate.full_log_s = {evaluate.full_log_s}: at most evaluate.warmup_s + "
            f"evaluate.duration_s = {total_s:g}"
        )
    return faults


def _policies(scenario: Scenario, key: str, policies: tuple[str, ...]) -> list[str]:
    """Policies that nobody is: no learner, no scheduler, none of `policies`."""
    known = [*scenario.learned, *untrained_names(scenario)]
    faults = []
    for policy in policies:
        if policy in ALGORITHMS and policy not in known:
            faults.append(
                f"{key} = {list(policies)}: {policy} is not trained where learning.algorithm = "
                f"{scenario.learning.algorithm} (and learners has none of this name)"
            )
        elif policy not in known:
            faults.append(
                f"{key} = {list(policies)}: {policy} is no policy; allowed: {', '.join(known)}"
            )
    return faults


def _gain_sweeps(scenario: Scenario) -> list[str]:
    study = scenario.gain_study
    faults = [
        f"gain_study.{key} = {list(points)}: every value once"
        for key, points in (
            ("methods", study.methods),
            ("weight", study.weight),
            ("fixed_delay_s", study.fixed_delay_s),
            ("sampling_s", study.sampling_s),
        )
        if len(set(points)) != len(points)
    ]
    position, heading = study.noise_position_m, study.noise_heading_rad
    if len(position) != len(heading):
        faults.append(
            f"gain_study.noise_position_m = {list(position)}: {len(position)} numbers, must be as "
            f"many as in gain_study.noise_heading_rad, {len(heading)}"
        )
    if len(set(zip(position, heading, strict=False))) != min(len(position), len(heading)):
        faults.append(
            f"gain_study.noise_position_m = {list(position)}: every pair with "
            f"gain_study.noise_heading_rad = {list(heading)} once"
        )
    return faults


def _cells(scenario: Scenario) -> list[str]:
    cells = scenario.generalise.cells
    faults = [
        f"generalise.cells = {list(cell)}: {cell[0]} + {cell[1]} users, at most as many as its "
        f"{cell[2]} PRBs"
        for cell in cells
        if cell[0] + cell[1] > cell[2]
    ]
    if len(set(cells)) != len(cells):
        faults.append(f"generalise.cells = {[list(cell) for cell in cells]}: every cell once")
    return faults
