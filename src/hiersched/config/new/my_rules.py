"""A scheduler: the index of every user in a slot; the parameter is a key of the scenario."""

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

from hiersched.core.numerics import exp_f64
from hiersched.core.parameters import NonNegative, Note
from hiersched.policies.registry import RULES, Rule
from hiersched.policies.seams import INDEX


class UrgentWords(NamedTuple):
    """What the kernel needs of the rule."""

    slope: float


@RULES.model
@dataclass(frozen=True, kw_only=True)
class Urgent(Rule):
    """Maximises the sum of exp(s min(W / D, 2)) r / R: W wait, D deadline, R average rate."""

    model: Literal["urgent"] = "urgent"
    slope: Annotated[NonNegative, Note("1", "assumed", "s; at 0: proportional fair")] = 1.0

    def words(self, setup) -> UrgentWords:
        """Return what the kernel needs."""
        return UrgentWords(slope=self.slope)


@INDEX.kernel(UrgentWords)
def index_urgent(me, constants, state, slot, env):
    """Write the index of every user of world `env`."""
    for user in range(state.index_weight.shape[1]):
        wait = min(state.hol_delay_s[env, user] / constants.deadline_s[user], 2.0)
        urgency = exp_f64(me.slope * wait)
        state.index_weight[env, user] = urgency / state.average_rate_mbps[env, user]
