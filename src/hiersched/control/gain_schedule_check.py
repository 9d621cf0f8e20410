"""Whether a gain schedule is what its method makes for a plant: recomputed with NumPy alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hiersched.control.certificate import (
    Certificate,
    IntervalWitness,
    SeparationWitness,
    certify,
)
from hiersched.control.checks import FloatArray
from hiersched.control.delayed_plant import DelayedPlant
from hiersched.control.h2 import h2_gain
from hiersched.control.lqg import FilterModel, design_lqg
from hiersched.control.lqr import latency_compensated
from hiersched.control.predictor import input_memory_radii, predictor_gains

if TYPE_CHECKING:
    from hiersched.control.gain_schedule import GainSchedule

ROUNDING = 1e-6
"""Numbers may differ by this share of the largest of their kind: processors round differently,
and a Riccati solution, a predictor's powers and eigenvalues make more of it."""
MARGIN_ROUNDING = 1e5
"""Margins may differ by this many tolerances of their certificate, 2e-9 of the numbers' size."""
_OUTCOMES = {
    "krasovskii": ("nominal", "adjusted", "infeasible"),
    "razumikhin": ("nominal", "adjusted", "infeasible"),
    "predictor": ("nominal", "uncertified"),
    "latency_compensated": ("nominal", "adjusted", "uncertified", "infeasible"),
    "h2": ("nominal", "adjusted", "uncertified", "infeasible"),
    "lqg": ("nominal",),
}
"""Method -> the statuses that its gains can have."""


def check_schedule(schedule: GainSchedule, plant: DelayedPlant, model: FilterModel | None) -> None:
    """As `GainSchedule.verify`."""
    with np.errstate(all="ignore"):
        try:
            _check(schedule, plant, model)
        except (TypeError, LookupError, ArithmeticError) as error:
            raise ValueError(f"it cannot be checked: {error!r:.200}") from error


def _check(schedule: GainSchedule, plant: DelayedPlant, model: FilterModel | None) -> None:
    for name in ("kind", "sampling_s"):
        own, wanted = getattr(schedule, name), getattr(plant, name)
        if own != wanted:
            raise ValueError(f"{name} is {own!r}; it must be {wanted!r}")
    if schedule.method not in _OUTCOMES:
        raise ValueError(f"method is {schedule.method!r}; it must be one of {list(_OUTCOMES)}")
    _same("nominal", schedule.nominal, plant.nominal_gain)
    operator = plant.operator_gain
    if (schedule.operator_gain is None) != (operator is None):
        raise ValueError("operator_gain is there, or not, against what the plant has")
    if schedule.operator_gain is not None and operator is not None:
        _same("operator_gain", schedule.operator_gain, operator)
    _check_lqg(schedule, plant, model)
    for delay in range(schedule.max_delay_steps + 1):
        _check_gain(schedule, plant, delay)


def _check_lqg(schedule: GainSchedule, plant: DelayedPlant, model: FilterModel | None) -> None:
    """Compare filter and regulator with those of the plant and of what the filter believes."""
    own = schedule.lqg
    if (own is not None) != (schedule.method == "lqg"):
        raise ValueError(f"lqg is there, or not, against the method {schedule.method!r}")
    if own is None:
        return
    if model is None:
        raise ValueError("lqg is there; the plant has no model for a filter")
    for name, wanted in vars(model).items():
        _same(f"lqg.model.{name}", getattr(own.model, name), wanted)
    design = design_lqg(plant, model)
    for name in ("regulator", "filter_gain", "covariance"):
        _same(f"lqg.{name}", getattr(own, name), getattr(design, name))


def _check_gain(schedule: GainSchedule, plant: DelayedPlant, delay: int) -> None:
    method, status = schedule.method, schedule.status[delay]
    gain, inputs = schedule.gains[delay], schedule.input_gains[delay, :delay]
    old = schedule.certificates[delay]
    criterion = {"razumikhin": "razumikhin", "lqg": "separation"}.get(method, "krasovskii")
    if status not in _OUTCOMES[method] or old.criterion not in (criterion, "none"):
        raise ValueError(
            f"status[{delay}] is {status!r}, certified by {old.criterion}: {method} gives "
            f"{', '.join(_OUTCOMES[method])}, certified by {criterion}"
        )
    promised = getattr(old.witness, "decay_rate", schedule.decay_rate)
    if promised != schedule.decay_rate:
        raise ValueError(
            f"the witness for T={delay} promises the decay {promised!r}; it must be "
            f"{schedule.decay_rate!r}"
        )
    if schedule.lqg is not None:
        new = schedule.lqg.certificate(delay)
    elif method == "predictor" and delay > 0:
        wanted, wanted_inputs = predictor_gains(plant.A, plant.B, plant.nominal_gain, delay)
        _same(f"gains[{delay}]", gain, wanted)
        _same(f"input_gains[{delay}]", inputs, wanted_inputs)
        radii = input_memory_radii(plant.A, plant.B, gain, inputs, delay)
        new = Certificate(spectral_radii=radii)
    else:
        if inputs.any():
            raise ValueError(f"input_gains[{delay}] is not zero: {method} has none")
        if status == "adjusted" and np.array_equal(gain, schedule.nominal):
            raise ValueError(
                f"status[{delay}] is 'adjusted', but gains[{delay}] is the nominal one"
            )
        if delay > 0 and status != "infeasible":
            _check_formula(schedule, plant, delay)
        # By its criterion it is neither of these.
        assert not isinstance(old.witness, IntervalWitness | SeparationWitness)
        new = certify(*plant.closed_loop(gain), delay, old.witness)
    _check_certificate(delay, old, new)


def _check_formula(schedule: GainSchedule, plant: DelayedPlant, delay: int) -> None:
    """Compare a gain with that of its method's formula, where there is one."""
    gain = schedule.gains[delay]
    if schedule.method == "latency_compensated":
        wanted = latency_compensated(plant.nominal_gain, plant.A, plant.B, delay)
    elif schedule.method == "h2":
        wanted = h2_gain(plant, delay, gain)  # an optimum is where the descent stays
    else:
        return
    _same(f"gains[{delay}]", gain, wanted)


def _check_certificate(delay: int, old: Certificate, new: Certificate) -> None:
    """Compare what is recorded of a gain with what its check says now."""
    found = f"margins {dict(new.margins)}, largest spectral radius {new.spectral_radii.max():.6g}"
    if new.certified != old.certified:
        raise ValueError(
            f"the gain for T={delay} is recorded as "
            f"{'certified' if old.certified else 'not certified'}, but its check says "
            f"otherwise: {found}"
        )
    # Random simulations are the designer's: they take a hundred times as long.
    recorded = {name: value for name, value in old.margins.items() if name != "simulation"}
    allowed = MARGIN_ROUNDING * new.tolerance
    fits = recorded.keys() == new.margins.keys() and all(
        abs(value - new.margins[name]) <= allowed + ROUNDING * abs(value)
        for name, value in recorded.items()
    )
    if not fits or old.spectral_radii.shape != new.spectral_radii.shape:
        raise ValueError(
            f"the certificate for T={delay} is another gain's: recorded are margins "
            f"{dict(old.margins)}, its check gives {found}"
        )
    _same(f"spectral_radii of T={delay}", old.spectral_radii, new.spectral_radii)


def _same(name: str, own: FloatArray, wanted: FloatArray) -> None:
    size = float(np.abs(wanted).max(initial=0.0))
    if own.shape != wanted.shape or not (np.abs(own - wanted) <= ROUNDING * size).all():
        raise ValueError(
            f"{name} is {_text(own)}; it must be {_text(wanted)}, which the plant and the method "
            "give"
        )


def _text(values: FloatArray) -> str:
    return np.array2string(values, precision=6, threshold=12, separator=", ").replace("\n", "")
