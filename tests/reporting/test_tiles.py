"""Panels of a figure below one another on a narrow page; cards, folds, the look of a drawing."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
import pytest

from benchmarks.browser import CHROMIUM, Tab, open_browser
from reporting.pages import figures
from reporting.pages.inline_svg import inline_svg
from reporting.pages.page import Fold, Page, ReportFigure, Section, render_page
from reporting.pages.tiles import Tile, tiles_of_figure
from tests.costs import once
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


class TiledFigure(NamedTuple):
    """The tiles of a figure, and for each panel the numbers of the tiles that hold it whole."""

    tiles: Sequence[Tile]
    holders: list[list[int]]


@once
def tiled(wide_row: bool) -> TiledFigure:
    """Return the tiles of two by two panels, perhaps with one of the whole width below them."""
    figure = several_panels(2, 2, wide_row=wide_row)
    tiles = tiles_of_figure(figure)
    width, height = 72.0 * figure.get_size_inches()  # points
    holders = []
    for axes in figure.axes:
        box = axes.get_position()
        left, right = width * box.x0, width * box.x1
        top, bottom = height * (1.0 - box.y1), height * (1.0 - box.y0)
        holders.append(
            [
                number
                for number, tile in enumerate(tiles)
                if tile.x <= left and right <= tile.x_end and tile.y <= top and bottom <= tile.y_end
            ]
        )
    return TiledFigure(tiles, holders)


@pytest.mark.parametrize("wide_row", [False, True])
def test_each_panel_of_a_figure_is_whole_in_one_tile_and_in_no_other(wide_row):
    assert [len(holders) for holders in tiled(wide_row).holders] == [1] * (4 + wide_row)


@pytest.mark.parametrize("wide_row", [False, True])
def test_tiles_are_narrow_but_that_of_a_panel_of_the_whole_width(wide_row):
    tiles, holders = tiled(wide_row)
    is_narrow = [tiles[number].is_narrow for (number,) in holders]
    assert is_narrow == [True] * 4 + [False] * wide_row


def test_a_column_of_panels_stands_below_the_other_with_its_shared_axis():
    upper_left, upper_right, lower_left, lower_right = tiled(False).holders
    assert upper_left == lower_left != upper_right == lower_right


@pytest.mark.parametrize("wide_row", [False, True])
def test_the_legend_comes_first_in_narrow_parts(wide_row):
    tiles, holders = tiled(wide_row)
    assert all(tile.is_narrow for tile in tiles[: min(min(holders))])


def test_a_colour_bar_stays_beside_its_panel():
    with figures.publication_style():
        figure = figures.new_figure(2.0)
        axes = figure.add_axes((0.3, 0.2, 0.6, 0.7))
        axes.pcolormesh([[1.0, 2.0]])
        figures.color_bar(figure, mpl.cm.ScalarMappable(), "of no panel", ax=axes, location="left")
    assert len(tiles_of_figure(figure)) == 1


DRAWING = b'<svg viewBox="0 0 9 9" font-size="11" text-anchor="middle"><text id="a">x</text></svg>'


def test_a_drawing_keeps_the_look_that_its_file_states_for_all_letters():
    drawn = inline_svg(DRAWING, "f1", "A drawing")
    parse(drawn.full)
    assert 'font-size="11"' in drawn.full
    assert 'text-anchor="middle"' in drawn.full


def test_a_drawing_has_one_box_and_no_tiles():
    drawn = inline_svg(DRAWING, "f1", "A drawing")
    assert drawn.full.count("viewBox") == 1
    assert drawn.tiles == ()


@pytest.fixture(scope="module")
def page_with_a_fold() -> str:
    """The text of a page with a card, a fold and a paragraph after it."""
    verdict = Section("Verdict", [Fold("Why & how", ["Because."]), "After."])
    return render_page(Page("Title", sentence="Friction at the joint < 3 N", sections=[verdict]))


def test_a_card_stands_open(page_with_a_fold):
    parse(page_with_a_fold)
    assert '<div class="card">Friction at the joint &lt; 3\u00a0N</div>' in page_with_a_fold


def test_a_fold_is_closed_and_ends_where_it_was_ended(page_with_a_fold):
    begin, end = page_with_a_fold.index("<details>"), page_with_a_fold.index("</details>")
    fold = page_with_a_fold[begin:end]
    assert "<summary>Why &amp; how</summary>" in fold
    assert "Because." in fold
    assert "After." not in fold


NARROW, WIDE = 400, 1300
"""Widths of a page on a phone and on a screen [px]."""

BOXES = """[...document.querySelectorAll('.tile svg')]
  .map((one) => one.getBoundingClientRect())
  .map((box) => [box.left, box.right, box.top, box.bottom])"""

THIRD_POINT_OF_THE_FIRST_LINE = """(() => { const line = document.querySelector('[data-series]');
  const panel = JSON.parse(line.closest('[data-axes]').dataset.axes);
  const [left, right, bottom, top] = panel.box;
  const holds = ({ x, y, width, height }) =>
    x <= left && right <= x + width && y <= top && bottom <= y + height;
  const tiles = [...document.querySelectorAll('.tile svg')];
  const tile = tiles.find((one) => holds(one.viewBox.baseVal));
  const course = line.querySelector('path').getAttribute('d');
  const point = [...course.matchAll(/[ML] (\\S+) (\\S+)/g)][2];
  const at = new DOMPoint(+point[1], +point[2]).matrixTransform(tile.getScreenCTM());
  return [at.x, at.y]; })()"""


@pytest.fixture(scope="module")
def page_with_panels(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The address of a page with a figure of two by two panels."""
    panels = ReportFigure("panels", several_panels(2, 2), "Figure", "Caption.")
    page = Page("Narrow", picture=figures.page_figure(panels))
    file = tmp_path_factory.mktemp("panels") / "page.html"
    file.write_text(render_page(page), encoding="utf-8")
    return f"file://{file}"


@pytest.fixture(scope="module")
def tab() -> Iterator[Tab]:
    """A tab of a browser that all tests here use."""
    if CHROMIUM is None:
        pytest.skip("needs a browser")
    with open_browser() as browser:
        yield browser.tab()


@pytest.fixture
def narrow_tab(tab: Tab, page_with_panels: str) -> Tab:
    """The page on a phone."""
    tab.go(page_with_panels, NARROW, 1200)
    tab.wait("document.readyState === 'complete'")
    return tab


def test_a_narrow_page_is_not_wider_than_its_window(narrow_tab):
    assert narrow_tab.value("document.documentElement.scrollWidth") <= NARROW
    assert all(left >= 0 and right <= NARROW for left, right, _, _ in narrow_tab.value(BOXES))


def test_a_narrow_page_shows_panels_below_one_another(narrow_tab):
    tiles = narrow_tab.value(BOXES)
    assert tiles
    assert all(above[3] <= below[2] for above, below in pairwise(tiles))


def test_a_point_of_a_panel_on_a_narrow_page_is_read_with_its_units(narrow_tab):
    x, y = narrow_tab.value(THIRD_POINT_OF_THE_FIRST_LINE)
    narrow_tab.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
    reading = narrow_tab.value("document.querySelector('.reading').innerText").split("\n")
    assert reading[1:] == ["time (s): 2", "speed (m/s): 11.25"]
    assert narrow_tab.errors == []


def test_a_wide_page_shows_the_figure_whole(tab, page_with_panels):
    tab.go(page_with_panels, WIDE, 1200)
    tab.wait("document.readyState === 'complete'")
    assert tab.value("getComputedStyle(document.querySelector('.tile')).display") == "none"
    assert tab.errors == []
