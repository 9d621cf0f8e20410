"""Gain schedules: gains for every delay, designed once, cached, and looked up in the slot loop."""

from __future__ import annotations

import hashlib
import json
import logging
import operator
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, SupportsIndex, get_args

import numpy as np
import numpy.typing as npt

from hiersched.control.certificate import (
    DEFAULT_DECAY_RATE,
    Certificate,
    DelayRazumikhinWitness,
    KrasovskiiWitness,
    Method,
    RazumikhinWitness,
    SeparationWitness,
    Status,
    Witness,
)
from hiersched.control.checks import FloatArray, as_matrix, as_samples
from hiersched.control.delayed_plant import DelayedPlant
from hiersched.control.gain_schedule_check import check_schedule
from hiersched.control.lqg import FilterModel, Lqg
from hiersched.core.files import write_bytes
from hiersched.core.sealed import seal_json, unseal_json

logger = logging.getLogger(__name__)

DESIGN_VERSION = 2
"""Part of the cache key: raise it when the design algorithm changes its results."""

FORMAT = "hiersched gain schedule 3"
_MOST = 1000
"""States, inputs, delays: a file that claims more is none."""
_UNSEALED = "hiersched gain schedule 2"
"""Of earlier versions, without a checksum: still in their logs."""
_WITNESSES: dict[str, type[Witness | SeparationWitness]] = {
    witness.criterion: witness
    for witness in (
        RazumikhinWitness,
        DelayRazumikhinWitness,
        KrasovskiiWitness,
        SeparationWitness,
    )
}
_HEAD: dict[str, type] = {
    "key": str,
    "kind": str,
    "method": str,
    "decay_rate": float,
    "sampling_s": float,
    "nominal": np.ndarray,
    "operator_gain": np.ndarray,
}
"""Fields of a schedule that are not tables; `_OPTIONAL` ones may be null."""
_OPTIONAL = ("decay_rate", "operator_gain")


@dataclass(frozen=True, kw_only=True, eq=False)
class GainSchedule:
    """The gain in force at every delay 0..T_max, with what is known about it.

    The slot loop applies u(k) = -local x(k) - network x(k-d) - sum_i input_i u(k-1-i), with the
    tables `local_gains`, `network_gains` and `input_gains` at the delay in force. Arrays are
    read-only; a ValueError says which tables do not fit each other, or which status its
    certificate.
    """

    # (T_max + 1, m, n), in force at each delay; the nominal one where nothing could be certified.
    gains: FloatArray
    status: tuple[str, ...]  # a `Status` of each
    certificates: tuple[Certificate, ...]  # independent check of each
    nominal: FloatArray  # (m, n)
    kind: str  # of the plant, "network" or "split"
    method: str
    decay_rate: float | None  # per sample, certified by C1; None for the other methods
    sampling_s: float  # one step of delay
    key: str  # SHA-256 of the design's inputs
    # (T_max + 1, T_max, m, m), on past inputs, the newest first, zero from the delay on; all zero
    # if left out.
    input_gains: FloatArray = field(default_factory=lambda: np.empty(0))
    operator_gain: FloatArray | None = None  # (m, n), the operator's over the network (split)
    lqg: Lqg | None = None  # filter and regulator of the method lqg, for all delays
    kinds: tuple[GainSchedule, ...] = ()  # those of other plants of the same loop

    def __post_init__(self) -> None:
        """Check that the tables fit each other and freeze the arrays."""
        gains = np.array(self.gains, dtype=np.float64, order="C")
        nominal = np.array(self.nominal, dtype=np.float64)
        if gains.ndim != 3 or gains.shape[1:] != nominal.shape or not gains.shape[0]:
            raise ValueError(
                f"gains has shape {gains.shape}; it must be (T_max + 1, *{nominal.shape})"
            )
        if not (np.isfinite(gains).all() and np.isfinite(nominal).all()):
            raise ValueError("gains has entries that are not finite")
        for name, table in (("status", self.status), ("certificates", self.certificates)):
            if len(table) != gains.shape[0]:
                raise ValueError(f"{name} has {len(table)} entries; it must have {gains.shape[0]}")
        arrays = {"gains": gains, "nominal": nominal}
        arrays["input_gains"] = self._checked_input_gains(len(gains) - 1, len(nominal))
        if self.operator_gain is not None:
            arrays["operator_gain"] = as_matrix("operator_gain", self.operator_gain, nominal.shape)
        for name, array in arrays.items():
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        for delay in range(len(gains)):
            self._check_status(delay)
        for number, kind in enumerate(self.kinds):
            self._check_kind(number, kind)

    def _check_kind(self, number: int, kind: GainSchedule) -> None:
        if kind.kinds:
            raise ValueError(f"kinds[{number}] has kinds; only the schedule itself may")
        names = "kind", "method", "decay_rate", "sampling_s", "max_delay_steps"
        for name in names:
            found, wanted = getattr(kind, name), getattr(self, name)
            if found != wanted:
                raise ValueError(f"kinds[{number}].{name} is {found!r}; it must be {wanted!r}")
        if kind.nominal.shape != self.nominal.shape or (kind.lqg is None) != (self.lqg is None):
            raise ValueError(f"kinds[{number}] is of another form than the schedule itself")

    def _checked_input_gains(self, steps: int, inputs: int) -> FloatArray:
        shape = (steps + 1, steps, inputs, inputs)
        table = np.array(self.input_gains, dtype=np.float64)
        if table.size == 0:
            return np.zeros(shape)
        if table.shape != shape or not np.isfinite(table).all():
            raise ValueError(f"input_gains has shape {table.shape}; it must be {shape}, finite")
        for delay in range(steps + 1):
            if table[delay, delay:].any():
                raise ValueError(f"input_gains[{delay}] is not zero from entry {delay} on")
        return table

    def _check_status(self, delay: int) -> None:
        status, certified = self.status[delay], self.certificates[delay].certified
        if status not in get_args(Status):
            raise ValueError(f"status[{delay}] is {status!r}; it must be one of {get_args(Status)}")
        if certified != (status in ("nominal", "adjusted")):
            raise ValueError(
                f"status[{delay}] is {status!r}, but its certificate is "
                f"{'certified' if certified else 'not certified'}"
            )
        if status in ("nominal", "infeasible") and not (
            np.array_equal(self.gains[delay], self.nominal) and not self.input_gains[delay].any()
        ):
            raise ValueError(f"gains[{delay}] is not the nominal gain, but {status}")
        if status == "adjusted" and self.input_gains[delay].any():
            raise ValueError(f"input_gains[{delay}] is not zero; no certificate covers it")

    @property
    def max_delay_steps(self) -> int:
        """Return T_max in samples."""
        return int(self.gains.shape[0]) - 1

    @property
    def local_gains(self) -> FloatArray:
        """Return new gains on the present state, shape (T_max + 1, m, n); 0 for network plants."""
        return np.zeros_like(self.gains) if self.kind == "network" else self.gains.copy()

    @property
    def network_gains(self) -> FloatArray:
        """Return new gains on the delayed state, shape (T_max + 1, m, n).

        Split plants: the operator's, the same at every delay; 0 where A_d is no operator's gain
        but belongs to the plant.
        """
        if self.kind == "network":
            return self.gains.copy()
        table = np.zeros_like(self.gains)
        if self.operator_gain is not None:
            table[:] = self.operator_gain
        return table

    @property
    def certified(self) -> npt.NDArray[np.bool_]:
        """Return whether the gain in force at each delay is certified, shape (T_max + 1,)."""
        return np.array([certificate.certified for certificate in self.certificates])

    @property
    def deviation(self) -> FloatArray:
        """Return ||K^(T) - K||_F at each delay, shape (T_max + 1,)."""
        return np.asarray(np.linalg.norm(self.gains - self.nominal, axis=(1, 2)))

    def gain(self, delay_steps: SupportsIndex) -> FloatArray:
        """Return the gain in force at a delay within 0..T_max, shape (m, n), read-only.

        For many delays index `gains` directly.
        """
        steps = operator.index(delay_steps)
        if not 0 <= steps <= self.max_delay_steps:
            raise ValueError(f"delay_steps is {steps}; it must lie in 0..{self.max_delay_steps}")
        return np.asarray(self.gains[steps])

    def verify(
        self,
        plant: DelayedPlant,
        model: FilterModel | None = None,
        kinds: Sequence[tuple[DelayedPlant, FilterModel | None]] = (),
    ) -> None:
        """Recompute for a plant, and what its filter believes, all that the schedule says.

        `kinds` are the same of the other plants. Numbers may differ by what another processor
        rounds differently. ValueError if a gain, its status or its certificate is not what this
        method makes for this plant.
        """
        if len(kinds) != len(self.kinds):
            raise ValueError(f"kinds are {len(self.kinds)}; they must be {len(kinds)}")
        check_schedule(self, plant, model)
        for number, (own, of_plant) in enumerate(zip(self.kinds, kinds, strict=True)):
            try:
                check_schedule(own, *of_plant)
            except ValueError as error:
                raise ValueError(f"kinds[{number}]: {error}") from error

    def to_json(self) -> str:
        """Return the schedule as JSON, floats in their shortest form that reads back exactly."""
        return seal_json({"format": FORMAT, **self._document()}, default=_plain)

    def _document(self) -> dict[str, Any]:
        entries = [
            {
                "delay_steps": delay,
                "status": self.status[delay],
                "gain": gain,
                "input_gains": self.input_gains[delay, :delay],
                "certificate": self.certificates[delay],
            }
            for delay, gain in enumerate(self.gains)
        ]
        head = {name: getattr(self, name) for name in _HEAD}
        document = {**head, "entries": entries}
        if self.lqg is not None:
            document["lqg"] = self.lqg
        if self.kinds:
            document["kinds"] = [kind._document() for kind in self.kinds]
        return document

    @classmethod
    def from_json(cls, text: str, *, vouched: bool = False) -> GainSchedule:
        """Return the schedule that `to_json` wrote.

        Where something else has `vouched` for the text, such as a log's checksum, it may be one of
        an earlier version, which has none. A ValueError names the field that is wrong.
        """
        document, wanted = _unsealed(text) if vouched else None, _UNSEALED
        if document is None:
            document, wanted = unseal_json(text.encode()), FORMAT
        if document.get("format") != wanted:
            raise ValueError(f"not a gain schedule: its format must be {wanted!r}")
        try:
            return cls._of(document)
        except (TypeError, LookupError, ArithmeticError, MemoryError) as error:
            raise ValueError(f"not a gain schedule: {error!r:.200}") from error

    @classmethod
    def _of(cls, document: dict[str, Any]) -> GainSchedule:
        entries = _field(document, "entries", list)
        for delay, entry in enumerate(entries):
            if not isinstance(entry, dict) or entry.get("delay_steps") != delay:
                raise ValueError(f"entries[{delay}] must be an object with delay_steps {delay}")
        head: dict[str, Any] = {"decay_rate": None} | {
            name: _field(document, name, kind)
            for name, kind in _HEAD.items()
            if name not in _OPTIONAL or document.get(name) is not None
        }
        if head["nominal"].ndim != 2 or max(*head["nominal"].shape, len(entries)) > _MOST:
            raise ValueError(f"nominal is no matrix, or there are more than {_MOST} of something")
        certificates = (_field(entry, "certificate", dict) for entry in entries)
        kinds = _field(document, "kinds", list) if "kinds" in document else []
        if any("kinds" in kind for kind in kinds):
            raise ValueError("kinds has kinds; only the schedule itself may")
        return cls(
            **head,
            gains=np.array([_field(entry, "gain", np.ndarray) for entry in entries]),
            status=tuple(_field(entry, "status", str) for entry in entries),
            certificates=tuple(map(_parse_certificate, certificates)),
            input_gains=_parse_input_gains(entries, len(head["nominal"])),
            lqg=_parse_lqg(document) if "lqg" in document else None,
            kinds=tuple(cls._of(kind) for kind in kinds),
        )


def _unsealed(text: str) -> dict[str, Any] | None:
    """Read JSON without a checksum; None if it is another text."""
    try:
        document = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return document if isinstance(document, dict) and "sha256" not in document else None


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Certificate):
        names = "certified", "criterion", "margins", "tolerance", "spectral_radii", "witness"
        return {name: getattr(value, name) for name in names}
    return vars(value)


def _parse_input_gains(entries: list[Any], inputs: int) -> FloatArray:
    """Return the table, zero from the delay on, from the entries' shorter lists."""
    table = np.zeros((len(entries), len(entries) - 1, inputs, inputs))
    for delay, entry in enumerate(entries):
        gains = _field(entry, "input_gains", np.ndarray)
        if gains.shape != (delay, inputs, inputs) and not gains.size == delay == 0:
            raise ValueError(
                f"entries[{delay}].input_gains has shape {gains.shape}; "
                f"it must be {(delay, inputs, inputs)}"
            )
        table[delay, :delay] = gains.reshape(delay, inputs, inputs)
    return table


def _parse_lqg(document: Mapping[str, Any]) -> Lqg:
    values = _field(document, "lqg", dict)
    believed = _field(values, "model", dict)
    model = FilterModel(
        **{part.name: _field(believed, part.name, np.ndarray) for part in fields(FilterModel)}
    )
    names = [part.name for part in fields(Lqg) if part.name != "model"]
    return Lqg(model=model, **{name: _field(values, name, np.ndarray) for name in names})


def _parse_certificate(document: Mapping[str, Any]) -> Certificate:
    criterion = _field(document, "criterion", str)
    witness: Witness | SeparationWitness | None = None
    if criterion != "none":
        if criterion not in _WITNESSES:
            raise ValueError(f"criterion is {criterion!r}; it must be one of {list(_WITNESSES)}")
        kind, values = _WITNESSES[criterion], _field(document, "witness", dict)
        matrices = {name for name, value in values.items() if isinstance(value, list)}
        arguments: dict[str, Any] = {
            part.name: _field(values, part.name, np.ndarray if part.name in matrices else float)
            for part in fields(kind)
        }
        witness = kind(**arguments)
    return Certificate(
        certified=_field(document, "certified", bool),
        margins={str(k): float(v) for k, v in _field(document, "margins", dict).items()},
        tolerance=_field(document, "tolerance", float),
        spectral_radii=_field(document, "spectral_radii", np.ndarray),
        witness=witness,
    )


def _field(document: Mapping[str, Any], name: str, kind: type) -> Any:
    """Return a field of this kind; an array is a list of numbers."""
    value, expected = document.get(name), list if kind is np.ndarray else kind
    if not isinstance(value, expected):
        raise ValueError(f"{name} is {value!r:.60}; it must be a {expected.__name__}")
    if kind is not np.ndarray:
        return value
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} is no array of numbers: {error}") from error


def design_key(
    plant: DelayedPlant,
    max_delay_steps: SupportsIndex,
    method: Method,
    decay_rate: float,
    model: FilterModel | None = None,
    kinds: Sequence[tuple[DelayedPlant, FilterModel | None]] = (),
) -> str:
    """Return the SHA-256, in hexadecimal, of everything that `build_schedule` depends on."""
    inputs: dict[str, Any] = {
        "design_version": DESIGN_VERSION,
        "method": method,
        "decay_rate": decay_rate if method == "razumikhin" else None,
        "max_delay_steps": as_samples("max_delay_steps", max_delay_steps),
        "kind": plant.kind,
        "sampling_s": plant.sampling_s,
    }
    for name in ("A", "B", "Q", "R", "nominal_gain", "A_d", "operator_gain"):
        array = getattr(plant, name)
        inputs[name] = None if array is None else array.tolist()
    if model is not None:
        inputs["model"] = {name: value.tolist() for name, value in vars(model).items()}
    if kinds:
        rest = max_delay_steps, method, decay_rate
        inputs["kinds"] = [design_key(own, *rest, believed) for own, believed in kinds]
    text = json.dumps(inputs, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def build_schedule(
    plant: DelayedPlant,
    max_delay_steps: SupportsIndex,
    method: Method = "krasovskii",
    *,
    decay_rate: float = DEFAULT_DECAY_RATE,
    model: FilterModel | None = None,
    key: str | None = None,
    kinds: Sequence[tuple[DelayedPlant, FilterModel | None]] = (),
) -> GainSchedule:
    """Design the gain of every delay 0..T_max in samples; each is that of `GainDesigner`.

    `key` names the design; its `design_key` unless given. `kinds` are other plants of the same
    loop, each with what its filter believes: the gains of each stand in `GainSchedule.kinds`.
    """
    from hiersched.control.design import GainDesigner

    designer = GainDesigner(plant, method=method, decay_rate=decay_rate, model=model)
    steps = as_samples("max_delay_steps", max_delay_steps)
    designs = [designer.design(delay) for delay in range(steps + 1)]
    logger.info(
        "designed %d gains in %.1f s: %s, %s plant, sampling %.4g s",
        len(designs),
        sum(design.solve_time_s for design in designs),
        method,
        plant.kind,
        plant.sampling_s,
    )
    inputs = plant.B.shape[1]
    input_gains = np.zeros((steps + 1, steps, inputs, inputs))
    for delay, design in enumerate(designs):
        input_gains[delay, :delay] = design.input_gains
    return GainSchedule(
        gains=np.stack([design.gain for design in designs]),
        status=tuple(design.status for design in designs),
        certificates=tuple(design.certificate for design in designs),
        nominal=plant.nominal_gain,
        input_gains=input_gains,
        operator_gain=plant.operator_gain,
        kind=plant.kind,
        method=method,
        decay_rate=decay_rate if method == "razumikhin" else None,
        sampling_s=plant.sampling_s,
        key=design_key(plant, steps, method, decay_rate, model, kinds) if key is None else key,
        lqg=designer.lqg,
        kinds=tuple(
            build_schedule(own, steps, method, decay_rate=decay_rate, model=believed, key=key)
            for own, believed in kinds
        ),
    )


def load_or_build(
    path: str | os.PathLike[str],
    plant: DelayedPlant,
    max_delay_steps: SupportsIndex,
    method: Method = "krasovskii",
    *,
    decay_rate: float = DEFAULT_DECAY_RATE,
    model: FilterModel | None = None,
    key: str | None = None,
    kinds: Sequence[tuple[DelayedPlant, FilterModel | None]] = (),
) -> GainSchedule:
    """Return the schedule cached as JSON at `path` if it is this design's, else build and store it.

    A cached schedule is verified before it is used; a file that is not usable is logged. The file
    is replaced atomically. The rest is as for `build_schedule`.
    """
    target = Path(path)
    if key is None:
        key = design_key(plant, max_delay_steps, method, decay_rate, model, kinds)
    if target.exists():
        try:
            schedule = GainSchedule.from_json(target.read_text(encoding="utf-8"))
            if schedule.key == key:
                schedule.verify(plant, model, kinds)
                return schedule
            logger.info("%s holds another design's gains; designing anew", target)
        except ValueError as error:
            logger.warning("%s is not usable (%s); designing anew", target, error)
    schedule = build_schedule(
        plant, max_delay_steps, method, decay_rate=decay_rate, model=model, key=key, kinds=kinds
    )
    write_bytes(target, schedule.to_json().encode())
    return schedule
