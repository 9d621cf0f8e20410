"""Trained networks as kernels: the actions of torch, and the same bits everywhere."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import llvmlite.binding
import numpy as np
import pytest
import torch

from hiersched.core.pointer import Pointer
from hiersched.env import action_weights
from hiersched.learning.es import Population
from hiersched.learning.networks import learner_network
from hiersched.policies.features import num_features, observe_worlds
from hiersched.policies.learned import network_words
from hiersched.policies.trained import TrainedPolicy

EXPONENT = 2.0


def random_parameters(
    network, hidden, *, observe_robots=False, observe_demand=False, num_urllc=10, num_embb=10
):
    """Networks whose actions are spread over (-1, 1)."""
    rng = np.random.default_rng(7)
    count = num_features(observe_robots, observe_demand)
    users = num_urllc + num_embb, max(num_urllc, num_embb)
    inputs, outputs = {
        "linear": (count, 1),
        "shared": (3 * count, 1),
        "mlp": (users[0] * count, users[1]),
    }[network]
    parts = []
    for rows, columns in pairwise((inputs, *hidden, outputs)):
        parts.append(rng.uniform(-1.0, 1.0, (2, (rows + 1) * columns)) * 1.5 * rows**-0.5)
    return np.concatenate(parts, axis=1).astype(np.float32)


def make_words(network, hidden, **sizes):
    sizes = {
        "num_urllc": 10,
        "num_embb": 10,
        "observe_robots": False,
        "observe_demand": False,
        **sizes,
    }
    return network_words(
        random_parameters(network, hidden, **sizes),
        network,
        hidden,
        weight_exponent=EXPONENT,
        **sizes,
    )


@pytest.mark.parametrize(
    ("observe_robots", "observe_demand"), [(False, False), (True, False), (True, True)]
)
@pytest.mark.parametrize("network", ["shared", "mlp"])
@pytest.mark.parametrize(
    ("hidden", "num_urllc", "num_embb"),
    [
        ((64, 64), 10, 10),
        ((64, 64), 3, 9),
        ((5,), 4, 1),
        ((1,), 1, 1),
        ((13, 64, 7), 6, 11),
        ((33, 17, 40, 9), 2, 3),
    ],
)
def test_actions_are_those_of_torch(
    make_worlds,
    weigh,
    torch_weights,
    network,
    hidden,
    num_urllc,
    num_embb,
    observe_robots,
    observe_demand,
):
    observed = {"observe_robots": observe_robots, "observe_demand": observe_demand}
    sizes = {"num_urllc": num_urllc, "num_embb": num_embb, **observed}
    constants, state = make_worlds(num_urllc, num_embb, num_envs=50)
    policy = TrainedPolicy(
        parameters=random_parameters(network, hidden, **sizes),
        network=network,
        hidden=hidden,
        rule="pf",
        weighs="utility",
        **observed,
        weight_exponent=EXPONENT,
        num_embb=num_embb,
        multipliers=np.zeros(num_urllc),
        seed=1,
        scenario_sha256="",
    )
    features = np.empty(
        (50, num_urllc + num_embb, num_features(observe_robots, observe_demand)), np.float32
    )
    observe_worlds(Pointer(constants), Pointer(state), observe_robots, observe_demand, features)
    wanted = np.log(torch_weights(policy, features)) / EXPONENT
    got = np.log(weigh(make_words(network, hidden, **sizes), constants, state)) / EXPONENT
    assert np.abs(got - wanted).max() < 1e-6
    assert np.std(wanted) > 0.03  # the worlds and users differ


@pytest.mark.parametrize(
    ("observe_robots", "observe_demand"), [(False, False), (True, False), (False, True)]
)
@pytest.mark.parametrize(("num_urllc", "num_embb"), [(10, 10), (1, 1), (3, 7)])
def test_a_linear_policy_has_the_bits_of_its_training(
    make_worlds, weigh, scenario, num_urllc, num_embb, observe_robots, observe_demand
):
    """The kernel, the learner's network and Python's exact sums of doubles."""
    observed = {"observe_robots": observe_robots, "observe_demand": observe_demand}
    count = num_features(**observed)
    parameters = np.random.default_rng(2).normal(size=(2, count + 1)).astype(np.float32) / 4
    words = network_words(
        parameters,
        "linear",
        (),
        weight_exponent=EXPONENT,
        num_urllc=num_urllc,
        num_embb=num_embb,
        **observed,
    )
    constants, state = make_worlds(num_urllc, num_embb, num_envs=60)
    got = weigh(words, constants, state)
    features = np.empty((60, num_urllc + num_embb, count), np.float32)
    observe_worlds(Pointer(constants), Pointer(state), observe_robots, observe_demand, features)
    learning = replace(scenario.learning, algorithm="a2c", network="linear", **observed)
    users = replace(scenario.users, num_urllc=num_urllc, num_embb=num_embb)
    network = learner_network(learning, users)
    inputs = network.inputs(torch.from_numpy(features[None]))
    raw = network.raw_actions(network.actor_outputs(torch.from_numpy(parameters), inputs), 1)
    actions = np.tanh(raw[0].numpy().astype(np.float64)).astype(np.float32)
    np.testing.assert_array_equal(action_weights(actions, EXPONENT), got)
    for env, user in ((0, 0), (59, num_urllc), (30, num_urllc + num_embb - 1)):
        agent = int(user >= num_urllc)
        total = float(parameters[agent, 0])
        for x, w in zip(features[env, user], parameters[agent, 1:], strict=True):
            total += float(x) * float(w)
        wanted = np.exp(EXPONENT * np.float64(np.float32(np.tanh(np.float64(np.float32(total))))))
        assert got[env, user] == np.float32(wanted)
    assert np.std(np.log(got)) > 0.1


@pytest.mark.parametrize(("network", "hidden"), [("shared", (9, 6)), ("mlp", (9,)), ("linear", ())])
def test_policies_side_by_side_have_the_bits_of_each_alone(make_worlds, weigh, network, hidden):
    """A population of three policies in two worlds each, whose parameters change in place."""
    learning = SimpleNamespace(
        start="pf",
        weighs="utility",
        network=network,
        hidden=hidden or (64, 64),
        observe_robots=True,
        observe_demand=True,
        weight_exponent=EXPONENT,
    )
    sizes = {"num_urllc": 4, "num_embb": 7, "observe_robots": True, "observe_demand": True}
    one = random_parameters(network, hidden, **sizes)
    rng = np.random.default_rng(6)
    population = Population(learning, SimpleNamespace(num_urllc=4, num_embb=7))
    setup = SimpleNamespace(num_envs=6)
    words = None
    for _ in range(2):
        three = np.stack([one * factor for factor in rng.uniform(0.5, 1.5, 3)]).astype(np.float32)
        population.become(three)
        words = words or population.words(setup)
        got = weigh(words, *make_worlds(4, 7, num_envs=6))
        assert np.std(np.log(got)) > 0.01
        for policy in range(3):
            alone = network_words(three[policy], network, hidden, weight_exponent=EXPONENT, **sizes)
            wanted = weigh(alone, *make_worlds(4, 7, num_envs=6))
            mine = slice(2 * policy, 2 * policy + 2)
            np.testing.assert_array_equal(got[mine], wanted[mine])
            assert not np.array_equal(got, wanted)


@pytest.mark.parametrize(("network", "hidden"), [("linear", (4,)), ("shared", ()), ("mlp", ())])
def test_hidden_layers_that_a_network_cannot_have_are_refused(network, hidden):
    with pytest.raises(ValueError, match=rf"hidden = .* must be .* with network = '{network}'"):
        make_words(network, hidden)


def test_a_network_of_zeros_weighs_all_users_alike(make_worlds, weigh):
    for network, size in (("shared", 25 * 4 + 5), ("mlp", 161 * 4 + 5 * 10)):
        words = network_words(
            np.zeros((2, size), np.float32),
            network,
            (4,),
            observe_robots=False,
            observe_demand=False,
            weight_exponent=EXPONENT,
            num_urllc=10,
            num_embb=10,
        )
        assert (weigh(words, *make_worlds()) == 1.0).all()


@pytest.mark.parametrize("network", ["shared", "mlp"])
def test_weights_are_rounded_as_the_log_rounds_them(make_worlds, weigh, network):
    weight = weigh(make_words(network, (20,)), *make_worlds())
    np.testing.assert_array_equal(weight, weight.astype(np.float32))


@pytest.mark.parametrize("num_envs", [1, 3])
@pytest.mark.parametrize("network", ["shared", "mlp"])
def test_a_world_has_the_same_weights_in_every_batch(make_worlds, weigh, network, num_envs):
    many = weigh(make_words(network, (64, 64)), *make_worlds(num_envs=64))
    few = weigh(make_words(network, (64, 64)), *make_worlds(num_envs=num_envs))
    assert few.tobytes() == many[:num_envs].tobytes()


@pytest.mark.parametrize("network", ["shared", "mlp"])
def test_a_world_has_the_same_weights_after_any_other(make_worlds, weigh, network):
    constants, state = make_worlds(num_envs=8)
    words = make_words(network, (64, 64))
    first = weigh(words, constants, state)
    backwards = state._replace(**{k: v[::-1].copy() for k, v in state._asdict().items()})
    assert weigh(words, constants, backwards)[::-1].tobytes() == first.tobytes()


@pytest.mark.parametrize("network", ["shared", "mlp"])
@pytest.mark.parametrize("backlog", [0.0, 1e15])
@pytest.mark.parametrize("rate", [0.0, 1e-30, 1e30])
def test_weights_are_finite_at_extremes(make_worlds, weigh, network, backlog, rate):
    constants, state = make_worlds()
    state.backlog_packets[...] = backlog
    state.hol_delay_s[...] = backlog
    state.reported_rate_mbps[...] = rate
    weight = weigh(make_words(network, (64, 64)), constants, state)
    assert (weight >= np.exp(-EXPONENT) * (1 - 1e-7)).all()
    assert (weight <= np.exp(EXPONENT) * (1 + 1e-7)).all()


DIGEST = """
import hashlib
import sys

import numpy as np

sys.path.insert(0, {folder!r})
import conftest

from hiersched.policies.learned import network_words

for network, hidden in {cases!r}:
    words = network_words(
        np.load({parameters!r} + network + ".npy"),
        network,
        hidden,
        observe_robots=True,
        observe_demand=True,
        weight_exponent={exponent!r},
        num_urllc=7,
        num_embb=10,
    )
    weight = conftest.weigh_worlds(words, *conftest.random_worlds(7, 10, num_envs=50))
    print(hashlib.sha256(words.features.tobytes() + weight.tobytes()).hexdigest())
"""
TARGET_CASES = (("shared", (64, 37)), ("mlp", (37, 64)))


@pytest.mark.nightly
@pytest.mark.skipif(
    not llvmlite.binding.get_host_cpu_features().get("avx2"), reason="a processor without AVX2"
)
def test_every_processor_target_gives_the_same_bits(make_worlds, weigh, tmp_path):
    """Vectors of 4 without FMA instructions, of 8 with them, and what this processor has."""
    sizes = {"observe_robots": True, "observe_demand": True, "num_urllc": 7, "num_embb": 10}
    digests = {"host": []}
    for network, hidden in TARGET_CASES:
        np.save(tmp_path / f"{network}.npy", random_parameters(network, hidden, **sizes))
        words = make_words(network, hidden, **sizes)
        weight = weigh(words, *make_worlds(7, 10, num_envs=50))
        digest = hashlib.sha256(words.features.tobytes() + weight.tobytes())
        digests["host"].append(digest.hexdigest())
    script = tmp_path / "digest.py"
    folder = str(Path(__file__).parent)
    script.write_text(
        DIGEST.format(
            folder=folder, cases=TARGET_CASES, parameters=f"{tmp_path}/", exponent=EXPONENT
        )
    )
    for target in ("generic", "haswell"):
        environment = {
            **os.environ,
            "NUMBA_CPU_NAME": target,
            "NUMBA_CPU_FEATURES": "",  # those of the target, none of this processor
            "NUMBA_CACHE_DIR": str(tmp_path / target),
        }
        result = subprocess.run(
            [sys.executable, script], env=environment, capture_output=True, text=True, check=False
        )
        assert result.returncode == 0, result.stderr
        digests[target] = result.stdout.split()
    assert digests["generic"] == digests["haswell"] == digests["host"]


def test_parameters_of_another_shape_are_refused():
    parameters = random_parameters("mlp", (8,))
    with pytest.raises(ValueError, match=r"must be \(2, 209\) for layers of \(24, 8, 1\)"):
        network_words(
            parameters,
            "shared",
            (8,),
            observe_robots=False,
            observe_demand=False,
            weight_exponent=EXPONENT,
            num_urllc=10,
            num_embb=10,
        )


def test_an_unknown_network_is_refused():
    with pytest.raises(ValueError, match="'transformer': must be one of shared, mlp, linear"):
        network_words(
            np.zeros((2, 1), np.float32),
            "transformer",
            (8,),
            observe_robots=False,
            observe_demand=False,
            weight_exponent=EXPONENT,
            num_urllc=1,
            num_embb=1,
        )
