"""Sensors whose observation is a row with more behind its G values: a covariance of its own, or readings.

Of modes that were identified of a record it is the lower triangle of the covariance with which they were
found, row by row; NaN or left out where it is not known, which counts as zero. Of inspections it is what was
read of the state, by sensors that are read only when asked for.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from reporting.arrays import Float, Index
from twin_master.errors import InvalidObservationError, said
from twin_master.network.kernels import LOG_ROOT_TWO_PI
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.scenario.observation import row_width


def packed_row(values: Float, covariance: Float) -> Float:
    """Return the row of values (G,) and their covariance (G, G)."""
    return np.concatenate((values, covariance[np.tril_indices(len(values))]))


class IdentifiedSensorModel(GaussianSensorModel):
    """Gaussian sensors whose noise has, beside the standard deviations, the covariance of each observation.

    The average over the draws is that of eq. (30), "outside". Parameters are those of `GaussianSensorModel`.
    """

    def apart(self, observation: ArrayLike) -> tuple[Float, Float]:
        """Return rows with or without their covariances, of which nothing passes beside the sensors."""
        rows = np.asarray(observation, dtype=np.float64)
        return rows, np.zeros((*rows.shape[:-1], self.state_count))

    def noise(self, joint: ArrayLike, rows: Float | None = None) -> Float:
        """Return the standard deviation of sensors, that of what was identified among it; see there."""
        assumed, place = super().noise(joint), np.cumsum(np.arange(self.sensor_count) + 1) - 1
        told = np.zeros(1) if rows is None else np.nan_to_num(rows[..., self.sensor_count + place])
        return np.asarray(np.sqrt(assumed**2 + told))

    def _densities(self, observations: ArrayLike, control_index: ArrayLike, draws: int) -> Float:
        """Return log densities (T, S, E) of each draw, or of their average where `draws` is one.

        Raises
        ------
        InvalidObservationError
            The length of a row is another one, a value is infinite, or the covariance is none.
        """
        rows = zip(np.asarray(observations), np.asarray(control_index), strict=True)
        shape = self.state_count, self.draw_count
        each = np.array([self._of_draws(row, control) for row, control in rows]).reshape(-1, *shape)
        average = draws == 1
        return np.asarray(logsumexp(each, axis=2, b=self.draw_weight, keepdims=True)) if average else each

    def _of_draws(self, observation: Float, control_index: int) -> Float:
        row, count = np.array(observation, dtype=np.float64), self.sensor_count
        values = self.checked(row[:count])
        covariance = np.zeros((count, count))
        if len(row) not in (count, row_width(count)) or np.isinf(row).any():
            widths = count, row_width(count), len(row)
            raise InvalidObservationError(said("network.covariance", widths=widths))
        covariance[np.tril_indices(count)] = np.nan_to_num(row[count:]) if len(row) > count else 0.0
        covariance += np.tril(covariance, -1).T
        seen = np.flatnonzero(~np.isnan(values))
        if not seen.size:
            return np.zeros((self.state_count, self.draw_count))
        total = np.array(
            np.broadcast_to(covariance[np.ix_(seen, seen)], (self.state_count, seen.size, seen.size))
        )
        place = np.arange(seen.size)
        total[:, place, place] += self.independent_standard_deviation[:, control_index, seen] ** 2
        interval = self.interval[:, control_index, seen]
        total += interval @ interval.swapaxes(1, 2)
        try:
            factor = np.linalg.cholesky(total)
        except np.linalg.LinAlgError:
            raise InvalidObservationError(said("network.not_definite")) from None
        residual = values[seen] - self.value_per_draw[:, :, control_index, seen]  # (E, S, G)
        white = np.linalg.solve(factor, residual.transpose(1, 2, 0))  # (S, G, E)
        scale = np.log(np.einsum("sgg->sg", factor)).sum(axis=1) + seen.size * LOG_ROOT_TWO_PI
        return np.asarray(-0.5 * np.sum(white**2, axis=1) - scale[:, None])


class InspectedSensorModel(GaussianSensorModel):
    """Gaussian sensors, and readings of the state itself.

    An observation is a row: its G values, and behind them I readings, NaN where they were not asked for; a
    row without them has none. Given the state they are independent.

    Parameters
    ----------
    *args, **keywords
        Of `GaussianSensorModel`.
    reading : (S, I)
        What each reading shows in each state without noise, SI.
    reading_deviation : (S, I)
        Standard deviation of its noise, and of what lies within the interval of the state, SI.
    asked_by : (I,)
        Index of the control that asks for each reading.
    """

    def __init__(
        self, *args: Any, reading: Float, reading_deviation: Float, asked_by: Index, **keywords: Any
    ) -> None:
        super().__init__(*args, **keywords)
        self.reading, self.reading_deviation, self.asked_by = reading, reading_deviation, asked_by

    @property
    def beside(self) -> dict[str, Any]:
        """Keywords beside those of `GaussianSensorModel`."""
        return {name: getattr(self, name) for name in ("reading", "reading_deviation", "asked_by")}

    def sampled(self, state: Index, control_index: int, generator: np.random.Generator) -> Float:
        """Return one row drawn in each of N states (N,) under a control: (N, G + I), SI."""
        gauges = super().sampled(state, control_index, generator)
        noise = self.reading_deviation[state] * generator.standard_normal((len(state), len(self.asked_by)))
        read = np.where(self.asked_by == control_index, self.reading[state] + noise, np.nan)
        return np.hstack((gauges, read))

    def apart(self, observation: ArrayLike) -> tuple[Float, Float]:
        """Return the values of the sensors, and log p(readings | D); see `GaussianSensorModel.apart`."""
        rows, count = np.asarray(observation, dtype=np.float64), self.sensor_count
        gauges, read = self.checked(rows[..., :count]), rows[..., count:]
        if not read.shape[-1]:
            return gauges, np.zeros((*read.shape[:-1], self.state_count))
        if read.shape[-1] != self.reading.shape[1] or np.isinf(read).any():
            widths = count, count + self.reading.shape[1], rows.shape[-1]
            raise InvalidObservationError(said("network.readings", widths=widths))
        residual = (read[..., None, :] - self.reading) / self.reading_deviation
        density = -0.5 * residual**2 - np.log(self.reading_deviation) - LOG_ROOT_TWO_PI
        return gauges, np.where(np.isnan(read)[..., None, :], 0.0, density).sum(axis=-1)
