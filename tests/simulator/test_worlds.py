"""Bits: batch and single, seeds, policies in the same world, interruption."""

from __future__ import annotations

import numpy as np
import pytest

from hiersched.core.randomness import STREAM_ARRIVAL, draw_exponentials, draw_uniforms, world_keys
from hiersched.models.channel.path_loss import Macro
from hiersched.models.channel.rayleigh import Rayleigh
from hiersched.policies.index_rules import CLASSICAL
from hiersched.policies.policy import LoggedDecisions
from hiersched.simulator.record import SlotRecord

WORLD = ("fading_power", "mean_fading_power", "arrival_uniform", "robot_normal")


def row(record, index):
    return SlotRecord(*(field[index : index + 1] for field in record))


@pytest.mark.parametrize("policy", ["pf", "drift_plus_penalty", "edf"])
def test_batch_of_64_is_64_single_worlds(make_simulator, assert_same_bits, policy):
    keys = world_keys("batch", 1, 64)
    batch = make_simulator(keys=keys, num_slots=30).run(policy)
    for env, key in enumerate(keys):
        single = make_simulator(keys=[key], num_slots=30).run(policy)
        assert_same_bits(row(batch, env), single)


def test_batch_is_single_where_rows_are_no_multiple_of_four(make_simulator, assert_same_bits):
    """3 + 2 users and 7 PRBs: 35 fading powers, 18 normals."""
    odd = {
        "users": {"num_urllc": 3, "num_embb": 2},
        "radio": {"num_prb": 7, "path_loss": Macro()},
        "traffic": {"urllc_offered_mbps": (10.0, 14.0, 18.0)},
    }
    keys = world_keys("batch", 2, 5)
    batch = make_simulator(keys=keys, **odd).run("m_lwdf")
    for env, key in enumerate(keys):
        assert_same_bits(row(batch, env), make_simulator(keys=[key], **odd).run("m_lwdf"))


def test_batch_is_single_for_given_weights_and_multipliers(make_simulator, assert_same_bits):
    rng = np.random.default_rng(1)
    weights, multipliers = np.exp(rng.uniform(-3, 3, (4, 8))), rng.uniform(0, 5, (4, 4))
    keys = world_keys("batch", 3, 4)
    batch = make_simulator(keys=keys).run("pf", weights=weights, multipliers=multipliers)
    for env, key in enumerate(keys):
        single = make_simulator(keys=[key]).run(
            "pf", weights=weights[env : env + 1], multipliers=multipliers[env : env + 1]
        )
        assert_same_bits(row(batch, env), single)


def test_same_worlds_give_the_same_bits_and_others_do_not(make_simulator, assert_same_bits):
    first = make_simulator()
    record = first.run("pf")
    assert_same_bits(make_simulator().run("pf"), record)
    first.reset(first.state.key)
    assert_same_bits(first.run("pf"), record)
    other = make_simulator(keys=world_keys("test", 2, 2)).run("pf")
    for name in WORLD:
        assert not np.array_equal(getattr(other, name), getattr(record, name))


def test_every_policy_meets_the_same_world(make_simulator, assert_same_bits):
    pf = make_simulator().run("pf")
    decisions = set()
    for policy in CLASSICAL:
        record = make_simulator().run(policy)
        assert_same_bits(record, pf, WORLD)
        decisions.add(record.prb_owner.tobytes())
    assert len(decisions) == len(CLASSICAL)


@pytest.mark.parametrize("policy", ["pf", "max_weight"])
def test_two_runs_are_one(make_simulator, assert_same_bits, policy):
    """Also across a sample of 20 ms and a window of 1 s that the cut falls into."""
    whole = make_simulator(num_slots=210).run(policy)
    halves = make_simulator(num_slots=210)
    for start, count in ((0, 1), (1, 98), (99, 51), (150, 60)):
        part = halves.run(policy, count)
        assert_same_bits(part, SlotRecord(*(f[:, start : start + count] for f in whole)))
    assert halves.slots_left == 0


def test_the_horizon_changes_nothing(make_simulator, assert_same_bits):
    short = make_simulator(num_slots=20).run("pf")
    long = make_simulator(num_slots=300).run("pf", 20)
    assert_same_bits(long, short)


def test_any_slot_can_be_drawn_again_alone(make_simulator):
    simulator = make_simulator()
    record = simulator.run("pf")
    scale = np.float32(2 * simulator.scenario.radio.fading.scale**2)
    for env, slot in ((0, 0), (1, 17), (0, 59)):
        key = simulator.state.key[env]
        uniform = np.empty(8)
        draw_uniforms(key, STREAM_ARRIVAL, slot, 0, uniform)
        np.testing.assert_array_equal(uniform, record.arrival_uniform[env, slot])
        power = np.empty(80, np.float32)
        draw_exponentials(key, slot, scale, np.zeros((4, 20), np.uint32), power)
        np.testing.assert_array_equal(power, record.fading_power[env, slot].ravel())


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_mean_fading_power_is_twice_the_squared_scale(make_simulator, scale):
    record = make_simulator(4, 200, radio={"fading": Rayleigh(scale=scale)}).run("round_robin")
    power = record.fading_power.astype(np.float64)
    mean = 2 * scale**2
    assert power.mean() == pytest.approx(mean, abs=4 * mean / np.sqrt(power.size))
    means = record.mean_fading_power
    np.testing.assert_allclose(means, power.mean(axis=-1), rtol=1e-6)


def test_equal_weights_are_pf(make_simulator, assert_same_bits):
    pf = make_simulator().run("pf")
    assert_same_bits(make_simulator().run("pf", weights=np.ones((2, 8))), pf)
    same = make_simulator().run("pf", weights=np.full((2, 8), 2.0))
    assert_same_bits(same, pf, set(pf._fields) - {"weight"})


@pytest.mark.parametrize("policy", ["edf", "pf"])
def test_given_owners_are_the_policy_that_chose_them(make_simulator, assert_same_bits, policy):
    original = make_simulator().run(policy)
    assert_same_bits(make_simulator().run(LoggedDecisions(original.prb_owner)), original)


def test_robots_alone_leave_nothing_of_the_network(make_simulator):
    """Also where the same simulator has run the network before."""
    simulator = make_simulator(num_slots=60)
    simulator.run("pf", 30)
    delay_s = np.full((simulator.num_envs, 30, simulator.scenario.users.num_urllc), 0.015)
    record = simulator.run_robots(delay_s)
    assert not record.rate_mbps.any()
    assert not record.prb_owner.any()
    assert record.tracking_error_m.any()
