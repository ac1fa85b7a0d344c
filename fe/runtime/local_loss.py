"""Local loss of the skin's stiffness: what strips of the wing keep of it, and what gauges among them read.

NumPy and relative imports only: this file is copied into the FMU.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .errors import InvalidPatchError
from .patch import LocalStiffnessLoss, ModelPatch

FloatArray = npt.NDArray[np.float64]

TIP_OFFSET = 1.02
"""Where the weight of a part of the skin would vanish, in semi-spans."""
LEAST_GAUGE_LENGTH = 1e-3
"""A gauge without a length averages over this [m]."""


class RemainingSkin(NamedTuple):
    """What the skin keeps of its stiffness along the span.

    Attributes
    ----------
    breaks : (m + 1,) ndarray
        Edges of strips and boxes [m from the root].
    exact : (m,) ndarray
        What it keeps between them.
    strip : (m,) ndarray of int
        The strip that each piece lies in.
    of_strips : (S,) ndarray
        What each strip as a whole keeps, so that the tip moves as much as with the boxes as they are.
    """

    breaks: FloatArray
    exact: FloatArray
    strip: npt.NDArray[np.int64]
    of_strips: FloatArray


def boxes_of(patch: ModelPatch) -> list[LocalStiffnessLoss]:
    """Return the local losses of a patch that are not zero."""
    return [item for item in patch if isinstance(item, LocalStiffnessLoss) and item.loss != 0.0]


def remaining_skin(boxes: list[LocalStiffnessLoss], lines: FloatArray) -> RemainingSkin:
    """Return what the skin keeps under local losses, which multiply where they overlap.

    A strip keeps the harmonic mean of its pieces, since they bend one after the other, weighed by the square
    of the distance from the tip: the moment of a force there, and the way on which the tip follows the
    bending.

    Parameters
    ----------
    boxes : list of LocalStiffnessLoss
        The losses.
    lines : (S + 1,) ndarray
        Edges of the strips [m from the root].

    Raises
    ------
    InvalidPatchError
        If nothing is left somewhere.
    """
    edges = [edge for box in boxes for edge in (box.start, box.start + box.length)]
    breaks = np.unique(np.concatenate((lines, np.clip(edges, lines[0], lines[-1]))))
    middles = 0.5 * (breaks[1:] + breaks[:-1])
    exact = np.ones(len(middles))
    for box in boxes:
        exact *= 1.0 - box.loss * ((middles > box.start) & (middles < box.start + box.length))
    if exact.min() <= 0.0:
        raise InvalidPatchError(
            f"A local stiffness loss must leave some stiffness, but leaves {exact.min():g} of it."
        )
    strip = np.maximum(np.searchsorted(lines, middles) - 1, 0)  # one may begin next to nothing above zero
    weights = -np.diff((TIP_OFFSET * lines[-1] - breaks) ** 3)
    count = len(lines) - 1
    of_strips = np.bincount(strip, weights, count) / np.bincount(strip, weights / exact, count)
    return RemainingSkin(breaks, exact, strip.astype(np.int64), of_strips)


def strain_factors(
    skin: RemainingSkin, stations: FloatArray, length: float, skin_share: FloatArray
) -> FloatArray:
    """Return factors (G,) on the strains of gauges, by where the edges of boxes lie in their strips.

    The structure has a loss smeared over the strip that the edge of its box parts; what a gauge there reads
    is the curvature of its own section. At a given bending moment the strain of a section whose skin keeps r
    of its stiffness goes as 1 / (1 - s (1 - r)), s the skin's share of the bending stiffness; the factor is
    the mean of that over the gauge with the boxes as they are, over the same with the strips' means.

    Parameters
    ----------
    skin : RemainingSkin
        The losses.
    stations : (G,) ndarray
        Middles of the gauges [m from the root].
    length : float
        Length over which they average [m].
    skin_share : (G,) ndarray
        s at each gauge.
    """
    half, middle = 0.5 * max(length, LEAST_GAUGE_LENGTH), stations[:, None]
    begin, end = skin.breaks[:-1], skin.breaks[1:]
    covered = np.maximum(np.minimum(end, middle + half) - np.maximum(begin, middle - half), 0.0)
    exact, smeared = (
        (covered / (1.0 - skin_share[:, None] * (1.0 - remaining))).sum(axis=1)
        for remaining in (skin.exact, skin.of_strips[skin.strip])
    )
    return np.asarray(exact / smeared)
