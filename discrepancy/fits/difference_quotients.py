"""Difference quotients of a response by an unknown, exact where the response curves or jumps."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray

LEAST_JUMP = 0.5
"""Difference of the quotients of both sides, divided by the rms quotient of the channel, above
which a reading may have jumped between them."""
OUTSTANDING_JUMP = 4.0
"""This difference divided by its own rms in the channel, above which a reading stands out. A kink
of the response changes all readings instead."""


class DifferenceQuotient(NamedTuple):
    """The derivative of a response by an unknown, and its jumps near the present value.

    Attributes
    ----------
    slope : (N, C) ndarray
        The derivative on the branch on which the response is now.
    jumps : (N, C) ndarray
        What a jump within one step adds to the response; zero where the response does not jump.
    """

    slope: FloatArray
    jumps: FloatArray


def two_sided_quotient(
    below: FloatArray, response: FloatArray, above: FloatArray, step: float
) -> DifferenceQuotient:
    """Return the derivative of a response by an unknown, from one step to either side.

    The response to a change of frequency curves within a small part of the prior of a stiffness or
    a mass. The error of a one-sided quotient is half of this curvature times the step, and it would
    count as information: on a mass, for example, where only its ratio to the stiffness can be
    known. The central quotient has no such error.

    Some readings jump, such as an acceleration at a reversal of dry friction. If a jump passes a
    sample within a step, the quotient of this side is the jump over the step: far too large, and
    the larger the smaller the step is. The derivative is then that of the other side.

    Parameters
    ----------
    below, response, above : (N, C) array
        The response with the unknown one step below its value, at its value, and one step above.
    step : float
        The step, positive.
    """
    forward = (above - response) / step
    backward = (response - below) / step
    is_forward_smaller = np.abs(forward) < np.abs(backward)
    smaller = np.where(is_forward_smaller, forward, backward)
    difference = np.abs(forward - backward)
    is_large = difference > LEAST_JUMP * _rms_of_channel(smaller)
    stands_out = difference > OUTSTANDING_JUMP * _rms_of_channel(difference)
    is_jump = is_large & stands_out
    # beyond the jump the response is that of the side with the larger quotient
    beyond = np.where(is_forward_smaller, below + smaller * step, above - smaller * step)
    return DifferenceQuotient(
        slope=np.where(is_jump, smaller, 0.5 * (forward + backward)),
        jumps=np.where(is_jump, beyond - response, 0.0),
    )


def largest_jumps(jumps_by_unknown: Sequence[FloatArray], shape: tuple[int, ...]) -> FloatArray:
    """Return the largest jump (N, C) of each reading, of those by all unknowns.

    Parameters
    ----------
    jumps_by_unknown : sequence of (N, C) array
        The jumps within a step of each unknown; there may be none.
    shape : tuple of int
        The shape (N, C) of the response.
    """
    largest = np.zeros(shape)
    for jumps in jumps_by_unknown:
        largest = np.where(np.abs(jumps) > np.abs(largest), jumps, largest)
    return largest


def one_sided_quotient(
    response: FloatArray, stepped: FloatArray, stepped_twice: FloatArray, step: float
) -> FloatArray:
    """Return the derivative of a response by an unknown that may move to one side only.

    The parabola through three responses is exact where the response has a constant curvature.

    Parameters
    ----------
    response, stepped, stepped_twice : (N, C) array
        The response with the unknown at its value, and one and two steps from it.
    step : float
        The step with its sign.
    """
    return np.asarray((4.0 * stepped - 3.0 * response - stepped_twice) / (2.0 * step))


def _rms_of_channel(readings: FloatArray) -> FloatArray:
    """Return the rms value of each channel (C,), given readings (N, C)."""
    return np.asarray(np.sqrt(np.mean(np.square(readings), axis=0)))
