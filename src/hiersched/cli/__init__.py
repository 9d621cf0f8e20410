"""The command `hiersched`: what people type, besides the workflow."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from importlib.metadata import version

from hiersched.core.extras import MissingExtraError, naming_extras
from hiersched.core.faults import InputError, PrintableStream, printable

BAD_INPUT = 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; `arguments` are as typed, those of the process unless given.

    Returns the exit status: 0; 1 when a log is not what it should be; 2 when the input is at fault
    (one message on stderr); 3 when a recovered log, or a table of studies, lacks something; of a
    study Snakemake's.
    """
    parsed = _parser().parse_args(arguments)
    command: Callable[[argparse.Namespace], int] = parsed.command
    out, err = PrintableStream(sys.stdout), PrintableStream(sys.stderr)
    try:
        with naming_extras(), redirect_stdout(out), redirect_stderr(err):
            return command(parsed)
    except BrokenPipeError:  # the reader of our output has seen enough
        sys.stderr.close()
        return 0
    except (InputError, MissingExtraError) as error:
        return _complain(str(error))
    except OSError as error:
        return _complain(f"{error.filename}: {error.strerror}" if error.filename else str(error))


def _complain(message: str) -> int:
    print(f"hiersched: {printable(message)}", file=sys.stderr)
    return BAD_INPUT


def _parser() -> argparse.ArgumentParser:
    from hiersched.cli import log, replay, run, scenario, table

    parser = argparse.ArgumentParser(
        prog="hiersched", description="Bandwidth allocation and control gains for teleoperation."
    )
    parser.add_argument("--version", action="version", version=f"hiersched {version('hiersched')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for module in (run, scenario, table, log, replay):
        module.add_commands(commands)
    return parser
