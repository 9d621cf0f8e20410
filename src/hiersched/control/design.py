"""Gains for a given delay: the nominal one where it is certified, else the closest that is."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from hiersched.control import krasovskii, razumikhin, razumikhin_synthesis
from hiersched.control.certificate import Certificate, Witness, certify
from hiersched.control.checks import FloatArray, as_delay_steps
from hiersched.control.plant import DelayedPlant
from hiersched.control.schedule import DEFAULT_DECAY_RATE

logger = logging.getLogger(__name__)

Method = Literal["krasovskii", "razumikhin"]
Status = Literal["nominal", "adjusted", "infeasible"]


@dataclass(frozen=True, kw_only=True, eq=False)
class GainDesign:
    """The gain to use up to a delay, and what is known about it.

    Parameters
    ----------
    gain : ndarray, shape (m, n)
        The gain in force: the nominal one unless the status is "adjusted".
    method : {"krasovskii", "razumikhin"}
        The condition used.
    status : {"nominal", "adjusted", "infeasible"}
        Whether the nominal gain is certified, a closest certified one was found, or neither.
    delay_steps : int
        Longest delay T in samples.
    certificate : Certificate
        Independent check of the gain in force.
    deviation : float
        ||K^ - K||_F in the units of the gain.
    solve_time_s : float
        Wall-clock time spent, in s.
    """

    gain: FloatArray
    method: Method
    status: Status
    delay_steps: int
    certificate: Certificate
    deviation: float
    solve_time_s: float

    @property
    def certified(self) -> bool:
        """Return whether the gain in force is certified."""
        return self.certificate.certified

    @property
    def margins(self) -> Mapping[str, float]:
        """Return the eigenvalue margins of the certificate."""
        return self.certificate.margins


class GainDesigner:
    """Designs gains for one plant at any delay; compiles its inequalities at most once.

    Parameters
    ----------
    plant : DelayedPlant
        The plant and its nominal gain.
    method : {"krasovskii", "razumikhin"}
        C3 (depends on the delay; both kinds of plant) or C1 (the paper's method by name; holds
        for any delay; split plants).
    decay_rate : float
        Decay of V per sample that C1 has to certify, in (0, 1); C3 does not use it.

    Raises
    ------
    ValueError
        If the method or the rate is not allowed.
    """

    def __init__(
        self,
        plant: DelayedPlant,
        *,
        method: Method = "krasovskii",
        decay_rate: float = DEFAULT_DECAY_RATE,
    ) -> None:
        if method not in get_args(Method):
            raise ValueError(f"method is {method!r}; it must be one of {get_args(Method)}")
        razumikhin.razumikhin_gamma(decay_rate, 0)
        self._plant, self._method, self._rate = plant, method, decay_rate
        self._synthesis: (
            krasovskii.KrasovskiiSynthesis | razumikhin_synthesis.RazumikhinSynthesis | None
        )
        self._synthesis = None
        self._nominal_fails_at: int | None = None

    def design(self, delay_steps: int) -> GainDesign:
        """Return the gain for all delays up to `delay_steps` samples.

        Parameters
        ----------
        delay_steps : int
            Longest delay T in samples.

        Returns
        -------
        GainDesign
            "infeasible", which is also logged, keeps the nominal gain.

        Raises
        ------
        ValueError
            If the delay is negative or not whole.
        """
        T = as_delay_steps("delay_steps", delay_steps)
        start = time.perf_counter()
        nominal = self._plant.nominal_gain
        certificate = certify(*self._plant.closed_loop(nominal), T, self._nominal_witness(T))
        if certificate.certified:
            return self._result(nominal, "nominal", T, certificate, start)
        if self._nominal_fails_at is None or self._nominal_fails_at > T:
            self._nominal_fails_at = T
        found = self._minimal_deviation(T)
        if found is not None:
            gain, witness = found
            adjusted = certify(*self._plant.closed_loop(gain), T, witness)
            if adjusted.certified:
                return self._result(gain, "adjusted", T, adjusted, start)
            logger.info("the gain found for T=%d failed its certificate: %s", T, adjusted.margins)
        logger.warning(
            "no certified gain: method=%s plant=%s T=%d; the nominal gain stays in force",
            self._method,
            self._plant.kind,
            T,
        )
        return self._result(nominal, "infeasible", T, certificate, start)

    def _nominal_witness(self, T: int) -> Witness | None:
        # Both conditions become harder with T, so one failure answers for every longer delay.
        if self._nominal_fails_at is not None and self._nominal_fails_at <= T:
            return None
        loop = self._plant.closed_loop(self._plant.nominal_gain)
        if self._method == "krasovskii":
            return krasovskii.analyse(*loop, T)
        return razumikhin.analyse(*loop, T, self._rate)

    def _minimal_deviation(self, T: int) -> tuple[FloatArray, Witness] | None:
        if self._synthesis is None:
            if self._method == "krasovskii":
                self._synthesis = krasovskii.KrasovskiiSynthesis(self._plant)
            elif self._plant.kind == "network":
                return None  # C1 needs a stable A_c = A, which no gain changes
            else:
                self._synthesis = razumikhin_synthesis.RazumikhinSynthesis(self._plant, self._rate)
        return self._synthesis.minimal_deviation(T)

    def _result(
        self, gain: FloatArray, status: Status, T: int, certificate: Certificate, start: float
    ) -> GainDesign:
        return GainDesign(
            gain=gain,
            method=self._method,
            status=status,
            delay_steps=T,
            certificate=certificate,
            deviation=float(np.linalg.norm(gain - self._plant.nominal_gain)),
            solve_time_s=time.perf_counter() - start,
        )


def design_gain(
    plant: DelayedPlant,
    delay_steps: int,
    *,
    method: Method = "krasovskii",
    decay_rate: float = DEFAULT_DECAY_RATE,
) -> GainDesign:
    """Return the gain for all delays up to `delay_steps`; see `GainDesigner`.

    Parameters
    ----------
    plant : DelayedPlant
        The plant and its nominal gain.
    delay_steps : int
        Longest delay T in samples.
    method : {"krasovskii", "razumikhin"}
        The condition used.
    decay_rate : float
        Decay of V per sample that C1 has to certify, in (0, 1); C3 does not use it.

    Returns
    -------
    GainDesign
        The gain, its status and its certificate.

    Raises
    ------
    ValueError
        If the method, the rate or the delay is not allowed.
    """
    return GainDesigner(plant, method=method, decay_rate=decay_rate).design(delay_steps)
