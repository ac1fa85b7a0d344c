"""Quantities of interest: what a belief about the state says about what the sensors would show without noise.

The quantity depends on the state, the control and the uncertain parameters of the asset, of which there are
draws. Given a belief, its distribution is a mixture of point values, so that mean, standard deviation and
quantiles are exact: Kapteyn et al. 2021, eqs. (3) and (37).
"""

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from fe.compilation import compiled
from reporting.arrays import Float, Index
from twin_master.errors import InvalidModelError, said
from twin_master.network.distributions import distribution, expect_shape

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
