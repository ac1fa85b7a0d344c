"""What can be counted of how readable the code is: a package may become better, not worse.

The counts are signals. Where one fights clarity, clarity wins, and the ceiling is raised with its reason.
"""

import ast
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
VAGUE_NAMES = frozenset(
    word
    for line in (
        "at behind beside both by came every far found given here into item kept known left made meant more",
        "near of one other others own rest said seen shown some taken there told tried up what which whole",
        "whose",
    )
    for word in line.split()
)
"""Names that do not say what they hold."""


@dataclass(frozen=True)
class Counts:
    """Counts of a package, per 1,000 lines but for the vague names.

    Attributes
    ----------
    packed : float
        Assignments of several values at once that have different kinds, or are more than two.
    bundles : float
        Positional arguments that are passed as a bundle, `call(*arguments)`.
    walrus : float
        Assignments inside of expressions.
    columns : float
        Columns of arrays by a bare number.
    untyped : float
        Names that are annotated with `Any`.
    vague : float
        Per cent of the assigned names that are in `VAGUE_NAMES`.
    """

    packed: float
    bundles: float
    walrus: float
    columns: float
    untyped: float
    vague: float


CEILINGS = {
    "reporting": Counts(packed=0, bundles=1.1, walrus=0, columns=0.5, untyped=3.4, vague=0.2),
    "fe": Counts(packed=0.1, bundles=1.3, walrus=0, columns=1.2, untyped=1.8, vague=0.4),
    "fmu_asset": Counts(packed=0.2, bundles=1.2, walrus=0, columns=0.2, untyped=1.2, vague=0.4),
    "calibration": Counts(packed=0, bundles=2.2, walrus=0, columns=3.3, untyped=0.4, vague=0.2),
    "discrepancy": Counts(packed=0.3, bundles=1.3, walrus=0, columns=0.8, untyped=0.9, vague=0.3),
    "scenarios": Counts(packed=0, bundles=0, walrus=0, columns=0, untyped=0, vague=0),
    "twin_master": Counts(packed=0.1, bundles=1.2, walrus=0, columns=0.8, untyped=2.4, vague=0.3),
    "uav_twin": Counts(packed=0, bundles=0.5, walrus=0, columns=0.5, untyped=3.5, vague=0.7),
    "benchmarks": Counts(packed=0, bundles=2.7, walrus=0.2, columns=2, untyped=3.7, vague=0.5),
    "evidence": Counts(packed=0, bundles=0.6, walrus=0, columns=0, untyped=0, vague=0.3),
}
"""The most that each package may have; lower it when a package has become better."""


def is_packed(node: ast.AST) -> bool:
    """Return whether a statement assigns several values that have little to do with each other."""
    if not isinstance(node, ast.Assign) or not isinstance(node.value, ast.Tuple):
        return False
    if not any(isinstance(target, ast.Tuple) for target in node.targets):
        return False
    kinds = {type(value) for value in node.value.elts}
    return len(kinds) > 1 or len(node.value.elts) > 2


def has_bare_column(node: ast.AST) -> bool:
    """Return whether a subscript takes columns of an array by number."""
    if not isinstance(node, ast.Subscript) or not isinstance(node.slice, ast.Tuple):
        return False
    for index in node.slice.elts[1:]:
        is_number = isinstance(index, ast.Constant) and isinstance(index.value, int)
        if is_number or isinstance(index, ast.List):
            return True
    return False


@cache
def counts(package: str) -> Counts:
    """Return the counts of a package."""
    lines = packed = bundles = walrus = columns = untyped = names = vague = 0
    for path in sorted((ROOT / package).rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        lines += sum(bool(line.strip()) for line in source.splitlines())
        for node in ast.walk(ast.parse(source)):
            packed += is_packed(node)
            walrus += isinstance(node, ast.NamedExpr)
            columns += has_bare_column(node)
            if isinstance(node, ast.Call):
                bundles += sum(isinstance(argument, ast.Starred) for argument in node.args)
            if isinstance(node, ast.Name):
                untyped += node.id == "Any"
                if isinstance(node.ctx, ast.Store):
                    names += 1
                    vague += node.id in VAGUE_NAMES
    thousands = lines / 1000.0
    return Counts(
        packed=packed / thousands,
        bundles=bundles / thousands,
        walrus=walrus / thousands,
        columns=columns / thousands,
        untyped=untyped / thousands,
        vague=100.0 * vague / names,
    )


@pytest.mark.parametrize("package", sorted(CEILINGS))
def test_a_package_does_not_become_harder_to_read(package):
    now, ceiling = vars(counts(package)), vars(CEILINGS[package])
    grown = {name: round(value, 2) for name, value in now.items() if value > ceiling[name]}
    assert grown == {}, f"more than {CEILINGS[package]}: see CONTRIBUTING.md, How code is written"


@pytest.mark.parametrize(
    ("code", "packed"),
    [
        ("a, b = 1, 2", False),
        ("low, high = bounds", False),
        ("a, b = 1, f(2)", True),
        ("a, b, c = 1, 2, 3", True),
    ],
)
def test_unrelated_values_in_one_assignment_are_counted(code, packed):
    (statement,) = ast.parse(code).body
    assert is_packed(statement) == packed
