"""The share of the missing force that a hypothesis explains, in fitted or in held-out trials."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.estimation.estimate import NO_EFFECTS, Estimate
from discrepancy.estimation.filtered import SmoothedTrial
from discrepancy.estimation.force_search import ForceSearch
from discrepancy.estimation.gauss_newton import (
    EstimatorStart,
    linearise_along_laws,
    linearise_trials,
)
from discrepancy.estimation.linearisation import Linearisation, plain_linearisation
from discrepancy.estimation.ported_problem import WIDE_WINDOW, shows_missing_force
from discrepancy.estimation.process_search import Processes
from discrepancy.estimation.trial_set import TrialSet
from discrepancy.fits.candidate import Point
from discrepancy.trials_in_motion.trial_at_rest import LinearTrial

from .gap_share import OF_FORCE, OF_PREDICTIONS, SEED, GapShare

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
"""Forces (F,) at the ports of a trial, by the index of the port."""


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
        The search for the missing force in which the hypotheses were estimated.
    """

    def __init__(self, search: ForceSearch) -> None:
        self.search = search
        campaign = search.ported.problem.campaign
        held_out = tuple(
            trial for trial in campaign.held_out if shows_missing_force(search.ported.model, trial)
        )
        self._held_out: TrialSet | None = None
        self._held_out_trials: dict[bytes, tuple[LinearTrial, ...]] = {}
        self._without_effect: dict[bool, tuple[SmoothedTrial, ...]] = {}
        if held_out:
            problem = search.ported.problem.with_trials(held_out)
            self._held_out = search.ported.trial_set.with_problem(
                problem, range(len(problem.trials))
            )

    @property
    def has_held_out(self) -> bool:
        """Whether some of the held-out trials show missing forces."""
        return self._held_out is not None

    def gap_share(self, estimate: Estimate, *, held_out: bool) -> GapShare:
        """Return the share of the missing force that a hypothesis explains.

        Two shares are computed: that of the forces, and that of the changes of the readings by
        these forces. The one whose interval has the higher lower end is returned. Each may overlook
        a part of the force: fast forces hardly move a free mass, and slow forces are small compared
        with fast ones.

        Parameters
        ----------
        held_out : bool
            Whether the share is computed in the held-out trials, and not in the fitted trials.
        """
        linearisation, trials = self.smooth_trials(estimate, held_out=held_out)
        trials_without = self._trials_without_effect(held_out)
        law_ports = self._law_ports(estimate)
        ports = law_ports or set(self.search.best_port_estimate.processes)
        remaining_rms = _largest_rms([trial.missing_forces for trial in trials], ports)
        total_rms = _largest_rms([trial.missing_forces for trial in trials_without], ports)
        law_rms = _largest_rms([trial.effect_forces for trial in trials], ports)
        # trials in which the force of the law is small do not test the law
        is_tested = not law_ports or law_rms**2 > LEAST_FORCE_RATIO * total_rms**2
        of_forces, of_predictions = self._block_sums(
            estimate, linearisation, trials, trials_without
        )
        shares = []
        for block_sums, kind in ((of_forces, OF_FORCE), (of_predictions, OF_PREDICTIONS)):
            sums_before, sums_after, noise_sums = np.array(block_sums).T
            share = GapShare(
                squares_before=sums_before,
                squares_after=sums_after,
                noise_squares=noise_sums,
                held_out=held_out,
                trial_count=len(trials),
                remaining_rms=remaining_rms,
                total_rms=total_rms,
                kind=kind,
                is_tested=is_tested,
            )
            shares.append(share)
        return max(shares, key=lambda share: share.interval[0])

    def _law_ports(self, estimate: Estimate) -> set[int]:
        """Return the numbers of the ports at which a hypothesis has laws."""
        names = self.search.ported.ports
        ports = [term.port for term in estimate.candidate.terms]
        return {names.index(port) for port in ports if port in names}

    def _block_sums(
        self,
        estimate: Estimate,
        linearisation: Linearisation,
        trials: Sequence[SmoothedTrial],
        trials_without: Sequence[SmoothedTrial],
    ) -> tuple[list[_BlockSums], list[_BlockSums]]:
        """Return the sums of squares of forces and of the changes of readings, by block.

        Forces at different ports are weighted by how strongly they act on state and readings.

        Parameters
        ----------
        linearisation : Linearisation
            The trials, linear along their motion with the hypothesis.
        trials, trials_without : sequence of SmoothedTrial
            The smoothed trials with the hypothesis, and without any effect.

        Returns
        -------
        of_forces, of_predictions : list of _BlockSums
            The sums of each block of all trials: of weighted forces, and of changes of readings
            divided by their noise.
        """
        weights = {
            port: trials[0].trial.strength_of_port(port) for port in trials[0].missing_forces
        }
        of_forces = []
        of_predictions = []
        filters = linearisation.filter(self._large_processes(estimate))
        for smoothed_trial, without_effect, filtered_trial in zip(
            trials, trials_without, filters, strict=True
        ):
            trial = smoothed_trial.trial
            # missing forces as they would be estimated from noise alone
            noise_forces = filtered_trial.forces_of_residual(_simulated_noise(trial))
            # in the order of `_BlockSums`: without a law, with the law, and of noise alone
            forces_of_kinds: tuple[PortForces, ...] = (
                without_effect.missing_forces,
                smoothed_trial.missing_forces,
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

    def _large_processes(self, estimate: Estimate) -> Processes:
        """Return the missing forces without any effect, and those of an estimate at further ports.

        They are large enough to describe all that the hypothesis does not explain.
        """
        return {**estimate.processes, **self.search.estimate_without_effects.processes}

    def _trials_without_effect(self, held_out: bool) -> tuple[SmoothedTrial, ...]:
        """Return the smoothed trials without any effect, in which the whole force is missing.

        Shared unknowns are kept within `SHARED_BOUND` prior deviations, as they would otherwise
        explain a part of the missing force.
        """
        if held_out not in self._without_effect:
            estimate = self.search.estimate_without_effects
            # an unknown with a flat prior has no bound
            has_prior = self.search.ported.problem.shared.precision > 0.0
            bounds = np.where(has_prior, SHARED_BOUND, np.inf)
            bounded_estimate = replace(estimate, shared=np.clip(estimate.shared, -bounds, bounds))
            _, self._without_effect[held_out] = self.smooth_trials(
                bounded_estimate, held_out=held_out
            )
        return self._without_effect[held_out]

    def smooth_trials(
        self, estimate: Estimate, *, held_out: bool
    ) -> tuple[Linearisation, tuple[SmoothedTrial, ...]]:
        """Return trials under a hypothesis, smoothed with the force that it leaves unexplained.

        This force has the prior standard deviation of the force that is missing without any effect.
        Shared unknowns and effects are those of the estimate. Held-out trials are linearised along
        their own motion, in a few rounds; fitted trials as in the estimate.
        """
        processes = self._large_processes(estimate)
        if not held_out:
            return estimate.linearisation, estimate.linearisation.smooth(
                processes, estimate.solution
            )
        assert self._held_out is not None
        priors = self.search.ported.shared_priors
        trials = self._held_out_linearised_as(estimate)
        without_laws = plain_linearisation(trials, priors)
        linearisation = without_laws
        smoothed_trials = without_laws.smooth(
            processes, replace(estimate.solution, mean=estimate.shared)
        )
        # the laws act along the motion, which in turn depends on their force: iterate
        laws = self._held_out.laws(estimate.candidate, trials)
        # an estimate without effects has no window, but the model may have laws of its own
        speed_window = estimate.speed_window or WIDE_WINDOW
        # first along the smoothed motion; then, if the estimate is, along that of the laws alone
        rounds = [(linearise_trials, processes)] * SMOOTHING_ROUNDS
        if estimate.follows_laws:
            rounds += [(linearise_along_laws, estimate.processes)] * SMOOTHING_ROUNDS
        for linearise, remaining_processes in rounds:
            start = EstimatorStart(
                effect=estimate.effect,
                shared=estimate.shared,
                local=tuple(trial.local for trial in smoothed_trials),
                trajectories=tuple(trial.trajectory for trial in smoothed_trials),
                processes=remaining_processes,
            )
            with_laws = linearise(laws, trials, start, speed_window, priors)
            if with_laws is None:
                break
            linearisation = with_laws
            smoothed_trials = linearisation.smooth(remaining_processes, estimate.solution)
        return linearisation, linearisation.smooth(processes, estimate.solution)

    def _held_out_linearised_as(self, estimate: Estimate) -> tuple[LinearTrial, ...]:
        """Return the held-out trials, linearised about the same values as the fitted trials."""
        assert self._held_out is not None
        problem = self._held_out.problem
        fitted_trial = estimate.trials[0].trial
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
    """Return the sum of squares of weighted forces over all ports, and over a slice of fine stamps.

    Forces (F,) and weights are given by the index of the port.
    """
    total = 0.0
    for port, force in forces.items():
        weighted_force = weights[port] * force[samples]
        total += float(np.sum(weighted_force**2))
    return total


def _largest_rms(forces_by_trial: Sequence[PortForces], ports: Iterable[int]) -> float:
    """Return the rms force in all trials together, at the port where it is largest."""
    rms_of_ports = []
    for port in ports:
        forces = [trial_forces[port] for trial_forces in forces_by_trial if port in trial_forces]
        rms_of_ports.append(_rms(np.concatenate(forces)) if forces else 0.0)
    return max(rms_of_ports)


def _rms(values: FloatArray) -> float:
    """Return the root mean square of values (N,)."""
    return float(np.sqrt(np.mean(values**2)))


def _simulated_noise(trial: LinearTrial) -> FloatArray:
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
