"""The tables, figures and claims of this package, registered, and what a scenario shows of them.

What is shown imports nothing of this: each would depend on all others.
"""

import sys

import hiersched.study.claims.judged
import hiersched.study.claims.task
import hiersched.study.figures.comparison
import hiersched.study.figures.gains
import hiersched.study.figures.loops
import hiersched.study.figures.rates
import hiersched.study.figures.task
import hiersched.study.figures.training
import hiersched.study.tables.gains
import hiersched.study.tables.loops
import hiersched.study.tables.paper
import hiersched.study.tables.policies
import hiersched.study.tables.task  # noqa: F401
from hiersched.core.registry import Registry, is_plugin_file
from hiersched.scenario import Scenario
from hiersched.scenario.plugins import plugin_modules
from hiersched.study.registry import Shown


def shown(registry: Registry[Shown], scenario: Scenario) -> dict[str, Shown]:
    """Return what of a registry a scenario shows, by name: nothing of another's plug-ins."""
    own = plugin_modules(scenario).values()
    found = {}
    for name in registry:
        thing, module = registry[name], sys.modules[registry[name].module]
        if (module in own or not is_plugin_file(module)) and thing.when(scenario):
            found[name] = thing
    return found
