"""Mutants of four areas, drawn with a fixed seed, and the tests that kill them: `make mutants`.

python tests/mutants/run.py [--list] [--quick] [--area AREA] [--out FILE]

Every mutant has a line in FILE: area, id, place, operator, what has changed, and what became of it.
A mutant that is recorded as killed is not run again: a stopped run goes on, and survivors meet new
tests. Without FILE all begins anew.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import hashlib
import importlib.util
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from resource import RLIMIT_CPU, setrlimit
from typing import Any

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

SEED = 20260917
MUTANTS_PER_AREA = 15
ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "src/hiersched"
# Processor time for a folder of tests, and for all: three times what they take, compiling included.
FOLDER_LIMIT_S, LIMIT_S = 300.0, 1800.0
SURVIVED, SURVIVED_AREA = "survived", "survived the tests of its area"


@dataclass(frozen=True)
class Area:
    """Folders of the package, and the folders of tests that are run before all others."""

    sources: tuple[str, ...]
    tests: tuple[str, ...]


AREAS = {
    "network": Area(
        (
            *("models/channel", "models/link", "models/queue", "models/traffic"),
            *("allocation", "simulator"),
        ),
        ("models", "allocation", "simulator", "policies"),
    ),
    "control": Area(("control", "models/plant"), ("control", "models", "simulator")),
    "log": Area(("log", "replay"), ("log", "replay")),
    "study": Area(("study", "experiments"), ("study", "experiments")),
}


@dataclass(frozen=True)
class Mutant:
    """One operator of the tool at one place of a file."""

    area: str
    path: str  # relative to the root
    line: int
    operator: str
    occurrence: int
    key: str

    @property
    def text(self) -> str:
        """The mutated file; empty where the tool changes nothing."""
        code = (ROOT / self.path).read_text(encoding="utf-8")
        return mutate_code(code, get_operator(self.operator)(), self.occurrence) or ""

    def described(self) -> str:
        """Area, id, place, operator and change, separated by tabs."""
        name = self.operator.removeprefix("core/")
        before = (ROOT / self.path).read_text(encoding="utf-8").splitlines()
        lines = list(difflib.unified_diff(before, self.text.splitlines(), n=0, lineterm=""))[3:]
        gone, new = (" ".join(x[1:].strip() for x in lines if x[0] == sign) for sign in "-+")
        place = f"{self.path.removeprefix(PACKAGE + '/')}:{self.line}"
        return "\t".join((self.area, self.key[:8], place, name, f"{gone} → {new}".strip()))


# What is drawn.


def candidates(area: str) -> Iterator[Mutant]:
    """Everything that the tool's operators find in an area.

    The key hangs on the seed, the file, the operator and the text around the place: edits
    elsewhere in the file leave it as it is.
    """
    for folder in AREAS[area].sources:
        for file in sorted((ROOT / PACKAGE / folder).rglob("*.py")):
            path = file.relative_to(ROOT).as_posix()
            code = file.read_text(encoding="utf-8")
            lines, nodes = code.splitlines(), list(ast_nodes(get_ast(code)))
            for operator in operator_names():
                kind = get_operator(operator)
                if kind.arguments():
                    continue  # names variables of one program
                seen: Counter[str] = Counter()
                positions = kind().mutation_positions
                places = (start for node in nodes for start, _ in positions(node))
                for occurrence, (line, column) in enumerate(places):
                    text = lines[line - 1]
                    place = f"{text.strip()} {column - len(text) + len(text.lstrip())}"
                    words = f"{SEED} {path} {operator} {place} {seen[place]}"
                    seen[place] += 1
                    key = hashlib.sha256(words.encode()).hexdigest()
                    yield Mutant(area, path, line, operator, occurrence, key)


def drawn(area: str) -> list[Mutant]:
    """The first of all in the order of their keys, without those that can change nothing."""
    found: list[Mutant] = []
    for mutant in sorted(candidates(area), key=lambda mutant: mutant.key):
        if can_matter((ROOT / mutant.path).read_text(encoding="utf-8"), mutant.text):
            found.append(mutant)
        if len(found) == MUTANTS_PER_AREA:
            break
    return found


def can_matter(code: str, mutated: str) -> bool:
    """Whether a mutant is Python, and another program once what nothing evaluates is gone.

    Annotations are strings (`from __future__ import annotations`), and imports for them never run.
    The bare `*` among parameters is no operator, which the tool takes it for.
    """
    try:
        trees = [_Evaluated().visit(ast.parse(text)) for text in (code, mutated)]
    except SyntaxError:
        return False
    return ast.dump(trees[0]) != ast.dump(trees[1])


class _Evaluated(ast.NodeTransformer):
    """Leaves of a program what is evaluated."""

    def visit_If(self, node: ast.If) -> ast.AST | None:
        if ast.unparse(node.test) in ("TYPE_CHECKING", "not TYPE_CHECKING"):
            return None
        return self.generic_visit(node)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.returns = None
        return self.generic_visit(node)

    def visit_arg(self, node: ast.arg) -> ast.AST:
        node.annotation = None
        return node

    def visit_arguments(self, node: ast.arguments) -> ast.AST:
        node.args = [*node.posonlyargs, *node.args, *node.kwonlyargs]
        node.defaults = [*node.defaults, *(value for value in node.kw_defaults if value)]
        node.posonlyargs, node.kwonlyargs, node.kw_defaults = [], [], []
        return self.generic_visit(node)

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.AST:
        # The fields of a model are read from their annotations.
        if any("Annotated" in ast.unparse(line) for line in node.body):
            for line in node.body:
                if isinstance(line, ast.AnnAssign):
                    line.simple = 2  # marks it for visit_AnnAssign
        return self.generic_visit(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        if node.simple != 2:
            node.annotation = ast.Constant(None)
        return self.generic_visit(node)


# What becomes of it.


class Copy:
    """A copy of the files that git knows, where mutants are put and tests run."""

    def __init__(self, folder: Path) -> None:
        self.root = folder
        listing = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for name in filter(None, listing.split("\0")):
            if (ROOT / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(ROOT / name, folder / name, follow_symlinks=False)
            elif (ROOT / name).is_symlink():
                (folder / name).symlink_to(os.readlink(ROOT / name))

    def put(self, path: str, text: str) -> None:
        """Write a file, and forget what was compiled from it."""
        (self.root / path).write_text(text, encoding="utf-8")
        Path(importlib.util.cache_from_source(str(self.root / path))).unlink(missing_ok=True)

    def kernels(self) -> set[Path]:
        """Folders of machine code, one for each state of the sources."""
        return set((self.root / PACKAGE / "__pycache__").glob("kernels-*"))

    def test(self, places: list[str], limit_s: float) -> str:
        """What becomes of a mutant in these tests: '' where all pass within the limit.

        Limits are of processor time, so that a busy machine kills no mutant; a process that
        sleeps has four times as long.
        """
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *places]
        threads = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
        source = {"PYTHONPATH": str(self.root / "src"), "PYTHONHASHSEED": "0"}
        with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as output:
            process = subprocess.Popen(
                command,
                cwd=self.root,
                env={**os.environ, **threads, **source},
                stdout=output,
                stderr=subprocess.STDOUT,
                process_group=0,
                preexec_fn=lambda: setrlimit(RLIMIT_CPU, (round(limit_s), round(limit_s))),
            )
            try:
                code = process.wait(4.0 * limit_s)
                if code in (-signal.SIGXCPU, -signal.SIGKILL):
                    raise subprocess.TimeoutExpired(command, limit_s)
            except subprocess.TimeoutExpired:
                return f"timed out after {limit_s:.0f} s in {places[0]}"
            finally:
                if process.poll() is None:
                    os.killpg(process.pid, signal.SIGKILL)
                    process.wait()
            output.seek(0)
            text = output.read()
        if code in (0, 5):  # 5: all of them are nightly
            return ""
        named = re.search(r"^(?:FAILED|ERROR) (.*)$", text, re.MULTILINE)
        name = named[1].split(" - ")[0] if named else f"{places[0]}: pytest ends with {code}"
        return f"killed by {name}"


def stages(mutant: Mutant, quick: bool) -> Iterator[tuple[list[str], float]]:
    """Tests in the order in which they meet a mutant, the likeliest first, and their time limit."""
    source = Path(mutant.path).relative_to(PACKAGE)
    named = f"tests/{source.parts[0]}/test_{source.stem}.py"
    if (ROOT / named).exists():
        yield [named], FOLDER_LIMIT_S
    own = sorted(AREAS[mutant.area].tests, key=lambda name: name != source.parts[0])
    for name in own:
        yield [f"tests/{name}"], FOLDER_LIMIT_S
    if not quick:
        yield ["tests", *(f"--ignore=tests/{name}" for name in own)], LIMIT_S


def run(copy: Copy, mutant: Mutant, quick: bool) -> str:
    """Put a mutant into the copy, look what kills it, and take it out again."""
    known = copy.kernels()
    copy.put(mutant.path, mutant.text)
    try:
        for places, limit_s in stages(mutant, quick):
            killed = copy.test(places, limit_s)
            if killed:
                return killed
        return SURVIVED_AREA if quick else SURVIVED
    finally:
        copy.put(mutant.path, (ROOT / mutant.path).read_text(encoding="utf-8"))
        for folder in copy.kernels() - known:
            shutil.rmtree(folder)


def main() -> None:
    """Draw, run what has not been killed yet, and count."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "results/mutants.tsv", metavar="FILE")
    parser.add_argument("--list", action="store_true", help="draw, and run nothing")
    parser.add_argument("--quick", action="store_true", help="no tests but those of the area")
    parser.add_argument("--area", choices=AREAS, action="append", help="all without")
    options: Any = parser.parse_args()
    areas = options.area or list(AREAS)
    mutants = {mutant.described(): mutant for area in areas for mutant in drawn(area)}
    if options.list:
        print(*mutants, sep="\n")
        return
    outcomes: dict[str, str] = {}
    begins = not options.out.exists()
    if not begins:
        lines = options.out.read_text(encoding="utf-8").splitlines()
        outcomes = dict(line.rsplit("\t", 1) for line in lines)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder))
        if begins and (failed := copy.test(["tests"], LIMIT_S)):
            sys.exit(f"without a mutant: {failed}")
        for line in mutants:
            again = (SURVIVED,) if options.quick else (SURVIVED, SURVIVED_AREA)
            if outcomes.get(line, SURVIVED) in again:
                outcomes[line] = run(copy, mutants[line], options.quick)
                print(f"{line}\t{outcomes[line]}", flush=True)
                done = [f"{line}\t{outcomes[line]}\n" for line in mutants if line in outcomes]
                options.out.write_text("".join(done), encoding="utf-8")
    for area in areas:
        ends = [outcomes[line] for line in mutants if line.startswith(f"{area}\t")]
        print(f"{area}: {sum(not end.startswith(SURVIVED) for end in ends)} of {len(ends)} killed")


if __name__ == "__main__":
    main()
