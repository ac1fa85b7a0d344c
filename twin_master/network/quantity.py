"""Quantities of interest: what a belief about the state says about what the sensors would show without noise.

The quantity depends on the state, the control and the uncertain parameters of the asset, of which there are
draws. Given a belief, its distribution is a mixture of point values, so that mean, standard deviation and
quantiles are exact: Kapteyn et al. 2021, eqs. (3) and (37).

Rewards for health, control and error follow from it with their uncertainty, eqs. (9)-(11): what counts as a
limit, what a control is worth and how an error is scaled comes from the scenario.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr

from fe.compilation import compiled
from reporting.arrays import Float, Index
from twin_master.errors import InvalidModelError, said
from twin_master.network.transition import distribution, expect_shape

TIE = 1e-12
"""A cumulative probability reaches a level when it misses it by no more than this (rounding of the sum)."""


@compiled
def _quantiles(
    weight: Float, order: Index, owner: Index, point_weight: Float, value: Float, levels: Float, result: Float
) -> None:
    """Fill result (B, P, G): for each belief and sensor walk up the sorted points until each level is met."""
    for sensor in range(order.shape[0]):
        for belief in range(weight.shape[0]):
            reached = 0.0
            level = 0
            last = value[sensor, 0]
            for k in range(order.shape[1]):
                share = weight[belief, owner[sensor, k]]
                if share > 0.0:
                    reached += share * point_weight[sensor, k]
                    last = value[sensor, k]
                    while level < len(levels) and reached >= levels[level]:
                        result[belief, level, sensor] = last
                        level += 1
                    if level == len(levels):
                        break
            while level < len(levels):  # a level of one, and a sum that rounds below it
                result[belief, level, sensor] = last
                level += 1


class QuantityModel:
    """Noise-free sensor values for every draw, state and control.

    Parameters
    ----------
    value_per_draw : (E, S, U, G)
        One value for each of E draws of the uncertain parameters, S states, U controls and G sensors, SI.
    draw_weight : (E,), optional
        Probability of each draw; equal by default.

    Attributes
    ----------
    value_per_draw : (E, S, U, G)
        SI, read-only.
    draw_weight : (E,)
        Read-only.
    draw_count, state_count, control_count, sensor_count : int

    Raises
    ------
    InvalidModelError
        If the array has another rank, is empty or not finite, or the weights are no distribution.
    """

    def __init__(self, value_per_draw: ArrayLike, draw_weight: ArrayLike | None = None) -> None:
        values = np.array(value_per_draw, dtype=np.float64, order="C")
        expect_shape("values", values.shape, "draws", "states", "controls", "sensors")
        if values.size == 0:
            raise InvalidModelError(f"expected one value or more, got the shape {values.shape}")
        if not np.all(np.isfinite(values)):
            where = tuple(int(i) for i in np.argwhere(~np.isfinite(values))[0])
            raise InvalidModelError(said("network.value", where=where, value=values[where]))
        values.setflags(write=False)
        self.value_per_draw: Float = values
        self.draw_count, self.state_count, self.control_count, self.sensor_count = values.shape
        weight = np.full(self.draw_count, 1.0 / self.draw_count) if draw_weight is None else draw_weight
        self.draw_weight = distribution(weight, size=self.draw_count, name="draw weights")

    @cached_property
    def mean(self) -> Float:
        """Mean over the draws (S, U, G)."""
        return np.asarray(np.tensordot(self.draw_weight, self.value_per_draw, axes=1))

    @cached_property
    def variance(self) -> Float:
        """Variance over the draws (S, U, G)."""
        return np.asarray(np.tensordot(self.draw_weight, (self.value_per_draw - self.mean) ** 2, axes=1))

    @cached_property
    def _sorted(self) -> tuple[Index, Index, Float, Float]:
        """Order (G, N) of all N = S * U * E points of each sensor, their owner, weight and value."""
        points = self.value_per_draw.transpose(3, 1, 2, 0).reshape(self.sensor_count, -1)
        order = np.argsort(points, axis=1, kind="stable").astype(np.int64)
        owner, draw = np.divmod(order, self.draw_count)
        return order, owner, self.draw_weight[draw], np.take_along_axis(points, order, axis=1)

    def weights(self, joint: ArrayLike) -> Float:
        """Return the checked joint (..., S, U)."""
        joint = np.asarray(joint, dtype=np.float64)
        what = "a joint belief, see `known_control`,"
        expect_shape(what, joint.shape, *joint.shape[:-2], self.state_count, self.control_count)
        return joint

    def moments(self, joint: ArrayLike) -> tuple[Float, Float]:
        """Return mean and standard deviation of each sensor's noise-free value.

        Parameters
        ----------
        joint : (..., S, U)
            p(D, U), each summing to one.

        Returns
        -------
        tuple of two (..., G)
            In the unit of the values.
        """
        weights = self.weights(joint)
        flat = weights.reshape(-1, self.state_count * self.control_count)
        mean_table = self.mean.reshape(-1, self.sensor_count)
        mean = flat @ mean_table
        # Centred, so that a certain belief gives the spread of the draws and no cancellation.
        variance = flat @ self.variance.reshape(-1, self.sensor_count)
        for row in range(len(flat)):
            variance[row] += flat[row] @ (mean_table - mean[row]) ** 2
        shape = (*weights.shape[:-2], self.sensor_count)
        return mean.reshape(shape), np.sqrt(variance).reshape(shape)

    def quantiles(self, joint: ArrayLike, levels: ArrayLike) -> Float:
        """Return exact quantiles of each sensor's noise-free value.

        The quantile at level p is the smallest value whose cumulative probability is at least p.

        Parameters
        ----------
        joint : (..., S, U)
            p(D, U), each summing to one.
        levels : (P,)
            Increasing, in (0, 1].

        Returns
        -------
        (..., P, G)
            In the unit of the values.
        """
        weights = self.weights(joint)
        chosen = np.array(levels, dtype=np.float64)
        if chosen.ndim != 1 or np.any(np.diff(chosen) < 0) or not np.all((chosen > 0.0) & (chosen <= 1.0)):
            raise InvalidModelError(f"expected increasing quantile levels in (0, 1], got {chosen}")
        flat = np.require(weights.reshape(-1, self.state_count * self.control_count), np.float64, ["C", "W"])
        result = np.empty((len(flat), len(chosen), self.sensor_count))
        order, owner, point_weight, value = self._sorted
        _quantiles(flat, order, owner, point_weight, value, chosen - TIE, result)
        return result.reshape(*weights.shape[:-2], len(chosen), self.sensor_count)


def _error_moments(observation: Float, shown: Float, variance: Float, scale: Float) -> tuple[Float, Float]:
    """Return mean and variance of the error reward: minus the mean distance of observation and model.

    What the sensors show is independently normal, and the distance of such a variable from a point has a
    folded normal distribution. observation is (G,), NaN for a lost sensor, which is left out; shown and
    variance are (..., G), and scale is broadcast against them.
    """
    seen = ~np.isnan(observation)
    distance, squared = np.abs(observation - shown)[..., seen], variance[..., seen]
    deviation = np.sqrt(squared)
    share = np.divide(distance, deviation, out=np.full_like(distance, np.inf), where=deviation > 0.0)
    folded = distance * (1.0 - 2.0 * ndtr(-share))
    folded += deviation * np.sqrt(2.0 / np.pi) * np.exp(-0.5 * share**2)
    unit = 1.0 / (np.broadcast_to(scale, shown.shape)[..., seen] * seen.sum())
    left = np.maximum(distance**2 + squared - folded**2, 0.0)
    return -(folded * unit).sum(axis=-1), (left * unit**2).sum(axis=-1)


def _mixed(weight: Float, mean: Float, within: Float) -> tuple[Float, Float]:
    """Return mean and variance (B, R) of mixtures with weights (B, ...) of parts with moments (R, ...)."""
    flat, means, variances = (part.reshape(len(part), -1) for part in (weight, mean, within))
    # Of each belief what it would be alone, which a product of matrices does not give.
    whole, spread = (np.einsum("bn,rn->br", flat, part) for part in (means, variances))
    for row, own, center in zip(spread, flat, whole, strict=True):
        row += (means - center[:, None]) ** 2 @ own
    return whole, spread


@dataclass(frozen=True)
class RewardModel:
    """The three rewards of an asset, and their expectation under a belief.

    Attributes
    ----------
    quantity : QuantityModel
        What the sensors would show without noise, for each draw, state and control.
    limit : float or tuple of float
        Sensor value at which the health reward is zero, in its unit, positive; one, or one for each of the
        sensors that count.
    control_reward : tuple of float
        One for each control.
    error_scale : float or tuple of float
        Normalised error that costs one, in its unit, positive; one, or one for each sensor.
    control_normaliser : tuple of float or None
        For each control the figure by which observation and model are divided before their distance is
        taken (the load factor); None for ones.
    health_sensors : tuple of int or None
        Indices of the sensors that count for the health reward; None for all.
    true_per_draw : (E, S, U, G), optional
        What is there at the sensors, SI, where that is not what they show: limits and health are of the
        structure, and a gauge that is known to show too little does not make it healthier.
    """

    quantity: QuantityModel
    limit: float | tuple[float, ...]
    control_reward: tuple[float, ...]
    error_scale: float | tuple[float, ...]
    control_normaliser: tuple[float, ...] | None = None
    health_sensors: tuple[int, ...] | None = None
    true_per_draw: Float | None = None

    def health(self, values: Float) -> Float:
        """Return the health reward of what is there at the sensors (..., G): one minus the largest share.

        One without load, zero where a sensor reaches its limit, one or (G,), and negative beyond.
        """
        chosen = slice(None) if self.health_sensors is None else list(self.health_sensors)
        # As a share first: rounding is monotonic: for one limit the result is that of the largest value.
        return np.asarray(1.0 - (values[..., chosen] / np.asarray(self.limit)).max(axis=-1))

    @cached_property
    def health_per_draw(self) -> Float:
        """Health reward of each draw, state and control (E, S, U)."""
        return self.health(self.quantity.value_per_draw if self.true_per_draw is None else self.true_per_draw)

    @cached_property
    def _error_scale(self) -> Float:
        """Error that costs one under each control (U, 1) or (U, G)."""
        normaliser = self.control_normaliser or (1.0,) * len(self.control_reward)
        return np.asarray(self.error_scale * np.array(normaliser)[:, None])

    @cached_property
    def _health_moments(self) -> tuple[Float, Float]:
        """Mean and variance of the health reward over the draws, each (S, U)."""
        mean = np.tensordot(self.quantity.draw_weight, self.health_per_draw, axes=1)
        variance = np.tensordot(self.quantity.draw_weight, (self.health_per_draw - mean) ** 2, axes=1)
        return mean, variance

    def planning_reward(self, health_weight: float, control_weight: float) -> Float:
        """Return the expected reward of each state and control for planning, eq. (36): (S, U)."""
        worth = np.multiply(control_weight, self.control_reward)
        return np.asarray(health_weight * self._health_moments[0] + worth)

    def expectation(self, joint: ArrayLike, observation: ArrayLike | None = None) -> tuple[Float, Float]:
        """Return mean and standard deviation of each reward (..., 3), in the order of `REWARD_NAMES`.

        The error reward is NaN where nothing was observed.

        Parameters
        ----------
        joint : (..., S, U)
            p(D, U); use `known_control` for a control that is known.
        observation : (..., G), optional
            SI, NaN for a lost sensor; without it (prediction) the error reward is NaN.

        Raises
        ------
        InvalidModelError
            If shapes do not fit.
        """
        quantity = self.quantity
        joint = quantity.weights(joint)
        lead = joint.shape[:-2]
        flat = joint.reshape(-1, quantity.state_count, quantity.control_count)
        health, health_variance = self._health_moments
        tables = np.stack([health, np.broadcast_to(self.control_reward, health.shape)])
        within = np.stack([health_variance, np.zeros_like(health)])
        mean, variance = (
            np.pad(own, ((0, 0), (0, 1)), constant_values=np.nan) for own in _mixed(flat, tables, within)
        )
        if observation is not None:
            observation = np.asarray(observation, dtype=np.float64)
            for row, seen in enumerate(observation.reshape(-1, quantity.sensor_count)):
                if not np.isnan(seen).all():
                    state, chosen = np.nonzero(flat[row])
                    shown = quantity.value_per_draw[:, state, chosen]
                    error, _ = _error_moments(seen, shown, np.zeros_like(shown), self._error_scale[chosen])
                    share = quantity.draw_weight[:, None] * flat[row, state, chosen]
                    mean[row, 2] = (share * error).sum()
                    variance[row, 2] = (share * (error - mean[row, 2]) ** 2).sum()
        return mean.reshape(*lead, 3), np.sqrt(variance).reshape(*lead, 3)

    def expectation_of(
        self,
        weight: Float,
        draw: Index,
        controls: slice,
        shown: Float,
        variance: Float,
        observation: Float | None = None,
    ) -> tuple[Float, Float]:
        """Return mean and standard deviation (B, 3) under beliefs over hypotheses, states and controls.

        Parameters
        ----------
        weight : (B, K, S, U')
            Probabilities, which sum to one.
        draw : (K,)
            Draw of the parameter of each hypothesis.
        controls : slice
            Which of the controls the U' are.
        shown, variance : (K, S, U', G)
            What each sensor shows there without noise, independently normal, SI.
        observation : (G,), optional
            SI, NaN for a lost sensor; without it the error reward is NaN.
        """
        mean = np.full((3, *shown.shape[:-1]), np.nan)
        within = np.zeros_like(mean)
        mean[0], mean[1] = self.health_per_draw[draw][:, :, controls], self.control_reward[controls]
        if observation is not None and not np.isnan(observation).all():
            mean[2], within[2] = _error_moments(observation, shown, variance, self._error_scale[controls])
        whole, spread = _mixed(weight, mean, within)
        return whole, np.sqrt(spread)
