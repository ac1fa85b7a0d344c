"""A page is self-contained, escaped, numbered and well-formed; its figures say the values that were drawn.

Figures are of one style, with reproducible bytes, and change nothing global.
"""

import base64
import hashlib
import re
from html.parser import HTMLParser
from itertools import pairwise

import matplotlib as mpl
import numpy as np
import pytest

from benchmarks.browser import CHROMIUM, open_browser
from reporting import figures
from reporting.errors import InvalidFigureError
from reporting.page import Page, PageColumn, Table, Words, script_source
from reporting.tiles import tiles_of_figure

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
    assert result.add_figure(svg(), "What is seen, in µε.", title='What & "whose" <size>') == 1
    result.add_section("Second")
    assert result.add_figure(svg(), "The same.", title="Another") == 2
    columns = (PageColumn("quantity"), PageColumn("value", unit="N/mm", numeric=True))
    assert result.add_table(Table(columns, [("<k>", "0.677")]), "A caption.", title="Stiffness") == 1
    return result


def test_a_page_is_well_formed_and_escaped_and_asks_nothing_of_any_server():
    """Its links lead somewhere, and a server can allow its script and no other."""
    text = page("Title <img src=x>").render()
    seen = parse(text).seen
    tags = [tag for tag, _ in seen]
    assert tags.count("script") == 1  # what shows values under the pointer
    assert "b" in tags  # the numbers of figures and tables only
    assert "one &lt;b&gt;line&lt;/b&gt;" in text
    assert (tags.count("figure"), tags.count("section")) == (2, 2)
    assert "3.5\u00a0%" in text  # units and figures stay on one line
    assert "<small>N/mm</small>" in text
    identifiers = [attributes["id"] for _, attributes in seen if "id" in attributes]
    assert len(identifiers) == len(set(identifiers))
    for tag, attributes in seen:
        assert tag not in {"img", "link", "iframe", "object", "embed"}
        assert "src" not in attributes
        for value in (attributes.get(name) for name in ("href", "xlink:href") if name in attributes):
            assert value
            assert value.startswith("#")
            assert value[1:] in identifiers
    assert not re.search(r"@import|url\((?!#)", text)
    assert set(re.findall(r"url\(#(.*?)\)", text)) <= set(identifiers)
    assert 'What & "whose" <size>' in [attributes.get("aria-label") for _, attributes in seen]
    (script,) = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert script_source() == f"'sha256-{digest}'"
    empty = Page("Empty").render()
    parse(empty)
    assert "<nav>" not in empty
    assert "<script" not in empty


def test_what_can_be_no_part_of_a_page_is_refused():
    for data in (b"", b"not a drawing", b"<svg", b"<svg width='3'></svg>"):
        with pytest.raises(InvalidFigureError):
            figures.inline_svg(data, "f1", "x")
    for size in (0.0, -1.0, float("nan")):
        with pytest.raises(InvalidFigureError, match="positive size"):
            figures.new_figure(size)
    with pytest.raises(InvalidFigureError, match="Row 1 of a table has 1 cells"):
        Table((PageColumn("a"), PageColumn("b")), [("1", "2"), ("3",)])


def test_words_say_cells_units_columns_that_may_go_and_rows_that_are_always_there():
    words = Words("twin_master.report", half=0.5)
    cells = [
        {"text": "name", "cell": "{{ row }}"},
        {"number": "{{ what }}", "unit": "m", "cell": "{{ half }}"},
    ]
    words.content = {"tables": {"t": {"columns": [*cells, {"text": "more", "cell": "x", "when": "long"}]}}}
    columns, rows = words.table("t", ["a"], what="length", long=False)
    assert (columns, rows) == ([PageColumn("name"), PageColumn("length", "m", numeric=True)], [["a", "0.5"]])
    assert words.table("t", ["a"], what="length", long=True)[1] == [["a", "0.5", "x"]]
    words.content["tables"]["t"] = {"columns": ["item", "value"], "rows": [["{{ what }}", "1"], ["none", ""]]}
    assert words.table("t", [["b", "2"]], what="length")[1] == [["length", "1"], ["b", "2"]]


X = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
Y = np.array([12.0, 13.5, 11.25, 14.0, 15.0])


def drawing() -> "figures.Figure":
    with figures.publication_style():
        figure = figures.new_figure(4.0)
        above = figure.add_axes((0.1, 0.6, 0.8, 0.3))
        above.fill_between(X, Y - 2.0, Y + 1.0, color=figures.PAST, alpha=figures.BAND_OPACITY)
        above.plot(X, Y, color=figures.PAST, label='speed < "limit"')
        above.axhline(10.0, color=figures.REFERENCE, label="limit")
        above.errorbar([2.5], [12.5], yerr=[[0.25], [0.5]], fmt="D", color=figures.PRESENT, label="tested")
        above.set_xlabel("time (s)")
        above.set_ylabel("speed (m/s)")
        figures.panel_label(above, "a", "Tunnel")
        left = figure.add_axes((0.1, 0.1, 0.35, 0.3))
        left.plot(X, 10.0**X, color=figures.PAST)
        left.set_yscale("log")
        left.set_xlabel("step")
        right = figure.add_axes((0.55, 0.1, 0.35, 0.3))
        right.scatter([1.0, 2.0, 3.0], [0.0, 1.0, 1.0], label="choice")
        right.set_yticks([0, 1], ["2g", "3g"])
        field = figure.add_axes((0.55, 0.42, 0.3, 0.1))
        mesh = field.pcolormesh(
            [0.5, 1.5, 2.5, 3.5], [0.0, 10.0, 20.0], [[0.1, 0.25, 0.5], [1.0, np.nan, 3.0]]
        )
        figure.colorbar(mesh, cax=figure.add_axes((0.9, 0.42, 0.02, 0.1)), label="residual")
        field.set_xlabel("gauge")
        image = figure.add_axes((0.1, 0.42, 0.3, 0.1))
        image.imshow([[1.0, 2.0], [3.0, 4.0]], aspect="auto")
        image.set_yticks([])
    return figure


SEEN = {
    "0": ['a Tunnel: speed < "limit"', "time (s): 2", "speed (m/s): 11.25 (9.25 to 12.25)"],
    "1": ["a Tunnel: tested", "time (s): 2.5", "speed (m/s): 12.5 (12.25 to 13)"],
    "2": ['speed < "limit"', "step: 2", "100"],
    "3": ["choice", "2", "3g"],
}
"""What is said at the middle point of each series, in the order of drawing."""


CELLS = {
    (3, 0.9, 0.25): ["gauge: 3", "5", "residual: 0.5"],
    (3, 0.1, 0.75): ["gauge: 1", "15", "residual: 1"],
    (3, 0.5, 0.75): None,
    (4, 0.75, 0.75): ["1", "residual: 2"],
    (4, 0.25, 0.25): ["0", "residual: 3"],
}
"""What is said in maps: number of the panel, share of its width and height; None where there is no value."""


def test_bytes_follow_from_the_data_alone():
    """No setting of a user's, no date, no program; and nothing of the user's or the figure is changed."""
    import matplotlib.pyplot as pyplot

    before, known, figure = dict(mpl.rcParams), pyplot.get_fignums(), drawing()
    svg, png = figures.to_svg(figure), figures.to_png(figure, 60)
    assert dict(mpl.rcParams) == before
    assert pyplot.get_fignums() == known
    with mpl.rc_context({"font.size": 30, "svg.fonttype": "none", "axes.edgecolor": "red", "savefig.dpi": 7}):
        assert (figures.to_svg(drawing()), figures.to_png(drawing(), 60)) == (svg, png)
    assert figures.to_svg(figure) == svg
    assert all(artist.get_gid() is None for axes in figure.axes for artist in (axes, *axes.get_children()))
    assert png.startswith(b"\x89PNG")
    assert b"Software" not in png
    assert not re.search(rb"<!DOCTYPE|metadata|date|http(?!://www\.w3\.org/)", svg)
    assert svg.count(b"data-axes=") == 5  # the scale of colours is none
    assert svg.count(b"data-series=") == len(SEEN)  # a limit has no points
    assert not re.search(rb'id="hover', svg)


def several_panels(rows: int, columns: int, *, wide_row: bool = False) -> "figures.Figure":
    """Return a figure of equal panels, perhaps with one below them that is as wide as the figure."""
    with figures.publication_style():
        figure = figures.new_figure(2.0 * rows + 2.0)
        grid = figure.add_gridspec(rows + 1, columns, left=0.1, right=0.97, top=0.85, hspace=0.7, wspace=0.4)
        places = [grid[row, column] for row in range(rows) for column in range(columns)]
        for number, place in enumerate([*places, *([grid[rows, :]] if wide_row else [])]):
            axes = figure.add_subplot(place)
            axes.plot(X, Y, label=f"line {number} with a long name")
            axes.set(xlabel="time (s)", ylabel="speed (m/s)", title=f"panel {number}")
        figures.shared_legend(figure, rows=2)
    return figure


@pytest.mark.parametrize("wide_row", [False, True])
def test_the_tiles_of_a_figure_are_narrow_and_cut_no_panel(wide_row):
    figure = several_panels(2, 2, wide_row=wide_row)
    tiles = tiles_of_figure(figure)
    height = 72.0 * figure.get_size_inches()[1]
    width = 72.0 * figure.get_size_inches()[0]
    holders = []
    for axes in figure.axes:
        box = axes.get_position()
        ends = (width * box.x0, width * box.x1, height * (1.0 - box.y1), height * (1.0 - box.y0))
        inside = [
            number
            for number, tile in enumerate(tiles)
            if tile.x <= ends[0] and ends[1] <= tile.x_end and tile.y <= ends[2] and ends[3] <= tile.y_end
        ]
        assert len(inside) == 1  # the panel is whole in one tile, and in no other
        holders += inside
    is_narrow = [tiles[number].is_narrow for number in holders]
    assert is_narrow == [True] * 4 + [False] * wide_row
    if not wide_row:  # a column stands below the other, with its shared axis
        assert holders[0] == holders[2] != holders[1] == holders[3]
    assert all(tile.is_narrow for tile in tiles[: min(holders)])  # the legend comes first, in parts


def test_a_colour_bar_stays_beside_its_panel():
    with figures.publication_style():
        figure = figures.new_figure(2.0)
        axes = figure.add_axes((0.3, 0.2, 0.6, 0.7))
        axes.pcolormesh([[1.0, 2.0]])
        figures.color_bar(figure, mpl.cm.ScalarMappable(), "of no panel", ax=axes, location="left")
    assert len(tiles_of_figure(figure)) == 1


def test_a_drawing_keeps_the_look_that_its_file_states_for_all_letters():
    svg = b'<svg viewBox="0 0 9 9" font-size="11" text-anchor="middle"><text id="a">x</text></svg>'
    drawn = figures.inline_svg(svg, "f1", "A drawing")
    parse(drawn.full)
    assert 'font-size="11"' in drawn.full
    assert 'text-anchor="middle"' in drawn.full
    assert drawn.full.count("viewBox") == 1
    assert drawn.tiles == ()


def test_a_card_stands_open_and_a_fold_is_closed():
    page = Page("Title")
    page.add_section("Verdict")
    page.add_card("Friction at the joint < 3 N")
    page.begin_fold("Why & how")
    page.add_paragraph("Because.")
    page.end_fold()
    page.add_paragraph("After.")
    text = page.render()
    parse(text)
    assert '<p class="card">Friction at the joint &lt; 3\u00a0N</p>' in text
    fold = text[text.index("<details>") : text.index("</details>")]
    assert "<summary>Why &amp; how</summary>" in fold
    assert "Because." in fold
    assert "After." not in fold


def test_a_fold_of_words_is_left_out_with_all_its_blocks():
    words = Words("twin_master.report")
    blocks = [{"card": "{{ x }}"}, {"fold": "More", "blocks": [{"say": "{{ y }}"}]}]
    assert [kind for kind, _ in words.rendered_blocks(blocks, x="a", y="b")] == [
        "card", "fold", "say", "end of fold",
    ]  # fmt: skip
    assert [kind for kind, _ in words.rendered_blocks(blocks, x="a", y=" ")] == ["card"]


@pytest.mark.skipif(CHROMIUM is None, reason="needs a browser")
def test_a_narrow_page_shows_panels_below_one_another_with_their_values(tmp_path):
    page = Page("Narrow")
    page.add_figure(figures.to_svg(several_panels(2, 2)), "Caption.", title="Figure")
    file = tmp_path / "page.html"
    file.write_text(page.render(), encoding="utf-8")
    with open_browser() as browser:
        tab = browser.tab()
        tab.go(f"file://{file}", 400, 1200)
        tab.wait("document.readyState === 'complete'")
        assert tab.value("document.documentElement.scrollWidth") <= 400
        boxes = """[...document.querySelectorAll('.tile svg')].map((one) => one.getBoundingClientRect())
          .map((box) => [box.left, box.right, box.top, box.bottom])"""
        tiles = tab.value(boxes)
        assert all(left >= 0 and right <= 400 for left, right, _, _ in tiles)
        assert all(above[3] <= below[2] for above, below in pairwise(tiles))
        find = """() => { const line = document.querySelector('[data-series]');
          const [left, right, bottom, top] = JSON.parse(line.closest('[data-axes]').dataset.axes).box;
          const holds = ({ x, y, width, height }) =>
            x <= left && right <= x + width && y <= top && bottom <= y + height;
          const tile = [...document.querySelectorAll('.tile svg')].find((one) => holds(one.viewBox.baseVal));
          const points = [...line.querySelector('path').getAttribute('d').matchAll(/[ML] (\\S+) (\\S+)/g)];
          const at = new DOMPoint(+points[2][1], +points[2][2]).matrixTransform(tile.getScreenCTM());
          return [at.x, at.y]; }"""
        x, y = tab.value(f"({find})()")
        tab.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        seen = tab.value("document.querySelector('.reading').innerText").split("\n")
        assert seen[1:] == ["time (s): 2", "speed (m/s): 11.25"]
        tab.go(f"file://{file}", 1300, 1200)
        tab.wait("document.readyState === 'complete'")
        assert tab.value("getComputedStyle(document.querySelector('.tile')).display") == "none"
        assert tab.errors == []


DOLLAR = b'-7"'
"""End of the name of the dollar sign's outline in DejaVu Sans."""


@pytest.mark.parametrize("said", [{}, {"parse_math": True}], ids=["a user", "the program"])
def test_text_is_mathematics_where_the_program_says_so(said):
    """Broken mathematics of a user would end the drawing, and whole one would not be what was written."""
    with figures.publication_style():
        figure = figures.new_figure(2.0)
        axes = figure.add_axes((0.1, 0.1, 0.8, 0.8))
        axes.loglog([1, 1e4], [1, 1e4], label="seen" if said else "$_{$")
        axes.set_title("of $x^2$" if said else r"of $\frac{1$ and of $x^2$", **said)
        axes.legend()
    assert (DOLLAR in figures.to_svg(figure)) == (not said)


@pytest.mark.skipif(CHROMIUM is None, reason="needs a browser")
def test_the_pointer_and_a_tap_are_told_what_was_drawn(tmp_path):
    page = Page("Values")
    page.add_figure(figures.to_svg(drawing()), "Caption.", title="Figure")
    file = tmp_path / "page.html"
    file.write_text(page.render(), encoding="utf-8")
    find = """(number) => { const one = document.querySelectorAll('[data-series]')[number];
      const marks = [...one.querySelectorAll('use')]
        .map((use) => [+use.getAttribute('x'), +use.getAttribute('y')]);
      const line = () => [...one.querySelector('path').getAttribute('d').matchAll(/[ML] (\\S+) (\\S+)/g)]
        .map((found) => [+found[1], +found[2]]);
      const points = marks.length ? marks : line(), [x, y] = points[points.length >> 1];
      const at = new DOMPoint(x, y).matrixTransform(one.closest('svg').getScreenCTM());
      return [at.x, at.y]; }"""
    with open_browser() as browser:
        tab = browser.tab()
        tab.go(f"file://{file}", 1300, 1200)
        tab.wait("document.readyState === 'complete'")
        sign = "document.querySelector('.reading')"
        for number, lines in SEEN.items():
            x, y = tab.value(f"({find})({number})")
            tab.send("Input.dispatchMouseEvent", type="mouseMoved", x=x + 2.0, y=y + 1.0)
            assert tab.value(f"{sign}.innerText").split("\n") == lines
            assert tab.value("document.querySelectorAll('.ring').length") == 1
        at = """(panel, right, up) => { const group = document.querySelectorAll('[data-axes]')[panel];
          const [x0, x1, y0, y1] = JSON.parse(group.dataset.axes).box;
          const place = new DOMPoint(x0 + right * (x1 - x0), y0 + up * (y1 - y0));
          const seen = place.matrixTransform(group.closest('svg').getScreenCTM());
          return [seen.x, seen.y]; }"""
        for place, cell in CELLS.items():
            left, top = tab.value(f"({at})({', '.join(map(str, place))})")
            tab.send("Input.dispatchMouseEvent", type="mouseMoved", x=left, y=top)
            assert tab.value(f"{sign}.hidden ? null : {sign}.innerText.split('\\n')") == cell
        tab.press("Escape")
        assert tab.value(f"{sign}.hidden")
        tab.send("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y}])
        tab.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
        assert not tab.value(f"{sign}.hidden")
        tab.send("Emulation.setEmulatedMedia", media="print")
        assert tab.value(f"getComputedStyle({sign}).display") == "none"
        assert tab.errors == []
        assert [one for one in tab.requests if not one.startswith("data:")] == [f"file://{file}"]
