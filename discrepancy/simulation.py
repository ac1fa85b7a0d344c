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
from discrepancy.judgement.separability import (
    DETECTION_DISTANCE,
    campaign_as_predicted,
    has_free_initial_state,
)
from discrepancy.system.interface import Model

MOST_DRAWS = 60
"""Most draws of an effect's prior until one is detectable.

If none is, the effect counts as not detectable in this campaign.
"""
REFINEMENT = 2
"""Factor by which the time steps are finer than in the fits, which thus do not share the errors."""


@dataclass(frozen=True)
class HiddenEffect:
    """An effect to hide in a simulated campaign.

    Attributes
    ----------
    term : EffectTerm
        The effect and its place.
    normal : (K,) ndarray
        Standard normal variables of its parameters.
    distance : float
        Squared change d^2 of all readings by the effect that nuisances cannot explain, in units of
        the noise variance.
    """

    term: EffectTerm
    normal: FloatArray
    distance: float


class Simulator:
    """Simulates campaigns with the trials, channels and noise of a real one.

    Parameters
    ----------
    campaign : Campaign
        The real campaign. Its readings are used only for nuisances without a prior (a free zero, a
        motion that began before the record), which keep their values of a fit without effects.
    model : Model
        The model without a patch.
    """

    def __init__(self, campaign: Campaign, model: Model) -> None:
        self.campaign = campaign
        self.model = model
        self.setting = Setting(campaign, model, model.scales(campaign))
        problem = Problem(campaign, model, self.setting)
        self.fitted = fit(problem, Candidate(), problem.prior_mean_point(Candidate()))
        # local unknowns of all trials, held-out ones too, with the shared unknowns of that fit
        self.problem = problem.with_trials(campaign.trials)
        zeros = tuple(np.zeros(data.unknowns.unknown_count) for data in self.problem.trials)
        start = replace(self.fitted.point, local=zeros)
        self.nuisances = fit(self.problem, Candidate(), start, local_only=True).point

    def screen(self) -> Screen:
        """Return the screen that measures the distance d^2 of an effect.

        The screen is linearised about a fit to a campaign whose readings are the predictions of the
        model.
        """
        predicted = campaign_as_predicted(self.campaign, self.model, self.setting)
        problem = Problem(predicted, self.model, self.setting)
        return Screen(
            problem, fit(problem, Candidate(), problem.prior_mean_point(Candidate()), iterations=1)
        )

    def draw_effect(
        self, effect: Effect, screen: Screen, generator: np.random.Generator
    ) -> HiddenEffect | None:
        """Draw an effect's place and parameters from their priors until it is detectable.

        An effect is detectable if its distance d^2, which the screen measures, is at least
        `DETECTION_DISTANCE`. A draw that the structure cannot carry counts as not detectable. The
        result is None if none of `MOST_DRAWS` draws is detectable.
        """
        places = effect.places(self.setting)
        for _ in range(MOST_DRAWS):
            term = EffectTerm(effect, places[int(generator.integers(len(places)))])
            normal = generator.standard_normal(len(term.parameters))
            try:
                distance = screen.change_by_effect(term, normal).squared_length
            except DiscrepancyError:  # the structure cannot carry an effect of this size
                continue
            if distance >= DETECTION_DISTANCE:
                return HiddenEffect(term, normal, distance)
        return None

    def simulate(self, hidden: HiddenEffect | None, generator: np.random.Generator) -> Campaign:
        """Return a campaign with simulated readings in place of the measured ones.

        Parameters, gains, zeros and other nuisances are drawn from their priors; those without a
        prior, and free initial states, keep their fitted values. The noise is drawn with the
        autocorrelation of the noise records, and its deviation with the error of the records.

        Parameters
        ----------
        hidden : HiddenEffect or None
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
        shared = _draw_unknowns(self.nuisances.shared, problem.shared.precision, generator)
        no_patch = Candidate().patch(self.setting, np.empty(0))
        patch = no_patch if hidden is None else candidate.patch(self.setting, hidden.normal)
        noise_ratios = {name: self._noise_ratio(name, generator) for name in self.campaign.channels}
        trials: list[Trial] = []
        for trial_index, data in enumerate(problem.trials):
            trial = data.trial
            fitted_local = self.nuisances.local[trial_index]
            local = _draw_unknowns(fitted_local, data.unknowns.precision, generator)
            if has_free_initial_state(trial):  # its prior is too wide to be drawn from
                initial_state = data.unknowns.indices.initial_state
                local[initial_state] = fitted_local[initial_state]
            effect_acts = trial.kind in candidate.acts_on
            response, _ = problem.response(
                trial_index, shared, local, patch if effect_acts else no_patch, REFINEMENT
            )
            # the prediction of a trial reads only its own local unknowns; those of earlier trials
            # keep the place
            earlier_trials = self.nuisances.local[:trial_index]
            point = Point(shared, (*earlier_trials, local), np.empty(0))
            values = problem.prediction(trial_index, point, response).copy()
            for column, name in enumerate(trial.channels):
                noise = _draw_noise(data.noise_models[column], trial, generator)
                values[:, column] += noise_ratios[name] * trial.noise_factor * noise
            trials.append(replace(trial, values=values))
        name = f"{self.campaign.name} (simulated)"
        return replace(self.campaign, name=name, trials=tuple(trials))

    def _noise_ratio(self, name: str, generator: np.random.Generator) -> float:
        """Draw the ratio of a channel's true noise deviation to that of its noise record.

        A record with n degrees of freedom estimates the variance as chi-squared / n times the true
        one. The ratio is 1 if the deviation is exact, or if there is no noise record.
        """
        freedom = self.problem.noise_models[name].degrees_of_freedom
        if isinf(freedom) or freedom <= 0.0:
            return 1.0
        return float(np.sqrt(freedom / generator.chisquare(freedom)))


def _draw_unknowns(
    fitted: FloatArray, precision: FloatArray, generator: np.random.Generator
) -> FloatArray:
    """Draw scaled unknowns (K,) from their priors; those without a prior keep their fitted values.

    `fitted` (K,) are in prior standard deviations, and an unknown without a prior has zero
    `precision` (K,). As many numbers are drawn as there are unknowns, with or without a prior.
    """
    draws = generator.standard_normal(len(fitted))
    return np.where(precision > 0.0, draws, fitted)


def _draw_noise(model: NoiseModel, trial: Trial, generator: np.random.Generator) -> FloatArray:
    """Draw noise (N,) [channel's unit] of one channel in the N rows of a trial.

    The noise has the autocorrelation of the noise record if the trial is sampled at the same
    interval, else it is white.
    """
    count = len(trial.time)
    if not trial.is_dynamic or not model.can_whiten(trial.interval):
        return np.asarray(model.static_deviation * generator.standard_normal(count))
    # samples before the record, after which the filter has forgotten its zero initial state
    lead_in = 20 * len(model.autoregression)
    white = model.standard_deviation * generator.standard_normal(lead_in + count)
    coloured = lfilter([1.0], np.r_[1.0, -model.autoregression], white)
    return np.asarray(coloured[lead_in:])
