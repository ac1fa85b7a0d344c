"""Campaign and model brought together: standardised residuals of every trial and their derivatives.

A residual is (measured - (1 + gain) model - zero) / s0, whitened in time where the noise record is coloured.
The variance of each channel's noise is marginalised under the inverse gamma distribution that its record
leaves: -ln L = sum over channels of (n0 + n) / 2 ln(1 + RSS / n0) + constant, RSS in units of s0^2.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from math import inf

import numpy as np

from discrepancy.campaign.noise import NoiseModel, noise_model, whiteness_is_tested
from discrepancy.campaign.records import Campaign, FloatArray, IntArray, Trial
from discrepancy.catalogue.entry import Setting
from discrepancy.errors import CampaignDataError, DiscrepancyError, said
from discrepancy.system.interface import Model
from discrepancy.system.sensing import observe
from fe.runtime.patch import ModelPatch
from reporting.memory import ResultCache

from .candidate import LEAST_STEP, PARAMETER_STEP, SHARED_STEP, Candidate, Linearisation, Point, moved
from .trial_data import TrialData, global_unknowns, stand_in

KEPT = 2000
"""Responses that a problem keeps."""
QUIETEST = 1e-12
"""Least variance of an unknown noise over its stand-in: a billionth of the range, from rounding."""


def misfits(freedom: FloatArray, counts: FloatArray, sums: FloatArray) -> FloatArray:
    """Return -ln L of each channel [nat], its noise variance marginalised, up to a constant.

    Parameters
    ----------
    freedom, counts, sums : (...) ndarray
        n0 of the noise record, number of samples, sum of squared standardised residuals.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        known = 0.5 * (freedom + counts) * np.log1p(sums / freedom)
        unknown = 0.5 * counts * np.log(np.maximum(sums, QUIETEST * counts))
    return np.where(np.isinf(freedom), 0.5 * sums, np.where(freedom > 0.0, known, unknown))


class Problem:
    """A campaign and a model, with everything that does not depend on the hypothesis.

    Parameters
    ----------
    campaign : Campaign
        With its noise records.
    model : Model
        The model as it is.
    setting : Setting
        Scales for the catalogue.

    Attributes
    ----------
    beginnings : dict of str to (L,) ndarray
        Own unknowns of trials as their first readings show them, by name, where they were looked for.

    Raises
    ------
    CampaignDataError
        If all trials are held out.
    """

    def __init__(self, campaign: Campaign, model: Model, setting: Setting) -> None:
        if not campaign.fitted:
            raise CampaignDataError(said("campaign.all_held_out", campaign=campaign))
        self.campaign, self.setting, self.model = campaign, setting, model.remembering()
        self.channel_names = tuple(campaign.channels)
        self.refinement = 1
        self.noise: dict[str, NoiseModel] = {
            name: noise_model(channel, stand_in(campaign, name))
            for name, channel in campaign.channels.items()
        }
        self.freedom = np.array([item.degrees_of_freedom for item in self.noise.values()])
        self.tests_whiteness = [whiteness_is_tested(channel) for channel in campaign.channels.values()]
        self.refusals: dict[str, str] = {}
        self.beginnings: dict[str, FloatArray] = {}
        self._take(campaign.fitted)
        self.shared = global_unknowns(campaign, model, campaign.fitted, {})
        self.shared = global_unknowns(campaign, model, campaign.fitted, self._unit_responses())

    def _take(self, trials: Sequence[Trial]) -> None:
        """Make trials ready to be compared."""
        self.trials = tuple(TrialData.of(self.campaign, trial, self.noise, self.model) for trial in trials)
        self.counts = np.zeros(len(self.channel_names))
        for data in self.trials:
            np.add.at(self.counts, data.groups, data.weight.sum(axis=0))
        self._responses = ResultCache(KEPT)

    def refused(self, candidate: Candidate, cause: DiscrepancyError) -> None:
        """Keep why an effect could not be evaluated or fitted alone; of several, any may be to blame."""
        if len(candidate.terms) == 1:
            self.refusals[candidate.terms[0].effect.identifier] = str(cause)

    def _unit_responses(self) -> dict[str, float]:
        """Estimate data over model for signals of unknown scale."""
        found: dict[str, float] = {}
        point = self.start(Candidate())
        for number, data in enumerate(self.trials):
            for column, name in enumerate(data.trial.channels):
                channel = self.campaign.channels[name]
                if channel.gain_deviation != inf or name in found:
                    continue
                measured = data.trial.values[:, column] - np.median(data.trial.values[:, column])
                local = point.local[number]
                if data.trial.release is not None and not data.trial.release.at_rest:
                    local[data.unknowns.zeros] = 1.0 / data.unknowns.scale[data.unknowns.zeros]
                response, _ = self.response(number, point.shared, local, ModelPatch())
                size = float(np.abs(response[:, column]).max())
                if size > 0.0:
                    same = data.trial.release is not None or measured @ response[:, column] > 0.0
                    found[name] = float(np.abs(measured).max()) / size * (1.0 if same else -1.0)
        return found

    # -------------------------------------------------------------------------- values

    def start(self, candidate: Candidate) -> Point:
        """Return the prior means, and the start of the candidate."""
        return Point(
            np.zeros(self.shared.size),
            tuple(np.zeros(data.unknowns.size) for data in self.trials),
            candidate.start(),
        )

    def response(
        self, number: int, shared: FloatArray, local: FloatArray, patch: ModelPatch, finer: int = 1
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return the response (N, C) of a trial without gain and zero, and its rates; kept while it is used.

        Time steps are `refinement` times `finer` smaller than the model's own.
        """
        data = self.trials[number]
        conditions = data.unknowns.conditions(data.trial, self.shared.parameters(shared), local)
        conditions = replace(conditions, refinement=self.refinement * finer)

        def answer() -> tuple[FloatArray, FloatArray | None]:
            observed = observe(self.model, self.campaign, data.trial, patch, conditions)
            return observed.values, observed.rates

        return self._responses.get((number, patch.primitives, conditions.key), answer)

    def answer(self, number: int, point: Point, candidate: Candidate, finer: int = 1) -> FloatArray:
        """Return the response (N, C) of a trial beside the effects of a candidate, as `response` does."""
        acts = self.trials[number].trial.kind in candidate.acts_on
        patch = candidate.patch(self.setting, point.effect) if acts else ModelPatch()
        return self.response(number, point.shared, point.local[number], patch, finer)[0]

    def prediction(self, number: int, point: Point, response: FloatArray) -> FloatArray:
        """Return the prediction (N, C) with gains and zeros."""
        data = self.trials[number]
        gains = self.shared.gains(point.shared, data.trial.channels)
        zero = data.unknowns.zero(point.local[number], len(data.trial.channels))
        return np.asarray((1.0 + gains) * response + zero)

    def residual(self, number: int, point: Point, response: FloatArray) -> FloatArray:
        """Return the standardised residuals (N, C) of a trial."""
        data = self.trials[number]
        return data.standardised(data.trial.values - self.prediction(number, point, response))

    # -------------------------------------------------------------------------- derivatives

    def linearise(
        self,
        number: int,
        point: Point,
        candidate: Candidate,
        *,
        known: Linearisation | None = None,
        effect_steps: FloatArray | None = None,
    ) -> Linearisation:
        """Return response and derivatives of a trial.

        Parameters
        ----------
        number : int
            Of the trial.
        point : Point
            Where.
        candidate : Candidate
            Effects that act.
        known : Linearisation, optional
            Derivatives by shared and local unknowns that are near enough.
        effect_steps : (E,) ndarray, optional
            Deviations of the effect parameters. Differences over one of them, at most a hundredth of the
            prior's, average over the kinks of friction and hysteresis and do not reach beyond where the
            parameters may lie.

        Notes
        -----
        What nuisances can do as well is left of a derivative by an effect once these are fitted: a
        ten-thousandth where the effect moves frequencies. The curvature in a one-sided difference is more
        than that, and would count as information.
        """
        kind, response = self.trials[number].trial.kind, self.answer(number, point, candidate)
        if known is not None:
            parameters, by_local = known.parameters, known.local
        else:
            parameters, by_local = self._by_nuisances(number, point, candidate)
        effect = np.zeros((candidate.size, *response.shape))
        steps = np.full(candidate.size, PARAMETER_STEP)
        if effect_steps is not None:
            steps = np.clip(effect_steps, LEAST_STEP, PARAMETER_STEP)
        for k, step in enumerate(steps.tolist()):
            if kind in candidate.acting(k):
                ends = [replace(point, effect=moved(point.effect, k, side * step)) for side in (1.0, -1.0)]
                above, below = (self.answer(number, end, candidate) for end in ends)
                effect[k] = (above - below) / (2.0 * step)
        return Linearisation(response, parameters, by_local, effect)

    def _by_nuisances(self, number: int, point: Point, candidate: Candidate) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives by the calibrated parameters and by the trial's own unknowns but zeros."""
        data, shared, local = self.trials[number], point.shared, point.local[number]
        acts = data.trial.kind in candidate.acts_on
        patch = candidate.patch(self.setting, point.effect) if acts else ModelPatch()
        response, rates = self.response(number, shared, local, patch)
        unknowns = data.unknowns
        first, _, last, at = unknowns.ends

        def slope(by_shared: FloatArray, by_local: FloatArray, step: float = PARAMETER_STEP) -> FloatArray:
            return (self.response(number, by_shared, by_local, patch)[0] - response) / step

        # inwards from the end of a range
        inwards = shared + SHARED_STEP > self.shared.ends[1]
        steps = np.where(inwards, -SHARED_STEP, SHARED_STEP)[: self.shared.count]
        parameters = [slope(moved(shared, k, step), local, step) for k, step in enumerate(steps.tolist())]
        columns = [slope(shared, moved(local, k)) for k in range(first, last)]
        if unknowns.has_time_zero:
            of_time = slope(shared, moved(local, last)) if rates is None else rates * unknowns.scale[last]
            columns.append(of_time)
        if len(unknowns.health_rows):
            by_entry = np.zeros((len(unknowns.health_rows), *response.shape))
            for region in range(data.trial.health.shape[1]):
                entries = np.flatnonzero(unknowns.health_columns == region)
                if not len(entries):
                    continue
                there = local.copy()
                # away from the limits of the loss; rows do not act on each other
                sign = np.where(there[at + entries] > 0.0, -1.0, 1.0)
                there[at + entries] += sign * PARAMETER_STEP
                change = slope(shared, there)
                if data.trial.is_dynamic:
                    by_entry[entries] = sign[:, np.newaxis, np.newaxis] * change
                else:
                    rows = unknowns.health_rows[entries]
                    by_entry[entries, rows] = sign[:, np.newaxis] * change[rows]
            columns.extend(by_entry)
        shape = (-1, *response.shape)
        return np.array(parameters).reshape(shape), np.array(columns).reshape(shape)

    def columns(
        self, number: int, point: Point, parts: Linearisation, candidate: Candidate
    ) -> tuple[FloatArray, IntArray]:
        """Return derivatives of the prediction of a trial [channel's unit], and whose the later ones are.

        Returns
        -------
        columns : (L + K, N, C) ndarray
            By the L unknowns of the trial, and by the K shared ones and effect parameters that touch it.
        index : (K,) ndarray of int
            Which these are, global unknowns first.
        """
        data, shared = self.trials[number], self.shared
        channels, unknowns = data.trial.channels, data.unknowns
        gains = 1.0 + shared.gains(point.shared, channels)
        known = np.array([k for k, name in enumerate(shared.gain_channels) if name in channels], dtype=int)
        column = [channels.index(shared.gain_channels[k]) for k in known]
        acting = np.array(
            [k for k in range(candidate.size) if data.trial.kind in candidate.acting(k)], dtype=int
        )
        shape = parts.response.shape
        zeros, of_gains = np.zeros((unknowns.zeros, *shape)), np.zeros((len(known), *shape))
        zeros[np.arange(len(zeros)), :, unknowns.zero_columns] = unknowns.scale[: len(zeros), np.newaxis]
        of_gains[np.arange(len(known)), :, column] = (
            parts.response[:, column] * shared.scale[shared.count + known]
        ).T
        found = (zeros, parts.local * gains, parts.parameters * gains, of_gains, parts.effect[acting] * gains)
        index = np.concatenate((np.arange(shared.count), shared.count + known, shared.size + acting))
        return np.concatenate(found), index

    # -------------------------------------------------------------------------- likelihood

    def group_sums(self, residuals: Sequence[FloatArray]) -> FloatArray:
        """Return the sum of squared standardised residuals of each channel."""
        sums = np.zeros(len(self.channel_names))
        for data, residual in zip(self.trials, residuals, strict=True):
            np.add.at(sums, data.groups, np.einsum("nc,nc->c", residual, residual))
        return sums

    def misfit(self, sums: FloatArray) -> float:
        """Return -ln L with the noise variances marginalised, up to a constant."""
        return float(misfits(self.freedom, self.counts, sums)[self.counts > 0].sum())

    def precisions(self, sums: FloatArray) -> FloatArray:
        """Return the expected precision of each channel's noise over 1 / s0^2, given the residuals."""
        n0, n = self.freedom, self.counts
        with np.errstate(divide="ignore", invalid="ignore"):
            left = np.where(n0 > 0.0, sums, np.maximum(sums, QUIETEST * n))
            weights = np.where(np.isinf(n0), 1.0, (n0 + n) / (n0 + left))
        return np.where(n > 0, weights, 1.0)

    def with_trials(self, trials: Sequence[Trial], model: Model | None = None) -> "Problem":
        """Return the problem of other trials and another model, with the same noise and global unknowns."""
        other = copy(self)
        if model is not None:
            other.model = model.remembering()
        other._take(trials)
        return other

    def first_samples(self, count: int) -> "Problem":
        """Return the problem of the first samples of the trials in motion."""
        shorter = copy(self)
        shorter.trials = tuple(
            replace(data, weight=data.weight * (np.arange(len(data.weight)) < count)[:, None])
            if data.trial.is_dynamic
            else data
            for data in self.trials
        )
        shorter.counts = np.zeros_like(self.counts)
        for data in shorter.trials:
            np.add.at(shorter.counts, data.groups, data.weight.sum(axis=0))
        return shorter

    def widened(self, factors: FloatArray) -> "Problem":
        """Return the problem with noise so many times (channels,) as wide in trials in motion, and known.

        At rest too, where nothing is known of it.
        """
        wider = copy(self)
        everywhere = self.freedom == 0.0
        wider.trials = tuple(
            replace(
                data,
                deviation=data.deviation
                * np.where(everywhere[data.groups] | data.trial.is_dynamic, factors[data.groups], 1.0),
            )
            for data in self.trials
        )
        wider.freedom = np.where(factors != 1.0, inf, self.freedom)
        return wider
