"""The error bounds that the docstrings state, measured against the C library and long doubles."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hiersched.core.compiled import kernel
from hiersched.core.numerics import (
    cos_half,
    exp_f64,
    fma,
    from_ordered_f32,
    ln_f32,
    ln_f64,
    log1p_f64,
    log2_f64,
    ordered_f32,
    ordered_f64,
    sin_half,
    sinc,
    sincos,
    sincos_turn_f32,
    wrap_angle,
)


@kernel()
def ln_all(x, out):
    for i in range(x.shape[0]):
        out[i] = ln_f32(x[i])


@kernel()
def log2_all(x, out):
    for i in range(x.shape[0]):
        out[i] = log2_f64(x[i])


@kernel()
def ln_double_all(x, out):
    for i in range(x.shape[0]):
        out[i] = ln_f64(x[i])


@kernel()
def log1p_all(x, out):
    for i in range(x.shape[0]):
        out[i] = log1p_f64(x[i])


@kernel()
def halves_all(x, sine, cosine):
    for i in range(x.shape[0]):
        sine[i] = sin_half(x[i])
        cosine[i] = cos_half(x[i])


@kernel()
def turns_all(x, sine, cosine):
    for i in range(x.shape[0]):
        sine[i], cosine[i] = sincos_turn_f32(x[i])


def positive(dtype, low, high, count=200_000):
    """Numbers of all magnitudes 2^low … 2^high, near 1, near powers of 2 and sqrt(1/2)."""
    rng = np.random.default_rng(1)
    spread = 2.0 ** rng.uniform(low, high, count)
    near = 1.0 + rng.normal(size=count) * 2.0 ** rng.uniform(-20, -1, count)
    powers = 2.0 ** np.arange(low, high)
    edges = [powers * f for f in (1.0, math.sqrt(0.5), 1 - 2**-22, 1 + 2**-22)]
    every = np.concatenate([spread, near[near > 0.01], *edges]).astype(dtype)
    return every


def test_natural_logarithm_keeps_its_bound():
    x = positive(np.float32, -125, 127)
    got = np.empty_like(x)
    ln_all(x, got)
    exact = np.log(x.astype(np.longdouble))
    error = np.abs(got.astype(np.longdouble) - exact) / np.maximum(1.0, np.abs(exact))
    assert error.max() < 2e-7


def test_binary_logarithm_keeps_its_bound():
    x = positive(np.float64, -1000, 1000)
    got = np.empty_like(x)
    log2_all(x, got)
    exact = np.log2(x.astype(np.longdouble))
    ulp = np.spacing(np.maximum(1.0, np.abs(exact)).astype(np.float64))
    assert (np.abs(got.astype(np.longdouble) - exact) / ulp).max() < 2.0


def test_binary_logarithm_of_powers_of_two_is_exact():
    exponents = np.arange(-1000.0, 1001.0)
    got = np.empty_like(exponents)
    log2_all(2.0**exponents, got)
    np.testing.assert_array_equal(got, exponents)


def test_natural_logarithm_of_a_double_keeps_its_bound():
    x = positive(np.float64, -1000, 1000)
    got = np.empty_like(x)
    ln_double_all(x, got)
    exact = np.log(x.astype(np.longdouble))
    assert (np.abs(got - exact) <= 2 * np.spacing(np.abs(got))).all()
    assert got[x == 1.0].tolist() == [0.0] * (x == 1.0).sum()


def test_logarithm_of_one_plus_x_keeps_its_bound():
    rng = np.random.default_rng(4)
    x = np.concatenate([positive(np.float64, -1000, 1000), rng.uniform(-0.999, 1.0, 100_000)])
    x = np.concatenate([x, -(2.0 ** -np.arange(2.0, 900.0)), [0.0]])
    got = np.empty_like(x)
    log1p_all(x, got)
    exact = np.log1p(x.astype(np.longdouble))
    assert (np.abs(got - exact) <= 2 * np.spacing(np.abs(got))).all()
    assert got[-1] == 0.0


def test_half_angles_keep_their_bound():
    x = np.linspace(-np.pi, np.pi, 100_001)
    sine, cosine = np.empty_like(x), np.empty_like(x)
    halves_all(x, sine, cosine)
    assert np.abs(sine - np.sin(x / 2)).max() < 1e-9
    assert np.abs(cosine - np.cos(x / 2)).max() < 1e-9


def test_turns_keep_their_bound():
    rng = np.random.default_rng(2)
    edges = np.array([2**-24, 1 - 2**-24, 0.25, 0.5, 0.75])
    x = np.concatenate([edges, rng.uniform(2**-24, 1 - 2**-24, 200_000)]).astype(np.float32)
    sine, cosine = np.empty_like(x), np.empty_like(x)
    turns_all(x, sine, cosine)
    angle = 2.0 * np.pi * x.astype(np.float64)
    assert np.abs(sine + np.sin(angle)).max() < 2e-6
    assert np.abs(cosine + np.cos(angle)).max() < 2e-6


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [
        (0.0, 0.0),
        (np.pi, -np.pi),
        (-np.pi, -np.pi),
        (3.5, 3.5 - 2 * np.pi),
        (-3.5, 2 * np.pi - 3.5),
    ],
)
def test_angles_wrap_into_one_turn(angle, wrapped):
    assert wrap_angle(angle) == wrapped


@kernel()
def exp_all(x, out):
    for i in range(x.shape[0]):
        out[i] = exp_f64(x[i])


def test_exponential_keeps_its_bound():
    rng = np.random.default_rng(2)
    near = np.arange(-300, 300) * 0.5 * math.log(2)
    x = np.concatenate([rng.uniform(-700, 700, 200_000), rng.normal(size=50_000), near, [0.0]])
    got = np.empty_like(x)
    exp_all(x, got)
    exact = np.exp(x.astype(np.longdouble))
    assert (np.abs(got - exact) <= 2 * np.spacing(got)).all()
    assert got[-1] == 1.0


@kernel()
def fma_all(a, b, c, out):
    for i in range(a.shape[0]):
        out[i] = fma(a[i], b[i], c[i])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_multiplication_and_addition_are_fused(dtype):
    """(1 + e)(1 - e) - 1 = -e² with one rounding, 0 with two."""
    small = np.array([np.sqrt(np.finfo(dtype).eps) / 4], dtype)
    got = np.empty(1, dtype)
    fma_all(1 + small, 1 - small, -np.ones(1, dtype), got)
    e = (1 + small) - 1
    assert got[0] == -(e[0] ** 2) != 0.0


@kernel()
def orders_all(x, y, single, back, double):
    for i in range(x.shape[0]):
        single[i] = ordered_f32(x[i])
        back[i] = from_ordered_f32(single[i])
        double[i] = ordered_f64(y[i])


def test_integers_are_in_the_order_of_their_floats():
    rng = np.random.default_rng(3)
    x = np.sort(rng.normal(size=1000) * 2.0 ** rng.uniform(-60, 60, 1000)).astype(np.float32)
    y = np.sort(rng.normal(size=1000) * 2.0 ** rng.uniform(-600, 600, 1000))
    single, back, double = np.empty(1000, np.int32), np.empty_like(x), np.empty(1000, np.int64)
    orders_all(x, y, single, back, double)
    assert (np.diff(single) >= 0).all()
    assert (np.diff(double) > 0).all()
    np.testing.assert_array_equal(back, x)


def test_sine_and_cosine_keep_their_bound():
    """Below 2 ulp, beside multiples of pi / 2 below 1e-30; in an array."""
    rng = np.random.default_rng(3)
    beside = (np.arange(-200, 200) * (math.pi / 2))[:, None] + [0.0, 1e-9, -1e-15]
    x = np.concatenate([rng.uniform(-10.0, 10.0, 3000), rng.uniform(-1e5, 1e5, 3000)])
    x = np.concatenate([x, beside.ravel(), [0.0, 1e-300, -1e-20]])
    sine, cosine = sincos(x)
    for got, exact in ((sine, np.sin(np.longdouble(x))), (cosine, np.cos(np.longdouble(x)))):
        ulp = np.spacing(np.abs(exact.astype(np.float64)))
        assert np.all(np.abs(got - exact) <= 2.0 * ulp + 1e-30)
    np.testing.assert_array_equal(sincos(x[:6].reshape(2, 3))[0], sine[:6].reshape(2, 3))


def test_sinc_is_one_at_zero():
    x = np.array([0.0, 1e-9, 0.5, -2.0])
    np.testing.assert_allclose(sinc(x), [1.0, 1.0, math.sin(0.5) / 0.5, math.sin(2) / 2])
