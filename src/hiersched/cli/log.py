"""Commands about logs: info, digest, recover, export, view, report, schema."""

from __future__ import annotations

import argparse
import math
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hiersched.cli.options import add_overwrite
from hiersched.core.faults import blaming_input

if TYPE_CHECKING:
    from hiersched.log import LogReader

LOSSY = 3


def add_commands(commands: Any) -> None:
    """Add the commands to the parser."""
    for name, command, text in (
        ("info", _info, "say what a log holds, and check every byte of it"),
        ("digest", _digest, "hash topic, time and payload, whatever compression and chunks"),
        ("recover", _recover, "write what is whole in a damaged or unfinished log into a new one"),
        ("export", _export, "write the topics of a log as tables, or what viewers need beside it"),
        ("view", _view, "open a log in Rerun (needs rerun-sdk: the extra hiersched[viewer])"),
        ("report", _report, "write a log as one HTML page, which needs no network"),
    ):
        parser = commands.add_parser(name, help=text, description=text)
        parser.add_argument("log", metavar="LOG", help="an MCAP file of hiersched")
        parser.set_defaults(command=command)
        if name == "recover":
            text = "the new log (LOG with .recovered.mcap)"
            parser.add_argument("--out", metavar="LOG2", help=text)
        if name == "view":
            text = "write a Rerun recording (.rrd) instead"
            parser.add_argument("--save", metavar="FILE", help=text)
        if name == "report":
            parser.add_argument("--out", metavar="FILE", help="the page (LOG with .html)")
            _add_span(parser)
        if name == "export":
            _add_export_options(parser)
        if name in ("view", "report", "export"):
            add_overwrite(parser)
    text = "print the schema of the logs that this version writes, as a .proto file"
    commands.add_parser("schema", help=text, description=text).set_defaults(command=_schema)


def _add_export_options(parser: argparse.ArgumentParser) -> None:
    form = parser.add_mutually_exclusive_group(required=True)
    for name, text in (
        ("csv", "as CSV; numbers read back to the same bits"),
        ("parquet", "as Parquet (needs pyarrow: the extra hiersched[study])"),
        (
            "viewer",
            "poses, trails and images as viewer.mcap, a layout for Foxglove as foxglove.json",
        ),
    ):
        form.add_argument(f"--{name}", dest="form", action="store_const", const=name, help=text)
    parser.add_argument("--out", metavar="FOLDER", help="folder of the files (LOG without .mcap)")
    parser.add_argument("--topic", action="append", metavar="TOPIC", help="again for more; all")
    _add_span(parser)


def _add_span(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--from", dest="start", type=float, default=0.0, metavar="S",
                        help="from this time on [s]")  # fmt: skip
    parser.add_argument("--to", dest="stop", type=float, default=math.inf, metavar="S",
                        help="to before this time [s]")  # fmt: skip


def _schema(parsed: argparse.Namespace) -> int:
    from hiersched.log import proto_source

    print(proto_source(), end="")
    return 0


def _digest(parsed: argparse.Namespace) -> int:
    from hiersched.log import log_digest

    print(f"{log_digest(parsed.log)}  {parsed.log}")
    return 0


def _recover(parsed: argparse.Namespace) -> int:
    from hiersched.log import recover

    with blaming_input(FileExistsError):
        report = recover(parsed.log, parsed.out)
    spans = ", ".join(f"{start} to {stop - 1}" for start, stop in report.spans) or "none"
    print(f"{report.path}: {report.num_slots} slots ({spans}), {report.num_events} events")
    for loss in report.losses:
        print(f"lost: {loss}")
    if not report.losses:
        print("lost: nothing of what is in the file; what was not flushed never got there")
    return LOSSY if report.losses else 0


def _info(parsed: argparse.Namespace) -> int:
    from hiersched.log import LogReader

    with LogReader(parsed.log) as log:
        size = log.path.stat().st_size
        print(f"{parsed.log}: complete, every checksum is right ({size:,} bytes)")
        for line in [*_origin(log), *_contents(log), *_statistics(log), *_growth(log)]:
            print(line.replace("\n", "\\n"))  # of metadata: it must not look like a line of ours
    return 0


def _origin(log: LogReader) -> list[str]:
    """Say what the log is of."""
    text, dims = log.metadata, log.dims
    point = f", {text['axis']} = {text['value']}" if text.get("axis") else ""
    lines = [
        f"scenario    {text.get('scenario', '?')} (sha256 {text.get('scenario_sha256', '?')[:16]})",
        f"run         {text.get('stage', '?')}{point}, policy {text.get('policy', '?')}, "
        f"seed {text.get('seed', '?')}",
        f"schema      version {text['schema_version']}, profile {log.profile}",
        f"cell        {dims.num_urllc} URLLC and {dims.num_embb} eMBB users, {dims.num_prb} PRBs",
        f"duration    {log.num_slots} slots of {log.slot_ns / 1e6:g} ms: "
        f"{log.num_slots * log.slot_ns / 1e9:g} s",
    ]
    for key in ("sb3", "vec_normalize", "onnx"):
        if name := text.get(f"policy_{key}"):
            sha256 = text.get(f"policy_{key}_sha256", "?")[:16]
            lines.insert(2, f"policy      {key} {name} (sha256 {sha256})")
    if log.model_fields:
        names = ", ".join(f"{f.name} [{f.unit}] ({f.count})" for f in log.model_fields)
        lines.insert(-1, f"models      {names}")
    for fields, what in (
        (log.unknown_fields, "not known to this hiersched, read as the log describes them"),
        (log.missing_fields, "not in the log, which is of another version"),
    ):
        if fields:
            lines.append(f"fields      {what}: {', '.join(fields)}")
    if text.get("recovered_losses"):
        lines.append(f"recovered   lost: {text['recovered_losses']}")
    return lines


def _contents(log: LogReader) -> list[str]:
    """Say what is in the file."""
    lines = ["", f"{'topic':<13}{'messages':>10}{'chunks':>8}{'bytes':>14}{'stored':>8}"]
    for topic, messages, chunks, plain, stored in log.contents():
        share = f"{100 * stored / plain:.0f} %" if plain else "-"
        lines.append(f"{topic:<13}{messages:>10,}{chunks:>8,}{plain:>14,}{share:>8}")
    kinds = Counter((event.level, event.name) for event in log.events())
    for (level, name), number in sorted(kinds.items()):
        lines.append(f"  {number:,} {level} of {name}")
    for name, data in sorted(log.attachments.items()):
        lines.append(f"attachment  {name} ({len(data):,} bytes)")
    return lines


def _statistics(log: LogReader) -> list[str]:
    """Average what matters over the run."""
    from hiersched.replay.measures import batch_means

    if not log.num_slots:
        return []
    warmup = log.metadata.get("warmup_slots", "0")
    among = f", the {warmup} of the warm-up among them" if warmup != "0" else ""
    return ["", f"mean over all slots{among}"] + [
        f"  {name:<22}{float(values[0]):>14.6g} {unit}".rstrip()
        for name, unit, values in batch_means(log, log.num_slots, 1)
    ]


def _growth(log: LogReader) -> list[str]:
    """Say whether the second moment of the loop shrinks over the delays that the log has.

    The scenario of a log that names plug-ins is not loaded: to look at a log runs nobody's code.
    """
    from yaml import YAMLError

    from hiersched.control import GainSchedule
    from hiersched.scenario import load_resolved
    from hiersched.scenario.strict_yaml import parse_yaml
    from hiersched.simulator.loop_growth import transitions, worst_growth

    kept = log.attachments
    if not {"scenario.yaml", "schedule.json"} <= set(kept) or not log.num_slots:
        return []
    if "/robots" not in log.topics or "delay_steps" not in log.known_fields("/robots"):
        return []
    text = kept["scenario.yaml"].decode()
    try:
        if parse_yaml(text)["plugins"]:
            return []
        scenario, _, _ = load_resolved(text, Path("scenario.yaml"))
        schedule = GainSchedule.from_json(kept["schedule.json"].decode(), vouched=True)
        delays = log.read("/robots", ["delay_steps"])["delay_steps"]
        counts = transitions(delays, scenario, log.slot_ns * 1e-9)
        robot, growth = worst_growth(scenario, schedule, counts)
    except (ValueError, LookupError, TypeError, YAMLError):  # none over the network, or another's
        return []
    word = "shrinks" if growth.in_force < 1.0 else "GROWS"
    if math.isnan(growth.in_force):
        word = "not known"
    return [
        "",
        f"second moment of the loop over its delays, robot {robot} the worst: {word}, factor "
        f"{growth.in_force:.4f} a sample",
        f"  with the nominal gain {growth.nominal:.4f}, with gains that follow each delay at once "
        f"{growth.followed:.4f}",
    ]


def _export(parsed: argparse.Namespace) -> int:
    from hiersched.replay.export import export_for_viewers, export_tables

    source = Path(parsed.log)
    folder = Path(parsed.out) if parsed.out else source.with_suffix("")
    if parsed.form == "viewer":
        with blaming_input(FileExistsError):
            written = export_for_viewers(source, folder, overwrite=parsed.overwrite)
        _note_what_is_left_out(parsed.log)
    else:
        rows = parsed.topic, parsed.start, parsed.stop
        with blaming_input((ValueError, FileExistsError)):
            written = export_tables(source, folder, parsed.form, *rows, overwrite=parsed.overwrite)
    for path in written:
        print(path)
    return 0


def _view(parsed: argparse.Namespace) -> int:
    from hiersched.replay.view import show_in_rerun

    with blaming_input(FileExistsError):
        show_in_rerun(parsed.log, parsed.save, overwrite=parsed.overwrite)
    _note_what_is_left_out(parsed.log)
    return 0


def _report(parsed: argparse.Namespace) -> int:
    from hiersched.replay.page import write_log_page

    source = Path(parsed.log)
    out = Path(parsed.out) if parsed.out else source.with_suffix(".html")
    with blaming_input((ValueError, FileExistsError)):
        print(write_log_page(source, out, parsed.start, parsed.stop, overwrite=parsed.overwrite))
    _note_what_is_left_out(parsed.log)
    return 0


def _note_what_is_left_out(path: str) -> None:
    """Say which panels views of a small log lack, and how to have them."""
    from hiersched.log import LogReader
    from hiersched.replay.panels import left_out

    with LogReader(path, verify="chunks") as log:
        text = left_out(log, path)
    if text:
        print(f"{path}: {text}", file=sys.stderr)
