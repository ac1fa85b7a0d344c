"""Pages and texts use the terms of the glossary, and none of the spellings that it turns down."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
CODE = re.compile(r"^```.*?^```|`[^`\n]*`|\]\([^)]*\)", re.MULTILINE | re.DOTALL)
TURNED = ("one sees", "the house", "that we know", "believes ours", "gone on with", "elements, please")
"""Turns of other languages that were found once."""


def test_pages_use_the_terms_of_the_glossary() -> None:
    glossary = ROOT / "docs" / "glossary.md"
    rows = re.findall(r"^\| (.+?) \| .+ \| (.+?) \|$", glossary.read_text(encoding="utf-8"), re.MULTILINE)
    refused = [word for _, words in rows[2:] for word in words.split(", ")]
    assert len(refused) > 30
    other = re.compile(rf"\b({'|'.join(map(re.escape, [*refused, *TURNED]))})\b", re.IGNORECASE)
    found = {
        str(page.relative_to(ROOT)): words
        for page in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md"))
        if page != glossary and (words := {*other.findall(CODE.sub("", page.read_text(encoding="utf-8")))})
    }
    assert not found


def test_what_people_read_spells_chi_square_in_one_way() -> None:
    """Pages, and the texts of the code that are no docstrings, say χ² and χ²/dof."""
    other = re.compile(r"chi\^2|chi2|chi²|χ² / dof|χ2|chi-square", re.IGNORECASE)
    texts = [
        page.read_text(encoding="utf-8")
        for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md"))
        if page.name != "glossary.md"  # which lists what is not to be written
    ]
    for package in ("calibration", "discrepancy", "uav_twin", "twin_master", "fe", "reporting"):
        for file in (ROOT / package).rglob("*.py"):
            tree = ast.parse(file.read_text(encoding="utf-8"))
            aside = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}  # docstrings
            constants = [node for node in ast.walk(tree) if isinstance(node, ast.Constant)]
            told = [node.value for node in constants if isinstance(node.value, str) and id(node) not in aside]
            texts += [" ".join(word for word in text.split() if not word.isidentifier()) for text in told]
    assert len(texts) > 1000
    assert [text for text in texts if other.search(text)] == []
