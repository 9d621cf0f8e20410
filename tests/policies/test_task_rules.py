"""Rules by the robots' task, and the knob of every rule: the numbers are worked out beside them."""

from __future__ import annotations

import numpy as np
import pytest

from hiersched.policies.index_rules import CLASSICAL
from hiersched.policies.registry import RULES
from hiersched.policies.task_rules import TASK_RULES, whittle_index

# Two URLLC users and one eMBB user.
LEVEL = np.ones((3, 3))
DRIFT = tuple(name for name in TASK_RULES if hasattr(RULES[name], "weighs"))


@pytest.fixture(scope="session")
def weights(decide_by_hand):
    """Weights of drift and penalty under a rule, and urgencies: (3,) each."""

    def of(name, weighs=None, **values):
        keys = {**values.pop("keys", {}), **({} if weighs is None else {"weighs": weighs})}
        simulator, _ = decide_by_hand(name, LEVEL, num_urllc=2, keys=keys, **values)
        state = simulator.state
        return state.drift_weight[0].tolist(), state.index_weight[0].tolist()

    return of


CASES = {
    # 2 (0.3 + 0.4²) = 0.92 and 2 (0.3 + 0²) = 0.6
    "urgency": ({"set_point_speed_mps": [0.4, 0.0]}, {}, [0.92, 0.6]),
    # λ = 1 and 3, mean 2: 2 (0.05 + 0.4²) 2² = 1.68, 2 (0.05 + 0.6²) (2/3)² = 0.3644…
    "cmu": (
        {"set_point_speed_mps": [0.4, 0.6], "mean_due_packets": [1.0, 3.0, 50.0]},
        {},
        [1.68, 0.82 * 4 / 9],
    ),
    # 4 cm: 2 (0.1 + 2²) = 8.2; 1 cm: 2 (0.1 + 0.25) = 0.7
    "error_weight": ({"reported_error_m": [0.04, 0.01]}, {}, [8.2, 0.7]),
    "gap_weight": ({"set_point_gap_m": [0.04, 0.01]}, {}, [8.2, 0.7]),
    # 6 m/s²: 2 (0.1 + 2²); 1.5 m/s²: 2 (0.1 + 0.25)
    "surprise": ({"set_point_acceleration_mps2": [6.0, 1.5]}, {}, [8.2, 0.7]),
    # λ = 1 and 3: 2 · 2² = 8, 2 (2/3)² = 0.8889
    "lag": ({"mean_due_packets": [1.0, 3.0, 50.0]}, {}, [8.0, 8 / 9]),
    # Slots of 10 ms: 30 ms are 3 slots; 4 ms count as the slot that is the least.
    "age": ({"set_point_age_s": [0.03, 0.004]}, {}, [6.0, 2.0]),
}
"""What is known, further keys, and the weights of both URLLC users for k = 2."""


@pytest.mark.parametrize("name", DRIFT)
def test_weight_of_the_drift(weights, name):
    known, keys, expected = CASES[name]
    keys = {"urllc_factor": 2.0, **keys}
    drift, both = weights(name, **known, keys=keys)
    np.testing.assert_allclose(drift, [*expected, 1.0], rtol=1e-14)
    assert both == [1.0, 1.0, 1.0]
    drift, both = weights(name, "both", **known, keys=keys)
    np.testing.assert_allclose(both, [*expected, 1.0], rtol=1e-14)
    assert drift == [1.0, 1.0, 1.0]
    # k is a factor, and what other rules read changes nothing.
    others = {
        key: 9.0
        for other, _, _ in CASES.values()
        for key in other
        if key not in known and key != "mean_due_packets"
    }
    drift, _ = weights(name, **known, **others, keys={**keys, "urllc_factor": 6.0})
    np.testing.assert_allclose(drift[:2], 3.0 * np.array(expected), rtol=1e-14)


@pytest.mark.parametrize("name", ["urgency", "cmu", "task_edf"])
def test_speed_of_the_newest_or_of_those_that_wait(weights, name):
    known = {"set_point_speed_mps": [0.4, 0.0], "waiting_speed_mps": [0.4, 0.4]}
    for speed, equal in (("newest", False), ("waiting", True)):
        drift, urgency = weights(name, **known, keys={"speed": speed})
        values = urgency if name == "task_edf" else drift
        assert (values[0] == values[1]) == equal
        assert values[0] >= values[1]


@pytest.mark.parametrize("name", ["cmu", "lag"])
def test_a_user_that_sends_nothing_counts_as_the_mean(weights, name):
    drift, _ = weights(name, mean_due_packets=[0.0, 4.0, 1.0])  # mean 2
    assert drift[1] == pytest.approx(drift[0] / 4.0, rel=1e-14)


def test_whittle_weight(weights):
    """h = 3 and 1 slots, p = 1: 3 · 4 / 2 = 6 and 1 · 2 / 2 = 1."""
    drift, _ = weights("age", set_point_age_s=[0.03, 0.01], keys={"index": "whittle"})
    np.testing.assert_allclose(drift, [6.0, 1.0, 1.0], rtol=1e-14)


@pytest.mark.parametrize("delivery", [1.0, 0.6])
@pytest.mark.parametrize("age", [1, 4])
def test_whittle_index_is_the_charge_at_which_waiting_costs_the_same(age, delivery):
    """From the age h on, a slot is sent in until it is delivered: n ~ Geom(p), h - 1 + n slots."""
    attempts = np.arange(1, 400)
    chance = delivery * (1.0 - delivery) ** (attempts - 1)

    def mean_cost(first, charge):
        slots = first - 1 + attempts
        ages = slots * (slots + 1) / 2  # 1 + 2 + … slots
        return (chance @ (ages + charge * attempts)) / (chance @ slots)

    charge = whittle_index(float(age), delivery)
    assert mean_cost(age, charge) == pytest.approx(mean_cost(age + 1, charge), rel=1e-12)
    assert mean_cost(age, 0.9 * charge) < mean_cost(age + 1, 0.9 * charge)


def test_decision_by_urgency(decide_by_hand):
    """F = 10 and 10, no arrivals, V = 0; one PRB each, the third to whom the drift falls more.

    Equal rates 3: ½(7² − 4²) = 16.5 times 0.3 + 1 and 0.3. A speed of 1 m/s decides.
    """
    given = {"backlog_packets": [10.0, 10.0], "num_urllc": 2}
    rate = np.full((2, 3), 3.0)
    for speed, winner in (([1.0, 0.0], 0), ([0.0, 1.0], 1)):
        _, owner = decide_by_hand("urgency", rate, set_point_speed_mps=speed, **given)
        assert owner.tolist().count(winner) == 2


def test_penalty_is_not_weighed_with_the_drift_alone(decide_by_hand):
    """Empty queues: V / r² alone decides. A URLLC user with r = 1 a PRB, an eMBB user with 0.9.

    The third PRB is worth V (1 − 1/4) = 0.75 V to the first and 0.926 V to the second, whatever
    the weight of the drift; with k = 9 on the penalty too it is worth 6.75 V to the first.
    """
    rate = [[1.0, 1.0, 1.0], [0.9, 0.9, 0.9]]
    given = {"num_urllc": 1, "penalty_weight": 100.0, "epsilon": 1e-12}
    for name in ("drift_plus_penalty", "urgency"):
        for weighs, winner in (("drift", 1), ("both", 0)):
            keys = {"urllc_factor": 9.0, "weighs": weighs}
            _, owner = decide_by_hand(name, rate, keys=keys, **given)
            assert owner.tolist().count(winner) == 2, (name, weighs)


def test_task_deadlines(weights):
    """2 cm in 50 ms at 0.4 m/s; at 0.01 m/s 200 ms, at 40 m/s 5 ms bound it; 5 ms core latency."""
    urgency = {}
    for speed in (0.4, 0.01, 40.0, 0.0):
        given = {"set_point_speed_mps": [speed, 0.4], "hol_delay_s": [0.01, 0.0, 0.1]}
        _, urgency[speed] = weights("task_edf", deadline_s=[0.02, 0.02, 0.3], **given)
        np.testing.assert_allclose(urgency[speed][1:], [-0.045, 0.1 - 0.3], rtol=1e-13)
    got = [urgency[speed][0] for speed in (0.4, 0.01, 40.0, 0.0)]
    np.testing.assert_allclose(got, [0.01 - 0.045, 0.01 - 0.195, 0.01, 0.01 - 0.195], rtol=1e-13)
    # The knob: 1 cm halves 50 ms.
    keys = {"tolerance_m": 0.01}
    _, half = weights("task_edf", set_point_speed_mps=0.4, hol_delay_s=0.0, keys=keys)
    np.testing.assert_allclose(half, [-0.02, -0.02, -0.02], rtol=1e-13)


def test_task_deadlines_decide_the_order(decide_by_hand):
    """Equal waits: the robot that moves is first and takes two of three PRBs; its need is two."""
    given = {"num_urllc": 2, "backlog_packets": [2.0, 2.0]}
    for speed, winner in (([0.4, 0.0], 0), ([0.0, 0.4], 1)):
        _, owner = decide_by_hand("task_edf", np.ones((2, 3)), set_point_speed_mps=speed, **given)
        assert owner.tolist().count(winner) == 2


def test_try_once_discard(decide_by_hand):
    """Gaps of 1 and 3 cm; eMBB users last, though 0.4 s past a deadline, by W − D among them.

    Seven PRBs of 1 Mbit/s, a packet each: one a user, and the three others to user 1, who needs 3
    (two more), then user 0 (one more of 2).
    """
    rate = np.ones((4, 7))
    given = {
        "num_urllc": 2,
        "set_point_gap_m": [0.01, 0.03],
        "hol_delay_s": [0.0, 0.0, 0.7, 0.5],
        "deadline_s": [0.02, 0.02, 0.3, 0.3],
    }
    simulator, owner = decide_by_hand(
        "try_once_discard", rate, backlog_packets=[2.0, 3.0, 9.0, 9.0], **given
    )
    assert np.bincount(owner).tolist() == [2, 3, 1, 1]
    urgency = simulator.state.index_weight[0]
    np.testing.assert_allclose(urgency, [0.01, 0.03, -1.0, -1.2], rtol=1e-13)
    np.testing.assert_allclose(simulator.state.need_mbps[0], [2.0, 3.0, 9.0, 9.0])
    # When nobody is late eMBB users are last as well, and without a gap too.
    given |= {"hol_delay_s": [0.0, 0.0, 0.1, 0.2], "set_point_gap_m": 0.0}
    simulator, owner = decide_by_hand("try_once_discard", rate, backlog_packets=9.0, **given)
    np.testing.assert_allclose(simulator.state.index_weight[0], [0, 0, -1.2, -1.1], rtol=1e-13)
    assert np.bincount(owner).tolist() == [4, 1, 1, 1]


# The knob.


@pytest.mark.parametrize("name", [n for n in CLASSICAL if RULES[n].knob == "urllc_factor"])
def test_the_factor_multiplies_the_weights_of_urllc_users(weights, name):
    given = {"backlog_packets": [1.0, 2.0, 3.0], "hol_delay_s": [0.01, 0.03, 0.02]}
    place = 0 if name == "drift_plus_penalty" else 1
    for keys in ({}, *({"need": need} for need in ("backlog",) if hasattr(RULES[name], "need"))):
        given |= keys
        plain = np.array(weights(name, **given)[place])
        eight = np.array(weights(name, **given, keys={"urllc_factor": 8.0})[place])
        assert eight.tolist() == [8.0 * plain[0], 8.0 * plain[1], plain[2]]
        assert (plain > 0.0).all()


def test_the_factor_of_the_deadlines(weights):
    given = {"deadline_s": [0.02, 0.02, 0.3], "hol_delay_s": [0.01, 0.0, 0.1]}
    assert weights("edf", **given)[1] == [0.01 - 0.02, -0.02, 0.1 - 0.3]
    half = weights("edf", **given, keys={"deadline_factor": 0.5})[1]
    assert half == [0.0, -0.01, 0.1 - 0.3]


def test_every_family_names_its_knob_and_what_it_knows():
    without = {name for name in (*CLASSICAL, *TASK_RULES) if RULES[name].knob is None}
    assert without == {"round_robin", "try_once_discard"}
    for name in {*CLASSICAL, *TASK_RULES} - without:
        assert getattr(RULES[name](**{RULES[name].knob: 3.0}), RULES[name].knob) == 3.0
    knowing = {name for name in (*CLASSICAL, *TASK_RULES) if RULES[name].knows_task}
    assert knowing == {*TASK_RULES} - {"lag", "age"}


def test_looks_are_of_one_rule_each():
    names = (*CLASSICAL, *TASK_RULES)
    looks = [RULES[name].look for name in names]
    assert len({look.label for look in looks}) == len(names)
    assert len({look.color for look in looks}) == len(names)
    assert len({str(look.dashes) for look in looks}) == len(names)
    by_task = [RULES[name].look for name in TASK_RULES]
    assert len({look.marker for look in by_task}) == len(by_task)
    # Those that know the task have long dashes, and nobody else.
    for name, look in zip(names, looks, strict=True):
        assert (look.dashes[1][0] == 10) == RULES[name].knows_task
