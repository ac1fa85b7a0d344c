"""Gaussian sensors: the likelihood of their values in each state, and residuals.

Kapteyn et al. 2021, eqs. (30) and (32).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reporting.arrays import Float, Index, nan_where_masked, product_of_each
from reporting.choices import require_one_of
from reporting.words import brief
from twin_master.errors import InvalidModelError, InvalidObservationError
from twin_master.network.gaussian_kernels import (
    LOG_ROOT_TWO_PI,
    factor_low_rank,
    log_densities,
)
from twin_master.network.quantity import QuantityModel
from twin_master.network.transition import check_shape, checked_controls

Averaging = Literal["outside", "inside"]
"""Whether the likelihoods of the draws are averaged, or those of each sensor."""
_WORST_LISTED = 3
"""Number of sensors in the list of those that fit worst."""
_MANY_STEPS = 32
"""From so many steps on it is tried first whether all have the same sensors, to group them fast."""
LARGEST_DISTANCE = 1e140
"""Distances are cut to this; its square is still a number."""
LEAST_ONE_MINUS_LEVERAGE = 1e-12
"""Less than this is a rounding error, if a sensor alone determines the value in the interval."""


@dataclass(frozen=True)
class IntervalFit:
    """Predictions for the point in the interval of each state that fits an observation best.

    Attributes
    ----------
    value : (E, S, G) array
        The predictions at the most probable point, given all sensors, SI.
    value_by_others : (E, S, G) array
        For each sensor the prediction at the most probable point given all other sensors, SI.
    one_minus_leverage : (S, G) array
        One minus the leverage: the variance of a sensor's noise over that of its observation, given
        all other sensors.
    log_density : (E, S) array
        The log of the factor by which the density of independent sensors at `value` is multiplied
        to give the density averaged over the interval.
    """

    value: Float
    value_by_others: Float
    one_minus_leverage: Float
    log_density: Float


class _DensityTerms(NamedTuple):
    """Terms that densities of observations with the same present sensors and control share.

    The kernel `log_densities` has the formula.

    Attributes
    ----------
    log_scale : (S,) array
        The log of the density's factor.
    draw_offset : (S, E) array
        Half the squared distance of each draw from the mean over the draws.
    mean, inverse_deviation : (S, G) array
        The mean over the draws, SI, and one over the standard deviation of noise and model error,
        1/SI; the latter is zero for a lost sensor.
    interval_directions : (S, F, G) array
        The directions in which the interval of a state moves the sensors.
    draw_directions : (S, G, R) array
        The directions in which the draws move the sensors.
    """

    log_scale: Float
    draw_offset: Float
    mean: Float
    inverse_deviation: Float
    interval_directions: Float
    draw_directions: Float


class GaussianSensorModel(QuantityModel):
    """Sensors that show a value plus independent Gaussian noise.

    If the twin doubts its model, an error of the model is added to the noise in quadrature for each
    state, control and sensor: sqrt(standard_deviation² + (model_error * mean)²), with the mean over
    the draws. That error is drawn anew for each sensor and step, while a real one stays the same
    from step to step. So the term is a safeguard and no description of the error.

    A state may stand for an interval of each factor. The true value in it moves all sensors
    together, so that each factor adds one term of rank one to the covariance of the sensors.

    Parameters
    ----------
    strain_per_draw : (E, S, U, G) array
        The noise-free value for each draw e of the uncertain parameters, state, control and sensor,
        SI.
    standard_deviation : float or (G,) array
        The standard deviation of the noise that the twin assumes, SI, positive.
    draw_weight : (E,) array, optional
        The probability of each draw; equal by default.
    average : {"outside", "inside"}
        Where the average over the draws stands. "outside", the default, is the integral (30): the
        mean over e of the product over sensors. "inside" is eq. (32) as printed: the product over
        sensors of the mean over e, as if each sensor had parameters of its own.
    model_error : float or (G,) array
        The standard deviation of the predicted value as a fraction of it; zero by default.
    interval : (S, U, G, F) array, optional
        The change of each sensor, SI, if a factor moves by one standard deviation within the
        interval of the state, see `StateSpace.change_within_interval`. If left out, the true values
        are exactly at the levels.

    Raises
    ------
    InvalidModelError
        If shapes do not fit, a value is not finite, a standard deviation is not positive, or an
        error is negative.
    InvalidChoiceError
        If `average` is another word.
    """

    interval: Float
    """Change of each sensor within the interval of a state (S, U, G, F), SI, read-only."""
    independent_standard_deviation: Float
    """Noise and model error of each state, control and sensor (S, U, G), SI, read-only."""
    total_standard_deviation: Float
    """The same with the change within the interval of the state (S, U, G), SI, read-only."""

    def __repr__(self) -> str:
        draws, states, controls, sensors = self.value_per_draw.shape
        return brief(self, draws=draws, states=states, controls=controls, sensors=sensors)

    def __init__(
        self,
        strain_per_draw: ArrayLike,
        standard_deviation: ArrayLike,
        draw_weight: ArrayLike | None = None,
        average: Averaging = "outside",
        model_error: ArrayLike = 0.0,
        interval: ArrayLike | None = None,
    ) -> None:
        require_one_of(average, get_args(Averaging), "average")
        super().__init__(strain_per_draw, draw_weight)
        noise = np.array(nan_where_masked(standard_deviation))
        self._check_one_or_each(noise, noise > 0.0, "positive noise standard deviation")
        relative_error = np.array(nan_where_masked(model_error))
        self._check_one_or_each(
            relative_error, relative_error >= 0.0, "relative model error that is not negative"
        )
        self.standard_deviation: Float = np.full(self.sensor_count, noise)
        self.model_error: Float = np.full(self.sensor_count, relative_error)
        # hypot(x, 0) is exactly x; the root of a sum of squares would round.
        independent = np.hypot(self.standard_deviation, self.model_error * self.mean)

        if interval is None:
            self.interval = np.zeros((*independent.shape, 0))
        else:
            self.interval = np.array(nan_where_masked(interval))
        check_shape("changes within intervals", self.interval.shape, *independent.shape, "factors")
        if not np.all(np.isfinite(self.interval)):
            raise InvalidModelError("the changes within intervals must be finite")
        self.independent_standard_deviation = independent
        self.total_standard_deviation = np.hypot(
            independent, np.linalg.norm(self.interval, axis=-1)
        )
        for array in (independent, self.total_standard_deviation, self.interval):
            array.setflags(write=False)
        self.averages_inside = average == "inside"
        with np.errstate(divide="ignore"):
            self._log_weight: Float = np.log(self.draw_weight)

        # The differences of the draws from their mean, in standard deviations, are a matrix of low
        # rank R: directions (S, U, G, R) times coefficients (R, E).
        difference = (self.value_per_draw - self.mean) / independent
        largest = float(np.max(np.abs(self.value_per_draw) / independent))
        rows_of_draws = np.moveaxis(difference, 0, -1).reshape(-1, self.draw_count)
        directions, self._draw_coefficients = factor_low_rank(rows_of_draws, largest)
        self._draw_directions = directions.reshape(*independent.shape, len(self._draw_coefficients))
        # By control: the sensors that were present last (as bytes), and the terms of the density.
        self._last_terms: dict[int, tuple[bytes, _DensityTerms]] = {}

    def _check_one_or_each(self, value: Float, is_valid: NDArray[np.bool_], what: str) -> None:
        """Refuse a value that is neither one finite, valid number nor one for each sensor."""
        has_shape = value.shape in ((), (self.sensor_count,))
        if not has_shape or not np.all(np.isfinite(value) & is_valid):
            raise InvalidModelError(
                f"there must be one {what}, or one for each of {self.sensor_count} sensors, but "
                f"{value} was given"
            )

    @property
    def has_own_likelihood(self) -> bool:
        """Whether a subclass computes the density of an observation in a way of its own."""
        methods = ("log_likelihood", "log_likelihood_sequence", "log_density_of_draws")
        return any(self._overrides(method) for method in methods)

    @property
    def takes_observations_one_by_one(self) -> bool:
        """Whether a subclass has a likelihood of single observations, and none of many at once."""
        return self._overrides("log_likelihood") and not self._overrides("log_likelihood_sequence")

    def _overrides(self, method: str) -> bool:
        """Return whether a subclass overrides a method."""
        return getattr(type(self), method) is not getattr(GaussianSensorModel, method)

    @property
    def extra_arguments(self) -> Mapping[str, Any]:
        """Keyword arguments of a subclass that `GaussianSensorModel` does not have."""
        return {}

    def check_observation(self, observation: ArrayLike) -> Float:
        """Return observations as an array of floats, after a check of shape and values.

        Parameters
        ----------
        observation : (..., G) array-like
            The values of the G sensors, SI. NaN stands for the value of a lost sensor.

        Raises
        ------
        InvalidObservationError
            If the last axis does not have G values, or a value is infinite.
        """
        observation = np.array(nan_where_masked(observation), order="C")
        any_leading_axes = observation.shape[:-1]
        check_shape(
            "sensor values",
            observation.shape,
            *any_leading_axes,
            self.sensor_count,
            error=InvalidObservationError,
        )
        is_infinite = np.isinf(observation)
        if np.any(is_infinite):
            position = tuple(int(i) for i in np.argwhere(is_infinite)[0])
            raise InvalidObservationError(
                f"sensor value at {position} is infinite; expected a number, or NaN for a lost "
                "sensor"
            )
        return observation

    def split_observation(self, observation: ArrayLike) -> tuple[Float, Float]:
        """Return the sensor values of an observation, and the log density of its other parts.

        Returns
        -------
        values : (..., G) array
            The values of the sensors, SI.
        log_density : (..., S) array
            The log density of the other parts in each state, such as readings of inspections; zero
            for this class.
        """
        return self.check_observation(observation), np.zeros(self.state_count)

    def draw_observations(
        self, state: Index, control_index: int, generator: np.random.Generator
    ) -> Float:
        """Draw one observation in each of N states under a control.

        Parameters
        ----------
        state : (N,) array
            The index of each state.
        control_index : int
            The control in force.
        generator : numpy.random.Generator
            The source of random numbers.

        Returns
        -------
        (N, G) array
            The sensor values with noise, SI.
        """
        count = len(state)
        # With the average inside the product over sensors, eq. (32), each sensor has its own draw.
        draws_per_row = self.sensor_count if self.averages_inside else 1
        draw = generator.choice(self.draw_count, (count, draws_per_row), p=self.draw_weight)
        sensors = np.arange(self.sensor_count)
        values = self.value_per_draw[draw, state[:, None], control_index, sensors]
        interval_factors = generator.standard_normal((count, self.interval.shape[-1]))
        deviation = self.independent_standard_deviation[state, control_index]
        noise = deviation * generator.standard_normal((count, self.sensor_count))
        change = np.einsum("ngf,nf->ng", self.interval[state, control_index], interval_factors)
        return np.asarray(values + noise + change)

    def log_likelihood(self, observation: ArrayLike, control_index: int) -> Float:
        """Return log p(o | D, u) for each state, eq. (30) or (32).

        A subclass with a `log_likelihood_sequence` alone is asked for a sequence of one.

        Parameters
        ----------
        observation : (G,) array
            The sensor values, SI; NaN where a sensor is lost. If all are lost, the result is zero.
        control_index : int
            The control in force.

        Returns
        -------
        (S,) array
            The log density in SI.

        Raises
        ------
        InvalidObservationError, InvalidModelError
            If the shape is wrong, if a value is infinite, or if there is no such control.
        """
        if self._overrides("log_likelihood_sequence") and not self._overrides("log_likelihood"):
            row = nan_where_masked(observation)[None]
            control = checked_controls([control_index], self.control_count)
            (log_density_of_row,) = self.log_likelihood_sequence(row, control)
            return np.asarray(log_density_of_row)
        values, other_log_density = self.split_observation(observation)
        log_density = self._log_densities(values[None], [control_index], 1).squeeze(axis=(0, 2))
        return np.asarray(log_density + other_log_density)

    def log_likelihood_sequence(self, observations: ArrayLike, control_index: ArrayLike) -> Float:
        """Return log p(o_t | D_t, u_t) for a sequence: (T, G) and (T,) -> (T, S).

        The rows may be the steps of one twin or one step of many twins: each is by itself. A
        subclass with a `log_likelihood` alone is asked for one row after the other.

        Raises
        ------
        InvalidObservationError, InvalidModelError
            As `log_likelihood`.
        """
        if self.takes_observations_one_by_one:
            rows = nan_where_masked(observations)
            controls = checked_controls(control_index, self.control_count)
            check_shape("controls", controls.shape, len(rows))
            log_densities_of_rows = np.empty((len(rows), self.state_count))
            for number, control in enumerate(controls.tolist()):
                log_density_of_row = np.asarray(self.log_likelihood(rows[number], control))
                check_shape("log-likelihood", log_density_of_row.shape, self.state_count)
                log_densities_of_rows[number] = log_density_of_row
            return log_densities_of_rows
        values, other_log_density = self.split_observation(observations)
        log_density = self._log_densities(values, control_index, 1).squeeze(axis=-1)
        return np.asarray(log_density + other_log_density)

    def log_density_of_draws(self, observations: ArrayLike, control_index: ArrayLike) -> Float:
        """Return log p(o_t | D_t, u_t, e) of a sequence for each draw e: (T, G), (T,) -> (T, S, E).

        Raises
        ------
        InvalidObservationError, InvalidModelError
            As `log_likelihood`.
        """
        values, other_log_density = self.split_observation(observations)
        log_density = self._log_densities(values, control_index, self.draw_count)
        if np.any(other_log_density):  # the array is large, and mostly there is nothing to add
            log_density += other_log_density[..., None]
        return log_density

    def _log_densities(self, observations: Float, control_index: ArrayLike, draws: int) -> Float:
        """Return log densities of a sequence of observations.

        Parameters
        ----------
        observations : (T, G) array
            The checked sensor values, SI; NaN where a sensor is lost.
        control_index : (T,) array
            The control in force in each step.
        draws : int
            The number E of draws for the density of each draw; 1 for their average.

        Returns
        -------
        (T, S, draws) array
            The log densities of values in SI.
        """
        control = checked_controls(control_index, self.control_count)
        check_shape("controls", control.shape, control.size)
        check_shape("observations", observations.shape, control.size, self.sensor_count)
        is_present = ~np.isnan(observations)
        if not self.averages_inside or draws != 1:
            return self._log_densities_of_sensors(observations, control, is_present, draws)
        # The average inside the product over sensors: each sensor is averaged by itself, eq. (32).
        result = np.zeros((len(observations), self.state_count, 1))
        for is_averaged_sensor in np.eye(self.sensor_count, dtype=bool):
            is_counted = is_averaged_sensor & is_present
            result += self._log_densities_of_sensors(observations, control, is_counted, 1)
        return result

    def _log_densities_of_sensors(
        self, observations: Float, control: Index, is_present: NDArray[np.bool_], draws: int
    ) -> Float:
        """Return the log density of each observation, over its present sensors only.

        Steps with the same control and the same present sensors are computed together.

        Parameters
        ----------
        observations : (T, G) array
            The sensor values, SI.
        control : (T,) array
            The control in force in each step.
        is_present : (T, G) array of bool
            Whether a sensor counts in a step.
        draws : int
            The number E of draws for the density of each draw; 1 for their average.

        Returns
        -------
        (T, S, draws) array
            The log densities of values in SI.
        """
        result = np.empty((len(observations), self.state_count, draws))
        for (control_in_force, present_key), steps in _steps_by_group(control, is_present).items():
            # Mostly the same sensors are present in the next step, so that the terms are kept.
            is_present_now = np.frombuffer(present_key, dtype=bool)
            last_key, terms = self._last_terms.get(control_in_force, (b"", None))
            if terms is None or last_key != present_key:
                terms = self._density_terms(control_in_force, is_present_now)
                self._last_terms[control_in_force] = (present_key, terms)
            draw_offset = terms.draw_offset
            if draws == 1:
                draw_offset = draw_offset - self._log_weight  # the sum over draws is weighted
            log_densities(
                np.ascontiguousarray(np.where(is_present_now, observations[steps], 0.0).T),
                terms.mean,
                terms.inverse_deviation,
                terms.interval_directions,
                terms.draw_directions,
                self._draw_coefficients,
                draw_offset,
                terms.log_scale,
                steps,
                result,
            )
        return result

    def _density_terms(self, control: int, is_present: NDArray[np.bool_]) -> _DensityTerms:
        """Return the terms that all observations with the same present sensors share.

        In units of noise the covariance is C = 1 + V V', with V (G, F) the changes within the
        interval. By Woodbury's identity its inverse is 1 - I' I, where I = L^-1 V' are the interval
        directions, and L is the Cholesky factor of 1 + V' V. Let d be the observation minus the
        mean, and A b_e what draw e adds to the mean. Then

            -(d - A b_e)' C^-1 (d - A b_e) / 2 =
                -d' C^-1 d / 2 + d' (C^-1 A) b_e - b_e' A' C^-1 A b_e / 2.
        """
        inverse_deviation = np.where(
            is_present, 1.0 / self.independent_standard_deviation[:, control], 0.0
        )
        interval = self.interval[:, control] * inverse_deviation[..., None]  # V, (S, G, F)
        transposed = interval.swapaxes(1, 2)
        root = np.linalg.cholesky(np.eye(interval.shape[-1]) + transposed @ interval)
        interval_directions = np.linalg.solve(root, transposed)

        directions = np.where(is_present[:, None], self._draw_directions[:, control], 0.0)  # A
        whitened = directions - interval_directions.swapaxes(1, 2) @ (
            interval_directions @ directions
        )
        coefficients = self._draw_coefficients
        quadratic = whitened.swapaxes(1, 2) @ directions @ coefficients
        draw_offset = 0.5 * np.sum(quadratic * coefficients, axis=1)

        log_scale = np.log(inverse_deviation[:, is_present]).sum(axis=1)
        log_scale = log_scale - LOG_ROOT_TWO_PI * is_present.sum()
        log_scale -= np.log(np.einsum("sff->sf", root)).sum(axis=1)  # half the log determinant
        return _DensityTerms(
            log_scale=log_scale,
            draw_offset=draw_offset,
            mean=np.ascontiguousarray(self.mean[:, control]),
            inverse_deviation=inverse_deviation,
            interval_directions=interval_directions,
            draw_directions=whitened,
        )

    def fit_within_interval(
        self, observation: Float, control_index: int, value: Float, precision: ArrayLike = 1.0
    ) -> IntervalFit:
        """Fit the point within the interval of each state to an observation.

        The point has a standard normal prior for each factor, so that the fit is a ridge
        regression.

        Parameters
        ----------
        observation : (G,) array
            The sensor values, SI; NaN where a sensor is lost.
        control_index : int
            The control in force.
        value : (E, S, G) array
            The predictions of some draws at the levels, SI.
        precision : float or (G,) array
            The precision of each sensor over the assumed one. With a low precision a sensor that is
            off does not shift the fitted point.
        """
        is_present = ~np.isnan(observation)
        root_precision = np.sqrt(precision)
        inverse_deviation = 1.0 / self.independent_standard_deviation[:, control_index]
        interval = self.interval[:, control_index]  # (S, G, F)
        design_scale = np.where(is_present, root_precision, 0.0) * inverse_deviation
        design = design_scale[..., None] * interval
        distance = np.where(is_present, observation - value, 0.0)
        distance = distance.clip(-LARGEST_DISTANCE, LARGEST_DISTANCE)
        residual = distance * inverse_deviation * root_precision

        # The most probable point, for each draw and state.
        normal_matrix = np.eye(design.shape[-1]) + design.swapaxes(1, 2) @ design
        covariance = np.linalg.inv(normal_matrix)  # (S, F, F)
        regression = covariance @ design.swapaxes(1, 2)  # (S, F, G)
        point = (regression @ residual[..., None]).squeeze(axis=-1)  # (E, S, F)
        change = (interval @ point[..., None]).squeeze(axis=-1)  # (E, S, G)

        # Leave-one-out residual of a linear regression: the residual over (1 - leverage), where the
        # leverage is the derivative of the fitted value by the observed one.
        leverage = np.einsum("sgf,sfg->sg", design, regression)
        one_minus_leverage = (1.0 - leverage).clip(LEAST_ONE_MINUS_LEVERAGE)
        residual_by_others = (distance - change) / one_minus_leverage
        log_determinant = np.linalg.slogdet(covariance)[1]
        return IntervalFit(
            value=value + change,
            value_by_others=value + (distance - residual_by_others),
            one_minus_leverage=one_minus_leverage,
            log_density=0.5 * (log_determinant - np.sum(point**2, axis=-1)),
        )

    def worst_residuals(self, observation: ArrayLike, control_index: int) -> dict[str, float]:
        """Return the largest residuals of an observation, in the state that fits it best.

        This is the state with the smallest sum of absolute residuals. The residuals are in standard
        deviations, the largest first, by names such as "sensor 1".
        """
        observation = np.asarray(observation)[: self.sensor_count]
        predicted_values = self.mean[:, control_index]
        deviation = self.total_standard_deviation[:, control_index]
        with np.errstate(over="ignore"):  # absurd observations overflow
            residual = (observation - predicted_values) / deviation
            distance = np.nan_to_num(np.abs(residual), nan=0.0)
            best_fitting_state = int(np.argmin(distance.sum(axis=1)))
        worst_first = np.argsort(-distance[best_fitting_state])
        return {
            f"sensor {index + 1}": float(residual[best_fitting_state, index])
            for index in worst_first[:_WORST_LISTED]
        }

    def noise(self, joint: ArrayLike, _rows: Float | None = None) -> Float:
        """Return the standard deviation (..., G) of the noise of each sensor under beliefs, SI.

        It contains noise, model error and the change within the interval of the state.

        Parameters
        ----------
        joint : (..., S, U) array
            The joint beliefs over states and controls.
        _rows : (..., G + I) array, optional
            What was observed; only sensors with a covariance of their own use it.
        """
        weight = self.check_joint(joint)
        weight = weight.reshape(*weight.shape[:-2], -1)
        variance = self.total_standard_deviation.reshape(-1, self.sensor_count) ** 2
        return np.asarray(np.sqrt(product_of_each(weight, variance)))


def _steps_by_group(
    control: Index, is_present: NDArray[np.bool_]
) -> dict[tuple[int, bytes], Index]:
    """Group the steps that have the same control and the same present sensors.

    The key of a group is the control, and `is_present` of its steps as bytes (an array cannot be
    part of a key); its value holds the numbers of its steps.

    Parameters
    ----------
    control : (T,) array
        The control in force in each step.
    is_present : (T, G) array of bool
        Whether a sensor counts in a step.
    """
    if len(control) > _MANY_STEPS and bool(np.all(is_present == is_present[0])):
        present_key = is_present[0].tobytes()
        return {
            (control_of_group, present_key): np.flatnonzero(control == control_of_group)
            for control_of_group in np.unique(control).tolist()
        }
    steps_by_group: dict[tuple[int, bytes], list[int]] = {}
    for step, control_in_force in enumerate(control.tolist()):
        group = (control_in_force, is_present[step].tobytes())
        steps_by_group.setdefault(group, []).append(step)
    return {group: np.array(steps) for group, steps in steps_by_group.items()}


def check_noise(
    key: str, deviation: ArrayLike, predicted_values: Float, units: Sequence[str]
) -> None:
    """Refuse a noise that is larger than all values that the sensors of its unit can show.

    The cause is most likely a forgotten unit. All sensors of a unit are taken together, because a
    single sensor may be insensitive to every state.

    Parameters
    ----------
    key : str
        The key of the noise in the scenario.
    deviation : float or (G,) array
        The standard deviation of the noise, SI.
    predicted_values : (E, S, U, G) array
        The sensor values without noise, SI.
    units : sequence of str
        The unit of each of the G sensors.

    Raises
    ------
    InvalidModelError
        If the noise of a sensor is that large; the message names the sensor, the range of values
        that it can show, and the likely unit.
    """
    noise = np.broadcast_to(np.asarray(deviation, dtype=np.float64), len(units))
    lowest = predicted_values.min(axis=(0, 1, 2))
    highest = predicted_values.max(axis=(0, 1, 2))
    for sensor, (unit, sensor_noise) in enumerate(zip(units, noise.tolist(), strict=True)):
        same_unit = [index for index, other_unit in enumerate(units) if other_unit == unit]
        low = float(lowest[same_unit].min())
        high = float(highest[same_unit].max())
        largest_signal = max(high - low, abs(low), abs(high))
        if sensor_noise <= largest_signal:
            continue
        if unit != "1":
            advice = f"give it in {unit}, the unit of the sensor"
        elif sensor_noise * 1e-6 <= largest_signal:
            advice = (
                f"it is likely meant in microstrain: write `{key}_microstrain = {sensor_noise:g}`"
            )
        else:
            advice = "give it as a strain, without unit"
        raise InvalidModelError(
            f"`{key}` is {sensor_noise:g} for sensor {sensor + 1}, and all that sensors of its "
            f"unit ({unit}) can show by the twin's model lies between {low:.3g} and {high:.3g}: "
            f"such a sensor gives no information; {advice}."
        )
