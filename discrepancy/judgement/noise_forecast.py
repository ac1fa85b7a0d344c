"""Whether less noise would show an effect, and which unknowns could imitate it otherwise.

Let d be the change of the readings due to an effect, over their noise, and J the derivatives of the
readings with respect to the U unknowns that are fitted under every hypothesis (one row for each).
Let P be the prior precisions of these unknowns. With a noise variance that is n times smaller, the
squared distance of the effect from the model without it is

    G(n) = min over u of n |d - J' u|^2 + u' P u.

It grows in proportion to n only while the unknowns cannot imitate the change. If they can, their
prior deviations limit it, and neither less noise nor more trials of the same kind help.
"""

from math import inf, prod

import numpy as np
from scipy.optimize import brentq

from discrepancy.campaign.records import FloatArray
from discrepancy.campaign.units import UNITS
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.normal_equations import normal_equations
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import ScreenedChange
from discrepancy.fits.trial_data import TrialData

LARGEST_NOISE_REDUCTION = 100.0
"""How many times smaller the noise may have to be; more is beyond any instrument."""
LEAST_PART_IN_IMITATION = 0.2
"""Least change of the readings due to an unknown, over the largest such change, for it to be
named."""
MOST_NAMED_UNKNOWNS = 3
"""Largest number of unknowns that are named."""


class NoiseForecast:
    """The squared distances of effects from the model without them, at smaller noise.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    fit : CandidateFit
        The fit without effect.
    """

    def __init__(self, problem: Problem, fit: CandidateFit) -> None:
        noise_precision = problem.recorded_or_estimated_precisions(fit.squares_by_channel)
        equations = normal_equations(problem, fit, Candidate(), noise_precision)
        self._trials = equations.trials
        self._information = np.zeros_like(equations.matrix)
        for rows, indices in self._trials:
            self._information[np.ix_(indices, indices)] += rows.jacobian @ rows.jacobian.T
        self._prior_precision = equations.matrix - self._information
        self._names = _names_of_unknowns(problem)

    def needed_noise_reduction(
        self, change: ScreenedChange, squared_detection_distance: float
    ) -> float:
        """Return how many times smaller the noise must be for an effect to be detected.

        Parameters
        ----------
        squared_detection_distance : float
            The squared distance at which an effect is detected.

        Returns
        -------
        float
            The reduction; infinite if `LARGEST_NOISE_REDUCTION` is not enough.
        """

        def excess(noise_reduction: float) -> float:
            return self._squared_distance(change, noise_reduction) - squared_detection_distance

        # the excess grows with the reduction, so that it has one zero at most
        if excess(LARGEST_NOISE_REDUCTION) < 0.0:
            return inf
        if excess(1.0) >= 0.0:
            return 1.0
        return float(brentq(excess, 1.0, LARGEST_NOISE_REDUCTION, rtol=1e-3))

    def imitating_unknowns(self, change: ScreenedChange) -> tuple[str, ...]:
        """Return the names and stated values of the unknowns that imitate an effect.

        The noise is `LARGEST_NOISE_REDUCTION` times smaller. The unknowns that change the readings
        most come first, at most `MOST_NAMED_UNKNOWNS`.
        """
        overlaps, _ = self._overlaps(change)
        imitation = self._imitation(overlaps, LARGEST_NOISE_REDUCTION)
        changes_of_readings = np.sqrt(np.diag(self._information)) * np.abs(imitation)
        by_name: dict[str, float] = {}
        for name, change_of_readings in zip(self._names, changes_of_readings.tolist(), strict=True):
            by_name[name] = max(by_name.get(name, 0.0), change_of_readings)
        largest = max(by_name.values(), default=0.0)
        ranked = sorted(by_name, key=lambda name: -by_name[name])
        named_unknowns = [
            name for name in ranked if by_name[name] >= LEAST_PART_IN_IMITATION * largest
        ]
        return tuple(named_unknowns[:MOST_NAMED_UNKNOWNS]) if largest > 0.0 else ()

    def _squared_distance(self, change: ScreenedChange, noise_reduction: float) -> float:
        """Return G(n) of the module docstring, where n is the square of the noise reduction."""
        overlaps, squared_change = self._overlaps(change)
        imitation = self._imitation(overlaps, noise_reduction)
        return noise_reduction**2 * (squared_change - float(overlaps @ imitation))

    def _overlaps(self, change: ScreenedChange) -> tuple[FloatArray, float]:
        """Return J d (U,) and |d|^2 of a change d."""
        overlaps = np.zeros(len(self._information))
        squared_change = 0.0
        first_entry = 0
        for rows, indices in self._trials:
            trial_change = change.vector[first_entry : first_entry + rows.residual.size]
            first_entry += rows.residual.size
            overlaps[indices] += rows.jacobian @ trial_change
            squared_change += float(trial_change @ trial_change)
        return overlaps, squared_change

    def _imitation(self, overlaps: FloatArray, noise_reduction: float) -> FloatArray:
        """Return the scaled unknowns (U,) that come closest to a change, given J d (U,)."""
        matrix = self._information + self._prior_precision / noise_reduction**2
        return np.asarray(np.linalg.solve(matrix, overlaps))


def _names_of_unknowns(problem: Problem) -> list[str]:
    """Return the names of all unknowns: those that trials share, then those of each trial."""
    layout = problem.shared
    names = []
    for index, parameter in enumerate(problem.model.parameters):
        unit = "" if parameter.unit == "1" else f" {parameter.unit}"
        names.append(
            f"{parameter.name!r} ({layout.centre[index]:.4g} ± {layout.scale[index]:.2g}{unit})"
        )
    for index, channel in enumerate(layout.gain_channels, start=layout.parameter_count):
        stated_text = "not stated"
        if layout.precision[index] > 0.0:
            stated_text = f"stated to {100.0 * layout.scale[index]:.3g} %"
        names.append(f"the gain of {channel} ({stated_text})")
    for data in problem.trials:
        names += _names_of_trial_unknowns(problem, data)
    return names


def _names_of_trial_unknowns(problem: Problem, data: TrialData) -> list[str]:
    """Return the names of the unknowns of a trial, without the name of the trial."""
    trial = data.trial
    layout = data.unknowns
    names = []
    for index, column in enumerate(layout.zero_columns):
        channel = trial.channels[column]
        stated_text = "not stated"
        if layout.precision[index] > 0.0:
            factor, unit = UNITS[problem.campaign.channels[channel].quantity].drawn
            stated_text = f"stated to {factor * layout.scale[index]:.3g} {unit}"
        names.append(f"the zero of {channel} ({stated_text})")
    names += ["how the trials begin"] * prod(layout.initial_shape)
    for index in layout.offset_inputs:
        names.append(f"the constant of {trial.inputs[index].name}")
    if layout.has_time_zero:
        names.append("the time of the release")
    for column in layout.health_columns:
        names.append(f"the stated loss of {trial.regions[column]}")
    return names
