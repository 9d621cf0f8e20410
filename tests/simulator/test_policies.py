"""Policies of all forms in the slot loop: rules, weighing kernels, Python; what they see."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import pytest
import yaml

from hiersched.allocation.exact import owned_rates
from hiersched.allocation.objective import slot_terms, user_lagrangian
from hiersched.policies.find import ExactPolicy
from hiersched.policies.index_rules import CLASSICAL, LogRule, MaxWeight
from hiersched.policies.policy import LoggedWeights, Owners, View, Weigher, Weights
from hiersched.policies.registry import RULES, Rule
from hiersched.policies.seams import ALLOCATE, INDEX, WEIGH
from hiersched.policies.task_rules import TASK_RULES
from hiersched.scenario import load_scenario
from hiersched.simulator.setup import TASK_STATE, SlotState

BUT_WEIGHTS = {"weight"}
BY_THE_POLICY = {"weight", "index_weight", "need_mbps", "drift_weight", "multiplier"}


class Decider:
    """A policy from a function of the view; keeps what it was shown of each slot."""

    def __init__(self, function):
        self.function, self.seen = function, []

    def decide(self, view):
        self.seen.append({name: np.copy(getattr(view, name)) for name in View._fields[:-1]})
        return self.function(view)


class OwnWords(NamedTuple):
    fault: int
    calls: Any


@dataclass(frozen=True, kw_only=True)
class Own(Rule):
    """Round robin by a kernel of its own; with a fault from slot 3 on in the second world."""

    model: Literal["own"] = "own"
    fault: Literal["none", "left_out", "beyond"] = "none"

    @property
    def allocation(self):
        return "own"

    def words(self, setup):
        return OwnWords(("none", "left_out", "beyond").index(self.fault), np.zeros(1, np.int64))


@ALLOCATE.kernel(OwnWords)
def allocate_own(me, constants, state, slot, env):
    me.calls[0] += 1
    num_users, num_prb = slot.rate_mbps.shape[0], slot.prb_owner.shape[0]
    faulty = env == 1 and state.slot[env] >= 3
    for prb in range(num_prb):
        owner = (state.slot[env] * num_prb + prb) % num_users
        if faulty and me.fault == 1 and owner == 4:
            owner = 5
        if faulty and me.fault == 2 and prb == num_prb - 1:
            owner = num_users
        slot.prb_owner[prb] = owner


class TurnWords(NamedTuple):
    turn: Any


@dataclass(frozen=True, kw_only=True)
class Turn(Rule):
    """Owners by a counter of its own, which begins at the key of the world."""

    model: Literal["turn"] = "turn"
    allocation = "own"

    def words(self, setup):
        return TurnWords(np.zeros(setup.num_envs, np.int64))

    def reset(self, words, keys):
        words.turn[:] = keys % np.uint64(8)


@ALLOCATE.kernel(TurnWords)
def allocate_turn(me, constants, state, slot, env):
    for prb in range(slot.prb_owner.shape[0]):
        slot.prb_owner[prb] = (me.turn[env] + prb) % slot.rate_mbps.shape[0]
    me.turn[env] += 3


class DoubleWords(NamedTuple):
    factor: float


class Favour(Weigher):
    """Weighs the last users by a factor that grows with their multipliers."""

    rule = "pf"

    def __init__(self, factor, multipliers):
        self.factor, self.multipliers = factor, multipliers

    def words(self, setup):
        return DoubleWords(self.factor)


@WEIGH.kernel(DoubleWords)
def weigh_favour(me, constants, state, slot, env):
    for user in range(state.weight.shape[1]):
        price = state.multiplier[env, user] if user < constants.num_urllc else 1.0
        state.weight[env, user] = 1.0 + me.factor * price


@pytest.mark.parametrize("rule", [name for name in CLASSICAL if name != "round_robin"])
def test_weights_from_python_are_weights_of_the_rule(make_simulator, assert_same_bits, rule):
    weights = np.exp(np.random.default_rng(1).uniform(-2, 2, (2, 8)))
    expected = make_simulator(num_slots=20).run(rule, weights=weights)
    policy = Decider(lambda view: Weights(weights, rule))
    assert_same_bits(make_simulator(num_slots=20).run(policy), expected)
    assert len(policy.seen) == 20


@pytest.mark.parametrize(
    ("weights", "rule"),
    [
        (lambda view: 1.0 / view.average_rate_mbps, "pf_average"),
        (
            lambda view: (
                np.log(1.1 + 5.0 * view.hol_delay_s / view.constants.deadline_s)
                / view.average_rate_mbps
            ),
            LogRule(need="none"),
        ),
    ],
)
def test_a_rule_written_in_python_is_the_compiled_one(
    make_simulator, assert_same_bits, weights, rule
):
    expected = make_simulator().run(rule)
    record = make_simulator().run(Decider(lambda view: Weights(weights(view), "max_rate")))
    assert_same_bits(record, expected, set(record._fields) - BUT_WEIGHTS)
    assert (expected.prb_owner != make_simulator().run("max_rate").prb_owner).any()


@pytest.mark.parametrize("rule", CLASSICAL)
def test_owners_from_python_reproduce_the_decisions(make_simulator, assert_same_bits, rule):
    expected = make_simulator(num_slots=20).run(rule)
    decisions = iter(expected.prb_owner.swapaxes(0, 1))
    record = make_simulator(num_slots=20).run(Decider(lambda view: Owners(next(decisions))))
    assert_same_bits(record, expected)


def test_round_robin_by_hand_is_the_rule(make_simulator, assert_same_bits):
    def turn(view):
        _, num_users, num_prb = view.rate_mbps.shape
        return Owners((view.slot[:, None] * num_prb + np.arange(num_prb)) % num_users)

    assert_same_bits(make_simulator().run(Decider(turn)), make_simulator().run("round_robin"))


def test_a_policy_may_change_its_form_from_slot_to_slot(make_simulator, assert_same_bits):
    expected = make_simulator()
    parts = [expected.run(name, 1) for name in ("pf", "edf", "max_rate", "m_lwdf")]
    ones = np.ones((2, 8))
    answers = iter(
        [
            Weights(ones),
            Owners(parts[1].prb_owner[:, 0]),
            Weights(ones, "max_rate"),
            Weights(ones, "m_lwdf"),
        ]
    )
    record = make_simulator().run(Decider(lambda view: next(answers)), 4)
    for slot, part in enumerate(parts):
        for name in record._fields:
            assert getattr(record, name)[:, slot].tobytes() == getattr(part, name).tobytes(), name


def test_a_policy_sees_the_slot_that_comes(make_simulator):
    multipliers = np.random.default_rng(2).uniform(0, 3, (2, 4))
    policy = Decider(lambda view: Weights(np.ones((2, 8))))
    simulator = make_simulator(traffic={"load": 1.2})
    task = np.random.default_rng(3).random((len(TASK_STATE), 2, 4))
    for name, values in zip(TASK_STATE, task, strict=True):
        getattr(simulator.state, name)[:] = values
    shown = {name: np.copy(getattr(simulator.view, name)) for name in TASK_STATE}
    for name, values in zip(TASK_STATE, task, strict=True):
        np.testing.assert_array_equal(shown[name], values, err_msg=name)
    record = simulator.run(policy, multipliers=multipliers)
    radio = simulator.scenario.radio
    snr = 10 ** ((radio.tx_power_dbm - radio.noise_dbm) / 10)
    for slot, seen in enumerate(policy.seen):
        assert (seen["slot"] == slot).all()
        for name in ("backlog_packets", "hol_delay_s", "average_rate_mbps", "dexterity_index"):
            np.testing.assert_array_equal(seen[name], getattr(record, name)[:, slot], err_msg=name)
        np.testing.assert_array_equal(seen["multiplier"], multipliers)
        last = record.rate_mbps[:, slot - 1] if slot else np.zeros((2, 8))
        np.testing.assert_array_equal(seen["last_rate_mbps"], last)
        power = record.fading_power[:, slot].astype(float)
        rate = radio.bandwidth_hz / radio.num_prb * 1e-6 * np.log2(1.0 + snr * power)
        np.testing.assert_allclose(seen["rate_mbps"], rate, rtol=1e-6)
    assert record.backlog_packets.any()
    assert policy.seen[0]["average_rate_mbps"].all()


def arrays_of(value):
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, tuple):
        for part in value:
            yield from arrays_of(part)


def test_a_policy_cannot_write_into_its_view(make_simulator, assert_same_bits):
    tried = []

    def meddle(view):
        for array in arrays_of(view):
            with pytest.raises(ValueError, match="read-only"):
                array[...] = 1
            tried.append(array.shape)
        with pytest.raises(AttributeError):
            view.slot = np.zeros(2)
        return Weights(np.ones((2, 8)))

    simulator = make_simulator(num_slots=3)
    assert_same_bits(simulator.run(Decider(meddle)), make_simulator(num_slots=3).run("pf"))
    fields = len(View._fields) - 1 + len(list(arrays_of(simulator.constants)))
    assert len(tried) == 3 * fields
    assert simulator.constants.deadline_s.flags.writeable  # kernels are compiled for such arrays
    assert simulator.view.constants.loop.network_gain.shape == (
        simulator.constants.loop.network_gain.shape
    )


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (
            lambda: Weights(np.zeros((2, 8))),
            r"weights: must be positive and finite, shape \(2, 8\); user 0 of world 0 has 0.0",
        ),
        (lambda: Weights(np.ones((2, 7))), r"shape \(2, 8\), not \(2, 7\)"),
        (lambda: Weights(np.ones((2, 8)), "best"), "policy = 'best': must be one of pf"),
        (lambda: Weights(np.ones((2, 8)), "exact"), "rule = 'exact': a policy that calls Python"),
        (
            lambda: Owners(np.zeros((2, 10), int)),
            "every user 0 to 7 must own a PRB, and nobody else; user 1 of world 0 has none",
        ),
        (lambda: Owners(np.tile(np.arange(10), (2, 1))), "; PRB 8 of world 0 has 8"),
        (lambda: Owners(np.tile(np.arange(-1, 9), (2, 1))), "; PRB 0 of world 0 has -1"),
        (lambda: Owners(np.zeros((2, 10))), "prb_owner: of type float64, must be integers"),
        (lambda: Owners(np.zeros((2, 9), int)), r"shape \(2, 9\), must be \(2, 10\)"),
        (lambda: Owners(np.zeros(10, int)), r"shape \(10,\), must be \(2, 10\)"),
        (lambda: np.ones((2, 8)), r"Decider.decide returned ndarray: must be Weights or Owners"),
    ],
)
def test_what_is_no_decision_is_refused(make_simulator, answer, message):
    with pytest.raises(ValueError, match=message):
        make_simulator().run(Decider(lambda view: answer()))


def test_what_is_no_policy_is_refused(make_simulator):
    with pytest.raises(ValueError, match=r"policy = 3: neither a rule nor has it `decide\(view\)`"):
        make_simulator().run(3, 5)


# A rule whose kernel names the owners.


def test_a_rule_with_an_allocation_of_its_own_runs(make_simulator, assert_same_bits):
    expected = make_simulator().run("round_robin")
    assert_same_bits(make_simulator().run(Own()), expected)
    simulator = make_simulator()
    owners = simulator.decide(Own())
    np.testing.assert_array_equal(owners, expected.prb_owner[:, 0])


def test_what_a_rule_remembers_is_of_its_episode(make_simulator, assert_same_bits):
    keys = make_simulator().state.key
    expected = make_simulator().run(Turn())
    np.testing.assert_array_equal(expected.prb_owner[:, 1, 0], (keys % np.uint64(8) + 3) % 8)
    simulator = make_simulator()
    simulator.run(Turn(), 7)
    simulator.reset(keys[::-1])
    other = simulator.run(Turn())
    simulator.reset(keys)
    assert_same_bits(simulator.run(Turn()), expected)
    np.testing.assert_array_equal(other.prb_owner, expected.prb_owner[::-1])


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("left_out", "a rule left a user without a PRB"),
        ("beyond", "a rule gave a PRB to a user that is not there"),
    ],
)
def test_a_rule_that_allocates_wrongly_is_stopped(make_simulator, fault, message):
    simulator = make_simulator()
    simulator.run(Own(fault=fault), 3)
    with pytest.raises(ValueError, match=message):
        simulator.run(Own(fault=fault), 1)
    simulator.reset(simulator.state.key)
    with pytest.raises(ValueError, match=message):
        simulator.run(Own(fault=fault))
    # One world alone has no fault: it is that of the second.
    make_simulator(1).run(Own(fault=fault))


# Weights: of a kernel, held, of a log.


def test_a_kernel_weighs_the_users_of_a_rule(make_simulator, assert_same_bits):
    multipliers = np.array([0.0, 0.5, 1.0, 2.0])
    policy = Favour(0.75, multipliers)
    weights = np.tile(1.0 + 0.75 * np.append(multipliers, np.ones(4)), (2, 1))
    expected = make_simulator().run("pf", weights=weights, multipliers=np.tile(multipliers, (2, 1)))
    assert_same_bits(make_simulator().run(policy), expected)
    assert (expected.prb_owner != make_simulator().run("pf").prb_owner).any()


@pytest.mark.parametrize("rule", ["pf", "m_lwdf", "drift_plus_penalty"])
def test_weights_are_held_for_all_slots_of_a_run(make_simulator, assert_same_bits, rule):
    rng = np.random.default_rng(3)
    weights = np.exp(rng.uniform(-2, 2, (12, 2, 8)))
    whole, single = make_simulator(), make_simulator()
    for given in weights:
        held = whole.run(rule, 5, weights=given)
        for slot in range(5):
            one = single.run(rule, 1, weights=given)
            for name in one._fields:
                here = getattr(held, name)[:, slot : slot + 1]
                assert here.tobytes() == getattr(one, name).tobytes(), name
        assert (held.weight == given[:, None].astype(np.float32)).all()
    logged = LoggedWeights(np.repeat(weights, 5, axis=0).swapaxes(0, 1), rule)
    again = make_simulator()
    record = again.run(logged)
    np.testing.assert_array_equal(record.weight[:, -5:], held.weight)
    assert_same_bits(again.state, whole.state)
    # They do not outlive the run.
    plain = make_simulator()
    plain.run(rule, 5, weights=weights[0])
    assert (plain.run(rule, 5).weight == 1.0).all()


def test_weights_on_the_drift_are_a_smaller_penalty(
    smoke_scenario, make_simulator, assert_same_bits
):
    """k drift + V penalty is least where drift + (V / k) penalty is; k = 4 rounds nothing."""
    four = np.full((2, 8), 4.0)
    weighed = make_simulator().run("drift_plus_penalty", weights=four, weighs="drift")
    penalty = smoke_scenario.objective.penalty_weight / 4.0
    assert (weighed.weight == 4.0).all()
    wanted = make_simulator(objective={"penalty_weight": penalty}).run("drift_plus_penalty")
    np.testing.assert_array_equal(weighed.prb_owner, wanted.prb_owner)
    plain = make_simulator().run("drift_plus_penalty", weights=four)
    assert not np.array_equal(plain.prb_owner, wanted.prb_owner)
    logged = LoggedWeights(weighed.weight.astype(np.float64), "drift_plus_penalty", "drift")
    assert_same_bits(make_simulator().run(logged), weighed)


@pytest.mark.parametrize(("rule", "weighs"), [("pf", "drift"), ("drift_plus_penalty", "speed")])
def test_weights_on_what_a_rule_does_not_have_are_refused(make_simulator, rule, weighs):
    with pytest.raises(ValueError, match=rf"weighs = '{weighs}' with the allocation"):
        make_simulator().run(rule, weighs=weighs)


# What would be decided.


@pytest.mark.parametrize("rule", [*CLASSICAL, "own", "weigher"])
def test_to_decide_leaves_the_state_as_it_is(make_simulator, assert_same_bits, rule):
    multipliers = np.random.default_rng(4).uniform(0, 3, (2, 4))
    policy = {"own": Own(), "weigher": Favour(0.5, multipliers[0])}.get(rule, rule)
    simulator, other = make_simulator(), make_simulator()
    compiled = simulator.rule(rule) if rule in RULES else policy
    for _ in range(5):
        before = {name: values.copy() for name, values in simulator.state._asdict().items()}
        owners = simulator.decide(compiled, multipliers)
        for name, values in before.items():
            if name not in BY_THE_POLICY:
                np.testing.assert_array_equal(getattr(simulator.state, name), values, err_msg=name)
        np.testing.assert_array_equal(simulator.decide(compiled, multipliers), owners)
        record = simulator.run(policy, 7, multipliers=multipliers)
        np.testing.assert_array_equal(record.prb_owner[:, 0], owners)
        assert_same_bits(record, other.run(policy, 7, multipliers=multipliers))


def test_to_decide_takes_weights(make_simulator):
    weights = np.exp(np.random.default_rng(5).uniform(-3, 3, (2, 8)))
    simulator = make_simulator()
    plain = simulator.decide(simulator.rule("pf"))
    owners = simulator.decide(simulator.rule("pf"), weights=weights)
    assert (owners != plain).any()
    np.testing.assert_array_equal(make_simulator().run("pf", 1).prb_owner[:, 0], plain)
    weighted = make_simulator().run("pf", 1, weights=weights)
    np.testing.assert_array_equal(weighted.prb_owner[:, 0], owners)
    with pytest.raises(ValueError, match="weights: must be positive"):
        simulator.decide(simulator.rule("pf"), weights=-weights)


# The knob, and rules by the task.


@pytest.mark.parametrize("name", CLASSICAL)
def test_a_factor_of_1_is_the_rule(make_simulator, name):
    """The one without its kernel decides as that with the nearest factor; a knob favours URLLC."""
    simulator = make_simulator(traffic={"load": 1.1})
    rule = simulator.rule(name)
    expected = simulator.run(rule)
    knob = RULES[name].knob
    if knob is None:
        assert name == "round_robin"
        return
    assert getattr(rule, knob) == 1.0

    def run(value):
        return make_simulator(traffic={"load": 1.1}).run(replace(rule, **{knob: value}))

    if name in ("pf", "max_rate", "drift_plus_penalty"):
        assert rule.words(simulator.setup) is None
        nearest = run(math.nextafter(1.0, 2.0))
        np.testing.assert_array_equal(nearest.prb_owner, expected.prb_owner)
    less, more = (run(value).rate_mbps[..., :4].sum() for value in (0.05, 20.0))
    assert less > more if name == "edf" else less < more


def set_task(simulator, value):
    for name in TASK_STATE:
        getattr(simulator.state, name)[:] = value


def test_urgency_at_rest_with_a_floor_of_1_is_drift_plus_penalty(make_simulator, assert_same_bits):
    """Of Whittle's index and the age too, where nothing is older than a slot: h = 1 = 1 · 2 / 2."""

    def run(rule):
        simulator = make_simulator(traffic={"load": 1.1})
        for _ in range(60):
            set_task(simulator, 0.0)
            simulator.run(rule, 1)
        set_task(simulator, 0.0)
        return simulator.state

    names = set(SlotState._fields) - BY_THE_POLICY
    expected = run("drift_plus_penalty")
    for rule in (
        RULES["urgency"](floor=1.0),
        RULES["urgency"](floor=1.0, weighs="both"),
        RULES["age"](),
        RULES["age"](index="whittle", weighs="both"),
    ):
        assert_same_bits(run(rule), expected, names)
    other = run(RULES["urgency"](floor=4.0))
    assert (other.backlog_packets != expected.backlog_packets).any()


@pytest.mark.parametrize("name", TASK_RULES)
def test_a_rule_by_the_task_runs_under_the_name_of_a_policy(make_simulator, tmp_path, name):
    """And its knob favours URLLC users, here where all have a queue and eMBB users wait."""
    knob = RULES[name].knob
    little, much = (0.9, 0.001) if knob == "tolerance_m" else (0.001, 1000.0)
    keys = {policy: {} if knob is None else {knob: value}
            for policy, value in (("little", little), ("much", much))}  # fmt: skip
    policies = {policy: {"model": name, **own} for policy, own in keys.items()}
    path = tmp_path / "mine.yaml"
    values = {"name": "mine", "policies": policies}
    values["robot"] = {"set_point": "hold"}
    path.write_text(yaml.safe_dump(values))
    rules = load_scenario(path).policies
    assert all(rules[policy] == RULES[name](**own) for policy, own in keys.items())
    simulator = make_simulator()
    with pytest.raises(ValueError, match=f"policy = '{name}': must be one of pf"):
        simulator.rule(name)
    simulator.state.backlog_packets[:] = 40.0
    simulator.state.hol_delay_s[:, 4:] = 0.2
    set_task(simulator, 0.5)
    prbs = {policy: np.count_nonzero(simulator.decide(rules[policy]) < 4) for policy in rules}
    if knob is None:
        assert name == "try_once_discard"
    else:
        assert prbs["much"] > prbs["little"]


class WrongWords(NamedTuple):
    weight: float


@dataclass(frozen=True, kw_only=True)
class Wrong(Rule):
    """Drift plus penalty with a weight of the drift that is none."""

    model: Literal["wrong"] = "wrong"
    weight: float = 1.0
    allocation = "lagrangian"

    def words(self, setup):
        return WrongWords(self.weight)


@INDEX.kernel(WrongWords)
def index_wrong(me, constants, state, slot, env):
    for user in range(state.index_weight.shape[1]):
        state.index_weight[env, user] = 1.0
    state.drift_weight[env, 2] = me.weight


@pytest.mark.parametrize("weight", [-1.0, np.nan, np.inf])
def test_a_weight_of_the_drift_that_is_none_is_refused(make_simulator, weight):
    make_simulator().run(Wrong(weight=0.0), 3)
    with pytest.raises(ValueError, match="a weight that is negative or not finite"):
        make_simulator().run(Wrong(weight=weight), 3)


# The exact optimum.


def test_the_exact_optimum_is_at_least_as_good_as_drift_plus_penalty(make_simulator):
    """By each slot's Lagrangian, both from the same state; and strictly better now and then."""
    small = {
        "users": {"num_urllc": 2, "num_embb": 2},
        "radio": {"num_prb": 7},
        "traffic": {"urllc_offered_mbps": 16.0, "load": 3.0},
    }
    multipliers = np.array([[0.0, 40.0], [5.0, 3e4]])
    simulator = make_simulator(num_slots=15, **small)
    greedy, exact, gains = simulator.rule("drift_plus_penalty"), ExactPolicy(), []
    for _ in range(15):
        found = {"greedy": simulator.decide(greedy, multipliers)}
        found["exact"] = exact.decide(simulator.view).prb_owner
        for env, rate in enumerate(simulator.view.rate_mbps):
            state = simulator.view
            terms = slot_terms(
                simulator.constants,
                state.backlog_packets[env],
                state.dexterity_index[env],
                multipliers[env],
                np.ones(4),
                np.zeros((2, 4)),
            )
            value = {}
            for name, owners in found.items():
                rates = owned_rates(rate, owners[env])
                value[name] = sum(user_lagrangian(terms, u, rates[u]) for u in range(4))
            assert value["exact"] <= value["greedy"] + 1e-6 * (1.0 + abs(value["greedy"]))
            gains.append(value["greedy"] - value["exact"])
        record = simulator.run(exact, 1, multipliers=multipliers)
        np.testing.assert_array_equal(record.prb_owner[:, 0], found["exact"])
    assert max(gains) > 0.01
    assert simulator.state.backlog_packets.any()


def test_the_exact_optimum_runs_by_its_name(make_simulator, assert_same_bits):
    small = {
        "users": {"num_urllc": 1, "num_embb": 2},
        "radio": {"num_prb": 5},
        "traffic": {"urllc_offered_mbps": 16.0},
    }
    by_name = make_simulator(1, 4, **small).run("exact")
    assert_same_bits(by_name, make_simulator(1, 4, **small).run(ExactPolicy()))


def test_rules_are_known_to_who_imports_the_simulator_alone():
    code = (
        "import hiersched.simulator\nfrom hiersched.policies.registry import RULES\nprint(*RULES)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) == {*CLASSICAL, *TASK_RULES}


def test_equal_rules_are_prepared_once_and_others_apart(make_simulator):
    """The words of a rule are made when it is prepared."""
    simulator = make_simulator(traffic={"load": 1.3})
    runs = {}
    for need in ("none", "backlog", "none"):
        simulator.reset(simulator.state.key)
        owners = simulator.run(MaxWeight(need=need)).prb_owner
        np.testing.assert_array_equal(runs.setdefault(need, owners), owners)
    assert (runs["none"] != runs["backlog"]).any()
    assert replace(MaxWeight(need="none"), need="backlog") == MaxWeight(need="backlog")
