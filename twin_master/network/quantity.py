"""Sensor values without noise, and rewards, under a belief about the state.

A sensor value depends on the state, the control and the uncertain parameters of the asset, of which
there are draws. Given a belief, its distribution is a mixture of points, so that mean, standard
deviation and quantiles are exact: Kapteyn et al. 2021, eqs. (3) and (37).

Rewards for health, control and error follow with their uncertainty, eqs. (9)-(11). The scenario
says which value is a limit, what a control is worth and how an error is scaled.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fe.compilation import compiled
from reporting.arrays import Float, Index, nan_where_masked, product_of_each
from twin_master.errors import InvalidModelError
from twin_master.network.transition import check_shape, distribution

ROUNDING = 1e-12
"""A cumulative probability counts as having reached a level if it is this far below it."""
HEALTH = 0
"""Index of the health reward."""
CONTROL = 1
"""Index of the control reward."""
ERROR = 2
"""Index of the error reward."""
REWARD_COUNT = 3
"""Number of rewards."""


class SortedValues(NamedTuple):
    """The N = S U E values of each of G sensors in rising order, for S states, U controls, E draws.

    Attributes
    ----------
    state_and_control : (G, N) array
        The index of the pair of state and control to which a value belongs.
    draw_weight : (G, N) array
        The probability of the draw to which a value belongs.
    value : (G, N) array
        The values of each sensor, SI, the smallest first.
    """

    state_and_control: Index
    draw_weight: Float
    value: Float


@compiled
def _fill_quantiles(
    weight: Float, sorted_values: SortedValues, levels: Float, result: Float
) -> None:
    """Fill `result` with quantiles of G sensors under B beliefs.

    For each belief and sensor the probabilities of the sorted values are summed until each of P
    levels is reached.

    Parameters
    ----------
    weight : (B, S U) array
        The beliefs over pairs of state and control.
    levels : (P,) array
        The cumulative probabilities of the quantiles, increasing.
    result : (B, P, G) array
        The quantiles, in the unit of the values; filled here.
    """
    pair, draw_weight, value = sorted_values
    for sensor in range(value.shape[0]):
        for belief in range(weight.shape[0]):
            cumulative = 0.0
            level = 0
            last_value = value[sensor, 0]
            for k in range(value.shape[1]):
                pair_weight = weight[belief, pair[sensor, k]]
                if pair_weight > 0.0:
                    cumulative += pair_weight * draw_weight[sensor, k]
                    last_value = value[sensor, k]
                    while level < len(levels) and cumulative >= levels[level]:
                        result[belief, level, sensor] = last_value
                        level += 1
                    if level == len(levels):
                        break
            # By rounding the sum of all probabilities may stay below a level of one.
            while level < len(levels):
                result[belief, level, sensor] = last_value
                level += 1


class QuantityModel:
    """Noise-free sensor values for every draw, state and control.

    Parameters
    ----------
    value_per_draw : (E, S, U, G) array
        One value for each of E draws of the uncertain parameters, S states, U controls and G
        sensors, SI.
    draw_weight : (E,) array, optional
        The probability of each draw; equal by default.

    Attributes
    ----------
    value_per_draw : (E, S, U, G) array
        The values, SI, read-only.
    draw_weight : (E,) array
        The probability of each draw, read-only.
    draw_count, state_count, control_count, sensor_count : int
        The lengths of the axes.

    Raises
    ------
    InvalidModelError
        If the array has another rank, is empty or not finite, or the weights are not a
        distribution.
    """

    def __init__(self, value_per_draw: ArrayLike, draw_weight: ArrayLike | None = None) -> None:
        values = np.array(nan_where_masked(value_per_draw), order="C")
        check_shape("values", values.shape, "draws", "states", "controls", "sensors")
        if values.size == 0:
            raise InvalidModelError(
                f"there must be one value or more, but the array has the shape {values.shape}"
            )
        is_finite = np.isfinite(values)
        if not np.all(is_finite):
            position = tuple(int(i) for i in np.argwhere(~is_finite)[0])
            raise InvalidModelError(
                f"the value at (draw, state, control, sensor) {position} is {values[position]}, "
                "but values must be finite"
            )
        values.setflags(write=False)
        self.value_per_draw: Float = values
        self.draw_count, self.state_count, self.control_count, self.sensor_count = values.shape
        if draw_weight is None:
            draw_weight = np.full(self.draw_count, 1.0 / self.draw_count)
        self.draw_weight = distribution(draw_weight, size=self.draw_count, name="draw weights")

    @cached_property
    def mean(self) -> Float:
        """Mean over the draws, by state, control and sensor: (S, U, G)."""
        return np.asarray(np.tensordot(self.draw_weight, self.value_per_draw, axes=1))

    @cached_property
    def variance(self) -> Float:
        """Variance over the draws, by state, control and sensor: (S, U, G)."""
        deviation = self.value_per_draw - self.mean
        return np.asarray(np.tensordot(self.draw_weight, deviation**2, axes=1))

    @cached_property
    def _sorted_values(self) -> SortedValues:
        """The values of each sensor in rising order."""
        values = self.value_per_draw.transpose(3, 1, 2, 0).reshape(self.sensor_count, -1)
        order = np.argsort(values, axis=1, kind="stable").astype(np.int64)
        state_and_control, draw = np.divmod(order, self.draw_count)
        sorted_values = np.take_along_axis(values, order, axis=1)
        return SortedValues(state_and_control, self.draw_weight[draw], sorted_values)

    def check_joint(self, joint: ArrayLike) -> Float:
        """Return a joint belief (..., S, U) as an array, or refuse its shape."""
        joint = nan_where_masked(joint)
        what = "a joint belief, see `known_control`,"
        leading_axes = joint.shape[:-2]
        check_shape(what, joint.shape, *leading_axes, self.state_count, self.control_count)
        return joint

    def moments(self, joint: ArrayLike) -> tuple[Float, Float]:
        """Return mean and standard deviation of each sensor's noise-free value.

        Parameters
        ----------
        joint : (..., S, U) array
            p(D, U), each summing to one.

        Returns
        -------
        mean, standard_deviation : (..., G) array
            In the unit of the values.
        """
        joint = self.check_joint(joint)
        weight = joint.reshape(-1, self.state_count * self.control_count)
        mean_table = self.mean.reshape(-1, self.sensor_count)
        variance_table = self.variance.reshape(-1, self.sensor_count)
        mean = product_of_each(weight, mean_table)
        variance = np.empty_like(mean)
        for row, weight_of_pairs in enumerate(weight):
            # Law of total variance: variance within each pair of state and control, plus that of
            # the means. Distances from the mean are squared, so that no differences cancel.
            squared_distance = (mean_table - mean[row]) ** 2
            variance[row] = weight_of_pairs @ (variance_table + squared_distance)
        shape = (*joint.shape[:-2], self.sensor_count)
        return mean.reshape(shape), np.sqrt(variance).reshape(shape)

    def quantiles(self, joint: ArrayLike, levels: ArrayLike) -> Float:
        """Return exact quantiles of each sensor's noise-free value.

        The quantile at level p is the smallest value whose cumulative probability is at least p.

        Parameters
        ----------
        joint : (..., S, U) array
            p(D, U), each summing to one.
        levels : (P,) array
            Increasing, in (0, 1].

        Returns
        -------
        (..., P, G) array
            In the unit of the values.
        """
        joint = self.check_joint(joint)
        levels = np.array(levels, dtype=np.float64)
        is_increasing = levels.ndim == 1 and not np.any(np.diff(levels) < 0)
        is_probability = (levels > 0.0) & (levels <= 1.0)
        if not is_increasing or not np.all(is_probability):
            raise InvalidModelError(
                f"the levels of quantiles must increase and lie in (0, 1], but they are {levels}"
            )
        weight = joint.reshape(-1, self.state_count * self.control_count)
        weight = np.require(weight, np.float64, ["C", "W"])  # as the compiled loop expects it
        result = np.empty((len(weight), len(levels), self.sensor_count))
        _fill_quantiles(weight, self._sorted_values, levels - ROUNDING, result)
        return result.reshape(*joint.shape[:-2], len(levels), self.sensor_count)


def _error_moments(
    observation: Float, mean: Float, variance: Float, scale: Float
) -> tuple[Float, Float]:
    """Return mean and variance (...) of the error reward for uncertain sensor values.

    The reward is minus the mean, over the present sensors, of |observation - value| / scale. The
    values are normal and independent, so that each |observation - value| has a folded normal
    distribution (Leone, Nelson and Nottingham 1961).

    Parameters
    ----------
    observation : (G,) array
        The observed values, SI; NaN for a lost sensor, which is left out.
    mean, variance : (..., G) array
        Moments of the sensor values without noise.
    scale : (..., G) or (..., 1) array
        The absolute error of a sensor for which the reward is -1.
    """
    from scipy.special import ndtr  # slow to import; only a twin that learns needs it

    is_present = ~np.isnan(observation)
    distance = np.abs(observation - mean)[..., is_present]
    variance = variance[..., is_present]
    standard_deviation = np.sqrt(variance)
    standardized = np.full_like(distance, np.inf)  # for a value without variance
    np.divide(distance, standard_deviation, out=standardized, where=standard_deviation > 0.0)
    # moments of the folded normal distribution
    gaussian = np.exp(-0.5 * standardized**2)
    folded_mean = distance * (1.0 - 2.0 * ndtr(-standardized))
    folded_mean += standard_deviation * np.sqrt(2.0 / np.pi) * gaussian
    folded_variance = np.maximum(distance**2 + variance - folded_mean**2, 0.0)
    # the mean over the present sensors, in units of their scales
    scale_of_present = np.broadcast_to(scale, mean.shape)[..., is_present]
    cost_per_distance = 1.0 / (scale_of_present * is_present.sum())
    cost = (folded_mean * cost_per_distance).sum(axis=-1)
    cost_variance = (folded_variance * cost_per_distance**2).sum(axis=-1)
    return -cost, cost_variance


def _mixture_moments(weight: Float, mean: Float, variance: Float) -> tuple[Float, Float]:
    """Return mean and variance (B, R) of R quantities under B mixtures.

    Parameters
    ----------
    weight : (B, ...) array
        The weights of the components in each mixture.
    mean, variance : (R, ...) array
        Moments of each quantity in each component.
    """
    weight = weight.reshape(len(weight), -1)
    mean = mean.reshape(len(mean), -1)
    variance = variance.reshape(len(variance), -1)
    mixture_mean = product_of_each(weight, mean.T)
    # Law of total variance: mean of the variances, plus variance of the means.
    mixture_variance = product_of_each(weight, variance.T)
    for b in range(len(weight)):
        deviation = mean - mixture_mean[b][:, None]
        mixture_variance[b] += deviation**2 @ weight[b]
    return mixture_mean, mixture_variance


@dataclass(frozen=True)
class RewardModel:
    """The three rewards of an asset, and their expectation under a belief.

    Attributes
    ----------
    quantity : QuantityModel
        The sensor values without noise, for each draw, state and control.
    limit : float or tuple of float
        The sensor value at which the health reward is zero, SI, positive: one, or one for each of
        the sensors that count.
    control_reward : tuple of float
        The reward of each control.
    error_scale : float or tuple of float
        The normalised error that costs one, SI, positive: one, or one for each sensor.
    control_normaliser : tuple of float or None
        For each control the number by which observation and model are divided before their distance
        is taken, such as the load factor; None for ones.
    health_sensors : tuple of int or None
        The indices of the sensors that count for the health reward; None for all.
    true_per_draw : (E, S, U, G) array, optional
        The true values at the sensors, SI, if sensors are known to show something else. Limits and
        health belong to the structure: a gauge that shows too little does not make it healthier.
    """

    quantity: QuantityModel
    limit: float | tuple[float, ...]
    control_reward: tuple[float, ...]
    error_scale: float | tuple[float, ...]
    control_normaliser: tuple[float, ...] | None = None
    health_sensors: tuple[int, ...] | None = None
    true_per_draw: Float | None = None

    def health(self, values: Float) -> Float:
        """Return the health reward (...) of true values at the sensors (..., G), SI.

        It is one without load, zero if one sensor reaches its limit, and negative beyond.
        """
        sensors = slice(None) if self.health_sensors is None else list(self.health_sensors)
        # The division comes before the maximum, because each sensor may have its own limit. With
        # one limit the order makes no difference, because rounding is monotonic.
        fraction_of_limit = values[..., sensors] / np.asarray(self.limit)
        return np.asarray(1.0 - fraction_of_limit.max(axis=-1))

    @cached_property
    def health_per_draw(self) -> Float:
        """Health reward of each draw, state and control (E, S, U)."""
        if self.true_per_draw is None:
            return self.health(self.quantity.value_per_draw)
        return self.health(self.true_per_draw)

    @cached_property
    def _error_scale(self) -> Float:
        """Error that costs one under each control (U, 1) or (U, G), SI."""
        normaliser = self.control_normaliser or (1.0,) * len(self.control_reward)
        return np.asarray(self.error_scale * np.array(normaliser)[:, None])

    @cached_property
    def _health_moments(self) -> tuple[Float, Float]:
        """Mean and variance of the health reward over the draws, each (S, U)."""
        weight = self.quantity.draw_weight
        mean = np.tensordot(weight, self.health_per_draw, axes=1)
        variance = np.tensordot(weight, (self.health_per_draw - mean) ** 2, axes=1)
        return mean, variance

    def planning_reward(self, health_weight: float, control_weight: float) -> Float:
        """Return the expected reward for planning, by state and control, eq. (36): (S, U)."""
        mean_health, _ = self._health_moments
        weighted_control = np.multiply(control_weight, self.control_reward)
        return np.asarray(health_weight * mean_health + weighted_control)

    def expectation(
        self, joint: ArrayLike, observation: ArrayLike | None = None
    ) -> tuple[Float, Float]:
        """Return mean and standard deviation of each reward (..., 3), in order of `REWARD_NAMES`.

        Parameters
        ----------
        joint : (..., S, U) array
            p(D, U); use `known_control` for a control that is known.
        observation : (..., G) array, optional
            The observed values, SI; NaN for a lost sensor. If no value was observed, as in a
            prediction, the error reward is NaN.

        Raises
        ------
        InvalidModelError
            If shapes do not fit.
        """
        quantity = self.quantity
        joint = quantity.check_joint(joint)
        beliefs = joint.reshape(-1, quantity.state_count, quantity.control_count)
        mean = np.full((len(beliefs), REWARD_COUNT), np.nan)
        variance = np.full((len(beliefs), REWARD_COUNT), np.nan)

        health_mean, health_variance = self._health_moments
        control_mean = np.broadcast_to(self.control_reward, health_mean.shape)
        mean[:, :ERROR], variance[:, :ERROR] = _mixture_moments(
            beliefs,
            np.stack([health_mean, control_mean]),
            np.stack([health_variance, np.zeros_like(health_mean)]),
        )

        if observation is not None:
            observations = nan_where_masked(observation)
            for b, row in enumerate(observations.reshape(-1, quantity.sensor_count)):
                if not np.isnan(row).all():
                    mean[b, ERROR], variance[b, ERROR] = self._error_reward(beliefs[b], row)
        shape = (*joint.shape[:-2], REWARD_COUNT)
        return mean.reshape(shape), np.sqrt(variance).reshape(shape)

    def _error_reward(self, belief: Float, observation: Float) -> tuple[float, float]:
        """Return mean and variance of the error reward of an observation (G,), given a belief."""
        state, control = np.nonzero(belief)  # pairs of positive probability
        value = self.quantity.value_per_draw[:, state, control]  # (E, n, G) of n pairs
        # The error reward at each known value. It equals the mean that `_error_moments` returns for
        # a variance of zero, and is faster.
        is_present = ~np.isnan(observation)
        distance = np.abs(observation - value)[..., is_present]
        scale = np.broadcast_to(self._error_scale[control], value.shape)[..., is_present]
        cost_per_distance = 1.0 / (scale * is_present.sum())
        error = -(distance * cost_per_distance).sum(axis=-1)
        weight = self.quantity.draw_weight[:, None] * belief[state, control]
        mean = (weight * error).sum()
        variance = (weight * (error - mean) ** 2).sum()
        return mean, variance

    def expectation_of(
        self,
        weight: Float,
        draw: Index,
        controls: slice,
        mean: Float,
        variance: Float,
        observation: Float | None = None,
    ) -> tuple[Float, Float]:
        """Return mean and standard deviation (B, 3) of each reward for a twin that learns.

        Each belief is a joint one over K hypotheses on constant unknowns, S states and U' of the
        controls.

        Parameters
        ----------
        weight : (B, K, S, U') array
            The beliefs; each sums to one.
        draw : (K,) array
            The draw of the parameter of each hypothesis.
        controls : slice
            The U' controls among all.
        mean, variance : (K, S, U', G) array
            Moments of each sensor's value without noise, independently normal, SI.
        observation : (G,) array, optional
            The observed values, SI; NaN for a lost sensor. If left out, the error reward is NaN.
        """
        reward_mean = np.full((REWARD_COUNT, *mean.shape[:-1]), np.nan)
        reward_variance = np.zeros_like(reward_mean)
        reward_mean[HEALTH] = self.health_per_draw[draw][:, :, controls]
        reward_mean[CONTROL] = self.control_reward[controls]
        if observation is not None and not np.isnan(observation).all():
            reward_mean[ERROR], reward_variance[ERROR] = _error_moments(
                observation, mean, variance, self._error_scale[controls]
            )
        mixture_mean, mixture_variance = _mixture_moments(weight, reward_mean, reward_variance)
        return mixture_mean, np.sqrt(mixture_variance)
