"""What a study runs: experiments, each a list of points, policies and seeds.

A point is the scenario with some of its values replaced; evaluation, sweeps, cells of other sizes
and the gain study are instances.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import product
from math import prod
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hiersched.core.randomness import STREAM_DELAY, draw_uniforms
from hiersched.policies.files import FilePolicy
from hiersched.policies.registry import Rule
from hiersched.scenario import Scenario, ScenarioError, scenario_faults, with_values
from hiersched.scenario.schema import (
    Family,
    GainMethod,
    RobotKind,
    Users,
    Worlds,
    delay_steps,
    hold_of,
)

Gain = Literal["nominal", "adjusted"]
Cell: TypeAlias = tuple[int, int, int]
"""URLLC users, eMBB users, PRBs."""

TASK = "task"
"""Stage of the study of the task, and the beginning of the names of its experiments."""
TUNED, FLOOR = "tuned", "floor"
"""Points of its cells: families at their tuned knobs; set-points that are always present."""
REFERENCE = "drift_plus_penalty"
"""Whose eMBB throughput its families keep."""

STUDY_PLANTS: dict[GainMethod, Literal["network", "split"]] = {
    "krasovskii": "network",
    "razumikhin": "split",
    "predictor": "network",
    "lqg": "network",
    "latency_compensated": "network",
    "h2": "network",
}
"""Method of the gain study -> the plant that it is for."""

GAINS: tuple[Gain, ...] = ("nominal", "adjusted")
"""What stands for policies in the gain study, where delays are forced and nobody decides."""

BASELINE = "pf"
CLASSICAL_GROUP = "classical"
"""Policies that need no training share a job; each learner's have one of their own.

So has a policy in a file: a changed file, or a library that is missing, touches no other's runs.
"""
LOOP_CELLS = "gain_cells"
"""Experiment of the cells of the gain study."""
GAIN_GROUP = "gains"
"""The loops of the gain study share a job."""
MOST_POINTS = 1000
"""Of an axis: each is a job's work, and its name a folder."""
MAX_NAME = 120
"""Characters of the name of a point: it is a folder."""


@dataclass(frozen=True, kw_only=True)
class ForcedDelays:
    """Network delays that are drawn instead of measured: uniform per slot and robot.

    As a ``sawtooth`` they are the same at all slots of a control sample, and grow from one sample
    by one a sample, as the age of what waits in a queue does, to the greatest of `violation_s` and
    back at once, each robot at a place of its own; ends count twice.
    """

    windows: tuple[int, ...]  # of violated delay, 1 = the first
    violation_s: tuple[float, float]  # bounds of the delays in these windows [s]
    calm_s: tuple[float, float]  # and elsewhere [s]
    form: Literal["uniform", "sawtooth"] = "uniform"

    def draw(
        self, scenario: Scenario, keys: NDArray[np.uint64], num_slots: int
    ) -> NDArray[np.float64]:
        """Draw the delays [s], shape (E, T, R); they depend on the worlds alone."""
        if self.form == "sawtooth":
            return self._sawtooth(scenario, keys, num_slots)
        per_window = round(scenario.robot.window_s / scenario.radio.slot_s)
        violated = np.isin(np.arange(num_slots) // per_window + 1, self.windows)
        low = np.where(violated, self.violation_s[0], self.calm_s[0])
        high = np.where(violated, self.violation_s[1], self.calm_s[1])
        uniform = np.empty((len(keys), num_slots, scenario.users.num_urllc))
        for env, key in enumerate(keys):
            for slot in range(num_slots):
                draw_uniforms(key, STREAM_DELAY, slot, 0, uniform[env, slot])
        return low[:, None] + (high - low)[:, None] * uniform

    def _sawtooth(
        self, scenario: Scenario, keys: NDArray[np.uint64], num_slots: int
    ) -> NDArray[np.float64]:
        sampling_s = scenario.control.sampling_s
        longest = max(1, delay_steps(self.violation_s[1], sampling_s))
        steps = np.array([1, *range(1, longest + 1), longest])
        slots = np.arange(num_slots) * scenario.radio.slot_s / sampling_s
        sample = np.floor(slots + 1e-9).astype(np.int64)
        place = np.empty((len(keys), scenario.users.num_urllc))
        for env, key in enumerate(keys):
            draw_uniforms(key, STREAM_DELAY, 0, 1, place[env])
        start = np.floor(place * len(steps)).astype(np.int64)
        found = steps[(sample[None, :, None] + start[:, None]) % len(steps)]
        return np.asarray(found * sampling_s, np.float64)

    def to_json(self) -> str:
        """Write them for the metadata of a log; ``uniform`` goes without saying."""
        return json.dumps({k: v for k, v in vars(self).items() if v != "uniform"})

    @staticmethod
    def from_json(text: str) -> ForcedDelays:
        """Read them; ValueError if they are none."""
        try:
            values = json.loads(text)
            form = values.pop("form", "uniform")
            read = ForcedDelays(**{name: tuple(v) for name, v in values.items()}, form=form)
            windows, bounds = set(map(type, read.windows)), (read.violation_s, read.calm_s)
            if windows - {int} or any(not 0.0 <= low <= high < 1e6 for low, high in bounds):
                raise ValueError("numbers out of range")
            if form not in ("uniform", "sawtooth"):
                raise ValueError(f"form = {form!r}")
        except (TypeError, ValueError, AttributeError) as error:
            raise ValueError(f"delays = {text:.100}: no forced delays: {error}") from error
        return read


def logged_delays(scenario: Scenario, metadata: Mapping[str, str]) -> ForcedDelays:
    """Return the forced delays of a log of the gain study, from its scenario and metadata.

    Logs of release 0.1 do not carry them: they follow from the point of the sweep.
    """
    if "delays" in metadata:
        return ForcedDelays.from_json(metadata["delays"])
    axis = metadata["axis"]
    if axis == "grid":
        delay_s = float(metadata["value"].partition("_")[2])
        return _delays(scenario, violation_s=(delay_s, delay_s))
    return _delays(scenario, None if axis else scenario.gain_study.violation_windows)


@dataclass(frozen=True, kw_only=True)
class Point:
    """A point of an experiment."""

    value: str  # its name, in paths and metadata; empty where the experiment has no other
    scenario: Scenario  # with the values of the point in place
    values: Mapping[str, Any] = field(default_factory=dict)  # dotted key -> value, of a sweep
    policies: tuple[str, ...] | None = None  # all of the experiment's unless given
    delays: ForcedDelays | None = None  # of the gain study
    tuned: tuple[str, ...] = ()  # families whose knobs come from `tune`


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """Points x policies x seeds: all meet each other, but for a point's own list of policies."""

    name: str  # folder of its logs
    stage: str  # in the metadata of its logs; worlds of different stages are independent
    axis: str = ""  # what its points vary, in tables
    points: tuple[Point, ...]
    policies: tuple[str, ...]
    seeds: tuple[int, ...]
    warmup_s: float  # of every world, and first [s]
    duration_s: float  # behind it [s]
    profile: str  # of the logs
    logs: int | None = None  # first worlds, which are logged; all are measured as they run
    full_logs: int = 0  # worlds whose beginning is logged in full as well
    full_log_s: float = 0.0  # and how long that is [s]

    @property
    def logged_seeds(self) -> tuple[int, ...]:
        """Seeds of the worlds that are logged."""
        return self.seeds[: self.logs]

    @property
    def forced(self) -> bool:
        """Whether delays are forced: gains stand for policies."""
        return self.points[0].delays is not None

    def runs(self, policies: Sequence[str]) -> Iterator[tuple[Point, str]]:
        """Yield each point with each of its policies that are among these."""
        for point in self.points:
            for policy in self.policies if point.policies is None else point.policies:
                if policy in policies:
                    yield point, policy

    def num_slots(self, scenario: Scenario) -> tuple[int, int]:
        """Slots of a world and those of its warm-up, which are the first of them."""
        slot_s = scenario.radio.slot_s
        return round((self.warmup_s + self.duration_s) / slot_s), round(self.warmup_s / slot_s)


@lru_cache(maxsize=8)
def experiments(scenario: Scenario) -> dict[str, Experiment]:
    """Return every experiment of a study by name, with whatever has points and policies.

    ScenarioError if a point does not fit the rest of the scenario; all faults are listed.
    """
    builders: list[Callable[[], Experiment]] = [
        partial(_evaluation, scenario),
        *(partial(_sweep, scenario, name) for name in scenario.sweeps.axes),
        partial(_cells, scenario),
        *(partial(_task_cell, scenario, name) for name in scenario.task_study.cells),
    ]
    if scenario.gain_study.methods:
        builders += [
            partial(_forced, scenario, "gain_study", "", _method_points),
            partial(_forced, scenario, "gain_grid", "grid", _grid_points),
            partial(_forced, scenario, "gain_sampling_s", "sampling_s", _sampling_points),
            partial(_forced, scenario, "gain_noise", "noise", _noise_points),
            partial(_forced, scenario, LOOP_CELLS, "cell", _loop_points),
        ]
    faults: list[str] = []
    found = []
    for build in builders:
        try:
            found.append(build())
        except ScenarioError as error:
            faults.append(str(error))
    if faults:
        raise ScenarioError("\n".join(faults))
    return {e.name: e for e in found if e.points and e.policies}


def _in_worlds(worlds: Worlds, **others: Any) -> Experiment:
    """Return an experiment in the worlds of a section, and with its policies unless given."""
    own = {key: getattr(worlds, key) for key in ("policies", "seeds", "warmup_s", "duration_s")}
    return Experiment(**{**own, **others})


def _evaluation(scenario: Scenario) -> Experiment:
    return _in_worlds(
        scenario.evaluate,
        name="evaluate",
        stage="evaluate",
        points=(Point(value="", scenario=scenario),),
        profile=scenario.log.evaluate_profile,
        full_logs=scenario.evaluate.full_logs,
        full_log_s=scenario.evaluate.full_log_s,
    )


def _sweep(scenario: Scenario, name: str) -> Experiment:
    return _in_worlds(
        scenario.sweeps,
        name=name,
        stage="sweep",
        axis=name,
        points=tuple(_axis_points(scenario, name)),
        policies=axis_policies(scenario, name),
        profile=scenario.log.sweep_profile,
    )


def axis_policies(scenario: Scenario, name: str) -> tuple[str, ...]:
    """Return the policies along an axis: ``all``, ``own`` or its list, as the scenario says.

    The exact optimum runs where a scenario names it and nowhere else: it is slow.
    """
    named, chosen = scenario.sweeps.policies, scenario.sweeps.axes[name].policies
    if chosen == "all":
        evaluated = [policy for policy in scenario.evaluate.policies if policy != "exact"]
        return tuple(dict.fromkeys((*named, *evaluated)))
    if chosen == "own":
        pair = (scenario.learning.algorithm, BASELINE)
        return tuple(policy for policy in named if policy in pair)
    return named if chosen is None else chosen


def _axis_points(scenario: Scenario, name: str) -> Iterator[Point]:
    vary, where = scenario.sweeps.axes[name].vary, f"sweeps.axes.{name}.vary"
    if (count := prod(map(len, vary.values()))) > MOST_POINTS:
        raise ScenarioError(f"{where}: {count} points, must be at most {MOST_POINTS}")
    faults, names = [], set()
    for values in product(*vary.values()):
        text = "_".join(map(value_text, values))
        chosen = dict(zip(vary, values, strict=True))
        if len(text) > MAX_NAME or text in names:
            faults.append(
                f"{where}: a point would be called {text!r}: must be another name than the other "
                f"points', of {MAX_NAME} characters or fewer"
            )
        names.add(text)
        try:
            variant = with_values(scenario, chosen, where)
        except ScenarioError as error:
            faults.append(str(error))
        else:
            yield Point(value=text, scenario=variant, values=chosen)
    if faults:
        raise ScenarioError("\n".join(dict.fromkeys(faults)))


def value_text(value: Any) -> str:
    """Return a swept value as it stands in file names: ``0.005``, ``1``, ``zigzag``.

    Of a model: its name, then keys and values.
    """
    if isinstance(value, Mapping):
        parts = (v if key == "model" else [key, v] for key, v in value.items())
        return "-".join(map(value_text, parts))
    if isinstance(value, list | tuple):
        return "-".join(map(value_text, value))
    if isinstance(value, bool) or value is None or isinstance(value, str):
        text = json.dumps(value) if not isinstance(value, str) else value
        return "".join(c if c.isalnum() or c in "._-" else "-" for c in text)
    return format(value, ".12g")


def _cells(scenario: Scenario) -> Experiment:
    return _in_worlds(
        scenario.generalise,
        name="generalise",
        stage="generalise",
        axis="cell",
        points=tuple(
            Point(value="u{}_e{}_k{}".format(*cell), scenario=cell_scenario(scenario, cell))
            for cell in scenario.generalise.cells
        ),
        profile=scenario.log.sweep_profile,
    )


def cell_scenario(scenario: Scenario, cell: Cell) -> Scenario:
    """Return the scenario in a cell of another size, its PRBs as wide as before.

    The loads of the users are as spread as the scenario's: each is the average of its part of the
    sorted list, so that users of twice as many have every load twice.

    ScenarioError if the cell does not fit the rest of the scenario.
    """
    num_urllc, num_embb, num_prb = cell
    radio, traffic = scenario.radio, scenario.traffic
    bandwidth_hz = radio.bandwidth_hz / radio.num_prb * num_prb
    variant = replace(
        scenario,
        users=Users(num_urllc=num_urllc, num_embb=num_embb),
        robot_kinds=_repeated_kinds(scenario, num_urllc),
        radio=replace(radio, num_prb=num_prb, bandwidth_hz=bandwidth_hz),
        traffic=replace(
            traffic,
            urllc_offered_mbps=_spread(traffic.urllc_offered_mbps, num_urllc),
            embb_offered_mbps=_spread(traffic.embb_offered_mbps, num_embb),
        ),
    )
    return _checked(variant, f"generalise.cells = {list(cell)}")


def _repeated_kinds(scenario: Scenario, num_robots: int) -> dict[str, RobotKind]:
    """Return the kinds of so many robots: those of the scenario again and again."""
    row = scenario.kind_of_robot
    kinds = {
        name: [robot for robot in range(num_robots) if row[robot % len(row)] == number]
        for number, name in enumerate(sorted(scenario.robot_kinds), 1)
    }
    return {
        name: replace(scenario.robot_kinds[name], robots=tuple(robots))
        for name, robots in kinds.items()
        if robots
    }


def _spread(offered_mbps: float | tuple[float, ...], count: int) -> float | tuple[float, ...]:
    """Averages over `count` equal parts of the sorted loads; one number stays as it is."""
    if not isinstance(offered_mbps, Sequence):
        return offered_mbps
    loads = sorted(offered_mbps)
    each = [load for load in loads for _ in range(count)]  # count parts of len(loads) numbers
    parts = range(0, len(each), len(loads))
    return tuple(sum(each[part : part + len(loads)]) / len(loads) for part in parts)


def _task_cell(scenario: Scenario, name: str) -> Experiment:
    """Return the experiment of a cell of the study of the task.

    Its points: every family at its tuned knob, with the reference and what else runs; the reference
    with set-points that are always present, the floor of the error; and, for the curves, families
    at each knob of a grid.
    """
    study, cell = scenario.task_study, scenario.task_study.cells[name]
    where = f"task_study.cells.{name}.values"
    families = task_families(scenario, name)
    # What the study consists of is nothing to a run: its logs hold the cell alone.
    own = replace(scenario, task_study=replace(study, families={}, cells={}, policies=()))
    base = with_values(own, cell.values, where)
    policies = tuple(dict.fromkeys((REFERENCE, *families, *study.policies)))
    points = [
        Point(
            value=TUNED,
            scenario=with_rules(base, {f: family.policy for f, family in families.items()}),
            policies=policies,
            tuned=tuple(families),
        )
    ]
    if base.robot.set_point != "present":
        # Only the reference runs there: the scenario's own policies may need late set-points.
        alone = _listing(replace(base, policies={}), lambda _: (REFERENCE,))
        present = with_values(alone, {"robot.set_point": "present"}, where)
        points.append(Point(value=FLOOR, scenario=present, policies=(REFERENCE,)))
    tunable = [f for f, family in families.items() if family.range is not None]
    for number in range(study.pareto_knobs if cell.pareto and tunable else 0):
        rules = {
            f: with_knob(families[f].policy, knob_grid(families[f], study.pareto_knobs)[number])
            for f in tunable
        }
        at_knobs = with_rules(base, rules)
        points.append(Point(value=f"knob{number}", scenario=at_knobs, policies=tuple(tunable)))
    return Experiment(
        name=f"{TASK}_{name}",
        stage=TASK,
        axis=f"{TASK}_{name}",
        points=tuple(points),
        policies=policies,
        seeds=study.seeds,
        warmup_s=study.warmup_s,
        duration_s=study.duration_s,
        profile=scenario.log.sweep_profile,
        logs=1,
    )


def cell_of(experiment: Experiment) -> str:
    """Return the cell of the study of the task that an experiment of it runs in."""
    return experiment.name.removeprefix(f"{TASK}_")


def task_families(scenario: Scenario, cell: str) -> dict[str, Family]:
    """Return the families that run in a cell of the study of the task, in the study's order."""
    families, own = scenario.task_study.families, scenario.task_study.cells[cell].families
    return {name: family for name, family in families.items() if own == "all" or name in own}


def with_knob(rule: Rule, knob: float) -> Rule:
    """Return a rule with another value of its knob."""
    assert rule.knob is not None
    return replace(rule, **{rule.knob: knob})  # type: ignore[type-var]  # rules are dataclasses


def with_rules(scenario: Scenario, rules: Mapping[str, Rule]) -> Scenario:
    """Return the scenario with further policies of its own."""
    return replace(scenario, policies={**scenario.policies, **rules})


def knob_grid(family: Family, count: int) -> list[float]:
    """Return so many knobs over the range of a family, in equal ratios."""
    assert family.range is not None
    return [float(knob) for knob in np.geomspace(*family.range, count)]


def _forced(
    scenario: Scenario, name: str, axis: str, points: Callable[[Scenario], Iterator[Point]]
) -> Experiment:
    study = scenario.gain_study
    windows = study.sweep_windows if axis else study.num_windows
    if name == LOOP_CELLS:
        windows = study.cell_windows
    return Experiment(
        name=name,
        stage="gain_study",
        axis=axis,
        points=tuple(points(scenario)),
        policies=GAINS,
        seeds=study.seeds,
        warmup_s=0.0,
        duration_s=windows * scenario.robot.window_s,
        profile=scenario.log.gain_study_profile,
    )


def _method_points(scenario: Scenario) -> Iterator[Point]:
    """Yield a point a method, on the plant that it is for.

    Methods on one plant have the same nominal gain: it runs with the first of them.
    """
    study = scenario.gain_study
    for method in study.methods:
        first = method == baseline_method(scenario, method)
        variant = _method_scenario(scenario, method)
        yield Point(
            value=method,
            scenario=robots_alone(variant, study.num_robots, f"gain_study with {method}"),
            policies=GAINS if first else ("adjusted",),
            delays=_delays(scenario, study.violation_windows),
        )


def baseline_method(scenario: Scenario, method: GainMethod) -> GainMethod:
    """Return the method whose runs with nominal gains serve a method: the first on its plant."""
    plant = STUDY_PLANTS[method]
    return next(name for name in scenario.gain_study.methods if STUDY_PLANTS[name] == plant)


def _method_scenario(scenario: Scenario, method: GainMethod) -> Scenario:
    """Return the scenario with a method of the gain study and the loop that it is for.

    A plant that decides its loop itself stays what it is; predictors are not held, and what has
    replaced a predictor is held as usual.
    """
    own = scenario.control
    loop = STUDY_PLANTS[method] if scenario.plant.chooses_loop else own.loop
    either = hold_of(method) != hold_of(own.method)
    hold_samples = hold_of(method) if either else own.hold_samples
    control = replace(own, method=method, loop=loop, hold_samples=hold_samples)
    if method != "lqg":
        control = replace(control, link="measurements", known_motion=False)
    robot = replace(scenario.robot, superseding="none")  # no packet waits under forced delays
    return replace(scenario, control=control, robot=robot)


def _delays(
    scenario: Scenario,
    windows: tuple[int, ...] | None = None,
    violation_s: tuple[float, float] | None = None,
) -> ForcedDelays:
    """Return the delays of a gain study; in its sweeps all windows but the first are violated."""
    study = scenario.gain_study
    return ForcedDelays(
        windows=windows or tuple(range(2, study.sweep_windows + 1)),
        violation_s=violation_s or study.violation_delay_s,
        calm_s=study.calm_delay_s,
    )


def _sweep_point(
    scenario: Scenario, value: str, violation_s: tuple[float, float] | None = None
) -> Point:
    """Return a point of a sweep of the gain study."""
    return Point(
        value=value,
        scenario=robots_alone(scenario, scenario.gain_study.sweep_robots, f"gain_study, {value}"),
        delays=_delays(scenario, violation_s=violation_s),
    )


def _grid_points(scenario: Scenario) -> Iterator[Point]:
    for weight, delay_s in product(scenario.gain_study.weight, scenario.gain_study.fixed_delay_s):
        variant = replace(scenario, control=replace(scenario.control, weight=weight))
        name = f"q{value_text(weight)}_{value_text(delay_s)}"
        yield _sweep_point(variant, name, (delay_s, delay_s))


def _sampling_points(scenario: Scenario) -> Iterator[Point]:
    for value in scenario.gain_study.sampling_s:
        variant = replace(scenario, control=replace(scenario.control, sampling_s=value))
        yield _sweep_point(variant, value_text(value))


def _noise_points(scenario: Scenario) -> Iterator[Point]:
    study = scenario.gain_study
    for position, heading in zip(study.noise_position_m, study.noise_heading_rad, strict=True):
        robot = replace(scenario.robot, noise_position_m=position, noise_heading_rad=heading)
        name = f"{value_text(position)}_{value_text(heading)}"
        yield _sweep_point(replace(scenario, robot=robot), name)


def _loop_points(scenario: Scenario) -> Iterator[Point]:
    """Yield a point a cell and method; the nominal gain runs with the first on its plant."""
    study = scenario.gain_study
    for name, cell in study.cells.items():
        violation_s = cell.delay_s, cell.delay_s
        delays = ForcedDelays(
            windows=tuple(range(1, study.cell_windows + 1)),
            violation_s=violation_s,
            calm_s=violation_s,
            form="sawtooth" if cell.sawtooth else "uniform",
        )
        plants: set[str] = set()
        for method in study.cell_methods if cell.methods is None else cell.methods:
            where = f"gain_study.cells.{name}.values"
            base = replace(scenario, gain_study=replace(study, cells={}))
            variant = with_values(_method_scenario(base, method), cell.values, where)
            first = STUDY_PLANTS[method] not in plants
            plants.add(STUDY_PLANTS[method])
            yield Point(
                value=f"{name}_{method}",
                scenario=robots_alone(variant, study.sweep_robots, f"gain_study.cells.{name}"),
                policies=GAINS if first else ("adjusted",),
                delays=delays,
            )


def robots_alone(scenario: Scenario, num_robots: int, what: str) -> Scenario:
    """Return the scenario with so many robots, in a cell just large enough for them.

    ScenarioError if the scenario does not hold together; `what` is named.
    """
    traffic = replace(scenario.traffic, urllc_offered_mbps=1.0, embb_offered_mbps=1.0)
    variant = replace(
        scenario,
        users=Users(num_urllc=num_robots, num_embb=1),
        robot_kinds=_repeated_kinds(scenario, num_robots),
        radio=replace(scenario.radio, num_prb=num_robots + 1),
        traffic=traffic,
    )
    return _checked(variant, what)


def _checked(variant: Scenario, what: str) -> Scenario:
    if faults := scenario_faults(variant):
        raise ScenarioError("\n".join(f"{what}: {fault}" for fault in faults))
    return variant


def learner_scenario(scenario: Scenario, learner: str) -> Scenario:
    """Return the scenario as one learner trains in it: its section `learning`, and no others.

    Lists of policies name this learner, by its algorithm, and the schedulers: the scenario holds
    together on its own, as a log's has to.

    ValueError if there is no such learner.
    """
    if learner not in scenario.learned:
        raise ValueError(f"learner = {learner!r}: must be one of {', '.join(scenario.learned)}")
    learning = scenario.learned[learner]

    def own(policies: tuple[str, ...]) -> tuple[str, ...]:
        return learning.algorithm, *(p for p in policies if p not in scenario.learned)

    return replace(
        _listing(scenario, own),
        learning=learning,
        learners={},
        task_study=replace(scenario.task_study, families={}, cells={}, policies=()),
    )


def _listing(scenario: Scenario, choose: Callable[[tuple[str, ...]], tuple[str, ...]]) -> Scenario:
    """Return the scenario with other lists of policies: what is chosen of each."""

    def own(section: Any) -> Any:
        if not isinstance(section.policies, tuple):
            return section  # an axis that takes those of others
        return replace(section, policies=choose(section.policies))

    axes = {name: own(axis) for name, axis in scenario.sweeps.axes.items()}
    return replace(
        scenario,
        evaluate=own(scenario.evaluate),
        sweeps=replace(own(scenario.sweeps), axes=axes),
        generalise=own(scenario.generalise),
    )


def trained_learners(scenario: Scenario) -> tuple[str, ...]:
    """List the learners that a study trains: whose policies run, and controls of the same kind.

    A control is a learner that stays as it starts, beside one with its algorithm and start.
    """
    named = {policy for e in experiments(scenario).values() for policy in e.policies}
    used = [name for name in scenario.learned if name in named]
    kinds = {(scenario.learned[name].algorithm, scenario.learned[name].start) for name in used}
    return tuple(
        name
        for name, own in scenario.learned.items()
        if name in used or (own.frozen and (own.algorithm, own.start) in kinds)
    )


def groups(scenario: Scenario, experiment: Experiment) -> dict[str, tuple[str, ...]]:
    """Return the groups of policies that share a job of an experiment, each with its policies."""
    if experiment.forced:
        return {GAIN_GROUP: experiment.policies}
    found: dict[str, tuple[str, ...]] = {}
    for policy in experiment.policies:
        is_file = isinstance(scenario.policies.get(policy), FilePolicy)
        group = policy if is_file or policy in scenario.learned else CLASSICAL_GROUP
        found[group] = (*found.get(group, ()), policy)
    return dict(sorted(found.items(), key=lambda item: item[0] != CLASSICAL_GROUP))


def has_unlogged(scenario: Scenario, experiment: Experiment, policy: str) -> bool:
    """Whether runs of a policy are measured as they run, since not all of them have a log."""
    return is_crossed(scenario, policy) or experiment.logs is not None


def is_crossed(scenario: Scenario, policy: str) -> bool:
    """Whether a policy is several, one a training seed, of which one a world is logged."""
    return policy in scenario.learned and len(scenario.learned[policy].seeds) > 1
