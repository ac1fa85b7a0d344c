"""Screening: what an effect could explain, before any fit, to first order in the nuisances.

With d the standardised change that an effect makes to the prediction at the fitted nuisances, J their
derivatives and H the Hessian of the fit, the misfit after the nuisances have adapted is

    F(d) = F(0) - b(d) + G(d, d) / 2,   G(c, d) = c.d - (J c)' H^-1 (J d),   b(d) = r.d - g' H^-1 (J d).

Changes of several effects add, so pairs and scales cost inner products only. G is also what separates two
effects before data are looked at.
"""

from collections.abc import Iterator, Mapping
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

from .candidate import Candidate, Term
from .fitting import LARGEST_EFFECT, CandidateFit, finite, normal_equations, upper_factor
from .problem import Problem


@dataclass(frozen=True)
class Change:
    """What an effect at given values does to the prediction, adapted nuisances taken off.

    Attributes
    ----------
    term : Term
        The effect at a place.
    start : (E,) ndarray
        Scaled parameters.
    vector : (D,) ndarray
        Change and its projections, such that G(c, d) = c.sign.d.
    fits : float
        b(d): its overlap with the residual [nat].
    size : float
        G(d, d): squared distance from the model without it [sigma^2].
    """

    term: Term
    start: FloatArray
    vector: FloatArray
    fits: float
    size: float

    @property
    def scale(self) -> float:
        """Factor on the change that explains most."""
        return self.fits / self.size if self.size > 0.0 else 0.0

    @property
    def gain(self) -> float:
        """Decrease of the misfit at the best scale [nat]; none where a positive size would turn negative."""
        return 0.5 * self.fits * self.scale if self.fits > 0.0 or self.term.may_turn else 0.0

    @property
    def best(self) -> FloatArray:
        """The scaled parameters (E,) at which the magnitude is that of the best scale."""
        return self.term.sized(self.start, self.scale, -0.7 * LARGEST_EFFECT, SEARCH.largest_start)


class Screen:
    """Inner products of changes at a fit.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    fit : CandidateFit
        Where the nuisances stand; its own effects stay as they are.
    record_noise : bool
        Whether residuals count by the noise record (else by what the fit left).
    effect_precision : (E,) ndarray, optional
        Of the prior of the fit's own effect parameters, which follow a change with the nuisances then.
    """

    def __init__(
        self,
        problem: Problem,
        fit: CandidateFit,
        *,
        record_noise: bool = True,
        effect_precision: FloatArray | None = None,
    ) -> None:
        self.problem, self.fit = problem, fit
        known = problem.freedom > 0.0
        left = problem.precisions(fit.sums)
        precision = np.where(known, 1.0, left) if record_noise else left
        following = Candidate() if effect_precision is None else fit.candidate
        found = normal_equations(problem, fit, following, precision, effect_precision)
        self._trials, self._size = found.trials, len(found.gradient)
        factor = upper_factor(found.matrix)
        self._inverse = solve_triangular(factor, np.eye(self._size), trans="T", check_finite=False)
        self._gradient = self._inverse @ found.gradient

    def change(self, term: Term, start: FloatArray) -> Change:
        """Return what a term does at scaled parameters, besides the effects of the fit."""
        candidate = self.fit.candidate.plus(term)
        effect = np.concatenate((self.fit.point.effect, start))
        vector, fits, size = self._moved(candidate, effect, term.effect.acts_on)
        return Change(term, start, vector, fits, max(size, 0.0))

    def rise(self, effect: FloatArray) -> float:
        """Return by how much the misfit rises [nat] when the fit's own effect parameters (E,) are these."""
        candidate = self.fit.candidate
        _, fits, size = self._moved(candidate, effect, candidate.acts_on)
        return 0.5 * size - fits

    @np.errstate(over="ignore", invalid="ignore")
    def _moved(
        self, candidate: Candidate, effect: FloatArray, acting: frozenset[TrialKind]
    ) -> tuple[FloatArray, float, float]:
        """Return vector, b and G of the change to a candidate, in kinds of trials that it touches."""
        problem, fit = self.problem, self.fit
        patch = candidate.patch(problem.setting, effect)
        changes: dict[int, FloatArray] = {}
        for number, data in enumerate(problem.trials):
            if data.trial.kind in acting:
                response, _ = problem.response(number, fit.point.shared, fit.point.local[number], patch)
                gains = 1.0 + problem.shared.gains(fit.point.shared, data.trial.channels)
                changes[number] = data.standardised(gains * (response - fit.responses[number]))
        return self.projected(changes)

    def projected(self, changes: Mapping[int, FloatArray]) -> tuple[FloatArray, float, float]:
        """Return vector, b and G of standardised changes (N, C) of predictions, by number of the trial."""
        total = np.zeros(self._size)
        parts, fits, square = [], 0.0, 0.0
        for number, (item, place) in enumerate(self._trials):
            d: FloatArray = np.zeros(item.residual.shape)
            if number in changes:
                d = (changes[number] * item.root).ravel()
                total[place] += item.rows @ d
                fits += float(item.residual @ d)
                square += float(d @ d)
            parts.append(d)
        y = self._inverse @ total
        fits -= float(self._gradient @ y)
        square -= float(y @ y)
        finite(np.array((fits, square)))
        return np.concatenate((*parts, y)), fits, square

    def shrunk(self, change: Change) -> tuple[Change, float]:
        """Return a change made so small that it is of first order, and by which factor.

        Effects that move a frequency turn phases by many radians at their medians, which says nothing of what
        they do in small.
        """
        whole = float((change.vector[self.sign > 0.0] ** 2).sum())  # before the nuisances take their share
        factor = sqrt(SEARCH.first_order / whole) if whole > 0.0 else 1.0
        if factor >= 1.0:
            return change, 1.0
        return self.change(change.term, change.term.sized(change.start, factor)), factor

    def _peaks(self, term: Term) -> tuple[float, ...]:
        """Return peaks of the residuals' mean spectrum at a term's channel, over the first frequency."""
        if not term.effect.spectral:
            return ()
        problem = self.problem
        spectra: dict[tuple[int, float], FloatArray] = {}
        for data, residual in zip(problem.trials, self.fit.residuals, strict=True):
            if data.trial.kind not in term.effect.acts_on or term.place not in data.trial.channels:
                continue
            series = residual[:, data.trial.channels.index(term.place)]
            key = (len(series), data.trial.interval)
            power = np.abs(np.fft.rfft(series - series.mean(), SEARCH.padded * len(series))) ** 2
            spectra[key] = spectra.get(key, 0.0) + power
        found: list[float] = []
        for (count, interval), power in spectra.items():
            resolution = 1.0 / (SEARCH.padded * count * interval)
            inner = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:])) + 1
            best = inner[np.argsort(power[inner])[::-1][: 4 * SEARCH.peaks]]
            kept: list[int] = []
            for index in best:
                if all(abs(index - other) > 2 * SEARCH.padded for other in kept) and len(kept) < SEARCH.peaks:
                    kept.append(int(index))
            first = problem.setting.scales.angular_frequency / (2.0 * np.pi)
            found += [index * resolution / first for index in kept]
        return tuple(found)

    @property
    def sign(self) -> FloatArray:
        """Signs (D,) of the inner product: changes count, their projections are taken off."""
        samples = sum(residual.size for residual in self.fit.residuals)
        return np.repeat((1.0, -1.0), (samples, self._size))

    def changes(self, term: Term, *, fine: bool = True) -> Iterator[Change]:
        """Yield the changes of a term over the grid of its parameters, where the model can follow.

        Without `fine`, signed magnitudes are tried at one size only, enough for what is linear in them,
        unless they ask for levels of their own.
        """
        followed, refusal = False, None
        for start in grid(term, self._peaks(term), fine=fine):
            try:
                change = self.change(term, start)
            except DiscrepancyError as cause:  # such as a spring softer than what is taken from it
                refusal = cause
            else:
                followed = True
                yield change
        if refusal is not None and not followed:
            self.problem.refused(self.fit.candidate.plus(term), refusal)


def grid(term: Term, peaks: tuple[float, ...] = (), *, fine: bool = True) -> Iterator[FloatArray]:
    """Yield scaled parameters to try: magnitudes at one value or at levels of theirs, since changes scale.

    A spectral parameter is tried at the given peaks.
    """
    axes: list[tuple[float, ...]] = []
    scaled = False
    count = sum(not item.magnitude for item in term.parameters)
    levels = SEARCH.levels[count] if count < len(SEARCH.levels) else SEARCH.levels_of_many
    for item in term.parameters:
        if item.magnitude:
            signed = item.prior.value(0.0) == 0.0
            if item.levels and not scaled:
                axes.append(_spread_levels(item))
                scaled = True
            elif scaled:
                axes.append((-1.0, 0.0, 1.0) if signed else (0.0,))
            else:
                axes.append((1.0, *((SEARCH.linear,) if fine else ())) if signed else (0.0,))
                scaled = True
        elif item.name == term.effect.spectral and peaks:
            axes.append(tuple(float(np.clip(item.prior.normal(peak), -3.0, 3.0)) for peak in peaks))
        elif item.levels:
            axes.append(_spread_levels(item))
        elif item in term.effect.shape:
            axes.append((item.prior.normal(item.canonical),))
        else:
            axes.append(levels)
    for values in product(*axes):
        yield np.array(values)


def _spread_levels(item: EffectParameter | ShapeParameter) -> tuple[float, ...]:
    """Return the scaled values of a parameter that asks for so many, evenly over its prior."""
    return tuple(float(ndtri((k + 0.5) / item.levels)) for k in range(item.levels))
