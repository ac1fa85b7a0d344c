"""Every sentence of a refusal is said somewhere, with all that its braces ask for."""

import ast
from pathlib import Path
from string import Formatter

import pytest

from discrepancy.errors import Sentences

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("package", sorted(path.parent.name for path in ROOT.glob("*/sentences.toml")))
def test_every_sentence_is_said_with_its_values(package):
    tables = Sentences(str(ROOT / package / "sentences.py")).tables
    rows = ((table, own) for table, own in tables.items() if isinstance(own, dict))
    known = {f"{table}.{key}": text for table, own in rows for key, text in own.items()}
    said = set()
    for path in (ROOT / package).rglob("*.py"):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "said":
                first, given = call.args[0], {item.arg for item in call.keywords}
                either = (first.body, first.orelse) if isinstance(first, ast.IfExp) else (first,)
                if package == "discrepancy" and not all(isinstance(item, ast.Constant) for item in either):
                    continue  # of rules, chosen by name
                names = [ast.literal_eval(item) for item in either]
                fields = (key for name in names for _, key, _, _ in Formatter().parse(known[name]) if key)
                wanted = {key.split(".")[0].split("[")[0] for key in fields}
                assert wanted == given or (None in given and given - {None} <= wanted), (path.name, names)
                said.update(names)
    assert said == known.keys() or package == "discrepancy"  # whose tables have words of verdicts, too
