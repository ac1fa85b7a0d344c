"""Derivatives of the response and the prediction of a trial with respect to unknowns of a fit.

The nuisances are the calibrated parameters and the trial's own unknowns. The *response* is what the
model gives; the *prediction* of the readings is the response with gains and zeros of channels.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray, IntArray

from .candidate import (
    PARAMETER_STEP,
    SHARED_STEP,
    Candidate,
    TrialDerivatives,
    with_step,
)
from .difference_quotients import largest_jumps, one_sided_quotient, two_sided_quotient
from .trial_data import SharedUnknowns, TrialData


class NuisanceDerivatives(NamedTuple):
    """The derivatives of a trial's response with respect to its nuisances.

    Attributes
    ----------
    by_parameters : (P, N, C) ndarray
        The derivatives with respect to the P calibrated parameters.
    by_local : (I, N, C) ndarray
        The derivatives with respect to the I unknowns of the trial that are not zeros of channels.
    jumps : (N, C) ndarray
        The jump of the response within a step of an unknown; zero where there is none.
    """

    by_parameters: FloatArray
    by_local: FloatArray
    jumps: FloatArray


RespondAt = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray | None]]
"""Returns the response (N, C) of a trial at given shared and local unknowns, and its time
derivative (N, C), or None if the model does not give that."""


class _ResponseDifferences:
    """The difference quotients of the response of a trial about one point.

    Attributes
    ----------
    response : (N, C) ndarray
        The response at the point.
    rates : (N, C) ndarray or None
        Its time derivative.
    jumps_by_unknown : list of (N, C) ndarray
        The jumps that were met within the steps so far.
    """

    def __init__(
        self, data: TrialData, shared_point: FloatArray, local_point: FloatArray, respond: RespondAt
    ) -> None:
        self._is_dynamic = data.trial.is_dynamic
        self._shared_point = shared_point
        self._local_point = local_point
        self._respond = respond
        self.response, self.rates = respond(shared_point, local_point)
        self.jumps_by_unknown: list[FloatArray] = []

    def slope(
        self,
        shared_step: FloatArray,
        local_step: FloatArray,
        step: float,
        *,
        both_sides: bool = True,
    ) -> FloatArray:
        """Return the derivative (N, C) of the response along a direction.

        Parameters
        ----------
        shared_step, local_step : (Q,), (L,) array
            The change of the unknowns by one step in the direction.
        step : float
            The length of the step, with its sign.
        both_sides : bool
            Whether the unknowns may also move against the direction.
        """
        stepped_response = self._response_at(shared_step, local_step)
        if not self._is_dynamic:
            return np.asarray((stepped_response - self.response) / step)
        if both_sides:
            response_below = self._response_at(-shared_step, -local_step)
            quotient = two_sided_quotient(response_below, self.response, stepped_response, step)
            self.jumps_by_unknown.append(quotient.jumps)
            return quotient.slope
        stepped_twice = self._response_at(2.0 * shared_step, 2.0 * local_step)
        return one_sided_quotient(self.response, stepped_response, stepped_twice, step)

    def _response_at(self, shared_step: FloatArray, local_step: FloatArray) -> FloatArray:
        """Return the response (N, C) after a step from the point."""
        response, _ = self._respond(
            self._shared_point + shared_step, self._local_point + local_step
        )
        return response


def nuisance_derivatives(
    data: TrialData,
    shared_unknowns: SharedUnknowns,
    shared_point: FloatArray,
    local_point: FloatArray,
    respond: RespondAt,
) -> NuisanceDerivatives:
    """Return the derivatives of a trial's response with respect to its nuisances.

    They are difference quotients; only that by time zero is the time derivative of the response, if
    the model gives it. In trials in motion the unknown makes two steps: one to either side, or both
    to the side on which it may move. At rest the response is nearly linear, and one step is enough.

    Parameters
    ----------
    shared_point, local_point : (Q,), (L,) array
        The scaled values of the Q shared unknowns, and of the L unknowns of the trial, at which the
        derivatives are computed.
    respond : callable
        The function that returns the response at given shared and local unknowns, for N samples of
        C channels, and its time derivative (N, C), or None if the model does not give it.
    """
    unknowns = data.unknowns
    differences = _ResponseDifferences(data, shared_point, local_point, respond)
    no_shared_step = np.zeros_like(shared_point)
    no_local_step = np.zeros_like(local_point)
    # calibrated parameters: steps from an end of the range go into the range
    low, high = shared_unknowns.bounds
    is_at_high_end = shared_point + SHARED_STEP > high
    is_at_low_end = shared_point - SHARED_STEP < low
    by_parameters = []
    for k in range(shared_unknowns.parameter_count):
        step = -SHARED_STEP if is_at_high_end[k] else SHARED_STEP
        both_sides = not (is_at_high_end[k] or is_at_low_end[k])
        parameter_step = with_step(no_shared_step, k, step)
        by_parameters.append(
            differences.slope(parameter_step, no_local_step, step, both_sides=both_sides)
        )
    # initial state and constants of inputs
    indices = unknowns.indices
    by_local = [
        differences.slope(no_shared_step, with_step(no_local_step, k), PARAMETER_STEP)
        for k in (*indices.initial_state, *indices.input_constants)
    ]
    if unknowns.has_time_zero:
        time_zero = indices.time_zero.start
        if differences.rates is None:
            time_zero_step = with_step(no_local_step, time_zero)
            by_local.append(differences.slope(no_shared_step, time_zero_step, PARAMETER_STEP))
        else:
            # a shift of time zero by scale u changes the response by its rate times scale u
            by_local.append(differences.rates * unknowns.scale[time_zero])
    # health
    if len(unknowns.health_rows):
        by_local.extend(
            _health_derivatives(
                data,
                local_point,
                indices.health.start,
                differences.response.shape,
                lambda step: differences.slope(
                    no_shared_step, step, PARAMETER_STEP, both_sides=False
                ),
            )
        )
    shape = (-1, *differences.response.shape)
    return NuisanceDerivatives(
        by_parameters=np.array(by_parameters).reshape(shape),
        by_local=np.array(by_local).reshape(shape),
        jumps=largest_jumps(differences.jumps_by_unknown, differences.response.shape),
    )


def _health_derivatives(
    data: TrialData,
    local_values: FloatArray,
    first_health: int,
    shape: tuple[int, ...],
    slope: Callable[[FloatArray], FloatArray],
) -> FloatArray:
    """Return the derivatives (H, N, C) of a response with respect to the uncertain health entries.

    Health is the stiffness loss of each region of the structure. In a static trial it has one row
    for each reading, and a row changes only that reading. So all rows of a region are stepped at
    once, and the derivative by each row is that row of the difference.

    Parameters
    ----------
    local_values : (L,) array
        The scaled unknowns of the trial.
    first_health : int
        The index of the first health entry among these unknowns.
    shape : tuple of int
        The shape (N, C) of the response.
    slope : callable
        Returns the change of the response (N, C) for a step of the trial's unknowns (L,), divided
        by `PARAMETER_STEP`.
    """
    unknowns = data.unknowns
    derivatives = np.zeros((len(unknowns.health_rows), *shape))
    for region in range(data.trial.health.shape[1]):
        region_entries = np.flatnonzero(unknowns.health_columns == region)
        if not len(region_entries):
            continue
        # step towards zero, away from the limits of the stiffness loss
        step_signs = np.where(local_values[first_health + region_entries] > 0.0, -1.0, 1.0)
        local_step = np.zeros_like(local_values)
        local_step[first_health + region_entries] = step_signs * PARAMETER_STEP
        difference_quotient = slope(local_step)
        if data.trial.is_dynamic:
            derivatives[region_entries] = (
                step_signs[:, np.newaxis, np.newaxis] * difference_quotient
            )
        else:
            reading_rows = unknowns.health_rows[region_entries]
            derivatives[region_entries, reading_rows] = (
                step_signs[:, np.newaxis] * difference_quotient[reading_rows]
            )
    return derivatives


def prediction_derivatives(
    data: TrialData,
    shared_unknowns: SharedUnknowns,
    shared_values: FloatArray,
    derivatives: TrialDerivatives,
    candidate: Candidate,
) -> tuple[FloatArray, IntArray]:
    """Return the derivatives of a trial's predicted readings with respect to all unknowns.

    The derivatives of the response are multiplied by the gains, and those with respect to gains and
    zeros of channels are added.

    Parameters
    ----------
    shared_values : (Q,) array
        The scaled values of the Q unknowns that all trials share.

    Returns
    -------
    by_unknowns : (L + K, N, C) array
        The derivatives with respect to the L unknowns of the trial, and to the K shared
        unknowns and effect parameters that act on it [unit of the channel].
    shared_indices : (K,) array of int
        The indices of these K, among the Q shared unknowns and the effect parameters after
        them.
    """
    unknowns = data.unknowns
    channels = data.trial.channels
    response = derivatives.response
    gains = 1.0 + shared_unknowns.gains(shared_values, channels)
    # zeros of the channels
    by_zeros = np.zeros((unknowns.zero_count, *response.shape))
    zero_scale = unknowns.scale[: unknowns.zero_count, np.newaxis]
    by_zeros[np.arange(unknowns.zero_count), :, unknowns.zero_columns] = zero_scale
    # gains of the channels
    gain_numbers = np.array(
        [k for k, name in enumerate(shared_unknowns.gain_channels) if name in channels], dtype=int
    )
    gain_columns = [channels.index(shared_unknowns.gain_channels[k]) for k in gain_numbers]
    by_gains = np.zeros((len(gain_numbers), *response.shape))
    gain_scale = shared_unknowns.scale[shared_unknowns.parameter_count + gain_numbers]
    by_gains[np.arange(len(gain_numbers)), :, gain_columns] = (
        response[:, gain_columns] * gain_scale
    ).T
    # parameters of the effects that act on such trials
    kind = data.trial.kind
    effect_numbers = np.array(
        [
            k
            for k in range(candidate.parameter_count)
            if kind in candidate.trial_kinds_of_parameter(k)
        ],
        dtype=int,
    )
    by_unknowns = np.concatenate(
        (
            by_zeros,
            derivatives.by_local * gains,
            derivatives.by_parameters * gains,
            by_gains,
            derivatives.by_effect[effect_numbers] * gains,
        )
    )
    shared_indices = np.concatenate(
        (
            np.arange(shared_unknowns.parameter_count),
            shared_unknowns.parameter_count + gain_numbers,
            shared_unknowns.unknown_count + effect_numbers,
        )
    )
    return by_unknowns, shared_indices
