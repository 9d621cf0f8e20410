"""Certificates of stability under delay, checked with NumPy alone.

Nothing here is shared with the code that solves the inequalities: a witness is a set of
matrices from anywhere, and the check recomputes its inequalities' eigenvalues in the original
state, besides the spectrum of every constant delay. The closed loop is always
x(k+1) = A_c x(k) + A_d x(k-d(k)) with 0 <= d(k) <= T.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, SupportsIndex

import numpy as np
import numpy.typing as npt

from hiersched.control.checks import FloatArray, as_decay_rate, as_loop, as_square, as_symmetric
from hiersched.control.lifted import simulate_random_delays, spectral_radius_by_delay

DEFAULT_DECAY_RATE = 0.02
"""Decay of V per sample that C1 certifies where nothing else is asked."""


Method = Literal["krasovskii", "razumikhin", "predictor", "latency_compensated", "h2", "lqg"]
"""C3, C1 (certified by design); state prediction, K (A - B K)^T, H2-optimal (tried afterwards);
filter, prediction and regulator."""

Status = Literal["nominal", "adjusted", "uncertified", "infeasible"]
"""The nominal gain, certified; another one, certified; the method's, which no certificate covers;
the nominal gain for want of a better one, not certified."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RazumikhinWitness:
    """C1: V = x^T P x decays by 1 - decay_rate a sample; any delay is stable, rate up to T."""

    criterion: ClassVar[str] = "razumikhin"
    P: FloatArray
    tau: float
    decay_rate: float


@dataclass(frozen=True, kw_only=True, eq=False)
class DelayRazumikhinWitness:
    """C2: delay-dependent Razumikhin condition with the weights p + t1 + t2 < 1."""

    criterion: ClassVar[str] = "delay_razumikhin"
    P: FloatArray
    p: float
    t1: float
    t2: float


@dataclass(frozen=True, kw_only=True, eq=False)
class KrasovskiiWitness:
    """C3: delay-dependent Lyapunov-Krasovskii functional (P, S, R) with the coupling X."""

    criterion: ClassVar[str] = "krasovskii"
    P: FloatArray
    S: FloatArray
    R: FloatArray
    X: FloatArray


Witness = RazumikhinWitness | DelayRazumikhinWitness | KrasovskiiWitness


@dataclass(frozen=True, kw_only=True, eq=False)
class IntervalWitness:
    """Functional for delays of an interval: see `hiersched.control.interval`.

    P has as many n x n blocks as its vector has parts, the others are (n, n).
    """

    criterion: ClassVar[str] = "interval"
    P: FloatArray
    Q1: FloatArray
    Q2: FloatArray
    R1: FloatArray
    R2: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class SeparationWitness:
    """Filter and regulator are stable each by itself: see `hiersched.control.lqg`."""

    criterion: ClassVar[str] = "separation"


@dataclass(frozen=True, kw_only=True, eq=False)
class Certificate:
    """Outcome of a check."""

    # Every margin exceeds the tolerance and every spectral radius is below 1.
    certified: bool = False
    # Smallest eigenvalue of every matrix that must be positive definite, in the coordinates where
    # P is the identity, and the margin of the simulated runs, if there were any.
    margins: Mapping[str, float] = field(default_factory=dict)
    tolerance: float = 0.0  # bound on the rounding error of the margins
    spectral_radii: FloatArray  # (T + 1,) of the lifted system at each constant delay; read-only
    # The matrices checked; None where none was found.
    witness: Witness | IntervalWitness | SeparationWitness | None = None

    def __post_init__(self) -> None:
        """Make the radii read-only."""
        self.spectral_radii.setflags(write=False)

    @property
    def margins_hold(self) -> bool:
        """Whether every margin exceeds the tolerance."""
        return all(margin > self.tolerance for margin in self.margins.values())

    @property
    def criterion(self) -> str:
        """Return the name of the condition; "none" where no witness was found."""
        return "none" if self.witness is None else self.witness.criterion


def certify(
    A_c: npt.ArrayLike,
    A_d: npt.ArrayLike,
    delay_steps: SupportsIndex,
    witness: Witness | None,
    *,
    simulations: int = 0,
    seed: int = 0,
) -> Certificate:
    """Check a witness of stability for all delays 0..T, constant or varying.

    A witness that fails is no error, and None (nothing found) is never certified; a malformed one
    is a ValueError. With `simulations`, V must not exceed what the witness promises in so many
    runs under random varying delays (`simulate_random_delays`, 500 samples and more, `seed`); their
    margin is ``simulation``. A witness that passes the other checks cannot fail this one unless
    its condition is wrong.
    """
    A_c, A_d, steps = as_loop(A_c, A_d, delay_steps)
    radii = spectral_radius_by_delay(A_c, A_d, steps)
    if witness is None:
        return Certificate(spectral_radii=radii)
    margins, size = _margins(A_c, A_d, steps, witness)
    if simulations and judged(margins, size, radii, witness).margins_hold:
        margins["simulation"] = _simulated_margin(A_c, A_d, steps, witness, simulations, seed)
    return judged(margins, size, radii, witness)


def judged(
    margins: Mapping[str, float],
    size: float,
    radii: FloatArray,
    witness: Witness | IntervalWitness,
) -> Certificate:
    """Return what margins certify that were computed from numbers of a size, besides the radii."""
    certificate = Certificate(
        margins=margins,
        tolerance=100.0 * float(np.finfo(float).eps) * size,
        spectral_radii=radii,
        witness=witness,
    )
    certified = certificate.margins_hold and bool((radii < 1.0).all())
    return replace(certificate, certified=certified)


def _margins(
    A_c: FloatArray, A_d: FloatArray, steps: int, witness: Witness
) -> tuple[dict[str, float], float]:
    """Return the eigenvalue margins, and the size of the numbers they were computed from."""
    P = as_symmetric("P", witness.P, A_c.shape[0])
    smallest = _min_eigenvalue(P)
    if smallest <= 0.0:
        return {"P": smallest}, 1.0
    # z = L^T x makes P the identity: margins then mean the same whatever the units of x.
    L = np.asarray(np.linalg.cholesky(P), dtype=np.float64)
    A_z, D_z = (np.asarray(np.linalg.solve(L, (L.T @ M).T).T, float) for M in (A_c, A_d))
    if isinstance(witness, RazumikhinWitness):
        return _razumikhin_margins(A_z, D_z, steps, witness)
    if isinstance(witness, DelayRazumikhinWitness):
        return _delay_razumikhin_margins(A_z, D_z, steps, witness)
    return _krasovskii_margins(A_z, D_z, steps, witness, L)


def _razumikhin_margins(
    A_c: FloatArray, A_d: FloatArray, steps: int, witness: RazumikhinWitness
) -> tuple[dict[str, float], float]:
    """C1 where P = I: diag((1 - a - tau g) I, tau I) - [A_c A_d]^T [A_c A_d], g = (1-a)^-T."""
    rate, tau = as_decay_rate(witness.decay_rate), _finite("tau", witness.tau)
    gamma = (1.0 - rate) ** -steps
    F = np.hstack([A_c, A_d])
    weights = np.repeat([1.0 - rate - tau * gamma, tau], A_c.shape[0])
    margin = _min_eigenvalue(np.diag(weights) - F.T @ F)
    return {"inequality": margin, "tau": tau}, 1.0 + float(np.linalg.norm(F) ** 2)


def _delay_razumikhin_margins(
    A_c: FloatArray, A_d: FloatArray, steps: int, witness: DelayRazumikhinWitness
) -> tuple[dict[str, float], float]:
    """C2 where P = I: diag(p, t1, t2) - G^T G, G = [A_c+A_d, -T A_d (A_c-I), -T A_d A_d]."""
    p, t1, t2 = (_finite(name, getattr(witness, name)) for name in ("p", "t1", "t2"))
    n = A_c.shape[0]
    G = np.hstack([A_c + A_d, -steps * A_d @ (A_c - np.eye(n)), -steps * A_d @ A_d])
    margin = _min_eigenvalue(np.diag(np.repeat([p, t1, t2], n)) - G.T @ G)
    margins = {"inequality": margin, "contraction": 1.0 - (p + t1 + t2)}
    return margins, 1.0 + float(np.linalg.norm(G) ** 2)


def _krasovskii_margins(
    A_c: FloatArray, A_d: FloatArray, steps: int, witness: KrasovskiiWitness, L: FloatArray
) -> tuple[dict[str, float], float]:
    """C3 where P = I, as the decrease of V along (x(k), x(k-T), x(k-d)), shape (3n, 3n).

    V = x^T P x + sum of x^T S x over T samples + T times the double sum of eta^T R eta; the
    sums' difference is bounded by Jensen's inequality and the reciprocally convex bound with X.
    """
    n = A_c.shape[0]
    next_state = np.hstack([A_c, np.zeros((n, n)), A_d])
    if steps == 0:  # the delay is always 0: V = x^T P x alone
        loop = A_c + A_d
        margin = _min_eigenvalue(np.eye(n) - loop.T @ loop)
        return {"inequality": margin}, 1.0 + float(np.linalg.norm(loop) ** 2)
    S = _congruent(L, as_symmetric("S", witness.S, n))
    R = _congruent(L, as_symmetric("R", witness.R, n))
    X = _congruent(L, as_square("X", witness.X, n))
    now, oldest, delayed = np.split(np.eye(3 * n), 3)
    eta = next_state - now
    gaps = np.vstack([now - delayed, delayed - oldest])
    coupling = np.block([[R, X], [X.T, R]])
    terms = (
        next_state.T @ next_state - now.T @ now,
        now.T @ S @ now - oldest.T @ S @ oldest,
        steps**2 * eta.T @ R @ eta,
        -gaps.T @ coupling @ gaps,
    )
    margins = {
        "inequality": _min_eigenvalue(-sum(terms, np.zeros((3 * n, 3 * n)))),
        "coupling": _min_eigenvalue(coupling),
        "S": _min_eigenvalue(S),
    }
    return margins, 1.0 + sum(float(np.linalg.norm(term)) for term in terms)


def _simulated_margin(
    A_c: FloatArray, A_d: FloatArray, steps: int, witness: Witness, runs: int, seed: int
) -> float:
    """Return 1 - max V(x(k)) / bound over simulated runs that start at rest (x(k) = x(0), k < 0).

    The bound is what the witness proves: V(x(0)) for C1; the largest V of the first 2T + 1
    samples, after them, for C2; x(0)^T (P + T S) x(0), the functional at rest, for C3.
    """
    samples = 500 + 2 * steps
    with np.errstate(over="ignore", invalid="ignore"):
        states, _ = simulate_random_delays(A_c, A_d, steps, runs=runs, samples=samples, seed=seed)
        V = np.einsum("kri,ij,krj->kr", states, witness.P, states)
        first, bound = 1, V[0]
        if isinstance(witness, DelayRazumikhinWitness):
            first, bound = 2 * steps + 1, V[: 2 * steps + 1].max(axis=0)
        elif isinstance(witness, KrasovskiiWitness):
            bound = bound + steps * np.einsum("ri,ij,rj->r", states[0], witness.S, states[0])
        ratio = float((V[first:] / bound).max())
    return 1.0 - ratio if np.isfinite(ratio) else -np.inf


def _congruent(L: FloatArray, matrix: FloatArray) -> FloatArray:
    """Return L^-1 M L^-T, the matrix of the same form in z = L^T x."""
    return np.linalg.solve(L, np.linalg.solve(L, matrix.T).T)


def _min_eigenvalue(matrix: FloatArray) -> float:
    return float(np.linalg.eigvalsh((matrix + matrix.T) / 2.0)[0])


def _finite(name: str, value: float) -> float:
    if not np.isfinite(value):
        raise ValueError(f"{name} is {value!r}; it must be finite")
    return float(value)
