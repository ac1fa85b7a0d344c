"""Outcomes of missions: means over the twins of a group with their standard errors.

The twins are read by blocks. Counts, sums and sums of squares of a block are added to those of the
blocks before, so that the memory does not grow with the number of twins.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import AnyArray, Float
from twin_master.fleet.storage.store import WITHIN, flown_rows

_PATHS_OF_OUTCOMES = (
    "delay",
    "early",
    "credible",
    "filtered/mean",
    "filtered/log_evidence",
    "truth/state",
)
"""The variables of the store from which outcomes follow."""
StoredRows = Callable[[str], AnyArray]
"""Returns a variable of a group of the store by its path, with a row for each twin of a block."""


@dataclass(frozen=True)
class Estimated:
    """An estimated quantity with its standard error; NaN if it cannot be estimated.

    Attributes
    ----------
    value, error : float
        The estimate, and its standard error.
    unit : str
        The unit of both; empty for a plain number, or if the factors of a state have different
        ones.
    """

    value: float
    error: float
    unit: str = ""


class RunningMoments:
    """Count, mean and sum of squared deviations of values that come block by block.

    The sums of two blocks are joined by the formulas of Chan, Golub and LeVeque (1983), which lose
    no digits if the mean is large compared with the standard deviation.
    """

    def __init__(self) -> None:
        self._count = 0
        self._mean = 0.0
        self._squares = 0.0

    def add(self, values: Float) -> None:
        """Add the values of further independent missions, a (B,) array."""
        count = len(values)
        if not count:
            return
        mean = float(np.mean(values))
        squares = float(np.sum((values - mean) ** 2))
        total = self._count + count
        difference = mean - self._mean
        self._mean += difference * count / total
        self._squares += squares + difference**2 * self._count * count / total
        self._count = total

    @property
    def mean(self) -> Estimated:
        """The mean with its standard error; NaN without values, as is the error of a single one."""
        if not self._count:
            return Estimated(float("nan"), float("nan"))
        if self._count == 1:
            return Estimated(self._mean, float("nan"))
        deviation = np.sqrt(self._squares / (self._count - 1))
        return Estimated(self._mean, float(deviation / np.sqrt(self._count)))

    @property
    def root(self) -> Estimated:
        """The root r of the mean, with the first-order standard error d(r^2) / (2 r)."""
        mean = self.mean
        root = float(np.sqrt(mean.value))
        return Estimated(root, mean.error / (2.0 * root) if root > 0.0 else 0.0)


class Fraction:
    """The fraction of hits among trials that come block by block."""

    def __init__(self) -> None:
        self.hits = 0
        self.trials = 0

    def add(self, is_hit: NDArray[np.bool_]) -> None:
        """Add further trials, a (B,) array."""
        self.hits += int(np.sum(is_hit))
        self.trials += len(is_hit)

    @property
    def estimate(self) -> Estimated:
        """The fraction with its error; NaN if there is no trial.

        The error is the standard deviation of the posterior Beta(hits + 1, misses + 1) of the
        probability of a hit under a uniform prior. It is above 0 even if no trial is a hit.
        """
        if not self.trials:
            return Estimated(float("nan"), float("nan"))
        a = self.hits + 1.0
        b = self.trials - self.hits + 1.0
        error = np.sqrt(a * b / (a + b + 1.0)) / (a + b)  # standard deviation of Beta(a, b)
        return Estimated(self.hits / self.trials, float(error))


@dataclass(frozen=True)
class Outcomes:
    """The outcomes of N missions, for a state of F factors.

    Attributes
    ----------
    prompt_fallbacks : Estimated
        Of the missions in which the true damage called for a fallback to a gentler control, the
        fraction in which it came within `WITHIN` steps; NaN without such a mission. A mission that
        ended within `WITHIN` steps of the call, without a fallback, is not counted.
    early_fallbacks : Estimated
        The fraction of missions with a fallback before the damage that calls for it; NaN if no
        damage calls for one.
    rms : tuple of Estimated
        For each factor, the root mean square error of its filtered mean over all steps of all
        missions, in SI units.
    bias : tuple of Estimated
        For each factor, the mean error of its filtered mean, in SI units.
    log_evidence : Estimated
        The mean log evidence of a step.
    credible_coverage : Estimated
        The fraction of the steps in which the true state lies in the smallest set of states that
        has a probability of `CREDIBILITY` under the filtered belief.
    """

    prompt_fallbacks: Estimated
    early_fallbacks: Estimated
    rms: tuple[Estimated, ...]
    bias: tuple[Estimated, ...]
    log_evidence: Estimated
    credible_coverage: Estimated

    @classmethod
    def from_store(cls, stored_arrays: Mapping[str, AnyArray]) -> "Outcomes":
        """Return the outcomes of all twins that have flown, from arrays with a row for each twin.

        Parameters
        ----------
        stored_arrays : mapping of str to array
            The variables of a group of the store, by path.
        """
        return cls.from_blocks(iter([stored_arrays.__getitem__]))

    @classmethod
    def from_blocks(cls, blocks: Iterator[StoredRows]) -> "Outcomes":
        """Return the outcomes of all twins that have flown, block by block.

        If an asset ended its simulation early, its flown steps are counted.

        Parameters
        ----------
        blocks : iterator of callable
            The variables of successive blocks of twins; at least one.
        """
        prompt_fallbacks = Fraction()
        early_fallbacks = Fraction()
        log_evidence = RunningMoments()
        credible = RunningMoments()
        mean_squares: list[RunningMoments] = []  # of each factor
        mean_errors: list[RunningMoments] = []
        for block in blocks:
            rows_flown = flown_rows(np.asarray(block("status")))
            values = {
                path: np.asarray(block(path))[rows_flown].astype(np.float64)
                for path in _PATHS_OF_OUTCOMES
            }
            delay = values["delay"]
            delays_when_called_for = delay[~np.isnan(delay)]  # NaN: the damage called for none
            prompt_fallbacks.add(delays_when_called_for <= WITHIN)
            early = values["early"]  # 1: early, 0: not early, -1: not defined
            early_fallbacks.add(early[early >= 0.0] > 0.0)
            log_evidence.add(np.nanmean(values["filtered/log_evidence"], axis=1))
            credible.add(values["credible"])

            # Means over the flown steps of each mission: (B, T, F) becomes (F, B).
            error = np.ma.masked_invalid(values["filtered/mean"] - values["truth/state"])
            mean_square = (error**2).mean(axis=1).filled(np.nan).T
            mean_error = error.mean(axis=1).filled(np.nan).T
            if not mean_errors:
                mean_squares = [RunningMoments() for _ in mean_square]
                mean_errors = [RunningMoments() for _ in mean_error]
            for factor, squares in enumerate(mean_squares):
                squares.add(mean_square[factor])
                mean_errors[factor].add(mean_error[factor])
        return cls(
            prompt_fallbacks=prompt_fallbacks.estimate,
            early_fallbacks=early_fallbacks.estimate,
            rms=tuple(moments.root for moments in mean_squares),
            bias=tuple(moments.mean for moments in mean_errors),
            log_evidence=log_evidence.mean,
            credible_coverage=credible.mean,
        )
