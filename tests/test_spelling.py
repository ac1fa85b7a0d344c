"""Pages use the terms of the glossary, and none of the spellings that it turns down."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
CODE = re.compile(r"^```.*?^```|`[^`\n]*`|\]\([^)]*\)", re.MULTILINE | re.DOTALL)
TURNED = ("one sees", "the house", "that we know", "believes ours", "gone on with", "elements, please")
"""Turns of other languages that were found once."""


def test_pages_use_the_terms_of_the_glossary():
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
