"""Gain schedules: certified gains for every delay, computed once and looked up online."""

from __future__ import annotations

import hashlib
import json
import logging
import operator
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsIndex

import numpy as np
import numpy.typing as npt

from hiersched.control.certificate import Certificate, certify
from hiersched.control.checks import FloatArray, as_delay_steps
from hiersched.control.plant import DelayedPlant

if TYPE_CHECKING:
    from hiersched.control.design import Method

logger = logging.getLogger(__name__)

DESIGN_VERSION = 1
"""Part of the cache key: raise it when the design algorithm changes its results."""

DEFAULT_DECAY_RATE = 0.02
"""Decay of V per sample that C1 certifies where nothing else is asked."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GainSchedule:
    """The gain in force at every delay 0..T_max, with its certificate.

    Parameters
    ----------
    gains : ndarray, shape (T_max + 1, m, n), float64
        Gain in force at each delay; the nominal one where nothing could be certified.
    status : tuple of str, length T_max + 1
        "nominal", "adjusted" or "infeasible" at each delay.
    certificates : tuple of Certificate, length T_max + 1
        Independent check of each gain in force.
    nominal : ndarray, shape (m, n)
        The nominal gain.
    kind : str
        Kind of plant, "network" or "split".
    method : str
        "krasovskii" or "razumikhin".
    decay_rate : float or None
        Decay per sample certified by C1; None for C3.
    sampling_s : float
        Sampling interval in s: one step of delay.
    key : str
        SHA-256 of the design's inputs.
    """

    gains: FloatArray
    status: tuple[str, ...]
    certificates: tuple[Certificate, ...]
    nominal: FloatArray
    kind: str
    method: str
    decay_rate: float | None
    sampling_s: float
    key: str

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
        for delay, (status, gain) in enumerate(zip(self.status, gains, strict=True)):
            if status not in ("nominal", "adjusted", "infeasible"):
                raise ValueError(
                    f"status[{delay}] is {status!r}; it must be nominal, adjusted or infeasible"
                )
            if status != "adjusted" and not np.array_equal(gain, nominal):
                raise ValueError(f"gains[{delay}] is not the nominal gain, but {status}")
        for name, array in (("gains", gains), ("nominal", nominal)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def max_delay_steps(self) -> int:
        """Return T_max in samples."""
        return int(self.gains.shape[0]) - 1

    @property
    def certified(self) -> npt.NDArray[np.bool_]:
        """Return whether the gain in force at each delay is certified, shape (T_max + 1,)."""
        return np.array([certificate.certified for certificate in self.certificates])

    @property
    def deviation(self) -> FloatArray:
        """Return ||K^(T) - K||_F at each delay, shape (T_max + 1,)."""
        return np.asarray(np.linalg.norm(self.gains - self.nominal, axis=(1, 2)))

    def gain(self, delay_steps: SupportsIndex) -> FloatArray:
        """Return the gain in force at one delay.

        Parameters
        ----------
        delay_steps : int
            Delay in samples, within 0..T_max. For many delays index `gains` directly.

        Returns
        -------
        ndarray, shape (m, n)
            Read-only.

        Raises
        ------
        ValueError
            If the delay is outside the table.
        """
        steps = operator.index(delay_steps)
        if not 0 <= steps <= self.max_delay_steps:
            raise ValueError(f"delay_steps is {steps}; it must lie in 0..{self.max_delay_steps}")
        return np.asarray(self.gains[steps])

    def verify(self, plant: DelayedPlant) -> None:
        """Recompute every certificate for a plant.

        Parameters
        ----------
        plant : DelayedPlant
            The plant that the schedule is meant for.

        Raises
        ------
        ValueError
            If a verdict does not come out as recorded.
        """
        for delay, (gain, old) in enumerate(zip(self.gains, self.certificates, strict=True)):
            new = certify(*plant.closed_loop(gain), delay, old.witness)
            if new.certified != old.certified:
                raise ValueError(
                    f"the gain for T={delay} is recorded as "
                    f"{'certified' if old.certified else 'not certified'}, but its check says "
                    f"otherwise: margins {dict(new.margins)}, "
                    f"largest spectral radius {new.spectral_radii.max():.6g}"
                )

    def to_json(self) -> str:
        """Return the schedule as JSON text; every float comes back bit for bit."""
        from hiersched.control.schedule_json import dump_schedule

        return dump_schedule(self)

    @classmethod
    def from_json(cls, text: str) -> GainSchedule:
        """Return the schedule that `to_json` wrote.

        Raises
        ------
        ValueError
            If the text is no schedule; the message names the field.
        """
        from hiersched.control.schedule_json import parse_schedule

        return parse_schedule(text)


def design_key(plant: DelayedPlant, max_delay_steps: int, method: Method, decay_rate: float) -> str:
    """Return the SHA-256 of everything that a schedule depends on.

    Parameters
    ----------
    plant, max_delay_steps, method, decay_rate
        As for `build_schedule`.

    Returns
    -------
    str
        64 hexadecimal digits.
    """
    inputs: dict[str, Any] = {
        "design_version": DESIGN_VERSION,
        "method": method,
        "decay_rate": decay_rate if method == "razumikhin" else None,
        "max_delay_steps": as_delay_steps("max_delay_steps", max_delay_steps),
        "kind": plant.kind,
        "sampling_s": plant.sampling_s,
    }
    for name in ("A", "B", "Q", "R", "nominal_gain", "A_d"):
        array = getattr(plant, name)
        inputs[name] = None if array is None else array.tolist()
    text = json.dumps(inputs, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def build_schedule(
    plant: DelayedPlant,
    max_delay_steps: int,
    method: Method = "krasovskii",
    *,
    decay_rate: float = DEFAULT_DECAY_RATE,
) -> GainSchedule:
    """Design the gain of every delay 0..T_max; each is the one `design_gain` returns.

    Parameters
    ----------
    plant : DelayedPlant
        The plant and its nominal gain.
    max_delay_steps : int
        Longest delay T_max in samples.
    method : {"krasovskii", "razumikhin"}
        The condition used.
    decay_rate : float
        Decay of V per sample that C1 has to certify, in (0, 1); C3 does not use it.

    Returns
    -------
    GainSchedule
        The table.

    Raises
    ------
    ValueError
        If the method, the rate or the delay is not allowed.
    """
    from hiersched.control.design import GainDesigner

    designer = GainDesigner(plant, method=method, decay_rate=decay_rate)
    steps = as_delay_steps("max_delay_steps", max_delay_steps)
    designs = [designer.design(delay) for delay in range(steps + 1)]
    logger.info(
        "designed %d gains in %.1f s: %s, %s plant, sampling %.4g s",
        len(designs),
        sum(design.solve_time_s for design in designs),
        method,
        plant.kind,
        plant.sampling_s,
    )
    return GainSchedule(
        gains=np.stack([design.gain for design in designs]),
        status=tuple(design.status for design in designs),
        certificates=tuple(design.certificate for design in designs),
        nominal=plant.nominal_gain,
        kind=plant.kind,
        method=method,
        decay_rate=decay_rate if method == "razumikhin" else None,
        sampling_s=plant.sampling_s,
        key=design_key(plant, steps, method, decay_rate),
    )


def load_or_build(
    path: str | os.PathLike[str],
    plant: DelayedPlant,
    max_delay_steps: int,
    method: Method = "krasovskii",
    *,
    decay_rate: float = DEFAULT_DECAY_RATE,
) -> GainSchedule:
    """Return the schedule cached at `path` if it is this design's, else build and store it.

    A cached schedule passes its certificates again before it is used. The file is replaced
    atomically.

    Parameters
    ----------
    path : path-like
        The cache file (JSON).
    plant, max_delay_steps, method, decay_rate
        As for `build_schedule`.

    Returns
    -------
    GainSchedule
        The table.

    Raises
    ------
    ValueError
        If the method, the rate or the delay is not allowed.
    OSError
        If the file cannot be read or written.
    """
    target = Path(path)
    key = design_key(plant, max_delay_steps, method, decay_rate)
    if target.exists():
        try:
            schedule = GainSchedule.from_json(target.read_text(encoding="utf-8"))
            if schedule.key == key:
                schedule.verify(plant)
                return schedule
            logger.info("%s holds another design's gains; designing anew", target)
        except ValueError as error:
            logger.warning("%s is not usable (%s); designing anew", target, error)
    schedule = build_schedule(plant, max_delay_steps, method, decay_rate=decay_rate)
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f"{target.name}.{os.getpid()}.part")
    part.write_text(schedule.to_json(), encoding="utf-8")
    os.replace(part, target)
    return schedule
