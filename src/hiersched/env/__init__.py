"""The simulator as reinforcement-learning environments: adapters without physics.

`SlicingVectorEnv` (Gymnasium, a native batch), `SlicingEnv` (Gymnasium, one world),
`SlicingVecEnv` (stable-baselines3) and `SlicingParallelEnv` (PettingZoo) load their libraries when
they are first asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hiersched.core.extras import lazy_names
from hiersched.env.core import SlotLoop, agent_views
from hiersched.policies.features import FEATURE_VERSION, FEATURES
from hiersched.policies.policy import action_weights

if TYPE_CHECKING:
    from hiersched.env.parallel import SlicingParallelEnv
    from hiersched.env.sb3 import SlicingVecEnv
    from hiersched.env.single import SlicingEnv
    from hiersched.env.vector import SlicingVectorEnv

__all__ = [
    "FEATURES",
    "FEATURE_VERSION",
    "SlicingEnv",
    "SlicingParallelEnv",
    "SlicingVecEnv",
    "SlicingVectorEnv",
    "SlotLoop",
    "action_weights",
    "agent_views",
]

__getattr__ = lazy_names(
    __name__,
    {
        "SlicingEnv": "single",
        "SlicingParallelEnv": "parallel",
        "SlicingVecEnv": "sb3",
        "SlicingVectorEnv": "vector",
    },
)
