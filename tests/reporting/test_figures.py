"""Figures are of one style, with reproducible bytes, and say the values that were drawn."""

import re
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
import pytest

from benchmarks.browser import CHROMIUM, open_browser
from reporting.pages import figures
from reporting.pages.page import Page, PageFigure, render_page

X = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
Y = np.array([12.0, 13.5, 11.25, 14.0, 15.0])


def draw_panels() -> "figures.Figure":
    """Return a figure with series, a logarithmic axis, choices, a map and an image."""
    with figures.publication_style():
        figure = figures.new_figure(4.0)
        draw_band(figure)
        draw_logarithm(figure)
        draw_choices(figure)
        draw_map(figure)
        draw_image(figure)
    return figure


def draw_band(figure: "figures.Figure") -> None:
    axes = figure.add_axes((0.1, 0.6, 0.8, 0.3))
    axes.fill_between(X, Y - 2.0, Y + 1.0, color=figures.PAST, alpha=figures.BAND_OPACITY)
    axes.plot(X, Y, color=figures.PAST, label='speed < "limit"')
    axes.axhline(10.0, color=figures.REFERENCE, label="limit")
    error = [[0.25], [0.5]]
    axes.errorbar([2.5], [12.5], yerr=error, fmt="D", color=figures.PRESENT, label="tested")
    axes.set_xlabel("time (s)")
    axes.set_ylabel("speed (m/s)")
    figures.panel_label(axes, "a", "Tunnel")


def draw_logarithm(figure: "figures.Figure") -> None:
    axes = figure.add_axes((0.1, 0.1, 0.35, 0.3))
    axes.plot(X, 10.0**X, color=figures.PAST)
    axes.set_yscale("log")
    axes.set_xlabel("step")


def draw_choices(figure: "figures.Figure") -> None:
    axes = figure.add_axes((0.55, 0.1, 0.35, 0.3))
    axes.scatter([1.0, 2.0, 3.0], [0.0, 1.0, 1.0], label="choice")
    axes.set_yticks([0, 1], ["2g", "3g"])


def draw_map(figure: "figures.Figure") -> None:
    axes = figure.add_axes((0.55, 0.42, 0.3, 0.1))
    values = [[0.1, 0.25, 0.5], [1.0, np.nan, 3.0]]
    mesh = axes.pcolormesh([0.5, 1.5, 2.5, 3.5], [0.0, 10.0, 20.0], values)
    scale = figure.add_axes((0.9, 0.42, 0.02, 0.1))
    figure.colorbar(mesh, cax=scale, label="residual")
    axes.set_xlabel("gauge")


def draw_image(figure: "figures.Figure") -> None:
    axes = figure.add_axes((0.1, 0.42, 0.3, 0.1))
    axes.imshow([[1.0, 2.0], [3.0, 4.0]], aspect="auto")
    axes.set_yticks([])


READINGS_OF_SERIES = {
    0: ['a Tunnel: speed < "limit"', "time (s): 2", "speed (m/s): 11.25 (9.25 to 12.25)"],
    1: ["a Tunnel: tested", "time (s): 2.5", "speed (m/s): 12.5 (12.25 to 13)"],
    2: ['speed < "limit"', "step: 2", "100"],
    3: ["choice", "2", "3g"],
}
"""What is said at the middle point of each series, in the order of drawing."""


@dataclass(frozen=True)
class MapReading:
    """What is said at a place of a map.

    Attributes
    ----------
    panel : int
        The number of the panel.
    right, up : float
        The place, in fractions of its width and height.
    lines : list of str or None
        None if there is no value.
    """

    panel: int
    right: float
    up: float
    lines: list[str] | None


READINGS_OF_MAPS = [
    MapReading(3, 0.9, 0.25, ["gauge: 3", "5", "residual: 0.5"]),
    MapReading(3, 0.1, 0.75, ["gauge: 1", "15", "residual: 1"]),
    MapReading(3, 0.5, 0.75, None),
    MapReading(4, 0.75, 0.75, ["1", "residual: 2"]),
    MapReading(4, 0.25, 0.25, ["0", "residual: 3"]),
]

# ---------------------------------------------------------------- bytes


@pytest.fixture(scope="module")
def figure():
    return draw_panels()


@pytest.fixture(scope="module")
def svg(figure):
    return figures.to_svg(figure)


@pytest.fixture(scope="module")
def png(figure):
    return figures.to_png(figure, 60)


def test_drawing_changes_nothing_global():
    import matplotlib.pyplot as pyplot

    parameters = dict(mpl.rcParams)
    numbers = pyplot.get_fignums()

    figure = draw_panels()
    figures.to_svg(figure)
    figures.to_png(figure, 60)

    assert dict(mpl.rcParams) == parameters
    assert pyplot.get_fignums() == numbers


def test_bytes_do_not_follow_settings_of_a_user(svg, png):
    settings = {
        "font.size": 30,
        "svg.fonttype": "none",
        "axes.edgecolor": "red",
        "savefig.dpi": 7,
    }

    with mpl.rc_context(settings):
        assert figures.to_svg(draw_panels()) == svg
        assert figures.to_png(draw_panels(), 60) == png


def test_a_figure_can_be_written_again_and_is_not_changed(figure, svg):
    artists = [artist for axes in figure.axes for artist in (axes, *axes.get_children())]

    assert figures.to_svg(figure) == svg
    assert all(artist.get_gid() is None for artist in artists)


def test_a_png_names_no_program(png):
    assert png.startswith(b"\x89PNG")
    assert b"Software" not in png


def test_an_svg_names_no_date_and_no_program(svg):
    assert not re.search(rb"<!DOCTYPE|metadata|date|http(?!://www\.w3\.org/)", svg)
    assert not re.search(rb'id="hover', svg)


def test_an_svg_has_the_values_of_panels_and_series(svg):
    assert svg.count(b"data-axes=") == 5  # the scale of colours has none
    assert svg.count(b"data-series=") == len(READINGS_OF_SERIES)  # a limit has no points


# ---------------------------------------------------------------- mathematics

DOLLAR = b'-7"'
"""End of the name of the dollar sign's outline in DejaVu Sans."""


def draw_texts(label: str, title: str, **options: bool) -> bytes:
    with figures.publication_style():
        figure = figures.new_figure(2.0)
        axes = figure.add_axes((0.1, 0.1, 0.8, 0.8))
        axes.loglog([1, 1e4], [1, 1e4], label=label)
        axes.set_title(title, **options)
        axes.legend()
    return figures.to_svg(figure)


def test_text_of_a_user_is_no_mathematics():
    """Broken mathematics would end the drawing, and whole one would not be what was written."""
    svg = draw_texts("$_{$", r"of $\frac{1$ and of $x^2$")

    assert DOLLAR in svg


def test_text_is_mathematics_where_the_program_says_so():
    svg = draw_texts("seen", "of $x^2$", parse_math=True)

    assert DOLLAR not in svg


# ---------------------------------------------------------------- readings under the pointer

MIDDLE_OF_SERIES = """(number) => {
  const series = document.querySelectorAll('[data-series]')[number];
  const marks = [...series.querySelectorAll('use')]
    .map((use) => [+use.getAttribute('x'), +use.getAttribute('y')]);
  const course = () => series.querySelector('path').getAttribute('d');
  const line = () => [...course().matchAll(/[ML] (\\S+) (\\S+)/g)]
    .map((match) => [+match[1], +match[2]]);
  const points = marks.length ? marks : line();
  const [x, y] = points[points.length >> 1];
  const place = new DOMPoint(x, y).matrixTransform(series.closest('svg').getScreenCTM());
  return [place.x, place.y]; }"""
PLACE_OF_PANEL = """(panel, right, up) => {
  const group = document.querySelectorAll('[data-axes]')[panel];
  const [x0, x1, y0, y1] = JSON.parse(group.dataset.axes).box;
  const point = new DOMPoint(x0 + right * (x1 - x0), y0 + up * (y1 - y0));
  const place = point.matrixTransform(group.closest('svg').getScreenCTM());
  return [place.x, place.y]; }"""
READING = "document.querySelector('.reading')"


@pytest.fixture(scope="module")
def page_file(svg, tmp_path_factory):
    page = Page("Values", picture=PageFigure("values", svg, "Figure", "Caption."))
    file = tmp_path_factory.mktemp("page") / "page.html"
    file.write_text(render_page(page), encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def tab(page_file):
    """A tab of a browser with the page."""
    with open_browser() as browser:
        tab = browser.tab()
        tab.go(f"file://{page_file}", 1300, 1200)
        tab.wait("document.readyState === 'complete'")
        yield tab


def move_pointer(tab, x, y):
    tab.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)


def point_at_series(tab, number):
    """Move the pointer next to the middle point of a series, and return where that is."""
    x, y = tab.value(f"({MIDDLE_OF_SERIES})({number})")
    move_pointer(tab, x + 2.0, y + 1.0)
    return x, y


needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="needs a browser")


@needs_browser
@pytest.mark.parametrize(("number", "lines"), READINGS_OF_SERIES.items())
def test_the_pointer_reads_a_series(tab, number, lines):
    point_at_series(tab, number)

    assert tab.value(f"{READING}.innerText").split("\n") == lines
    assert tab.value("document.querySelectorAll('.ring').length") == 1


@needs_browser
@pytest.mark.parametrize("reading", READINGS_OF_MAPS)
def test_the_pointer_reads_a_map(tab, reading):
    arguments = f"{reading.panel}, {reading.right}, {reading.up}"
    x, y = tab.value(f"({PLACE_OF_PANEL})({arguments})")

    move_pointer(tab, x, y)

    lines = tab.value(f"{READING}.hidden ? null : {READING}.innerText.split('\\n')")
    assert lines == reading.lines


@needs_browser
def test_escape_hides_a_reading(tab):
    point_at_series(tab, 3)

    tab.press("Escape")

    assert tab.value(f"{READING}.hidden")


@needs_browser
def test_a_tap_shows_a_reading(tab):
    x, y = point_at_series(tab, 3)
    tab.press("Escape")

    tab.send("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y}])
    tab.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    assert not tab.value(f"{READING}.hidden")


@needs_browser
def test_a_printed_page_shows_no_reading(tab):
    point_at_series(tab, 3)

    tab.send("Emulation.setEmulatedMedia", media="print")
    display = tab.value(f"getComputedStyle({READING}).display")
    tab.send("Emulation.setEmulatedMedia", media="screen")

    assert display == "none"


@needs_browser
def test_a_page_in_a_browser_has_no_error_and_asks_for_nothing(tab, page_file):
    requests = [request for request in tab.requests if not request.startswith("data:")]

    assert tab.errors == []
    assert requests == [f"file://{page_file}"]
