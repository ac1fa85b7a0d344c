"""The figures of a mission as reports and the terminal print them."""

from collections.abc import Sequence
from typing import NamedTuple

from reporting.words import number, rounded
from twin_master.store.summary import Figure, FigureValue

_MEAN = "_mean"
_STANDARD_DEVIATION = "_standard_deviation"


class PrintedFigure(NamedTuple):
    """The value of a figure and its reference as texts; the latter is empty without a reference."""

    value: str
    reference: str


def printed_figures(figures: Sequence[Figure]) -> list[PrintedFigure]:
    """Return the printed values of the figures of a mission.

    A number has three significant digits. A mean whose standard deviation is a figure, too, has the
    decimals of that deviation, so that both can be compared.

    Parameters
    ----------
    figures : sequence of Figure
        All figures of the mission.
    """
    values = {figure.key: figure.value for figure in figures}
    figures_in_text = []
    for figure in figures:
        deviation = None
        if figure.key.endswith(_MEAN):
            deviation = values.get(figure.key.removesuffix(_MEAN) + _STANDARD_DEVIATION)
        reference = ""
        if figure.reference is not None:
            reference = _printed_number(figure.reference, deviation)
        figures_in_text.append(PrintedFigure(_printed_number(figure.value, deviation), reference))
    return figures_in_text


def _printed_number(value: FigureValue, deviation: FigureValue) -> str:
    """Return a value with the decimals of its standard deviation, if that is known."""
    if isinstance(value, float) and isinstance(deviation, float) and deviation > 0.0:
        return rounded(value, deviation)
    return number(value)
