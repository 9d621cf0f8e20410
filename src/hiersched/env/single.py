"""One world as a Gymnasium environment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from hiersched.env.core import RENDER_MODES, EpisodeWorlds, SlotLoop, as_scenario
from hiersched.env.vector import real_time, slot_info, user_spaces
from hiersched.scenario.schema import Scenario
from hiersched.simulator import Gains


class SlicingEnv(EzPickle, gymnasium.Env):
    """One world; spaces, reward and info are those of one row of `SlicingVectorEnv`.

    `scenario` is one, the name of a shipped one, or a path; the other parameters are those of
    `SlotLoop`. A copy, or one that was pickled, starts before the first reset.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as the base class has it)
        "render_modes": list(RENDER_MODES),
        "render_fps": 100,
    }

    def __init__(
        self,
        scenario: Scenario | str | Path,
        gains: Gains | None = None,
        *,
        num_slots: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        EzPickle.__init__(self, scenario, gains, num_slots=num_slots, render_mode=render_mode)
        scenario = as_scenario(scenario)
        self.render_mode, self.metadata = render_mode, real_time(self.metadata, scenario)
        self.observation_space, self.action_space = user_spaces(scenario)
        self._worlds = EpisodeWorlds(1)
        self._loop = SlotLoop(scenario, gains, self._worlds.coming(), num_slots, render_mode)

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
        self._worlds.require_episode("step")
        features = self._loop.step(np.asarray(action)[None])
        info = {name: v[0] for name, v in slot_info(self._loop).items()}
        reward = 0.5 * float(info["reward_urllc"] + info["reward_embb"])
        return features[0], reward, False, self._loop.finished, info

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the last slots, shape (height, width, 3)."""
        self._worlds.require_episode("render")
        frames = self._loop.render()
        return None if frames is None else frames[0]
