"""Counter-based streams: what no policy can influence depends on (world, stream, slot, user).

Two policies that run in the same world meet the same fading, arrival uniforms, slip and noise,
whatever they decide, and any slot can be drawn again on its own. The generator is Philox 4x32-10
(Salmon et al., SC 2011), whose published test vectors the tests hold.
"""

from __future__ import annotations

import hashlib
from typing import NamedTuple

import numpy as np
from numba import njit, uint32, uint64
from numpy.typing import NDArray

from hiersched.core.compiled import kernel
from hiersched.core.numerics import F32, ln_f32, sincos_turn_f32

STREAM_FADING = np.uint32(0)
STREAM_ARRIVAL = np.uint32(1)
STREAM_ROBOT = np.uint32(2)
STREAM_POSITION = np.uint32(3)
STREAM_DELAY = np.uint32(4)
STREAM_REFERENCE = np.uint32(5)
FIRST_FREE_STREAM = 64
"""Streams below it are those of this package; a plug-in takes numbers from here on."""

_M0 = np.uint64(0xD2511F53)
_M1 = np.uint64(0xCD9E8D57)
_W0 = np.uint32(0x9E3779B9)
_W1 = np.uint32(0xBB67AE85)
_S32 = np.uint64(32)
_VECTOR = 16


def world_key(purpose: str, seed: int, index: int = 0) -> int:
    """64-bit key of a world; those of other purposes, seeds or indices are independent.

    `purpose` is what it is for (``"train"``, ``"evaluate"``), `index` the environment in a run.
    """
    digest = hashlib.blake2b(f"{purpose}/{seed}/{index}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little")


def world_keys(purpose: str, seed: int, count: int) -> NDArray[np.uint64]:
    """Keys of the worlds 0 … count-1 of a run, shape (count,)."""
    return np.array([world_key(purpose, seed, index) for index in range(count)], dtype=np.uint64)


def train_worlds(
    seed: int, first: int, count: int, per_round: int, worlds_per_round: int
) -> NDArray[np.uint64]:
    """Keys of the worlds of a training's episodes from `first` on, shape (count,).

    A round has `per_round` episodes. They take turns in its `worlds_per_round` worlds, new ones in
    every round; if these are as many, episode j has world j.
    """
    rounds, places = np.divmod(np.arange(first, first + count), per_round)
    worlds = rounds * worlds_per_round + places % worlds_per_round
    return np.array([world_key("train", seed, int(j)) for j in worlds], dtype=np.uint64)


@njit(inline="always")
def philox4x32(
    c0: np.uint32, c1: np.uint32, c2: np.uint32, c3: np.uint32, k0: np.uint32, k1: np.uint32
) -> tuple[np.uint32, np.uint32, np.uint32, np.uint32]:
    """Four random 32-bit words of a 128-bit counter and a 64-bit key (ten rounds)."""
    for _ in range(10):
        p0 = _M0 * uint64(c0)
        p1 = _M1 * uint64(c2)
        c0, c1, c2, c3 = (
            uint32(p1 >> _S32) ^ c1 ^ k0,
            uint32(p1),
            uint32(p0 >> _S32) ^ c3 ^ k1,
            uint32(p0),
        )
        k0 = uint32(k0 + _W0)
        k1 = uint32(k1 + _W1)
    return c0, c1, c2, c3


@njit(inline="always")
def unit_f32(word: np.uint32) -> np.float32:
    """Uniform float32 strictly between 0 and 1 from one word (23 bits, exact)."""
    return (F32(np.int32(word >> np.uint32(9))) + F32(0.5)) * F32(2.0**-23)


@njit(inline="always")
def unit_f64(high: np.uint32, low: np.uint32) -> float:
    """Uniform double strictly between 0 and 1 from two words (52 bits, exact)."""
    bits = (np.int64(high >> np.uint32(6)) << np.int64(26)) | np.int64(low >> np.uint32(6))
    return (np.float64(bits) + 0.5) * 2.0**-52


@kernel()
def draw_uniforms(
    key: np.uint64, stream: np.uint32, slot: int, lane: int, out: NDArray[np.float64]
) -> None:
    """Fill `out` (n,) with uniforms of (world, stream, slot, lane): element i is user i's."""
    k0 = uint32(key)
    k1 = uint32(key >> _S32)
    for i in range(out.shape[0]):
        a, b, _, _ = philox4x32(uint32(lane), uint32(i), uint32(slot), stream, k0, k1)
        out[i] = unit_f64(a, b)


@kernel()
def draw_stream_normals(
    key: np.uint64, stream: np.uint32, slot: int, lane: int, out: NDArray[np.float32]
) -> None:
    """Fill `out` (n,) with standard normals of (world, stream, slot, lane): element i is user i's.

    Box-Muller in float32, for streams of plug-ins: no work arrays, half as fast as `draw_normals`.
    """
    k0 = uint32(key)
    k1 = uint32(key >> _S32)
    for i in range(out.shape[0]):
        a, b, _, _ = philox4x32(uint32(lane), uint32(i), uint32(slot), stream, k0, k1)
        _, cosine = sincos_turn_f32(unit_f32(b))
        out[i] = np.sqrt(F32(-2.0) * ln_f32(unit_f32(a))) * cosine


@njit(inline="always")
def _draw_words(key: np.uint64, stream: np.uint32, slot: int, words: NDArray[np.uint32]) -> None:
    """Fill `words` (4, B) with B blocks of (world, stream, slot), each four words below another.

    One array for all lanes: the compiler sees that they do not overlap.
    """
    k0 = uint32(key)
    k1 = uint32(key >> _S32)
    for i in range(words.shape[1]):
        a, b, c, d = philox4x32(uint32(i), uint32(0), uint32(slot), stream, k0, k1)
        words[0, i] = a
        words[1, i] = b
        words[2, i] = c
        words[3, i] = d


@kernel()
def draw_exponentials(
    key: np.uint64,
    slot: int,
    scale: np.float32,
    words: NDArray[np.uint32],
    out: NDArray[np.float32],
) -> None:
    """Fill `out` (N,) with scale-times-unit exponentials of the fading stream.

    One Philox block serves four elements: word `lane` of block `i` belongs to element lane*B + i,
    with B = ceil(N/4) blocks. `words` (4, B) is scratch.
    """
    _draw_words(key, STREAM_FADING, slot, words)
    flat = words.reshape(-1)
    for i in range(out.shape[0]):
        out[i] = -ln_f32(unit_f32(flat[i])) * scale


class NormalScratch(NamedTuple):
    """Work arrays of `draw_normals`, padded to whole vectors."""

    words: NDArray[np.uint32]
    flat: NDArray[np.uint32]
    normals: NDArray[np.float32]


def normal_scratch(num_robots: int, num_normals: int) -> NormalScratch:
    """Work arrays for `num_normals` normals of each of `num_robots` robots."""
    rows = -(-num_robots * num_normals // 5)
    blocks = -(-6 * rows // 4)
    half = -(-3 * rows // _VECTOR) * _VECTOR
    return NormalScratch(
        words=np.zeros((4, -(-blocks // _VECTOR) * _VECTOR), np.uint32),
        flat=np.zeros(4 * blocks + half, np.uint32),
        normals=np.zeros((3, half), np.float32),
    )


@kernel()
def draw_normals(
    key: np.uint64, slot: int, scratch: NormalScratch, out: NDArray[np.float32]
) -> None:
    """Fill `out` (R, W) with standard normals of the robot stream (Box-Muller in float32).

    They lie in N = ceil(R W / 5) rows of five: normal j of row r is element j*N + r of 6 N normals;
    elements i and 3 N + i come from words i and 3 N + i, word `lane` of block b being number
    lane*B + b of B = ceil(6 N / 4) blocks. The loops are short, so that each becomes vector
    instructions, and run over whole vectors: what lies beyond is not used.
    """
    words, flat, normals, values = scratch.words, scratch.flat, scratch.normals, out.reshape(-1)
    _draw_words(key, STREAM_ROBOT, slot, words)
    rows = (values.shape[0] + 4) // 5
    blocks = (6 * rows + 3) // 4
    for lane in range(4):
        for i in range(blocks):
            flat[lane * blocks + i] = words[lane, i]
    for i in range(normals.shape[1]):
        normals[0, i] = np.sqrt(F32(-2.0) * ln_f32(unit_f32(flat[i])))
    for i in range(normals.shape[1]):
        sine, cosine = sincos_turn_f32(unit_f32(flat[3 * rows + i]))
        normals[1, i] = normals[0, i] * cosine
        normals[2, i] = normals[0, i] * sine
    for row in range(rows):
        for j in range(5):
            if 5 * row + j < values.shape[0]:
                values[5 * row + j] = normals[1 + j // 3, j % 3 * rows + row]
