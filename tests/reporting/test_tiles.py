"""Panels of a figure below one another on a narrow page; cards, folds, the look of a drawing."""

from itertools import pairwise

import matplotlib as mpl
import numpy as np
import pytest

from benchmarks.browser import CHROMIUM, open_browser
from reporting import figures
from reporting.page import Page
from reporting.tiles import tiles_of_figure
from tests.reporting.test_page import parse

X = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
Y = np.array([12.0, 13.5, 11.25, 14.0, 15.0])


def several_panels(rows: int, columns: int, *, wide_row: bool = False) -> "figures.Figure":
    """Return a figure of equal panels, perhaps with one below them of the width of the figure."""
    with figures.publication_style():
        figure = figures.new_figure(2.0 * rows + 2.0)
        grid = figure.add_gridspec(
            rows + 1, columns, left=0.1, right=0.97, top=0.85, hspace=0.7, wspace=0.4
        )
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
            if tile.x <= ends[0]
            and ends[1] <= tile.x_end
            and tile.y <= ends[2]
            and ends[3] <= tile.y_end
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
        boxes = """[...document.querySelectorAll('.tile svg')]
          .map((one) => one.getBoundingClientRect())
          .map((box) => [box.left, box.right, box.top, box.bottom])"""
        tiles = tab.value(boxes)
        assert all(left >= 0 and right <= 400 for left, right, _, _ in tiles)
        assert all(above[3] <= below[2] for above, below in pairwise(tiles))
        find = """() => { const line = document.querySelector('[data-series]');
          const panel = JSON.parse(line.closest('[data-axes]').dataset.axes);
          const [left, right, bottom, top] = panel.box;
          const holds = ({ x, y, width, height }) =>
            x <= left && right <= x + width && y <= top && bottom <= y + height;
          const tiles = [...document.querySelectorAll('.tile svg')];
          const tile = tiles.find((one) => holds(one.viewBox.baseVal));
          const course = line.querySelector('path').getAttribute('d');
          const point = [...course.matchAll(/[ML] (\\S+) (\\S+)/g)][2];
          const at = new DOMPoint(+point[1], +point[2]).matrixTransform(tile.getScreenCTM());
          return [at.x, at.y]; }"""
        x, y = tab.value(f"({find})()")
        tab.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        seen = tab.value("document.querySelector('.reading').innerText").split("\n")
        assert seen[1:] == ["time (s): 2", "speed (m/s): 11.25"]
        tab.go(f"file://{file}", 1300, 1200)
        tab.wait("document.readyState === 'complete'")
        assert tab.value("getComputedStyle(document.querySelector('.tile')).display") == "none"
        assert tab.errors == []
