"""The missing force that a verdict is about.

Where it is, how large, and what share of it a law explains.

Shares are of the trials that were fitted, or of those that were held out.
"""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Point
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.verdict import ForceAtPort, ForceLeft, ForceMoment

from .explained import ForceHypothesis
from .hypotheses import ColumnBuilder, scaled, sees_forces
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
OF_FORCE = "the missing force"
OF_PREDICTIONS = "what the missing force does to predictions"
OF_READINGS = "the gap"
DRAWS = 2000
"""Draws of the bootstrap."""
SEED = 0
"""Seed of the bootstrap, and of the noise that is simulated."""
UNSEEN_ERRORS = (DiscrepancyError, np.linalg.LinAlgError, ValueError)
"""Errors by which a missing force cannot be seen; what it would show is left out then."""
ROUNDS = 3
"""Times that the motion of a held-out trial is smoothed along the law that acts along it."""
BINS = 24
"""Largest number of bins of a variable that may order a force."""
LEAST_IN_BIN = 4
"""Least number of samples in a bin."""
LEAST_ORDER = 0.3
"""Least share of the force's variance that a variable must explain to order it."""
ALIKE = 0.05
"""Difference of such shares up to which two variables order a force alike."""


# ---------------------------------------------------------------- shares of the gap


@dataclass(frozen=True, eq=False)
class GapShare:
    """A share of the gap that a hypothesis explains: 1 - mean square after over mean square before.

    Attributes
    ----------
    before, after : (B,) array
        The sums of squares of each block without and with the hypothesis.
    noise : (B,) array
        The part of these sums that the noise of the readings alone makes.
    held_out : bool
        Whether the trials were held out.
    trial_count : int
        The number of trials.
    remaining_rms, total_rms : float
        The rms of the force at the port of the law (or where most is missing), beside the law and
        without it [N, N m or the port's flow]; or of the gap between readings and simulation.
    kind : str
        What it is a share of: of the forces, weighted by what they do to the state; of what they do
        to the readings over a block, from its begin (the error of predictions); or of the gap
        between readings and simulation.
    tested : bool
        Whether the law has a force in these trials that could be seen.
    """

    before: FloatArray
    after: FloatArray
    noise: FloatArray
    held_out: bool
    trial_count: int
    remaining_rms: float
    total_rms: float
    kind: str
    tested: bool

    @property
    def value(self) -> float:
        """The share."""
        return float(_share_of(self.before.sum(), self.after.sum(), self.noise.sum()))

    def bootstrap_draws(self) -> FloatArray:
        """Return the share (DRAWS,) at draws of blocks with replacement.

        A block bootstrap (Kuensch 1989, Ann. Statist. 17, 1217-1241); all shares draw the same
        blocks.
        """
        count = len(self.before)
        generator = np.random.default_rng(SEED)
        times_drawn = generator.multinomial(count, np.full(count, 1.0 / count), DRAWS)
        return _share_of(
            times_drawn @ self.before, times_drawn @ self.after, times_drawn @ self.noise
        )

    def is_larger_than(self, other: "GapShare") -> bool:
        """Return whether this share is larger than another one beyond chance (5 %)."""
        difference = self.bootstrap_draws() - other.bootstrap_draws()
        return bool(np.quantile(difference, 0.05) > 0.0)

    @property
    def interval(self) -> tuple[float, float]:
        """The ends of the 90 % interval of the share."""
        low, high = np.quantile(self.bootstrap_draws(), (0.05, 0.95))
        return float(low), float(high)


def _share_of(before: FloatArray, after: FloatArray, noise: FloatArray) -> FloatArray:
    """Return 1 - (after - noise) / (before - noise), and 0 where nothing is missing."""
    gap = before - noise
    remaining = np.divide(
        np.maximum(after - noise, 0.0), gap, out=np.ones_like(gap), where=gap > 0.0
    )
    return 1.0 - remaining


# ---------------------------------------------------------------- shares of the missing force

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


# ---------------------------------------------------------------- what orders a force


def explained_variance(variable: FloatArray, force: FloatArray) -> float:
    """Return the share of a force's variance that its mean at like values of a variable explains.

    Parameters
    ----------
    variable, force : (N,) array
        The variable and the force at the same times.
    """
    count = len(force)
    bins = min(BINS, count // LEAST_IN_BIN)
    if bins < 2 or not np.ptp(variable) > 0.0:
        return 0.0
    order = np.argsort(variable, kind="stable")
    sums = [float(np.sum((part - part.mean()) ** 2)) for part in np.array_split(force[order], bins)]
    variance_within = sum(sums) / (count - bins)
    variance = max(float(np.var(force, ddof=1)), 1e-300)
    return max(1.0 - variance_within / variance, 0.0)


def ordering_variables(
    force: FloatArray, position: FloatArray, speed: FloatArray, time: FloatArray
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return which variables order a force.

    Parameters
    ----------
    force, position, speed, time : (N,) array
        The force, the motion of its port, and the time.

    Returns
    -------
    shares : dict of str to float
        The share of the force's variance that each variable explains.
    ordered_by : tuple of str
        The variables that order it, as well as the best one does.
    """
    scaled_position = position / max(float(np.std(position)), 1e-300)
    scaled_speed = speed / max(float(np.std(speed)), 1e-300)
    amplitude = np.hypot(scaled_position, scaled_speed)
    shares = {
        "displacement": explained_variance(position, force),
        "velocity": explained_variance(speed, force),
        "amplitude": explained_variance(amplitude, np.abs(force)),
        "time": explained_variance(time, force),
    }
    least = max(LEAST_ORDER, max(shares.values()) - ALIKE)
    return shares, tuple(name for name, share in shares.items() if share >= least)


# ---------------------------------------------------------------- the missing force at a port

GROUND = 3.0
"""Evidence over no missing force at all from which on there is one [nat]."""


@dataclass(frozen=True, eq=False)
class ForceCourse:
    """The missing force in a trial, at its samples.

    Attributes
    ----------
    trial : str
        The name of the trial.
    time : (N,) array
        The stamps [s].
    position, speed : (N,) array
        The motion of the port; at a port of a state the speed is the state.
    force, deviation : (N,) array
        The smoothed force, and its standard deviation.
    law : (N,) array or None
        The force of the named effect along the same motion.
    """

    trial: str
    time: FloatArray
    position: FloatArray
    speed: FloatArray
    force: FloatArray
    deviation: FloatArray
    law: FloatArray | None

    @property
    def left(self) -> FloatArray:
        """The missing force (N,) beside the law."""
        return self.force if self.law is None else self.force - self.law


@dataclass(frozen=True, eq=False)
class MissingForce:
    """The missing force at a port.

    Attributes
    ----------
    at_port : ForceAtPort
        What a verdict says of it.
    courses : sequence of ForceCourse
        The force in each fitted trial.
    law : str
        The name of the effect at the port that is drawn through it; empty if there is none.
    """

    at_port: ForceAtPort
    courses: Sequence[ForceCourse]
    law: str = ""


def missing_force(search: ForceSearch, hypothesis: ForceHypothesis) -> MissingForce | None:
    """Return the missing force that a hypothesis is about; None where no force is missing at all.

    It is that at the port of its law, or else at the port with the most evidence. The law is drawn
    through it if it acts at one port. The share that the law explains is not computed.
    """
    evidence_of_none = max(evidence_without_force(at_port) for at_port in search.at.values())
    evidence = {}
    for name, at_port in search.at.items():
        evidence[name] = at_port.log_evidence - evidence_of_none
    if max(evidence.values()) < GROUND:
        return None
    terms = hypothesis.candidate.terms
    law_ports = {term.place for term in terms if term.place in search.ports}
    if len(law_ports) == 1:
        (port,) = law_ports
    else:
        port = max(evidence, key=lambda name: evidence[name])
    number = search.ports.index(port)
    if number not in hypothesis.processes:
        hypothesis = search.at[port]
    law = " and ".join(
        term.effect.name for term in hypothesis.candidate.terms if term.place == port
    )
    courses = _force_courses(hypothesis, number, has_law=bool(law))
    unit, *_ = search.problem.model.port_units(port)
    correlation_time = hypothesis.processes[number].time
    force = _force_at_port(courses, port, unit, evidence, correlation_time, law)
    return MissingForce(force, courses, law)


def _force_courses(hypothesis: ForceHypothesis, port: int, *, has_law: bool) -> list[ForceCourse]:
    """Return the missing force at a port, by its number, in each trial."""
    courses = []
    for trial, motion in zip(hypothesis.view.trials, hypothesis.motions, strict=True):
        samples = slice(None, None, trial.parts)
        force = motion.forces[port][samples]
        law = force - motion.left[port][samples] if has_law else None
        force_deviation, _ = motion.deviations[port]
        courses.append(
            ForceCourse(
                trial=trial.name,
                time=trial.time,
                position=motion.positions[samples, port],
                speed=motion.speeds[samples, port],
                force=force,
                deviation=force_deviation,
                law=law,
            )
        )
    return courses


def _force_at_port(
    courses: Sequence[ForceCourse],
    port: str,
    unit: str,
    evidence: Mapping[str, float],
    correlation_time: float,
    law: str,
) -> ForceAtPort:
    """Return what a verdict says of the missing force at a port.

    Parameters
    ----------
    courses : sequence of ForceCourse
        The force in each trial.
    port, unit : str
        The name of the port, and the unit of its force.
    evidence : mapping of str to float
        The evidence of a missing force over none, by port [nat].
    correlation_time : float
        The correlation time of the force [s].
    law : str
        The name of the law that is drawn through it.
    """
    force = np.concatenate([course.force for course in courses])
    position = np.concatenate([course.position for course in courses])
    speed = np.concatenate([course.speed for course in courses])
    time = np.concatenate([course.time for course in courses])
    shares, ordered_by = ordering_variables(force, position, speed, time)
    # where the force is largest
    course = max(courses, key=lambda course: float(np.abs(course.force).max()))
    k = int(np.abs(course.force).argmax())
    largest = ForceMoment(
        trial=course.trial,
        time=float(course.time[k]),
        force=float(course.force[k]),
        displacement=float(course.position[k]),
        speed=float(course.speed[k]),
    )
    return ForceAtPort(
        port=port,
        unit=unit,
        rms=_rms(force),
        displacement=_rms(position),
        speed=_rms(speed),
        largest=largest,
        evidence=evidence,
        correlation_time=correlation_time,
        orders=shares,
        ordered_by=ordered_by,
        law=law,
    )


def evidence_without_force(hypothesis: ForceHypothesis) -> float:
    """Return the log evidence of a hypothesis without any missing force [nat]."""
    return hypothesis.view.solve(scaled(hypothesis.processes, 1e-9, 1.0)).evidence


def seen_force(
    problem: Problem,
    search: ForceSearch | None,
    hypotheses: Sequence[ForceHypothesis],
    fit: CandidateFit,
) -> MissingForce | None:
    """Return the missing force beside the fit of a verdict, with the share that its law explains.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    search : ForceSearch or None
        The search for the missing force, if there was one.
    hypotheses : sequence of ForceHypothesis
        The hypotheses that were fitted to the missing force.
    fit : CandidateFit
        The fit that stands for the verdict.

    Returns
    -------
    MissingForce or None
        None where no force can be seen.
    """
    terms = fit.candidate.terms
    try:
        ports = problem.model.ports
        has_law = any(term.place in ports for term in terms)
        if not sees_forces(problem) or (terms and not has_law):
            return None
        search = search or ForceSearch(problem)
        hypothesis = next(
            (known for known in hypotheses if known.candidate.key == fit.candidate.key), None
        )
        if hypothesis is None and terms:
            hypothesis = search.followed(search.whole, fit.candidate, fit.point.effect)
        missing = missing_force(search, search.whole if hypothesis is None else hypothesis)
    except UNSEEN_ERRORS:
        return None
    if missing is None or not missing.law or hypothesis is None:
        return missing
    at_port = missing.at_port
    laws = [(term.effect.name, term.place) for term in terms if term.place in ports]
    if len({place for _, place in laws}) > 1:
        at_port = replace(at_port, law=" and ".join(f"{name} at {place}" for name, place in laws))
    with suppress(*UNSEEN_ERRORS):
        shares = ForceShares(search)
        held_out = None
        if shares.has_held_out:
            held_out = _force_left(shares.share_of(hypothesis, held_out=True))
        fitted = _force_left(shares.share_of(hypothesis, held_out=False))
        at_port = replace(at_port, fitted=fitted, held_out=held_out)
    return replace(missing, at_port=at_port)


def _force_left(share: GapShare) -> ForceLeft:
    """Return what a law leaves of the missing force, as the verdict has it."""
    return ForceLeft(
        share.remaining_rms, share.total_rms, trials=share.trial_count, tested=share.tested
    )
