"""Checks across keys: what no single range can say."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from importlib import import_module
from inspect import signature
from operator import attrgetter
from typing import Any

from pydantic import ValidationError

from hiersched.core.extras import import_fault
from hiersched.core.faults import did_you_mean
from hiersched.core.parameters import no_multiple, read_strictly
from hiersched.core.registry import ALGORITHMS, BUILT_IN_ALGORITHMS
from hiersched.models.model import SECTIONS
from hiersched.models.plant.estimator import MAX_TURN_RATE_RADPS
from hiersched.models.plant.reference import greatest_turn_rate, period_s, tasks_of
from hiersched.policies.files import FilePolicy
from hiersched.policies.find import UNTRAINED, ImportedPolicy, untrained_names
from hiersched.scenario.fault_text import meant, own_faults
from hiersched.scenario.reference_file import reference_faults
from hiersched.scenario.schema import Family, Learning, Scenario, delay_steps, model_at

LEAST_SNR_DB = -80.0
"""Below it, a PRB in a deep fade could carry exactly 0 bit/s, and no logarithm of a rate exists."""
GREATEST_SNR_DB = 300.0
LEAST, GREATEST = 1e-12, 1e12
"""Numbers of a scenario, in SI units or those of their keys."""
LEAST_PRB_HZ, GREATEST_PRB_HZ = 1.0, 1e11
"""Rates are float32, in Mbit/s."""
MAX_DELAY_STEPS = 200
MAX_SUBSTEPS = 10_000
MOST_PERIOD_STEPS = 5_000_000
MOST_CHECKPOINTS = 1000
SWEPT_SECTIONS = (
    *("users", "radio", "traffic", "objective", "schedulers"),
    *("robot", "plant", "control", "policies"),
)
"""Sections of which a sweep can vary the keys: those that the slot loop reads."""
TASK_SECTIONS = tuple(section for section in SWEPT_SECTIONS if section != "policies")
"""Those of which a cell of the study of the task sets keys: its policies are its families."""
RESERVED_AXES = (
    *("evaluate", "generalise", "gain_study", "gain_grid", "gain_sampling_s", "gain_noise"),
    "gain_cells",
    *(
        "cell",
        "tune",
        "measure",
        "growth",
        "train",
        "gains",
        "bound",
        "stability",
        "resolve",
        "kernels",
        "claims",
    ),
)
"""Names of other experiments, of what they vary, and of jobs."""
RESERVED_LEARNERS = ("classical", "gains")
"""Names of jobs of policies that are not trained."""
NETWORK_METHODS = ("predictor", "latency_compensated", "h2", "lqg")
"""Gain methods for plants whose whole feedback crosses the network."""
OF_METHODS = ("control.method", "control.gain", "control.loop", "control.hold_samples")
"""Keys that follow from the method of a cell."""
LOOP_SECTIONS = ("robot", "control")
"""Sections whose keys the cells of the gain study vary."""
PREDICTING = ("predictor", "lqg")
"""Of them those that predict over the delay."""


def inconsistencies(scenario: Scenario, *, swept: bool = False) -> list[str]:
    """Every fault between keys, as ``key = value: what is allowed``; empty when there is none.

    A `swept` scenario is a point of a sweep: nothing else of the study runs in it.
    """
    if faults := _magnitudes(asdict(scenario)):
        return faults
    unfit = _users(scenario)
    if scenario.num_users > scenario.radio.num_prb:
        return unfit  # the others would form arrays of any size
    faults = [
        *unfit,
        *_link_budget(scenario),
        *_times(scenario),
        *_control(scenario),
        *_robot_kinds(scenario),
        *reference_faults(scenario, swept=swept),
    ]
    if scenario.control.known_motion and not faults:
        faults += _known_motion(scenario)
    for key in () if unfit else SECTIONS:  # they read a load of each user
        faults += _asked(key, model_at(scenario, key).faults, scenario)
    faults += [*_own_policies(scenario), *_learners(scenario)]
    worlds = ("evaluate", "sweeps", "generalise", "task_study")
    for name in ("sweeps",) if swept else worlds:
        faults += _multiples(scenario, "radio.slot_s", f"{name}.warmup_s", f"{name}.duration_s")
        faults += _policies(scenario, f"{name}.policies", getattr(scenario, name).policies)
    if not swept:
        for name in (*worlds, "gain_study"):
            faults += _once(f"{name}.seeds", getattr(scenario, name).seeds, "seed")
        faults += [*_axes(scenario), *_gain_study(scenario), *_task_study(scenario)]
        faults += [*_full_logs(scenario), *_cells(scenario)]
    return faults


def _magnitudes(data: Any, place: str = "", *, least: float = LEAST) -> list[str]:
    """List numbers that no quantity of a cell or a robot has: their products may overflow.

    Entries of matrices and points may be as small as rounding leaves them.
    """
    if isinstance(data, Mapping | list | tuple):
        items = data.items() if isinstance(data, Mapping) else enumerate(data)
        is_matrix = not isinstance(data, Mapping) and any(isinstance(v, tuple) for v in data)
        inner = 0.0 if is_matrix else least
        return [
            fault
            for key, value in items
            for fault in _magnitudes(value, f"{place}.{key}".lstrip("."), least=inner)
        ]
    if isinstance(data, bool) or not isinstance(data, int | float) or not math.isfinite(data):
        return []
    if data == 0 or least <= abs(data) <= GREATEST:
        return []
    return [f"{place} = {data}: must be 0, or from {LEAST:g} to {GREATEST:g} in magnitude"]


def _broken(*rules: tuple[bool, str]) -> list[str]:
    """Return what is said of the rules that are broken."""
    return [text for is_broken, text in rules if is_broken]


def _once(key: str, values: Sequence[Any], what: str) -> list[str]:
    """Check that nothing stands twice in a list."""
    try:
        twice = len(set(values)) < len(values)
    except TypeError:  # lists and mappings of an axis
        twice = any(value in values[:number] for number, value in enumerate(values))
    return _broken((twice, f"{key} = {list(values)}: every {what} once"))


def _multiples(scenario: Scenario, unit_key: str, *keys: str) -> list[str]:
    """Check that durations are 0 or multiples of another one."""
    unit = attrgetter(unit_key)(scenario)
    faults = []
    for key in keys:
        value = attrgetter(key)(scenario)
        faults += no_multiple(key, value, unit_key, unit) if value != 0.0 else []
    return faults


def _users(scenario: Scenario) -> list[str]:
    users = scenario.users
    if scenario.num_users > scenario.radio.num_prb:
        return [
            f"users.num_urllc + users.num_embb = {scenario.num_users}: at most radio.num_prb = "
            f"{scenario.radio.num_prb}, since every user gets one PRB or more"
        ]
    faults = []
    for name, count in (("urllc", users.num_urllc), ("embb", users.num_embb)):
        key = f"traffic.{name}_offered_mbps"
        value = attrgetter(key)(scenario)
        if isinstance(value, Sequence) and len(value) != count:
            faults.append(
                f"{key} has {len(value)} numbers, and users.num_{name} = {count}: must be one "
                f"number, or {count} of them"
            )
    return faults


def _robot_kinds(scenario: Scenario) -> list[str]:
    """Check which robots are of a kind, and in which keys they differ; not yet their values."""
    count, allowed = scenario.users.num_urllc, scenario.plant.kind_keys
    faults, taken = [], dict[int, str]()
    for name, kind in scenario.robot_kinds.items():
        place = f"robot_kinds.{name}"
        faults += _once(f"{place}.robots", kind.robots, "robot")
        if beyond := [robot for robot in kind.robots if robot >= count]:
            faults.append(
                f"{place}.robots = {list(kind.robots)}: robot {beyond[0]}: must be from 0 to "
                f"{count - 1} (users.num_urllc = {count})"
            )
        faults += [
            f"{place}.robots = {list(kind.robots)}: robot {robot} is of the kind {taken[robot]}"
            for robot in kind.robots
            if robot in taken
        ]
        taken |= dict.fromkeys(kind.robots, name)
        faults += [
            f"{place}.values.{key}: robots may not differ in it with plant.model = "
            f"{scenario.plant.model!r}; in: {', '.join(allowed) or 'nothing'}{meant(key, allowed)}"
            for key in kind.values
            if key not in allowed
        ]
    return faults


def _link_budget(scenario: Scenario) -> list[str]:
    radio = scenario.radio
    own = getattr(radio.fading, "scale", None)
    # A fading without a scale is taken to have the mean power 1.
    scale_db = 20.0 * math.log10(1.0 if own is None else own)
    best_db = radio.tx_power_dbm - radio.noise_dbm + scale_db
    least_db = best_db + radio.path_loss.least_gain_db()
    prb_hz = radio.bandwidth_hz / radio.num_prb
    return _broken(
        (
            not LEAST_PRB_HZ <= prb_hz <= GREATEST_PRB_HZ,
            f"radio.bandwidth_hz = {radio.bandwidth_hz}: {prb_hz:.6g} Hz a PRB, must be "
            f"{LEAST_PRB_HZ:g} to {GREATEST_PRB_HZ:g} Hz",
        ),
        (
            least_db < LEAST_SNR_DB or best_db > GREATEST_SNR_DB,
            f"radio.tx_power_dbm = {radio.tx_power_dbm}, radio.noise_dbm = {radio.noise_dbm}: the "
            f"signal-to-noise ratio goes from {least_db:.6g} dB to {best_db:.6g} dB (Rayleigh "
            f"scale, path loss and shadowing included), must stay within {LEAST_SNR_DB:g} dB to "
            f"{GREATEST_SNR_DB:g} dB",
        ),
    )


def _times(scenario: Scenario) -> list[str]:
    longest = scenario.max_delay_steps
    substeps = max(scenario.radio.slot_s, scenario.control.sampling_s) / scenario.robot.substep_s
    period = period_s(scenario.robot) / scenario.robot.substep_s
    return [
        *_multiples(scenario, "robot.substep_s", "radio.slot_s", "control.sampling_s"),
        *_tasks(scenario),
        *_multiples(scenario, "radio.slot_s", "robot.window_s"),
        *_multiples(scenario, "control.sampling_s", "robot.window_s"),
        *_broken(
            (
                period > MOST_PERIOD_STEPS,
                f"robot.reference = {scenario.robot.reference}: {period:.6g} substeps until it "
                f"repeats itself, at most {MOST_PERIOD_STEPS} (all of them are kept)",
            ),
            (
                substeps > MAX_SUBSTEPS,
                f"robot.substep_s = {scenario.robot.substep_s}: {substeps:.6g} substeps in a slot "
                f"or a control sample, at most {MAX_SUBSTEPS}",
            ),
            (
                longest > MAX_DELAY_STEPS,
                f"control.max_delay_s = {scenario.control.max_delay_s}: {longest} samples of "
                f"control.sampling_s, at most {MAX_DELAY_STEPS} (one gain is designed for each)",
            ),
        ),
    ]


def _tasks(scenario: Scenario) -> list[str]:
    """Check what operators drive, and how set-points reach the robots."""
    robot, plant, queue = scenario.robot, scenario.plant, scenario.traffic.queue
    faults = []
    try:
        tasks_of(robot, scenario.users.num_urllc)
    except ValueError as error:
        faults.append(str(error))
    for name in ("reach_duration_s", "reach_length_m", "reach_pause_s"):
        low, high = getattr(robot, name)
        if low > high:
            faults.append(f"robot.{name} = [{low}, {high}]: the least must come first")
    late = f"robot.set_point = {robot.set_point!r}"
    follows = f"traffic.queue.model = {queue.model!r}"
    return [
        *faults,
        *_broken(
            (
                robot.set_point != "present" and not plant.has_pose,
                f"{late}: needs a plant with a reference, not {plant.model!r}",
            ),
            (
                scenario.tracks_age and not getattr(queue, "tracks_packets", False),
                f"{follows}: must be one that follows packets (`tracks_packets`), such as 'fifo', "
                f"with {late} and control.delay = {scenario.control.delay!r}",
            ),
            (
                robot.superseding != "none" and not getattr(queue, "tracks_packets", False),
                f"{follows}: must be one that follows packets (`tracks_packets`), such as 'fifo', "
                f"with robot.superseding = {robot.superseding!r}",
            ),
            (
                robot.superseding != "none"
                and scenario.filter_size > 0
                and scenario.control.delay != "age",
                f"control.delay = {scenario.control.delay!r}: must be 'age' with control.method = "
                f"'lqg' and robot.superseding = {robot.superseding!r}",
            ),
        ),
    ]


def _control(scenario: Scenario) -> list[str]:
    """Name the first reason why the method does not suit its loop."""
    control, kind = scenario.control, scenario.loop_kind
    return _broken(
        (
            control.method in PREDICTING and control.hold_samples > 0,
            f"control.hold_samples = {control.hold_samples}: must be 0 with control.method = "
            f"{control.method!r} (a prediction over T samples is right for the delay T alone)",
        ),
        (
            control.method == "razumikhin" and kind == "network",
            "control.method = 'razumikhin': needs control.loop = 'split' (a plant with an "
            "eigenvalue on the unit circle whose whole feedback is delayed has no such "
            "certificate), or plant.A_d",
        ),
        (
            control.method in NETWORK_METHODS and kind != "network",
            f"control.method = {control.method!r}: needs control.loop = 'network' (it replaces "
            "the whole feedback by one made for the delay), or a linear plant without A_d",
        ),
        (
            control.known_motion and not scenario.plant.has_pose,
            "control.known_motion = true: needs a plant with a reference, not "
            f"{scenario.plant.model!r}",
        ),
        (
            control.known_motion and control.method != "lqg",
            "control.known_motion = true: needs control.method = 'lqg', whose filter goes by it",
        ),
        (
            scenario.playout_steps > MAX_DELAY_STEPS,
            f"control.playout_s = {control.playout_s}: {scenario.playout_steps} samples of "
            f"control.sampling_s, at most {MAX_DELAY_STEPS}",
        ),
        (
            control.link != "measurements" and control.method != "lqg",
            f"control.link = {control.link!r}: needs control.method = 'lqg' (commands for a time "
            "to come need a prediction)",
        ),
        (
            scenario.robot.superseding != "none" and scenario.playout_steps > 0,
            f"robot.superseding = {scenario.robot.superseding!r}: must be none with control.link = "
            "'playout' (every command has a sample of its own)",
        ),
    )[:1] or _asked("plant", _filter, scenario)


def _known_motion(scenario: Scenario) -> list[str]:
    """Name references that turn faster than a filter that goes by them has models for."""
    robot, faults = scenario.robot, []
    for task in dict.fromkeys(tasks_of(robot, scenario.users.num_urllc)):
        rate, keys = greatest_turn_rate(robot, task)
        if rate > MAX_TURN_RATE_RADPS:
            given = ", ".join(f"robot.{key} = {getattr(robot, key)}" for key in keys)
            faults.append(
                f"{given}: the reference {task.reference!r} turns at up to {rate:.6g} rad/s, must "
                f"be at most {MAX_TURN_RATE_RADPS} rad/s with control.known_motion = true"
            )
    return list(dict.fromkeys(faults))


def _filter(scenario: Scenario) -> list[str]:
    """Say why a plant has no filter where its method needs one."""
    if scenario.control.method != "lqg" or scenario.plant.faults(scenario):
        return []
    from hiersched.control import design_lqg

    try:
        design_lqg(scenario.plant.design(scenario), scenario.plant.filter_model(scenario))
    except ValueError as error:
        return [f"control.method = 'lqg': {error}"]
    return []


def _asked(key: str, ask: Callable[[Scenario], list[str]], scenario: Scenario) -> list[str]:
    """Faults that a model names; one of a plug-in may be at fault itself."""
    try:
        return ask(scenario)
    except Exception as error:
        return [f"{key}: its check of the scenario fails: {type(error).__name__}: {error}"]


def _own_policies(scenario: Scenario) -> list[str]:
    faults = []
    taken = dict.fromkeys(UNTRAINED, "a scheduler") | dict.fromkeys(scenario.learned, "a learner")
    for name, policy in scenario.policies.items():
        key = f"policies.{name}"
        if name in taken:
            faults.append(f"{key}: the name of {taken[name]}: must be another one")
        if isinstance(policy, ImportedPolicy):
            faults += _import_faults(key, policy)
        elif isinstance(policy, FilePolicy):
            faults += [f"{key}.{fault}" for fault in policy.faults(scenario)]
            if name in RESERVED_LEARNERS:
                faults.append(f"{key}: the name of jobs of the study: must be another one")
        else:
            faults += [f"{key}: {fault}" for fault in _asked(key, policy.faults, scenario)]
    return faults


def _import_faults(key: str, policy: ImportedPolicy) -> list[str]:
    source = policy.source
    module, _, name = source.partition(":")
    try:
        names = vars(import_module(module))
    except Exception as error:
        return [f"{key}.import = {source!r}: cannot be imported: {import_fault(error)}"]
    if name not in names:
        own = [other for other, thing in names.items() if callable(thing)]
        fault = f"cannot be imported: {module} has no {name}{did_you_mean(name, own)}"
        return [f"{key}.import = {source!r}: {fault}"]
    found = names[name]
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
    own = scenario.learning
    faults = _learning(scenario, "learning", own)
    taken = {own.algorithm: "learning.algorithm"}
    taken |= dict.fromkeys(UNTRAINED, "a scheduler")
    taken |= dict.fromkeys(RESERVED_LEARNERS, "jobs of the study")
    if taken[own.algorithm] == "a scheduler":
        faults.append(f"learning.algorithm = {own.algorithm}: the name of a scheduler")
    for name, learner in scenario.learners.items():
        if name in taken:
            faults.append(f"learners.{name}: the name of {taken[name]}: must be another one")
        if learner.reward_scale != own.reward_scale:
            faults.append(
                f"learners.{name}.reward_scale = {learner.reward_scale}: must be "
                f"learning.reward_scale = {own.reward_scale}, so that rewards compare"
            )
        faults += _learning(scenario, f"learners.{name}", learner)
    return faults


def _learning(scenario: Scenario, section: str, learning: Learning) -> list[str]:
    round_slots = learning.num_envs * learning.slots_per_episode
    is_es = learning.algorithm == "es"
    return [
        *_algorithm(section, learning),
        *_once(f"{section}.seeds", learning.seeds, "seed"),
        *_broken(
            (
                learning.episodes % learning.num_envs > 0,
                f"{section}.episodes = {learning.episodes}: must be a multiple of "
                f"{section}.num_envs = {learning.num_envs}",
            ),
            (
                learning.checkpoints > MOST_CHECKPOINTS,
                f"{section}.checkpoints = {learning.checkpoints}: at most {MOST_CHECKPOINTS}",
            ),
            (
                learning.algorithm == "ddpg" and learning.replay_capacity < round_slots,
                f"{section}.replay_capacity = {learning.replay_capacity}: at least "
                f"{section}.num_envs * {section}.slots_per_episode = {round_slots}",
            ),
            (
                learning.observe_robots and not scenario.plant.has_pose,
                f"{section}.observe_robots = true: must be false where plant.model = "
                f"{scenario.plant.model}, whose robots have no position",
            ),
            (
                learning.reward_terms == "control_drift" and not scenario.plant.has_pose,
                f"{section}.reward_terms = control_drift: must be drift_plus_penalty where "
                f"plant.model = {scenario.plant.model}, whose robots have no position",
            ),
            (
                learning.observe_demand and not scenario.plant.has_pose,
                f"{section}.observe_demand = true: must be false where plant.model = "
                f"{scenario.plant.model}, whose robots have no position",
            ),
            (
                learning.start == "drift_plus_penalty" and learning.algorithm == "ddpg",
                f"{section}.start = drift_plus_penalty: must be pf or max_weight with "
                f"{section}.algorithm = ddpg, whose actors need the gradient of the allocation",
            ),
            (
                learning.advantage == "user"
                and (learning.network == "mlp" or learning.reward == "cooperative"),
                f"{section}.advantage = user: must be slice or counterfactual where "
                f"{section}.network = mlp, which values no user, or {section}.reward = cooperative",
            ),
            (
                is_es and learning.num_envs % (2 * learning.pairs + 1) > 0,
                f"{section}.num_envs = {learning.num_envs}: must be a multiple of 2 * "
                f"{section}.pairs + 1 = {2 * learning.pairs + 1} with {section}.algorithm = es",
            ),
            (
                is_es and learning.frozen,
                f"{section}.frozen = true: must be false with {section}.algorithm = es, which puts "
                "no noise on actions",
            ),
            (
                is_es and learning.reward_terms != "drift_plus_penalty",
                f"{section}.reward_terms = {learning.reward_terms}: must be drift_plus_penalty "
                f"with {section}.algorithm = es, which is judged by its fitness",
            ),
            (
                is_es and learning.task_weight > 0.0,
                f"{section}.task_weight = {learning.task_weight}: must be 0 with "
                f"{section}.algorithm = es, which is judged by its fitness",
            ),
            (
                is_es and learning.fitness == "tracking" and not scenario.plant.has_pose,
                f"{section}.fitness = tracking: must be reward where plant.model = "
                f"{scenario.plant.model}, whose robots have no position",
            ),
            (
                learning.weighs == "drift" and learning.start != "drift_plus_penalty",
                f"{section}.weighs = drift: must be utility with {section}.start = "
                f"{learning.start}, which has no drift",
            ),
            (
                learning.batch_size > learning.replay_capacity,
                f"{section}.batch_size = {learning.batch_size}: at most "
                f"{section}.replay_capacity = {learning.replay_capacity}",
            ),
        ),
    ]


def _algorithm(section: str, learning: Learning) -> list[str]:
    """List an algorithm that nobody has registered, or keys that are not its own."""
    name, place, parameters = learning.algorithm, f"{section}.parameters", learning.parameters
    if name not in ALGORITHMS:
        return [f"{section}.algorithm = {name!r}: {ALGORITHMS.allowed(name)}"]
    found = None if name in BUILT_IN_ALGORITHMS else ALGORITHMS.loaded(name)
    if found is None and name not in BUILT_IN_ALGORITHMS:
        return []  # an installed one that is imported when it trains
    kind = getattr(found, "Parameters", None)
    if kind is not None:
        try:
            read_strictly(kind, parameters)
        except ValidationError as error:
            return own_faults(error, place, parameters, [field.name for field in fields(kind)])
    elif parameters:
        return [f"{place} = {dict(parameters)}: must be {{}}: {name} has no own keys"]
    return []


def _policies(scenario: Scenario, key: str, policies: tuple[str, ...]) -> list[str]:
    """List policies that stand twice, or that are no learner, no scheduler, none of `policies`."""
    known = [*scenario.learned, *untrained_names(scenario)]
    faults = _once(key, policies, "policy")
    for policy in policies:
        if policy not in known:
            fault = f"{policy} is no policy; allowed: {', '.join(known)}"
            fault += did_you_mean(policy, known)
            if policy in ALGORITHMS:
                fault = (
                    f"{policy} is not trained where learning.algorithm = "
                    f"{scenario.learning.algorithm} (and learners has none of this name)"
                )
            faults.append(f"{key} = {list(policies)}: {fault}")
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
            varied = f"{place}.vary.{key}"
            faults += [
                *_once(varied, values, "value"),
                *_broken(
                    (
                        key == "robot.reference_file",
                        f"{varied}: cannot be varied: its points are read but once (vary "
                        "robot.reference)",
                    ),
                    (
                        _is_of_file(scenario, key),
                        f"{varied}: cannot be varied: a policy's files are read but once (name "
                        "another policy under `policies`)",
                    ),
                    (
                        key.partition(".")[0] not in SWEPT_SECTIONS,
                        f"{varied}: must be a key of {', '.join(SWEPT_SECTIONS)} (what learners "
                        "differ in stands under `learners`)",
                    ),
                ),
            ]
        if isinstance(axis.policies, tuple):
            faults += _policies(scenario, f"{place}.policies", axis.policies)
    return faults


def _is_of_file(scenario: Scenario, key: str) -> bool:
    """Whether a dotted key names a policy in a file, its file or the hash of it."""
    section, *rest = key.split(".")
    entry = scenario.policies.get(rest[0]) if section == "policies" and rest else None
    if not isinstance(entry, FilePolicy):
        return False
    return len(rest) == 1 or rest[1].removesuffix("_sha256") in entry.file_keys


def _gain_study(scenario: Scenario) -> list[str]:
    study = scenario.gain_study
    faults = [
        f"gain_study.violation_windows = {window}: at most "
        f"gain_study.num_windows = {study.num_windows}"
        for window in study.violation_windows
        if window > study.num_windows
    ]
    for key in ("methods", "weight", "fixed_delay_s", "sampling_s"):
        faults += _once(f"gain_study.{key}", getattr(study, key), "value")
    position, heading = study.noise_position_m, study.noise_heading_rad
    pairs = list(zip(position, heading, strict=False))
    noise = f"gain_study.noise_position_m = {list(position)}"
    varied = {"robot.noise_position_m", "robot.noise_heading_rad"}
    own = [name for name, kind in scenario.robot_kinds.items() if varied & kind.values.keys()]
    faults += _broken(
        (
            len(position) != len(heading),
            f"{noise}: {len(position)} numbers, must be as many as in "
            f"gain_study.noise_heading_rad, {len(heading)}",
        ),
        (
            len(set(pairs)) != len(pairs),
            f"{noise}: every pair with gain_study.noise_heading_rad = {list(heading)} once",
        ),
        (
            bool(position) and bool(own),
            f"{noise}: must be [] where robots of a kind have noise of their own "
            f"(robot_kinds.{', '.join(own)})",
        ),
    )
    for name, cell in study.cells.items():
        place = f"gain_study.cells.{name}"
        if cell.methods is not None:
            faults += _once(f"{place}.methods", cell.methods, "method")
        faults += _cell_values(place, cell.values, LOOP_SECTIONS, OF_METHODS)
        longest = delay_steps(cell.delay_s, scenario.control.sampling_s)
        faults += _broken(
            (
                cell.methods is None and not study.cell_methods,
                f"{place}.methods = null: must name one or more, since gain_study.cell_methods "
                "= []",
            ),
            (
                longest > MAX_DELAY_STEPS,
                f"{place}.delay_s = {cell.delay_s}: {longest} samples of control.sampling_s, at "
                f"most {MAX_DELAY_STEPS}",
            ),
        )
    faults += _once("gain_study.cell_methods", study.cell_methods, "method")
    for key in ("violation_delay_s", "calm_delay_s"):
        low, high = getattr(study, key)
        if low > high:
            faults.append(f"gain_study.{key} = [{low}, {high}]: the lower bound first")
    return faults


def _cell_values(
    place: str, keys: Iterable[str], sections: Sequence[str], others: Sequence[str] = ()
) -> list[str]:
    """Check that a cell sets keys of some sections, but for those that others decide.

    Points of a reference are read but once, so its file is no key of a cell.
    """
    but = f", and none of {', '.join(others)}" if others else ""
    return [
        f"{place}.values.{key}: must be a key of {', '.join(sections)}{but}"
        for key in keys
        if key.partition(".")[0] not in sections or key in ("robot.reference_file", *others)
    ]


def _task_study(scenario: Scenario) -> list[str]:
    """Check families and cells; whether the scenario of a cell can be, `points` says."""
    study, known = scenario.task_study, list(scenario.task_study.families)
    faults = [
        *_once("task_study.design_seeds", study.design_seeds, "seed"),
        *_broken(
            (
                bool(study.cells) and not known,
                "task_study.families = {}: must name one or more, since there are cells",
            ),
            (
                bool(study.cells) and study.duration_s < scenario.traffic.embb_deadline_s,
                f"task_study.duration_s = {study.duration_s}: must be at least "
                f"traffic.embb_deadline_s = {scenario.traffic.embb_deadline_s}, so that eMBB "
                "packets fall due",
            ),
        ),
    ]
    taken = [*scenario.learned, *untrained_names(scenario)]
    for name, family in study.families.items():
        faults += _family(f"task_study.families.{name}", name in taken, family)
    for name, cell in study.cells.items():
        place = f"task_study.cells.{name}"
        if f"task_{name}" in scenario.sweeps.axes:
            faults.append(f"{place}: must be another name: sweeps.axes has task_{name}")
        faults += _cell_values(place, cell.values, TASK_SECTIONS)
        for key, bounds in (
            ("expected_rms", cell.expected_rms),
            ("expected_p99", cell.expected_p99),
        ):
            if bounds is not None and not bounds[0] < bounds[1]:
                faults.append(f"{place}.{key} = {list(bounds)}: the least first")
        if cell.families != "all":
            faults += _once(f"{place}.families", cell.families, "family")
            faults += [
                f"{place}.families = {list(cell.families)}: {family} is no family; allowed: "
                f"{', '.join(known)}"
                for family in cell.families
                if family not in known
            ]
    return faults


def _family(place: str, is_taken: bool, family: Family) -> list[str]:
    """Check that a family's range is of its rule's knob, which the study alone chooses."""
    rule, knob = family.policy, family.policy.knob
    if knob is None:
        return _broken(
            (is_taken, f"{place}: the name of a policy: must be another one"),
            (
                family.range is not None,
                f"{place}.range = {family.range}: must be null: {rule.model} has no knob",
            ),
        )
    given = getattr(rule, knob)
    low, high = family.range or (0.0, 0.0)
    return _broken(
        (is_taken, f"{place}: the name of a policy: must be another one"),
        (
            given != signature(type(rule)).parameters[knob].default,
            f"{place}.policy.{knob} = {given}: must be left out: the study chooses it",
        ),
        (
            not low < high,
            f"{place}.range = {None if family.range is None else list(family.range)}: must be "
            f"[least, greatest] of {knob}, the least first",
        ),
    )


def _full_logs(scenario: Scenario) -> list[str]:
    evaluate = scenario.evaluate
    total_s = evaluate.warmup_s + evaluate.duration_s
    return [
        *_broken(
            (
                evaluate.full_logs > len(evaluate.seeds),
                f"evaluate.full_logs = {evaluate.full_logs}: at most as many as evaluate.seeds, "
                f"{len(evaluate.seeds)}",
            )
        ),
        *_multiples(scenario, "radio.slot_s", "evaluate.full_log_s"),
        *_broken(
            (
                evaluate.full_logs > 0 and evaluate.full_log_s > total_s + 1e-9,
                f"evaluate.full_log_s = {evaluate.full_log_s}: at most evaluate.warmup_s + "
                f"evaluate.duration_s = {total_s:g}",
            )
        ),
    ]


def _cells(scenario: Scenario) -> list[str]:
    cells = [list(cell) for cell in scenario.generalise.cells]
    faults = [
        f"generalise.cells = {[num_urllc, num_embb, num_prb]}: {num_urllc} + {num_embb} users, at "
        f"most as many as its {num_prb} PRBs"
        for num_urllc, num_embb, num_prb in cells
        if num_urllc + num_embb > num_prb
    ]
    return faults + _once("generalise.cells", cells, "cell")
