from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest

from hiersched.core.randomness import world_key
from hiersched.learning.checkpoint import CheckpointError
from hiersched.learning.rewards import user_rewards
from hiersched.learning.trainer import Trainer, train
from hiersched.simulator import Simulator

ENVS, SLOTS = 2, 6


VARIANTS = {
    "ddpg": {},
    "ddpg, mlp, from max_weight": {"network": "mlp", "start": "max_weight"},
    "a2c": {"algorithm": "a2c", "rollout_slots": 4},
    "a2c, linear, counterfactual": {
        "algorithm": "a2c",
        "rollout_slots": 3,
        "network": "linear",
        "advantage": "counterfactual",
    },
    "es, linear": {
        "algorithm": "es",
        "network": "linear",
        "start": "drift_plus_penalty",
        "weighs": "drift",
        "observe_demand": True,
        "fitness": "reward",
        "num_envs": 6,
        "episodes": 18,
        "pairs": 1,
    },
    "es, reward": {
        "algorithm": "es",
        "num_envs": 3,
        "episodes": 9,
        "pairs": 1,
        "fitness": "reward",
        "reward": "independent",
    },
    "a2c, mlp, robots": {
        "algorithm": "a2c",
        "rollout_slots": 2,
        "network": "mlp",
        "start": "drift_plus_penalty",
        "reward": "independent",
        "task_weight": 2.0,
        "observe_robots": True,
    },
}


@pytest.fixture(scope="module", params=VARIANTS.values(), ids=VARIANTS)
def variant(request, tiny):
    return replace(tiny, learning=replace(tiny.learning, **request.param))


@pytest.fixture(scope="module")
def tiny(scenario):
    learning = replace(
        scenario.learning,
        seeds=(1, 2),
        episodes=3 * ENVS,
        num_envs=ENVS,
        slots_per_episode=SLOTS,
        warmup_slots=2,
        critic_warmup_updates=2,
        batch_size=4,
        replay_capacity=2 * ENVS * SLOTS,
        hidden=(8,),
    )
    objective = replace(scenario.objective, constraint="measured", multiplier_step=20.0)
    return replace(scenario, learning=learning, objective=objective)


def assert_same(one, other):
    for a, b in zip(one, other, strict=True):
        for name, value in vars(a).items():
            np.testing.assert_array_equal(value, getattr(b, name), err_msg=name)


def test_the_same_seeds_give_the_same_bits(variant, gains):
    first, second = train(variant, gains, show=False), train(variant, gains, show=False)
    assert_same(first, second)
    assert not np.array_equal(first[0].parameters, first[1].parameters)
    assert np.abs(first[0].parameters[:, -8:]).max() > 0.0


def test_an_interrupted_training_ends_with_the_same_bits(variant, gains, tmp_path):
    whole = train(variant, gains, progress=tmp_path / "whole.csv", show=False)
    checkpoint = tmp_path / "checkpoint.pt"
    calls = []

    def interrupt(seed, block):
        calls.append(seed)
        if len(calls) == 2 * 2 * variant.learning.num_envs:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(variant, gains, on_slots=interrupt, checkpoint=checkpoint, show=False)
    assert checkpoint.exists()
    resumed = train(
        variant, gains, progress=tmp_path / "parts.csv", checkpoint=checkpoint, show=False
    )
    assert_same(whole, resumed)
    assert not checkpoint.exists()

    def without_time(path):
        return [line.rsplit(",", 1)[0] for line in path.read_text().splitlines()]

    assert without_time(tmp_path / "whole.csv") == without_time(tmp_path / "parts.csv")


def test_a_checkpoint_of_another_training_is_refused(tiny, gains, tmp_path):
    checkpoint = tmp_path / "checkpoint.pt"

    def interrupt(seed, block):
        if checkpoint.exists():
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(tiny, gains, on_slots=interrupt, checkpoint=checkpoint, show=False)
    other = replace(tiny, learning=replace(tiny.learning, discount=0.5))
    with pytest.raises(CheckpointError, match="scenario_sha256"):
        train(other, gains, checkpoint=checkpoint, show=False)


def test_a_seed_learns_the_same_alone_up_to_rounding(variant, gains):
    both = train(variant, gains, show=False)
    alone = replace(variant, learning=replace(variant.learning, seeds=(2,)))
    np.testing.assert_allclose(
        train(alone, gains, show=False)[0].parameters, both[1].parameters, atol=1e-4
    )


def test_every_episode_is_reported_and_can_be_run_again(variant, gains):
    """The logged weights, replayed in the episode's world, give the logged slots."""
    seen = {0: [], 1: []}
    train(
        variant,
        gains,
        on_slots=lambda seed, block: seen[seed].append({k: v.copy() for k, v in block.items()}),
        show=False,
    )
    count = variant.learning.episodes
    assert [len(blocks) for blocks in seen.values()] == [count, count]
    block = seen[1][-1]
    # Two worlds a round in every variant, but one of a population of three.
    world = {6: 5, 18: 5, 9: 2}[count]
    simulator = Simulator(
        variant, gains, np.array([world_key("train", 2, world)], np.uint64), SLOTS
    )
    for slot in range(SLOTS):
        record = simulator.run(
            variant.learning.start,
            1,
            weights=block["weight"][slot][None].astype(np.float64),
            weighs=variant.learning.weighs,
            multipliers=block["multiplier"][slot][None],
        )
        for name, value in block.items():
            np.testing.assert_array_equal(value[slot], getattr(record, name)[0, 0], err_msg=name)
    assert not (block["weight"] == 1.0).all()


def test_the_progress_file_says_what_the_slots_say(tiny, gains, tmp_path):
    blocks = {0: [], 1: []}
    path = tmp_path / "progress.csv"
    train(
        tiny,
        gains,
        progress=path,
        on_slots=lambda seed, block: blocks[seed].append({k: v.copy() for k, v in block.items()}),
        show=False,
    )
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["seed"], row["episode"]) for row in rows] == [
        (str(seed), str(ENVS * (k + 1))) for k in range(3) for seed in (1, 2)
    ]
    for place, row in enumerate(rows):
        part = blocks[place % 2][ENVS * (place // 2) : ENVS * (place // 2 + 1)]
        late = sum(block["late_packets"][:, :3].sum() for block in part)
        due = sum(block["due_packets"][:, :3].sum() for block in part)
        assert float(row["late_share"]) == pytest.approx(late / max(1, due))
        for agent in ("urllc", "embb"):
            mean = np.mean([block[f"reward_{agent}"] for block in part])
            assert float(row[f"reward_{agent}"]) == pytest.approx(mean)


def test_user_rewards_have_the_records_reward_as_their_mean(tiny, gains):
    trainer = Trainer(tiny, gains)
    loop = trainer.loop
    rng = np.random.default_rng(1)
    for _ in range(SLOTS):
        loop.step(rng.uniform(-1, 1, (2 * ENVS, 5)))
        after = loop.simulator.state.backlog_packets
        shares = user_rewards(loop.record, after, loop.task_costs, tiny)
        np.testing.assert_allclose(shares[:, :3].mean(1), loop.record.reward_urllc[:, 0], rtol=1e-9)
        np.testing.assert_allclose(shares[:, 3:].mean(1), loop.record.reward_embb[:, 0], rtol=1e-9)


def test_a_robots_tracking_error_is_priced_in_its_users_reward(tiny, gains):
    priced = replace(tiny, learning=replace(tiny.learning, task_weight=2.0))
    loop = Trainer(priced, gains).loop
    loop.step(np.zeros((2 * ENVS, 5)))
    after = loop.simulator.state.backlog_packets
    less = user_rewards(loop.record, after, np.zeros_like(loop.task_costs), tiny)
    less -= user_rewards(loop.record, after, loop.task_costs, priced)
    error_cm = 100.0 * loop.record.tracking_error_m[:, 0]
    np.testing.assert_allclose(less[:, :3], 2.0 * error_cm / tiny.learning.reward_scale)
    assert (less[:, 3:] == 0.0).all()
    assert (error_cm > 0.0).all()


def test_rounds_that_are_not_whole_are_refused(tiny, gains):
    odd = replace(tiny, learning=replace(tiny.learning, episodes=5))
    with pytest.raises(ValueError, match=r"learning\.episodes = 5"):
        train(odd, gains, show=False)
