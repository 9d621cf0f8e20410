"""Gains for a given delay: the nominal one where it is certified, else the method's."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import SupportsIndex, get_args

import numpy as np

from hiersched.control.certificate import (
    DEFAULT_DECAY_RATE,
    Certificate,
    Method,
    Status,
    Witness,
    certify,
)
from hiersched.control.checks import FloatArray, as_decay_rate, as_samples
from hiersched.control.delayed_plant import DelayedPlant, require_network
from hiersched.control.h2 import h2_gain
from hiersched.control.krasovskii import KrasovskiiSynthesis, analyse_krasovskii
from hiersched.control.lqg import FilterModel, design_lqg
from hiersched.control.lqr import latency_compensated
from hiersched.control.predictor import input_memory_radii, predictor_gains
from hiersched.control.razumikhin import RazumikhinSynthesis, analyse_razumikhin

logger = logging.getLogger(__name__)

CERTIFYING = ("krasovskii", "razumikhin")
"""Methods that put no gain into force but one that is certified, or the nominal one."""

SIMULATIONS = 16
"""Runs under random varying delays that every gain in force has to pass (15 ms a gain)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GainDesign:
    """The gain to use up to a delay, and what is known about it."""

    # (m, n), in force on the state delayed by up to T samples; split plants: the local one.
    gain: FloatArray
    # (T, m, m), on the last T inputs, the newest first; zero for every method but the predictor.
    input_gains: FloatArray
    status: Status
    certificate: Certificate  # independent check of the gain in force
    deviation: float  # ||K^ - K||_F in the units of the gain
    solve_time_s: float  # wall-clock time spent

    @property
    def certified(self) -> bool:
        """Return whether the gain in force is certified."""
        return self.certificate.certified

    @property
    def margins(self) -> Mapping[str, float]:
        """Return the eigenvalue margins of the certificate."""
        return self.certificate.margins


_Found = tuple[FloatArray, Status, Certificate]


class GainDesigner:
    """Designs gains for one plant at any delay; compiles its inequalities at most once.

    ``krasovskii`` (C3, depends on the delay, both kinds of plant) and ``razumikhin`` (C1, the
    paper's method by name, for any delay, split plants) keep the nominal gain where they certify
    it and otherwise take the closest gain that they certify. The others, for network plants,
    take the gain of their formula and then ask C3 whether it happens to be certified:
    ``predictor`` (`predictor_gains`: made for the delay T exactly), ``latency_compensated``
    (K (A - B K)^T), ``h2`` (`h2_gain`: for the constant delay T, from the nominal gain where that
    is stable, else from the C3 gain). ``lqg`` keeps the nominal gain and adjusts the estimate on
    which it acts, by a filter that believes the `model`. `decay_rate`, in (0, 1), is the decay of V
    per sample that C1 has to certify; no other method uses it. ValueError if the method does not
    fit the plant, or a model is missing.
    """

    def __init__(
        self,
        plant: DelayedPlant,
        *,
        method: Method = "krasovskii",
        decay_rate: float = DEFAULT_DECAY_RATE,
        model: FilterModel | None = None,
    ) -> None:
        if method not in get_args(Method):
            raise ValueError(f"method is {method!r}; it must be one of {get_args(Method)}")
        if method not in CERTIFYING:
            require_network(plant, f"the method {method!r}")
        self._plant, self._method, self._rate = plant, method, as_decay_rate(decay_rate)
        self._nominal_fails_at = math.inf
        if (model is None) == (method == "lqg"):
            raise ValueError(
                f"model is {'missing' if model is None else 'given'}; the method 'lqg' needs one, "
                "no other has any"
            )
        self.lqg = None if model is None else design_lqg(plant, model)

    def design(self, delay_steps: SupportsIndex) -> GainDesign:
        """Return the gain for all delays up to `delay_steps` samples.

        "infeasible", which is also logged, keeps the nominal gain.
        """
        T = as_samples("delay_steps", delay_steps)
        start, m = time.perf_counter(), self._plant.B.shape[1]
        input_gains = np.zeros((T, m, m))
        if self.lqg is not None or self._method in CERTIFYING:
            gain, status, certificate = self._certified_gain(T)
        elif self._method == "predictor" and T > 0:
            A, B = self._plant.A, self._plant.B
            gain, input_gains = predictor_gains(A, B, self._plant.nominal_gain, T)
            radii = input_memory_radii(A, B, gain, input_gains, T)
            status, certificate = "uncertified", Certificate(spectral_radii=radii)
        else:
            gain, status, certificate = self._formula_gain(T)
        if status == "infeasible":
            logger.warning(
                "no certified gain: method=%s plant=%s T=%d; the nominal gain stays in force",
                self._method,
                self._plant.kind,
                T,
            )
        return GainDesign(
            gain=gain,
            input_gains=input_gains,
            status=status,
            certificate=certificate,
            deviation=float(np.linalg.norm(gain - self._plant.nominal_gain)),
            solve_time_s=time.perf_counter() - start,
        )

    def _certified_gain(self, T: int) -> _Found:
        nominal = self._plant.nominal_gain
        if self.lqg is not None:
            return nominal, "nominal", self.lqg.certificate(T)
        certificate = self._certify(nominal, T, self._nominal_witness(T))
        if certificate.certified:
            return nominal, "nominal", certificate
        self._nominal_fails_at = min(self._nominal_fails_at, T)
        found = self._minimal_deviation(T)
        if found is not None:
            adjusted = self._certify(found[0], T, found[1])
            if adjusted.certified:
                return found[0], "adjusted", adjusted
            logger.info("the gain found for T=%d failed its certificate: %s", T, adjusted.margins)
        return nominal, "infeasible", certificate

    def _formula_gain(self, T: int) -> _Found:
        plant, nominal = self._plant, self._plant.nominal_gain
        gain: FloatArray | None = nominal
        if self._method == "latency_compensated" and T > 0:
            gain = latency_compensated(nominal, plant.A, plant.B, T)
        elif self._method == "h2":
            gain = self._h2_gain(T)
        if gain is None:
            return nominal, "infeasible", self._certify(nominal, T, None)
        certificate = self._certify(gain, T, analyse_krasovskii(*plant.closed_loop(gain), T))
        status: Status = "nominal" if np.array_equal(gain, nominal) else "adjusted"
        return gain, status if certificate.certified else "uncertified", certificate

    def _h2_gain(self, T: int) -> FloatArray | None:
        nominal = self._plant.nominal_gain
        if self._certify(nominal, T, None).spectral_radii[T] < 1.0:
            return h2_gain(self._plant, T, nominal)
        found = self._minimal_deviation(T)
        return None if found is None else h2_gain(self._plant, T, found[0])

    def _certify(self, gain: FloatArray, T: int, witness: Witness | None) -> Certificate:
        return certify(*self._plant.closed_loop(gain), T, witness, simulations=SIMULATIONS)

    def _nominal_witness(self, T: int) -> Witness | None:
        # Both conditions become harder with T, so one failure answers for every longer delay.
        if self._nominal_fails_at <= T:
            return None
        loop = self._plant.closed_loop(self._plant.nominal_gain)
        if self._method == "krasovskii":
            return analyse_krasovskii(*loop, T)
        return analyse_razumikhin(*loop, T, self._rate)

    def _minimal_deviation(self, T: int) -> tuple[FloatArray, Witness] | None:
        if self._method == "razumikhin" and self._plant.kind == "network":
            return None  # C1 needs a stable A_c = A, which no gain changes
        return self._synthesis.minimal_deviation(T)

    @cached_property
    def _synthesis(self) -> KrasovskiiSynthesis | RazumikhinSynthesis:
        if self._method == "razumikhin":
            return RazumikhinSynthesis(self._plant, self._rate)
        return KrasovskiiSynthesis(self._plant)


def design_gain(
    plant: DelayedPlant,
    delay_steps: SupportsIndex,
    method: Method = "krasovskii",
    *,
    decay_rate: float = DEFAULT_DECAY_RATE,
    model: FilterModel | None = None,
) -> GainDesign:
    """Return the gain for all delays up to `delay_steps` samples; see `GainDesigner`."""
    designer = GainDesigner(plant, method=method, decay_rate=decay_rate, model=model)
    return designer.design(delay_steps)
