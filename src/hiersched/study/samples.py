"""From runs of one policy to a sample: one value a world, or policies crossed with worlds."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
import pandas as pd
from numpy.typing import NDArray


def sample_of(
    runs: pd.DataFrame, name: str, worlds: Sequence[int] | None = None
) -> NDArray[np.float64]:
    """Return a measure of one policy under one condition.

    Runs are one a row; without a column `policy_seed`, and where that is empty, they are of a rule.
    The sample of a rule has shape (W,), of a learned policy (P, W): training seeds in the order of
    the rows, and so `worlds` unless their order is given. ValueError if not every policy ran once
    in every world.
    """
    worlds = list(dict.fromkeys(runs["seed"])) if worlds is None else worlds
    learned = is_learned(runs)
    trained = runs["policy_seed"].tolist() if learned else [0] * len(runs)
    policies = list(dict.fromkeys(trained))
    pairs = dict(zip(zip(trained, runs["seed"], strict=True), runs[name], strict=True))
    wanted = list(product(policies, worlds))
    if len(runs) != len(wanted) or set(pairs) != set(wanted):
        raise ValueError(
            f"{len(runs)} runs of {len(policies)} policies in {len(worlds)} worlds: must be each "
            "policy once in each world"
        )
    values = np.array([pairs[pair] for pair in wanted], dtype=np.float64)
    return values.reshape(len(policies), len(worlds)) if learned else values


def is_learned(runs: pd.DataFrame) -> bool:
    """Whether runs of one policy are of trained ones."""
    return "policy_seed" in runs and bool(runs["policy_seed"].notna().all()) and len(runs) > 0


def counts(runs: pd.DataFrame) -> dict[str, int]:
    """Return columns of a table: worlds, and training seeds, 0 of a rule."""
    trained = runs["policy_seed"].nunique() if is_learned(runs) else 0
    return {"seeds": runs["seed"].nunique(), "training_seeds": int(trained)}


def paired(
    own: pd.DataFrame, other: pd.DataFrame, name: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return samples of two policies in the same worlds, by world and training seed.

    Of two learned policies the k-th training seeds are paired, as many as both have. ValueError if
    they did not run in the same worlds.
    """
    worlds = list(dict.fromkeys(own["seed"]))
    if set(worlds) != set(other["seed"]):
        raise ValueError(
            f"{own['policy'].iloc[0]} and {other['policy'].iloc[0]} did not run in the same worlds"
        )
    a, b = (sample_of(runs, name, worlds) for runs in (own, other))
    if a.ndim == b.ndim == 2:
        common = min(len(a), len(b))
        a, b = a[:common], b[:common]
    return a, b
