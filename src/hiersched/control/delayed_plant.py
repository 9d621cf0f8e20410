"""The delayed linear plants for which gains are designed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from hiersched.control.checks import (
    FloatArray,
    as_matrix,
    as_square,
    as_symmetric,
    require_definite,
    require_semidefinite,
)
from hiersched.control.lqr import dlqr

PlantKind = Literal["network", "split"]


@dataclass(frozen=True, kw_only=True, eq=False)
class DelayedPlant:
    """A discrete linear plant whose feedback crosses, in whole or in part, a delaying network.

    ``network``: x(k+1) = A x(k) - B K x(k-d), all feedback is late, so A_c = A and A_d = -B K.
    ``split``: x(k+1) = (A - B K) x(k) + A_d x(k-d), the operator's part is late and fixed, the
    local gain K is free: the paper's form.

    Parameters
    ----------
    A : array_like, shape (n, n)
        State matrix.
    B : array_like, shape (n, m)
        Input matrix.
    Q : array_like, shape (n, n)
        State weight of the regulator.
    R : array_like, shape (m, m)
        Input weight of the regulator.
    kind : {"network", "split"}
        Where the delay acts.
    nominal_gain : array_like, shape (m, n)
        Gain K in force when nothing has to be adjusted.
    A_d : array_like, shape (n, n), optional
        Delayed matrix of a split plant; None for a network plant.
    operator_gain : array_like, shape (m, n), optional
        Gain K_o that the operator of a split plant applies over the network, A_d = -B K_o. None
        for a network plant, and for a split plant whose A_d is a delay of the plant itself.
    sampling_s : float
        Sampling interval in s.

    Raises
    ------
    ValueError
        If a shape, a value or the combination of kind and A_d is wrong.
    """

    A: FloatArray
    B: FloatArray
    Q: FloatArray
    R: FloatArray
    kind: PlantKind
    nominal_gain: FloatArray
    A_d: FloatArray | None = None
    operator_gain: FloatArray | None = None
    sampling_s: float

    def __post_init__(self) -> None:
        """Check everything once and make the arrays read-only copies."""
        A = as_square("A", self.A)
        n = A.shape[0]
        B = as_matrix("B", self.B, (n, None))
        m = B.shape[1]
        if self.kind not in get_args(PlantKind):
            raise ValueError(f"kind is {self.kind!r}; it must be one of {get_args(PlantKind)}")
        if (self.A_d is None) != (self.kind == "network"):
            raise ValueError(
                f"A_d is {'missing' if self.A_d is None else 'given'} for a {self.kind} plant; "
                "a split plant needs it, a network plant has A_d = -B K"
            )
        if not (math.isfinite(self.sampling_s) and self.sampling_s > 0.0):
            raise ValueError(
                f"sampling_s is {self.sampling_s!r}; it must be finite and greater than 0"
            )
        object.__setattr__(self, "sampling_s", float(self.sampling_s))
        arrays = {
            "A": A,
            "B": B,
            "Q": as_symmetric("Q", self.Q, n),
            "R": as_symmetric("R", self.R, m),
            "nominal_gain": as_matrix("nominal_gain", self.nominal_gain, (m, n)),
        }
        require_semidefinite("Q", arrays["Q"])
        require_definite("R", arrays["R"])
        if self.A_d is not None:
            arrays["A_d"] = as_square("A_d", self.A_d, n)
        if self.operator_gain is not None:
            arrays["operator_gain"] = self._checked_operator_gain(B, self.operator_gain)
        for name, array in arrays.items():
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def _checked_operator_gain(self, B: FloatArray, value: npt.ArrayLike) -> FloatArray:
        if self.A_d is None:
            raise ValueError("operator_gain is given for a network plant; its whole gain is late")
        K_o = as_matrix("operator_gain", value, (B.shape[1], B.shape[0]))
        error = float(np.abs(self.A_d + B @ K_o).max())
        if error > 1e-9 * (1.0 + float(np.abs(self.A_d).max())):
            raise ValueError(f"A_d is not -B operator_gain: they differ by up to {error:.3g}")
        return K_o

    @cached_property
    def riccati(self) -> FloatArray:
        """Return the solution of the regulator's Riccati equation, shape (n, n)."""
        return dlqr(self.A, self.B, self.Q, self.R)[1]

    @cached_property
    def scaling(self) -> FloatArray:
        """Return the invertible matrix L^T, shape (n, n), of the solver's state z = L^T x.

        L is the Cholesky factor of the Riccati solution (lifted off singularity by 1e-9 of its
        norm). Any invertible choice gives the same gains in exact arithmetic; badly scaled
        states make feasible problems look infeasible to a solver.
        """
        S = self.riccati
        lifted = S + 1e-9 * np.linalg.norm(S, 2) * np.eye(S.shape[0])
        return np.asarray(np.linalg.cholesky(lifted).T, dtype=np.float64)

    def closed_loop(self, K: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return (A_c, A_d) of x(k+1) = A_c x(k) + A_d x(k-d) under the gain K.

        Parameters
        ----------
        K : array_like, shape (m, n)
            The gain.

        Returns
        -------
        A_c, A_d : ndarray, shape (n, n)
            Undelayed and delayed matrix.
        """
        K = as_matrix("K", K, (self.B.shape[1], self.A.shape[0]))
        if self.A_d is None:
            return self.A, -self.B @ K
        return self.A - self.B @ K, self.A_d


def require_network(plant: DelayedPlant, what: str) -> None:
    """Raise ValueError unless all feedback of the plant crosses the network."""
    if plant.kind != "network":
        raise ValueError(f"kind is {plant.kind!r}; {what} needs a 'network' plant")


def network_plant(
    A: npt.ArrayLike,
    B: npt.ArrayLike,
    Q: npt.ArrayLike,
    R: npt.ArrayLike,
    *,
    sampling_s: float,
) -> DelayedPlant:
    """Return the plant whose whole feedback u = -K x(k-d) is late, K from the regulator.

    Parameters
    ----------
    A, B, Q, R : array_like
        As for `DelayedPlant`.
    sampling_s : float
        Sampling interval in s.

    Returns
    -------
    DelayedPlant
        Kind ``network``.
    """
    A, B = as_square("A", A), as_matrix("B", B)
    K = dlqr(A, B, Q, R)[0]
    Q, R = as_square("Q", Q), as_square("R", R)
    return DelayedPlant(A=A, B=B, Q=Q, R=R, kind="network", nominal_gain=K, sampling_s=sampling_s)


def split_plant(
    A: npt.ArrayLike,
    B: npt.ArrayLike,
    Q: npt.ArrayLike,
    R: npt.ArrayLike,
    *,
    operator_share: float,
    operator_states: Sequence[int],
    sampling_s: float,
) -> DelayedPlant:
    """Return the plant whose operator closes a share of the regulator's gain over the network.

    With the regulator's K, the operator's part is K_o = share * K on `operator_states` and 0
    elsewhere; A_d = -B K_o is late, K - K_o is the nominal local gain. Without delay the loop
    is the regulator's.

    Parameters
    ----------
    A, B, Q, R : array_like
        As for `DelayedPlant`.
    operator_share : float
        Share of the gain that crosses the network, in [0, 1].
    operator_states : sequence of int
        Indices of the states that the operator feeds back (the pose).
    sampling_s : float
        Sampling interval in s.

    Returns
    -------
    DelayedPlant
        Kind ``split``.

    Raises
    ------
    ValueError
        If the share is outside [0, 1] or a state does not exist.
    """
    A, B = as_square("A", A), as_matrix("B", B)
    if not 0.0 <= operator_share <= 1.0:
        raise ValueError(f"operator_share is {operator_share!r}; it must lie in [0, 1]")
    n = A.shape[0]
    if not all(0 <= state < n for state in operator_states):
        raise ValueError(f"operator_states is {operator_states!r}; each must lie in 0..{n - 1}")
    K = dlqr(A, B, Q, R)[0]
    K_o = np.zeros_like(K)
    columns = list(operator_states)
    K_o[:, columns] = operator_share * K[:, columns]
    local = K - K_o
    Q, R = as_square("Q", Q), as_square("R", R)
    return DelayedPlant(
        A=A,
        B=B,
        Q=Q,
        R=R,
        kind="split",
        nominal_gain=local,
        A_d=-B @ K_o,
        operator_gain=K - local,  # K_o, rounded so that the two parts add up to K
        sampling_s=sampling_s,
    )
