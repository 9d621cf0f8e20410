"""What a training takes in memory, beside what its arrays take."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import pytest

from hiersched.experiments import feasible
from hiersched.learning.replay_buffer import ReplayBuffer
from hiersched.policies.features import num_features
from hiersched.scenario import Scenario

SEEDS = 3


def training_gib(monkeypatch: pytest.MonkeyPatch, scenario: Scenario, **learning: Any) -> float:
    """What the fault says that a training with these values takes."""
    monkeypatch.setattr(feasible, "physical_memory_bytes", lambda: 0)
    learning = {"seeds": tuple(range(SEEDS)), **learning}
    asked = replace(scenario, learning=replace(scenario.learning, **learning))
    faults = "\n".join(feasible.memory_faults(asked))
    (found,) = re.findall(rf"^learner ddpg: {SEEDS} seeds: takes (\S+) GiB", faults, re.MULTILINE)
    return float(found)


def test_replay_takes_what_its_arrays_take(
    monkeypatch: pytest.MonkeyPatch, smoke_scenario: Scenario
) -> None:
    users, slots, capacity = smoke_scenario.users, 1000, 10**9
    features = num_features(smoke_scenario.learning.observe_robots, observe_demand=False)
    buffer = ReplayBuffer(SEEDS, 1, slots, 1, users.num_urllc, (smoke_scenario.num_users, features))
    num_bytes = sum(array.nbytes for array in buffer.state()["arrays"].values())
    needed = training_gib(monkeypatch, smoke_scenario, replay_capacity=capacity)
    least = num_bytes * (capacity / slots) / 2**30
    assert least < needed < 1.2 * least


def test_a_batch_takes_its_activations_and_what_is_made_of_them(
    monkeypatch: pytest.MonkeyPatch, smoke_scenario: Scenario
) -> None:
    """Layers of all users in float32, kept for the backward pass of an actor and a critic."""
    learning = smoke_scenario.learning
    batch, features = 10**8, num_features(learning.observe_robots, observe_demand=False)
    layers = features + sum(learning.hidden)
    activations = 4.0 * SEEDS * batch * smoke_scenario.num_users * layers / 2**30
    asked = {"replay_capacity": batch}
    added = training_gib(monkeypatch, smoke_scenario, batch_size=batch, **asked)
    added -= training_gib(monkeypatch, smoke_scenario, **asked)
    assert 2.0 * activations < added < 100.0 * activations
