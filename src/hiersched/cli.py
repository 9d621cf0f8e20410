"""The command `hiersched`: what people type, besides the workflow."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version

BAD_INPUT = 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.

    Parameters
    ----------
    arguments
        As typed; those of the process unless given.

    Returns
    -------
    int
        Exit status: 0, or 2 when the input is at fault (one message on stderr).
    """
    parsed = _parser().parse_args(arguments)
    command: Callable[[argparse.Namespace], int] = parsed.command
    try:
        return command(parsed)
    except BrokenPipeError:  # the reader of our output has seen enough
        sys.stderr.close()
        return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="hiersched", description="Bandwidth allocation and control gains for teleoperation."
    )
    parser.add_argument("--version", action="version", version=f"hiersched {version('hiersched')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    scenario = commands.add_parser("scenario", help="check or show a scenario")
    actions = scenario.add_subparsers(required=True, metavar="ACTION")
    for name, command, text in (
        ("check", _check_scenario, "say whether a scenario can be run, and what is wrong if not"),
        ("show", _show_scenario, "print a scenario with every value in place, as YAML"),
    ):
        action = actions.add_parser(name, help=text, description=text)
        action.add_argument(
            "file", metavar="FILE", help="path, or the name of a file in config/scenarios"
        )
        action.set_defaults(command=command)
    return parser


def _check_scenario(parsed: argparse.Namespace) -> int:
    from hiersched.runs.variants import check_variants
    from hiersched.scenario import ScenarioError, load_scenario

    try:
        scenario = load_scenario(parsed.file)
        check_variants(scenario)
    except ScenarioError as error:
        return _complain(error)
    print(
        f"{parsed.file}: scenario {scenario.name} is fine: {scenario.users.num_urllc} URLLC and "
        f"{scenario.users.num_embb} eMBB users, {scenario.radio.num_prb} PRBs"
    )
    return 0


def _show_scenario(parsed: argparse.Namespace) -> int:
    from hiersched.scenario import ScenarioError, load_scenario, scenario_to_yaml

    try:
        print(scenario_to_yaml(load_scenario(parsed.file)), end="")
    except ScenarioError as error:
        return _complain(error)
    return 0


def _complain(error: Exception) -> int:
    print(f"hiersched: {error}", file=sys.stderr)
    return BAD_INPUT


if __name__ == "__main__":
    sys.exit(main())
