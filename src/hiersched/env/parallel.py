"""One world as a PettingZoo parallel environment with the paper's two agents."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.utils import EzPickle, seeding
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from hiersched.env.core import RENDER_MODES, EpisodeWorlds, SlotLoop, agent_views, as_scenario
from hiersched.env.vector import real_time, slot_info
from hiersched.policies.features import num_features
from hiersched.scenario.schema import Scenario
from hiersched.simulator import Gains

AGENTS = ("urllc", "embb")


class SlicingParallelEnv(EzPickle, ParallelEnv):
    """Two agents, `urllc` and `embb`; each gives every user of its slice one number in [-1, 1].

    Observation of an agent (n, 3 F): its users' features, the slice's mean and the other slice's
    mean. Reward: that of the own slice, or the mean of both where the scenario says `reward:
    cooperative`. The parameters are those of `SlicingEnv`.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as the base class has it)
        "name": "hiersched_v0",
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
        self.possible_agents = list(AGENTS)
        self.agents: list[str] = []
        self.np_random, _ = seeding.np_random()  # wrappers draw from it, the worlds do not
        self._num_urllc = scenario.users.num_urllc
        self._cooperative = scenario.learning.reward == "cooperative"
        counts = {"urllc": scenario.users.num_urllc, "embb": scenario.users.num_embb}
        learning = scenario.learning
        width = 3 * num_features(learning.observe_robots, learning.observe_demand)
        self._observation_spaces = {
            agent: spaces.Box(-np.inf, np.inf, (count, width), np.float32)
            for agent, count in counts.items()
        }
        self._action_spaces = {
            agent: spaces.Box(-1.0, 1.0, (count,), np.float32) for agent, count in counts.items()
        }
        self._worlds = EpisodeWorlds(1)
        self._loop = SlotLoop(scenario, gains, self._worlds.coming(), num_slots, render_mode)

    def observation_space(self, agent: str) -> spaces.Box:
        """Return the observation space of an agent, always the same object."""
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Box:
        """Return the action space of an agent, always the same object."""
        return self._action_spaces[agent]

    def _views(self, features: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        return dict(zip(AGENTS, agent_views(features[0], self._num_urllc), strict=True))

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[np.float32]], dict[str, dict[str, Any]]]:
        """Start an episode in a new world; with a seed, in the first world of that seed."""
        if seed is not None:
            self.np_random, _ = seeding.np_random(seed)
        features = self._loop.reset(self._worlds.take(seed))
        self.agents = list(AGENTS)
        return self._views(features), {agent: {} for agent in AGENTS}

    def step(
        self, actions: dict[str, NDArray[np.floating]]
    ) -> tuple[
        dict[str, NDArray[np.float32]],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """Run one slot under both agents' actions; errors are those of `SlotLoop.step`."""
        self._worlds.require_episode("step")
        if set(actions) != set(AGENTS):
            raise ValueError(f"actions of {', '.join(actions)}: must be of {', '.join(AGENTS)}")
        for agent, space in self._action_spaces.items():
            if np.shape(actions[agent]) != space.shape:
                shape = np.shape(actions[agent])
                raise ValueError(f"actions of {agent}: shape {shape}, must be {space.shape}")
        features = self._loop.step(np.concatenate([actions[agent] for agent in AGENTS])[None])
        info = {name: v[0] for name, v in slot_info(self._loop).items()}
        rewards = {agent: float(info[f"reward_{agent}"]) for agent in AGENTS}
        if self._cooperative:
            rewards = dict.fromkeys(AGENTS, 0.5 * sum(rewards.values()))
        finished = self._loop.finished
        if finished:
            self.agents = []
        return (
            self._views(features),
            rewards,
            dict.fromkeys(AGENTS, False),
            dict.fromkeys(AGENTS, finished),
            {agent: dict(info) for agent in AGENTS},
        )

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the last slots, shape (height, width, 3)."""
        self._worlds.require_episode("render")
        frames = self._loop.render()
        return None if frames is None else frames[0]
