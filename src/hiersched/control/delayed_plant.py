"""The delayed linear plants for which gains are designed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from hiersched.control.checks import (
    FloatArray,
    as_definite,
    as_matrix,
    as_positive,
    as_semidefinite,
    as_square,
)
from hiersched.control.lqr import dlqr

PlantKind = Literal["network", "split"]


@dataclass(frozen=True, kw_only=True, eq=False)
class DelayedPlant:
    """A discrete linear plant whose feedback crosses, in whole or in part, a delaying network.

    ``network``: x(k+1) = A x(k) - B K x(k-d), all feedback is late, so A_c = A and A_d = -B K.
    ``split``: x(k+1) = (A - B K) x(k) + A_d x(k-d), the operator's part is late and fixed, the
    local gain K is free: the paper's form. Arrays become read-only copies.
    """

    A: FloatArray  # (n, n)
    B: FloatArray  # (n, m)
    Q: FloatArray  # (n, n), weight of the state in the regulator, positive semidefinite
    R: FloatArray  # (m, m), weight of the input, positive definite
    kind: PlantKind
    nominal_gain: FloatArray  # (m, n), K in force when nothing has to be adjusted
    A_d: FloatArray | None = None  # (n, n) of a split plant
    # (m, n), K_o that the operator of a split plant applies over the network, A_d = -B K_o; None
    # where A_d is a delay of the plant itself.
    operator_gain: FloatArray | None = None
    sampling_s: float

    def __post_init__(self) -> None:
        """Check everything once and freeze the arrays."""
        A = as_square("A", self.A)
        B = as_matrix("B", self.B, (A.shape[0], None))
        n, m = B.shape
        if self.kind not in get_args(PlantKind):
            raise ValueError(f"kind is {self.kind!r}; it must be one of {get_args(PlantKind)}")
        if (self.A_d is None) != (self.kind == "network"):
            raise ValueError(
                f"A_d is {'missing' if self.A_d is None else 'given'} for a {self.kind} plant; "
                "a split plant needs it, a network plant has A_d = -B K"
            )
        checked: dict[str, Any] = {
            "sampling_s": as_positive("sampling_s", self.sampling_s),
            "A": A,
            "B": B,
            "Q": as_semidefinite("Q", self.Q, n),
            "R": as_definite("R", self.R, m),
            "nominal_gain": as_matrix("nominal_gain", self.nominal_gain, (m, n)),
        }
        if self.A_d is not None:
            checked["A_d"] = as_square("A_d", self.A_d, n)
        if self.operator_gain is not None:
            checked["operator_gain"] = self._checked_operator_gain(B, self.operator_gain)
        for name, value in checked.items():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            object.__setattr__(self, name, value)

    def _checked_operator_gain(self, B: FloatArray, value: npt.ArrayLike) -> FloatArray:
        if self.A_d is None:
            raise ValueError("operator_gain is given for a network plant; its whole gain is late")
        K_o = as_matrix("operator_gain", value, (B.shape[1], B.shape[0]))
        error = float(np.abs(self.A_d + B @ K_o).max())
        if error > 1e-9 * (1.0 + float(np.abs(self.A_d).max())):
            raise ValueError(f"A_d is not -B operator_gain: they differ by up to {error:.3g}")
        return K_o

    @cached_property
    def scaling(self) -> FloatArray:
        """Return the invertible matrix L^T, shape (n, n), of the solver's state z = L^T x.

        L is the Cholesky factor of the Riccati solution (lifted off singularity by 1e-9 of its
        norm). Any invertible choice gives the same gains in exact arithmetic; badly scaled
        states make feasible problems look infeasible to a solver.
        """
        S = dlqr(self.A, self.B, self.Q, self.R)[1]
        lifted = S + 1e-9 * np.linalg.norm(S, 2) * np.eye(S.shape[0])
        return np.asarray(np.linalg.cholesky(lifted).T, dtype=np.float64)

    def closed_loop(self, K: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return (A_c, A_d) of x(k+1) = A_c x(k) + A_d x(k-d) under the gain K, shape (m, n)."""
        K = as_matrix("K", K, self.nominal_gain.shape)
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
    """Return the plant whose whole feedback u = -K x(k-d) is late, K from the regulator."""
    K = dlqr(A, B, Q, R)[0]
    A, B, Q, R = (np.asarray(matrix, dtype=np.float64) for matrix in (A, B, Q, R))
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

    With the regulator's K, the operator's part is K_o = share * K on `operator_states`, indices of
    the states that the operator feeds back (the pose), and 0 elsewhere; A_d = -B K_o is late,
    K - K_o is the nominal local gain. Without delay the loop is the regulator's. ValueError if the
    share is outside [0, 1] or a state does not exist.
    """
    if not 0.0 <= operator_share <= 1.0:
        raise ValueError(f"operator_share is {operator_share!r}; it must lie in [0, 1]")
    K = dlqr(A, B, Q, R)[0]
    n = K.shape[1]
    if not all(0 <= state < n for state in operator_states):
        raise ValueError(f"operator_states is {operator_states!r}; each must lie in 0..{n - 1}")
    A, B, Q, R = (np.asarray(matrix, dtype=np.float64) for matrix in (A, B, Q, R))
    K_o = np.zeros_like(K)
    columns = list(operator_states)
    K_o[:, columns] = operator_share * K[:, columns]
    local = K - K_o
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
