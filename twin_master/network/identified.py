"""Sensors whose observation is a row of G values and a covariance, or G values and readings.

Modes that are identified from a record come with their covariance: its lower triangle, row by row.
An unknown entry is NaN or left out, and counts as zero. Inspections come with readings of the state
by sensors that are read only if they are asked for.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import Float, Index, nan_where_masked
from twin_master.errors import InvalidObservationError
from twin_master.network.gaussian_kernels import LOG_ROOT_TWO_PI
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.scenario.observation import row_width


def packed_row(values: Float, covariance: Float) -> Float:
    """Return the row of an observation: values (G,) and the triangle of their covariance (G, G)."""
    return np.concatenate((values, covariance[np.tril_indices(len(values))]))


class IdentifiedSensorModel(GaussianSensorModel):
    """Gaussian sensors whose observations have a covariance, which is added to the assumed noise.

    Parameters are those of `GaussianSensorModel`. The average over the draws is that of eq. (30),
    "outside".
    """

    def split_observation(self, observation: ArrayLike) -> tuple[Float, Float]:
        """Return the rows unchanged, and log densities (..., S) of zero.

        An observation has no other parts.
        """
        rows = nan_where_masked(observation)
        return rows, np.zeros((*rows.shape[:-1], self.state_count))

    def noise(self, joint: ArrayLike, rows: Float | None = None) -> Float:
        """Return the standard deviation (..., G) of the noise of each sensor, SI.

        It combines the assumed noise and the variance that comes with an observation.

        Parameters
        ----------
        joint : (..., S, U) array
            The joint beliefs over states and controls.
        rows : (..., G + G (G + 1) / 2) array, optional
            The observed values, each row with the lower triangle of its covariance matrix.
        """
        assumed = super().noise(joint)
        if rows is None:
            return assumed
        # In the triangle, row by row, the variance of sensor g is the last entry of row g.
        row_lengths = np.arange(self.sensor_count) + 1
        variance_index = self.sensor_count + np.cumsum(row_lengths) - 1
        variance = np.nan_to_num(rows[..., variance_index])
        return np.asarray(np.sqrt(assumed**2 + variance))

    def _log_densities(
        self, observations: ArrayLike, control_index: ArrayLike, draws: int
    ) -> Float:
        """Return the log densities (T, S, draws) of rows; see `GaussianSensorModel._log_densities`.

        Raises
        ------
        InvalidObservationError
            If a row has another length, a value is infinite, or the covariance is not positive
            definite.
        """
        from scipy.special import logsumexp  # slow to import, and few twins identify modes

        rows = zip(np.asarray(observations), np.asarray(control_index), strict=True)
        log_density = np.array([self._log_density_of_row(row, control) for row, control in rows])
        log_density = log_density.reshape(-1, self.state_count, self.draw_count)
        if draws != 1:
            return log_density
        average = logsumexp(log_density, axis=2, b=self.draw_weight, keepdims=True)
        return np.asarray(average)

    def _log_density_of_row(self, observation: Float, control_index: int) -> Float:
        """Return the log density (S, E) of one observation in S states, for each of E draws.

        The row has the G values and the lower triangle of their covariance matrix.
        """
        row = np.array(observation, dtype=np.float64)
        count = self.sensor_count
        values = self.check_observation(row[:count])
        covariance = self._covariance_of_row(row)
        present_columns = np.flatnonzero(~np.isnan(values))
        if not present_columns.size:
            return np.zeros((self.state_count, self.draw_count))

        # Covariance in each state: identification, noise and model error, interval of the state.
        shape = (self.state_count, present_columns.size, present_columns.size)
        total_covariance = np.array(
            np.broadcast_to(covariance[np.ix_(present_columns, present_columns)], shape)
        )
        diagonal = np.arange(present_columns.size)
        noise = self.independent_standard_deviation[:, control_index, present_columns]
        total_covariance[:, diagonal, diagonal] += noise**2
        interval = self.interval[:, control_index, present_columns]
        total_covariance += interval @ interval.swapaxes(1, 2)
        try:
            root = np.linalg.cholesky(total_covariance)
        except np.linalg.LinAlgError:
            raise InvalidObservationError(
                "the covariance of the observation is not positive definite"
            ) from None

        residual = (
            values[present_columns] - self.value_per_draw[:, :, control_index, present_columns]
        )  # (E, S, G)
        # root @ root.T is the covariance, so that the whitened residuals are independent.
        whitened_residual = np.linalg.solve(root, residual.transpose(1, 2, 0))  # (S, G, E)
        # The determinant of the covariance is the squared product of the diagonal of its root.
        half_log_determinant = np.log(np.einsum("sgg->sg", root)).sum(axis=1)
        log_scale = half_log_determinant + present_columns.size * LOG_ROOT_TWO_PI
        return np.asarray(-0.5 * np.sum(whitened_residual**2, axis=1) - log_scale[:, None])

    def _covariance_of_row(self, row: Float) -> Float:
        """Return the covariance (G, G) of the values in a row, SI; zeros if the row has none."""
        count = self.sensor_count
        if len(row) not in (count, row_width(count)) or np.isinf(row).any():
            raise InvalidObservationError(
                f"an observation must have {count} finite values, or {row_width(count)} with their "
                f"covariance, but this one has {len(row)}"
            )
        covariance = np.zeros((count, count))
        if len(row) > count:
            covariance[np.tril_indices(count)] = np.nan_to_num(row[count:])
            covariance += np.tril(covariance, -1).T
        return covariance


class InspectedSensorModel(GaussianSensorModel):
    """Gaussian sensors, and readings of the state itself by inspections.

    An observation is a row of G values and I readings, NaN for those that were not asked for. A row
    of G values has no readings. Given the state the readings are independent.

    Parameters
    ----------
    *arguments, **keywords
        Those of `GaussianSensorModel`.
    expected_reading : (S, I) array
        The value of each reading in each state without noise, SI.
    reading_deviation : (S, I) array
        The standard deviation of its noise and of the true value within the interval of the state,
        SI.
    asked_by : (I,) array
        The index of the control that asks for each reading.
    """

    def __init__(
        self,
        *arguments: Any,
        expected_reading: Float,
        reading_deviation: Float,
        asked_by: Index,
        **keywords: Any,
    ) -> None:
        super().__init__(*arguments, **keywords)
        self.expected_reading = expected_reading
        self.reading_deviation = reading_deviation
        self.asked_by = asked_by

    @property
    def extra_arguments(self) -> Mapping[str, Any]:
        """Keyword arguments that `GaussianSensorModel` does not have."""
        return {
            "expected_reading": self.expected_reading,
            "reading_deviation": self.reading_deviation,
            "asked_by": self.asked_by,
        }

    def draw_observations(
        self, state: Index, control_index: int, generator: np.random.Generator
    ) -> Float:
        """Draw one observation in each of N states (N,) under a control: (N, G + I), SI.

        Readings that the control does not ask for are NaN.
        """
        values = super().draw_observations(state, control_index, generator)
        shape = (len(state), len(self.asked_by))
        noise = self.reading_deviation[state] * generator.standard_normal(shape)
        is_asked = self.asked_by == control_index
        readings = np.where(is_asked, self.expected_reading[state] + noise, np.nan)
        return np.hstack((values, readings))

    def split_observation(self, observation: ArrayLike) -> tuple[Float, Float]:
        """Return the values of the sensors, and the log densities of the readings of inspections.

        Parameters
        ----------
        observation : (..., G) or (..., G + I) array
            The values of G sensors, then the readings of I inspections, SI; NaN where a sensor is
            lost or an inspection was not asked for.

        Returns
        -------
        (..., G) array
            The values of the sensors.
        (..., S) array
            The log density of all readings together in each of S states; zero without a reading.

        Raises
        ------
        InvalidObservationError
            If a row has another length, or a value is infinite.
        """
        rows = nan_where_masked(observation)
        sensor_count = self.sensor_count
        inspection_count = self.expected_reading.shape[1]
        values = self.check_observation(rows[..., :sensor_count])
        readings = rows[..., sensor_count:]
        if readings.shape[-1] == 0:
            return values, np.zeros((*readings.shape[:-1], self.state_count))
        if readings.shape[-1] != inspection_count or np.isinf(readings).any():
            raise InvalidObservationError(
                f"an observation must have {sensor_count} finite values, or "
                f"{sensor_count + inspection_count} with the readings of inspections, but this one "
                f"has {rows.shape[-1]}"
            )
        # Gaussian log densities (..., S, I) of each reading in each state
        residual = (readings[..., None, :] - self.expected_reading) / self.reading_deviation
        log_density = -0.5 * residual**2 - np.log(self.reading_deviation) - LOG_ROOT_TWO_PI
        was_inspected = ~np.isnan(readings)[..., None, :]
        return values, np.where(was_inspected, log_density, 0.0).sum(axis=-1)
