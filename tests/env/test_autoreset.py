from __future__ import annotations

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from hiersched.env import SlicingEnv, SlicingVectorEnv

SLOTS = 2


class OneEnvsWorlds(SlicingEnv):
    """Single environments whose first two episodes are in the worlds of one row of the batch."""

    def __init__(self, scenario, gains, row, rows):
        super().__init__(scenario, gains, num_slots=SLOTS)
        self._row, self._rows = row, rows

    def reset(self, *, seed=None, options=None):
        """Skip the worlds of the other rows."""
        if seed is not None:
            observation, info = super().reset(seed=seed - self._row)  # Sync adds the row
            for _ in range(self._row):
                observation, info = super().reset()
        else:
            for _ in range(self._rows):
                observation, info = super().reset()
        return observation, info


def same(found, wanted):
    """Compare infos as Gymnasium forms them: nested dictionaries of arrays, masks beside them."""
    assert found.keys() == wanted.keys()
    for name, value in wanted.items():
        if isinstance(value, dict):
            same(found[name], value)
        else:
            np.testing.assert_array_equal(np.stack(list(found[name])), np.stack(list(value)))


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_the_batch_does_what_gymnasiums_own_does_with_single_environments(scenario, gains, mode):
    """Observations, rewards, ends and infos, over the end of two episodes."""
    batch = SlicingVectorEnv(scenario, gains, 3, num_slots=SLOTS, autoreset_mode=mode)
    others = SyncVectorEnv(
        [lambda row=row: OneEnvsWorlds(scenario, gains, row, 3) for row in range(3)],
        autoreset_mode=mode,
    )
    assert batch.metadata["autoreset_mode"] is others.metadata["autoreset_mode"]
    assert SlicingVectorEnv.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    for found, wanted in zip(batch.reset(seed=7), others.reset(seed=7), strict=True):
        np.testing.assert_array_equal(found, wanted)
    rng = np.random.default_rng(0)
    ends = []
    for _ in range(2 * SLOTS + 1):
        actions = rng.uniform(-1, 1, (3, 5)).astype(np.float32)
        *found, info = batch.step(actions)
        *wanted, wanted_info = others.step(actions)
        for one, other in zip(found, wanted, strict=True):
            np.testing.assert_array_equal(one, other)
            assert one.dtype == other.dtype
        same(info, wanted_info)
        ends.append(found[3].all())
    assert ends == [False, True, False, mode == "SameStep", mode == "NextStep"]


def test_without_autoreset_the_end_stays_until_reset(scenario, gains):
    env = SlicingVectorEnv(scenario, gains, 2, num_slots=1, autoreset_mode=AutoresetMode.DISABLED)
    env.reset(seed=3)
    zeros = np.zeros((2, 5), np.float32)
    _, _, _, truncated, info = env.step(zeros)
    assert truncated.all()
    assert "cost" in info
    with pytest.raises(ResetNeeded, match="the episode of 1 slots is over: call reset"):
        env.step(zeros)
    with pytest.raises(ValueError, match="reset_mask: must be True for every world"):
        env.reset(options={"reset_mask": np.array([True, False])})
    env.reset(options={"reset_mask": np.ones(2, np.bool_)})
    env.step(zeros)


def test_a_mode_that_there_is_not_is_refused(scenario, gains):
    with pytest.raises(
        ValueError, match="autoreset_mode = 'never': must be one of NextStep, SameStep, Disabled"
    ):
        SlicingVectorEnv(scenario, gains, autoreset_mode="never")


def test_infos_hold_no_unsigned_integers(scenario, gains):
    for env in (SlicingEnv(scenario, gains), SlicingVectorEnv(scenario, gains, 2)):
        env.reset(seed=1)
        info = env.step(np.zeros(env.action_space.shape, np.float32))[4]
        assert {np.asarray(value).dtype.kind for value in info.values()} <= {"i", "f", "b"}
