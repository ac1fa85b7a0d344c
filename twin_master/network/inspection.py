"""Sensors that are read only when asked for: readings of inspections behind the values of the gauges."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import Float, Index
from twin_master.errors import InvalidObservationError
from twin_master.network.sensor_kernels import LOG_ROOT_TWO_PI
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.sentences import said


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

    def sampled(self, state: Index, control_index: int, generator: np.random.Generator) -> Float:
        """Return one row drawn in each of N states (N,) under a control: (N, G + I), SI."""
        gauges = super().sampled(state, control_index, generator)
        noise = self.reading_deviation[state] * generator.standard_normal((len(state), len(self.asked_by)))
        read = np.where(self.asked_by == control_index, self.reading[state] + noise, np.nan)
        return np.hstack((gauges, read))

    def log_likelihood(self, observation: ArrayLike, control_index: int) -> Float:
        """Return log p(o | D, u) for each state (S,), of a row (G + I,) or (G,)."""
        return np.asarray(self.log_likelihood_sequence(np.asarray(observation)[None], [control_index])[0])

    def log_likelihood_sequence(self, observations: ArrayLike, control_index: ArrayLike) -> Float:
        """Return log p(o_t | D_t, u_t) for a sequence of rows: (T, G + I) or (T, G), and (T,) -> (T, S)."""
        gauges, told = self.apart(observations)
        return np.asarray(super().log_likelihood_sequence(gauges, control_index) + told)

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
