"""Simulated campaigns of the geometry of a real one, with a hidden effect or none."""

from dataclasses import dataclass, replace
from math import isinf

import numpy as np
from scipy.signal import lfilter

from discrepancy.campaign.noise import NoiseModel
from discrepancy.campaign.records import Campaign, FloatArray, Trial
from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate, EffectTerm, Point
from discrepancy.fits.fitting import fit
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Screen
from discrepancy.judgement.separability import DETECTED, as_predicted, has_free_initial_state
from discrepancy.system.interface import Model

TRIES = 60
"""Draws of an effect's prior until one is detectable.

Without success the effect is not detectable here.
"""
REFINEMENT = 2
"""Finer time steps than on the naming side."""


@dataclass(frozen=True)
class Hidden:
    """An effect to hide: the term, its scaled parameters, its d^2."""

    term: EffectTerm
    normal: FloatArray
    distance: float


class Simulator:
    """Draws campaigns of the geometry of a real one.

    Parameters
    ----------
    campaign : Campaign
        The real one; its values count only where a nuisance has no prior (a free zero, a motion
        that began before the record): these stay as the fit without effect has them.
    model : Model
        The model as it is.
    """

    def __init__(self, campaign: Campaign, model: Model) -> None:
        self.campaign = campaign
        self.model = model
        self.setting = Setting(campaign, model, model.scales(campaign))
        problem = Problem(campaign, model, self.setting)
        self.fitted = fit(problem, Candidate(), problem.start(Candidate()))
        # nuisances of all trials, held-out ones too, with the parameters of that fit
        self.problem = problem.with_trials(campaign.trials)
        zeros = tuple(np.zeros(data.unknowns.size) for data in self.problem.trials)
        start = replace(self.fitted.point, local=zeros)
        self.nuisances = fit(self.problem, Candidate(), start, local_only=True).point

    def screen(self) -> Screen:
        """Return the screen that measures the distance d^2 of an effect, on the predicted data."""
        predicted = as_predicted(self.campaign, self.model, self.setting)
        problem = Problem(predicted, self.model, self.setting)
        return Screen(problem, fit(problem, Candidate(), problem.start(Candidate()), iterations=1))

    def draw_effect(
        self, effect: Effect, screen: Screen, generator: np.random.Generator
    ) -> Hidden | None:
        """Return a draw of an effect's prior that is detectable; None if several draws were not.

        Parameters
        ----------
        effect : Effect
            The effect.
        screen : Screen
            Measures the distance of a draw.
        generator : Generator
            Source of places and sizes.
        """
        places = effect.places(self.setting)
        for _ in range(TRIES):
            term = EffectTerm(effect, places[int(generator.integers(len(places)))])
            normal = generator.standard_normal(len(term.parameters))
            try:
                distance = screen.change(term, normal).squared_size
            except DiscrepancyError:  # more than the structure can carry
                continue
            if distance >= DETECTED:
                return Hidden(term, normal, distance)
        return None

    def simulate(self, hidden: Hidden | None, generator: np.random.Generator) -> Campaign:
        """Return a campaign with simulated readings in place of the measured ones.

        Parameters
        ----------
        hidden : Hidden or None
            The effect that the structure has; None for none.
        generator : Generator
            Source of nuisances and noise.

        Raises
        ------
        ModelError
            If the structure cannot carry the effect under the nuisances that were drawn.
        """
        problem = self.problem
        candidate = Candidate() if hidden is None else Candidate((hidden.term,))
        shared = _drawn(self.nuisances.shared, problem.shared.precision, generator)
        no_patch = Candidate().patch(self.setting, np.empty(0))
        patch = no_patch if hidden is None else candidate.patch(self.setting, hidden.normal)
        noise_ratios = {name: self._noise_ratio(name, generator) for name in self.campaign.channels}
        trials: list[Trial] = []
        for number, data in enumerate(problem.trials):
            trial = data.trial
            fitted_local = self.nuisances.local[number]
            local = _drawn(fitted_local, data.unknowns.precision, generator)
            if has_free_initial_state(
                trial
            ):  # the prior has no information: the state stays as fitted
                initial_state = slice(*data.unknowns.ends[:2])
                local[initial_state] = fitted_local[initial_state]
            effect_acts = trial.kind in candidate.acts_on
            response, _ = problem.response(
                number, shared, local, patch if effect_acts else no_patch, REFINEMENT
            )
            earlier_trials = self.nuisances.local[:number]
            point = Point(shared, (*earlier_trials, local), np.empty(0))
            values = problem.prediction(number, point, response).copy()
            for column, name in enumerate(trial.channels):
                noise = _noise(data.noise[column], trial, generator)
                values[:, column] += noise_ratios[name] * trial.noise_factor * noise
            trials.append(replace(trial, values=values))
        name = f"{self.campaign.name} (simulated)"
        return replace(self.campaign, name=name, trials=tuple(trials))

    def _noise_ratio(self, name: str, generator: np.random.Generator) -> float:
        """Return a draw of a channel's true noise deviation over that of its record."""
        freedom = self.problem.noise[name].degrees_of_freedom
        if isinf(freedom) or freedom <= 0.0:
            return 1.0
        return float(np.sqrt(freedom / generator.chisquare(freedom)))


def _drawn(fitted: FloatArray, precision: FloatArray, generator: np.random.Generator) -> FloatArray:
    """Return draws (K,) of the priors of scaled unknowns.

    Fitted values of those without a prior.
    """
    draws = generator.standard_normal(len(fitted))
    return np.where(precision > 0.0, draws, fitted)


def _noise(model: NoiseModel, trial: Trial, generator: np.random.Generator) -> FloatArray:
    """Return noise (N,) of one channel in a trial [channel's unit], coloured as its record is."""
    count = len(trial.time)
    if not trial.is_dynamic or not model.applies(trial.interval):
        return np.asarray(model.static_deviation * generator.standard_normal(count))
    lead_in = 20 * len(model.autoregression)  # until the start is forgotten
    white = model.standard_deviation * generator.standard_normal(lead_in + count)
    coloured = lfilter([1.0], np.r_[1.0, -model.autoregression], white)
    return np.asarray(coloured[lead_in:])
