"""Counter-based streams: published vectors, a twin in plain integers, distributions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from hiersched.core.randomness import (
    FIRST_FREE_STREAM,
    STREAM_ARRIVAL,
    STREAM_DELAY,
    STREAM_FADING,
    STREAM_POSITION,
    STREAM_ROBOT,
    draw_exponentials,
    draw_normals,
    draw_stream_normals,
    draw_uniforms,
    normal_scratch,
    philox4x32,
    unit_f32,
    unit_f64,
    world_key,
    world_keys,
)

MASK = 2**32 - 1
KEY = np.uint64(0x0123456789ABCDEF)


def philox_twin(counter, key):
    """Philox 4x32-10 as Salmon et al. print it, in Python's integers."""
    c, k = list(counter), list(key)
    for _ in range(10):
        p0, p1 = 0xD2511F53 * c[0], 0xCD9E8D57 * c[2]
        c = [(p1 >> 32) ^ c[1] ^ k[0], p1 & MASK, (p0 >> 32) ^ c[3] ^ k[1], p0 & MASK]
        k = [(k[0] + 0x9E3779B9) & MASK, (k[1] + 0xBB67AE85) & MASK]
    return c


def words(key):
    return int(key) & MASK, int(key) >> 32


def uniforms(key=KEY, stream=STREAM_ARRIVAL, slot=3, lane=0, count=20):
    out = np.empty(count)
    draw_uniforms(np.uint64(key), stream, slot, lane, out)
    return out


def exponentials(key=KEY, slot=3, count=500, scale=1.0):
    out = np.empty(count, np.float32)
    blocks = (count + 3) // 4
    draw_exponentials(key, slot, np.float32(scale), np.zeros((4, blocks), np.uint32), out)
    return out


def normals(key=KEY, slot=3, robots=10, width=5):
    out = np.empty((robots, width), np.float32)
    draw_normals(key, slot, normal_scratch(robots, width), out)
    return out


@pytest.mark.parametrize(
    ("counter", "key", "expected"),
    [
        ("00000000 00000000 00000000 00000000", "00000000 00000000",
         "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
        ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff",
         "408f276d 41c83b0e a20bc7c6 6d5451fd"),
        ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0",
         "d16cfe09 94fdcceb 5001e420 24126ea1"),
    ],
)  # fmt: skip
def test_philox_gives_the_published_words(counter, key, expected):
    """Known answers of Random123 (kat_vectors), for the kernel and for the twin below."""
    counter, key, expected = ([int(w, 16) for w in s.split()] for s in (counter, key, expected))
    got = philox4x32(*np.array(counter, np.uint32), *np.array(key, np.uint32))
    assert [int(word) for word in got] == expected
    assert philox_twin(counter, key) == expected


def test_units_lie_strictly_inside_the_interval():
    least, greatest = np.uint32(0), np.uint32(MASK)
    assert unit_f32(least) == 2.0**-24
    assert unit_f32(greatest) == np.float32(1 - 2.0**-24)
    assert unit_f64(least, least) == 2.0**-53
    assert unit_f64(greatest, greatest) == 1 - 2.0**-53


@given(st.integers(0, 2**64 - 1), st.integers(0, 4), st.integers(0, 10**6), st.integers(0, 3))
def test_uniforms_are_the_twins(key, stream, slot, lane):
    """Counter (lane, user, slot, stream), 26 bits of the first word above 26 of the second."""
    got = uniforms(key, np.uint32(stream), slot, lane, count=3)
    for user in range(3):
        a, b, _, _ = philox_twin((lane, user, slot, stream), words(key))
        assert got[user] == (((a >> 6 << 26) | b >> 6) + 0.5) / 2**52


@pytest.mark.parametrize("count", [1, 35, 500])
def test_exponentials_are_the_twins(count):
    """Word l of block i belongs to element l B + i; the logarithm is good to float32."""
    got = exponentials(slot=11, count=count, scale=2.0)
    blocks = (count + 3) // 4
    table = [philox_twin((i, 0, 11, int(STREAM_FADING)), words(KEY)) for i in range(blocks)]
    flat = np.array(table).T.reshape(-1)[:count]
    expected = -2.0 * np.log(((flat >> 9) + 0.5) / 2**23)
    np.testing.assert_allclose(got, expected, rtol=1e-6, atol=5e-7)


@pytest.mark.parametrize(("robots", "width"), [(1, 5), (3, 5), (10, 5), (3, 4), (7, 6), (1, 2)])
def test_normals_are_the_twins(robots, width):
    """Box and Muller's pairs, laid out as the docstring says."""
    rows = -(-robots * width // 5)
    blocks = (6 * rows + 3) // 4
    table = [philox_twin((i, 0, 5, int(STREAM_ROBOT)), words(KEY)) for i in range(blocks)]
    unit = ((np.array(table).T.reshape(-1) >> 9) + 0.5) / 2**23
    half = 3 * rows
    radius, angle = np.sqrt(-2 * np.log(unit[:half])), 2 * np.pi * unit[half : 2 * half]
    flat = np.concatenate([-radius * np.cos(angle), -radius * np.sin(angle)])
    got = normals(slot=5, robots=robots, width=width).reshape(-1)
    for i, value in enumerate(got):
        row, j = divmod(i, 5)
        assert value == pytest.approx(flat[j * rows + row], abs=2e-5)


def stream_normals(stream=FIRST_FREE_STREAM, slot=5, lane=0, count=50):
    out = np.empty(count, np.float32)
    draw_stream_normals(KEY, np.uint32(stream), slot, lane, out)
    return out


def test_normals_of_a_stream_are_the_twins():
    """One block a user; the cosine of Box and Muller's pair, with the sign of `sincos_turn_f32`."""
    for lane in (0, 3):
        table = [philox_twin((lane, user, 5, 64), words(KEY)) for user in range(50)]
        a, b = (((np.array(table)[:, word] >> 9) + 0.5) / 2**23 for word in (0, 1))
        expected = -np.sqrt(-2.0 * np.log(a)) * np.cos(2.0 * np.pi * b)
        np.testing.assert_allclose(stream_normals(lane=lane), expected, atol=2e-5)
    np.testing.assert_array_equal(stream_normals()[:7], stream_normals(count=7))


def test_normals_of_a_stream_are_normal_and_of_streams_of_their_own():
    drawn = np.concatenate([stream_normals(slot=slot, count=200) for slot in range(50)])
    assert stats.kstest(drawn, "norm").pvalue > 1e-3
    other = np.concatenate([stream_normals(65, slot=slot, count=200) for slot in range(50)])
    assert abs(np.corrcoef(drawn, other)[0, 1]) < 0.04  # four standard errors
    streams = (STREAM_FADING, STREAM_ARRIVAL, STREAM_ROBOT, STREAM_POSITION, STREAM_DELAY)
    assert max(streams) < FIRST_FREE_STREAM


def test_a_user_or_slot_does_not_depend_on_what_is_drawn_beside_it():
    np.testing.assert_array_equal(uniforms(count=20)[:7], uniforms(count=7))
    first = [exponentials(slot=slot) for slot in range(4)]
    again = [exponentials(slot=slot) for slot in (2, 0, 3, 1)]
    for slot, draw in zip((2, 0, 3, 1), again, strict=True):
        np.testing.assert_array_equal(first[slot], draw)


def test_no_two_streams_slots_lanes_or_worlds_share_numbers():
    streams = (STREAM_FADING, STREAM_ARRIVAL, STREAM_ROBOT, STREAM_POSITION, STREAM_DELAY)
    assert len({int(stream) for stream in streams}) == len(streams)
    draws = [
        uniforms(key, stream, slot, lane)
        for key in world_keys("train", 1, 3)
        for stream in streams
        for slot in range(4)
        for lane in range(2)
    ]
    every = np.concatenate(draws)
    assert len(np.unique(every)) == every.size


def test_worlds_of_other_purposes_seeds_and_indices_differ():
    keys = [
        world_key(purpose, seed, index)
        for purpose in ("train", "evaluate", "sweep")
        for seed in range(20)
        for index in range(20)
    ]
    assert len(set(keys)) == len(keys)
    assert world_keys("train", 7, 3).tolist() == [world_key("train", 7, i) for i in range(3)]
    # A change of this number changes every result.
    assert world_key("evaluate", 101) == 0x870CB301EE7DBC6C


def test_uniforms_are_uniform():
    u = np.concatenate([uniforms(slot=slot, count=50) for slot in range(4000)])
    assert stats.kstest(u, "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(u[:-1], u[1:])[0, 1]) < 4 / np.sqrt(u.size)


def test_exponentials_have_the_mean_and_the_quantiles_of_fading():
    """E[h^2] = 2 s^2 for a Rayleigh amplitude of scale s, and h^2 exponential."""
    s = 1.7
    h2 = np.concatenate([exponentials(slot=i, scale=2 * s**2) for i in range(1000)])
    h2 = h2.astype(np.float64)
    mean = 2 * s**2
    assert h2.mean() == pytest.approx(mean, abs=4 * mean / np.sqrt(h2.size))
    assert h2.min() > 0
    for share in (0.01, 0.1, 0.5, 0.9, 0.99, 0.9999):
        below = np.mean(h2 <= -mean * np.log1p(-share))
        assert below == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / h2.size))
    assert stats.kstest(h2[:100_000], "expon", args=(0, mean)).pvalue > 1e-3


def test_fading_is_independent_over_users_blocks_and_slots():
    h2 = np.stack([exponentials(slot=i, count=80) for i in range(5000)])
    correlation = np.corrcoef(h2.T)
    np.fill_diagonal(correlation, 0.0)
    assert np.abs(correlation).max() < 5.0 / np.sqrt(len(h2))
    assert abs(np.corrcoef(h2[:-1].ravel(), h2[1:].ravel())[0, 1]) < 4 / np.sqrt(h2.size)


def test_normals_are_standard_and_independent():
    z = np.stack([normals(slot=i).ravel() for i in range(6000)]).astype(np.float64)
    count = z.size
    assert z.mean() == pytest.approx(0, abs=4 / np.sqrt(count))
    assert z.var() == pytest.approx(1, abs=4 * np.sqrt(2 / count))
    assert (z**3).mean() == pytest.approx(0, abs=4 * np.sqrt(15 / count))
    assert (z**4).mean() == pytest.approx(3, abs=4 * np.sqrt(96 / count))
    assert stats.kstest(z[:, 7], "norm").pvalue > 1e-3
    assert stats.kstest(z.ravel(), "norm").pvalue > 1e-3
    correlation = np.corrcoef(z.T)
    np.fill_diagonal(correlation, 0.0)
    assert np.abs(correlation).max() < 5.0 / np.sqrt(len(z))
