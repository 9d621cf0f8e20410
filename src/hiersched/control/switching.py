"""Which switches between the gains of a schedule are proven harmless, and by what.

A certificate holds while one gain stays in force. When the gain follows the delay, the loop is a
switched one: its modes are all pairs of a gain and a delay that this gain covers.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
import numpy.typing as npt

from hiersched.control.checks import FloatArray
from hiersched.control.common_functional import common_functional
from hiersched.control.delayed_plant import DelayedPlant
from hiersched.control.functional import (
    contraction,
    extended,
    jump,
    krasovskii_form,
    lifted_modes,
    worst_period,
)
from hiersched.control.gain_schedule import GainSchedule
from hiersched.control.krasovskii import analyse_krasovskii

logger = logging.getLogger(__name__)

LONGEST_HOLD = 10**8
"""A hold of more samples than this counts as none."""

MOST_COMMON = 10
"""Levels for which one functional is sought: the inequalities grow with their number cubed."""

PERIODS = (1, 2, 3, 4, 6, 8, 10, 12, 16, 24)
"""Samples in either mode among which a diverging periodic switching is sought."""


@dataclass(frozen=True, kw_only=True)
class Switch:
    """What is known of switching back and forth between two gains of a schedule."""

    shorter: int  # longest delay T in samples that either gain covers
    longer: int
    # "common": a common functional, any switching. "hold": two functionals and a hold. "none": no
    # functional was found for one of the two gains.
    covered_by: Literal["common", "hold", "none"]
    hold_samples: int | None  # least N of `hold_step` proven; 0 for "common", None for "none"
    contraction: float = math.nan  # largest V(k+1) / V(k) of the common functional; NaN without
    # Largest growth per sample of ||x|| that a periodic switching without a hold was found to
    # cause, at 1 or more the loop diverges under it; and its samples on the shorter gain (at its
    # longest delay) and on the longer one (at its own). NaN, (0, 0) for "common": none was sought.
    growth: float = math.nan
    period: tuple[int, int] = (0, 0)


@dataclass(frozen=True, kw_only=True, eq=False)
class SwitchingReport:
    """Which switches of a schedule are covered."""

    levels: tuple[int, ...]  # longest delay of each different certified gain, increasing
    # Level of the gain of each of the T_max + 1 entries of the table; None where the gain has no
    # certificate, so that no switch to or from it is covered.
    level_of: tuple[int | None, ...]
    switches: tuple[Switch, ...]  # one for each pair of levels
    # Least N for which every switching among all levels is proven, None if there is none; 0 if one
    # functional is common to all of them, whose largest V(k+1) / V(k) is `contraction`, else NaN.
    hold_samples: int | None
    contraction: float
    solve_time_s: float  # wall-clock time spent

    def covered(self, hold_samples: int = 0) -> npt.NDArray[np.bool_]:
        """Return which pairs of delays may alternate for ever, given the N of `hold_step`.

        Shape (T_max + 1, T_max + 1), symmetric. Each entry speaks of its two gains only; more than
        two are covered together from `self.hold_samples` on.
        """
        held = {(s.shorter, s.longer): s.hold_samples for s in self.switches}
        table = np.zeros((len(self.level_of), len(self.level_of)), dtype=np.bool_)
        for entry in np.ndindex(table.shape):
            one, other = (self.level_of[T] for T in entry)
            if one is not None and other is not None:
                needed = 0 if one == other else held[min(one, other), max(one, other)]
                table[entry] = needed is not None and needed <= hold_samples
        return table


@dataclass(frozen=True, kw_only=True, eq=False)
class _Level:
    """A gain's loop, the longest delay it covers, and a functional on the common window."""

    T: int
    loop: tuple[FloatArray, FloatArray]
    modes: FloatArray
    form: FloatArray | None
    contraction: float


def switching_report(plant: DelayedPlant, schedule: GainSchedule) -> SwitchingReport:
    """Check every pair of certified gains of a schedule for switching while the loop runs.

    For each pair, in this order: a common Krasovskii functional (`common_functional`), which
    covers any switching; else the hold that two functionals V_1, V_2 prove. If V_i falls by r_i
    and a switch from i to j raises it by mu_ij at most, a round trip with N + 1 samples on the
    longer gain is a contraction once mu_12 mu_21 r_1 r_2^(N+1) < 1. All functionals are checked
    by `functional.contraction`, which shares nothing with the solver. Where no common functional
    is found, a periodic switching that diverges is sought, to tell a real danger from caution.
    Where every pair has one, one for all levels is tried. Memoryless gains are covered, the
    predictor's are not. ValueError if the schedule is another plant's: a verdict does not come out
    as recorded.
    """
    start = time.perf_counter()
    schedule.verify(plant)
    level_of = [_level_of(schedule, T) for T in range(schedule.max_delay_steps + 1)]
    limits = sorted({T for T in level_of if T is not None})
    levels = [_level(plant, schedule, T, limits[-1]) for T in limits]
    switches = tuple(_switch(one, other) for one, other in combinations(levels, 2))
    common = math.inf
    if len(levels) <= MOST_COMMON and all(switch.covered_by == "common" for switch in switches):
        common = _common_contraction(levels) if levels else 0.0
    report = SwitchingReport(
        levels=tuple(limits),
        level_of=tuple(level_of),
        switches=switches,
        hold_samples=0 if common < 1.0 else _hold_for_all(levels),
        contraction=common if common < 1.0 else math.nan,
        solve_time_s=time.perf_counter() - start,
    )
    logger.info(
        "checked %d switches in %.1f s: %d by a common functional, hold of %s samples for all",
        len(switches),
        report.solve_time_s,
        sum(switch.covered_by == "common" for switch in switches),
        report.hold_samples,
    )
    return report


def _level_of(schedule: GainSchedule, T: int) -> int | None:
    """Return the longest delay that the gain of an entry is certified for, or None."""
    certified = schedule.certified
    same = (np.array_equal(gain, schedule.gains[T]) for gain in schedule.gains)
    covers = [other for other, equal in enumerate(same) if equal and certified[other]]
    return max(covers) if certified[T] else None


def _level(plant: DelayedPlant, schedule: GainSchedule, T: int, window: int) -> _Level:
    loop = plant.closed_loop(schedule.gains[T])
    modes = lifted_modes(*loop, T, window)
    witness = analyse_krasovskii(*loop, T)
    form, rate = None, math.inf
    if witness is not None:
        own = krasovskii_form(witness.P, [witness.S], [witness.R], [T]) if T else witness.P
        rate = contraction(own, lifted_modes(*loop, T, T))
        if rate < 1.0:
            form = own
            if T < window:
                form, rate = extended(own, witness.P, rate, window), (1.0 + rate) / 2.0
    return _Level(T=T, loop=loop, modes=modes, form=form, contraction=rate)


def _switch(one: _Level, other: _Level) -> Switch:
    rate = _common_contraction([one, other])
    if rate < 1.0:
        return Switch(
            shorter=one.T, longer=other.T, covered_by="common", hold_samples=0, contraction=rate
        )
    hold = _hold_for_all([one, other])
    growth, *period = worst_period(one.modes[-1], other.modes[-1], PERIODS)
    return Switch(
        shorter=one.T,
        longer=other.T,
        covered_by="none" if hold is None else "hold",
        hold_samples=hold,
        growth=growth,
        period=(period[0], period[1]),
    )


def _common_contraction(levels: Sequence[_Level]) -> float:
    """Return the largest V(k+1) / V(k) of a common functional; infinite if none was found."""
    limits = [level.T for level in levels]
    form = common_functional([level.loop for level in levels], limits)
    if form is None:
        return math.inf
    modes = [lifted_modes(*level.loop, level.T, limits[-1]) for level in levels]
    return contraction(form, np.concatenate(modes))


def _hold_for_all(levels: Sequence[_Level]) -> int | None:
    """Return the least N for which every round trip among the levels is a contraction."""
    rises = np.zeros((len(levels), len(levels)))
    for i, left in enumerate(levels):
        for j, entered in enumerate(levels):
            if left.form is None or entered.form is None or not left.contraction < 1.0:
                return None
            if i != j:
                rises[i, j] = math.log(jump(entered.form, left.form))
    rates = np.array([math.log(level.contraction) for level in levels])

    def proven(N: int) -> bool:
        # Before a switch up the gain was in force for one sample at least, before one down N + 1.
        down = np.tri(len(levels), k=-1, dtype=np.bool_)
        weights = rises + np.where(down, N + 1, 1) * rates[:, None]
        np.fill_diagonal(weights, -np.inf)
        for via in range(len(levels)):  # longest paths, after Floyd and Warshall
            weights = np.maximum(weights, weights[:, [via]] + weights[[via]])
        return bool((np.diagonal(weights) < 0.0).all())

    low, high = -1, 1
    while not proven(high):
        low, high = high, 2 * high
        if high > LONGEST_HOLD:
            return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if proven(middle) else (middle, high)
    return high
