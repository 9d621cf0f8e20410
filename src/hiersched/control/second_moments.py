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
from scipy.sparse import csr_array
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


LONGEST_COUNTED = 1000
"""Samples: loops with such delays are not followed, and their transitions take no memory."""
LARGEST, LONGEST = 1_400_000, 100
"""Entries of all second moments, and of a lifted state, beyond which they are not followed: it
would take minutes."""


class Chain(NamedTuple):
    """Loops that follow each other: the delay and the entry of the gains in force in each state."""

    delays: npt.NDArray[np.int64]  # (S,) samples
    entries: npt.NDArray[np.int64]  # (S,)
    transition: FloatArray  # (S, S), rows add up to 1


def chain_of_counts(
    counts: npt.ArrayLike,
    *,
    hold_samples: SupportsIndex = 0,
    max_entry: SupportsIndex | None = None,
) -> Chain:
    """Return the chain of delays 0..D that followed each other so often, counts (D + 1, D + 1).

    `hold_samples`: for how long a gain for a longer delay is kept (`hold_step`), which makes more
    states of each delay. `max_entry`: the longest delay that has a gain, which is in force at
    longer ones too; every delay has one unless given. Delays that never occurred are left out, and
    so are those after which none followed, such as the last of a run. ValueError if counts are
    negative or no delay recurs.
    """
    counted = as_matrix("counts", counts)
    if counted.shape[0] != counted.shape[1] or (counted < 0.0).any():
        raise ValueError("counts must be square and at least 0")
    hold = as_samples("hold_samples", hold_samples)
    last = len(counted) - 1 if max_entry is None else as_samples("max_entry", max_entry)
    while len(ends := np.flatnonzero(counted.any(axis=0) & ~counted.any(axis=1))):
        counted[:, ends] = 0.0
    if not counted.any():
        raise ValueError("counts have no delay that recurs")

    def entered(delay: int, entry: int = 0, kept: int = 0) -> tuple[int, int, int]:
        """Return a state: delay, entry in force, samples for which that has to be kept."""
        held, remaining = hold_step(entry, kept, min(delay, last), hold)
        return delay, int(held), int(remaining)

    waiting = [entered(int(delay)) for delay in np.flatnonzero(counted.any(axis=1))]
    places = {state: place for place, state in enumerate(waiting)}
    arrows: list[tuple[int, int, float]] = []
    while waiting:
        state = waiting.pop()
        row = counted[state[0]]
        for delay in np.flatnonzero(row).tolist():
            after = entered(delay, state[1], state[2])
            if after not in places:
                places[after] = len(places)
                waiting.append(after)
            arrows.append((places[state], places[after], row[delay] / row.sum()))
    transition = np.zeros((len(places), len(places)))
    for start, end, share in arrows:
        transition[start, end] += share
    delays, entries, _ = np.array(list(places), dtype=np.int64).T
    return Chain(delays, entries, transition)


def count_transitions(delays: npt.ArrayLike) -> FloatArray:
    """Count how often a delay followed another in sequences of samples, shape (samples, runs).

    Where a delay is beyond `LONGEST_COUNTED` nothing is counted: shape (1, 1).
    """
    steps = np.array(delays, dtype=np.int64)
    pairs = steps[:-1].ravel(), steps[1:].ravel()
    return transition_counts(*pairs, np.ones(pairs[0].size))


def transition_counts(start: npt.ArrayLike, end: npt.ArrayLike, times: npt.ArrayLike) -> FloatArray:
    """Return the matrix of transitions that were seen so many times, as `count_transitions`."""
    places = np.array([start, end], dtype=np.int64)
    longest = int(places.max(initial=0))
    if longest > LONGEST_COUNTED:
        return np.zeros((1, 1))
    counts = np.zeros((longest + 1, longest + 1))
    np.add.at(counts, (places[0], places[1]), times)
    return counts


def second_moment_growth(
    A: npt.ArrayLike,
    B: npt.ArrayLike,
    gains: npt.ArrayLike,
    chain: Chain,
    input_gains: npt.ArrayLike | None = None,
    *,
    A_d: npt.ArrayLike | None = None,
) -> float:
    """Return by which factor a sample the second moment of a loop grows, below 1: it shrinks.

    The loop is x(k+1) = A x(k) + B u(k), u(k) = -K_e x(k-d) - sum_i H_{e,i} u(k-1-i), with the
    delay d and the entry e of the chain's state; `gains` (entries, m, n), `input_gains` (entries,
    inputs, m, m), the newest first. With `A_d` (n, n) it is that of a split plant, x(k+1) =
    (A - B K_e) x(k) + A_d x(k-d), without such inputs. Parts of the plant that do not act on each
    other count each by itself: the factor is that of the part that grows most. ValueError where
    there are too many states or delays are too long for it to be found.
    """
    A, B, _ = as_plant(A, B, np.array(gains)[0])
    tables = np.array(gains, dtype=np.float64)
    m = B.shape[1]
    late = None if A_d is None else as_matrix("A_d", A_d, A.shape)
    memory = np.zeros((len(tables), 0, m, m)) if input_gains is None else np.array(input_gains)
    if not memory.any():
        memory = memory[:, :0]
    loops = []
    acting = A if late is None else np.abs(A) + np.abs(late)
    for states, inputs in _parts(acting, B, tables, memory):
        own = np.ix_(range(len(tables)), inputs, states)
        past = memory[:, :, inputs][:, :, :, inputs]
        among = np.ix_(states, states)
        plant = A[among], B[np.ix_(states, inputs)]
        of_part = None if late is None else late[among]
        loops.append(_new_values(*plant, tables[own], past, chain, of_part))
    return max(_growth(rows, chain) for rows in loops)


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


def _new_values(
    A: FloatArray,
    B: FloatArray,
    gains: FloatArray,
    memory: FloatArray,
    chain: Chain,
    A_d: FloatArray | None,
) -> FloatArray:
    """Return the new block of each loop, shape (S, b, N), on blocks that move down by a sample.

    Block j is x(k-j), and u(k-1-j) below it where inputs are remembered.
    """
    n, m = B.shape
    remembered = memory.shape[1]
    block = n + (m if remembered else 0)
    size = block * max(int(chain.delays.max()) + 1, remembered)
    count = len(chain.delays)
    if count * size**2 > LARGEST or size > LONGEST:
        raise ValueError(
            f"the growth of {count} second moments of {size} x {size} is not followed: at most "
            f"{LONGEST} x {LONGEST}, and {LARGEST} entries in all"
        )
    rows = np.zeros((count, block, size))
    for place, (delay, entry) in enumerate(zip(chain.delays, chain.entries, strict=True)):
        u = np.zeros((m, size))
        measured = slice(block * delay, block * delay + n)
        u[:, measured if A_d is None else slice(n)] = -gains[entry]
        for back in range(remembered):
            u[:, block * back + n : block * (back + 1)] = -memory[entry, back]
        rows[place, :n] = B @ u
        rows[place, :n, :n] += A
        if A_d is not None:
            rows[place, :n, measured] += A_d
        rows[place, n:] = u[: block - n]
    return rows


def _growth(rows: FloatArray, chain: Chain) -> float:
    """Return the spectral radius of Q_j <- sum_i p_ij M_i Q_i M_i^T, of loops with these rows."""
    count, block, size = rows.shape
    shape, length = (count, size, size), count * size * size
    columns = np.ascontiguousarray(rows.transpose(0, 2, 1))
    arrive, after = csr_array(chain.transition.T), np.empty(shape)

    def step(values: FloatArray) -> FloatArray:
        moments = values.reshape(shape)
        left = rows @ moments
        after[:, block:, block:] = moments[:, :-block, :-block]
        after[:, :block, block:] = left[:, :, :-block]
        after[:, block:, :block] = (moments @ columns)[:, :-block]
        after[:, :block, :block] = left @ columns
        return np.asarray((arrive @ after.reshape(count, -1)).ravel())

    if length <= LARGEST_DENSE:
        matrix = np.stack([step(unit) for unit in np.eye(length)], axis=1)
        return float(np.abs(np.linalg.eigvals(matrix)).max())
    # A map that keeps moments definite has its spectral radius as an eigenvalue. Shifted by about
    # as much it is alone at the edge, also where delays are periodic and others are as large.
    moments, shift = np.broadcast_to(np.eye(size), shape).ravel() / count, 0.0
    for _ in range(POWER_STEPS):
        moments = step(moments)
        shift = float(np.linalg.norm(moments))
        moments = moments / shift
    operator = LinearOperator(
        (length, length), matvec=lambda values: step(values) + shift * values, dtype=np.float64
    )
    try:
        largest = eigs(
            operator, k=1, which="LR", v0=moments, ncv=24, tol=1e-6, return_eigenvectors=False
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
