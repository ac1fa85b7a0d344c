"""Difference quotients of a response with respect to an unknown, where it is curved or jumps."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray

LEAST_JUMP = 0.5
"""Difference of the quotients of both sides above which a reading may have jumped, divided by the
rms quotient of the channel."""
OUTSTANDING_JUMP = 4.0
"""Difference above which a reading stands out from the others of its channel, divided by the rms
difference of the channel. A kink of the response changes all readings instead."""


class DifferenceQuotient(NamedTuple):
    """The derivative of a response by an unknown, and its jumps near the present value.

    Attributes
    ----------
    slope : (N, C) ndarray
        The derivative on the branch on which the response is now.
    jumps : (N, C) ndarray
        The response on the branch beyond a jump minus that on the present branch, both at the
        present value; zero where the response does not jump within a step.
    """

    slope: FloatArray
    jumps: FloatArray


def two_sided_quotient(
    below: FloatArray, response: FloatArray, above: FloatArray, step: float
) -> DifferenceQuotient:
    """Return the derivative of a response with respect to an unknown, from a step to either side.

    It is the central quotient. A one-sided quotient has an error of half the curvature times the
    step. Such errors can make unknowns look determined that are not: if readings depend only on the
    ratio of a stiffness to a mass, their derivatives by the logarithms of both are opposite, but
    the one-sided quotients are not, as if the readings told the mass.

    Some readings jump, such as an acceleration at a reversal of dry friction. If the jump passes a
    sample within a step, the quotient of that side is about the jump over the step, which is far
    too large. The derivative is then the quotient of the other side. A reading counts as a jump if
    the quotients of both sides differ by much compared with the slopes of its channel
    (`LEAST_JUMP`), and by much more than those of its other readings (`OUTSTANDING_JUMP`): in a
    smooth but strongly curved response they differ everywhere.

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
    # the branch beyond the jump, continued from its sample back to the present value of the unknown
    beyond = np.where(is_forward_smaller, below + smaller * step, above - smaller * step)
    return DifferenceQuotient(
        slope=np.where(is_jump, smaller, 0.5 * (forward + backward)),
        jumps=np.where(is_jump, beyond - response, 0.0),
    )


def largest_jumps(jumps_by_unknown: Sequence[FloatArray], shape: tuple[int, ...]) -> FloatArray:
    """Return for each reading the largest of its jumps within the steps of all unknowns.

    Parameters
    ----------
    jumps_by_unknown : sequence of (N, C) array
        The jumps within a step of each unknown; may be empty.
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
    """Return the derivative with respect to an unknown that may move to one side only.

    It is that of the parabola through three responses.

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
