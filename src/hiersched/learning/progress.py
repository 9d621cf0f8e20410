"""What training reports: sums over a round, and a CSV with one row a seed and round."""

from __future__ import annotations

import csv
import io
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hiersched.learning.algorithm import Losses
from hiersched.simulator import SlotRecord


class RoundSums:
    """Sums over the slots and environments of a round, by seed."""

    def __init__(self, num_seeds: int, num_urllc: int) -> None:
        self.slots = 0
        self.due_packets = np.zeros((num_seeds, num_urllc))
        self.late_packets = np.zeros((num_seeds, num_urllc))
        self._constraint = np.zeros((num_seeds, num_urllc))
        self._reward = np.zeros((2, num_seeds))
        self._backlog = np.zeros((2, num_seeds))
        self._tracking_error = np.zeros(num_seeds)
        self._critic_losses: list[NDArray[np.float32]] = []
        self._actor_losses: list[NDArray[np.float32]] = []
        self._none = np.full((num_seeds, 2), np.nan)

    def add(self, one: SlotRecord) -> None:
        """Add one slot of all environments."""
        num_seeds, num_urllc = self._constraint.shape
        self.slots += len(one.reward_urllc) // num_seeds

        def by_seed(values: NDArray[np.float64]) -> NDArray[np.float64]:
            total: NDArray[np.float64] = values.reshape(num_seeds, -1, *values.shape[1:]).sum(1)
            return total

        self.due_packets += by_seed(one.due_packets[:, 0, :num_urllc].astype(np.float64))
        self.late_packets += by_seed(one.late_packets[:, 0, :num_urllc].astype(np.float64))
        self._constraint += by_seed(one.constraint[:, 0])
        self._reward += by_seed(one.reward_urllc[:, 0]), by_seed(one.reward_embb[:, 0])
        self._tracking_error += by_seed(one.tracking_error_m[:, 0].mean(-1))
        backlog = one.backlog_packets[:, 0]
        self._backlog += (
            by_seed(backlog[:, :num_urllc].mean(-1)),
            by_seed(backlog[:, num_urllc:].mean(-1)),
        )

    def add_losses(self, losses: Losses) -> None:
        """Add one update."""
        self._critic_losses.append(losses.critic.numpy())
        if losses.actor is not None:
            self._actor_losses.append(losses.actor.numpy())

    def mean_constraint(self) -> NDArray[np.float64]:
        """Mean y over slots and environments, shape (seeds, R)."""
        return self._constraint / self.slots

    def late_share(self) -> NDArray[np.float64]:
        """Late packets over due packets of the URLLC slice, shape (seeds,)."""
        share: NDArray[np.float64] = self.late_packets.sum(1) / np.maximum(
            1.0, self.due_packets.sum(1)
        )
        return share

    def columns(self) -> dict[str, NDArray[np.float64]]:
        """Columns of the progress file, shape (seeds,) each; a loss without updates is NaN."""
        critic, actor = (
            np.mean(losses, axis=0) if losses else self._none
            for losses in (self._critic_losses, self._actor_losses)
        )
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


class ProgressFile:
    """The progress of a training as a CSV file that is whole at any time.

    Parameters
    ----------
    path
        Where to write; None keeps the rows in memory only.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self.rows: list[dict[str, float]] = []

    def add(
        self,
        sums: RoundSums,
        *,
        seeds: tuple[int, ...],
        episode: int,
        slots: int,
        multiplier_mean: NDArray[np.float64],
        seconds: float,
    ) -> None:
        """Add one row a seed and write the file.

        Parameters
        ----------
        sums
            Of the round that has just ended.
        seeds
            In the order of the arrays.
        episode, slots
            Episodes and slots of each seed so far.
        multiplier_mean
            Mean multiplier of each seed after the round, shape (seeds,).
        seconds
            Wall-clock time since training began.
        """
        columns = sums.columns()
        for index, seed in enumerate(seeds):
            self.rows.append(
                {
                    "episode": episode,
                    "seed": seed,
                    "slots": slots,
                    **{name: float(values[index]) for name, values in columns.items()},
                    "multiplier_mean": float(multiplier_mean[index]),
                    "seconds": round(seconds, 3),
                }
            )
        if self._path is not None:
            self._write(self._path)

    def _write(self, path: Path) -> None:
        text = io.StringIO()
        writer = csv.DictWriter(text, list(self.rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        part = Path(f"{path}.part")
        part.write_text(text.getvalue(), encoding="utf-8")
        os.replace(part, path)
