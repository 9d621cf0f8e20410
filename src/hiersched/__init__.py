"""A reproducible laboratory for 5G teleoperation: slicing, robust control, learning, logs.

`import hiersched` registers ``hiersched/Slicing-v0`` with Gymnasium, and loads no more than that.
"""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import gymnasium

if TYPE_CHECKING:
    from hiersched.env.single import SlicingEnv
    from hiersched.env.vector import SlicingVectorEnv
    from hiersched.scenario.schema import Scenario

__version__ = version("hiersched")

gymnasium.register(
    "hiersched/Slicing-v0",
    entry_point="hiersched.env.single:SlicingEnv",
    vector_entry_point="hiersched.env.vector:SlicingVectorEnv",
    kwargs={"scenario": "paper"},
)


@overload
def make(
    scenario: Scenario | str | Path = "paper", num_envs: None = None, **options: Any
) -> SlicingEnv: ...


@overload
def make(scenario: Scenario | str | Path, num_envs: int, **options: Any) -> SlicingVectorEnv: ...


def make(
    scenario: Scenario | str | Path = "paper", num_envs: int | None = None, **options: Any
) -> SlicingEnv | SlicingVectorEnv:
    """Return an environment of a scenario, without the wrappers of `gymnasium.make`.

    Parameters
    ----------
    scenario
        The name of a shipped scenario, the path of a file, or a scenario.
    num_envs
        Worlds of a `SlicingVectorEnv`; unless given, the environment is a `SlicingEnv`.
    options
        Keywords of that class.

    Raises
    ------
    ScenarioError
        There is no such scenario, or it is at fault.
    """
    from hiersched.env import SlicingEnv, SlicingVectorEnv

    if num_envs is None:
        return SlicingEnv(scenario, **options)
    return SlicingVectorEnv(scenario, num_envs=num_envs, **options)
