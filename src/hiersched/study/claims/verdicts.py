"""What makes a claim reproduced: statements with a claimed range, outcomes, and the one rule.

The rule was fixed before the numbers were looked at, and is written out in every result.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.study.statistics import Interval, halvings

Outcome = Literal["holds", "contradicted", "open"]
Verdict = Literal["reproduced", "not reproduced", "depends", "not judged"]

RULE = (
    "A statement holds where its 95 % interval lies within the claimed range, is contradicted "
    "where the interval lies outside it altogether, and is open else, as where an interval is "
    "unbounded or a number is missing. A claim holds under a condition where all its statements "
    "hold, and is contradicted where one is. It is reproduced where it holds under the scenario "
    "as configured and no sensitivity run contradicts it; not reproduced where it does not hold "
    "there nor in any sensitivity run; it depends in all other cases. It also depends where fewer "
    "than 95 % of the ways to halve the seeds (126 for ten) agree: both halves have to put the "
    "estimates on the same side of the claim as all seeds do. Of learned policies training seeds "
    "are halved, and each half meets all worlds. Classical schedulers and controls "
    "that learn nothing are shown beside the learned policies and do not count."
)

AGREEING = 0.95
"""Least share of the halvings that agree on a verdict that stands."""


@dataclass(frozen=True, kw_only=True)
class Statement:
    """A number, its interval and the open range that the claim puts it into.

    `effect` is the standardised effect: mean over standard deviation of `values`, whose mean is the
    estimate: the numbers or paired differences themselves, or, of ratios, their `logarithms`, shape
    (seeds,) or, of trained policies in all worlds, (training seeds, worlds).
    """

    name: str
    unit: str
    interval: Interval
    above: float = -math.inf
    below: float = math.inf
    effect: float
    values: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    logarithms: bool = False

    @property
    def count(self) -> int:
        """Seeds: those of the training where there are several, else worlds."""
        return len(self.values)

    def claimed_by(self, seeds: NDArray[np.intp]) -> bool:
        """Whether the estimate from some of the seeds alone lies within the claimed range."""
        estimate = float(np.mean(np.asarray(self.values)[seeds]))
        return self.above < (math.exp(estimate) if self.logarithms else estimate) < self.below

    @property
    def outcome(self) -> Outcome:
        """Whether the interval lies within the claimed range, outside it, or across its ends."""
        _, lo, hi = self.interval
        if not all(map(math.isfinite, self.interval)):
            return "open"
        if self.above < lo and hi < self.below:
            return "holds"
        return "contradicted" if hi <= self.above or lo >= self.below else "open"


@dataclass(frozen=True)
class Condition:
    """A claim under one condition: which policy, and which key has which value.

    `axis` is what differs from the scenario as configured, empty for that itself; a condition that
    does not count is shown for comparison.
    """

    axis: str
    value: str
    policy: str
    statements: tuple[Statement, ...]
    counts: bool = True

    @property
    def outcome(self) -> Outcome:
        """Contradicted where a statement is, open where one is or there is none, else holds."""
        outcomes = [statement.outcome for statement in self.statements]
        if "contradicted" in outcomes:
            return "contradicted"
        return "open" if "open" in outcomes or not outcomes else "holds"

    @property
    def agreement(self) -> float:
        """Share of the halvings of the seeds of which both halves agree with all seeds; else NaN.

        A part agrees where its estimates are all within their claimed ranges, or one is not, as
        those of all seeds. NaN for a single seed, or none.
        """
        ways = halvings(min((s.count for s in self.statements), default=0))
        if not ways or len({s.count for s in self.statements}) > 1:
            return math.nan

        def claimed(seeds: NDArray[np.intp]) -> bool:
            return all(statement.claimed_by(seeds) for statement in self.statements)

        whole = claimed(np.arange(self.statements[0].count))
        return sum(claimed(a) == claimed(b) == whole for a, b in ways) / len(ways)


class Judged(NamedTuple):
    """What came out of a claim: as configured, and under every other condition."""

    base: Condition
    others: tuple[Condition, ...]

    @property
    def verdict(self) -> Verdict:
        """By `RULE`; without any statement there is none."""
        if not self.base.statements:
            return "not judged"
        if self.base.agreement < AGREEING or self.flipped_by:
            return "depends"
        return "reproduced" if self.base.outcome == "holds" else "not reproduced"

    @property
    def flipped_by(self) -> list[Condition]:
        """Sensitivity runs that flip the claim: contradicted where it holds, or the reverse.

        Runs that are merely open, with an interval too wide to say, flip nothing.
        """
        wanted = "contradicted" if self.base.outcome == "holds" else "holds"
        return [c for c in self.others if c.counts and c.outcome == wanted]
