"""Growth of a loop's second moment over a Markov chain of delays.

Where the delay of each sample depends on that of the one before, the loop is a Markov jump linear
system: its second moment shrinks in the mean if the coupled recursion Q_j <- sum_i p_ij M_i Q_i
M_i^T, with M_i the loop at the delay i, has a spectral radius below 1 (Costa, Fragoso, Marques,
"Discrete-Time Markov Jump Linear Systems", 2005, theorem 3.9). That is exact for the chain, and the
linear model; delays drawn independently with the same frequencies may tell another story.
"""

from __future__ import annotations

from typing import NamedTuple, SupportsIndex

import numpy as np
import numpy.typing as npt
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigs

from hiersched.control.checks import FloatArray, as_matrix, as_plant, as_samples
from hiersched.control.hysteresis import hold_step

LARGEST_DENSE = 400
"""Entries of all second moments up to which their recursion is one matrix."""
POWER_STEPS = 50
"""Steps by which the shift of a larger one is found."""
UNCOUPLED = 1e-7
"""Entries below this share of the largest one are no coupling: they are rounding of a solver."""


class Chain(NamedTuple):
    """Loops that follow each other: the delay and the entry of the gains in force in each state."""

    delays: npt.NDArray[np.int64]  # (S,) samples
    entries: npt.NDArray[np.int64]  # (S,)
    transition: FloatArray  # (S, S), rows add up to 1


def chain_of_counts(counts: npt.ArrayLike, *, hold_samples: SupportsIndex = 0) -> Chain:
    """Return the chain of delays 0..T that followed each other so often, counts (T + 1, T + 1).

    `hold_samples`: for how long a gain for a longer delay is kept (`hold_step`), which makes more
    states of each delay. Delays that never occurred are left out; one after which nothing was seen
    stays. ValueError if counts are negative or all are 0.
    """
    counted = as_matrix("counts", counts)
    if counted.shape[0] != counted.shape[1] or (counted < 0.0).any() or not counted.any():
        raise ValueError("counts must be square, at least 0, and not all 0")
    seen = np.flatnonzero(counted.sum(axis=0) + counted.sum(axis=1))
    follow = {int(i): np.flatnonzero(counted[i]).tolist() or [int(i)] for i in seen}
    hold = as_samples("hold_samples", hold_samples)

    def entered(delay: int, entry: int = 0, kept: int = 0) -> tuple[int, int, int]:
        """Return a state: delay, entry in force, samples for which that has to be kept."""
        held, remaining = hold_step(entry, kept, delay, hold)
        return delay, int(held), int(remaining)

    waiting = [entered(int(delay)) for delay in seen]
    places = {state: place for place, state in enumerate(waiting)}
    arrows: list[tuple[int, int, float]] = []
    while waiting:
        state = waiting.pop()
        total = counted[state[0]].sum()
        for delay in follow[state[0]]:
            after = entered(delay, state[1], state[2])
            if after not in places:
                places[after] = len(places)
                waiting.append(after)
            share = counted[state[0], delay] / total if total else 1.0
            arrows.append((places[state], places[after], share))
    transition = np.zeros((len(places), len(places)))
    for start, end, share in arrows:
        transition[start, end] += share
    delays, entries, _ = np.array(list(places), dtype=np.int64).T
    return Chain(delays, entries, transition)


def count_transitions(delays: npt.ArrayLike, max_delay_steps: SupportsIndex) -> FloatArray:
    """Count how often a delay followed another in sequences (samples, runs), capped at T_max."""
    steps = np.minimum(np.array(delays, dtype=np.int64), as_samples("T_max", max_delay_steps))
    counts = np.zeros((as_samples("T_max", max_delay_steps) + 1,) * 2)
    np.add.at(counts, (steps[:-1].ravel(), steps[1:].ravel()), 1.0)
    return counts


def second_moment_growth(
    A: npt.ArrayLike,
    B: npt.ArrayLike,
    gains: npt.ArrayLike,
    chain: Chain,
    input_gains: npt.ArrayLike | None = None,
) -> float:
    """Return by which factor a sample the second moment of a loop grows, below 1: it shrinks.

    The loop is x(k+1) = A x(k) + B u(k), u(k) = -K_e x(k-d) - sum_i H_{e,i} u(k-1-i), with the
    delay d and the entry e of the chain's state; `gains` (entries, m, n), `input_gains` (entries,
    inputs, m, m), the newest first. Parts of the plant that do not act on each other count each by
    itself: the factor is that of the part that grows most.
    """
    A, B, _ = as_plant(A, B, np.array(gains)[0])
    tables = np.array(gains, dtype=np.float64)
    m = B.shape[1]
    memory = np.zeros((len(tables), 0, m, m)) if input_gains is None else np.array(input_gains)
    if not memory.any():
        memory = memory[:, :0]
    grown = 0.0
    for states, inputs in _parts(A, B, tables, memory):
        own = np.ix_(range(len(tables)), inputs, states)
        past = memory[:, :, inputs][:, :, :, inputs]
        modes = [
            _lifted(A[np.ix_(states, states)], B[np.ix_(states, inputs)], tables[own], past, d, e,
                    int(chain.delays.max()))
            for d, e in zip(chain.delays.tolist(), chain.entries.tolist(), strict=True)
        ]  # fmt: skip
        grown = max(grown, _growth(np.stack(modes), chain.transition))
    return grown


def _parts(
    A: FloatArray, B: FloatArray, gains: FloatArray, memory: FloatArray
) -> list[tuple[list[int], list[int]]]:
    """Return states and inputs of the parts of a loop that do not act on each other."""
    n, m = B.shape
    acts = np.zeros((n + m, n + m), dtype=np.bool_)
    for rows, columns, matrix in (
        (slice(0, n), slice(0, n), A),
        (slice(0, n), slice(n, None), B),
        (slice(n, None), slice(0, n), np.abs(gains).max(axis=0)),
        (slice(n, None), slice(n, None), np.abs(memory).max(axis=(0, 1), initial=0.0)),
    ):
        size = np.abs(matrix)
        acts[rows, columns] = size > UNCOUPLED * max(float(size.max()), 1e-300)
    count, part = connected_components(acts, directed=False)
    found = [np.flatnonzero(part == number) for number in range(count)]
    return [([*own[own < n]], [*(own[own >= n] - n)]) for own in found if (own < n).any()]


def _lifted(
    A: FloatArray,
    B: FloatArray,
    gains: FloatArray,
    memory: FloatArray,
    delay: int,
    entry: int,
    longest: int,
) -> FloatArray:
    """Return the loop on [x(k), ..., x(k-T), u(k-1), ...]."""
    n, m = B.shape
    states, size = n * (longest + 1), n * (longest + 1) + m * memory.shape[1]
    u = np.zeros((m, size))
    u[:, n * delay : n * (delay + 1)] = -gains[entry]
    for place in range(memory.shape[1]):
        u[:, states + m * place : states + m * (place + 1)] = -memory[entry, place]
    lifted = np.zeros((size, size))
    lifted[n:states, : states - n] = np.eye(states - n)
    lifted[:n, :n] = A
    lifted[:n] += B @ u
    if size > states:
        lifted[states : states + m] = u
        lifted[states + m :, states : size - m] = np.eye(size - states - m)
    return lifted


def _growth(modes: FloatArray, transition: FloatArray) -> float:
    """Return the spectral radius of Q_j <- sum_i p_ij M_i Q_i M_i^T; modes (S, N, N)."""
    count, size, _ = modes.shape
    shape = count, size, size

    def step(moments: FloatArray) -> FloatArray:
        moved = modes @ moments.reshape(shape) @ modes.transpose(0, 2, 1)
        return np.asarray(np.tensordot(transition, moved, axes=([0], [0])).ravel())

    length = count * size * size
    if length <= LARGEST_DENSE:
        matrix = np.stack([step(unit) for unit in np.eye(length)], axis=1)
        return float(np.abs(np.linalg.eigvals(matrix)).max())
    # A map that keeps moments definite has its spectral radius as an eigenvalue. Shifted by about
    # as much it is alone at the edge, also where delays are periodic and others are as large.
    moments = np.broadcast_to(np.eye(size), shape).ravel() / count
    shift = 0.0
    for _ in range(POWER_STEPS):
        moments = step(moments)
        shift = float(np.linalg.norm(moments))
        moments = moments / shift
    operator = LinearOperator(
        (length, length), matvec=lambda values: step(values) + shift * values, dtype=np.float64
    )
    try:
        largest = eigs(
            operator, k=1, which="LR", v0=moments, tol=1e-7, maxiter=300, return_eigenvectors=False
        )
    except ArpackNoConvergence as error:
        raise ValueError("the growth of the second moment was not found") from error
    return float(largest[0].real) - shift


def simulate_chain(
    A: npt.ArrayLike, B: npt.ArrayLike, gains: npt.ArrayLike, chain: Chain, *, samples: int,
    runs: int, seed: int = 0,
) -> FloatArray:  # fmt: skip
    """Simulate x(k+1) = A x(k) - B K_e x(k-d) over a chain from x = 1: mean square (samples,)."""
    A, B, _ = as_plant(A, B, np.array(gains)[0])
    tables, random = np.array(gains, dtype=np.float64), np.random.default_rng(seed)
    longest = int(chain.delays.max())
    past = np.ones((longest + 1, runs, len(A)))  # the newest first
    state = np.zeros(runs, np.int64)
    until = chain.transition.cumsum(axis=1)
    means = []
    for _ in range(samples):
        late = past[chain.delays[state], np.arange(runs)]
        u = -np.einsum("rij,rj->ri", tables[chain.entries[state]], late)
        past = np.concatenate([(past[0] @ A.T + u @ B.T)[None], past[:-1]])
        means.append(float((past[0] ** 2).sum(axis=1).mean()))
        draw = random.random(runs)
        state = np.minimum((until[state] < draw[:, None]).sum(axis=1), len(until) - 1)
    return np.array(means)
