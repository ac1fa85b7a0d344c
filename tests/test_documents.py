"""Pages use the terms of the glossary, their links lead somewhere, the picture is what its script draws."""

import ast
import re
from functools import cache
from itertools import chain, count
from pathlib import Path
from xml.etree import ElementTree

import pytest

from benchmarks.pictures import whole

ROOT = Path(__file__).parents[1]
PAGES = [*ROOT.glob("*.md"), *sorted((ROOT / "docs").rglob("*.md"))]
FRONT = ROOT / "docs" / "site" / "index.md"
"""Stands in the place of `docs/index.md` on the site."""
CODE = re.compile(r"^```.*?^```|`[^`\n]*`", re.MULTILINE | re.DOTALL)


@cache
def places(page: Path) -> set[str]:
    """Return the names of a page's headings, as code hosts make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    found: set[str] = set()
    for heading in re.findall(r"^#+ (.*)$", text, re.MULTILINE):
        plain = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").strip().lower()
        name = re.sub(r"[^\w\- ]", "", plain).replace(" ", "-")
        numbered_names = (f"{name}-{number}" for number in count(1))
        found.add(next(place for place in chain([name], numbered_names) if place not in found))
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    text = CODE.sub("", page.read_text(encoding="utf-8"))
    folder = ROOT / "docs" if page == FRONT else page.parent
    lost = []
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        name, _, place = link.partition("#")
        target = (folder / name).resolve() if name else page
        if "://" not in link and not (target.exists() and (not place or place in places(target))):
            lost.append(link)
    assert lost == []


def test_each_page_stands_in_a_table_of_contents_of_the_site():
    docs = ROOT / "docs"
    listed = {docs / "index.md", FRONT}
    for page in docs.rglob("*.md"):
        text = page.read_text(encoding="utf-8")
        for contents in re.findall(r"^```{toctree}\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
            for entry in re.findall(r"^[^:\s].*$", contents, re.MULTILINE):
                folder = docs if entry.startswith("/") or page == FRONT else page.parent
                target = (folder / entry.lstrip("/")).resolve()
                listed.update(target.parent.glob(f"{target.name}.*"))
    assert set(docs.rglob("*.md")) - listed == set()


PLAIN = re.compile(rf"{CODE.pattern}|\]\([^)]*\)", CODE.flags)
TURNED = ("one sees", "the house", "that we know", "believes ours", "gone on with", "elements, please")
"""Turns of other languages that were found once."""


def test_pages_use_the_terms_of_the_glossary():
    glossary = ROOT / "docs" / "reference" / "glossary.md"
    rows = re.findall(r"^\| (.+?) \| .+ \| (.+?) \|$", glossary.read_text(encoding="utf-8"), re.MULTILINE)
    refused = [word for term, words in rows if term not in ("term", "---") for word in words.split(", ")]
    assert len(refused) > 30
    other = re.compile(rf"\b({'|'.join(map(re.escape, [*refused, *TURNED]))})\b", re.IGNORECASE)
    found = {
        str(page.relative_to(ROOT)): words
        for page in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md"))
        if page != glossary and (words := {*other.findall(PLAIN.sub("", page.read_text(encoding="utf-8")))})
    }
    assert not found


HOW_TO_ADD = sorted((ROOT / "docs" / "how_to" / "add").glob("*.md"))


@pytest.mark.parametrize("page", HOW_TO_ADD, ids=lambda page: page.stem)
def test_examples_of_how_to_add_are_lines_of_the_files_that_they_name(page):
    text = page.read_text(encoding="utf-8")
    examples = re.findall(r"^```(?:py|toml)\n# (\S+)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert examples
    for file, lines in examples:
        source = (ROOT / file).read_text(encoding="utf-8")
        position = 0
        for piece in lines.split("...\n"):
            position = source.find(f"\n{piece}", position)
            assert position >= 0, f"{file} has no longer, in this order:\n{piece}"
            position += len(piece)


@pytest.mark.parametrize("page", HOW_TO_ADD, ids=lambda page: page.stem)
def test_paths_of_how_to_add_exist(page):
    text = page.read_text(encoding="utf-8")
    folders = "benchmarks|discrepancy|docs|fe|reporting|tests|twin_master|uav_twin"
    paths = re.findall(rf"(?:(?<=`)|(?<= ))(?:{folders})(?:/[\w*]+)+(?:\.\w+)*", text)
    assert paths
    assert [path for path in paths if "NAME" not in path and not list(ROOT.glob(path))] == []


IMAGES = ROOT / "docs" / "images"


def test_the_committed_picture_is_what_the_script_draws():
    drawn = whole.draw()
    ElementTree.fromstring(drawn)
    assert (IMAGES / "whole.svg").read_text(encoding="utf-8") == drawn


EXPLAINED = [
    page for folder in ("explanation", "reference") for page in sorted((ROOT / "docs" / folder).glob("*.md"))
]
CALL = re.compile(r"(?<![\w.])([A-Za-z_][\w.]*)\(")
"""A call such as `operators.mass(`, with its name."""
OF_PYTHON = {"help", "basicConfig", "open_datatree"}


@cache
def defined_names() -> set[str]:
    """Return the names of all functions and classes of the project."""
    names = set()
    for package in ("calibration", "discrepancy", "fe", "fmu_asset", "reporting", "twin_master", "uav_twin"):
        for file in (ROOT / package).rglob("*.py"):
            nodes = ast.walk(ast.parse(file.read_text(encoding="utf-8")))
            names |= {node.name for node in nodes if isinstance(node, ast.ClassDef | ast.FunctionDef)}
    return names


@pytest.mark.parametrize("page", EXPLAINED, ids=lambda page: page.stem)
def test_calls_in_the_text_of_a_page_are_functions_of_the_project(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    called = [name.split(".")[-1] for span in re.findall(r"`([^`\n]+)`", text) for name in CALL.findall(span)]
    assert {*called} - defined_names() - OF_PYTHON == set()
