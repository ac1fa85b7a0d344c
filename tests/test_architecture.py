"""The house: imports run downwards only, no two files import each other in a circle, scenarios is data."""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# What each package may import of the project. docs/architecture.md draws the same floors.
MAY_IMPORT = {
    "fe": set(),
    "reporting": set(),
    "scenarios": set(),
    "fmu_asset": {"fe", "reporting"},
    "calibration": {"fe", "reporting"},
    "twin_master": {"fe", "reporting", "scenarios", "fmu_asset", "calibration"},
    "discrepancy": {"fe", "reporting", "scenarios", "fmu_asset", "calibration"},
    "uav_twin": {
        "fe", "reporting", "scenarios", "fmu_asset", "calibration", "twin_master", "discrepancy",
    },
}  # fmt: skip


def modules() -> dict[str, Path]:
    """Return every module of the project by its dotted name."""
    found = {}
    for package in MAY_IMPORT:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(name: str, path: Path, known: dict[str, Path], *, at_import_time: bool) -> Iterator[str]:
    """Yield the project modules that `name` imports; only those of module level if `at_import_time`."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    skipped: set[ast.AST] = set()
    for node in ast.walk(tree):
        type_checking = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        if at_import_time and (type_checking or function):
            skipped.update(ast.walk(node))
    for node in ast.walk(tree):
        if node in skipped:
            continue
        if isinstance(node, ast.Import):
            candidates = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = name if path.name == "__init__.py" else name.rpartition(".")[0]
                for _ in range(node.level - 1):
                    package = package.rpartition(".")[0]
                base = f"{package}.{base}".rstrip(".")
            candidates = [f"{base}.{alias.name}" for alias in node.names] + [base]
        else:
            continue
        for candidate in candidates:
            if candidate in known and candidate != name:
                yield candidate


@pytest.mark.parametrize("package", sorted(MAY_IMPORT))
def test_imports_run_downwards_only(package: str) -> None:
    known = modules()
    wrong = [
        f"{name} imports {other}"
        for name, path in known.items()
        if name.split(".")[0] == package
        for other in imported(name, path, known, at_import_time=False)
        if other.split(".")[0] not in MAY_IMPORT[package] | {package}
    ]
    assert not wrong


def test_no_two_files_import_each_other_in_a_circle() -> None:
    known = modules()
    # A package's __init__ re-exports its files, and its files never need it: leave it out of the graph.
    graph = {
        name: {o for o in imported(name, path, known, at_import_time=True) if known[o].name != "__init__.py"}
        for name, path in known.items()
        if path.name != "__init__.py"
    }
    done: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, "circle: " + " -> ".join([*trail[trail.index(name) :], name])
        if name in done:
            return
        for other in graph[name]:
            visit(other, (*trail, name))
        done.add(name)

    for name in graph:
        visit(name, ())


def test_every_package_has_its_own_room_in_the_tests() -> None:
    tested = {p.name for p in (ROOT / "tests").iterdir() if p.is_dir()}
    assert set(MAY_IMPORT) - tested <= {"discrepancy"}


def test_every_package_is_distributed() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    found = {
        ".".join(path.parent.relative_to(ROOT).parts)
        for package in MAY_IMPORT
        for pattern in ("__init__.py", "*.toml")
        for path in (ROOT / package).rglob(pattern)
    }
    assert set(settings["tool"]["setuptools"]["packages"]) == found
