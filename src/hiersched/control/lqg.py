"""Kalman filter at the newest time stamp, prediction to now, and the regulator of what is believed.

Every measurement carries the time at which it was taken. The filter runs up to the newest that has
arrived, is predicted from there over its age with the inputs that were applied, and the regulator
acts on that. For a linear model that holds, inputs that are known and not saturated, known ages,
and every measurement up to the stamp filtered, estimate and control separate: the mean of the loop
is that of A - B K for any sequence of ages.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import SupportsIndex

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag, solve_discrete_are, solve_discrete_lyapunov

from hiersched.control.certificate import Certificate, SeparationWitness
from hiersched.control.checks import (
    FloatArray,
    as_definite,
    as_matrix,
    as_samples,
    as_semidefinite,
    as_square,
    spectral_radius,
    symmetrised,
)
from hiersched.control.delayed_plant import DelayedPlant, require_network
from hiersched.control.lqr import dlqr


@dataclass(frozen=True, kw_only=True, eq=False)
class FilterModel:
    """What a filter believes: x(k+1) = A x(k) + B u(k) + w(k), y(k) = (x_1, ..., x_n) + v(k).

    There are N states; the first n of them, those of the plant, are measured, the others are what
    disturbs it. Noise is white, w of covariance W; measurements have independent errors. Arrays
    become read-only copies; ValueError if one is malformed.
    """

    A: FloatArray  # (N, N)
    B: FloatArray  # (N, m)
    process_covariance: FloatArray  # W (N, N), positive semidefinite
    measurement_variance: FloatArray  # (n,), positive

    def __post_init__(self) -> None:
        """Check everything once and freeze the arrays."""
        A = as_square("A", self.A)
        checked = {
            "A": A,
            "B": as_matrix("B", self.B, (len(A), None)),
            "process_covariance": as_semidefinite(
                "process_covariance", self.process_covariance, len(A)
            ),
        }
        variance = np.array(self.measurement_variance, dtype=np.float64)
        if variance.ndim != 1 or not 0 < len(variance) <= len(A):
            raise ValueError(
                f"measurement_variance has shape {variance.shape}; it must be (n,) with n from 1 "
                f"to {len(A)}"
            )
        if not (np.isfinite(variance).all() and (variance > 0.0).all()):
            raise ValueError(f"measurement_variance is {variance}; it must be finite and positive")
        _freeze(self, checked | {"measurement_variance": variance})

    @property
    def num_measured(self) -> int:
        """Return n."""
        return len(self.measurement_variance)


@dataclass(frozen=True, kw_only=True, eq=False)
class Lqg:
    """The stationary filter and the regulator of a `FilterModel`: u = -`regulator` x^."""

    model: FilterModel
    regulator: FloatArray  # (m, N)
    filter_gain: FloatArray  # L (N, n): x^ = x^- + L (y - x^-[:n])
    covariance: FloatArray  # (N, N) of the error of x^ after an update

    def __post_init__(self) -> None:
        """Check the shapes and freeze the arrays."""
        size, n, m = len(self.model.A), self.model.num_measured, self.model.B.shape[1]
        _freeze(
            self,
            {
                "regulator": as_matrix("regulator", self.regulator, (m, size)),
                "filter_gain": as_matrix("filter_gain", self.filter_gain, (size, n)),
                "covariance": as_semidefinite("covariance", self.covariance, size),
            },
        )

    def prediction_covariance(self, age: SupportsIndex) -> FloatArray:
        """Return the covariance (N, N) of the error of a prediction over `age` samples.

        E_0 is that after an update, E_{i+1} = A E_i A^T + W.
        """
        model, covariance = self.model, self.covariance
        for _ in range(as_samples("age", age)):
            covariance = symmetrised(model.A @ covariance @ model.A.T + model.process_covariance)
        return covariance

    def second_moment(self, age: SupportsIndex) -> FloatArray:
        """Return the stationary covariance (N, N) of the state at a constant age in samples.

        X + E_age with X = A_c X A_c^T + A^age L S L^T (A^age)^T, A_c = A - B K, S the covariance of
        the innovation: what arrives moves the predicted state by A^age L times it. Prediction
        errors are not white: to treat them so underestimates.
        """
        model, n = self.model, self.model.num_measured
        before = model.A @ self.covariance @ model.A.T + model.process_covariance
        innovation = before[:n, :n] + np.diag(model.measurement_variance)
        steps = as_samples("age", age)
        moved = np.linalg.matrix_power(model.A, steps) @ self.filter_gain
        spread = symmetrised(moved @ innovation @ moved.T)
        X = solve_discrete_lyapunov(model.A - model.B @ self.regulator, spread)
        return symmetrised(X + self.prediction_covariance(steps))

    @property
    def growth(self) -> float:
        """Return the factor a sample by which the second moment shrinks, for any known ages."""
        return float(1.0 - min(self.certificate(0).margins.values())) ** 2

    def certificate(self, max_delay_steps: SupportsIndex) -> Certificate:
        """Return what separation proves for every sequence of known ages 0..T.

        The margins are 1 minus the spectral radii of A - B K and of the filter's error; the loop's
        spectral radius is the larger of the two at every delay.
        """
        model, n = self.model, self.model.num_measured
        regulated = spectral_radius(model.A - model.B @ self.regulator)
        corrected = np.eye(len(model.A))
        corrected[:, :n] -= self.filter_gain
        filtered = spectral_radius(corrected @ model.A)
        steps = as_samples("max_delay_steps", max_delay_steps)
        margins = {"regulator": 1.0 - regulated, "filter": 1.0 - filtered}
        return Certificate(
            certified=min(margins.values()) > 0.0,
            margins=margins,
            spectral_radii=np.full(steps + 1, max(regulated, filtered)),
            witness=SeparationWitness(),
        )


def design_lqg(plant: DelayedPlant, model: FilterModel) -> Lqg:
    """Return the stationary Kalman filter of a model and the regulator of a plant extended by it.

    The regulator weighs the plant's states and inputs as the plant does, and no others: where the
    model's first states are the plant, its gain on them is the plant's nominal gain. ValueError if
    the plant's feedback does not all cross the network, sizes do not fit, or a Riccati equation has
    no stabilising solution.
    """
    require_network(plant, "the method 'lqg'")
    n, size = model.num_measured, len(model.A)
    if plant.B.shape != (n, model.B.shape[1]):
        raise ValueError(
            f"the model measures {n} states and has {model.B.shape[1]} inputs; the plant has "
            f"{plant.B.shape[0]} and {plant.B.shape[1]}"
        )
    Q = block_diag(plant.Q, np.zeros((size - n, size - n)))
    regulator = dlqr(model.A, model.B, Q, plant.R)[0]
    filter_gain, covariance = stationary_filter(model)
    return Lqg(model=model, regulator=regulator, filter_gain=filter_gain, covariance=covariance)


def stationary_filter(model: FilterModel) -> tuple[FloatArray, FloatArray]:
    """Return the gain L (N, n) of the stationary Kalman filter, and the covariance after updates.

    ValueError if the Riccati equation has no stabilising solution: a mode that is not damped has
    to be measured and disturbed.
    """
    n, size = model.num_measured, len(model.A)
    C = np.eye(n, size)
    R = np.diag(model.measurement_variance)
    try:
        before = solve_discrete_are(model.A.T, C.T, model.process_covariance, R)
    except np.linalg.LinAlgError as error:
        raise ValueError(f"no stationary filter: {error}") from error
    innovation = as_definite("the innovation's covariance", before[:n, :n] + R)
    gain = np.linalg.solve(innovation, before[:n]).T
    after = before - gain @ before[:n]
    corrected = np.eye(size)
    corrected[:, :n] -= gain
    if not spectral_radius(corrected @ model.A) < 1.0:
        raise ValueError("no stationary filter: a mode that is not damped is not disturbed")
    return gain, symmetrised(after)


def simulate_lqg(
    lqg: Lqg, delays: npt.ArrayLike, *, seed: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Simulate runs of the linear model under the filter, delays of shape (samples, runs).

    Measurements arrive in order, all up to the newest; a delay that says that none has arrived
    since stays with what is known. Runs start at rest and known; inputs have no limit. Returns the
    states (samples, runs, N) at the control samples and the errors of their estimates. ValueError
    if a delay is negative or not whole.
    """
    steps = np.array(delays)
    if steps.ndim != 2 or steps.dtype.kind not in "iu" or (steps < 0).any():
        raise ValueError("delays must be whole, at least 0, and of shape (samples, runs)")
    model, (samples, runs) = lqg.model, steps.shape
    size, n, m = len(model.A), model.num_measured, model.B.shape[1]
    random = np.random.default_rng(seed)
    root = _root(model.process_covariance)
    states, errors = np.zeros((2, samples, runs, size))
    measured, inputs = np.zeros((samples, runs, n)), np.zeros((samples, runs, m))
    x, filtered = np.zeros((2, runs, size))
    stamp = np.full(runs, -1)
    for k in range(samples):
        noise = random.standard_normal((runs, n)) * np.sqrt(model.measurement_variance)
        states[k], measured[k] = x, x[:, :n] + noise
        newest = k - steps[k]
        while (behind := np.flatnonzero(stamp < newest)).size:
            before = filtered[behind]
            if (moving := stamp[behind] >= 0).any():
                own = behind[moving]
                before[moving] = _moved(model, before[moving], inputs[stamp[own], own])
            stamp[behind] += 1
            innovation = measured[stamp[behind], behind] - before[:, :n]
            filtered[behind] = before + innovation @ lqg.filter_gain.T
        predicted = filtered.copy()
        for age in range(k - int(stamp.min(initial=k)), 0, -1):
            own = np.flatnonzero((k - stamp >= age) & (k >= age))
            predicted[own] = _moved(model, predicted[own], inputs[k - age, own])
        inputs[k] = -predicted @ lqg.regulator.T
        errors[k] = x - predicted
        x = _moved(model, x, inputs[k]) + random.standard_normal((runs, size)) @ root.T
    return states, errors


def _moved(model: FilterModel, x: FloatArray, u: FloatArray) -> FloatArray:
    return np.asarray(x @ model.A.T + u @ model.B.T)


def _root(covariance: FloatArray) -> FloatArray:
    """Return a matrix M with M M^T = P, also for a P that is singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _freeze(target: object, arrays: dict[str, FloatArray]) -> None:
    for name, array in arrays.items():
        array.setflags(write=False)
        object.__setattr__(target, name, array)
