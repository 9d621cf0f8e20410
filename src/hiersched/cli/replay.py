"""`hiersched replay` and `hiersched compare`: logs computed again, and side by side."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hiersched.core.faults import InputError, blaming_input

if TYPE_CHECKING:
    from hiersched.experiments.logged import LoggedRun
    from hiersched.replay.compare import Comparison

DIFFERS = 1


def add_commands(commands: Any) -> None:
    """Add the commands to the parser."""
    text = "compute every slot of a log again and compare it bit for bit"
    more = (
        "With --out the run is also written again in the profile full: poses, states, channel and "
        "all else that a log of the profiles compact and decisions leaves out (weights that "
        "decisions leaves out are NaN: who owned which PRB is all that is known)."
    )
    replay = commands.add_parser("replay", help=text, description=f"{text}. {more}")
    replay.add_argument("log", metavar="LOG", help="an MCAP file of hiersched")
    more = "run this scheduler, or file of weights, in the world of the log instead"
    replay.add_argument("--policy", metavar="NAME", help=more)
    more = (
        "write the run again in the profile full if every bit is right; with --policy: keep the "
        "log of that run, in the profile of LOG"
    )
    replay.add_argument("--out", metavar="FULL", help=more)
    replay.set_defaults(command=_replay)
    text = "paired differences of runs in the same world, and the slots where they part"
    compare = commands.add_parser("compare", help=text, description=text)
    compare.add_argument("log", metavar="LOG", help="the baseline")
    compare.add_argument("others", metavar="LOG2", nargs="+", help="each is compared with LOG")
    compare.set_defaults(command=_compare)


def _replay(parsed: argparse.Namespace) -> int:
    from hiersched.experiments.logged import load_run
    from hiersched.replay.verify import decides_again, expand, verify

    run = load_run(parsed.log)
    if run.added_keys:
        keys = ", ".join(run.added_keys)
        text = f"{parsed.log}: older than these keys, which take today's defaults: {keys}"
        print(text, file=sys.stderr)
    if parsed.policy:
        return _counterfactual(run, parsed.policy, parsed.out)
    with blaming_input(FileExistsError), blaming_input(prefix=f"{parsed.log}: "):
        difference = expand(run, parsed.out) if parsed.out else verify(run)
    if difference is None:
        print(f"{parsed.log}: OK, {run.num_slots} slots computed again, every bit the same")
        if run.unknown_fields:
            left_out = f", nor in {parsed.out}" if parsed.out else ""
            print(f"not checked{left_out}, since this hiersched does not know them: "
                  f"{', '.join(run.unknown_fields)}")  # fmt: skip
        if not decides_again(run):
            print("decisions are those of the log: --policy asks the policy again")
        if parsed.out:
            print(f"{parsed.out}: the same run, profile full")
        return 0
    print(f"{parsed.log}: differs in {difference}")
    return DIFFERS


def _counterfactual(run: LoggedRun, policy: str, out: str | None) -> int:
    from hiersched.log import LogError, log_digest
    from hiersched.replay.compare import compare_logs
    from hiersched.replay.counterfactual import policy_of, rerun

    with blaming_input():
        other = policy_of(run, policy)
    for taken in (out, f"{out}.part") if out else ():
        if Path(taken).exists():
            raise InputError(f"{taken}: exists; a counterfactual never overwrites a file")
    with tempfile.TemporaryDirectory() as folder:
        target = Path(out) if out else Path(folder, "run.mcap")
        with blaming_input((TypeError, ValueError), f"{run.path}: policy {other.name}: "):
            rerun(run, other, target)
        if out:
            print(f"{out}: {other.name} in the world of {run.path}")
        if log_digest(target) == log_digest(run.path):
            print("every message is the same, bit for bit")
            return 0
        try:
            comparison = compare_logs(run.path, target)
        except LogError as error:
            raise InputError(
                f"{run.path}: this hiersched draws another world than the logged one "
                f"(hiersched replay says where they differ)"
            ) from error
    _show(comparison)
    return 0


def _compare(parsed: argparse.Namespace) -> int:
    from hiersched.replay.compare import compare_logs

    for other in parsed.others:
        print(f"{parsed.log} and {other}")
        _show(compare_logs(parsed.log, other))
    return 0


def _show(comparison: Comparison) -> None:
    """Print a comparison."""
    print(
        f"{comparison.num_slots} slots of the same world; 95 % intervals of the paired "
        f"difference over {comparison.num_batches} stretches of time"
    )
    names = comparison.baseline, comparison.other
    first, second = (max(14, len(name) + 2) for name in names)
    label = max((len(m.name) + 1 for m in comparison.measures), default=0)
    print(f"{'':<{label}}{names[0]:>{first}}{names[1]:>{second}}{'difference':>14}  interval")
    for m in comparison.measures:
        mean, low, high = m.difference
        print(
            f"{m.name:<{label}}{m.baseline:>{first}.6g}{m.other:>{second}.6g}{mean:>+14.4g}  "
            f"[{low:.4g}, {high:.4g}] {m.unit}".rstrip()
        )
    if not comparison.partings:
        print("the logs say the same, bit for bit")
    for p in comparison.partings:
        print(f"{p.topic} parts in slot {p.first_slot} and differs in {p.num_slots} slots")
