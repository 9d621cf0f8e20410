"""What a slot produced: the one record that feeds rewards, metrics and the log."""

from __future__ import annotations

import math
from collections import namedtuple
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.core.fields import FIELDS

_FIELDS = {field.name: field for field in FIELDS if "full" in field.profiles}

if TYPE_CHECKING:

    class SlotFields(tuple[NDArray[Any], ...]):  # noqa: D101
        _fields: tuple[str, ...]

        def __init__(self, **fields: NDArray[Any]) -> None: ...
        def __getattr__(self, name: str) -> NDArray[Any]: ...
        def _asdict(self) -> dict[str, NDArray[Any]]: ...
else:
    SlotFields = namedtuple("SlotFields", list(_FIELDS))
    SlotFields.__doc__ = "What a slot holds: the rows of `core.fields.FIELDS` that full logs have."


class OneSlot(NamedTuple):
    """The slot in work: its fields, and the same memory as words."""

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


_ALIGNMENT = 8
"""Fields of a row start at whole words. Cache lines would take a quarter more memory, and time."""


class SlotLayout:
    """Where the fields of a slot lie in its row.

    Made of the sizes in `core.fields.LETTERS`: U, R and K, N, M and W, and X; robots are unicycles
    unless `robot_sizes` says otherwise.
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
        for name, field in _FIELDS.items():
            shape, dtype = field.sized(sizes), np.dtype(field.dtype)
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
