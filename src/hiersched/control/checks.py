"""Checks of matrices that name what is wrong: matrix, shape or property."""

from __future__ import annotations

import operator
from typing import SupportsIndex

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def as_matrix(
    name: str, value: npt.ArrayLike, shape: tuple[int | None, int | None] = (None, None)
) -> FloatArray:
    """Return a finite float64 matrix, or say what is wrong with it.

    Parameters
    ----------
    name : str
        Name used in the error.
    value : array_like, shape (rows, columns)
        The matrix.
    shape : tuple
        Required rows and columns; None allows any number from 1.

    Returns
    -------
    ndarray, shape (rows, columns)
        A new array: later changes to `value` do not reach it.

    Raises
    ------
    ValueError
        If the shape is wrong or an entry is not finite.
    """
    matrix = np.array(value, dtype=np.float64)
    wanted = "(" + ", ".join("any" if size is None else str(size) for size in shape) + ")"
    fits = matrix.ndim == 2 and all(
        size is None or size == actual for size, actual in zip(shape, matrix.shape, strict=True)
    )
    if not fits or matrix.size == 0:
        raise ValueError(f"{name} has shape {matrix.shape}; it must be {wanted}")
    if not np.isfinite(matrix).all():
        row, column = np.argwhere(~np.isfinite(matrix))[0]
        raise ValueError(
            f"{name}[{row}, {column}] is {matrix[row, column]}; every entry must be finite"
        )
    return matrix


def as_square(name: str, value: npt.ArrayLike, size: int | None = None) -> FloatArray:
    """Return a finite square float64 matrix (of `size` rows, where given)."""
    matrix = as_matrix(name, value, (size, size))
    if matrix.shape[0] != matrix.shape[1]:
        raise ValueError(f"{name} has shape {matrix.shape}; it must be square")
    return matrix


def as_symmetric(name: str, value: npt.ArrayLike, size: int | None = None) -> FloatArray:
    """Return a finite symmetric float64 matrix; asymmetry beyond rounding is an error."""
    matrix = as_square(name, value, size)
    asymmetry = float(np.abs(matrix - matrix.T).max())
    if asymmetry > 1e-9 * max(1.0, float(np.abs(matrix).max())):
        raise ValueError(f"{name} is not symmetric: max |{name} - {name}^T| = {asymmetry:.3g}")
    return np.asarray((matrix + matrix.T) / 2.0, dtype=np.float64)


def require_semidefinite(name: str, matrix: FloatArray) -> None:
    """Raise ValueError unless the symmetric matrix is positive semidefinite up to rounding."""
    eigenvalues = np.linalg.eigvalsh(matrix)
    if eigenvalues[0] < -1e-10 * max(1.0, float(abs(eigenvalues[-1]))):
        raise ValueError(
            f"{name} is not positive semidefinite: smallest eigenvalue {eigenvalues[0]:.6g}"
        )


def require_definite(name: str, matrix: FloatArray) -> None:
    """Raise ValueError unless the symmetric matrix is positive definite."""
    eigenvalues = np.linalg.eigvalsh(matrix)
    if eigenvalues[0] <= 1e-14 * float(abs(eigenvalues[-1])):
        raise ValueError(
            f"{name} is not positive definite: smallest eigenvalue {eigenvalues[0]:.6g}"
        )


def as_delay_steps(name: str, value: SupportsIndex) -> int:
    """Return a delay in samples as an int of at least 0; a float is an error."""
    try:
        steps = operator.index(value)
    except TypeError:
        raise ValueError(f"{name} is {value!r}; it must be a whole number of samples") from None
    if steps < 0:
        raise ValueError(f"{name} is {steps}; it must be at least 0")
    return steps


def spectral_radius(matrix: FloatArray) -> float:
    """Return the largest modulus of the eigenvalues of a square matrix."""
    return float(np.abs(np.linalg.eigvals(matrix)).max())
