"""The share of the missing force that a hypothesis explains, in fitted or in held-out trials."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.fits.candidate import Point

from .explained import NO_EFFECTS, ForceHypothesis
from .gap_share import OF_FORCE, OF_PREDICTIONS, SEED, GapShare
from .hypotheses import ColumnBuilder
from .linear_trials import LinearTrials, TrialMotion
from .naming import ForceSearch
from .trial import PortedTrial

MOST_BLOCKS = 12
"""Largest number of blocks into which a trial is divided for the bootstrap."""
LEAST_BLOCK_SAMPLES = 8
"""Least number of samples of a block."""
SHARED_BOUND = 2.0
"""Bound of the shared unknowns, in prior standard deviations, when the missing force is estimated
without any effect."""
LEAST_FORCE_RATIO = 0.1
"""Least mean square force of a law, over that of the missing force, with which trials can test the
law."""
SMOOTHING_ROUNDS = 3
"""Number of times that a held-out trial is smoothed again with the law along its motion."""


PortForces = Mapping[int, FloatArray]
"""Forces (F,) at the ports of a trial, by the number of the port."""


class _BlockSums(NamedTuple):
    """Sums of squares over a block of a trial: without a law, with the law, and of noise alone."""

    before: float
    after: float
    noise: float


class ForceShares:
    """The shares of the missing force that hypotheses explain.

    Parameters
    ----------
    search : ForceSearch
        The search for the missing force that made the hypotheses.
    """

    def __init__(self, search: ForceSearch) -> None:
        self.search = search
        campaign = search.problem.campaign
        held_out = tuple(trial for trial in campaign.held_out if trial.is_dynamic)
        self._held_out: ColumnBuilder | None = None
        self._held_out_trials: dict[bytes, LinearTrials] = {}
        self._without_effect: dict[bool, tuple[LinearTrials, list[TrialMotion]]] = {}
        if held_out:
            problem = search.problem.with_trials(held_out)
            self._held_out = ColumnBuilder(problem, range(len(problem.trials)), search.model_laws)

    @property
    def has_held_out(self) -> bool:
        """Whether some of the trials in motion are held out."""
        return self._held_out is not None

    def gap_share(self, hypothesis: ForceHypothesis, *, held_out: bool) -> GapShare:
        """Return the share of the missing force that a hypothesis explains.

        Two shares are computed: that of the forces, and that of the changes of the readings by
        these forces. The one with the larger lower end of its interval is returned. Each of them
        may miss a part: fast forces hardly move a free mass, and slow forces are small compared
        with fast ones.

        Parameters
        ----------
        hypothesis : ForceHypothesis
            The fitted hypothesis: its effects, and the motion and missing forces of each trial.
        held_out : bool
            Whether the share is computed in the held-out trials, and not in the fitted trials.
        """
        linear_trials, motions = self.smooth_trials(hypothesis, held_out=held_out)
        _, motions_without = self._motions_without_effect(held_out)
        law_ports = self._law_ports(hypothesis)
        ports = law_ports or set(self.search.hypothesis_of_best_port().processes)
        remaining_rms = _largest_rms([motion.unexplained_forces for motion in motions], ports)
        total_rms = _largest_rms([motion.forces for motion in motions_without], ports)
        law_rms = _largest_rms([motion.law_forces for motion in motions], ports)
        # trials in which the force of the law is small do not test the law
        is_tested = not law_ports or law_rms**2 > LEAST_FORCE_RATIO * total_rms**2
        of_forces, of_predictions = self._block_sums(
            hypothesis, linear_trials, motions, motions_without
        )
        shares = []
        for block_sums, kind in ((of_forces, OF_FORCE), (of_predictions, OF_PREDICTIONS)):
            sums_before, sums_after, noise_sums = np.array(block_sums).T
            share = GapShare(
                squares_before=sums_before,
                squares_after=sums_after,
                noise_squares=noise_sums,
                held_out=held_out,
                trial_count=len(motions),
                remaining_rms=remaining_rms,
                total_rms=total_rms,
                kind=kind,
                is_tested=is_tested,
            )
            shares.append(share)
        return max(shares, key=lambda share: share.interval[0])

    def _law_ports(self, hypothesis: ForceHypothesis) -> set[int]:
        """Return the numbers of the ports at which a hypothesis has laws."""
        names = self.search.ports
        places = [term.place for term in hypothesis.candidate.terms]
        return {names.index(place) for place in places if place in names}

    def _block_sums(
        self,
        hypothesis: ForceHypothesis,
        linear_trials: LinearTrials,
        motions: Sequence[TrialMotion],
        motions_without: Sequence[TrialMotion],
    ) -> tuple[list[_BlockSums], list[_BlockSums]]:
        """Return the sums of squares of forces and of the changes of readings, by block.

        Forces at different ports are weighted by how strongly they act on state and readings.

        Parameters
        ----------
        hypothesis : ForceHypothesis
            The fitted hypothesis: its effects, and the motion and missing forces of each trial.
        linear_trials : LinearTrials
            The trials in motion as one linear model.
        motions, motions_without : sequence of TrialMotion
            The motion of each trial with the hypothesis, and without any effect.

        Returns
        -------
        of_forces, of_predictions : list of _BlockSums
            The sums of each block of all trials: of weighted forces, and of changes of readings
            divided by their noise.
        """
        system = linear_trials.trials[0].system
        weights = {}
        for port in motions[0].unexplained_forces:
            strength_on_state = np.linalg.norm(system.actions[port])
            strength_on_readings = np.linalg.norm(system.through[port])
            weights[port] = float(np.hypot(strength_on_state, strength_on_readings))
        of_forces = []
        of_predictions = []
        filters = linear_trials.force_filters(
            {**hypothesis.processes, **self.search.hypothesis_of_all_ports.processes}
        )
        for trial, motion, motion_without, force_filter in zip(
            linear_trials.trials, motions, motions_without, filters, strict=True
        ):
            # the missing forces that are estimated from noise alone
            smoothed_noise = force_filter.smooth(_simulated_noise(trial))
            noise_forces = {}
            for (port, _), force in zip(force_filter.processes, smoothed_noise.forces, strict=True):
                noise_forces[port] = force
            # in the order of `_BlockSums`: without a law, with the law, and of noise alone
            forces_of_kinds: tuple[PortForces, ...] = (
                motion_without.forces,
                motion.unexplained_forces,
                noise_forces,
            )
            for begin, end in _blocks(len(trial.time)):
                samples = slice(begin * trial.substeps, end * trial.substeps, trial.substeps)
                force_sums = [
                    _squares_of_weighted_forces(forces, weights, samples)
                    for forces in forces_of_kinds
                ]
                of_forces.append(_BlockSums(*force_sums))
                prediction_sums = [
                    float(np.sum(trial.readings_of_forces_in_block(forces, begin, end) ** 2))
                    for forces in forces_of_kinds
                ]
                of_predictions.append(_BlockSums(*prediction_sums))
        return of_forces, of_predictions

    def _motions_without_effect(self, held_out: bool) -> tuple[LinearTrials, list[TrialMotion]]:
        """Return the trials, and the motion and missing force of each without any effect.

        Shared unknowns are kept within `SHARED_BOUND` prior deviations, as they would otherwise
        explain a part of the missing force.
        """
        if held_out not in self._without_effect:
            hypothesis = self.search.hypothesis_of_all_ports
            # an unknown with a flat prior has no bound
            bounds = np.where(hypothesis.linear_trials.shared_precision > 0.0, SHARED_BOUND, np.inf)
            mean = np.clip(hypothesis.solution.mean, -bounds, bounds)
            bounded_hypothesis = replace(
                hypothesis, solution=replace(hypothesis.solution, mean=mean)
            )
            self._without_effect[held_out] = self.smooth_trials(
                bounded_hypothesis, held_out=held_out
            )
        return self._without_effect[held_out]

    def smooth_trials(
        self, hypothesis: ForceHypothesis, *, held_out: bool
    ) -> tuple[LinearTrials, list[TrialMotion]]:
        """Return the trials, and the motion and unexplained force of each with a hypothesis.

        The unexplained force has the standard deviation of the force that is missing without any
        effect, so that it can describe all that the hypothesis does not explain.

        Parameters
        ----------
        hypothesis : ForceHypothesis
            The fitted hypothesis: its effects, and the motion and missing forces of each trial.
        held_out : bool
            Whether the held-out trials are returned. Otherwise the fitted trials are returned.
        """
        processes = {**hypothesis.processes, **self.search.hypothesis_of_all_ports.processes}
        if not held_out:
            motion_estimate = hypothesis.linear_trials.smooth(processes, hypothesis.solution)
            return hypothesis.linear_trials, motion_estimate.motions
        assert self._held_out is not None
        builder = self._held_out
        linear_trials = self._held_out_linearised_as(hypothesis)
        solution = replace(hypothesis.solution, mean=hypothesis.shared)
        motions = linear_trials.smooth(processes, solution).motions
        # the laws act along the motion, which in turn depends on their force: iterate
        for _ in range(SMOOTHING_ROUNDS):
            effects_column = None
            if len(hypothesis.effect):
                effects_column = builder.column_of_candidate(
                    linear_trials, motions, hypothesis.candidate, hypothesis.effect
                )
            linear_trials = builder.trials_along_motions(linear_trials, motions, effects_column)
            motions = linear_trials.smooth(processes, solution).motions
        return linear_trials, motions

    def _held_out_linearised_as(self, hypothesis: ForceHypothesis) -> LinearTrials:
        """Return the held-out trials, linearised about the same values as the fitted trials.

        Parameters
        ----------
        hypothesis : ForceHypothesis
            The hypothesis with its fitted trials.
        """
        assert self._held_out is not None
        problem = self._held_out.problem
        fitted_trial = hypothesis.linear_trials.trials[0]
        shared_values = fitted_trial.linearisation_point[: problem.shared.unknown_count]
        key = shared_values.tobytes()
        if key not in self._held_out_trials:
            local_values = problem.prior_mean_point(NO_EFFECTS).local
            point = Point(shared_values, local_values, np.zeros(0))
            self._held_out_trials[key] = self._held_out.trials_about(point)
        return self._held_out_trials[key]


def _blocks(sample_count: int) -> Iterable[tuple[int, int]]:
    """Return start and end of each block of a trial, as indices of samples."""
    count = min(MOST_BLOCKS, max(1, sample_count // LEAST_BLOCK_SAMPLES))
    edges = np.linspace(0, sample_count, count + 1).astype(int)
    return pairwise(edges.tolist())


def _squares_of_weighted_forces(
    forces: PortForces, weights: Mapping[int, float], samples: slice
) -> float:
    """Return the sum of the squares of the weighted forces, over the samples and all ports.

    Parameters
    ----------
    forces : mapping of int to (F,) array
        The forces at the fine stamps, by the number of the port.
    weights : mapping of int to float
        The weight of each port.
    samples : slice
        The fine stamps over which is summed.
    """
    total = 0.0
    for port, force in forces.items():
        weighted_force = weights[port] * force[samples]
        total += float(np.sum(weighted_force**2))
    return total


def _largest_rms(forces_by_trial: Sequence[PortForces], ports: Iterable[int]) -> float:
    """Return the largest rms among some ports, of the forces of all trials together."""
    rms_of_ports = []
    for port in ports:
        forces = [trial_forces[port] for trial_forces in forces_by_trial if port in trial_forces]
        rms_of_ports.append(_rms(np.concatenate(forces)) if forces else 0.0)
    return max(rms_of_ports)


def _rms(values: FloatArray) -> float:
    """Return the root mean square of values (N,)."""
    return float(np.sqrt(np.mean(values**2)))


def _simulated_noise(trial: PortedTrial) -> FloatArray:
    """Return simulated noise (N, C) of a trial with its correlation, divided by its deviation.

    The seed is fixed, so that results can be repeated.
    """
    generator = np.random.default_rng(SEED)
    noise = generator.standard_normal(trial.residual.shape)
    for coloured in trial.coloured_noises:
        # an autoregression of first order at the trial's stamps; nothing comes before the first one
        decay = np.exp(-coloured.decay_rate * np.diff(trial.time, prepend=-np.inf))
        correlated_noise = np.zeros(len(noise))
        for k, innovation in enumerate(generator.standard_normal(len(noise))):
            correlated_noise[k] = (
                decay[k] * correlated_noise[k - 1] + np.sqrt(1.0 - decay[k] ** 2) * innovation
            )
        white_noise = np.sqrt(1.0 - coloured.share) * noise[:, coloured.channel]
        noise[:, coloured.channel] = white_noise + np.sqrt(coloured.share) * correlated_noise
    return np.asarray(noise * trial.used)
