"""Elementary functions of IEEE operations only: every machine gives the same bits.

The compiler turns loops over them into vector instructions; the C library's functions would neither
vectorise nor promise their last bit. Multiplication and addition are fused where that is written,
with one rounding on every machine, and nowhere else. Each docstring states the error; the tests
measure it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from hiersched.core.compiled import kernel

F32 = np.float32
_SQRT_HALF_32 = np.int32(0x3F3504F3)
_MANTISSA_32 = np.int32(0x007FFFFF)
_SQRT_HALF_64 = np.int64(0x3FE6A09E00000000)
_MANTISSA_64 = np.int64(0x000FFFFFFFFFFFFF)
_LOG2_E = 1.4426950408889634
_LN2_HIGH = 6.93147180369123816490e-01
_LN2_LOW = 1.90821492927058770002e-10

_TWO_OVER_PI = 0.6366197723675814
_HALF_PI_HIGH, _HALF_PI_LOW = 1.5707963267948966, 6.123233995736766e-17

# Coefficients of polynomials, that of the highest power first.
_LN_F32 = tuple(
    map(
        F32,
        (7.0376836292e-2, -1.1514610310e-1, 1.1676998740e-1, -1.2420140846e-1, 1.4249322787e-1,
         -1.6668057665e-1, 2.0000714765e-1, -2.4999993993e-1, 3.3333331174e-1),
    )
)  # fmt: skip
_LN_F64 = (
    1.479819860511658591e-01, 1.531383769920937332e-01, 1.818357216161805012e-01,
    2.222219843214978396e-01, 2.857142874366239149e-01, 3.999999999940941908e-01,
    6.666666666666735130e-01,
)  # fmt: skip
_SIN_F64 = (
    1.58969099521155010221e-10, -2.50507602534068634195e-08, 2.75573137070700676789e-06,
    -1.98412698298579493134e-04, 8.33333333332248946124e-03, -1.66666666666666324348e-01,
)  # fmt: skip
_COS_F64 = (
    -1.13596475577881948265e-11, 2.08757232129817482790e-09, -2.75573143513906633035e-07,
    2.48015872894767294178e-05, -1.38888888888741095749e-03, 4.16666666666666019037e-02,
)  # fmt: skip
_EXP = (
    1.6059043836821613e-10, 2.08767569878681e-09, 2.505210838544172e-08, 2.755731922398589e-07,
    2.7557319223985893e-06, 2.48015873015873e-05, 0.0001984126984126984, 0.001388888888888889,
    0.008333333333333333, 0.041666666666666664, 0.16666666666666666, 0.5, 1.0, 1.0,
)  # fmt: skip
_SIN = (
    1.6059043836821613e-10, -2.505210838544172e-08, 2.7557319223985893e-06,
    -0.0001984126984126984, 0.008333333333333333, -0.16666666666666666,
)  # fmt: skip
_COS = (
    -1.1470745597729725e-11, 2.08767569878681e-09, -2.755731922398589e-07, 2.48015873015873e-05,
    -0.001388888888888889, 0.041666666666666664, -0.5, 1.0,
)  # fmt: skip
_SIN_F32, _COS_F32 = tuple(map(F32, _SIN[1:])), tuple(map(F32, _COS[2:]))


@intrinsic
def fma(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """Return a b + c with one rounding, for three floats of one type."""
    if not (a == b == c and isinstance(a, types.Float)):
        return None

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return a(a, a, a), generate


@intrinsic
def polynomial(typing_context: Any, x: Any, coefficients: Any) -> Any:
    """Return a polynomial by Horner's scheme in fused multiply-adds, all floats of one type."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        total = builder.extract_value(arguments[1], 0)
        for place in range(1, coefficients.count):
            term = builder.extract_value(arguments[1], place)
            total = builder.fma(total, arguments[0], term)
        return total

    return x(x, coefficients), generate


@njit(inline="always")
def ln_f32(x: np.float32) -> np.float32:
    """Natural logarithm of a positive normal float32; error below 2e-7 relative to max(1, |ln x|).

    Source: the polynomial of Cephes `logf`.
    """
    bits = np.float32(x).view(np.int32) - _SQRT_HALF_32
    exponent = F32(bits >> np.int32(23))
    f = np.int32((bits & _MANTISSA_32) + _SQRT_HALF_32).view(np.float32) - F32(1.0)
    z = f * f
    y = polynomial(f, _LN_F32) * f * z
    y = fma(F32(-2.12194440e-4), exponent, y)
    y = fma(F32(-0.5), z, y)
    return fma(F32(0.693359375), exponent, f + y)


@njit(inline="always")
def ordered_f32(x: np.float32) -> np.int32:
    """Integer in the order of the float32 x: integers' maxima vectorise, floats' do not."""
    bits = np.float32(x).view(np.int32)
    return np.int32(bits ^ ((bits >> np.int32(31)) & np.int32(0x7FFFFFFF)))


@njit(inline="always")
def from_ordered_f32(key: np.int32) -> np.float32:
    """Float32 of which `ordered_f32` made `key`."""
    return np.int32(key ^ ((key >> np.int32(31)) & np.int32(0x7FFFFFFF))).view(np.float32)


@njit(inline="always")
def ordered_f64(x: float) -> np.int64:
    """Integer in the order of the double x."""
    bits = np.float64(x).view(np.int64)
    return np.int64(bits ^ ((bits >> np.int64(63)) & np.int64(0x7FFFFFFFFFFFFFFF)))


@njit(inline="always")
def _ln_parts_f64(x: float) -> tuple[float, float]:
    """Split a positive normal double 2^n m, m within [sqrt(1/2), sqrt(2)), into n and ln m.

    Source: the argument reduction and polynomial of FreeBSD's `e_log.c`.
    """
    bits = np.float64(x).view(np.int64) - _SQRT_HALF_64
    exponent = np.float64(bits >> np.int64(52))
    f = np.int64((bits & _MANTISSA_64) + _SQRT_HALF_64).view(np.float64) - 1.0
    s = f / (2.0 + f)
    z = s * s
    half_square = 0.5 * f * f
    return exponent, f - fma(-s, half_square + polynomial(z, _LN_F64) * z, half_square)


@njit(inline="always")
def log2_f64(x: float) -> float:
    """Logarithm to base 2 of a positive normal double; error below 2 ulp of max(1, |log2 x|)."""
    exponent, ln_mantissa = _ln_parts_f64(x)
    return fma(ln_mantissa, _LOG2_E, exponent)


@njit(inline="always")
def ln_f64(x: float) -> float:
    """Natural logarithm of a positive normal double; error below 2 ulp."""
    exponent, ln_mantissa = _ln_parts_f64(x)
    return fma(_LN2_HIGH, exponent, fma(_LN2_LOW, exponent, ln_mantissa))


@njit(inline="always")
def log1p_f64(x: float) -> float:
    """ln(1 + x) of a finite double x > -1; error below 2 ulp.

    What rounding takes from 1 + x comes back as a term of first order.
    """
    y = 1.0 + x
    return ln_f64(y) + (x - (y - 1.0)) / y


@njit(inline="always")
def exp_f64(x: float) -> float:
    """Exponential of a double within [-700, 700]; error below 2 ulp.

    Source: reduction to |r| <= ln 2 / 2 in two parts (Cody and Waite), Taylor series to the 13th
    power.
    """
    n = np.floor(x * _LOG2_E + 0.5)
    r = fma(-n, _LN2_LOW, fma(-n, _LN2_HIGH, x))
    two_to_n = np.int64((np.int64(n) + np.int64(1023)) << np.int64(52)).view(np.float64)
    return float(polynomial(r, _EXP) * two_to_n)


@njit(inline="always")
def wrap_angle(x: float) -> float:
    """Angle in rad brought into [-pi, pi), for |x| below 3 pi."""
    if x >= np.pi:
        return x - 2.0 * np.pi
    if x < -np.pi:
        return x + 2.0 * np.pi
    return x


@njit(inline="always")
def sin_half(x: float) -> float:
    """sin(x / 2) for |x| <= pi; error below 1e-9 (Taylor series to the 13th power)."""
    h = 0.5 * x
    z = h * h
    return fma(h * z, polynomial(z, _SIN), h)


@njit(inline="always")
def cos_half(x: float) -> float:
    """cos(x / 2) for |x| <= pi; error below 1e-9 (Taylor series to the 14th power)."""
    h = 0.5 * x
    return polynomial(h * h, _COS)


@njit(inline="always")
def _sine(r: float) -> float:
    z = r * r
    return fma(z * r, polynomial(z, _SIN_F64), r)


@njit(inline="always")
def _cosine(r: float) -> float:
    z = r * r
    half = 0.5 * z
    rest = 1.0 - half
    return rest + (((1.0 - rest) - half) + z * z * polynomial(z, _COS_F64))


@njit(inline="always")
def sincos_f64(x: float) -> tuple[float, float]:
    """Sine and cosine of a double within 1e5; errors below 2 ulp, or 1e-30 if that is more.

    Source: reduction by multiples of pi / 2 in two parts (Cody and Waite), polynomials of fdlibm.
    """
    n = np.floor(x * _TWO_OVER_PI + 0.5)
    r = fma(-n, _HALF_PI_LOW, fma(-n, _HALF_PI_HIGH, x))
    sine, cosine = _sine(r), _cosine(r)
    quarter = np.int64(n) & 3
    if quarter == 1:
        return cosine, -sine
    if quarter == 2:
        return -sine, -cosine
    if quarter == 3:
        return -cosine, sine
    return sine, cosine


@kernel()
def _fill_sincos(
    x: NDArray[np.float64], sine: NDArray[np.float64], cosine: NDArray[np.float64]
) -> None:
    for i in range(x.shape[0]):
        sine[i], cosine[i] = sincos_f64(x[i])


def sincos(x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sines and cosines of an array within 1e5, by `sincos_f64`.

    NumPy's have other last bits on processors with AVX-512, where a log would not replay that
    another processor wrote.
    """
    sine, cosine = np.empty(x.shape), np.empty(x.shape)
    _fill_sincos(np.ravel(x), sine.reshape(-1), cosine.reshape(-1))
    return sine, cosine


def sinc(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sin(x) / x of an array within 1e5, 1 at 0."""
    there = np.where(x == 0.0, 1e-20, x)
    ratio: NDArray[np.float64] = sincos(there)[0] / there
    return ratio


@njit(inline="always")
def sincos_turn_f32(turn: np.float32) -> tuple[np.float32, np.float32]:
    """-sin(2 pi x) and -cos(2 pi x) of a float32 in (0, 1); error below 2e-6 (Taylor)."""
    h = F32(np.pi) * turn - F32(0.5 * np.pi)
    z = h * h
    sine, cosine = fma(h * z, polynomial(z, _SIN_F32), h), polynomial(z, _COS_F32)
    return F32(2.0) * sine * cosine, F32(1.0) - F32(2.0) * sine * sine


@njit(inline="always")
def copy(values: NDArray[Any], out: NDArray[Any]) -> None:
    """Fill `out` (n,) with the first of the values."""
    for i in range(out.shape[0]):
        out[i] = values[i]
