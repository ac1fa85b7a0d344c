"""Whether an effect has one size in all trials, or follows the trial: then it stands for something else.

From a fit with its remainder the size of one effect in each trial is a step of Newton's method away, that
trial's own nuisances following: u_t = u + g_t / h_t, with the deviation h_t^(-1/2) that the remainder widens.
Cochran's Q = sum (u_t - mean)^2 h_t is chi^2 with one degree of freedom less than trials where the sizes
agree (Cochran 1954, Biometrics 10, 101-129); what they scatter beyond their deviations is that of
DerSimonian and Laird 1986 (Controlled Clinical Trials 7, 177-188).
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from discrepancy.campaign.records import FloatArray
from discrepancy.fits.elimination import trial_block
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import is_magnitude
from discrepancy.sentences import said

LEVEL = 1e-3
"""p-value of Cochran's Q below which sizes do not agree."""
LARGE_SCATTER = 0.2
"""Scatter between trials beyond their deviations, over the common size, from which an effect follows them."""
TELLING = 0.5
"""Relative deviation of the size in a trial beyond which the trial says nothing of it."""
DIFFERENCE = 1e-4


@dataclass(frozen=True)
class SizeByTrial:
    """Sizes of an effect in separate trials.

    Attributes
    ----------
    name : str
        The effect's standard name.
    trials : tuple of str
        That say something of it.
    shares, deviations : (T,) ndarray
        Size in each trial over the common one, less one, and the standard deviation of that.
    """

    name: str
    trials: tuple[str, ...]
    shares: FloatArray
    deviations: FloatArray

    @property
    def statistic(self) -> float:
        """Cochran's Q."""
        weights = self.deviations**-2
        mean = float(weights @ self.shares / weights.sum())
        return float(weights @ (self.shares - mean) ** 2)

    @property
    def p_value(self) -> float:
        """Probability of a Q this large where the sizes agree."""
        return float(chi2.sf(self.statistic, len(self.trials) - 1))

    @property
    def scatter(self) -> float:
        """Standard deviation of the sizes beyond their own deviations, over the common size."""
        weights = self.deviations**-2
        freedom = weights.sum() - float(weights @ weights) / weights.sum()
        return float(np.sqrt(max(self.statistic - (len(self.trials) - 1), 0.0) / freedom))

    @property
    def follows(self) -> bool:
        """Whether the effect follows the trial."""
        return self.p_value < LEVEL and self.scatter > LARGE_SCATTER

    def sentence(self) -> str:
        """Return what is said of an effect that follows the trial."""
        low, high = int(np.argmin(self.shares)), int(np.argmax(self.shares))
        ends = [f"{100.0 * (1.0 + self.shares[at]):.0f} % of it in {self.trials[at]!r}" for at in (low, high)]
        return said("remarks.follows_trial", name=self.name, low=ends[0], high=ends[1], p=self.p_value)


def sizes_by_trial(problem: Problem, found: CandidateFit) -> list[SizeByTrial]:
    """Return for each effect of a fit that has a size what the trials say of it, where two or more do."""
    precision = problem.precisions(found.sums)
    rows: list[list[tuple[str, float, float]]] = [[] for _ in found.candidate.terms]
    first = problem.shared.size
    for number, data in enumerate(problem.trials):
        block = trial_block(problem, number, found, found.candidate, precision)
        matrix, gradient = block.matrix, block.gradient
        at = first
        for row, term in zip(rows, found.candidate.terms, strict=True):
            for place, item in enumerate(term.parameters):
                own = np.flatnonzero(block.index == at + place)
                if not is_magnitude(item) or not own.size:
                    continue
                information = float(matrix[own[0], own[0]])
                u = float(found.point.effect[at - first + place])
                value = item.prior.value(u)
                slope = (
                    (item.prior.value(u + DIFFERENCE) - item.prior.value(u - DIFFERENCE)) / DIFFERENCE / 2.0
                )
                if information <= 0.0 or value == 0.0:
                    break
                deviation = abs(slope / value) / np.sqrt(information)
                if deviation < TELLING:
                    step = slope / value * float(gradient[own[0]]) / information
                    row.append((data.trial.name, step, deviation))
                break
            at += len(term.parameters)
    return [
        SizeByTrial(
            term.effect.name, tuple(item[0] for item in row), np.array([item[1] for item in row]),
            np.array([item[2] for item in row]),
        )
        for term, row in zip(found.candidate.terms, rows, strict=True)
        if len(row) > 1
    ]  # fmt: skip
