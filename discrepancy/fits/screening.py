"""Screening: how much an effect could explain, before any fit, to first order in the nuisances.

Let d be the standardised change that an effect makes to the prediction at the fitted nuisances, J
the derivatives of the prediction by the nuisances, r the residuals, g the gradient and H the
Hessian of the fit. The misfit after the nuisances have adapted is

    F(d) = F(0) - b(d) + G(d, d) / 2,
    G(c, d) = c.d - (J c)' H^-1 (J d),   b(d) = r.d - g' H^-1 (J d).

Changes of several effects add, so pairs and scales of effects cost inner products only. G is also
the measure that separates two effects before data are looked at.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from math import sqrt

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import ndtri

from discrepancy.campaign.records import FloatArray, TrialKind
from discrepancy.catalogue.entry import EffectParameter, ShapeParameter
from discrepancy.errors import DiscrepancyError
from discrepancy.search_settings import SEARCH

from .candidate import Candidate, EffectTerm
from .fitting import LARGEST_EFFECT, CandidateFit
from .normal_equations import check_finite, cholesky_factor, normal_equations
from .problem import Problem


@dataclass(frozen=True)
class ScreenedChange:
    """The change of the prediction by an effect at given values, without what nuisances can do.

    Attributes
    ----------
    term : EffectTerm
        The effect at its place.
    start : (E,) array
        The scaled parameters of the effect.
    vector : (D,) array
        The change and its projections on the nuisances, such that G(c, d) = (sign c).d with
        `Screen.sign`.
    overlap : float
        b(d): the overlap of the change with the residuals [nat].
    squared_size : float
        G(d, d): the squared distance from the model without the change, in noise variances.
    """

    term: EffectTerm
    start: FloatArray
    vector: FloatArray
    overlap: float
    squared_size: float

    @property
    def scale(self) -> float:
        """The factor on the change at which it explains most."""
        return self.overlap / self.squared_size if self.squared_size > 0.0 else 0.0

    @property
    def gain(self) -> float:
        """The decrease of the misfit at the best scale [nat].

        0 where that has a sign the effect cannot have.
        """
        if self.overlap > 0.0 or self.term.may_be_negative:
            return 0.5 * self.overlap * self.scale
        return 0.0

    @property
    def best(self) -> FloatArray:
        """The scaled parameters (E,) with the magnitude at the best scale: the start of a fit."""
        lowest = -0.7 * LARGEST_EFFECT
        return self.term.rescaled(self.start, self.scale, lowest, SEARCH.largest_start)


class Screen:
    """A fit as a screen for further effects: changes of its prediction and their inner products.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    fit : CandidateFit
        The fit at which nuisances are eliminated; its own effects stay as they are.
    record_noise : bool
        Whether residuals are weighted by the noise records, or by what the fit left.
    effect_precision : (E,) array, optional
        The prior precisions of the fit's own effect parameters; if given, these adapt to a change
        as the nuisances do.
    """

    def __init__(
        self,
        problem: Problem,
        fit: CandidateFit,
        *,
        record_noise: bool = True,
        effect_precision: FloatArray | None = None,
    ) -> None:
        self.problem = problem
        self.fit = fit
        precision = problem.precisions(fit.sums)
        if record_noise:
            precision = np.where(problem.freedom > 0.0, 1.0, precision)
        adapting = Candidate() if effect_precision is None else fit.candidate
        equations = normal_equations(problem, fit, adapting, precision, effect_precision)
        self._trials = equations.trials
        self._nuisance_count = len(equations.gradient)
        factor = cholesky_factor(equations.matrix)
        self._inverse_factor = solve_triangular(
            factor, np.eye(self._nuisance_count), trans="T", check_finite=False
        )
        self._gradient = self._inverse_factor @ equations.gradient

    @property
    def sign(self) -> FloatArray:
        """The signs (D,) of the inner product.

        1 for changes, -1 for their projections on nuisances.
        """
        samples = sum(residual.size for residual in self.fit.residuals)
        return np.repeat((1.0, -1.0), (samples, self._nuisance_count))

    # ---------------------------------------------------------------- changes of the prediction

    def change(self, term: EffectTerm, start: FloatArray) -> ScreenedChange:
        """Return the change by a term at scaled parameters (E,), beside the effects of the fit."""
        candidate = self.fit.candidate.with_term(term)
        effect = np.concatenate((self.fit.point.effect, start))
        vector, overlap, size = self._change_to(candidate, effect, term.effect.acts_on)
        return ScreenedChange(term, start, vector, overlap, max(size, 0.0))

    def misfit_rise(self, effect: FloatArray) -> float:
        """Return the rise of the misfit [nat] at other effect parameters (E,) of the fit."""
        candidate = self.fit.candidate
        _, overlap, size = self._change_to(candidate, effect, candidate.acts_on)
        return 0.5 * size - overlap

    @np.errstate(over="ignore", invalid="ignore")
    def _change_to(
        self, candidate: Candidate, effect: FloatArray, kinds: frozenset[TrialKind]
    ) -> tuple[FloatArray, float, float]:
        """Return vector, overlap b and size G of the change to a candidate, in kinds of trials."""
        problem = self.problem
        point = self.fit.point
        patch = candidate.patch(problem.setting, effect)
        changes: dict[int, FloatArray] = {}
        for number, data in enumerate(problem.trials):
            if data.trial.kind not in kinds:
                continue
            response, _ = problem.response(number, point.shared, point.local[number], patch)
            gains = 1.0 + problem.shared.gains(point.shared, data.trial.channels)
            changes[number] = data.standardised(gains * (response - self.fit.responses[number]))
        return self.project(changes)

    def project(self, changes: Mapping[int, FloatArray]) -> tuple[FloatArray, float, float]:
        """Return vector, overlap b and size G of changes, without what nuisances can do.

        Parameters
        ----------
        changes : mapping of int to (N, C) array
            The standardised changes of predictions, by the index of the trial.

        Returns
        -------
        vector : (D,) array
            The changes of all trials, and their projections on the nuisances.
        overlap, size : float
            b(d) and G(d, d) of the module's text.
        """
        by_nuisance = np.zeros(self._nuisance_count)  # J d
        trial_changes = []
        overlap = 0.0
        size = 0.0
        for number, (rows, index) in enumerate(self._trials):
            d: FloatArray = np.zeros(rows.residual.shape)
            if number in changes:
                d = (changes[number] * rows.root).ravel()
                by_nuisance[index] += rows.rows @ d
                overlap += float(rows.residual @ d)
                size += float(d @ d)
            trial_changes.append(d)
        projections = self._inverse_factor @ by_nuisance
        overlap -= float(self._gradient @ projections)
        size -= float(projections @ projections)
        check_finite(np.array((overlap, size)))
        return np.concatenate((*trial_changes, projections)), overlap, size

    def shrunk(self, change: ScreenedChange) -> tuple[ScreenedChange, float]:
        """Return a change made so small that it is linear in its magnitude, and the factor.

        At its median, an effect that moves a frequency turns phases by many radians, which says
        nothing of what it does at a small magnitude.
        """
        is_reading = self.sign > 0.0
        squared_size = float((change.vector[is_reading] ** 2).sum())
        factor = sqrt(SEARCH.first_order / squared_size) if squared_size > 0.0 else 1.0
        if factor >= 1.0:
            return change, 1.0
        return self.change(change.term, change.term.rescaled(change.start, factor)), factor

    def changes(self, term: EffectTerm, *, fine: bool = True) -> Iterator[ScreenedChange]:
        """Yield the changes by a term over a grid of its parameters, where the model can follow.

        Parameters
        ----------
        term : EffectTerm
            The effect at its place.
        fine : bool
            Whether signed magnitudes are tried at a small size too. One size is enough for an
            effect that is linear in its magnitude.
        """
        has_change = False
        refusal = None
        for start in parameter_grid(term, self._spectral_peaks(term), fine=fine):
            try:
                change = self.change(term, start)
            except DiscrepancyError as cause:  # such as a spring softer than what is taken from it
                refusal = cause
            else:
                has_change = True
                yield change
        if refusal is not None and not has_change:
            self.problem.record_refusal(self.fit.candidate.with_term(term), refusal)

    # ---------------------------------------------------------------- lines in the spectrum

    def _spectral_peaks(self, term: EffectTerm) -> tuple[float, ...]:
        """Return the peak frequencies of the residuals in a term's channel.

        They are relative to the first frequency of the structure.

        Empty where the effect has no spectral parameter. Records of the same length and interval
        are summed to one spectrum.
        """
        if not term.effect.spectral:
            return ()
        spectra: dict[tuple[int, float], FloatArray] = {}
        for data, residual in zip(self.problem.trials, self.fit.residuals, strict=True):
            trial = data.trial
            if trial.kind not in term.effect.acts_on or term.place not in trial.channels:
                continue
            series = residual[:, trial.channels.index(term.place)]
            padded_length = SEARCH.padded * len(series)
            power = np.abs(np.fft.rfft(series - series.mean(), padded_length)) ** 2
            key = (len(series), trial.interval)
            spectra[key] = spectra.get(key, 0.0) + power
        first_frequency = self.problem.setting.scales.angular_frequency / (2.0 * np.pi)
        peaks: list[float] = []
        for (count, interval), power in spectra.items():
            resolution = 1.0 / (SEARCH.padded * count * interval)
            for index in _largest_peaks(power):
                peaks.append(index * resolution / first_frequency)
        return tuple(peaks)


def _largest_peaks(power: FloatArray) -> list[int]:
    """Return the indices of the largest peaks of a spectrum, none on the flank of another."""
    is_peak = (power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:])
    peaks = np.flatnonzero(is_peak) + 1
    largest = peaks[np.argsort(power[peaks])[::-1][: 4 * SEARCH.peaks]]
    chosen: list[int] = []
    for index in largest:
        is_apart = all(abs(index - other) > 2 * SEARCH.padded for other in chosen)
        if is_apart and len(chosen) < SEARCH.peaks:
            chosen.append(int(index))
    return chosen


# ---------------------------------------------------------------- grid of parameters


def parameter_grid(
    term: EffectTerm, peaks: Sequence[float] = (), *, fine: bool = True
) -> Iterator[FloatArray]:
    """Yield scaled parameters (E,) of a term to try, over the product of the values of each.

    The first magnitude is tried at one value or at levels of its own, since a change scales with
    it. A spectral parameter is tried at the given peaks.

    Parameters
    ----------
    term : EffectTerm
        The effect at its place.
    peaks : sequence of float
        The frequencies of peaks in the residuals, over the first frequency.
    fine : bool
        Whether a signed magnitude is tried at a small size too.
    """
    others = sum(not parameter.magnitude for parameter in term.parameters)
    levels = SEARCH.levels_of_many
    if others < len(SEARCH.levels):
        levels = SEARCH.levels[others]
    axes: list[tuple[float, ...]] = []
    has_magnitude = False
    for parameter in term.parameters:
        if parameter.magnitude:
            axes.append(_magnitude_levels(parameter, is_first=not has_magnitude, fine=fine))
            has_magnitude = True
        elif parameter.name == term.effect.spectral and peaks:
            scaled_peaks = [
                float(np.clip(parameter.prior.normal(peak), -3.0, 3.0)) for peak in peaks
            ]
            axes.append(tuple(scaled_peaks))
        elif parameter.levels:
            axes.append(_prior_quantiles(parameter))
        elif parameter in term.effect.shape:
            axes.append((parameter.prior.normal(parameter.canonical),))
        else:
            axes.append(levels)
    for values in product(*axes):
        yield np.array(values)


def _magnitude_levels(
    parameter: EffectParameter | ShapeParameter, *, is_first: bool, fine: bool
) -> tuple[float, ...]:
    """Return the scaled values at which a magnitude is tried.

    The first magnitude of a term scales its change, which needs fewer values.
    """
    is_signed = parameter.prior.value(0.0) == 0.0
    if parameter.levels and is_first:
        return _prior_quantiles(parameter)
    if not is_signed:
        return (0.0,)
    if not is_first:
        return (-1.0, 0.0, 1.0)
    return (1.0, SEARCH.linear) if fine else (1.0,)


def _prior_quantiles(parameter: EffectParameter | ShapeParameter) -> tuple[float, ...]:
    """Return as many scaled values as a parameter has levels, evenly over its prior probability."""
    count = parameter.levels
    return tuple(float(ndtri((k + 0.5) / count)) for k in range(count))
