"""Trained networks inside the slot loop: the same bits on every machine and in every batch.

A world is evaluated on its own, so that a batch cannot change its bits. Every sum runs in the
order that is written here, with fused multiply-adds: the vector width of a processor decides which
sums run side by side, never the order within one. Actions differ from those that torch forms of
the same features by the rounding of float32 in another order: less than 1e-6 for 64-64 networks of
usual weights, 2e-6 for some three times as steep.

The work arrays are part of a policy's words: one thread at a time may use them, and what they
hold means nothing between two calls.

Words hold M policies side by side, which differ in their parameters alone: each runs in E / M
worlds, the first one in the first of them. M is 1 but for the populations of a training.
"""

from __future__ import annotations

from itertools import pairwise
from math import prod
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.core.compiled import inner_kernel
from hiersched.core.numerics import F32, copy, exp_f64, fma
from hiersched.policies.features import num_features, observe_world
from hiersched.policies.seams import WEIGH

NETWORKS = ("shared", "mlp", "linear")
"""Networks that have a kernel: small ones applied to every user, flat ones over all users, or one
sum over a user's features."""
_NUM_AGENTS = 2
_ALL_ENVS = 2**62
_LINE = 16
"""Floats of a cache line."""


class SharedWords(NamedTuple):
    """Two networks (agent 0 = URLLC, 1 = eMBB), each applied to every user of its slice.

    A user's inputs are its features, its slice's mean and the other slice's mean. The hidden layers
    have H_1 ... H_L outputs; W is the largest, and some zeros more.
    """

    observe_robots: bool
    observe_demand: bool
    weight_exponent: float  # c of w = exp(c a)
    envs_per_policy: int  # E / M
    first_user: NDArray[np.int64]  # (3,) 0, users of slice 0, users of both
    sizes: NDArray[np.int64]  # (L,) H_1 ... H_L
    table: NDArray[np.float32]  # (M, 2, N, W) hidden layers one below another: bias, then weights
    output_bias: NDArray[np.float32]  # (M, 2, 1)
    output_weight: NDArray[np.float32]  # (M, 2, H_L)
    features: NDArray[np.float32]  # (U, F) work array
    mean: NDArray[np.float32]  # (2, F) work array
    common: NDArray[np.float32]  # (H_1,) work array: what all users of a slice share
    hidden: NDArray[np.float32]  # (L, W) work array


class FlatWords(NamedTuple):
    """Two networks (agent 0 = URLLC, 1 = eMBB) over the features of all users side by side.

    Hidden layers as in `SharedWords`; outputs are as many as the larger slice has users.
    """

    observe_robots: bool
    observe_demand: bool
    weight_exponent: float  # c of w = exp(c a)
    envs_per_policy: int  # E / M
    first_user: NDArray[np.int64]  # (3,) 0, users of slice 0, users of both
    sizes: NDArray[np.int64]  # (L,) H_1 ... H_L
    table: NDArray[np.float32]  # (M, 2, N, W) hidden layers one below another: bias, then weights
    output_bias: NDArray[np.float32]  # (M, 2, n)
    output_weight: NDArray[np.float32]  # (M, 2, H_L, n)
    features: NDArray[np.float32]  # (U, F) work array
    hidden: NDArray[np.float32]  # (L, W) work array
    outputs: NDArray[np.float32]  # (n,) work array


class LinearWords(NamedTuple):
    """Two affine functions (agent 0 = URLLC, 1 = eMBB), each of the features of one user."""

    observe_robots: bool
    observe_demand: bool
    weight_exponent: float  # c of w = exp(c a)
    envs_per_policy: int  # E / M
    first_user: NDArray[np.int64]  # (3,) 0, users of slice 0, users of both
    bias: NDArray[np.float32]  # (M, 2)
    weight: NDArray[np.float32]  # (M, 2, F)
    features: NDArray[np.float32]  # (U, F) work array


NetworkWords = SharedWords | FlatWords | LinearWords


def network_words(
    parameters: NDArray[np.float32],
    network: str,
    hidden: tuple[int, ...],
    *,
    observe_robots: bool,
    observe_demand: bool,
    weight_exponent: float,
    num_urllc: int,
    num_embb: int,
) -> NetworkWords:
    """Lay out trained policies for their kernel, and check their shape (ValueError).

    `parameters` of both actors, shape (2, P), or (M, 2, P) of M policies side by side with a world
    each, float32, are layer after layer biases, then weights (inputs, outputs). `network` is one of
    `NETWORKS`, `hidden` the outputs of the hidden layers, of which ``linear`` has none and the
    others one at least. `observe_robots` and `observe_demand` say whether the features of the
    robots and of what their tasks ask for are observed; `weight_exponent` is c of w = exp(c a). An
    ``mlp`` runs on the numbers of users that it was trained on.
    """
    num_users, count = num_urllc + num_embb, num_features(observe_robots, observe_demand)
    sizes = layer_sizes(network, hidden, count, num_urllc, num_embb)
    outputs = sizes[-1]
    biases, weights = _layers(parameters, sizes)
    fields: dict[str, Any] = {
        "observe_robots": observe_robots,
        "observe_demand": observe_demand,
        "weight_exponent": float(weight_exponent),
        "envs_per_policy": 1 if parameters.ndim == 3 else _ALL_ENVS,
        "first_user": np.array([0, num_urllc, num_users]),
        "features": np.zeros((num_users, count), np.float32),
    }
    if network == "linear":
        bias, weight = biases[0][..., 0].copy(), weights[0][..., 0].copy()
        return LinearWords(**fields, bias=bias, weight=weight)
    fields |= {
        "sizes": np.array(hidden),
        "table": _table(biases[:-1], weights[:-1]),
        "output_bias": biases[-1],
        "hidden": _aligned((len(hidden), max(hidden))),
    }
    if network == "mlp":
        return FlatWords(
            **fields,
            output_weight=weights[-1],
            outputs=np.zeros(outputs, np.float32),
        )
    return SharedWords(
        **fields,
        output_weight=weights[-1][..., 0].copy(),
        mean=np.zeros((_NUM_AGENTS, count), np.float32),
        common=np.zeros(hidden[0], np.float32),
    )


def layer_sizes(
    network: str, hidden: tuple[int, ...], num_features: int, num_urllc: int, num_embb: int
) -> tuple[int, ...]:
    """Return the inputs, the outputs of the hidden layers, and the outputs.

    ValueError if there is no such network, or none of so many hidden layers.
    """
    if network not in NETWORKS:
        raise ValueError(f"network = {network!r}: must be one of {', '.join(NETWORKS)}")
    if (network == "linear") != (len(hidden) == 0):
        wanted = "no layer" if network == "linear" else "one layer or more"
        raise ValueError(f"hidden = {list(hidden)}: must be {wanted} with network = {network!r}")
    if network == "linear":
        return num_features, 1
    if network == "shared":
        return 3 * num_features, *hidden, 1
    return (num_urllc + num_embb) * num_features, *hidden, max(num_urllc, num_embb)


def num_parameters(sizes: tuple[int, ...]) -> int:
    """Biases and weights of all layers of these sizes."""
    return sum((rows + 1) * columns for rows, columns in pairwise(sizes))


def _layers(
    parameters: NDArray[np.float32], sizes: tuple[int, ...]
) -> tuple[list[NDArray[np.float32]], list[NDArray[np.float32]]]:
    """Biases (M, 2, outputs) and weights (M, 2, inputs, outputs) of all layers, copies."""
    wanted = _NUM_AGENTS, num_parameters(sizes)
    if parameters.shape[-2:] != wanted or parameters.ndim > 3:
        raise ValueError(
            f"parameters of shape {parameters.shape}: must be {wanted} for layers of {sizes}"
        )
    parameters = parameters.reshape(-1, *wanted)
    biases, weights, start = [], [], 0
    for rows, columns in pairwise(sizes):
        middle, stop = start + columns, start + (rows + 1) * columns
        biases.append(parameters[..., start:middle].astype(np.float32))
        weight = parameters[..., middle:stop].reshape(-1, _NUM_AGENTS, rows, columns)
        weights.append(weight.astype(np.float32))
        start = stop
    return biases, weights


def _table(
    biases: list[NDArray[np.float32]], weights: list[NDArray[np.float32]]
) -> NDArray[np.float32]:
    """Layers one below another, shape (M, 2, N, W); 0 beyond a layer's outputs."""
    rows = sum(1 + weight.shape[2] for weight in weights)
    width = max(bias.shape[2] for bias in biases)
    table = _aligned((len(biases[0]), _NUM_AGENTS, rows, width))
    row = 0
    for bias, weight in zip(biases, weights, strict=True):
        inputs, outputs = weight.shape[2:]
        table[:, :, row, :outputs] = bias
        table[:, :, row + 1 : row + 1 + inputs, :outputs] = weight
        row += 1 + inputs
    return table


def _aligned(shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Zeros whose rows all begin with a cache line; the last axis is made longer for it.

    Loads that cross lines take a fifth of the time of a product.
    """
    shape = (*shape[:-1], -(-shape[-1] // _LINE) * _LINE)
    room = np.zeros(prod(shape) + _LINE, np.float32)
    skipped = -room.ctypes.data // room.itemsize % _LINE
    return room[skipped : skipped + prod(shape)].reshape(shape)


@WEIGH.kernel(SharedWords)
def weigh_shared(me: Any, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Weigh every user by its slice's network."""
    observe_world(constants, state, env, me.observe_robots, me.observe_demand, me.features)
    for agent in range(_NUM_AGENTS):
        users = me.features[me.first_user[agent] : me.first_user[agent + 1]]
        _mean_user(users, me.mean[agent])
    for agent in range(_NUM_AGENTS):
        _weigh_slice(me, env // me.envs_per_policy, agent, state.weight[env])


@WEIGH.kernel(FlatWords)
def weigh_flat(me: Any, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Weigh the users of each slice by its network, which sees all users."""
    observe_world(constants, state, env, me.observe_robots, me.observe_demand, me.features)
    num_users, num_features = me.features.shape
    policy = env // me.envs_per_policy
    first, last = me.hidden[0, : me.sizes[0]], me.hidden[-1, : me.sizes[-1]]
    for agent in range(_NUM_AGENTS):
        table = me.table[policy, agent]
        copy(table[0], first)
        for user in range(num_users):
            _add_product(me.features[user], table, 1 + user * num_features, first)
        _further_layers(me, table, 1 + num_users * num_features)
        copy(me.output_bias[policy, agent], me.outputs)
        _add_product(last, me.output_weight[policy, agent], 0, me.outputs)
        begin = me.first_user[agent]
        for user in range(begin, me.first_user[agent + 1]):
            state.weight[env, user] = _weight(me.outputs[user - begin], me.weight_exponent)


@WEIGH.kernel(LinearWords)
def weigh_linear(me: Any, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Weigh every user by its slice's sum over its features.

    The sum is one of doubles in the order of the features: products of float32 are exact there, so
    training forms the same bits.
    """
    observe_world(constants, state, env, me.observe_robots, me.observe_demand, me.features)
    policy = env // me.envs_per_policy
    for agent in range(_NUM_AGENTS):
        for user in range(me.first_user[agent], me.first_user[agent + 1]):
            total = np.float64(me.bias[policy, agent])
            for feature in range(me.features.shape[1]):
                value = np.float64(me.features[user, feature])
                total = fma(value, np.float64(me.weight[policy, agent, feature]), total)
            state.weight[env, user] = _weight(F32(total), me.weight_exponent)


@inner_kernel()
def _mean_user(features: Any, mean: Any) -> None:
    """Mean (F,) of the features (n, F) of a slice, in the order of its users."""
    share = F32(1.0) / F32(features.shape[0])
    for feature in range(mean.shape[0]):
        mean[feature] = F32(0.0)
    for user in range(features.shape[0]):
        for feature in range(mean.shape[0]):
            mean[feature] = fma(features[user, feature], share, mean[feature])


@inner_kernel()
def _weigh_slice(me: Any, policy: int, agent: int, weight: Any) -> None:
    """Fill the weights of a slice's users. First layer: bias, own mean, other mean, user."""
    num_features = me.features.shape[1]
    table, common = me.table[policy, agent], me.common
    first, last = me.hidden[0, : me.sizes[0]], me.hidden[-1, : me.sizes[-1]]
    copy(table[0], common)
    _add_product(me.mean[agent], table, 1 + num_features, common)
    _add_product(me.mean[1 - agent], table, 1 + 2 * num_features, common)
    for user in range(me.first_user[agent], me.first_user[agent + 1]):
        copy(common, first)
        _add_product(me.features[user], table, 1, first)
        _further_layers(me, table, 1 + 3 * num_features)
        output = _dot(last, me.output_weight[policy, agent]) + me.output_bias[policy, agent, 0]
        weight[user] = _weight(output, me.weight_exponent)


@inner_kernel()
def _further_layers(me: Any, table: Any, row: int) -> None:
    """Evaluate the hidden layers of one input from the first one's affine part on.

    `row` is where the second layer begins in the table.
    """
    seen = me.hidden[0, : me.sizes[0]]
    _relu(seen)
    for layer in range(1, me.sizes.shape[0]):
        outputs = me.hidden[layer, : me.sizes[layer]]
        copy(table[row], outputs)
        _add_product(seen, table, row + 1, outputs)
        _relu(outputs)
        row += 1 + seen.shape[0]
        seen = outputs


@njit(inline="always")
def _relu(values: Any) -> None:
    """Turn what has the sign bit into 0. A comparison would become a slow masked store."""
    for j in range(values.shape[0]):
        bits = np.float32(values[j]).view(np.int32)
        values[j] = np.int32(bits & ~(bits >> np.int32(31))).view(np.float32)


@inner_kernel()
def _add_product(values: Any, table: Any, row: int, out: Any) -> None:
    """out[j] += sum over i of values[i] table[row + i, j], in the order of i.

    Eight rows at a time, so that a sum stays in a register for eight terms.
    """
    whole = values.shape[0] - values.shape[0] % 8
    for i in range(0, whole, 8):
        a, b, c, d = values[i], values[i + 1], values[i + 2], values[i + 3]
        e, f, g, h = values[i + 4], values[i + 5], values[i + 6], values[i + 7]
        first = row + i
        for j in range(out.shape[0]):
            total = fma(a, table[first, j], out[j])
            total = fma(b, table[first + 1, j], total)
            total = fma(c, table[first + 2, j], total)
            total = fma(d, table[first + 3, j], total)
            total = fma(e, table[first + 4, j], total)
            total = fma(f, table[first + 5, j], total)
            total = fma(g, table[first + 6, j], total)
            out[j] = fma(h, table[first + 7, j], total)
    for i in range(whole, values.shape[0]):
        value = values[i]
        for j in range(out.shape[0]):
            out[j] = fma(value, table[row + i, j], out[j])


@inner_kernel()
def _dot(x: Any, y: Any) -> Any:
    """Sum of products as eight interleaved sums s_k over x[k], x[k + 8], ...

    They end as ((s0 + s4) + (s2 + s6)) + ((s1 + s5) + (s3 + s7)), plus the sum of what is left of
    eights. One running sum would wait for itself at every term.
    """
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = F32(0.0)
    whole = x.shape[0] - x.shape[0] % 8
    for i in range(0, whole, 8):
        s0 = fma(x[i], y[i], s0)
        s1 = fma(x[i + 1], y[i + 1], s1)
        s2 = fma(x[i + 2], y[i + 2], s2)
        s3 = fma(x[i + 3], y[i + 3], s3)
        s4 = fma(x[i + 4], y[i + 4], s4)
        s5 = fma(x[i + 5], y[i + 5], s5)
        s6 = fma(x[i + 6], y[i + 6], s6)
        s7 = fma(x[i + 7], y[i + 7], s7)
    rest = F32(0.0)
    for i in range(whole, x.shape[0]):
        rest = fma(x[i], y[i], rest)
    return ((s0 + s4) + (s2 + s6)) + ((s1 + s5) + (s3 + s7)) + rest


@njit(inline="always")
def _weight(output: Any, weight_exponent: float) -> float:
    """Weight exp(c a) of the action a = tanh(output); both are float32, as the log has them."""
    x = min(20.0, max(-20.0, np.float64(output)))  # beyond, tanh is 1 to the last bit
    action = np.float64(F32(1.0 - 2.0 / (exp_f64(2.0 * x) + 1.0)))
    return np.float64(F32(exp_f64(weight_exponent * action)))
