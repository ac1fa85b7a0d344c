"""What a figure shows."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure


def panel(figure: Figure, title: str) -> Axes:
    (found,) = [axes for axes in figure.axes if title in axes.get_title(loc="left")]
    return found


def line(axes: Axes, label: str) -> np.ndarray:
    (found,) = [item for item in axes.get_lines() if item.get_label() == label]
    return np.asarray(found.get_xydata())
