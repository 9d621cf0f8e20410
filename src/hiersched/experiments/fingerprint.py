"""What a script does, as a hash: its statements and those of every module of ours that it imports.

Comments, docstrings and layout do not count. The modules are found by following the import
statements, so that none can be forgotten; an import inside a function counts too.
"""

from __future__ import annotations

import ast
import hashlib
import platform
from functools import cache
from importlib.metadata import version
from pathlib import Path

PACKAGE = "hiersched"
ALL = "*"
PACKAGE_FOLDER = Path(__file__).resolve().parents[1]
KERNEL_MODULE = PACKAGE_FOLDER / "simulator" / "simulator.py"
"""The module with the slot loop; with what it imports, it is all that has to be compiled."""


@cache
def kernels_name() -> str:
    """Name the compiled slot loop of this code, Numba, Python, machine and cache folder.

    The machine is that of the run: a job that computes it on another one has the same file.
    """
    from hiersched.core.compiled import CACHE_FOLDER
    from hiersched.experiments.turns import run_node

    parts = (
        code_fingerprint(KERNEL_MODULE),
        *(version("numba"), platform.python_version(), platform.machine(), run_node()),
        str(CACHE_FOLDER),
    )
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def code_fingerprint(script: Path, package_folder: Path = PACKAGE_FOLDER, *, only: str = "") -> str:
    """SHA-256, hexadecimal, of the code that a Python file can reach.

    With `only`, the name of a registered function of the file, that function stands for it. Others
    that are registered (``@figure``, ``@table``, ``@claim``), there or elsewhere, count where it
    reaches them.
    """
    modules = reachable_modules(script, package_folder)
    digest = hashlib.sha256(_statements(script, frozenset({only or ALL})).encode())
    files = (("", script), *modules.items())
    imported = {name for module, path in files for name in _imports(path, module)}
    for module, path in modules.items():
        names = _registered(path)
        used = {name for name in names if f"{module}.{name}" in imported}
        if module in imported or not names:
            used = {ALL}
        digest.update(f"\0{module}\0{_statements(path, frozenset(used))}".encode())
    for path in _data_files(modules):
        digest.update(f"\0{path.relative_to(package_folder)}\0".encode() + path.read_bytes())
    return digest.hexdigest()


def reachable_modules(script: Path, package_folder: Path = PACKAGE_FOLDER) -> dict[str, Path]:
    """Return the modules of the package that a script imports, directly or not: name -> file."""
    found: dict[str, Path] = {}
    waiting = [(script, "")]
    while waiting:
        path, name = waiting.pop()
        for candidate in _imports(path, name):
            parts = candidate.split(".")
            for end in range(1, len(parts) + 1):  # importing a module runs its parents first
                module = ".".join(parts[:end])
                file = _module_file(module, package_folder)
                if file is not None and module not in found:
                    found[module] = file
                    waiting.append((file, module))
    return dict(sorted(found.items()))


@cache
def _imports(path: Path, name: str) -> tuple[str, ...]:
    """Dotted names that a module imports from the package; the last part may be no module.

    What it imports for annotations alone does not count.
    """
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    tree = ast.parse(path.read_text(encoding="utf-8"), filename=str(path))
    tree.body = [
        node
        for node in tree.body
        if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    ]
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            if node.level:
                parts = package.split(".")
                base = ".".join(parts[: len(parts) - node.level + 1])
                module = f"{base}.{module}".rstrip(".")
            names += [f"{module}.{alias.name}" for alias in node.names]
    return tuple(name for name in names if name.split(".")[0] == PACKAGE)


@cache
def _module_file(name: str, package_folder: Path) -> Path | None:
    base = package_folder.joinpath(*name.split(".")[1:])
    for file in (base / "__init__.py", base.with_suffix(".py")):
        if file.is_file():
            return file
    return None


def _data_files(modules: dict[str, Path]) -> list[Path]:
    """Return the files without code in the folders of the packages: schemas and the like.

    Those in folders of the package itself, the configuration and the workflow, are no module's.
    """
    folders = {
        path.parent
        for name, path in modules.items()
        if path.name == "__init__.py" and name != PACKAGE
    }
    return sorted(
        path
        for folder in folders
        for path in folder.rglob("*")
        if path.is_file()
        and path.suffix not in (".py", ".pyc", ".nbi", ".nbc", ".part")
        and not path.name.startswith(".")
        and (path.parent == folder or not (path.parent / "__init__.py").exists())
    )


_REGISTERED = ("figure", "table", "claim")


def _functions(body: list[ast.stmt]) -> dict[str, ast.stmt]:
    """Return the registered functions of a module by name."""
    found: dict[str, ast.stmt] = {}
    for node in body:
        if isinstance(node, ast.FunctionDef):
            called = (d.func for d in node.decorator_list if isinstance(d, ast.Call))
            if any(isinstance(name, ast.Name) and name.id in _REGISTERED for name in called):
                found[node.name] = node
    return found


@cache
def _registered(path: Path) -> tuple[str, ...]:
    """List the names of the registered functions of a file."""
    text = path.read_text(encoding="utf-8")
    if not any(f"@{name}(" in text for name in _REGISTERED):
        return ()
    return tuple(_functions(ast.parse(text, filename=str(path)).body))


def _reached(body: list[ast.stmt], used: frozenset[str]) -> list[ast.stmt]:
    """Leave out registered functions that are not used, nor named by what is left."""
    left = {name: node for name, node in _functions(body).items() if name not in used}
    waiting = [node for node in body if node not in left.values()]
    while waiting:
        for node in ast.walk(waiting.pop()):
            if isinstance(node, ast.Name) and node.id in left:
                waiting.append(left.pop(node.id))
    return [node for node in body if node not in left.values()]


@cache
def _statements(path: Path, used: frozenset[str]) -> str:
    """Hash the statements of a file without comments, docstrings and positions.

    Of its registered functions those count that are used, from outside or here.
    """
    tree = ast.parse(path.read_text(encoding="utf-8"), filename=str(path))
    if ALL not in used:
        tree.body = _reached(tree.body, used)
    for node in ast.walk(tree):
        for name in ("body", "orelse", "finalbody"):
            statements = getattr(node, name, None)
            if isinstance(statements, list):
                setattr(node, name, [item for item in statements if not _is_text(item)])
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


def _is_text(node: ast.AST) -> bool:
    """Whether a statement is a string on its own: a docstring, without effect."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )
