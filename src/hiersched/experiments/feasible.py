"""Whether a study can be run at all on a machine, and what its cell is asked for."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from hiersched.core.extras import MissingExtraError
from hiersched.core.memory import physical_memory_bytes
from hiersched.core.randomness import world_key
from hiersched.experiments.points import experiments, groups
from hiersched.models.model import num_model_values
from hiersched.models.plant.operator import TABLE_WIDTH
from hiersched.models.plant.reference import tasks_of
from hiersched.policies.features import num_features
from hiersched.policies.files import FilePolicy, PolicyFileError
from hiersched.policies.find import file_spaces
from hiersched.scenario import Scenario, ScenarioError, find_scenario, load_scenario
from hiersched.scenario.schema import Learning
from hiersched.simulator.loop_gains import plant_of
from hiersched.simulator.record import SlotLayout

COPIES = 1.5
"""Memory of a batch over that of its record: measures and logs copy a part of it."""
_GIB = float(1 << 30)


def load_study(name_or_path: str | Path) -> Scenario:
    """Load a scenario, and check that every point of its experiments can be run here.

    Raises
    ------
    ScenarioError
        As `load_scenario` and `experiments`, or where memory is short; every fault names the file.
    """
    scenario = load_scenario(name_or_path)
    try:
        experiments(scenario)
        checks = _name_faults, memory_faults, design_faults, file_faults
        if faults := [fault for check in checks for fault in check(scenario)]:
            raise ScenarioError("\n".join(faults))
    except ScenarioError as error:
        path = find_scenario(name_or_path)
        lines = [f"{path}: {line}" for line in str(error).splitlines()]
        raise ScenarioError("\n".join(lines)) from error
    return scenario


def _name_faults(scenario: Scenario) -> list[str]:
    """Say which jobs would have the same name: ``load_hi`` with ddpg, ``load`` with hi_ddpg."""
    names = Counter(
        f"{experiment.name}_{group}"
        for experiment in experiments(scenario).values()
        for group in groups(scenario, experiment)
    )
    return [
        f"sweeps.axes, learners: two jobs would be called {name}: other names are needed"
        for name, number in names.items()
        if number > 1
    ]


def design_faults(scenario: Scenario) -> list[str]:
    """Say at which points no gain can be designed for the plant."""
    faults = []
    for experiment in experiments(scenario).values():
        for point in experiment.points:
            try:
                with np.errstate(all="ignore"):
                    plant_of(point.scenario)
            except (ValueError, ArithmeticError) as error:
                where = f"{experiment.name} {point.value}".rstrip()
                faults.append(f"{where}: no gain can be designed for this plant: {error}")
    return faults


def file_faults(scenario: Scenario) -> list[str]:
    """Say which policies in files do not fit a point at which they run; none of them is run.

    MissingExtraError if what runs one is not installed.
    """
    faults: dict[str, str] = {}
    for experiment in experiments(scenario).values():
        for point, policy in experiment.runs(experiment.policies):
            entry = point.scenario.policies.get(policy)
            if not isinstance(entry, FilePolicy):
                continue
            if find_spec(entry.package) is None:
                raise MissingExtraError(entry.package)
            where = f"{experiment.name} {point.value}".rstrip()
            try:
                found = entry.shape_faults(file_spaces(entry), point.scenario)
            except PolicyFileError as error:
                found = [str(error)]
            for fault in found:
                faults.setdefault(f"policies.{policy}.{fault}", where)
    return [f"{where}: {fault}" for fault, where in faults.items()]


def slot_bytes(scenario: Scenario) -> int:
    """Return what a slot of one world takes in memory [bytes].

    Its record, what its robots have measured, and references that the world draws for itself.
    """
    layout = SlotLayout(
        scenario.num_users,
        scenario.users.num_urllc,
        scenario.radio.num_prb,
        scenario.robot_sizes,
        num_model_values(scenario),
    )
    num_robots, (n, _, _) = scenario.users.num_urllc, scenario.robot_sizes
    measured = math.ceil(scenario.radio.slot_s / scenario.control.sampling_s) * n * num_robots
    tasks = tasks_of(scenario.robot, num_robots) if scenario.plant.has_pose else ()
    drawn = sum(task.reference == "reach" for task in tasks)
    return 8 * (layout.words + measured + drawn * scenario.steps_per_slot * TABLE_WIDTH)


def memory_faults(scenario: Scenario) -> list[str]:
    """Say which parts of a study do not fit into the memory of this machine."""
    faults = (_memory_fault(needed, what) for what, needed in _needed(scenario))
    return [fault for fault in faults if fault]


def world_fault(scenario: Scenario, seconds: float) -> str | None:
    """Say if one world of so many seconds does not fit into the memory of this machine."""
    slots = seconds / scenario.radio.slot_s
    return _memory_fault(COPIES * slots * slot_bytes(scenario), f"a world of {slots:.6g} slots")


def _memory_fault(needed: float, what: str) -> str | None:
    there = physical_memory_bytes()
    if needed <= there:
        return None
    return (
        f"{what}: takes {needed / _GIB:.3g} GiB of memory, this machine has {there / _GIB:.3g} GiB"
    )


def _needed(scenario: Scenario) -> Iterator[tuple[str, float]]:
    """Yield the values that decide over the memory of a job, and what it takes [bytes]."""
    for experiment in experiments(scenario).values():
        for point in experiment.points:
            num_slots, _ = experiment.num_slots(point.scenario)
            where = f"{experiment.name} {point.value}".rstrip()
            worlds = len(experiment.seeds)
            if point.tuned:
                worlds = max(worlds, len(scenario.task_study.design_seeds))
            yield (
                f"{where}: {worlds} worlds of {num_slots} slots",
                COPIES * worlds * num_slots * slot_bytes(point.scenario),
            )
    for name, learning in scenario.learned.items():
        yield f"learner {name}: {len(learning.seeds)} seeds", _training_bytes(scenario, learning)


def _training_bytes(scenario: Scenario, learning: Learning) -> float:
    """Return what a training takes: episodes side by side, transitions, networks with Adam."""
    features = num_features(learning.observe_robots, learning.observe_demand)
    users = scenario.num_users
    worlds = learning.num_envs + learning.checkpoint_worlds
    episodes = worlds * learning.slots_per_episode * slot_bytes(scenario)
    transitions = learning.replay_capacity * users * (4.0 * features + 12.0)
    widths = [3 * features if learning.network == "shared" else users * features, *learning.hidden]
    parameters = sum(float(a + 1) * b for a, b in zip(widths, [*widths[1:], users], strict=True))
    batch = 4.0 * learning.batch_size * users * sum(map(float, widths))
    per_seed = COPIES * episodes + transitions + 64.0 * parameters + 16.0 * batch
    return len(learning.seeds) * per_seed


def warnings(scenario: Scenario) -> list[str]:
    """Say what can be run, but is hardly meant."""
    belief = scenario.traffic.arrivals.belief(scenario)
    slot_s, packet_mbit = scenario.radio.slot_s, scenario.traffic.packet_bits * 1e-6
    withheld = belief.rate_sensitivity * belief.packets_per_mbps * packet_mbit / slot_s
    found = []
    if withheld.max() >= 1.0:
        found.append(
            f"traffic.arrivals: for every packet that a URLLC user is served {withheld.max():.3g} "
            "fewer arrive, so a scheduler gains by giving it PRBs that it does not need (the "
            "interval of arrivals is far longer than radio.slot_s: lower "
            "traffic.arrivals.rate_sensitivity or application_delay_s)"
        )
    return found


def offered_mbps(scenario: Scenario) -> tuple[float, float]:
    """Return the offered load of both slices [Mbit/s], URLLC first."""
    offered = scenario.traffic.arrivals.offered_mbps(scenario)
    split = scenario.users.num_urllc
    return float(np.sum(offered[:split])), float(np.sum(offered[split:]))


def capacity_mbps(scenario: Scenario) -> float:
    """Return what the cell carries where all users have as many PRBs, and nobody picks good ones.

    Shannon's capacity under Rayleigh fading, whatever link and fading the scenario has; a mean over
    the users of the evaluation's first world [Mbit/s].
    """
    radio = scenario.radio
    key = world_key("evaluate", scenario.evaluate.seeds[0])
    snr = 10.0 ** ((radio.tx_power_dbm - radio.noise_dbm) / 10.0)
    mean_snr = snr * radio.path_loss.gain(key, scenario.num_users)
    mean_snr = mean_snr * 2.0 * getattr(radio.fading, "scale", 0.5**0.5) ** 2
    power, weight = np.polynomial.laguerre.laggauss(64)
    rates = np.log2(1.0 + mean_snr[:, None] * power) @ weight
    return float(radio.bandwidth_hz * 1e-6 * rates.mean())
