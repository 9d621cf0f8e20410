"""What training reports: sums over a round, and a CSV with one row a seed and round."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiersched.core.files import write_bytes
from hiersched.learning.algorithm import Losses
from hiersched.simulator import SlotRecord


class RoundSums:
    """Sums over the slots and environments of a round, by seed."""

    def __init__(self, num_seeds: int, num_urllc: int) -> None:
        self.slots = 0
        self.due_packets, self.late_packets, self._constraint = np.zeros((3, num_seeds, num_urllc))
        self._reward = np.zeros((2, num_seeds))
        self._backlog = np.zeros((2, num_seeds))
        self._tracking_error = np.zeros(num_seeds)
        self._losses: list[Losses] = []

    def add(self, record: SlotRecord) -> None:
        """Add slots of all environments."""
        num_seeds, num_urllc = self._constraint.shape
        self.slots += record.reward_urllc.size // num_seeds

        def by_seed(values: NDArray[Any]) -> NDArray[np.float64]:
            values = values.reshape(num_seeds, -1, *values.shape[2:])
            total: NDArray[np.float64] = values.sum(1, dtype=np.float64)
            return total

        self.due_packets += by_seed(record.due_packets[..., :num_urllc])
        self.late_packets += by_seed(record.late_packets[..., :num_urllc])
        self._constraint += by_seed(record.constraint)
        self._reward += by_seed(record.reward_urllc), by_seed(record.reward_embb)
        self._tracking_error += by_seed(record.tracking_error_m.mean(-1))
        backlog = record.backlog_packets
        self._backlog += (
            by_seed(backlog[..., :num_urllc].mean(-1)),
            by_seed(backlog[..., num_urllc:].mean(-1)),
        )

    def add_losses(self, losses: Losses) -> None:
        """Add one update."""
        self._losses.append(losses)

    def mean_constraint(self) -> NDArray[np.float64]:
        """Mean y over slots and environments, shape (seeds, R)."""
        return self._constraint / self.slots

    def late_share(self) -> NDArray[np.float64]:
        """Late packets over due packets of the URLLC slice, shape (seeds,)."""
        due = np.maximum(1.0, self.due_packets.sum(1))
        share: NDArray[np.float64] = self.late_packets.sum(1) / due
        return share

    def columns(self) -> dict[str, NDArray[np.float64]]:
        """Columns of the progress file, shape (seeds,) each; a loss without updates is NaN."""
        critics = [losses.critic.numpy() for losses in self._losses if losses.critic is not None]
        actors = [losses.actor.numpy() for losses in self._losses if losses.actor is not None]
        none = np.full((len(self._constraint), 2), np.nan)
        critic, actor = (np.mean(some, axis=0) if some else none for some in (critics, actors))
        reward, backlog = self._reward / self.slots, self._backlog / self.slots
        return {
            "reward_urllc": reward[0],
            "reward_embb": reward[1],
            "late_share": self.late_share(),
            "backlog_urllc_packets": backlog[0],
            "backlog_embb_packets": backlog[1],
            "tracking_error_m": self._tracking_error / self.slots,
            "critic_loss_urllc": critic[:, 0],
            "critic_loss_embb": critic[:, 1],
            "actor_loss_urllc": actor[:, 0],
            "actor_loss_embb": actor[:, 1],
        }


def write_progress(path: Path, rows: list[dict[str, float]]) -> None:
    """Write the rows of a training as a CSV file that is whole at any time."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_bytes(path, text.getvalue().encode())
