"""A page is self-contained, escaped, numbered and well-formed."""

import base64
import hashlib
import re
from html.parser import HTMLParser

import pytest

from reporting.errors import InvalidFigureError
from reporting.pages import figures
from reporting.pages.inline_svg import inline_svg
from reporting.pages.page import (
    Fold,
    Highlights,
    Notice,
    Page,
    PageFigure,
    Section,
    render_page,
    script_source,
)
from reporting.pages.page_words import Words
from reporting.pages.table import (
    PageColumn,
    Table,
    item_table,
    number_cells,
    table_of_records,
    text_cells,
)

VOID_TAGS = {"meta", "br", "link", "img"}

Attributes = dict[str, str | None]


class Checker(HTMLParser):
    """Collects tags with their attributes, and notices one that is closed out of turn."""

    def __init__(self) -> None:
        super().__init__()
        self.open_tags: list[str] = []
        self.elements: list[tuple[str, Attributes]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID_TAGS:
            self.open_tags.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open_tags.pop() == tag


def parse(text: str) -> list[tuple[str, Attributes]]:
    """Return the elements of a page, which must be well-formed."""
    checker = Checker()
    checker.feed(text)
    checker.close()
    assert checker.open_tags == []
    return checker.elements


def draw_line() -> bytes:
    with figures.publication_style():
        figure = figures.new_figure(1.0)
        figure.add_axes((0.2, 0.2, 0.6, 0.6)).plot([0, 1], [1, 0])
    return figures.to_svg(figure)


TABLE = Table(
    (PageColumn("quantity"), PageColumn("value", unit="N/mm", numeric=True)),
    [("<k>", "0.677")],
    "Stiffness",
    "A caption.",
)


def make_page() -> Page:
    """Return a page with one of everything, and with texts that must be escaped."""
    picture = PageFigure("line", draw_line(), 'What & "whose" <size>', "What is seen, in µε.")
    return Page(
        "Title <img src=x>",
        subtitle="one <b>line</b>",
        sentence="The <wing> holds.",
        picture=picture,
        outcome=[Highlights([("3.5 %", "damage <1>")]), Notice("<script>alert('x')</script>")],
        sections=[
            Section("First <section>", ["if a < b & b > c"]),
            Section("Second", [picture._replace(title="Another"), Fold("More", [TABLE])]),
        ],
        footer=["A source & its year."],
    )


@pytest.fixture(scope="module")
def text() -> str:
    return render_page(make_page())


@pytest.fixture(scope="module")
def elements(text) -> list[tuple[str, Attributes]]:
    return parse(text)


@pytest.fixture(scope="module")
def tags(elements) -> list[str]:
    return [tag for tag, _ in elements]


@pytest.fixture(scope="module")
def identifiers(elements) -> list[str | None]:
    return [attributes["id"] for _, attributes in elements if "id" in attributes]


def script_of(text: str) -> str:
    """Return the one script of a page."""
    (script,) = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    return script


# ---------------------------------------------------------------- numbers, escapes, units


def test_figures_and_tables_are_numbered_in_the_order_of_the_page(text):
    assert re.findall(r"<b>((?:Figure|Table) \d)\.", text) == ["Figure 1", "Figure 2", "Table 1"]


def test_the_first_screen_is_sentence_picture_and_outcome_and_the_contents_follow(text):
    marks = ('class="card"', 'id="figure-1"', 'class="highlights"', 'class="notice"', "<nav>")
    places = [text.index(mark) for mark in (*marks, 'id="section-1"')]

    assert places == sorted(places)


def test_a_page_has_its_sections_and_figures(tags):
    assert (tags.count("figure"), tags.count("section")) == (2, 2)


def test_texts_of_users_are_escaped(text, tags):
    """Elements of the page itself are bold: the numbers of figures and tables."""
    assert "one &lt;b&gt;line&lt;/b&gt;" in text
    assert "b" in tags
    assert tags.count("script") == 1  # what shows values under the pointer


def test_a_figure_is_named_for_readers_of_the_screen(elements):
    labels = [attributes.get("aria-label") for _, attributes in elements]

    assert 'What & "whose" <size>' in labels


def test_units_and_numbers_stay_on_one_line(text):
    assert "3.5\u00a0%" in text


def test_a_column_shows_its_unit(text):
    assert "<small>N/mm</small>" in text


# ---------------------------------------------------------------- self-contained


def test_a_page_asks_nothing_of_any_server(text, elements, tags):
    sources = [attributes["src"] for _, attributes in elements if "src" in attributes]

    assert not {"img", "link", "iframe", "object", "embed"} & set(tags)
    assert sources == []
    assert not re.search(r"@import|url\((?!#)", text)


def test_identifiers_of_a_page_are_unique(identifiers):
    assert len(identifiers) == len(set(identifiers))


def test_links_of_a_page_lead_to_its_elements(elements, identifiers):
    for _, attributes in elements:
        for name in ("href", "xlink:href"):
            if name in attributes:
                target = attributes[name]
                assert target.startswith("#"), target
                assert target[1:] in identifiers


def test_references_of_styles_lead_to_elements_of_the_page(text, identifiers):
    assert set(re.findall(r"url\(#(.*?)\)", text)) <= set(identifiers)


def test_a_server_can_allow_the_script_of_a_page_and_no_other(text):
    digest = hashlib.sha256(script_of(text).encode()).digest()

    assert script_source() == f"'sha256-{base64.b64encode(digest).decode()}'"


def test_an_empty_page_has_no_contents_and_no_script():
    text = render_page(Page("Empty"))

    parse(text)
    assert "<nav>" not in text
    assert "<script" not in text


# ---------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    "data", [b"", b"not a drawing", b"<svg", b"<svg width='3'></svg>"], ids=repr
)
def test_a_text_that_is_no_drawing_is_refused(data):
    with pytest.raises(InvalidFigureError):
        inline_svg(data, "f1", "x")


@pytest.mark.parametrize("size", [0.0, -1.0, float("nan")])
def test_a_figure_needs_a_positive_size(size):
    with pytest.raises(InvalidFigureError, match="positive size"):
        figures.new_figure(size)


def test_a_row_with_too_few_cells_is_refused():
    with pytest.raises(InvalidFigureError, match="Row 1 of a table has 1 cells"):
        Table((PageColumn("a"), PageColumn("b")), [("1", "2"), ("3",)])


# ---------------------------------------------------------------- tables of records and words


def test_a_table_of_records_has_a_row_for_each_and_units_of_numbers():
    columns = [text_cells("name", lambda length: f"rod {length}"), number_cells("length", str, "m")]

    table = table_of_records(columns, [1, 2])

    assert table.columns == [PageColumn("name"), PageColumn("length", "m", numeric=True)]
    assert table.rows == [["rod 1", "1"], ["rod 2", "2"]]


EMPTY_BLOCKS = {
    "nothing": None,
    "blanks": " ",
    "a notice without text": Notice(""),
    "no values": Highlights([]),
    "a table without rows": Table([PageColumn("name")], [], "Rods", "None was found."),
    "an empty fold": Fold("Rods", [None, ""]),
}


@pytest.mark.parametrize("block", EMPTY_BLOCKS.values(), ids=EMPTY_BLOCKS)
def test_a_section_with_nothing_but_empty_blocks_is_left_out(block):
    text = render_page(Page("Rods of a frame", sections=[Section("Rods", [block])]))

    assert text == render_page(Page("Rods of a frame"))


def test_a_table_of_items_leaves_out_those_without_a_value():
    table = item_table([("seed", "3"), ("plug-ins", " ")], "Run", "")

    assert table.rows == [("seed", "3")]


def test_words_fill_the_fields_of_headings_and_captions():
    words = Words("twin_master.report")
    words.content = {
        "tables": {
            "rods": {
                "title": "Rods of {{ asset }}",
                "caption": "Measured.",
                "columns": ["name", {"number": "{{ what }}", "unit": "m"}],
            }
        }
    }

    table = words.table(
        "rods", [["a", "0.5", "x"]], columns=[PageColumn("mark")], asset="frame", what="length"
    )

    assert table.title == "Rods of frame"
    assert [column.name for column in table.columns] == ["name", "length", "mark"]
