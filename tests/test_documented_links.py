"""Links between pages, and to places in them, lead somewhere: on a code host as on the site."""

import re
from functools import cache
from pathlib import Path

import pytest

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
        found.add(next(f"{name}{end}" for end in ("", "-1", "-2", "-3") if f"{name}{end}" not in found))
    return found


def broken(page: Path) -> list[str]:
    """Return the links of a page that lead nowhere."""
    text = CODE.sub("", page.read_text(encoding="utf-8"))
    folder = ROOT / "docs" if page == FRONT else page.parent
    lost = []
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        name, _, place = link.partition("#")
        target = (folder / name).resolve() if name else page
        if "://" not in link and not (target.exists() and (not place or place in places(target))):
            lost.append(link)
    return lost


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    assert broken(page) == []


def test_a_broken_link_is_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# A `b` c, d\n[a](page.md#a-b-c-d) [b](#nowhere) [c](none.md) `[d](none.md)`\n")
    assert broken(page) == ["#nowhere", "none.md"]
