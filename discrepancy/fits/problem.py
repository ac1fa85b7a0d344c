"""Campaign and model brought together: standardised residuals of every trial and their derivatives.

A residual is (measured - (1 + gain) model - zero) / s0, whitened in time where the noise record is
coloured. The variance of each channel's noise is marginalised under the inverse gamma distribution
that its record leaves: -ln L = sum over channels of (n0 + n) / 2 ln(1 + RSS / n0) + constant, with
n0 the degrees of freedom of the noise record, n the number of samples, and RSS the sum of squared
residuals in units of s0^2. Here s0 is the recorded standard deviation of the noise.

The *response* is what the model gives for the channels; the *prediction* of the readings is the
response with the gains and zeros of the channels.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from math import inf

import numpy as np

from discrepancy.campaign.noise import NoiseModel, noise_model, whiteness_is_tested
from discrepancy.campaign.records import Campaign, Channel, FloatArray, IntArray, Trial
from discrepancy.catalogue.entry import Setting
from discrepancy.errors import CampaignDataError
from discrepancy.system.interface import Model
from discrepancy.system.sensing import observe
from fe.runtime.patch import ModelPatch
from reporting.system.memory import ResultCache

from .candidate import (
    LEAST_EFFECT_STEP,
    PARAMETER_STEP,
    Candidate,
    Point,
    TrialDerivatives,
    with_step,
)
from .derivatives import NuisanceDerivatives, nuisance_derivatives, prediction_derivatives
from .difference_quotients import largest_jumps, two_sided_quotient
from .trial_data import TrialData, shared_unknowns, stand_in_deviation

MOST_CACHED_RESPONSES = 2000
"""Number of responses that a problem keeps in memory."""
LARGEST_CACHE = 24e6
"""Largest memory of these responses; of long records fewer are kept [B]."""
FEWEST_CACHED_RESPONSES = 40
"""Number of responses that are kept in any case: those of the derivatives of one fit."""
LEAST_VARIANCE = 1e-12
"""Least variance of an unrecorded noise over that of its stand-in: rounding to a billionth of the
range."""


def channel_misfits(
    record_freedom: FloatArray, sample_counts: FloatArray, squares: FloatArray
) -> FloatArray:
    """Return -ln L of each channel with the noise variance marginalised, up to a constant [nat].

    Without a noise record, the logarithm of the noise deviation has a flat prior.

    Parameters
    ----------
    record_freedom : (...) array
        The degrees of freedom n0 of the noise record: 0 without a record, infinite where the noise
        is known.
    sample_counts : (...) array
        The number n of samples.
    squares : (...) array
        The sums of squared standardised residuals.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        recorded_misfits = (
            0.5 * (record_freedom + sample_counts) * np.log1p(squares / record_freedom)
        )
        unrecorded_misfits = (
            0.5 * sample_counts * np.log(np.maximum(squares, LEAST_VARIANCE * sample_counts))
        )
    return np.where(
        np.isinf(record_freedom),
        0.5 * squares,
        np.where(record_freedom > 0.0, recorded_misfits, unrecorded_misfits),
    )


class Problem:
    """A campaign and a model, with everything that does not depend on the hypothesis.

    Parameters
    ----------
    campaign : Campaign
        The trials and noise records.
    model : Model
        The unchanged model.
    setting : Setting
        The scales by which the catalogue states its priors.

    Attributes
    ----------
    trials : tuple of TrialData
        The trials that are compared, with their noise and unknowns.
    shared : SharedUnknowns
        The layout of the unknowns that all hypotheses and trials share.
    noise_models : dict of str to NoiseModel
        The noise model of each channel.
    record_freedom, sample_counts : (channels,) array
        The degrees of freedom of each noise record, and the number of samples of each channel.
    refinement : int
        The factor by which time steps are smaller than the model's own.
    refusals : dict of str to str
        The reason why an effect could not be fitted, by its identifier.
    initial_states : dict of str to (L,) array
        The scaled unknowns of a trial as fitted to its first readings, by the name of the trial;
        filled by `beginnings.with_initial_states_of_first_readings`.

    Raises
    ------
    CampaignDataError
        If all trials are held out.
    """

    def __init__(self, campaign: Campaign, model: Model, setting: Setting) -> None:
        if not campaign.fitted:
            raise CampaignDataError(
                f"The campaign {campaign.name!r} has no trial to fit: all are held out; hold out "
                "fewer."
            )
        self.campaign = campaign
        self.setting = setting
        self.model = model.with_response_cache()
        self._acts_in_motion_alone = np.array(
            [parameter.name in model.nuisance_parameters for parameter in model.parameters],
            dtype=bool,
        )
        self.channel_names = tuple(campaign.channels)
        self.refinement = 1
        self.noise_models: dict[str, NoiseModel] = {}
        for name, channel in campaign.channels.items():
            self.noise_models[name] = noise_model(channel, stand_in_deviation(campaign, name))
        self.record_freedom = np.array(
            [noise.degrees_of_freedom for noise in self.noise_models.values()]
        )
        channels = campaign.channels.values()
        self.is_whiteness_tested = [whiteness_is_tested(channel) for channel in channels]
        self.refusals: dict[str, str] = {}
        self.initial_states: dict[str, FloatArray] = {}
        self._prepare_trials(campaign.fitted)
        # first estimates of unknown gains need a response, and a response needs the layout of the
        # unknowns: so the layout is made twice, the first time without these estimates
        self.shared = shared_unknowns(campaign, model, campaign.fitted, {})
        self.shared = shared_unknowns(campaign, model, campaign.fitted, self._gain_estimates())

    def _prepare_trials(self, trials: Sequence[Trial]) -> None:
        """Set the trials that are compared, count their samples, and empty the cache."""
        self.trials = tuple(
            TrialData.prepare(self.campaign, trial, self.noise_models, self.model)
            for trial in trials
        )
        self.sample_counts = self._sample_counts()
        # a response has values and rates
        largest_response = max(2 * data.trial.values.nbytes for data in self.trials)
        count = int(LARGEST_CACHE / largest_response)
        count = min(max(count, FEWEST_CACHED_RESPONSES), MOST_CACHED_RESPONSES)
        self._responses = ResultCache(count)

    def _sample_counts(self) -> FloatArray:
        """Return the number of samples (channels,) of each channel in the trials."""
        counts = np.zeros(len(self.channel_names))
        for data in self.trials:
            np.add.at(counts, data.channel_indices, data.weight.sum(axis=0))
        return counts

    def record_refusal(self, candidate: Candidate, cause: Exception) -> None:
        """Record why a single effect could not be evaluated or fitted.

        Nothing is recorded for a set of several effects, as any of them may be the cause.
        """
        if len(candidate.terms) == 1:
            self.refusals[candidate.terms[0].effect.identifier] = str(cause)

    def _gain_estimates(self) -> dict[str, float]:
        """Return first estimates of unknown gains, by channel.

        A gain is the ratio of the largest amplitudes of readings (about their median) and response,
        in the first trial in which the channel moves in the model. It is negative if readings and
        response have opposite signs, except after a release.
        """
        estimates: dict[str, float] = {}
        point = self.prior_mean_point(Candidate())
        for number, data in enumerate(self.trials):
            release = data.trial.release
            for column, name in enumerate(data.trial.channels):
                has_unknown_scale = self.campaign.channels[name].gain_deviation == inf
                if not has_unknown_scale or name in estimates:
                    continue
                readings = data.trial.values[:, column]
                deviation_from_median = readings - np.median(readings)
                local_values = point.local[number]
                # a free initial state is zero at its prior mean, where nothing would move
                if release is not None and not release.at_rest:
                    first_amplitude = data.unknowns.zero_count
                    local_values[first_amplitude] = 1.0 / data.unknowns.scale[first_amplitude]
                response, _ = self.response(number, point.shared, local_values, ModelPatch())
                response_amplitude = float(np.abs(response[:, column]).max())
                if response_amplitude > 0.0:
                    has_same_sign = (
                        release is not None or deviation_from_median @ response[:, column] > 0.0
                    )
                    sign = 1.0 if has_same_sign else -1.0
                    estimates[name] = (
                        float(np.abs(deviation_from_median).max()) / response_amplitude * sign
                    )
        return estimates

    # -------------------------------------------------------------------------- values

    def prior_mean_point(self, candidate: Candidate) -> Point:
        """Return the point of the prior means, from which the fit of a candidate may begin."""
        return Point(
            shared=np.zeros(self.shared.unknown_count),
            local=tuple(np.zeros(data.unknowns.unknown_count) for data in self.trials),
            effect=candidate.start_values(),
        )

    def patch_in_trial(
        self, trial_index: int, candidate: Candidate, effect: FloatArray
    ) -> ModelPatch:
        """Return the change of the model by the effects of a candidate in a trial.

        It is empty if the effects do not act on trials of this kind.

        Parameters
        ----------
        effect : (E,) array
            The E parameters of the effects, on the scale on which their priors are standard normal.
        """
        if self.trials[trial_index].trial.kind not in candidate.acts_on:
            return ModelPatch()
        return candidate.patch(self.setting, effect)

    def response(
        self,
        trial_index: int,
        shared_values: FloatArray,
        local_values: FloatArray,
        patch: ModelPatch,
        refinement: int = 1,
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return the response of a patched model in a trial, as ideal sensors would read it.

        Gain errors and zero offsets of the channels are not applied. The last responses are kept in
        memory, at most `MOST_CACHED_RESPONSES`.

        Parameters
        ----------
        shared_values : (Q,) array
            The scaled values of the Q unknowns that all trials share.
        local_values : (L,) array
            The scaled unknowns of the trial.
        patch : ModelPatch
            What a hypothesis changes in the model: the primitives of its effects.
        refinement : int
            The time steps are this many times smaller than those of the problem, which are already
            divided by its own `refinement`.

        Returns
        -------
        response : (N, C) array
            The response at the times of the readings [unit of the channel].
        rates : (N, C) array or None
            Its time derivative; None if the model does not give it.
        """
        data = self.trials[trial_index]
        parameters = self.shared.parameters(shared_values)
        if not data.trial.is_dynamic:
            # of no influence at rest: one response serves all their values
            parameters[self._acts_in_motion_alone] = 0.0
        conditions = data.unknowns.conditions(data.trial, parameters, local_values)
        conditions = replace(conditions, refinement=self.refinement * refinement)

        def simulate() -> tuple[FloatArray, FloatArray | None]:
            observation = observe(self.model, self.campaign, data.trial, patch, conditions)
            return observation.values, observation.rates

        return self._responses.get((trial_index, patch.primitives, conditions.key), simulate)

    def response_of_candidate(
        self, trial_index: int, point: Point, candidate: Candidate, refinement: int = 1
    ) -> FloatArray:
        """Return the `response` (N, C) of a trial with the effects of a candidate."""
        patch = self.patch_in_trial(trial_index, candidate, point.effect)
        response, _ = self.response(
            trial_index, point.shared, point.local[trial_index], patch, refinement
        )
        return response

    def prediction(self, trial_index: int, point: Point, response: FloatArray) -> FloatArray:
        """Return the prediction (N, C) of the readings: the response with gains and zeros."""
        data = self.trials[trial_index]
        gains = self.shared.gains(point.shared, data.trial.channels)
        zero = data.unknowns.channel_zeros(point.local[trial_index], len(data.trial.channels))
        return np.asarray((1.0 + gains) * response + zero)

    def standardised_residual(
        self,
        trial_index: int,
        point: Point,
        response: FloatArray,
        jumps: FloatArray | None = None,
    ) -> FloatArray:
        """Return the standardised residuals (N, C) of a trial.

        Parameters
        ----------
        response : (N, C) array
            The response of the model in the trial at the point.
        jumps : (N, C) array, optional
            The jumps of the response near the point. A reading is then compared with the nearest of
            three branches: the response, and the response plus and minus the jump. On which side of
            a reversal a reading was taken can depend on microseconds, which neither the clock nor
            the time steps resolve.
        """
        data = self.trials[trial_index]

        def residual_of(any_response: FloatArray) -> FloatArray:
            prediction = self.prediction(trial_index, point, any_response)
            return data.standardise(data.trial.values - prediction)

        residual = residual_of(response)
        if jumps is None or not np.any(jumps):
            return residual
        for other_branch in (response + jumps, response - jumps):
            residual_of_branch = residual_of(other_branch)
            is_nearer = np.abs(residual_of_branch) < np.abs(residual)
            residual = np.where(is_nearer, residual_of_branch, residual)
        return residual

    # -------------------------------------------------------------------------- derivatives

    def linearise(
        self,
        trial_index: int,
        point: Point,
        candidate: Candidate,
        *,
        nearby_derivatives: TrialDerivatives | None = None,
        effect_steps: FloatArray | None = None,
    ) -> TrialDerivatives:
        """Return the response of a trial and its derivatives, by finite differences.

        Parameters
        ----------
        nearby_derivatives : TrialDerivatives, optional
            The derivatives with respect to nuisances at a nearby point, which are not computed
            again.
        effect_steps : (E,) array, optional
            The posterior standard deviations of the effect parameters, used as steps of their
            finite differences, at least `LEAST_EFFECT_STEP` and at most `PARAMETER_STEP`. Such a
            step averages over the kinks of friction and hysteresis. If left out, all steps are
            `PARAMETER_STEP`.

        Notes
        -----
        Differences by effect parameters are two-sided. Nuisances can compensate nearly all of such
        a derivative: if the effect moves frequencies, a ten-thousandth remains. A one-sided
        difference has a larger error from the curvature, which would count as information.
        """
        kind = self.trials[trial_index].trial.kind
        response = self.response_of_candidate(trial_index, point, candidate)
        by_nuisances: NuisanceDerivatives | TrialDerivatives
        if nearby_derivatives is None:
            by_nuisances = self._nuisance_derivatives(trial_index, point, candidate)
        else:
            by_nuisances = nearby_derivatives
        jumps_by_unknown = [by_nuisances.jumps]
        by_effect = np.zeros((candidate.parameter_count, *response.shape))
        steps = np.full(candidate.parameter_count, PARAMETER_STEP)
        if effect_steps is not None:
            steps = np.clip(effect_steps, LEAST_EFFECT_STEP, PARAMETER_STEP)
        for k, step in enumerate(steps.tolist()):
            if kind not in candidate.trial_kinds_of_parameter(k):
                continue
            point_above = replace(point, effect=with_step(point.effect, k, step))
            point_below = replace(point, effect=with_step(point.effect, k, -step))
            above = self.response_of_candidate(trial_index, point_above, candidate)
            below = self.response_of_candidate(trial_index, point_below, candidate)
            quotient = two_sided_quotient(below, response, above, step)
            by_effect[k] = quotient.slope
            jumps_by_unknown.append(quotient.jumps)
        return TrialDerivatives(
            response=response,
            by_parameters=by_nuisances.by_parameters,
            by_local=by_nuisances.by_local,
            by_effect=by_effect,
            jumps=largest_jumps(jumps_by_unknown, response.shape),
        )

    def _nuisance_derivatives(
        self, trial_index: int, point: Point, candidate: Candidate
    ) -> NuisanceDerivatives:
        """Return the `nuisance_derivatives` of a trial while the effects of a candidate act."""
        patch = self.patch_in_trial(trial_index, candidate, point.effect)

        def respond(
            shared_values: FloatArray, local_values: FloatArray
        ) -> tuple[FloatArray, FloatArray | None]:
            return self.response(trial_index, shared_values, local_values, patch)

        return nuisance_derivatives(
            self.trials[trial_index], self.shared, point.shared, point.local[trial_index], respond
        )

    def prediction_derivatives(
        self, trial_index: int, point: Point, derivatives: TrialDerivatives, candidate: Candidate
    ) -> tuple[FloatArray, IntArray]:
        """Return the derivatives of a trial's predicted readings, given those of its response."""
        return prediction_derivatives(
            self.trials[trial_index], self.shared, point.shared, derivatives, candidate
        )

    # -------------------------------------------------------------------------- likelihood

    def squares_by_channel(self, residuals: Sequence[FloatArray]) -> FloatArray:
        """Return the sum of squares (channels,), given the residuals (N, C) of each trial."""
        sums = np.zeros(len(self.channel_names))
        for data, residual in zip(self.trials, residuals, strict=True):
            np.add.at(sums, data.channel_indices, np.einsum("nc,nc->c", residual, residual))
        return sums

    def misfit(self, squares: FloatArray) -> float:
        """Return -ln L with the noise variances marginalised, up to a constant [nat].

        Parameters
        ----------
        squares : (channels,) array
            The sum of squared standardised residuals of each channel.
        """
        misfits = channel_misfits(self.record_freedom, self.sample_counts, squares)
        return float(misfits[self.sample_counts > 0].sum())

    def noise_precisions(self, squares: FloatArray) -> FloatArray:
        """Return the expected noise precision of each channel, as a ratio to the recorded 1 / s0^2.

        It is (n0 + n) / (n0 + RSS), the mean of its gamma posterior (see the module docstring), and
        1 if the noise is known (n0 is infinite) or the channel has no samples. Without a noise
        record n0 is zero, and RSS is kept away from zero.

        Parameters
        ----------
        squares : (channels,) array
            The sum of squared standardised residuals RSS of each channel.
        """
        n0, n = self.record_freedom, self.sample_counts
        with np.errstate(divide="ignore", invalid="ignore"):
            bounded_sums = np.where(n0 > 0.0, squares, np.maximum(squares, LEAST_VARIANCE * n))
            precisions = np.where(np.isinf(n0), 1.0, (n0 + n) / (n0 + bounded_sums))
        return np.where(n > 0, precisions, 1.0)

    def recorded_or_estimated_precisions(self, squares: FloatArray) -> FloatArray:
        """Return the noise precision of each channel, as a ratio to the recorded one.

        It is 1 for a channel with a noise record. The noise of other channels is estimated from
        their residuals, see `noise_precisions`.

        Parameters
        ----------
        squares : (channels,) array
            The sum of squared standardised residuals of each channel.
        """
        return np.where(self.record_freedom > 0.0, 1.0, self.noise_precisions(squares))

    # -------------------------------------------------------------------------- other problems

    def with_trials(self, trials: Sequence[Trial], model: Model | None = None) -> "Problem":
        """Return a problem with other trials, the same noise and the same shared unknowns.

        Parameters
        ----------
        model : Model, optional
            Another model; that of this problem if left out.
        """
        problem = copy(self)
        if model is not None:
            problem.model = model.with_response_cache()
        problem._prepare_trials(trials)
        return problem

    def with_channel(self, channel: Channel, noise_of: str) -> "Problem":
        """Return a problem with one more channel, which has the noise of a present one.

        The trials of the problem do not have it. An error of its gain is none of the shared
        unknowns.
        """
        number = self.channel_names.index(noise_of)
        problem = copy(self)
        problem.campaign = replace(
            self.campaign, channels={**self.campaign.channels, channel.name: channel}
        )
        problem.channel_names = (*self.channel_names, channel.name)
        problem.noise_models = {**self.noise_models, channel.name: self.noise_models[noise_of]}
        problem.record_freedom = np.append(self.record_freedom, self.record_freedom[number])
        problem.is_whiteness_tested = [*self.is_whiteness_tested, self.is_whiteness_tested[number]]
        problem.sample_counts = np.append(self.sample_counts, 0.0)
        return problem

    def with_first_samples(self, count: int) -> "Problem":
        """Return the problem in which only `count` samples of each trial in motion are compared."""
        shortened_problem = copy(self)
        shorter_trials = []
        for data in self.trials:
            if data.trial.is_dynamic:
                is_compared = np.arange(len(data.weight)) < count
                data = replace(data, weight=data.weight * is_compared[:, None])
            shorter_trials.append(data)
        shortened_problem.trials = tuple(shorter_trials)
        shortened_problem.sample_counts = shortened_problem._sample_counts()
        return shortened_problem

    def with_wider_noise(self, factors: FloatArray) -> "Problem":
        """Return the problem under a noise with a larger standard deviation, taken as known.

        The factors apply in trials in motion, and at rest only to channels without a noise record.

        Parameters
        ----------
        factors : (channels,) array
            The factor on the noise deviation of each channel.
        """
        wide_problem = copy(self)
        is_unrecorded = self.record_freedom == 0.0
        wider_trials = []
        for data in self.trials:
            is_wider = is_unrecorded[data.channel_indices] | data.trial.is_dynamic
            factor = np.where(is_wider, factors[data.channel_indices], 1.0)
            # errors of a mesh stay the same, and are in units of the noise
            mesh_errors = tuple(
                errors / factor[column] for column, errors in enumerate(data.mesh_errors)
            )
            deviation = data.deviation * factor
            wider_trials.append(replace(data, deviation=deviation, mesh_errors=mesh_errors))
        wide_problem.trials = tuple(wider_trials)
        wide_problem.record_freedom = np.where(factors != 1.0, inf, self.record_freedom)
        return wide_problem
