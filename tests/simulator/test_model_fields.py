"""What models add to the record of a slot: at their own slot, of their own world, else 0."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import pytest

from hiersched.core.fields import ModelField
from hiersched.core.randomness import world_keys
from hiersched.core.registry import PluginError
from hiersched.models.channel.rayleigh import Rayleigh
from hiersched.models.model import FADING, Model, Setup, model_fields, num_model_values
from hiersched.models.plant.unicycle import Unicycle, UnicycleWords, drive_unicycles
from hiersched.models.queue.fifo import Fifo
from hiersched.models.seams import DRAW_FADING, DRIVE
from hiersched.policies.policy import LoggedDecisions, Owners
from hiersched.policies.registry import RULES, Rule
from hiersched.simulator.record import SlotRecord


class FlatWords(NamedTuple):
    """Where the fields begin; sums of the users over the slots, shape (E, U)."""

    level: int
    deep: int
    total: np.ndarray


@dataclass(frozen=True, kw_only=True)
class Flat(Model):
    """The same power on all PRBs, that depends on world, slot and user; every third slot is deep.

    It logs the power, and in deep slots alone the sum of all powers so far.
    """

    log_fields: ClassVar = {"level": "1", "deep": "dB"}
    model: Literal["flat"] = "flat"
    scale: float = 1.0

    def words(self, setup: Setup) -> FlatWords:
        return FlatWords(
            level=setup.first_value(self, "level"),
            deep=setup.first_value(self, "deep"),
            total=np.zeros((setup.num_envs, setup.scenario.num_users)),
        )

    def reset(self, words: FlatWords, keys: Any) -> None:
        words.total[...] = 0.0


@DRAW_FADING.kernel(FlatWords)
def draw_flat(me, constants, state, slot, env):
    for user in range(state.fading_power.shape[1]):
        world = np.float64(state.key[env] % np.uint64(97)) / 97.0
        level = np.float32(0.5 + world + user + 0.25 * (state.slot[env] % 5))
        state.fading_power[env, user] = level
        me.total[env, user] += level
        state.model_values[env, me.level + user] = level
        if state.slot[env] % 3 == 0:
            state.model_values[env, me.deep + user] = me.total[env, user]


class NotedWords(NamedTuple):
    """The words of a unicycle, and where the field begins."""

    inner: UnicycleWords
    error: int


@dataclass(frozen=True, kw_only=True)
class Noted(Unicycle):
    """Unicycles that say twice how far they are off."""

    log_fields: ClassVar = {"error": "m"}

    def words(self, setup: Setup) -> NotedWords:
        return NotedWords(super().words(setup), setup.first_value(self, "error"))

    def reset(self, words: NotedWords, keys: Any) -> None:
        super().reset(words.inner, keys)


@DRIVE.kernel(NotedWords)
def drive_noted(me, constants, state, slot, env):
    drive_unicycles(me.inner, constants, state, slot, env)
    for robot in range(slot.tracking_error_m.shape[0]):
        state.model_values[env, me.error + robot] = slot.tracking_error_m[robot]


@pytest.fixture(scope="module")
def noted(smoke_scenario):
    plant = smoke_scenario.plant
    return Noted(**{field.name: getattr(plant, field.name) for field in fields(plant)})


@pytest.fixture
def make(make_simulator, noted):
    def simulator(keys, num_slots=31):
        sections = {"radio": {"fading": Flat()}, "plant": noted}
        return make_simulator(keys=keys, num_slots=num_slots, **sections)

    return simulator


KEYS = world_keys("fields", 1, 3)


def assert_fields(record, start=0):
    """8 users, 4 of them with a robot."""
    level, deep, error = np.split(record.model_values, [8, 16], axis=-1)
    power = record.fading_power[..., 0].astype(np.float64)
    np.testing.assert_array_equal(level, power)
    slots = np.arange(start, start + level.shape[1])
    if start == 0:
        total = np.cumsum(power, axis=1)
        np.testing.assert_array_equal(deep[:, slots % 3 == 0], total[:, slots % 3 == 0])
    assert not deep[:, slots % 3 != 0].any()
    np.testing.assert_array_equal(error, record.tracking_error_m)
    assert error.any()


def test_fields_are_of_their_slot_and_world(make, assert_same_bits):
    batch = make(KEYS).run("pf")
    assert batch.model_values.shape == (3, 31, 20)
    assert len(np.unique(batch.model_values[:, 0, 0])) == 3
    assert_fields(batch)
    for env, key in enumerate(KEYS):
        single = make([key]).run("pf")
        assert_same_bits(SlotRecord(*(field[env : env + 1] for field in batch)), single)


def test_fields_are_the_same_however_it_runs(make, assert_same_bits):
    whole = make(KEYS).run("pf")
    halves = make(KEYS)
    for start, count in ((0, 1), (1, 13), (14, 17)):
        part = halves.run("pf", count)
        assert_same_bits(part, SlotRecord(*(f[:, start : start + count] for f in whole)))
        assert_fields(part, start)
    halves.reset(np.array(KEYS))
    assert_same_bits(halves.run("pf"), whole)
    assert_same_bits(make(KEYS).run(LoggedDecisions(whole.prb_owner)), whole)

    class Given:
        """A policy in Python: slot by slot."""

        slot = -1

        def decide(self, view):
            self.slot += 1
            return Owners(whole.prb_owner[:, self.slot])

    assert_same_bits(make(KEYS).run(Given()), whole)


def test_to_ask_what_a_policy_would_do_changes_nothing(make, assert_same_bits):
    simulator = make(KEYS)
    simulator.decide(simulator.rule("pf"))
    assert_same_bits(simulator.run("pf"), make(KEYS).run("pf"))


def test_robots_alone_have_the_fields_of_the_plant_alone(make):
    """Also where the same simulator has run the network before, and in pieces."""
    simulator = make(KEYS)
    simulator.run("pf", 7)
    delay_s = np.full((3, 12, 4), 0.015)
    for _ in range(2):
        record = simulator.run_robots(delay_s)
        assert not record.model_values[..., :16].any()
        np.testing.assert_array_equal(record.model_values[..., 16:], record.tracking_error_m)
        assert record.model_values.any()


def test_models_that_add_nothing_take_nothing(make_simulator):
    simulator = make_simulator()
    assert model_fields(simulator.scenario) == ()
    assert simulator.state.model_values.shape == (2, 0)
    assert simulator.run("pf", 2).model_values.shape == (2, 2, 0)


def test_fields_lie_in_the_order_of_the_sections(make, noted):
    scenario = make(KEYS).scenario
    assert model_fields(scenario) == (
        ModelField("radio.fading/level", "1", 0, 8),
        ModelField("radio.fading/deep", "dB", 8, 8),
        ModelField("plant/error", "m", 16, 4),
    )
    assert num_model_values(scenario) == 20
    setup = Setup(scenario=scenario, num_envs=1, num_slots=1)
    assert setup.first_value(scenario.plant, "error") == 16
    assert setup.first_value(scenario.radio.fading, "deep") == 8
    for model, name in (
        (scenario.plant, "deep"),
        (Flat(), "deep"),  # equal, but not the scenario's
        (scenario.traffic.queue, "error"),
    ):
        with pytest.raises(ValueError, match=f"{name}: no field of "):
            setup.first_value(model, name)


@pytest.mark.parametrize("name", ["", "a b", "x[0]", "a/b"])
def test_fields_need_a_name(name):
    @dataclass(frozen=True, kw_only=True)
    class Nameless(Model):
        log_fields: ClassVar = {"fine": "1", name: "1"}
        model: Literal["nameless"] = "nameless"

    with pytest.raises(PluginError, match=r"Nameless\.log_fields: .*: must be a name"):
        FADING.model(Nameless)
    assert "nameless" not in FADING


def test_rules_log_nothing():
    @dataclass(frozen=True, kw_only=True)
    class Talks(Rule):
        log_fields: ClassVar = {"level": "1"}
        model: Literal["talks"] = "talks"

    with pytest.raises(PluginError, match=r"Talks\.log_fields: a model of policies\.\* logs"):
        RULES.model(Talks)


def test_built_in_models_add_nothing():
    assert not any(cls.log_fields for cls in (Rayleigh, Unicycle, Fifo))
