"""Every sentence of a refusal is said somewhere, with all that its braces ask for."""

import ast
from pathlib import Path
from string import Formatter

import fe
from fe.sentences import SENTENCES


def test_every_sentence_is_said_with_its_values():
    known = {f"{table}.{key}": text for table, own in SENTENCES.items() for key, text in own.items()}
    said = set()
    for path in Path(fe.__file__).parent.rglob("*.py"):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "said":
                name, given = ast.literal_eval(call.args[0]), {item.arg for item in call.keywords}
                wanted = {
                    key.split(".")[0].split("[")[0] for _, key, _, _ in Formatter().parse(known[name]) if key
                }
                assert wanted == given or (None in given and given - {None} <= wanted), (path.name, name)
                said.add(name)
    assert said == known.keys()
