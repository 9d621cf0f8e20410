"""Which worlds the episodes of an environment run in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hiersched.core.randomness import world_key


class EpisodeWorlds:
    """Worlds 0, 1, 2, … of a seed, `count` of them an episode.

    Parameters
    ----------
    count
        Worlds side by side.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._seed = 0
        self._next = 0

    def coming(self) -> NDArray[np.uint64]:
        """Keys of the next episode's worlds, shape (count,)."""
        indices = range(self._next, self._next + self._count)
        return np.array([world_key("env", self._seed, index) for index in indices], np.uint64)

    def take(self, seed: int | None = None) -> NDArray[np.uint64]:
        """Give the next episode's keys and go on; with a seed, begin with its first worlds."""
        if seed is not None:
            self._seed, self._next = seed, 0
        keys = self.coming()
        self._next += self._count
        return keys
