"""What makes a claim reproduced: statements with a claimed range, outcomes, and the one rule.

The rule was fixed before the numbers were looked at, and is written out in every result.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from hiersched.study.statistics import Interval

Outcome = Literal["holds", "contradicted", "open"]
Verdict = Literal["reproduced", "not reproduced", "depends", "not judged"]

RULE = (
    "A statement holds where its 95 % interval lies within the claimed range, is contradicted "
    "where the interval lies outside it altogether, and is open else, as where an interval is "
    "unbounded or a number is missing. A claim holds under a condition where all its statements "
    "hold, and is contradicted where one is. It is reproduced where it holds under the scenario "
    "as configured and no sensitivity run contradicts it; not reproduced where it does not hold "
    "there nor in any sensitivity run; it depends in all other cases. Classical schedulers are "
    "shown beside the learned policies and do not count."
)


@dataclass(frozen=True, kw_only=True)
class Statement:
    """A number, its interval and the open range that the claim puts it into.

    `effect` is the standardised effect: mean over standard deviation of the paired differences, or
    of the values where nothing is paired.
    """

    name: str
    unit: str
    interval: Interval
    above: float = -math.inf
    below: float = math.inf
    effect: float
    count: int

    @property
    def outcome(self) -> Outcome:
        """Whether the interval lies within the claimed range, outside it, or across its ends."""
        mean, lo, hi = self.interval
        if not (math.isfinite(mean) and math.isfinite(lo) and math.isfinite(hi)):
            return "open"
        if self.above < lo and hi < self.below:
            return "holds"
        return "contradicted" if hi <= self.above or lo >= self.below else "open"


@dataclass(frozen=True, kw_only=True)
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


def verdict_of(base: Condition, others: Sequence[Condition]) -> Verdict:
    """Return the verdict by `RULE`; without any statement there is none."""
    if not base.statements:
        return "not judged"
    outcomes = [condition.outcome for condition in others if condition.counts]
    if base.outcome == "holds":
        return "depends" if "contradicted" in outcomes else "reproduced"
    return "depends" if "holds" in outcomes else "not reproduced"


def flipping(base: Condition, others: Sequence[Condition]) -> list[Condition]:
    """Return the sensitivity runs that flip a claim: contradicted where it holds, or the reverse.

    Runs that are merely open, with an interval too wide to say, flip nothing.
    """
    wanted = "contradicted" if base.outcome == "holds" else "holds"
    return [c for c in others if c.counts and c.outcome == wanted]


@dataclass(frozen=True, kw_only=True)
class Claim:
    """A claim, how it is measured, and what came out under every condition.

    `unswept` says which sensitivity has not been run.
    """

    number: int
    reference: str
    paper: str
    measured: str
    base: Condition
    others: tuple[Condition, ...]
    unswept: str = ""

    @property
    def verdict(self) -> Verdict:
        """By `RULE`."""
        return verdict_of(self.base, self.others)

    @property
    def flipped_by(self) -> list[Condition]:
        """Sensitivity runs that flip the claim."""
        return flipping(self.base, self.others)
