"""Checks that name what is wrong (matrix, shape, property), and what is asked of most matrices."""

from __future__ import annotations

import math
import operator
from typing import SupportsIndex

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def as_matrix(
    name: str, value: npt.ArrayLike, shape: tuple[int | None, int | None] = (None, None)
) -> FloatArray:
    """Return a new finite float64 matrix of this shape (None: any number from 1)."""
    matrix = np.array(value, dtype=np.float64)
    fits = matrix.ndim == 2 and all(
        size in (None, actual) for size, actual in zip(shape, matrix.shape, strict=True)
    )
    if not fits or matrix.size == 0:
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        raise ValueError(f"{name} has shape {matrix.shape}; it must be ({wanted})")
    if not np.isfinite(matrix).all():
        row, column = np.argwhere(~np.isfinite(matrix))[0]
        raise ValueError(
            f"{name}[{row}, {column}] is {matrix[row, column]}; every entry must be finite"
        )
    return matrix


def as_square(name: str, value: npt.ArrayLike, size: int | None = None) -> FloatArray:
    """Return a finite square matrix (of `size` rows, where given)."""
    matrix = as_matrix(name, value, (size, size))
    if matrix.shape[0] != matrix.shape[1]:
        raise ValueError(f"{name} has shape {matrix.shape}; it must be square")
    return matrix


def as_symmetric(name: str, value: npt.ArrayLike, size: int | None = None) -> FloatArray:
    """Return a finite symmetric matrix; asymmetry beyond rounding is an error."""
    matrix = as_square(name, value, size)
    asymmetry = float(np.abs(matrix - matrix.T).max())
    if asymmetry > 1e-9 * max(1.0, float(np.abs(matrix).max())):
        raise ValueError(f"{name} is not symmetric: max |{name} - {name}^T| = {asymmetry:.3g}")
    return symmetrised(matrix)


def as_semidefinite(name: str, value: npt.ArrayLike, size: int | None = None) -> FloatArray:
    """Return a symmetric matrix that is positive semidefinite up to rounding."""
    matrix = as_symmetric(name, value, size)
    eigenvalues = np.linalg.eigvalsh(matrix)
    if eigenvalues[0] < -1e-10 * max(1.0, float(abs(eigenvalues[-1]))):
        raise ValueError(
            f"{name} is not positive semidefinite: smallest eigenvalue {eigenvalues[0]:.6g}"
        )
    return matrix


def as_definite(name: str, value: npt.ArrayLike, size: int | None = None) -> FloatArray:
    """Return a symmetric matrix that is positive definite."""
    matrix = as_symmetric(name, value, size)
    eigenvalues = np.linalg.eigvalsh(matrix)
    if eigenvalues[0] <= 1e-14 * float(abs(eigenvalues[-1])):
        raise ValueError(
            f"{name} is not positive definite: smallest eigenvalue {eigenvalues[0]:.6g}"
        )
    return matrix


def as_positive(name: str, value: float) -> float:
    """Return a finite number greater than 0."""
    if not (math.isfinite(value) and value > 0.0):
        raise ValueError(f"{name} is {value!r}; it must be finite and greater than 0")
    return float(value)


def as_decay_rate(value: float) -> float:
    """Return a relative decay a sample, in (0, 1)."""
    if not 0.0 < value < 1.0:
        raise ValueError(f"decay_rate is {value!r}; it must lie in (0, 1)")
    return float(value)


def as_samples(name: str, value: SupportsIndex) -> int:
    """Return a number of samples as an int of at least 0; a float is an error."""
    try:
        samples = operator.index(value)
    except TypeError:
        raise ValueError(f"{name} is {value!r}; it must be a whole number of samples") from None
    if samples < 0:
        raise ValueError(f"{name} is {samples}; it must be at least 0")
    return samples


def as_loop(
    A_c: npt.ArrayLike, A_d: npt.ArrayLike, delay_steps: SupportsIndex
) -> tuple[FloatArray, FloatArray, int]:
    """Return the checked matrices and delay of x(k+1) = A_c x(k) + A_d x(k-d), 0 <= d <= T."""
    A_c = as_square("A_c", A_c)
    A_d = as_square("A_d", A_d, A_c.shape[0])
    return A_c, A_d, as_samples("delay_steps", delay_steps)


def as_plant(
    A: npt.ArrayLike, B: npt.ArrayLike, K: npt.ArrayLike, name: str = "K"
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the checked matrices of x(k+1) = A x(k) + B u(k) and the gain called `name`."""
    A = as_square("A", A)
    B = as_matrix("B", B, (A.shape[0], None))
    return A, B, as_matrix(name, K, (B.shape[1], A.shape[0]))


def symmetrised(matrix: FloatArray) -> FloatArray:
    """Return (M + M^T) / 2."""
    return np.asarray((matrix + matrix.T) / 2.0, dtype=np.float64)


def spectral_radius(matrix: FloatArray) -> float:
    """Return the largest modulus of the eigenvalues of a square matrix."""
    return float(np.abs(np.linalg.eigvals(matrix)).max())
