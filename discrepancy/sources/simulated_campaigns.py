"""Campaigns simulated with inputs, channels, noise and nuisances of a real one, effects hidden in them."""

from dataclasses import dataclass, replace
from math import isinf

import numpy as np
from scipy.signal import lfilter

from discrepancy.campaign.noise import NoiseModel
from discrepancy.campaign.records import Campaign, FloatArray, Trial
from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate, Point, Term
from discrepancy.fits.fitting import fit
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Screen
from discrepancy.judgement.separability import DETECTED, as_predicted
from discrepancy.models.interface import Model

TRIES = 60
"""Draws of an effect's prior until one is detectable; without success the effect is not detectable here."""
REFINEMENT = 2
"""Finer time steps than on the naming side."""


@dataclass(frozen=True)
class Hidden:
    """An effect to hide: the term, its scaled parameters, its d^2."""

    term: Term
    normal: FloatArray
    distance: float


class Simulator:
    """Draws campaigns of the geometry of a real one.

    Parameters
    ----------
    campaign : Campaign
        The real one; its values count only where a nuisance has no prior (a free zero, a motion that began
        before the record): these stay as the fit without effect has them.
    model : Model
        The model as it is.
    """

    def __init__(self, campaign: Campaign, model: Model) -> None:
        self.campaign, self.model = campaign, model
        self.setting = Setting(campaign, model, model.scales(campaign))
        problem = Problem(campaign, model, self.setting)
        self.fitted = fit(problem, Candidate(), problem.start(Candidate()))
        self.problem = problem.with_trials(campaign.trials)
        zeros = tuple(np.zeros(data.unknowns.size) for data in self.problem.trials)
        start = replace(self.fitted.point, local=zeros)
        self.found = fit(self.problem, Candidate(), start, local_only=True).point

    def screen(self) -> Screen:
        """Return what measures d^2 of an effect under this campaign, on the predicted data."""
        problem = Problem(as_predicted(self.campaign, self.model, self.setting), self.model, self.setting)
        return Screen(problem, fit(problem, Candidate(), problem.start(Candidate()), iterations=1))

    def draw_effect(self, effect: Effect, screen: Screen, generator: np.random.Generator) -> Hidden | None:
        """Return a detectable draw of an effect's prior, or None if there was none."""
        places = effect.places(self.setting)
        for _ in range(TRIES):
            term = Term(effect, places[int(generator.integers(len(places)))])
            normal = generator.standard_normal(len(term.parameters))
            try:
                size = screen.change(term, normal).size
            except DiscrepancyError:  # more than the structure can carry
                continue
            if size >= DETECTED:
                return Hidden(term, normal, size)
        return None

    def simulate(self, hidden: Hidden | None, generator: np.random.Generator) -> Campaign:
        """Return a campaign with values in the place of the measured ones.

        Raises
        ------
        ModelError
            If the structure cannot carry the effect under the nuisances that were drawn.
        """
        problem = self.problem
        candidate = Candidate() if hidden is None else Candidate((hidden.term,))
        shared = _drawn(self.found.shared, problem.shared.precision, generator)
        patch = candidate.patch(self.setting, np.empty(0) if hidden is None else hidden.normal)
        nothing = Candidate().patch(self.setting, np.empty(0))
        channels = {name: self._deviation(name, generator) for name in self.campaign.channels}
        trials: list[Trial] = []
        for number, data in enumerate(problem.trials):
            # A motion that began before the record has a prior without information: it stays as fitted.
            free = data.trial.release is not None and not data.trial.release.at_rest
            local = _drawn(self.found.local[number], data.unknowns.precision, generator)
            if free:
                initials = slice(data.unknowns.zeros, data.unknowns.ends[2])
                local[initials] = self.found.local[number][initials]
            acts = data.trial.kind in candidate.acts_on
            response, _ = problem.response(number, shared, local, patch if acts else nothing, REFINEMENT)
            point = Point(shared, (*self.found.local[:number], local), np.empty(0))
            values = problem.prediction(number, point, response).copy()
            for column, name in enumerate(data.trial.channels):
                noise = _noise(data.noise[column], data.trial, generator)
                values[:, column] += channels[name] * data.trial.noise_factor * noise
            trials.append(replace(data.trial, values=values))
        return replace(self.campaign, name=f"{self.campaign.name} (simulated)", trials=tuple(trials))

    def _deviation(self, name: str, generator: np.random.Generator) -> float:
        """Return the true noise deviation over the recorded one: a draw of what the record leaves open."""
        freedom = self.problem.noise[name].degrees_of_freedom
        if isinf(freedom) or freedom <= 0.0:
            return 1.0
        return float(np.sqrt(freedom / generator.chisquare(freedom)))


def _drawn(found: FloatArray, precision: FloatArray, generator: np.random.Generator) -> FloatArray:
    """Return draws of N(0, 1) where there is a prior, the fitted values where there is none."""
    draws = generator.standard_normal(len(found))
    return np.where(precision > 0.0, draws, found)


def _noise(model: NoiseModel, trial: Trial, generator: np.random.Generator) -> FloatArray:
    """Return noise (N,) of one channel [channel's unit], coloured as its record is."""
    count = len(trial.time)
    if not trial.is_dynamic or not model.applies(trial.interval):
        return np.asarray(model.static_deviation * generator.standard_normal(count))
    lead = 20 * len(model.autoregression)  # until the start is forgotten
    white = model.standard_deviation * generator.standard_normal(lead + count)
    return np.asarray(lfilter([1.0], np.r_[1.0, -model.autoregression], white)[lead:])
