"""The search for the grid of probabilities, with several grids in each reading of the twins.

`likelihood_grid` narrows a grid step by step. To read all twins for each grid would take longer
than to compute all grids. Therefore the search is first run with an expected log likelihood, and
all grids that it visits are then computed in one reading. A grid that was expected wrongly costs
time; it never changes a result, because the search itself goes on with computed values only.
"""

from collections.abc import Callable

import numpy as np

from reporting.arrays import Float
from twin_master.fleet.posterior import Axes, LikelihoodGrid, likelihood_grid

MOST_GRIDS = 8
"""The largest number of grids that are computed in one reading."""


class GridSearch:
    """Finds the grid that resolves the posterior of K probabilities to worsen.

    Parameters
    ----------
    log_likelihoods : callable
        Returns the log likelihood of all twins on several grids of log odds, in one reading.
    expected_log_likelihood : callable or None
        Returns roughly that of all twins on one grid, from some of them; None if there are too few.
    count : int
        The number K of probabilities.
    """

    def __init__(
        self,
        log_likelihoods: Callable[[tuple[Axes, ...]], list[Float]],
        expected_log_likelihood: Callable[[Axes], Float] | None,
        count: int,
    ) -> None:
        self._log_likelihoods = log_likelihoods
        self._expected_log_likelihood = expected_log_likelihood
        self._count = count
        self._computed: dict[bytes, Float] = {}
        self._last_grid: LikelihoodGrid | None = None

    def likelihood(self) -> LikelihoodGrid:
        """Return the likelihood of all twins on the grid that resolves the posterior."""
        return likelihood_grid(self._log_likelihood, self._count)

    def _log_likelihood(self, axes: Axes) -> Float:
        """Return the log likelihood of all twins on a grid of the search."""
        if _key(axes) not in self._computed:
            grids = self._expected_grids(axes)
            for grid, values in zip(grids, self._log_likelihoods(grids), strict=True):
                self._computed[_key(grid)] = values
        values = self._computed[_key(axes)]
        self._last_grid = LikelihoodGrid(axes, values)
        return values

    def _expected_grids(self, axes: Axes) -> tuple[Axes, ...]:
        """Return a grid that the search has reached, and those that it will most likely visit."""
        grids = [axes]

        def log_likelihood(visited: Axes) -> Float:
            values = self._computed.get(_key(visited))
            if values is not None:
                return values
            if _key(visited) != _key(axes):
                grids.append(visited)
            return self._expectation(visited)

        if self._last_grid is not None or self._expected_log_likelihood is not None:
            likelihood_grid(log_likelihood, self._count)
        return tuple(grids[:MOST_GRIDS])

    def _expectation(self, axes: Axes) -> Float:
        """Return the expected log likelihood on a grid.

        It is interpolated on the last grid of the search. Before there is one, it is that of some
        of the twins, in proportion.
        """
        if self._last_grid is None and self._expected_log_likelihood is not None:
            return self._expected_log_likelihood(axes)
        from scipy.interpolate import RegularGridInterpolator

        assert self._last_grid is not None
        values = self._last_grid.log_likelihood
        least = values[np.isfinite(values)].min(initial=0.0)
        interpolate = RegularGridInterpolator(
            self._last_grid.axes,
            np.maximum(values, least),
            method="cubic",
            bounds_error=False,
            fill_value=None,  # grids reach a little beyond the last one
        )
        return np.asarray(interpolate(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)))


def _key(axes: Axes) -> bytes:
    """Return the numbers of a grid as a key, because arrays cannot be keys."""
    return b"".join(axis.tobytes() for axis in axes)
