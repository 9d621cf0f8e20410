"""What a slot produced: the one record that feeds rewards, metrics and the log."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class SlotFields(NamedTuple):
    """What a slot holds, field by field; the shape of one slot is noted.

    U users (URLLC first), R robots (one a URLLC user), K PRBs. A robot has N states, M inputs and W
    normals: 5, 2 and 5 for a unicycle, n, m and 2 n for a linear plant. X numbers are those that
    models add. Fields and units are those of the log's topics.
    """

    fading_power: NDArray[np.float32]  # (U, K) squared amplitude
    mean_fading_power: NDArray[np.float32]  # (U,)
    arrival_uniform: NDArray[np.float64]  # (U,)
    robot_normal: NDArray[np.float32]  # (R, W) slip and noise of the measurement
    prb_owner: NDArray[np.uint32]  # (K,)
    num_prb: NDArray[np.uint32]  # (U,)
    rate_mbps: NDArray[np.float64]  # (U,)
    weight: NDArray[np.float32]  # (U,) of the weighted PF rule
    backlog_packets: NDArray[np.float64]  # (U,) at the start of the slot
    arrivals_packets: NDArray[np.uint32]  # (U,)
    service_packets: NDArray[np.float64]  # (U,) offered
    average_rate_mbps: NDArray[np.float64]  # (U,) before the slot
    hol_delay_s: NDArray[np.float64]  # (U,) at the start of the slot
    delay_s: NDArray[np.float64]  # (U,) last packet delivered
    due_packets: NDArray[np.uint32]  # (U,)
    late_packets: NDArray[np.uint32]  # (U,)
    arrival_clamped: NDArray[np.uint32]  # (U,) 0 or 1
    multiplier: NDArray[np.float64]  # (R,)
    constraint: NDArray[np.float64]  # (R,) y, negative where violated
    drift_urllc: NDArray[np.float64]  # ()
    drift_embb: NDArray[np.float64]  # ()
    penalty_urllc: NDArray[np.float64]  # ()
    penalty_embb: NDArray[np.float64]  # ()
    reward_urllc: NDArray[np.float64]  # ()
    reward_embb: NDArray[np.float64]  # ()
    network_delay_s: NDArray[np.float64]  # (R,) measured in this slot, in force in the next
    delay_steps: NDArray[np.uint32]  # (R,) T_d in force in this slot
    delay_capped: NDArray[np.uint32]  # (R,) 1 where T_d > T_max, for which there is no gain
    gain_delay_steps: NDArray[np.uint32]  # (R,) T of the adjusted gain in force, 0: nominal
    state: NDArray[np.float64]  # (R, N) at the end of the slot
    reference: NDArray[np.float64]  # (R, 5) x, y, theta, v, omega at the slot's end; linear: 0
    control: NDArray[np.float64]  # (R, M)
    control_saturated: NDArray[np.uint32]  # (R,) samples
    tracking_error_m: NDArray[np.float64]  # (R,) root mean square over the slot
    dexterity_index: NDArray[np.float64]  # (R,) in force
    model_values: NDArray[np.float64]  # (X,) fields of the models (`models.model.model_fields`)


class OneSlot(NamedTuple):
    """The slot in work: its fields, each of its noted shape, and the same memory as words."""

    fields: SlotFields
    words: NDArray[np.uint64]


class SlotRecord(SlotFields):
    """Slots of E environments: every field has leading axes (E, T), then the shape of a slot.

    The fields are views of `rows` (E, T, words), in which a slot lies in one piece: the slot loop
    then writes one stream to memory rather than one for every field.
    """

    rows: NDArray[np.uint64]

    def environment(self, index: int) -> dict[str, NDArray[Any]]:
        """Fields of one environment by name, each with leading axis (T,)."""
        return {name: getattr(self, name)[index] for name in self._fields}


_SHAPES: dict[str, tuple[str | int, ...]] = {
    "fading_power": ("U", "K"),
    "robot_normal": ("R", "W"),
    "prb_owner": ("K",),
    "state": ("R", "N"),
    "reference": ("R", 5),
    "control": ("R", "M"),
    "model_values": ("X",),
}
_PER_ROBOT = (
    "multiplier",
    "constraint",
    "network_delay_s",
    "delay_steps",
    "delay_capped",
    "gain_delay_steps",
    "control_saturated",
    "tracking_error_m",
    "dexterity_index",
)
_SCALARS = (
    "drift_urllc",
    "drift_embb",
    "penalty_urllc",
    "penalty_embb",
    "reward_urllc",
    "reward_embb",
)
_FLOAT32 = ("fading_power", "mean_fading_power", "robot_normal", "weight")
_UINT32 = (
    "prb_owner",
    "num_prb",
    "arrivals_packets",
    "due_packets",
    "late_packets",
    "arrival_clamped",
    "delay_steps",
    "delay_capped",
    "gain_delay_steps",
    "control_saturated",
)


_ALIGNMENT = 8
"""Fields of a row start at whole words. Cache lines would take a quarter more memory, and time."""


class SlotLayout:
    """Where the fields of a slot lie in its row.

    Parameters
    ----------
    num_users, num_robots, num_prb
        U, R and K of the shapes in `SlotFields`.
    robot_sizes
        N, M and W; those of a unicycle unless given.
    num_model_values
        X.
    """

    def __init__(
        self,
        num_users: int,
        num_robots: int,
        num_prb: int,
        robot_sizes: tuple[int, int, int] = (5, 2, 5),
        num_model_values: int = 0,
    ) -> None:
        sizes = {"U": num_users, "R": num_robots, "K": num_prb, "X": num_model_values}
        sizes |= zip("NMW", robot_sizes, strict=True)
        self._places: dict[str, tuple[int, np.dtype[Any], tuple[int, ...]]] = {}
        offset = 0
        for name in SlotFields._fields:
            shape = tuple(sizes[n] if isinstance(n, str) else n for n in _shape_of(name))
            dtype = np.dtype(_dtype_of(name))
            self._places[name] = (offset, dtype, shape)
            offset += -(-math.prod(shape) * dtype.itemsize // _ALIGNMENT) * _ALIGNMENT
        self.words = offset // 8

    def _views(self, rows: NDArray[np.uint64]) -> dict[str, NDArray[Any]]:
        lead = rows.shape[:-1]
        return {
            name: np.ndarray(
                (*lead, *shape),
                dtype,
                rows.data,
                offset,
                (*rows.strides[:-1], *np.empty(shape, dtype).strides),
            )
            for name, (offset, dtype, shape) in self._places.items()
        }

    def record(self, num_envs: int, num_slots: int) -> SlotRecord:
        """Zeroed record of `num_slots` slots of `num_envs` environments."""
        rows = np.zeros((num_envs, num_slots, self.words), np.uint64)
        record = SlotRecord(**self._views(rows))
        record.rows = rows
        return record

    def slot(self) -> OneSlot:
        """Return a single slot, zeroed."""
        words = np.zeros(self.words, np.uint64)
        return OneSlot(SlotFields(**self._views(words)), words)


def _shape_of(name: str) -> tuple[str | int, ...]:
    if name in _SCALARS:
        return ()
    if name in _PER_ROBOT:
        return ("R",)
    return _SHAPES.get(name, ("U",))


def _dtype_of(name: str) -> type[np.generic]:
    return np.float32 if name in _FLOAT32 else np.uint32 if name in _UINT32 else np.float64
