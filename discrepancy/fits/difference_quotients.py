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
    """The derivative of a response with respect to an unknown, and its jumps near its value.

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

    For each reading it is

    - the central quotient, if the reading is smooth;
    - the smaller of the two one-sided quotients, if the reading jumps within one of the steps.

    A reading jumps if its two one-sided quotients differ by more than `LEAST_JUMP` times the rms
    slope of its channel, and by more than `OUTSTANDING_JUMP` times the rms difference in its
    channel. The second condition excludes a smooth but strongly curved response, in which the
    quotients differ everywhere.

    An example of a jump is an acceleration when dry friction reverses. If the unknown shifts the
    reversal across a sample, the quotient of that side is the jump divided by the step, which is
    far too large. Smooth readings need the central quotient, as a one-sided one has an error of
    half the curvature times the step. Such errors can make a mass look determined where readings
    depend only on the ratio of a stiffness to it.

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
    # A jump in the step below (or, mirrored, above) separates two branches:
    #     below --jump-- response ---- above
    # The branch of `below` is continued to the present value of the unknown with the same slope.
    other_branch = np.where(is_forward_smaller, below + smaller * step, above - smaller * step)
    return DifferenceQuotient(
        slope=np.where(is_jump, smaller, 0.5 * (forward + backward)),
        jumps=np.where(is_jump, other_branch - response, 0.0),
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
