"""Derivatives of one trial's prediction, kept channel by channel.

The zero and the gain of a channel touch its own readings only. With all channels side by side nearly all
derivatives would be noughts; channel by channel a trial of 24 gauges asks for a twentieth of the products.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.records import FloatArray

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class TrialDerivatives:
    """Standardised derivatives of the prediction of a trial.

    Attributes
    ----------
    rows : (C, M, N) ndarray
        Of each channel, by the M unknowns that touch it.
    owners : (C, M) ndarray of int
        Whose derivatives the rows are: unknowns of the trial from 0, then the K shared ones and effect
        parameters of `index`; the number after the last stands for none.
    local_size : int
        L, number of unknowns of the trial.
    index : (K,) ndarray of int
        Which shared unknowns (global ones first, then effect parameters) touch the trial.
    """

    rows: FloatArray
    owners: IntArray
    local_size: int
    index: IntArray

    @property
    def size(self) -> int:
        """Number of unknowns that touch the trial, L + K."""
        return self.local_size + len(self.index)

    def products(self) -> FloatArray:
        """Return the inner products (C, M, M) of the rows of each channel."""
        return np.asarray(np.matmul(self.rows, self.rows.transpose(0, 2, 1)))

    def normal(self, products: FloatArray, weights: FloatArray) -> FloatArray:
        """Return J W J^T (L + K, L + K), from the products and the weights (C,) of the channels."""
        count = self.size + 1
        at = self.owners[:, :, np.newaxis] * count + self.owners[:, np.newaxis, :]
        weighted = products * weights[:, np.newaxis, np.newaxis]
        total = np.bincount(at.ravel(), weighted.ravel(), minlength=count * count)
        return np.asarray(total.reshape(count, count)[:-1, :-1])

    def onto(self, columns: FloatArray, channels: Sequence[int] | None = None) -> FloatArray:
        """Return J d (L + K,) of readings d (C, N), or of some channels' only."""
        rows, owners = self.rows, self.owners
        if channels is not None:
            rows, owners = rows[list(channels)], owners[list(channels)]
        found = np.matmul(rows, columns[:, :, np.newaxis])[:, :, 0]
        return np.asarray(np.bincount(owners.ravel(), found.ravel(), minlength=self.size + 1)[:-1])

    def spread(self, products: FloatArray, weights: FloatArray, covariance: FloatArray) -> FloatArray:
        """Return for each channel (C,) the trace of W J^T covariance J, of all L + K unknowns."""
        padded = np.zeros((self.size + 1, self.size + 1))
        padded[:-1, :-1] = covariance
        chosen = padded[self.owners[:, :, np.newaxis], self.owners[:, np.newaxis, :]]
        return np.asarray(weights * np.einsum("cij,cij->c", chosen, products))

    def dense(self) -> tuple[FloatArray, FloatArray]:
        """Return J by the trial's own unknowns (L, N C) and by the others (K, N C), as (N, C) is ordered."""
        channels, _, samples = self.rows.shape
        found = np.zeros((self.size + 1, samples, channels))
        for channel in range(channels):
            found[self.owners[channel], :, channel] = self.rows[channel]
        whole = found[:-1].reshape(self.size, samples * channels)
        return whole[: self.local_size], whole[self.local_size :]
