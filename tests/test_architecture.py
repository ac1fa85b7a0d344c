"""Layers, modules and files import downwards only, and stay short enough to read."""

import ast
import re
import sys
import tokenize
import tomllib
from collections.abc import Iterator
from functools import cache
from itertools import chain
from pathlib import Path

import pytest
from setuptools import find_namespace_packages

ROOT = Path(__file__).parents[1]

# Layers from the lowest up, as docs/architecture.md draws them: a package imports those of lower layers.
LAYERS = (
    ("reporting",),
    ("fe",),
    ("fmu_asset", "calibration", "scenarios"),
    ("twin_master", "discrepancy"),
    ("uav_twin",),
)
MAY_IMPORT = {package: {*chain(*LAYERS[:number])} for number, layer in enumerate(LAYERS) for package in layer}
MAY_IMPORT["scenarios"] = set()

BESIDE = {"benchmarks", "evidence", "tests"}
"""What imports the product and is not distributed with it."""

MODULE_TABLES = dict(
    re.findall(
        r"^### Modules of `(\w+)`\n\n\| module \| contents \|\n\| --- \| --- \|\n((?:\| `.*\n)+)",
        (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8"),
        re.MULTILINE,
    )
)
"""The table rows of each package's modules, from the lowest up: its folders and the files at its root."""

LONGEST_MODULE = 350
"""Lines of code of a module (docstrings, help of options, comments and blank lines left out)."""
NO_CODE = (
    tokenize.ENCODING,
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
)
"""Tokens that make no line of code."""
LONGEST_FUNCTION = 60
"""Lines of code of a function (docstring, help of options, comments and blank lines left out)."""

LONGER: dict[str, str] = {
    "discrepancy/workflow.py:investigate": "The whole way, one stage after the other.",
    "discrepancy/estimation/kernel.py:filter_record": "One compiled loop over a record's samples.",
    "discrepancy/missing_force/two_filters.py:filter_backward": "One compiled loop over a record's samples.",
}
"""What may be longer, each with its reason."""


@cache
def source_files() -> dict[str, Path]:
    """Return every Python file of the product by its dotted name."""
    found = {}
    for package in MAY_IMPORT:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def nodes(path: Path) -> tuple[ast.Import | ast.ImportFrom | ast.FunctionDef | ast.AsyncFunctionDef, ...]:
    """Return imports and functions of a module, wherever they stand."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    wanted = (ast.Import, ast.ImportFrom, ast.FunctionDef, ast.AsyncFunctionDef)
    return tuple(node for node in ast.walk(tree) if isinstance(node, wanted))


@cache
def imported(name: str, path: Path) -> frozenset[str]:
    """Return the project modules that `name` imports, in functions and for type checking too."""
    return frozenset(
        other for other in named_imports(name, path) if other in source_files() and other != name
    )


def named_imports(name: str, path: Path) -> Iterator[str]:
    """Yield what a module imports, each name as a module and with the module it is of."""
    for node in nodes(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = name if path.name == "__init__.py" else name.rpartition(".")[0]
                for _ in range(node.level - 1):
                    package = package.rpartition(".")[0]
                base = f"{package}.{base}".rstrip(".")
            yield from (f"{base}.{alias.name}" for alias in node.names)
            yield base


@pytest.mark.parametrize("package", sorted(MAY_IMPORT))
def test_imports_run_downwards_only_and_never_to_what_stands_beside(package):
    refused = {*MAY_IMPORT, *BESIDE} - MAY_IMPORT[package] - {package}
    wrong = [
        f"{name} imports {other}"
        for name, path in source_files().items()
        if name.split(".")[0] == package
        for other in named_imports(name, path)
        if other.split(".")[0] in refused
    ]
    assert not wrong


def test_the_page_has_the_modules_of_every_package_that_has_layers_inside():
    assert set(MODULE_TABLES) == {
        "reporting",
        "fe",
        "fmu_asset",
        "calibration",
        "twin_master",
        "discrepancy",
    }


@cache
def listed_modules(package: str) -> tuple[str, ...]:
    """Return the modules of a package's table, from the lowest up."""
    first_columns = [row.split(" | ")[0] for row in MODULE_TABLES[package].splitlines()]
    return tuple(chain.from_iterable(re.findall(r"`(\w+)`", column) for column in first_columns))


@cache
def modules_by_file(package: str) -> dict[str, str]:
    """Return the module of each file of a package, by the dotted name of the file."""
    return {name: name.split(".")[1] for name in source_files() if name.startswith(f"{package}.")}


@pytest.mark.parametrize("package", sorted(MODULE_TABLES))
def test_the_table_of_a_package_has_each_of_its_modules_once(package):
    listed = listed_modules(package)
    assert len(set(listed) - {"errors"}) == len(listed), "a module stands in the table twice"
    missing = set(modules_by_file(package).values()) - {"errors", *listed}
    assert not missing, "a module is missing in the table"


@pytest.mark.parametrize("package", sorted(MODULE_TABLES))
def test_the_modules_of_a_table_exist(package):
    listed = listed_modules(package)
    folders = {module for module in listed if (ROOT / package / module).is_dir()}
    assert folders | set(modules_by_file(package).values()) >= set(listed)


@pytest.mark.parametrize("package", sorted(MODULE_TABLES))
def test_modules_import_modules_below_them_only(package):
    height = {module: number for number, module in enumerate(("errors", *listed_modules(package)))}
    module_of = modules_by_file(package)
    wrong = [
        f"{name} imports {other}"
        for name, module in module_of.items()
        for other in imported(name, source_files()[name])
        if other in module_of and height[module_of[other]] > height[module]
    ]
    assert not wrong


def test_no_two_files_import_each_other_in_a_circle():
    known = source_files()
    # A package's __init__ re-exports its files, and its files never need it: leave it out of the graph.
    graph = {
        name: {o for o in imported(name, path) if known[o].name != "__init__.py"}
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


def test_modules_and_functions_are_short_or_say_why_not():
    long: dict[str, int] = {}
    for path in source_files().values():
        place = path.relative_to(ROOT).as_posix()
        line_count = len(path.read_bytes().splitlines())  # code takes no more lines than all takes
        if line_count > LONGEST_MODULE and code_lines(path) > LONGEST_MODULE:
            long[place] = code_lines(path)
        for node in nodes(path):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and lines(node) > LONGEST_FUNCTION:
                long[f"{place}:{node.name}"] = lines(node)
    assert {place: length for place, length in long.items() if place not in LONGER} == {}
    assert not set(LONGER) - set(long), "no longer long"


@cache
def code_lines(path: Path) -> int:
    """Return the number of lines of a module with code: no docstrings, help, comments and blank lines."""
    rows: set[int] = set()
    with path.open("rb") as file:
        for token in tokenize.tokenize(file.readline):
            if token.type not in NO_CODE:
                rows |= set(range(token.start[0], token.end[0] + 1))
    tree = ast.parse(path.read_bytes())
    rows -= lines_of_option_help(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            rows -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(rows)


@cache
def lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Return the number of lines on which a part of a function begins or ends, its docstring left out."""
    rows = {
        row
        for statement in function.body[ast.get_docstring(function) is not None :]
        for part in ast.walk(statement)
        if hasattr(part, "lineno")
        for row in (part.lineno, part.end_lineno)
    }
    signature = function.body[0].lineno - function.lineno - len(lines_of_option_help(function.args))
    return len(rows) + signature


def lines_of_option_help(tree: ast.AST) -> set[int]:
    """Return the lines with the help and the limits of a command's options, which are a text for users.

    These are the lines of an `Annotated[...]` after its first one, which holds the name of the parameter.
    """
    return {
        row
        for node in ast.walk(tree)
        if isinstance(node, ast.Subscript)
        and isinstance(node.value, ast.Name)
        and node.value.id == "Annotated"
        for row in range(node.lineno + 1, (node.end_lineno or node.lineno) + 1)
    }


def test_the_runtime_imports_numpy_the_standard_library_and_itself_only():
    """By relative imports: its folder goes into FMUs as it is."""
    for name, path in source_files().items():
        for node in nodes(path) if name.startswith("fe.runtime") else ():
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                assert node.level <= len(path.relative_to(ROOT / "fe" / "runtime").parts), name
                names = [] if node.level else [str(node.module)]
            assert {item.split(".")[0] for item in names} <= {"numpy", *sys.stdlib_module_names}, name


def test_every_package_is_distributed():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    find = settings["tool"]["setuptools"]["packages"]["find"]
    distributed = set(find_namespace_packages(str(ROOT), **find))
    needed = {
        ".".join(path.parent.relative_to(ROOT).parts)
        for package in MAY_IMPORT
        for pattern in ("__init__.py", "*.toml")
        for path in (ROOT / package).rglob(pattern)
    }
    assert needed <= distributed
    assert {name.split(".")[0] for name in distributed} == set(MAY_IMPORT)
