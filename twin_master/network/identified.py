"""Observations that come with a covariance of their own, such as modes that were identified of a record.

Such an observation is a row: its G values, and behind them the lower triangle of the covariance with which
they were found, row by row; NaN or left out where it is not known, which counts as zero.
"""

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import Float
from twin_master.errors import InvalidObservationError
from twin_master.network.sensor_kernels import LOG_ROOT_TWO_PI
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.scenario.observation import row_width
from twin_master.sentences import said


def packed_row(values: Float, covariance: Float) -> Float:
    """Return the row of values (G,) and their covariance (G, G)."""
    return np.concatenate((values, covariance[np.tril_indices(len(values))]))


class IdentifiedSensorModel(GaussianSensorModel):
    """Gaussian sensors whose noise has, beside the standard deviations, the covariance of each observation.

    The average over the draws is that of eq. (30), "outside". Parameters are those of `GaussianSensorModel`.
    """

    def log_likelihood(self, observation: ArrayLike, control_index: int) -> Float:
        """Return log p(o | D, u) for each state (S,), of a row with or without its covariance.

        Raises
        ------
        InvalidObservationError
            The length is another one, a value is infinite, or the covariance is none.
        """
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
            return np.zeros(self.state_count)
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
        with np.errstate(divide="ignore"):
            exponent = np.log(self.draw_weight) - 0.5 * np.sum(white**2, axis=1)
        largest = exponent.max(axis=1)
        return np.asarray(largest + np.log(np.exp(exponent - largest[:, None]).sum(axis=1)) - scale)
