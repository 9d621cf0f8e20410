"""Gains for a given delay: the nominal one where it is certified, else the method's."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import get_args

import numpy as np

from hiersched.control.certificate import Certificate, Witness, certify
from hiersched.control.checks import FloatArray, as_delay_steps
from hiersched.control.delayed_plant import DelayedPlant, require_network
from hiersched.control.h2 import h2_gain
from hiersched.control.krasovskii import analyse_krasovskii
from hiersched.control.krasovskii_synthesis import KrasovskiiSynthesis
from hiersched.control.lqr import latency_compensated
from hiersched.control.methods import CERTIFYING, DEFAULT_DECAY_RATE, Method, Status
from hiersched.control.predictor import input_memory_radii, predictor_gains
from hiersched.control.razumikhin import analyse_razumikhin, razumikhin_gamma
from hiersched.control.razumikhin_synthesis import RazumikhinSynthesis

logger = logging.getLogger(__name__)

SIMULATIONS = 16
"""Runs under random varying delays that every gain in force has to pass (15 ms a gain)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GainDesign:
    """The gain to use up to a delay, and what is known about it.

    Parameters
    ----------
    gain : ndarray, shape (m, n)
        The gain in force, on the state delayed by up to T samples (split plants: the local one).
    input_gains : ndarray, shape (T, m, m)
        Gains on the last T inputs, the newest first; zero for every method but the predictor.
    method : str
        The method asked for.
    status : {"nominal", "adjusted", "uncertified", "infeasible"}
        "nominal": the nominal gain, certified. "adjusted": another gain, certified.
        "uncertified": the method's gain, which no certificate covers. "infeasible": nothing was
        found, the nominal gain stays in force and is not certified.
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
    input_gains: FloatArray
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

    ``krasovskii`` (C3, depends on the delay, both kinds of plant) and ``razumikhin`` (C1, the
    paper's method by name, for any delay, split plants) keep the nominal gain where they certify
    it and otherwise take the closest gain that they certify. The others, for network plants,
    take the gain of their formula and then ask C3 whether it happens to be certified:
    ``predictor`` (`predictor_gains`: made for the delay T exactly), ``latency_compensated``
    (K (A - B K)^T), ``h2`` (`h2_gain`: for the constant delay T, from the nominal gain where that
    is stable, else from the C3 gain).

    Parameters
    ----------
    plant : DelayedPlant
        The plant and its nominal gain.
    method : {"krasovskii", "razumikhin", "predictor", "latency_compensated", "h2"}
        How the gain is chosen.
    decay_rate : float
        Decay of V per sample that C1 has to certify, in (0, 1); no other method uses it.

    Raises
    ------
    ValueError
        If the method or the rate is not allowed, or the method does not fit the plant.
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
        if method not in CERTIFYING:
            require_network(plant, f"the method {method!r}")
        razumikhin_gamma(decay_rate, 0)
        self._plant, self._method, self._rate = plant, method, decay_rate
        self._synthesis: KrasovskiiSynthesis | RazumikhinSynthesis | None = None
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
        if self._method in CERTIFYING:
            return self._certified_design(T, start)
        if self._method == "predictor" and T > 0:
            return self._predictor_design(T, start)
        return self._formula_design(T, start)

    def _certified_design(self, T: int, start: float) -> GainDesign:
        nominal = self._plant.nominal_gain
        certificate = self._certify(nominal, T, self._nominal_witness(T))
        if certificate.certified:
            return self._result(nominal, "nominal", T, certificate, start)
        if self._nominal_fails_at is None or self._nominal_fails_at > T:
            self._nominal_fails_at = T
        found = self._minimal_deviation(T)
        if found is not None:
            gain, witness = found
            adjusted = self._certify(gain, T, witness)
            if adjusted.certified:
                return self._result(gain, "adjusted", T, adjusted, start)
            logger.info("the gain found for T=%d failed its certificate: %s", T, adjusted.margins)
        return self._infeasible(T, certificate, start)

    def _formula_design(self, T: int, start: float) -> GainDesign:
        plant, nominal = self._plant, self._plant.nominal_gain
        gain: FloatArray | None = nominal
        if self._method == "latency_compensated" and T > 0:
            gain = latency_compensated(nominal, plant.A, plant.B, T)
        elif self._method == "h2":
            gain = self._h2_gain(T)
        if gain is None:
            return self._infeasible(T, self._certify(nominal, T, None), start)
        certificate = self._certify(gain, T, analyse_krasovskii(*plant.closed_loop(gain), T))
        status: Status = "nominal" if np.array_equal(gain, nominal) else "adjusted"
        return self._result(
            gain, status if certificate.certified else "uncertified", T, certificate, start
        )

    def _h2_gain(self, T: int) -> FloatArray | None:
        nominal = self._plant.nominal_gain
        if self._certify(nominal, T, None).spectral_radii[T] < 1.0:
            return h2_gain(self._plant, T, nominal)
        found = self._minimal_deviation(T)
        return None if found is None else h2_gain(self._plant, T, found[0])

    def _predictor_design(self, T: int, start: float) -> GainDesign:
        plant = self._plant
        gain, input_gains = predictor_gains(plant.A, plant.B, plant.nominal_gain, T)
        radii = input_memory_radii(plant.A, plant.B, gain, input_gains, T)
        certificate = Certificate.without_witness(radii)
        return self._result(gain, "uncertified", T, certificate, start, input_gains)

    def _certify(self, gain: FloatArray, T: int, witness: Witness | None) -> Certificate:
        return certify(*self._plant.closed_loop(gain), T, witness, simulations=SIMULATIONS)

    def _infeasible(self, T: int, certificate: Certificate, start: float) -> GainDesign:
        logger.warning(
            "no certified gain: method=%s plant=%s T=%d; the nominal gain stays in force",
            self._method,
            self._plant.kind,
            T,
        )
        return self._result(self._plant.nominal_gain, "infeasible", T, certificate, start)

    def _nominal_witness(self, T: int) -> Witness | None:
        # Both conditions become harder with T, so one failure answers for every longer delay.
        if self._nominal_fails_at is not None and self._nominal_fails_at <= T:
            return None
        loop = self._plant.closed_loop(self._plant.nominal_gain)
        if self._method == "krasovskii":
            return analyse_krasovskii(*loop, T)
        return analyse_razumikhin(*loop, T, self._rate)

    def _minimal_deviation(self, T: int) -> tuple[FloatArray, Witness] | None:
        if self._synthesis is None:
            if self._method != "razumikhin":
                self._synthesis = KrasovskiiSynthesis(self._plant)
            elif self._plant.kind == "network":
                return None  # C1 needs a stable A_c = A, which no gain changes
            else:
                self._synthesis = RazumikhinSynthesis(self._plant, self._rate)
        return self._synthesis.minimal_deviation(T)

    def _result(
        self,
        gain: FloatArray,
        status: Status,
        T: int,
        certificate: Certificate,
        start: float,
        input_gains: FloatArray | None = None,
    ) -> GainDesign:
        inputs = self._plant.B.shape[1]
        return GainDesign(
            gain=gain,
            input_gains=np.zeros((T, inputs, inputs)) if input_gains is None else input_gains,
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
    method: Method = "krasovskii",
    *,
    decay_rate: float = DEFAULT_DECAY_RATE,
) -> GainDesign:
    """Return the gain for all delays up to `delay_steps`; see `GainDesigner`.

    Parameters
    ----------
    plant : DelayedPlant
        The plant and its nominal gain.
    delay_steps : int
        Longest delay T in samples.
    method : {"krasovskii", "razumikhin", "predictor", "latency_compensated", "h2"}
        How the gain is chosen.
    decay_rate : float
        Decay of V per sample that C1 has to certify, in (0, 1); no other method uses it.

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
