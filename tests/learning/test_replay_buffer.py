from __future__ import annotations

import numpy as np

from hiersched.learning.algorithm import Outcome
from hiersched.learning.replay_buffer import ReplayBuffer

SEEDS, ENVS, SLOTS, ROUNDS, USERS, URLLC = 2, 3, 4, 2, 3, 2


def numbered(seed, episode, env, slot):
    return seed + 10 * env + 100 * slot + 1000 * episode


def fill(replay, episodes, slots_of_last):
    """Play episodes whose every number says where it stands; returns those that can be drawn."""
    seen = []
    for episode in range(episodes):

        def at(slot, shape, episode=episode):
            place = np.array(
                [[numbered(s, episode, e, slot) for e in range(ENVS)] for s in range(SEEDS)]
            )
            return np.broadcast_to(
                place[..., None] if len(shape) == 1 else place[..., None, None],
                (SEEDS, ENVS, *shape),
            )

        replay.start_round(at(0, (USERS, 8)))
        for slot in range(SLOTS if episode < episodes - 1 else slots_of_last):
            replay.add(
                Outcome(
                    prb_count=at(slot, (USERS,)),
                    base_reward=at(slot, (USERS,)),
                    constraint=at(slot, (URLLC,)),
                    next_features=at(slot + 1, (USERS, 8)),
                )
            )
            seen.append((episode, slot))
    return {
        numbered(0, episode, env, slot)
        for episode, slot in seen
        if episode > episodes - 1 - ROUNDS
        for env in range(ENVS)
    }


def test_every_transition_held_and_no_other_is_drawn():
    for episodes, slots in ((1, 2), (2, 1), (2, 4), (3, 2), (5, 4)):
        replay = ReplayBuffer(SEEDS, ENVS, SLOTS, ROUNDS, URLLC, (USERS, 8))
        held = fill(replay, episodes, slots)
        assert len(replay) == len(held)
        generators = [np.random.default_rng(seed) for seed in range(SEEDS)]
        batch = replay.sample(600, generators)
        for seed in range(SEEDS):
            numbers = batch.features[seed, :, 0, 0]
            assert set(numbers.astype(int) - seed) == held
            for field in (batch.prb_count, batch.base_reward, batch.constraint):
                np.testing.assert_array_equal(
                    field[seed], np.broadcast_to(numbers[:, None], field[seed].shape)
                )
            # The next features: same environment, one slot later, after the last slot too.
            np.testing.assert_array_equal(batch.next_features[seed, :, 0, 0], numbers + 100)
