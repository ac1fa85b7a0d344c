"""The share of the missing force that a hypothesis explains, in fitted or in held-out trials."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.fits.candidate import Point

from .explained import ForceHypothesis
from .gap_share import OF_FORCE, OF_PREDICTIONS, SEED, GapShare
from .hypotheses import ColumnBuilder
from .naming import ForceSearch
from .trial import SeenTrial
from .view import TrialMotion, View

WINDOWS = 12
"""Largest number of blocks into which a trial is divided."""
SHORTEST = 8
"""Least number of samples of a block."""
WITHIN = 2.0
"""Bound of the shared unknowns, in prior standard deviations, when the missing force is estimated
without any effect."""
TESTED = 0.1
"""Ratio of the mean square force of a law to that of the missing force from which on the trials
test the law."""
ROUNDS = 3
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
        self._held_out: tuple[ColumnBuilder, View] | None = None
        self._without_effect: dict[bool, tuple[View, list[TrialMotion]]] = {}
        if held_out:
            problem = search.problem.with_trials(held_out)
            numbers = range(len(problem.trials))
            local = problem.start(search.whole.candidate).local
            point = Point(search.point.shared, local, np.zeros(0))
            columns = ColumnBuilder(problem, numbers, point, search.laws)
            self._held_out = (columns, columns.bare())

    @property
    def has_held_out(self) -> bool:
        """Whether some of the trials in motion are held out."""
        return self._held_out is not None

    def share_of(self, hypothesis: ForceHypothesis, *, held_out: bool) -> GapShare:
        """Return the share of the missing force that a hypothesis explains.

        Two shares are computed: that of the forces, and that of the changes of the readings by
        these forces. The one with the larger lower end of its interval is returned, as each may
        miss a part: fast forces hardly move a free mass, and slow forces are small compared with
        fast ones.

        Parameters
        ----------
        hypothesis : ForceHypothesis
            The hypothesis.
        held_out : bool
            Whether the share is that of held-out trials, not of the fitted ones.
        """
        view, motions = self.motions(hypothesis, held_out=held_out)
        _, motions_without = self._motions_without_effect(held_out)
        law_ports = self._law_ports(hypothesis)
        ports = law_ports or set(self.search.best().processes)
        remaining_rms = _largest_rms([motion.left for motion in motions], ports)
        total_rms = _largest_rms([motion.forces for motion in motions_without], ports)
        law_rms = _largest_rms([motion.laws for motion in motions], ports)
        # in trials where the force of the law is small, its share says nothing about it
        tested = not law_ports or law_rms**2 > TESTED * total_rms**2
        of_forces, of_predictions = self._block_sums(hypothesis, view, motions, motions_without)
        shares = []
        for block_sums, kind in ((of_forces, OF_FORCE), (of_predictions, OF_PREDICTIONS)):
            before, after, noise = np.array(block_sums).T
            share = GapShare(
                before=before,
                after=after,
                noise=noise,
                held_out=held_out,
                trial_count=len(motions),
                remaining_rms=remaining_rms,
                total_rms=total_rms,
                kind=kind,
                tested=tested,
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
        view: View,
        motions: Sequence[TrialMotion],
        motions_without: Sequence[TrialMotion],
    ) -> tuple[list[_BlockSums], list[_BlockSums]]:
        """Return the sums of squares of forces and of the changes of readings, by block.

        Forces at different ports are weighted by how strongly they act on state and readings.

        Parameters
        ----------
        hypothesis : ForceHypothesis
            The hypothesis.
        view : View
            The trials.
        motions, motions_without : sequence of TrialMotion
            The motion of each trial with the hypothesis, and without any effect.

        Returns
        -------
        of_forces, of_predictions : list of _BlockSums
            The sums of each block of all trials: of weighted forces, and of changes of readings
            divided by their noise.
        """
        system = view.trials[0].system
        weights = {}
        for port in motions[0].left:
            strength_on_state = np.linalg.norm(system.actions[port])
            strength_on_readings = np.linalg.norm(system.through[port])
            weights[port] = float(np.hypot(strength_on_state, strength_on_readings))
        of_forces = []
        of_predictions = []
        filters = view.filtered({**hypothesis.processes, **self.search.whole.processes})
        for trial, motion, motion_without, force_filter in zip(
            view.trials, motions, motions_without, filters, strict=True
        ):
            # the missing forces that are estimated from noise alone
            smoothed = force_filter.smoothed(_simulated_noise(trial))
            noise_forces = {}
            for (port, _), force in zip(force_filter.processes, smoothed.forces, strict=True):
                noise_forces[port] = force
            # in the order of `_BlockSums`: without a law, with the law, and of noise alone
            forces_of_kinds: tuple[PortForces, ...] = (
                motion_without.forces,
                motion.left,
                noise_forces,
            )
            for begin, end in _blocks(len(trial.time)):
                samples = slice(begin * trial.parts, end * trial.parts, trial.parts)
                force_sums = [
                    _weighted_squares(forces, weights, samples) for forces in forces_of_kinds
                ]
                of_forces.append(_BlockSums(*force_sums))
                prediction_sums = [
                    float(np.sum(trial.ahead(forces, begin, end) ** 2))
                    for forces in forces_of_kinds
                ]
                of_predictions.append(_BlockSums(*prediction_sums))
        return of_forces, of_predictions

    def _motions_without_effect(self, held_out: bool) -> tuple[View, list[TrialMotion]]:
        """Return the view of the trials, and motion and missing force of each without any effect.

        Shared unknowns are kept within `WITHIN` prior deviations, as they would otherwise explain a
        part of the missing force.
        """
        if held_out not in self._without_effect:
            whole = self.search.whole
            # an unknown without a prior has no bound
            bound = np.where(whole.view.shared_precision > 0.0, WITHIN, np.inf)
            mean = np.clip(whole.solution.mean, -bound, bound)
            bounded = replace(whole, solution=replace(whole.solution, mean=mean))
            self._without_effect[held_out] = self.motions(bounded, held_out=held_out)
        return self._without_effect[held_out]

    def motions(
        self, hypothesis: ForceHypothesis, *, held_out: bool
    ) -> tuple[View, list[TrialMotion]]:
        """Return the view of the trials, and motion and remaining force of each with a hypothesis.

        The remaining force has the size of the force that is missing without any effect, so that it
        can take up all that the hypothesis does not explain.

        Parameters
        ----------
        hypothesis : ForceHypothesis
            The hypothesis.
        held_out : bool
            Whether the trials are the held-out ones, not those fitted.
        """
        processes = {**hypothesis.processes, **self.search.whole.processes}
        if not held_out:
            _, _, motions = hypothesis.view.smoothed(processes, hypothesis.solution)
            return hypothesis.view, motions
        assert self._held_out is not None
        builder, view = self._held_out
        solution = replace(hypothesis.solution, mean=hypothesis.shared)
        _, _, motions = view.smoothed(processes, solution)
        for _ in range(ROUNDS):
            effects_column = None
            if len(hypothesis.effect):
                effects_column = builder.of(view, motions, hypothesis.candidate, hypothesis.effect)
            view = builder.along(view, motions, effects_column)
            _, _, motions = view.smoothed(processes, solution)
        return view, motions


def _blocks(sample_count: int) -> Iterable[tuple[int, int]]:
    """Return start and end of each block of a trial, as indices of samples."""
    count = min(WINDOWS, max(1, sample_count // SHORTEST))
    edges = np.linspace(0, sample_count, count + 1).astype(int)
    return pairwise(edges.tolist())


def _weighted_squares(forces: PortForces, weights: Mapping[int, float], samples: slice) -> float:
    """Return the sum of squares of forces over samples, each multiplied by the weight of its port.

    Parameters
    ----------
    forces : mapping of int to (F,) array
        The forces at the fine stamps, by the number of the port.
    weights : mapping of int to float
        The weight of each port.
    samples : slice
        The fine stamps of the samples.
    """
    sums = [np.sum((weights[port] * force[samples]) ** 2) for port, force in forces.items()]
    return float(sum(sums))


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


def _simulated_noise(trial: SeenTrial) -> FloatArray:
    """Return simulated noise (N, C) of a trial with its correlation, divided by its deviation.

    The seed is fixed, so that results can be repeated.
    """
    generator = np.random.default_rng(SEED)
    noise = generator.standard_normal(trial.residual.shape)
    for channel, coloured_share, rate in trial.coloured:
        # an autoregression of first order at the trial's stamps
        decay = np.exp(-rate * np.diff(trial.time, prepend=-np.inf))
        correlated_noise = np.zeros(len(noise))
        for k, innovation in enumerate(generator.standard_normal(len(noise))):
            correlated_noise[k] = (
                decay[k] * correlated_noise[k - 1] + np.sqrt(1.0 - decay[k] ** 2) * innovation
            )
        white_noise = np.sqrt(1.0 - coloured_share) * noise[:, channel]
        noise[:, channel] = white_noise + np.sqrt(coloured_share) * correlated_noise
    return np.asarray(noise * trial.used)
