"""What holds of every model, tried on a scenario: for the tests of a plug-in."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiersched.core.randomness import world_keys
from hiersched.scenario.schema import Scenario
from hiersched.simulator.loop_gains import Gains, nominal_gains
from hiersched.simulator.record import SlotFields
from hiersched.simulator.simulator import AnyPolicy, Simulator

WORLD = ("fading_power", "arrival_uniform", "robot_normal")
"""Fields of the record that no decision may change."""

_NUM_WORLDS = 3
Fields = dict[str, NDArray[Any]]


class ModelCheckError(ValueError):
    """A model breaks a rule that keeps runs reproducible: the message lists all that were found."""


def check_models(
    scenario: Scenario, policies: Sequence[AnyPolicy] | None = None, num_slots: int = 100
) -> None:
    """Run the models of a scenario, and its policies, and look for what no model may do.

    Worlds in a batch are those alone, whether their slots run in one call or one by one; an episode
    after another one is that of a new simulator; a slot depends on nothing that is left in the slot
    in work, so every field is written; all numbers are finite; no draw of a world depends on a
    decision.

    `policies` are names or policies, two or more that decide differently; unless given PF, round
    robin and those that the scenario adds. ModelCheckError if a rule is broken.
    """
    if policies is None:
        policies = ("pf", "round_robin", *scenario.policies)
    trial = _Trial(scenario, num_slots)
    first = [trial.run(policy) for policy in policies]
    faults = [fault for fields in first for fault in _out_of_range(fields)]
    faults += trial.of_robots()
    for policy, fields in zip(policies, first, strict=True):
        what = f"a second run of the same worlds differs, under {policy}"
        again = _differ(what, trial.run(policy), fields)
        faults += again or trial.of_policy(policy, fields)
    for policy, fields in zip(policies[1:], first[1:], strict=True):
        of_world = ({name: one[name] for name in WORLD} for one in (first[0], fields))
        faults += _differ(f"decisions of {policies[0]} and {policy} change the draws", *of_world)
    if faults:
        raise ModelCheckError("\n".join(dict.fromkeys(faults)))


class _Trial:
    """Runs of one scenario in the same worlds."""

    def __init__(self, scenario: Scenario, num_slots: int) -> None:
        self.scenario, self.num_slots = scenario, num_slots
        self.gains = _distinct_gains(scenario)
        self.keys = world_keys("check", 1, _NUM_WORLDS)

    def simulator(self, keys: NDArray[np.uint64]) -> Simulator:
        return Simulator(self.scenario, self.gains, keys, self.num_slots)

    def run(self, policy: AnyPolicy) -> Fields:
        return self.simulator(self.keys).run(policy)._asdict()

    def of_robots(self) -> Iterator[str]:
        """Faults of robots under forced delays, from the first slot on up to the longest."""
        rng = np.random.default_rng(1)
        shape = _NUM_WORLDS, self.num_slots, self.scenario.users.num_urllc
        delays = rng.uniform(0.0, 1.2 * self.scenario.control.max_delay_s, shape)

        def run(simulator: Simulator, worlds: slice) -> Fields:
            return simulator.run_robots(delays[worlds])._asdict()

        yield from self._of_runs(run, run(self.simulator(self.keys), slice(None)))

    def of_policy(self, policy: AnyPolicy, expected: Fields) -> Iterator[str]:
        """Faults of runs that have to be the expected one."""
        yield from self._of_runs(lambda simulator, _: simulator.run(policy)._asdict(), expected)
        zeros, ones = (self.run_over(policy, word) for word in (0, 2**64 - 1))
        yield from _differ("not written in every slot", zeros, ones)
        in_one_call = {name: expected[name] for name in zeros}
        yield from _differ("slots one by one are others than in one call", zeros, in_one_call)

    def _of_runs(
        self, run: Callable[[Simulator, slice], Fields], expected: Fields
    ) -> Iterator[str]:
        """Faults of the worlds alone, and after other worlds."""
        for world in range(_NUM_WORLDS):
            part = slice(world, world + 1)
            alone = run(self.simulator(self.keys[part]), part)
            of_batch = {name: values[part] for name, values in expected.items()}
            yield from _differ(
                "a world in a batch differs from the same world alone", alone, of_batch
            )
        simulator = self.simulator(self.keys[::-1])
        run(simulator, slice(None))
        simulator.reset(self.keys)
        again = run(simulator, slice(None))
        yield from _differ("`reset` leaves something of the episode before", again, expected)

    def run_over(self, policy: AnyPolicy, word: int) -> Fields:
        """Run slot by slot over a slot in work, and a coming channel, that are full of a word."""
        simulator = self.simulator(self.keys)
        slots = []
        for _ in range(self.num_slots):
            simulator.slot_in_work.words[:] = word
            channel = simulator.state.fading_power.copy()
            # The slot itself only logs it: this is what the channel of the next one is drawn over.
            simulator.state.fading_power.view(np.uint32)[:] = word & 0xFFFFFFFF
            fields = simulator.run(policy, 1)._asdict()
            slots.append({**fields, "fading_power": channel[:, None]})
        scenario = self.scenario
        absent = {
            "mean_fading_power": True,  # of what lies there now
            "reference": not scenario.plant.has_pose,
            "set_point": scenario.robot.set_point == "present",
            "set_point_age_s": not scenario.tracks_age,
            "superseded_packets": not getattr(scenario.traffic.queue, "tracks_packets", False),
        }
        names = [name for name in SlotFields._fields if not absent.get(name, False)]
        return {name: np.concatenate([slot[name] for slot in slots], axis=1) for name in names}


def _distinct_gains(scenario: Scenario) -> Gains:
    """Return gains of every delay that differ by a little: which one is in force shows."""
    gains = nominal_gains(scenario)
    count = len(gains.adjusted)
    factor = (1.0 - 0.01 * np.arange(count) / count)[:, None, None]
    return replace(
        gains,
        local_gains=factor * gains.local_gains,
        network_gains=factor * gains.network_gains,
        adjusted=np.arange(count) > 0,
    )


def _out_of_range(fields: Fields) -> list[str]:
    faults = []
    for name, values in fields.items():
        if not (fine := np.isfinite(values)).all():
            faults.append(f"{name}: {values[~fine][0]} in slot {_first(~fine)}")
    power = fields["fading_power"]
    if (power < 0.0).any():
        faults.append(f"fading_power: {power[power < 0.0][0]:.3g} in slot {_first(power < 0.0)}")
    return faults


def _differ(what: str, one: Fields, other: Fields) -> list[str]:
    """Name the first slot in which two runs differ, and its first field; empty where none does."""
    places = {
        name: _first(_bits(one[name]) != _bits(other[name]))
        for name in one
        if not np.array_equal(_bits(one[name]), _bits(other[name]))
    }
    if not places:
        return []
    name = min(places, key=lambda name: places[name])
    return [f"{name}: {what} (first in slot {places[name]})"]


def _bits(values: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(values).view(f"u{values.itemsize}")


def _first(differs: NDArray[np.bool_]) -> int:
    """Return the first slot of arrays (E, T, ...) in which something holds."""
    return int(np.flatnonzero(differs.any(axis=(0, *range(2, differs.ndim))))[0])
