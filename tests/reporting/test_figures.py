"""One style, reproducible bytes, nothing global."""

import re
from itertools import combinations

import matplotlib as mpl
import numpy as np
import pytest

from reporting import figures
from reporting.errors import InvalidFigureError

DOLLAR = b'-7"'
"""End of the name of the dollar sign's outline in DejaVu Sans."""


def drawing() -> "figures.Figure":
    with figures.publication_style():
        figure = figures.new_figure(2.0)
        axes = figure.add_axes((0.1, 0.1, 0.8, 0.8))
        axes.plot(np.arange(5), np.arange(5) ** 2, color=figures.PAST, marker="o", label="$x^2$")
        axes.fill_between([0, 4], [0, 1], [5, 6], alpha=figures.BAND_OPACITY)
        axes.pcolormesh(np.eye(3), cmap=figures.LEVELS)
        figures.panel_label(axes, "a", "title")
        axes.legend()
    return figure


def test_bytes_follow_from_the_data_alone():
    """No setting of a user's, no date, no program; and nothing of the user's is changed."""
    import matplotlib.pyplot as pyplot

    before, known = dict(mpl.rcParams), pyplot.get_fignums()
    svg, png = figures.to_svg(drawing()), figures.to_png(drawing(), 60)
    assert dict(mpl.rcParams) == before
    assert pyplot.get_fignums() == known
    with mpl.rc_context({"font.size": 30, "svg.fonttype": "none", "axes.edgecolor": "red", "savefig.dpi": 7}):
        assert (figures.to_svg(drawing()), figures.to_png(drawing(), 60)) == (svg, png)
    assert png.startswith(b"\x89PNG")
    assert b"Software" not in png
    assert not re.search(rb"<!DOCTYPE|metadata|date|http(?!://www\.w3\.org/)", svg)


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
    assert figures.to_png(figure, 40)


@pytest.mark.parametrize("data", [b"", b"not a drawing", b"<svg", b"<svg width='3'></svg>"])
def test_something_else_than_a_drawing_is_refused(data):
    with pytest.raises(InvalidFigureError):
        figures.inline_svg(data, "f1", "x")


@pytest.mark.parametrize("size", [0.0, -1.0, float("nan")])
def test_sizes_must_be_positive(size):
    with pytest.raises(InvalidFigureError, match="positive size"):
        figures.new_figure(size)


def test_the_palette_can_be_told_apart_in_grey_and_by_colour_blind_readers():
    """Lightness of the three zones differs, and so do the colours under simulated deuteranopia."""
    colors = np.array([mpl.colors.to_rgb(c) for c in (figures.PAST, figures.PREDICTION, figures.TRUTH)])
    deuteranopia = np.array([[0.625, 0.375, 0.0], [0.70, 0.30, 0.0], [0.0, 0.30, 0.70]])
    seen = colors @ deuteranopia.T
    assert all(np.linalg.norm(one - other) > 0.3 for one, other in combinations(seen, 2))
