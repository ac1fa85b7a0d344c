"""What local losses leave of the stiffness of a wing's skin; see `docs/patches.md`.

NumPy and relative imports only: this file is copied into the FMU.
"""

from typing import NamedTuple

import numpy as np

from .arrays import FloatArray, IntArray
from .errors import InvalidPatchError
from .patch import LocalStiffnessLoss, ModelPatch

ZERO_WEIGHT_STATION = 1.02
"""Where the weight of a part of the skin would vanish, in semi-spans."""


class RemainingSkin(NamedTuple):
    """The fractions of its stiffness that the skin keeps, along the span.

    Attributes
    ----------
    breaks : (m + 1,) array
        Edges of strips and losses [m from the root], which bound m pieces.
    by_piece : (m,) array
        Fraction that each piece keeps.
    strip_of_piece : (m,) array of int
        Strip in which each piece lies.
    by_strip : (S,) array
        Fraction that each strip as a whole keeps, so that the tip moves as much as with the pieces.
    """

    breaks: FloatArray
    by_piece: FloatArray
    strip_of_piece: IntArray
    by_strip: FloatArray


def remaining_skin(patch: ModelPatch, strip_lines: FloatArray) -> RemainingSkin | None:
    """Return what the skin keeps of its stiffness under the local losses of a patch.

    Losses multiply where they overlap. A strip keeps the harmonic mean of its pieces, because they
    bend one after the other. The mean is weighted by the square of the distance from the tip: once
    for the moment of a force there, once for the lever by which the tip follows the bending.

    Parameters
    ----------
    patch : ModelPatch
        The patch with the losses.
    strip_lines : (S + 1,) array
        Edges of the strips [m from the root].

    Returns
    -------
    RemainingSkin or None
        The fractions; None where the patch has no local loss.

    Raises
    ------
    InvalidPatchError
        If no stiffness remains somewhere.
    """
    losses = [
        primitive
        for primitive in patch
        if isinstance(primitive, LocalStiffnessLoss) and primitive.loss != 0.0
    ]
    if not losses:
        return None
    # pieces between the edges of strips and losses
    starts = [loss.start for loss in losses]
    ends = [loss.start + loss.length for loss in losses]
    edges = np.clip([*starts, *ends], strip_lines[0], strip_lines[-1])
    breaks = np.unique(np.concatenate((strip_lines, edges)))
    middles = 0.5 * (breaks[1:] + breaks[:-1])
    by_piece = np.ones(len(middles))
    for loss in losses:
        is_inside = (middles > loss.start) & (middles < loss.start + loss.length)
        by_piece *= np.where(is_inside, 1.0 - loss.loss, 1.0)
    if by_piece.min() <= 0.0:
        raise InvalidPatchError(
            "A local stiffness loss must leave some stiffness, but leaves "
            f"{by_piece.min():g} of it."
        )
    # weighted harmonic mean of the pieces of each strip
    strip = np.searchsorted(strip_lines, middles) - 1
    strip = np.maximum(strip, 0)  # a piece may begin next to nothing above the first line
    weights = -np.diff((ZERO_WEIGHT_STATION * strip_lines[-1] - breaks) ** 3)
    count = len(strip_lines) - 1
    total = np.bincount(strip, weights, count)
    by_strip = total / np.bincount(strip, weights / by_piece, count)
    return RemainingSkin(breaks, by_piece, strip.astype(np.int64), by_strip)
