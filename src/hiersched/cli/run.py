"""`hiersched new` and `hiersched run`: from an empty folder to results."""

from __future__ import annotations

import argparse
import json
import math
import os
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hiersched.cli.options import add_overwrite
from hiersched.core.extras import MissingExtraError
from hiersched.core.faults import InputError, blaming_input
from hiersched.core.files import refuse_existing

if TYPE_CHECKING:
    from hiersched.scenario import Scenario
    from hiersched.study.metrics import RunMetrics

PACKAGE = Path(__file__).resolve().parents[1]
ONE_THREAD = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
    "PYTHONHASHSEED": "0",
}
"""Jobs run side by side, and the bits of a matrix product depend on the number of threads."""


def add_commands(commands: Any) -> None:
    """Add the commands to the parser."""
    text = "make a folder with a scenario to start from, a scheduler of one's own and a README"
    new = commands.add_parser("new", help=text, description=text)
    new.add_argument("folder", metavar="DIR", help="the folder to be")
    new.set_defaults(command=_new)
    text = "run the study of a scenario, or one policy in one world of it"
    run = commands.add_parser("run", help=text, description=text)
    run.add_argument("scenario", metavar="SCENARIO", help="path, or the name of a shipped scenario")
    what = run.add_mutually_exclusive_group(required=True)
    text = "run the whole study, N jobs at once (Snakemake)"
    what.add_argument("--cores", type=int, metavar="N", help=text)
    text = "run this scheduler, or one of the scenario's own policies, in one world"
    what.add_argument("--policy", metavar="NAME", help=text)
    words = "more for Snakemake, such as --snakemake='-n --quiet rules': what would run"
    for name, kind, metavar, text in (
        ("seconds", float, "S", "of the world, behind the warm-up of evaluate"),
        ("seed", int, "N", "of the world (the first of evaluate.seeds)"),
        ("out", str, "FILE", "log of the world (results/<scenario>/worlds/<policy>_seed<N>.mcap)"),
        ("snakemake", shlex.split, "WORDS", words),
    ):
        run.add_argument(f"--{name}", type=kind, metavar=metavar, help=text)
    add_overwrite(run)
    run.set_defaults(command=_run)


def _new(parsed: argparse.Namespace) -> int:
    folder = Path(parsed.folder)
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{folder}: not empty; nothing is overwritten")
    shutil.copytree(PACKAGE / "config" / "new", folder, dirs_exist_ok=True)
    print(f"{folder}: made. Next: cd {shlex.quote(str(folder))}, and what its README says:\n")
    print((folder / "README.md").read_text(encoding="utf-8"), end="")
    return 0


def _run(parsed: argparse.Namespace) -> int:
    is_study = parsed.policy is None
    for name in ("seconds", "seed", "out") if is_study else ("snakemake",):
        if getattr(parsed, name) is not None:
            raise InputError(f"--{name}: only with {'--policy' if is_study else '--cores'}")
    return _study(parsed) if is_study else _world(parsed)


def _study(parsed: argparse.Namespace) -> int:
    if find_spec("snakemake") is None:
        raise MissingExtraError("snakemake")
    words = ["--snakefile", str(PACKAGE / "workflow" / "Snakefile"), "--cores", str(parsed.cores)]
    words += [*(parsed.snakemake or ()), "--config", f"scenarios={json.dumps([parsed.scenario])}"]
    done = subprocess.run(
        [sys.executable, "-m", "snakemake", *words], env={**os.environ, **ONE_THREAD}, check=False
    )
    return done.returncode


def _world(parsed: argparse.Namespace) -> int:
    from hiersched.experiments.feasible import world_fault
    from hiersched.scenario import load_scenario
    from hiersched.study.metrics import run_metrics

    scenario = load_scenario(parsed.scenario)
    evaluation, slot_s = scenario.evaluate, scenario.radio.slot_s
    seed = evaluation.seeds[0] if parsed.seed is None else parsed.seed
    seconds = evaluation.duration_s if parsed.seconds is None else parsed.seconds
    if not slot_s <= seconds < math.inf:
        raise InputError(f"--seconds {seconds:g}: must be a slot of {slot_s:g} s or more")
    if not 0 <= seed < 1 << 31:
        raise InputError(f"--seed {seed}: must be 0 to {(1 << 31) - 1}")
    if fault := world_fault(scenario, evaluation.warmup_s + seconds):
        raise InputError(f"--seconds {seconds:g}: {fault}")
    default = Path("results", scenario.name, "worlds", f"{parsed.policy}_seed{seed}.mcap")
    path = default if parsed.out is None else Path(parsed.out)
    if parsed.out is not None:
        with blaming_input(FileExistsError):
            refuse_existing(path, f"{path}.part", overwrite=parsed.overwrite)
    try:
        _log_world(path, scenario, parsed.policy, seed, seconds)
    except ValueError as error:
        is_learner = parsed.policy in scenario.learned
        more = "; the study trains learners, hiersched replay LOG --policy FILE runs their weights"
        raise InputError(f"{parsed.scenario}: {error}{more * is_learner}") from error
    print(
        f"{scenario.name}: {parsed.policy} in world {seed}, {seconds:g} s behind a warm-up of "
        f"{evaluation.warmup_s:g} s\n"
    )
    for line in _table(run_metrics(path, scenario)):
        print(line)
    print(f"\n{path}")
    return 0


def _log_world(path: Path, scenario: Scenario, policy: str, seed: int, seconds: float) -> None:
    """Run a policy in one world of the evaluation, and log it in full."""
    from hiersched.experiments.logging import RunLabel, write_log
    from hiersched.experiments.worlds import run_worlds, untrained_policies
    from hiersched.simulator.gain_source import scenario_schedule
    from hiersched.simulator.loop_gains import loop_gains

    policies = untrained_policies(scenario, policy)
    slot_s = scenario.radio.slot_s
    warmup_slots = round(scenario.evaluate.warmup_s / slot_s)
    num_slots = warmup_slots + round(seconds / slot_s)
    schedule = scenario_schedule(scenario)
    gains = loop_gains(schedule, scenario.control.gain)
    (run,) = run_worlds(scenario, gains, policies, "evaluate", [seed], num_slots)
    run = replace(run, metadata={"warmup_slots": str(warmup_slots)})
    label = RunLabel(stage="evaluate", policy=policy, seed=seed)
    write_log(path, scenario, schedule, label, run, profile="full")


def _table(measures: RunMetrics) -> list[str]:
    """Measures of both slices side by side, then those of the robots."""
    rows = [
        ("late packets", "%", 100.0, "late_share"),
        *(
            (f"delay, {share} %", "ms", 1e3, f"delay_{name}_s")
            for share, name in ((50, "p50"), (95, "p95"), (99, "p99"), (99.9, "p999"))
        ),
        ("rate", "Mbit/s", 1.0, "rate_mbps"),
        ("backlog", "packets", 1.0, "backlog_packets"),
    ]
    lines = [f"{'':24}{'URLLC':>10}{'eMBB':>10}"]
    for name, unit, factor, field in rows:
        of_slices = (factor * getattr(measures, f"{s}_{field}") for s in ("urllc", "embb"))
        lines.append(f"{name:24}" + "".join(map(_cell, of_slices)) + f"  {unit}")
    for name, unit, factor, field in (
        ("tracking error", "cm", 1.0, "tracking_error_cm"),
        ("windows off track", "%", 100.0, "off_track_share"),
        ("dexterity index", "", 1.0, "dexterity_index"),
    ):
        lines.append(f"{name:24}{_cell(factor * getattr(measures, field))}{'':12}{unit}".rstrip())
    return lines


def _cell(value: float) -> str:
    """Four digits, the last ones too where they are 0; nothing at all is 0."""
    return f"{value:#10.4g}" if value else f"{0:10}"
