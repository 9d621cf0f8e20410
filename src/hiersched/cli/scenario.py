"""`hiersched scenario`: check or show a scenario, or what one may be."""

from __future__ import annotations

import argparse
from typing import Any


def add_commands(commands: Any) -> None:
    """Add the command to the parser."""
    scenario = commands.add_parser("scenario", help="check or show a scenario, or its schema")
    actions = scenario.add_subparsers(required=True, metavar="ACTION")
    for name, command, text in (
        ("check", _check, "say whether a scenario can be run, and what is wrong if not"),
        ("show", _show, "print a scenario with every value in place, as YAML"),
    ):
        action = actions.add_parser(name, help=text, description=text)
        action.add_argument("file", metavar="FILE", help="path, or the name of a shipped scenario")
        action.set_defaults(command=command)
    text = "print the JSON schema of a scenario, with which editors check and complete"
    actions.add_parser("schema", help=text, description=text).set_defaults(command=_schema)


def _check(parsed: argparse.Namespace) -> int:
    from hiersched.experiments.feasible import capacity_mbps, load_study, offered_mbps, warnings

    scenario = load_study(parsed.file)
    print(
        f"{parsed.file}: scenario {scenario.name} is fine: {scenario.users.num_urllc} URLLC and "
        f"{scenario.users.num_embb} eMBB users, {scenario.radio.num_prb} PRBs"
    )
    urllc, embb = offered_mbps(scenario)
    capacity = capacity_mbps(scenario)
    print(
        f"offered: URLLC {urllc:.4g} and eMBB {embb:.4g} Mbit/s; with as many PRBs for each user "
        f"and no choice of good ones the cell carries about {capacity:.4g} Mbit/s: "
        f"{100.0 * (urllc + embb) / capacity:.3g} %"
    )
    for warning in warnings(scenario):
        print(f"warning: {warning}")
    return 0


def _show(parsed: argparse.Namespace) -> int:
    from hiersched.scenario import load_scenario, scenario_to_yaml

    print(scenario_to_yaml(load_scenario(parsed.file)), end="")
    return 0


def _schema(parsed: argparse.Namespace) -> int:
    from hiersched.scenario.plugins import CONFIG

    print((CONFIG / "scenario.schema.json").read_text(encoding="utf-8"), end="")
    return 0
