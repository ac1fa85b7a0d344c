"""The stiffness that a wing's skin keeps under local losses; see `docs/explanation/patches.md`.

NumPy and relative imports only: this file is copied into the FMU.
"""

from typing import NamedTuple

import numpy as np

from .arrays import FloatArray, IntArray
from .errors import InvalidPatchError
from .patch import LocalStiffnessLoss, ModelPatch

ZERO_WEIGHT_STATION = 1.02
"""Station at which a piece of skin has zero weight, in semi-spans; slightly beyond the tip, so that
all pieces have a weight."""


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
    """Return the fraction of its stiffness that each part of the skin keeps under local losses.

    Overlapping losses multiply: (1 - loss_1) (1 - loss_2). Pieces of a strip bend in series, so
    that the strip keeps the weighted harmonic mean of their fractions. The weight is the square of
    the distance from the tip: the moment of a tip force is proportional to the distance, and so is
    the displacement of the tip by a curvature.

    Parameters
    ----------
    strip_lines : (S + 1,) array
        Edges of the strips [m from the root].

    Returns
    -------
    RemainingSkin or None
        The fractions; None if the patch has no local loss.

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
    fraction_of_piece = np.ones(len(middles))
    for loss in losses:
        is_inside = (middles > loss.start) & (middles < loss.start + loss.length)
        fraction_of_piece *= np.where(is_inside, 1.0 - loss.loss, 1.0)
    if fraction_of_piece.min() <= 0.0:
        raise InvalidPatchError(
            "A local stiffness loss must leave some stiffness, but leaves "
            f"{fraction_of_piece.min():g} of it."
        )
    # weighted harmonic mean of the pieces of each strip
    strip_of_piece = np.searchsorted(strip_lines, middles) - 1
    # rounding may put the first piece before the first line
    strip_of_piece = np.maximum(strip_of_piece, 0)
    # the integral of (L - y)^2 over a piece is the difference of (L - y)^3 / 3; the 3 cancels
    weights = -np.diff((ZERO_WEIGHT_STATION * strip_lines[-1] - breaks) ** 3)
    strip_count = len(strip_lines) - 1
    strip_weights = np.bincount(strip_of_piece, weights, strip_count)
    fraction_of_strip = strip_weights / np.bincount(
        strip_of_piece, weights / fraction_of_piece, strip_count
    )
    return RemainingSkin(
        breaks, fraction_of_piece, strip_of_piece.astype(np.int64), fraction_of_strip
    )
