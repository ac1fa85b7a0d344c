"""A page is self-contained, escaped, numbered and well-formed."""

import base64
import hashlib
import re
from html.parser import HTMLParser

import pytest

from reporting import figures
from reporting.errors import InvalidFigureError
from reporting.page import Column, Page, Table, Words, script_source

VOID = {"meta", "br", "link", "img"}


class Checker(HTMLParser):
    """Collects tags, and notices one that is closed out of turn."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def parse(text: str) -> Checker:
    checker = Checker()
    checker.feed(text)
    checker.close()
    assert checker.open == []
    return checker


def svg() -> bytes:
    with figures.publication_style():
        figure = figures.new_figure(1.0)
        figure.add_axes((0.2, 0.2, 0.6, 0.6)).plot([0, 1], [1, 0])
    return figures.to_svg(figure)


def page(title: str = "Title") -> Page:
    result = Page(title, subtitle="one <b>line</b>", footer=["A source & its year."])
    result.add_section("First <section>")
    result.add_paragraph("if a < b & b > c")
    result.add_highlights([("3.5 %", "damage <1>")])
    result.add_notice("<script>alert('x')</script>")
    assert result.add_figure(svg(), "What is seen, in µε.", title="A figure") == 1
    result.add_section("Second")
    assert result.add_figure(svg(), "The same.", title="Another") == 2
    columns = (Column("quantity"), Column("value", unit="N/mm", numeric=True))
    assert result.add_table(Table(columns, [("<k>", "0.677")]), "A caption.", title="Stiffness") == 1
    return result


@pytest.fixture(scope="module")
def text() -> str:
    return page("Title <img src=x>").render()


def test_page_is_well_formed_and_escaped(text):
    tags = [tag for tag, _ in parse(text).seen]
    assert tags.count("script") == 1  # what shows values under the pointer
    assert "img" not in tags
    assert "b" in tags  # the numbers of figures and tables only
    assert "one &lt;b&gt;line&lt;/b&gt;" in text
    assert tags.count("figure") == 2
    assert tags.count("section") == 2
    assert "3.5\u00a0%" in text  # units and figures stay on one line
    assert "<small>N/mm</small>" in text
    assert page("Title <img src=x>").render() == text


def test_page_asks_nothing_of_any_server_and_its_links_lead_somewhere(text):
    seen = parse(text).seen
    identifiers = [attributes["id"] for _, attributes in seen if "id" in attributes]
    assert len(identifiers) == len(set(identifiers))
    for tag, attributes in seen:
        assert tag not in {"link", "iframe", "object", "embed"}
        assert "src" not in attributes
        for name in ("href", "xlink:href"):
            assert (attributes.get(name) or "#").startswith("#")
        assert tag != "a" or (attributes["href"] or "").removeprefix("#") in identifiers
    assert not re.search(r"@import|url\((?!#)", text)


def test_a_server_can_allow_the_script_and_no_other(text):
    (script,) = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert script_source() == f"'sha256-{digest}'"


def test_a_ragged_table_is_refused():
    with pytest.raises(InvalidFigureError, match="Row 1 of a table has 1 cells"):
        Table((Column("a"), Column("b")), [("1", "2"), ("3",)])


def test_an_empty_page_is_still_a_page():
    text = Page("Empty").render()
    parse(text)
    assert "<nav>" not in text
    assert "<script" not in text


def test_words_say_cells_units_columns_that_may_go_and_rows_that_are_always_there():
    words = Words("twin_master.report", half=0.5)
    cells = [
        {"text": "name", "cell": "{{ row }}"},
        {"number": "{{ what }}", "unit": "m", "cell": "{{ half }}"},
    ]
    words.content = {"tables": {"t": {"columns": [*cells, {"text": "more", "cell": "x", "when": "long"}]}}}
    columns, rows = words.table("t", ["a"], what="length", long=False)
    assert (columns, rows) == ([Column("name"), Column("length", "m", numeric=True)], [["a", "0.5"]])
    assert words.table("t", ["a"], what="length", long=True)[1] == [["a", "0.5", "x"]]
    words.content["tables"]["t"] = {"columns": ["item", "value"], "rows": [["{{ what }}", "1"], ["none", ""]]}
    assert words.table("t", [["b", "2"]], what="length")[1] == [["length", "1"], ["b", "2"]]
