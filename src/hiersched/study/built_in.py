"""The tables, figures and claims of this package, registered, and what a scenario shows of them.

What is shown imports nothing of this: each would depend on all others.
"""

import hiersched.study.claims.judged
import hiersched.study.figures.comparison
import hiersched.study.figures.gains
import hiersched.study.figures.rates
import hiersched.study.figures.training
import hiersched.study.tables.gains
import hiersched.study.tables.paper
import hiersched.study.tables.policies  # noqa: F401
from hiersched.core.registry import Registry
from hiersched.scenario import Scenario
from hiersched.study.registry import Shown


def shown(registry: Registry[Shown], scenario: Scenario) -> dict[str, Shown]:
    """Return what of a registry a scenario shows, by name."""
    return {name: registry[name] for name in registry if registry[name].when(scenario)}
