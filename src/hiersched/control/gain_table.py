"""The table of gains over delays that the slot loop looks up."""

from __future__ import annotations

import operator
from dataclasses import dataclass, field
from typing import SupportsIndex, get_args

import numpy as np
import numpy.typing as npt

from hiersched.control.certificate import Certificate, certify
from hiersched.control.checks import FloatArray, as_matrix
from hiersched.control.delayed_plant import DelayedPlant
from hiersched.control.gain_schedule_json import dump_schedule, parse_schedule
from hiersched.control.methods import Status


@dataclass(frozen=True, kw_only=True, eq=False)
class GainSchedule:
    """The gain in force at every delay 0..T_max, with what is known about it.

    The slot loop applies u(k) = -local x(k) - network x(k-d) - sum_i input_i u(k-1-i), with the
    tables `local_gains`, `network_gains` and `input_gains` at the delay in force.

    Parameters
    ----------
    gains : ndarray, shape (T_max + 1, m, n), float64
        Gain in force at each delay; the nominal one where nothing could be certified.
    status : tuple of str, length T_max + 1
        "nominal" and "adjusted" gains are certified, "uncertified" and "infeasible" ones are not
        (see `GainDesign`).
    certificates : tuple of Certificate, length T_max + 1
        Independent check of each gain in force.
    nominal : ndarray, shape (m, n)
        The nominal gain.
    kind : str
        Kind of plant, "network" or "split".
    method : str
        How the gains were chosen.
    decay_rate : float or None
        Decay per sample certified by C1; None for the other methods.
    sampling_s : float
        Sampling interval in s: one step of delay.
    key : str
        SHA-256 of the design's inputs.
    input_gains : ndarray, shape (T_max + 1, T_max, m, m), optional
        Gains on past inputs, the newest first, zero from the delay on; all zero if left out.
    operator_gain : ndarray, shape (m, n), optional
        The operator's fixed gain over the network (split plants).

    Raises
    ------
    ValueError
        If the tables do not fit each other, or a status does not fit its certificate.
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
    input_gains: FloatArray = field(default_factory=lambda: np.empty(0))
    operator_gain: FloatArray | None = None

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
        object.__setattr__(self, "gains", gains)
        object.__setattr__(self, "nominal", nominal)
        object.__setattr__(self, "input_gains", self._checked_input_gains())
        for delay in range(len(gains)):
            self._check_status(delay)
        for array in (gains, nominal, self.input_gains):
            array.setflags(write=False)
        if self.operator_gain is not None:
            operator_gain = as_matrix("operator_gain", self.operator_gain, nominal.shape)
            operator_gain.setflags(write=False)
            object.__setattr__(self, "operator_gain", operator_gain)

    def _checked_input_gains(self) -> FloatArray:
        steps, inputs = self.max_delay_steps, self.nominal.shape[0]
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
            if self.input_gains[delay].any():
                continue  # never certified: there is no verdict to check
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
        return dump_schedule(self)

    @classmethod
    def from_json(cls, text: str) -> GainSchedule:
        """Return the schedule that `to_json` wrote.

        Raises
        ------
        ValueError
            If the text is no schedule; the message names the field.
        """
        return parse_schedule(text, cls)
