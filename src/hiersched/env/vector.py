"""The simulator as a Gymnasium vector environment: a native batch, without one process a world."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from hiersched.env.core import EpisodeWorlds, SlotLoop
from hiersched.policies.features import num_features
from hiersched.scenario.schema import Scenario
from hiersched.simulator import Gains


def user_spaces(scenario: Scenario) -> tuple[spaces.Box, spaces.Box]:
    """Spaces of one world: features of every user, one number in [-1, 1] for each."""
    learning = scenario.learning
    width = num_features(learning.observe_robots, learning.observe_demand)
    return (
        spaces.Box(-np.inf, np.inf, (scenario.num_users, width), np.float32),
        spaces.Box(-1.0, 1.0, (scenario.num_users,), np.float32),
    )


def slot_info(loop: SlotLoop) -> dict[str, NDArray[Any]]:
    """Say what a slot cost, shape (E,) or (E, U) each; `cost` counts packets now late."""
    record, num_urllc = loop.record, loop.multipliers.shape[1]
    return {
        "cost": record.late_packets[:, 0, :num_urllc].sum(axis=-1).astype(np.float64),
        "due_packets": record.due_packets[:, 0, :num_urllc].sum(axis=-1).astype(np.float64),
        "reward_urllc": record.reward_urllc[:, 0] - loop.task_costs.mean(axis=1),
        "reward_embb": record.reward_embb[:, 0].copy(),
        "prb_count": record.num_prb[:, 0].copy(),
    }


class SlicingVectorEnv(VectorEnv):
    """E worlds side by side; one decision a slot for all users of both slices.

    Observation (E, U, F): `policies.features`. Action (E, U): one number in [-1, 1] for every
    user, the weight is exp(c a). Reward: mean of both slices' rewards; the parts and the cost are
    in the info. An episode ends at the slot limit only, which is truncation; all worlds end
    together and start anew in the same step (SAME_STEP), with the last observation in
    ``info["final_obs"]``. The parameters are those of `SlotLoop`, and E is `num_envs`.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as the base class has it)
        "autoreset_mode": AutoresetMode.SAME_STEP,
        "render_modes": [],
    }

    def __init__(
        self,
        scenario: Scenario,
        gains: Gains | None = None,
        num_envs: int = 1,
        *,
        num_slots: int | None = None,
    ) -> None:
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = user_spaces(scenario)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._worlds = EpisodeWorlds(num_envs)
        self._loop = SlotLoop(scenario, gains, self._worlds.coming(), num_slots)

    @property
    def multipliers(self) -> NDArray[np.float64]:
        """Multipliers in force, shape (E, R); write into it to change them."""
        return self._loop.multipliers

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode in new worlds; with a seed, in the first worlds of that seed."""
        super().reset(seed=seed)
        return self._loop.reset(self._worlds.take(seed)), {}

    def step(
        self, actions: NDArray[np.floating]
    ) -> tuple[
        NDArray[np.float32],
        NDArray[np.float64],
        NDArray[np.bool_],
        NDArray[np.bool_],
        dict[str, Any],
    ]:
        """Run one slot of all worlds."""
        self._worlds.require_episode()
        features = self._loop.step(actions)
        info: dict[str, Any] = dict(slot_info(self._loop))
        reward = 0.5 * (info["reward_urllc"] + info["reward_embb"])
        truncated = np.full(self.num_envs, self._loop.finished)
        if self._loop.finished:
            final = np.empty(self.num_envs, dtype=object)
            final[:] = list(features)
            info = {
                "final_obs": final,
                "_final_obs": truncated.copy(),
                "final_info": info,
                "_final_info": truncated.copy(),
            }
            features = self._loop.reset(self._worlds.take())
        return features, reward, np.zeros(self.num_envs, np.bool_), truncated, info
