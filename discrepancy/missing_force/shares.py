"""The share of the missing force that a law explains, in fitted or in held-out trials."""

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
"""Largest number of blocks into which a trial is cut."""
SHORTEST = 8
"""Least number of samples of a block."""
WITHIN = 2.0
"""Prior deviations within which parameters stay where the missing force without any effect is
estimated."""
TESTED = 0.1
"""Share of the missing force from which on the force of a law is large enough to be tested."""
ROUNDS = 3
"""Times that the motion of a held-out trial is smoothed along the law that acts along it."""


PortForces = Mapping[int, FloatArray]
"""Forces (F,) at ports of a trial, by the number of the port."""


class _BlockSums(NamedTuple):
    """Sums of squares over a block of a trial: without a law, beside it, and of noise alone."""

    before: float
    after: float
    noise: float


class ForceShares:
    """Shares of the missing force that hypotheses explain.

    Parameters
    ----------
    search : ForceSearch
        The search for the missing force whose hypotheses they are.
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
        """Whether there are trials in motion that were held out."""
        return self._held_out is not None

    def share_of(self, hypothesis: ForceHypothesis, *, held_out: bool) -> GapShare:
        """Return the share of the missing force that a hypothesis explains.

        It is the larger one of the share of the forces and that of what they do to predictions:
        fast forces hardly move a free mass, and slow ones are small beside them.

        Parameters
        ----------
        hypothesis : ForceHypothesis
            The hypothesis.
        held_out : bool
            Whether the share is of the trials held out, or of those fitted.
        """
        view, motions = self.motions(hypothesis, held_out=held_out)
        _, motions_without = self._motions_without_effect(held_out)
        law_ports = self._law_ports(hypothesis)
        ports = law_ports or set(self.search.best().processes)
        remaining_rms = _largest_rms([motion.left for motion in motions], ports)
        total_rms = _largest_rms([motion.forces for motion in motions_without], ports)
        law_rms = _largest_rms([motion.laws for motion in motions], ports)
        tested = not law_ports or law_rms**2 > TESTED * total_rms**2
        of_forces, of_predictions = self._block_sums(hypothesis, view, motions, motions_without)
        shares = []
        for blocks, kind in ((of_forces, OF_FORCE), (of_predictions, OF_PREDICTIONS)):
            before, after, noise = np.array(blocks).T
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
        """Return the sums of squares of forces, and of what they do to predictions, by block.

        Forces at different ports are weighted by how much they move the state and the readings.

        Parameters
        ----------
        hypothesis : ForceHypothesis
            The hypothesis.
        view : View
            The trials.
        motions, motions_without : sequence of TrialMotion
            The motion of each trial beside the hypothesis, and without any effect.
        """
        system = view.trials[0].system
        weights = {}
        for port in motions[0].left:
            by_state = np.linalg.norm(system.actions[port])
            by_readings = np.linalg.norm(system.through[port])
            weights[port] = float(np.hypot(by_state, by_readings))
        of_forces = []
        of_predictions = []
        filters = view.filtered({**hypothesis.processes, **self.search.whole.processes})
        for trial, motion, without, force_filter in zip(
            view.trials, motions, motions_without, filters, strict=True
        ):
            # the forces that noise alone would show
            smoothed = force_filter.smoothed(_simulated_noise(trial))
            noise_forces = {}
            for (port, _), force in zip(force_filter.processes, smoothed.forces, strict=True):
                noise_forces[port] = force
            kinds: tuple[PortForces, ...] = (without.forces, motion.left, noise_forces)
            for begin, end in _blocks(len(trial.time)):
                samples = slice(begin * trial.parts, end * trial.parts, trial.parts)
                force_sums = [_weighted_squares(forces, weights, samples) for forces in kinds]
                of_forces.append(_BlockSums(*force_sums))
                prediction_sums = [
                    float(np.sum(trial.ahead(forces, begin, end) ** 2)) for forces in kinds
                ]
                of_predictions.append(_BlockSums(*prediction_sums))
        return of_forces, of_predictions

    def _motions_without_effect(self, held_out: bool) -> tuple[View, list[TrialMotion]]:
        """Return motion and missing force without any effect.

        Parameters are kept within twice their priors, since they would take up a part of the force.
        """
        if held_out not in self._without_effect:
            whole = self.search.whole
            bound = np.where(whole.view.shared_precision > 0.0, WITHIN, np.inf)
            mean = np.clip(whole.solution.mean, -bound, bound)
            bounded = replace(whole, solution=replace(whole.solution, mean=mean))
            self._without_effect[held_out] = self.motions(bounded, held_out=held_out)
        return self._without_effect[held_out]

    def motions(
        self, hypothesis: ForceHypothesis, *, held_out: bool
    ) -> tuple[View, list[TrialMotion]]:
        """Return motion and missing force of each trial beside a hypothesis, and their view.

        The force beside the hypothesis has the size that is missing without any effect, so that it
        takes up all that it can.
        """
        processes = {**hypothesis.processes, **self.search.whole.processes}
        if not held_out:
            _, _, motions = hypothesis.view.smoothed(processes, hypothesis.solution)
            return hypothesis.view, motions
        assert self._held_out is not None
        columns, view = self._held_out
        solution = replace(hypothesis.solution, mean=hypothesis.shared)
        _, _, motions = view.smoothed(processes, solution)
        for _ in range(ROUNDS):
            known = None
            if len(hypothesis.effect):
                known = columns.of(view, motions, hypothesis.candidate, hypothesis.effect)
            view = columns.along(view, motions, known)
            _, _, motions = view.smoothed(processes, solution)
        return view, motions


def _blocks(sample_count: int) -> Iterable[tuple[int, int]]:
    """Return begin and end of each block of a trial."""
    count = min(WINDOWS, max(1, sample_count // SHORTEST))
    edges = np.linspace(0, sample_count, count + 1).astype(int)
    return pairwise(edges.tolist())


def _weighted_squares(forces: PortForces, weights: Mapping[int, float], samples: slice) -> float:
    """Return the sum of squares of forces over samples, each weighted by its port."""
    sums = [np.sum((weights[port] * force[samples]) ** 2) for port, force in forces.items()]
    return float(sum(sums))


def _largest_rms(forces_by_trial: Sequence[PortForces], ports: Iterable[int]) -> float:
    """Return the largest rms of the forces at some ports, over all trials."""
    sizes = []
    for port in ports:
        forces = [trial_forces[port] for trial_forces in forces_by_trial if port in trial_forces]
        sizes.append(_rms(np.concatenate(forces)) if forces else 0.0)
    return max(sizes)


def _rms(values: FloatArray) -> float:
    """Return the root mean square of values (N,)."""
    return float(np.sqrt(np.mean(values**2)))


def _simulated_noise(trial: SeenTrial) -> FloatArray:
    """Return simulated noise (N, C) over its deviation, with the colour of the trial's noise."""
    generator = np.random.default_rng(SEED)
    noise = generator.standard_normal(trial.residual.shape)
    for channel, coloured_share, rate in trial.coloured:
        # an autoregression of first order at the trial's stamps
        remaining = np.exp(-rate * np.diff(trial.time, prepend=-np.inf))
        slow = np.zeros(len(noise))
        for k, innovation in enumerate(generator.standard_normal(len(noise))):
            slow[k] = remaining[k] * slow[k - 1] + np.sqrt(1.0 - remaining[k] ** 2) * innovation
        white = np.sqrt(1.0 - coloured_share) * noise[:, channel]
        noise[:, channel] = white + np.sqrt(coloured_share) * slow
    return np.asarray(noise * trial.used)
