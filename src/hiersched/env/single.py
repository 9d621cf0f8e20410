"""One world as a Gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from hiersched.env.core import EpisodeWorlds, SlotLoop
from hiersched.env.vector import slot_info, user_spaces
from hiersched.scenario.schema import Scenario
from hiersched.simulator import Gains


class SlicingEnv(gymnasium.Env):
    """One world; spaces, reward and info are those of one row of `SlicingVectorEnv`.

    The parameters are those of `SlotLoop`.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (as the base class has it)

    def __init__(
        self, scenario: Scenario, gains: Gains | None = None, *, num_slots: int | None = None
    ) -> None:
        self.observation_space, self.action_space = user_spaces(scenario)
        self._worlds = EpisodeWorlds(1)
        self._loop = SlotLoop(scenario, gains, self._worlds.coming(), num_slots)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode in a new world; with a seed, in the first world of that seed."""
        super().reset(seed=seed)
        features = self._loop.reset(self._worlds.take(seed))
        return features[0], {}

    def step(
        self, action: NDArray[np.floating]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Run one slot; the slot limit is truncation."""
        self._worlds.require_episode()
        features = self._loop.step(np.asarray(action)[None])
        info = {name: v[0] for name, v in slot_info(self._loop).items()}
        reward = 0.5 * float(info["reward_urllc"] + info["reward_embb"])
        return features[0], reward, False, self._loop.finished, info
