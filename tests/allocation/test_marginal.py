"""The allocator against scipy's assignment, a plain greedy twin and exhaustive search."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from hiersched.allocation import ALLOCATE
from hiersched.allocation.assignment import assign_one_each
from hiersched.allocation.in_order import TurnWords, urgency_words
from hiersched.allocation.marginal import CAPPED, LAGRANGIAN, LINEAR, LOG, marginal_words
from hiersched.allocation.objective import user_lagrangian
from hiersched.core.compiled import kernel
from hiersched.core.pointer import Pointer
from hiersched.core.seam import call_plug
from hiersched.policies.index_rules import CLASSICAL

SHAPES = [(1, 1), (1, 7), (2, 3), (5, 5), (8, 10), (20, 25), (25, 25), (80, 100), (3, 40)]
SIZES = st.integers(1, 8).flatmap(lambda u: st.tuples(st.just(u), st.integers(u, 12)))


def random_rates(seed, num_users, num_prb):
    h2 = np.random.default_rng(seed).exponential(size=(num_users, num_prb))
    return np.log2(1 + 100 * h2).astype(np.float32)


def assignment_cost(cost):
    num_users, num_prb = cost.shape
    scratch = marginal_words(LOG, num_users, num_prb)
    scratch.cost[:, :num_prb] = cost
    scratch.nearest[:] = cost.argmin(axis=1)
    assign_one_each(scratch)
    prb_of_user = scratch.prb_of_user
    assert len(set(prb_of_user.tolist())) == len(cost)
    for k, user in enumerate(scratch.user_of_prb[:num_prb]):
        assert (user == -1 and k not in prb_of_user) or prb_of_user[user] == k
    return cost[np.arange(len(cost)), prb_of_user].sum()


def reduced(cost):
    return np.maximum(cost - cost.min(axis=1, keepdims=True), 0.0)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("kind", ["continuous", "ties", "spread"])
def test_assignment_has_scipys_value(shape, kind):
    rng = np.random.default_rng(shape)
    for _ in range(20):
        cost = {
            "continuous": lambda: rng.uniform(size=shape),
            "ties": lambda: rng.integers(0, 4, shape).astype(float),
            "spread": lambda: 10.0 ** rng.uniform(-9, 9, shape),
        }[kind]()
        cost = reduced(cost)
        best = cost[linear_sum_assignment(cost)].sum()
        assert assignment_cost(cost) == pytest.approx(best, rel=1e-9, abs=1e-12)


def test_equal_costs_are_assigned():
    assert assignment_cost(np.zeros((6, 9))) == 0.0


class Constants(NamedTuple):
    num_urllc: int
    service_coefficient_mbps: float
    offered_mbps: NDArray[np.float64]
    rate_sensitivity: NDArray[np.float64]
    arrival_packets_per_mbps: NDArray[np.float64]
    service_packets_per_mbps: float
    penalty_weight: float
    epsilon: float
    delay_exponent_per_mbps: float
    violation_share: float


class State(NamedTuple):
    slot: NDArray[np.int64]
    reported_rate_mbps: NDArray[np.float32]
    weight: NDArray[np.float64]
    index_weight: NDArray[np.float64]
    need_mbps: NDArray[np.float64]
    backlog_packets: NDArray[np.float64]
    dexterity_index: NDArray[np.float64]
    multiplier: NDArray[np.float64]
    drift_weight: NDArray[np.float64]


class Slot(NamedTuple):
    prb_owner: NDArray[np.uint32]


@kernel()
def call(plug, constants, state, slot):
    call_plug(plug, constants, state, slot, 0)


def run(words, rate, terms, *, weight=1.0, index=1.0, need=np.nan, slot=0):
    """Owner of each PRB by an allocation in a world of its own, all of whose users are URLLC."""
    num_users, num_prb = rate.shape
    named = {name: getattr(terms, name) for name in Constants._fields[2:]}
    constants = Constants(num_urllc=num_users, service_coefficient_mbps=1.0, **named)
    of_users = (np.broadcast_to(np.asarray(x, float), num_users) for x in (weight, index, need))
    rows = (*of_users, terms.backlog_packets, terms.service_offset_mbps, terms.multiplier)
    rows = (*rows, terms.drift_weight)
    state = State(np.array([slot]), rate[None], *(row[None].copy() for row in rows))
    owner = Slot(np.full(num_prb, 10**6, np.uint32))
    pointers = Pointer(constants), Pointer(state), Pointer(owner)
    plug, _kept = ALLOCATE.plug(words, *pointers)
    call(plug, *pointers)
    return owner.prb_owner


def allocate(utility, rate, weight, terms):
    return run(marginal_words(utility, *rate.shape), rate, terms, weight=weight)


def greedy_twin(value, rate):
    """The allocation in ten lines; value(user, rate) is a user's utility."""
    num_users, num_prb = rate.shape
    users = range(num_users)
    alone = np.array([[value(u, float(r)) for r in rate[u]] for u in users])
    owner = np.full(num_prb, -1)
    first = linear_sum_assignment(-alone)
    owner[first[1]] = first[0]
    have = rate[first].astype(float)
    while (owner < 0).any():
        gain = {
            (k, u): value(u, have[u] + float(rate[u, k])) - value(u, have[u])
            for k in np.flatnonzero(owner < 0)
            for u in users
        }
        k, u = max(gain, key=gain.__getitem__)
        owner[k] = u
        have[u] += float(rate[u, k])
    return owner


def test_prbs_that_harm_go_to_users_all_the_same(make_terms):
    """With a negative V every PRB is a loss; lanes without a user must not look better."""
    rate = random_rates(4, 5, 9)
    terms = make_terms(5, penalty_weight=-1.0)
    owner = allocate(LAGRANGIAN, rate, np.ones(5), terms)
    expected = greedy_twin(lambda u, r: -user_lagrangian(terms, u, r), rate)
    np.testing.assert_array_equal(owner, expected)


@pytest.mark.parametrize("shape", [(1, 6), (3, 8), (8, 10), (12, 25)])
@pytest.mark.parametrize("utility", [LOG, LINEAR, LAGRANGIAN])
def test_greedy_part_is_that_of_the_plain_twin(shape, utility, make_terms):
    for seed in range(10):
        rng = np.random.default_rng([seed, *shape])
        rate = random_rates(seed, *shape)
        weight = np.exp(rng.uniform(-3, 3, shape[0]))
        terms = make_terms(
            shape[0],
            backlog_packets=rng.uniform(0, 30, shape[0]),
            offered_mbps=rng.uniform(1, 10, shape[0]),
            rate_sensitivity=0.1,
            penalty_weight=100.0,
            multiplier=rng.uniform(0, 5, shape[0]),
        )
        value = {
            LOG: lambda u, r, w=weight: w[u] * np.log(r),
            LINEAR: lambda u, r, w=weight: w[u] * r,
            LAGRANGIAN: lambda u, r, w=weight, t=terms: -w[u] * user_lagrangian(t, u, r),
        }[utility]
        np.testing.assert_array_equal(
            allocate(utility, rate, weight, terms), greedy_twin(value, rate)
        )


def test_proportional_fairness_is_close_to_the_best_of_all_allocations(make_terms):
    """Exhaustive search over 3 users and 6 PRBs: the greedy part loses little."""
    losses = []
    for seed in range(30):
        rate = random_rates(seed, 3, 6)
        everyone = [o for o in itertools.product(range(3), repeat=6) if len(set(o)) == 3]

        def product(owner, rate=rate):
            return np.prod([rate[u, np.array(owner) == u].sum() for u in range(3)])

        got = product(tuple(allocate(LOG, rate, np.ones(3), make_terms(3))))
        best = max(product(o) for o in everyone)
        assert got <= best * (1 + 1e-6)
        losses.append(1 - (got / best) ** (1 / 3))  # of the geometric mean rate
    assert np.mean(losses) < 0.03
    assert max(losses) < 0.1


@pytest.mark.parametrize("name", sorted(CLASSICAL))
@settings(max_examples=30)
@given(size=SIZES, seed=st.integers(0, 1000), ties=st.booleans())
def test_every_prb_has_one_owner_and_every_user_a_prb(schedule, name, size, seed, ties):
    num_users, num_prb = size
    rng = np.random.default_rng(seed)
    rate = random_rates(seed, *size)
    if ties:
        rate = np.maximum(np.round(rate), np.float32(1))
    urllc = np.arange(num_users) < (num_users + 1) // 2
    owner = schedule(
        name,
        rate,
        slot=seed,
        weight=np.exp(rng.uniform(-3, 3, num_users)),
        hol_delay_s=rng.choice([0.0, 0.01, 0.3], num_users),
        average_rate_mbps=rng.uniform(1, 30, num_users),
        num_urllc=urllc.sum(),
        backlog_packets=rng.choice([0.0, 1.5, 80.0], num_users),
        multiplier=np.where(urllc, rng.choice([0.0, 3.0], num_users), 0.0),
        penalty_weight=100.0,
    )
    assert set(owner) == set(range(num_users))
    assert len(owner) == num_prb


@pytest.mark.parametrize("name", sorted(set(CLASSICAL) - {"round_robin"}))
@settings(max_examples=20)
@given(size=SIZES, seed=st.integers(0, 1000))
def test_permuting_users_permutes_the_result(schedule, name, size, seed):
    """Within a slice: exp_pf treats the slices apart."""
    num_users, _ = size
    rng = np.random.default_rng(seed)
    rate = random_rates(seed, *size)
    order = rng.permutation(num_users)
    given_values = {
        "weight": np.exp(rng.uniform(-3, 3, num_users)),
        "hol_delay_s": rng.uniform(0.001, 0.3, num_users),
        "average_rate_mbps": rng.uniform(1, 30, num_users),
        "deadline_s": rng.uniform(0.01, 0.5, num_users),
        "backlog_packets": rng.uniform(1, 80.0, num_users),
        "multiplier": rng.uniform(0, 3.0, num_users),
    }
    owner = np.array(schedule(name, rate, penalty_weight=100.0, **given_values))
    permuted = {key: value[order] for key, value in given_values.items()}
    again = np.array(schedule(name, rate[order], penalty_weight=100.0, **permuted))
    np.testing.assert_array_equal(order[again], owner)


@settings(max_examples=30)
@given(size=SIZES, seed=st.integers(0, 1000))
def test_equal_weights_are_plain_proportional_fairness(schedule, size, seed):
    """An agent's action a = 0 gives the weight exp(c · 0) = 1; a common factor changes nothing."""
    rate = random_rates(seed, *size)
    assert schedule("pf", rate, weight=np.exp(3.0 * 0.0)) == schedule("pf", rate, weight=4.0)


def test_need_is_met_in_the_order_of_urgency(make_terms):
    """Three users, five PRBs. Order of urgency: 2, 0, 1, with one PRB each first.

    User 2 takes its best, PRB 0 (9); user 0 PRB 1 (8), user 1 PRB 3 (5). User 2 needs 12: PRB 4 (4)
    brings 13. User 0 needs 20 and takes PRB 2 (1).
    """
    rate = np.array([[2, 8, 1, 3, 2], [1, 4, 3, 5, 1], [9, 7, 2, 3, 4]], np.float32)
    given = {"index": [1.0, 0.0, 2.0], "need": [20.0, 0.0, 12.0]}
    owner = run(urgency_words(3, 5), rate, make_terms(3), **given)
    assert owner.tolist() == [2, 0, 0, 1, 2]


def test_what_nobody_needs_goes_around_in_the_same_order(make_terms):
    rate = np.array([[5, 4, 3, 2, 1], [1, 2, 3, 4, 5]], np.float32)
    # User 1 first: PRB 4; user 0: PRB 0; then 1: PRB 3, 0: PRB 1, 1: PRB 2.
    got = run(urgency_words(2, 5), rate, make_terms(2), index=[0.0, 1.0], need=0.0)
    assert got.tolist() == [0, 0, 1, 1, 1]


def test_turns_go_on_where_the_last_slot_stopped(make_terms):
    rate = np.ones((3, 4), np.float32)
    terms = make_terms(3)
    rows = [run(TurnWords(), rate, terms, slot=slot).tolist() for slot in range(3)]
    assert rows == [[0, 1, 2, 0], [1, 2, 0, 1], [2, 0, 1, 2]]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"index": [1.0, -0.1]}, "a weight that is negative or not finite"),
        ({"weight": [1.0, np.nan]}, "a weight that is negative or not finite"),
        ({"index": [np.inf, 1.0]}, "a weight that is negative or not finite"),
    ],
)
def test_weights_that_cannot_be_are_refused(make_terms, given, message):
    rate = random_rates(1, 2, 3)
    with pytest.raises(ValueError, match=message):
        run(marginal_words(LINEAR, 2, 3), rate, make_terms(2), **given)
    if given.get("index") == [1.0, -0.1]:  # an urgency may be negative
        run(urgency_words(2, 3), rate, make_terms(2), need=0.0, **given)
    else:
        given = {"index": given.get("index", given.get("weight"))}
        with pytest.raises(ValueError, match=message):
            run(urgency_words(2, 3), rate, make_terms(2), need=0.0, **given)


@pytest.mark.parametrize("need", [-0.1, np.nan])
def test_needs_that_cannot_be_are_refused(make_terms, need):
    rate = random_rates(1, 2, 3)
    for words in (marginal_words(CAPPED, 2, 3), urgency_words(2, 3)):
        with pytest.raises(ValueError, match="a need that is negative or not a number, or none"):
            run(words, rate, make_terms(2), need=[1.0, need])


@pytest.mark.parametrize(
    ("shape", "message"),
    [((4, 3), "num_users = 4: must be 1 to num_prb = 3"), ((0, 3), "num_users = 0"),
     ((2, 1024), "num_prb = 1024: at most 1023")],
)  # fmt: skip
def test_impossible_sizes_are_refused(shape, message):
    with pytest.raises(ValueError, match=message):
        marginal_words(LOG, *shape)
