"""Screening: estimate how much an effect could reduce the misfit, before it is fitted.

The nuisances are all unknowns of a fit that are not of interest here: calibrated parameters, gains,
zeros and initial states. Let d be the standardised change that an effect makes to the prediction at
the fitted nuisances, J the derivatives of the prediction with respect to the nuisances (one row for
each), r the residuals, g the negative gradient and H the Hessian of the fit's objective. To first
order in the nuisances, the misfit after they are refitted is

    F(d) = F(0) - b(d) + G(d, d) / 2,
    G(c, d) = c.d - (J c)' H^-1 (J d),   b(d) = r.d - g' H^-1 (J d).

Changes due to several effects add, so pairs and scales of effects cost only inner products. G also
measures how well two effects can be told apart, before any data are known.
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

from .candidate import Candidate, EffectTerm, Point
from .fitting import CandidateFit
from .normal_equations import check_finite, cholesky_factor, normal_equations
from .problem import Problem


@dataclass(frozen=True)
class ScreenedChange:
    """The change of the prediction by an effect, minus what refitted nuisances can compensate.

    Attributes
    ----------
    term : EffectTerm
        The effect at its place.
    effect_values : (E,) array
        The scaled parameters of the effect.
    vector : (D,) array
        The change d of all readings, then its projections U^-T J d on the nuisances, with
        H = U^T U, such that G(c, d) = sum(signs * c.vector * d.vector) with
        `Screen.inner_product_signs`.
    overlap : float
        b(d): the overlap of the change with the residuals [nat].
    squared_length : float
        G(d, d): the squared distance from the model without the change, in noise variances.
    """

    term: EffectTerm
    effect_values: FloatArray
    vector: FloatArray
    overlap: float
    squared_length: float

    @property
    def best_scale(self) -> float:
        """The factor on the change that reduces the misfit most: b(d) / G(d, d)."""
        return self.overlap / self.squared_length if self.squared_length > 0.0 else 0.0

    @property
    def gain(self) -> float:
        """The decrease of the misfit at the best scale: b(d)^2 / (2 G(d, d)) [nat].

        It is 0 if the best scale is negative and the effect cannot be.
        """
        if self.overlap > 0.0 or self.term.may_be_negative:
            return 0.5 * self.overlap * self.best_scale
        return 0.0

    @property
    def best_values(self) -> FloatArray:
        """The scaled parameters (E,) with the magnitude at the best scale, to begin a fit with."""
        return self.term.multiply_magnitudes(
            self.effect_values, self.best_scale, SEARCH.least_start, SEARCH.largest_start
        )


class Screen:
    """Estimates of how much further effects would improve a fit, without fitting them.

    Parameters
    ----------
    problem : Problem
        The campaign and the model, with the layout of their unknowns.
    fit : CandidateFit
        The fit whose nuisances are eliminated; its own effects keep their values, unless
        `effect_precision` is given.
    record_noise : bool
        Whether residuals are weighted by the recorded noise, where there is a record, or by the
        noise level that the residuals of the fit give.
    effect_precision : (E,) array, optional
        The prior precisions of the fit's own effect parameters; if given, these parameters are
        eliminated together with the nuisances.
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
        if record_noise:
            precision = problem.recorded_or_estimated_precisions(fit.squares_by_channel)
        else:
            precision = problem.noise_precisions(fit.squares_by_channel)
        eliminated_effects = Candidate() if effect_precision is None else fit.candidate
        equations = normal_equations(problem, fit, eliminated_effects, precision, effect_precision)
        self._trials = equations.trials
        self._eliminated_count = eliminated_effects.parameter_count
        self._nuisance_count = len(equations.gradient)
        factor = cholesky_factor(equations.matrix)
        # U^-T with H = U^T U: then (J c)^T H^-1 (J d) is the inner product of U^-T J c and U^-T J d
        self._inverse_factor = solve_triangular(
            factor, np.eye(self._nuisance_count), trans="T", check_finite=False
        )
        self._whitened_gradient = self._inverse_factor @ equations.gradient  # U^-T g

    @property
    def inner_product_signs(self) -> FloatArray:
        """The signs (D,) of the inner product G of two vectors.

        They are 1 for the changes of readings and -1 for the projections on the nuisances, since G
        is the inner product of the changes minus that of the projections.
        """
        reading_count = sum(residual.size for residual in self.fit.residuals)
        return np.repeat((1.0, -1.0), (reading_count, self._nuisance_count))

    # ---------------------------------------------------------------- changes of the prediction

    def change_by_effect(self, term: EffectTerm, effect_values: FloatArray) -> ScreenedChange:
        """Return the change of the prediction if one more effect acts.

        Parameters
        ----------
        term : EffectTerm
            The effect at its place, added to those of the fit.
        effect_values : (E,) array
            The scaled parameters of the effect.
        """
        candidate = self.fit.candidate.with_term(term)
        effect = np.concatenate((self.fit.point.effect, effect_values))
        vector, overlap, squared_length = self._project_change(
            candidate, effect, term.effect.acts_on
        )
        return ScreenedChange(term, effect_values, vector, overlap, max(squared_length, 0.0))

    def refit_with_effect(self, term: EffectTerm, effect_values: FloatArray) -> tuple[float, Point]:
        """Refit the eliminated unknowns to first order beside an effect, see `change_by_effect`.

        Returns
        -------
        objective : float
            The negative log posterior [nat], up to the same constant as that of a fit.
        point : Point
            The refitted unknowns, with the parameters of the effect at the end.
        """
        problem, point = self.problem, self.fit.point
        change = self.change_by_effect(term, effect_values).vector
        # H x = g - J d, with the projections U^-T J d at the end of the vector
        projections = change[len(change) - self._nuisance_count :]
        step = self._inverse_factor.T @ (self._whitened_gradient - projections)
        shared = point.shared + step[: len(point.shared)]
        own_effect_values = point.effect.copy()
        own_effect_values[: self._eliminated_count] += step[len(shared) :][: self._eliminated_count]
        all_effect_values = np.concatenate((own_effect_values, effect_values))
        local, residuals = [], []
        squared_sum = float(
            problem.shared.precision @ shared**2 + all_effect_values @ all_effect_values
        )
        first_reading = 0
        for rows, indices in self._trials:
            local.append(rows.local_values + step[indices[: len(rows.local_values)]])
            squared_sum += float(rows.local_precision @ local[-1] ** 2)
            trial_change = change[first_reading : first_reading + rows.residual.size]
            first_reading += rows.residual.size
            residual = rows.residual - trial_change - step[indices] @ rows.jacobian
            residuals.append(residual.reshape(-1, len(rows.precision_root)) / rows.precision_root)
        misfit = problem.misfit(problem.squares_by_channel(residuals))
        return misfit + 0.5 * squared_sum, Point(shared, tuple(local), all_effect_values)

    def misfit_rise(self, effect_values: FloatArray) -> float:
        """Return the rise of the misfit at other parameters (E,) of the fit's own effects [nat]."""
        candidate = self.fit.candidate
        _, overlap, squared_length = self._project_change(
            candidate, effect_values, candidate.acts_on
        )
        return 0.5 * squared_length - overlap

    @np.errstate(over="ignore", invalid="ignore")
    def _project_change(
        self, candidate: Candidate, effect_values: FloatArray, kinds: frozenset[TrialKind]
    ) -> tuple[FloatArray, float, float]:
        """Return what `project` returns for the change from the fit to another candidate.

        `effect_values` (E,) are the scaled parameters of the candidate. Only trials of the given
        kinds change.
        """
        problem = self.problem
        point = self.fit.point
        patch = candidate.patch(problem.setting, effect_values)
        standardised_changes: dict[int, FloatArray] = {}
        for trial_index, data in enumerate(problem.trials):
            if data.trial.kind not in kinds:
                continue
            response, _ = problem.response(
                trial_index, point.shared, point.local[trial_index], patch
            )
            gains = 1.0 + problem.shared.gains(point.shared, data.trial.channels)
            standardised_changes[trial_index] = data.standardise(
                gains * (response - self.fit.responses[trial_index])
            )
        return self.project(standardised_changes)

    def project(self, changes: Mapping[int, FloatArray]) -> tuple[FloatArray, float, float]:
        """Project out of a change of the predictions what refitted nuisances can compensate.

        Let d be the change in all trials, r the residuals, J the derivatives of the predictions
        with respect to the nuisances (one row for each), g the negative gradient of the objective
        and H = U^T U its Hessian. With q = U^-T J d,

            b = r.d - (U^-T g).q,   G = |d|^2 - |q|^2.

        Parameters
        ----------
        changes : mapping of int to (N, C) array
            The standardised changes of the predictions of N samples in C channels, by the index of
            the trial. Trials that are left out do not change.

        Returns
        -------
        vector : (D,) array
            The change d, then its projection q on the nuisances.
        overlap, squared_length : float
            b and G.
        """
        nuisance_overlaps = np.zeros(self._nuisance_count)  # J d
        trial_changes = []
        overlap = 0.0
        squared_length = 0.0
        for trial_index, (trial_rows, nuisance_indices) in enumerate(self._trials):
            trial_change: FloatArray = np.zeros(trial_rows.residual.shape)
            if trial_index in changes:
                trial_change = (changes[trial_index] * trial_rows.precision_root).ravel()
                nuisance_overlaps[nuisance_indices] += trial_rows.jacobian @ trial_change
                overlap += float(trial_rows.residual @ trial_change)
                squared_length += float(trial_change @ trial_change)
            trial_changes.append(trial_change)
        projections = self._inverse_factor @ nuisance_overlaps  # q
        overlap -= float(self._whitened_gradient @ projections)
        squared_length -= float(projections @ projections)
        check_finite(np.array((overlap, squared_length)))
        return np.concatenate((*trial_changes, projections)), overlap, squared_length

    def shrink_change(self, change: ScreenedChange) -> tuple[ScreenedChange, float]:
        """Return the change at a magnitude so small that the readings respond linearly to it.

        An effect that moves a frequency may shift phases by many radians at the median of its
        prior. Such a change of the readings points in another direction than that of a small
        effect, so its scale and overlap would be wrong for a small one.

        Returns
        -------
        change : ScreenedChange
            The change at the smaller magnitude, at which the squared change of all readings is
            about `SEARCH.first_order_change`; the given one if it is no larger than that.
        factor : float
            The factor, at most 1, by which the magnitude was multiplied.
        """
        # the first entries of the vector, with a positive sign, are the readings; the projections
        # on the nuisances follow with a negative sign, and do not count here
        is_reading = self.inner_product_signs > 0.0
        squared_change = float((change.vector[is_reading] ** 2).sum())
        factor = sqrt(SEARCH.first_order_change / squared_change) if squared_change > 0.0 else 1.0
        if factor >= 1.0:
            return change, 1.0
        small_values = change.term.multiply_magnitudes(change.effect_values, factor)
        return self.change_by_effect(change.term, small_values), factor

    def changes_on_grid(
        self, term: EffectTerm, *, with_small_magnitude: bool = True
    ) -> Iterator[ScreenedChange]:
        """Yield the changes of the readings that an effect causes, over a grid of its parameters.

        Points of the grid at which the model cannot be evaluated are left out.

        Parameters
        ----------
        with_small_magnitude : bool
            Whether a magnitude that may be negative is tried at a small value too. One value is
            enough for an effect that is linear in its magnitude.
        """
        has_change = False
        refusal = None
        for values in parameter_grid(
            term, self._spectral_peaks(term), with_small_magnitude=with_small_magnitude
        ):
            try:
                change = self.change_by_effect(term, values)
            except DiscrepancyError as cause:  # such as more stiffness removed than there is
                refusal = cause
            else:
                has_change = True
                yield change
        if refusal is not None and not has_change:
            self.problem.record_refusal(self.fit.candidate.with_term(term), refusal)

    # ---------------------------------------------------------------- lines in the spectrum

    def _spectral_peaks(self, term: EffectTerm) -> tuple[float, ...]:
        """Return the peak frequencies of the residuals in the channel of an effect.

        They are relative to the first natural frequency of the structure. There are none if the
        effect has no parameter that is a frequency. Before peaks are looked for, the spectra of
        records with the same length and sampling interval are added.
        """
        if not term.effect.spectral:
            return ()
        spectra: dict[tuple[int, float], FloatArray] = {}
        for data, residual in zip(self.problem.trials, self.fit.residuals, strict=True):
            trial = data.trial
            if trial.kind not in term.effect.acts_on or term.place not in trial.channels:
                continue
            series = residual[:, trial.channels.index(term.place)]
            padded_length = SEARCH.zero_padding * len(series)
            power = np.abs(np.fft.rfft(series - series.mean(), padded_length)) ** 2
            key = (len(series), trial.interval)
            spectra[key] = spectra.get(key, 0.0) + power
        first_frequency = self.problem.setting.scales.angular_frequency / (2.0 * np.pi)
        peaks: list[float] = []
        for (count, interval), power in spectra.items():
            resolution = 1.0 / (SEARCH.zero_padding * count * interval)
            for index in _largest_peaks(power):
                peaks.append(index * resolution / first_frequency)
        return tuple(peaks)


def _largest_peaks(power: FloatArray) -> list[int]:
    """Return the indices of the largest separate peaks of a power spectrum, the largest first.

    With zero padding one spectral line has several local maxima, so peaks must be more than two
    lines of the unpadded spectrum apart. At most `SEARCH.most_peaks` are returned.
    """
    is_peak = (power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:])
    peaks = np.flatnonzero(is_peak) + 1
    peaks_by_power = peaks[np.argsort(power[peaks])[::-1][: 4 * SEARCH.most_peaks]]
    separate_peaks: list[int] = []
    for index in peaks_by_power:
        is_apart = all(
            abs(index - other_index) > 2 * SEARCH.zero_padding for other_index in separate_peaks
        )
        if is_apart and len(separate_peaks) < SEARCH.most_peaks:
            separate_peaks.append(int(index))
    return separate_peaks


# ---------------------------------------------------------------- grid of parameters


def parameter_grid(
    term: EffectTerm, peaks: Sequence[float] = (), *, with_small_magnitude: bool = True
) -> Iterator[FloatArray]:
    """Yield the points of a grid of an effect's scaled parameters (E,), for a screen.

    The values of magnitudes are those of `_magnitude_levels`. A parameter that is a frequency is
    tried at the given peaks, one with a number of levels in the catalogue at as many quantiles of
    its prior, a free shape at its canonical value, and any other at `SEARCH.grid_levels`.

    Parameters
    ----------
    peaks : sequence of float
        The frequencies of peaks in the residuals, over the first natural frequency.
    with_small_magnitude : bool
        Whether a magnitude that may be negative is tried at a small value too.
    """
    other_parameter_count = sum(not parameter.magnitude for parameter in term.parameters)
    levels = SEARCH.grid_levels_if_many
    if other_parameter_count < len(SEARCH.grid_levels):
        levels = SEARCH.grid_levels[other_parameter_count]
    # one axis for each parameter: the scaled values at which it is tried
    axes: list[tuple[float, ...]] = []
    has_magnitude = False
    for parameter in term.parameters:
        if parameter.magnitude:
            axes.append(
                _magnitude_levels(
                    parameter, is_first=not has_magnitude, with_small_magnitude=with_small_magnitude
                )
            )
            has_magnitude = True
        elif parameter.name == term.effect.spectral and peaks:
            scaled_peaks = [
                float(np.clip(parameter.prior.standard_normal(peak), -3.0, 3.0)) for peak in peaks
            ]
            axes.append(tuple(scaled_peaks))
        elif parameter.levels:
            axes.append(_prior_quantiles(parameter))
        elif parameter in term.effect.shape:
            axes.append((parameter.prior.standard_normal(parameter.canonical),))
        else:
            axes.append(levels)
    for values in product(*axes):
        yield np.array(values)


def _magnitude_levels(
    parameter: EffectParameter | ShapeParameter, *, is_first: bool, with_small_magnitude: bool
) -> tuple[float, ...]:
    """Return the scaled values at which a magnitude of an effect is tried in the grid.

    Scaled values have a standard normal prior: 0 is the prior median, and 1 and -1 are one prior
    deviation above and below it. The first case that holds decides:

    1. The first magnitude, whose entry in the catalogue gives a number of `levels`: that many
       quantiles of its prior.
    2. A magnitude of one sign, such as a mass: its prior median.
    3. A further magnitude of either sign: its median, zero, and one deviation to both sides.
    4. The first magnitude of either sign: one deviation, and if `with_small_magnitude` also
       `SEARCH.small_magnitude`. That is enough, because the screen computes the best factor on the
       first magnitude, of either sign, from the change at any value but zero.
    """
    has_own_levels = parameter.levels > 0
    if has_own_levels and is_first:
        return _prior_quantiles(parameter)
    prior_median = parameter.prior.value(0.0)
    has_either_sign = prior_median == 0.0
    if not has_either_sign:
        return (0.0,)
    if not is_first:
        return (-1.0, 0.0, 1.0)
    if with_small_magnitude:
        return (1.0, SEARCH.small_magnitude)
    return (1.0,)


def _prior_quantiles(parameter: EffectParameter | ShapeParameter) -> tuple[float, ...]:
    """Return the medians of `parameter.levels` intervals of equal prior probability, scaled."""
    count = parameter.levels
    return tuple(float(ndtri((k + 0.5) / count)) for k in range(count))
