"""Plug-ins of a scenario: where their files lie, and what they consist of."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

from hiersched.core.faults import did_you_mean
from hiersched.core.registry import PluginError, load_installed_plugins, load_plugin
from hiersched.scenario.schema import Scenario

CONFIG = Path(__file__).resolve().parents[1] / "config"
"""The defaults of every key, and the shipped scenarios."""


def load_plugins(names: Sequence[str], files: Sequence[Path]) -> list[str]:
    """Import what installed packages add, and the files that a scenario names.

    A file is looked for beside the scenario's files, the first one's before the others'. A
    resolved scenario lies elsewhere, in the results or in a log: for it the working directory is
    searched as well. Returns faults, as ``key = value: what is wrong``.
    """
    faults = []
    try:
        load_installed_plugins()
    except PluginError as error:
        faults.append(str(error))
    folders = tuple(dict.fromkeys((*(file.parent for file in files), Path())))
    for place, name in enumerate(names):
        try:
            found = next((f / name for f in folders if (f / name).is_file()), None)
            if found is None:
                raise PluginError(_missing(name, folders))
            load_plugin(found)
        except (PluginError, OSError, ValueError) as error:
            faults.append(f"plugins.{place} = {name!r}: {error}")
    return faults


def _missing(name: str, folders: Sequence[Path]) -> str:
    """Say that there is no such plug-in, and what there is where it was looked for."""
    own = [folder.resolve() for folder in folders if CONFIG not in (folder, folder.parent)]
    looked = dict.fromkeys(map(str, own))
    files = [file.name for folder in looked for file in sorted(Path(folder).glob("*.py"))]
    return (
        f"no such Python file in {' or '.join(looked)}{did_you_mean(name, files)} (hiersched new "
        "DIR makes one)"
    )


def plugin_modules(scenario: Scenario) -> dict[str, ModuleType]:
    """Return the modules of a scenario's plug-ins, by their names under `plugins`."""
    return {name: sys.modules[Path(name).stem] for name in scenario.plugins}
