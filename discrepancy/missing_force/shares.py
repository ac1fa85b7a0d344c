"""The force that a verdict is about: where it is, how large, and what share of it a hypothesis is.

Shares are told of trials that were fitted, and of those that were not.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Point
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.verdict import ForceAtPort, ForceLeft, ForceMoment

from .explained import Explained
from .hypotheses import Columns, scaled, sees_forces
from .naming import ForceSearch
from .trial import SeenTrial
from .view import Motion, View

WINDOWS, SHORTEST = 12, 8
"""Blocks into which a trial is cut, and samples of a block at least."""
WITHIN = 2.0
"""Prior deviations within which parameters stay where the missing force without any effect is told."""
TESTED = 0.1
"""Share of the missing force from which on a law has one that these trials can test."""
OF_FORCE, OF_PREDICTIONS = "the missing force", "what the missing force does to predictions"
OF_READINGS = "the gap"
DRAWS, SEED = 2000, 0
CANNOT = (DiscrepancyError, np.linalg.LinAlgError, ValueError)
"""What keeps a picture or a share from being told: it is left out."""
TURNS = 3
"""Times that the motion of a trial that was not fitted is looked at along the law that it shows."""
BINS, LEAST_IN_BIN = 24, 4
LEAST_ORDER, ALIKE = 0.3, 0.05
"""Share of the force's variance from which a variable is said to order it, and by which others are alike."""


@dataclass(frozen=True, eq=False)
class Share:
    """A share of what is missing: 1 - mean square of what is left over mean square of all of it.

    Attributes
    ----------
    before, after, noise : (B,) ndarray
        Sums of squares by block, and what the noise of the readings alone makes of them.
    held_out : bool
        Whether of trials that were not fitted.
    trials : int
        How many.
    left, whole : float
        Root mean square of the force at the port of the law (or where most is missing) beside it, and of all
        of it [N, N m or the port's flow].
    of : str
        What it is a share of: of the forces, over what they do to the state, of what they do to readings over
        a block, from its begin (the error of predictions), or of the gap between readings and simulation.
    tested : bool
        Whether the law has a force there that could be seen.
    """

    before: FloatArray
    after: FloatArray
    noise: FloatArray
    held_out: bool
    trials: int
    left: float
    whole: float
    of: str
    tested: bool

    @property
    def value(self) -> float:
        """The share."""
        return float(_share(self.before.sum(), self.after.sum(), self.noise.sum()))

    def drawn(self) -> FloatArray:
        """Return the share at draws of blocks with replacement (Kuensch 1989, Ann. Statist. 17, 1217)."""
        count = len(self.before)
        times = np.random.default_rng(SEED).multinomial(count, np.full(count, 1.0 / count), DRAWS)
        return _share(times @ self.before, times @ self.after, times @ self.noise)

    def told_from(self, other: "Share") -> bool:
        """Whether this share is larger than that of another hypothesis beyond chance (5 %)."""
        return bool(np.quantile(self.drawn() - other.drawn(), 0.05) > 0.0)

    @property
    def interval(self) -> tuple[float, float]:
        """Ends of its 90 % interval."""
        low, high = np.quantile(self.drawn(), (0.05, 0.95))
        return float(low), float(high)


class ForceShares:
    """Shares of the missing force, by hypothesis.

    Parameters
    ----------
    search : ForceSearch
        Whose hypotheses they are.
    """

    def __init__(self, search: ForceSearch) -> None:
        self.search = search
        campaign = search.problem.campaign
        held = tuple(trial for trial in campaign.held_out if trial.is_dynamic)
        self._outside: tuple[Columns, View] | None = None
        self._bare: dict[bool, tuple[View, list[Motion]]] = {}
        if held:
            problem = search.problem.with_trials(held)
            numbers = range(len(problem.trials))
            point = Point(search.point.shared, problem.start(search.whole.candidate).local, np.zeros(0))
            columns = Columns(problem, numbers, point, search.laws)
            self._outside = columns, columns.bare()

    @property
    def has_held_out(self) -> bool:
        """Whether there are trials in motion that were not fitted."""
        return self._outside is not None

    def of(self, found: Explained, *, held_out: bool) -> Share:
        """Return the share that a hypothesis is, of trials that were fitted or of those held out.

        Of the forces, or of what they do to predictions, whichever tells more: fast forces hardly move a free
        mass, slow ones are little beside them.
        """
        view, motions = self.motions(found, held_out=held_out)
        without = self._without(held_out)[1]
        places, ports = [term.place for term in found.candidate.terms], self.search.ports
        laws = {ports.index(place) for place in places if place in ports}
        system = view.trials[0].system
        weight = {
            port: float(np.hypot(np.linalg.norm(system.actions[port]), np.linalg.norm(system.through[port])))
            for port in motions[0].left
        }
        of_force, of_readings = [], []
        filters = view.filtered({**found.processes, **self.search.whole.processes})
        for trial, motion, bare, one in zip(view.trials, motions, without, filters, strict=True):
            forces = one.smoothed(_noise(trial))[1]
            shown = {port: force for (port, _), force in zip(one.processes, forces, strict=True)}
            kinds = (bare.forces, motion.left, shown)
            count = len(trial.time)
            edges = np.linspace(0, count, min(WINDOWS, max(1, count // SHORTEST)) + 1).astype(int)
            for begin, end in pairwise(edges.tolist()):
                samples = slice(begin * trial.parts, end * trial.parts, trial.parts)
                squares = [[np.sum((weight[p] * f[samples]) ** 2) for p, f in of.items()] for of in kinds]
                of_force.append([float(sum(row)) for row in squares])
                of_readings.append([float(np.sum(trial.ahead(of, begin, end) ** 2)) for of in kinds])
        seen = ([m.left for m in motions], [m.forces for m in without], [m.laws for m in motions])
        port_of = laws or set(self.search.best().processes)
        left, whole, own = (max(_size([f[p] for f in kind if p in f]) for p in port_of) for kind in seen)
        tested, shares = not laws or own**2 > TESTED * whole**2, []
        for rows, of in ((of_force, OF_FORCE), (of_readings, OF_PREDICTIONS)):
            before, after, noise = np.array(rows).T
            sizes = (len(motions), left, whole)
            shares.append(Share(before, after, noise, held_out, *sizes, of, tested))
        return max(shares, key=lambda share: share.interval[0])

    def _without(self, held_out: bool) -> tuple[View, list[Motion]]:
        """Return motion and missing force without any effect, parameters being within twice their priors."""
        if held_out not in self._bare:
            found = self.search.whole
            bound = np.where(found.view.shared_precision > 0.0, WITHIN, np.inf)
            mean = np.clip(found.solution.mean, -bound, bound)
            bare = replace(found, solution=replace(found.solution, mean=mean))
            self._bare[held_out] = self.motions(bare, held_out=held_out)
        return self._bare[held_out]

    def motions(self, found: Explained, *, held_out: bool) -> tuple[View, list[Motion]]:
        """Return motion and missing force of each trial beside a hypothesis, and the view that shows them.

        What is left is a force of the size that is missing without any effect: it takes up all that it can.
        """
        wide = {**found.processes, **self.search.whole.processes}
        if not held_out:
            return found.view, found.view.smoothed(wide, found.solution)[2]
        assert self._outside is not None
        columns, view = self._outside
        solution = replace(found.solution, mean=found.shared)
        motions = view.smoothed(wide, solution)[2]
        for _ in range(TURNS):
            known = columns.of(view, motions, found.candidate, found.effect) if len(found.effect) else None
            view = columns.along(view, motions, known)
            motions = view.smoothed(wide, solution)[2]
        return view, motions


def _share(before: FloatArray, after: FloatArray, noise: FloatArray) -> FloatArray:
    """Return 1 - (after - noise) / (before - noise), nought where nothing is missing."""
    gap = before - noise
    left = np.ones_like(gap)
    return 1.0 - np.divide(np.maximum(after - noise, 0.0), gap, out=left, where=gap > 0.0)


def _noise(trial: SeenTrial) -> FloatArray:
    """Return readings (N, C) of noise alone, over its deviation."""
    generator = np.random.default_rng(SEED)
    found = generator.standard_normal(trial.residual.shape)
    for channel, share, rate in trial.coloured:
        kept = np.exp(-rate * np.diff(trial.time, prepend=-np.inf))
        slow = np.zeros(len(found))
        for k, fresh in enumerate(generator.standard_normal(len(found))):
            slow[k] = kept[k] * slow[k - 1] + np.sqrt(1.0 - kept[k] ** 2) * fresh
        found[:, channel] = np.sqrt(1.0 - share) * found[:, channel] + np.sqrt(share) * slow
    return np.asarray(found * trial.used)


def _size(forces: Sequence[FloatArray]) -> float:
    if not forces:
        return 0.0
    return float(np.sqrt(np.mean(np.concatenate(forces) ** 2)))


def order_of(variable: FloatArray, force: FloatArray) -> float:
    """Return the share of a force's variance that its mean at like values of a variable is, (N,) each."""
    count = len(force)
    bins = min(BINS, count // LEAST_IN_BIN)
    if bins < 2 or not np.ptp(variable) > 0.0:
        return 0.0
    parts = np.array_split(force[np.argsort(variable, kind="stable")], bins)
    within = sum(float(np.sum((part - part.mean()) ** 2)) for part in parts) / (count - bins)
    return max(1.0 - within / max(float(np.var(force, ddof=1)), 1e-300), 0.0)


def orders(
    force: FloatArray, position: FloatArray, speed: FloatArray, time: FloatArray
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return the share of a force's variance by variable, and the variables (F,) that order it, alike."""
    scaled = [values / max(float(np.std(values)), 1e-300) for values in (position, speed)]
    shares = {
        "displacement": order_of(position, force),
        "velocity": order_of(speed, force),
        "amplitude": order_of(np.hypot(*scaled), np.abs(force)),
        "time": order_of(time, force),
    }
    least = max(LEAST_ORDER, max(shares.values()) - ALIKE)
    return shares, tuple(name for name, share in shares.items() if share >= least)


GROUND = 3.0
"""Evidence over no missing force at all [nat] from which there is one."""


@dataclass(frozen=True, eq=False)
class ForceCourse:
    """The missing force in a trial, at its samples (N,).

    Attributes
    ----------
    trial : str
        Its name.
    time : (N,) ndarray
        [s].
    position, speed : (N,) ndarray
        Of the port; of a port of a state the speed is the state.
    force, deviation : (N,) ndarray
        Smoothed, with its standard deviation.
    law : (N,) ndarray or None
        What the named effect gives along the same motion.
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
    """What is missing at a port.

    Attributes
    ----------
    told : ForceAtPort
        What a verdict says of it.
    courses : sequence of ForceCourse
        Of the trials that were fitted.
    law : str
        Name of the effect at the port that is drawn through it; empty: none.
    """

    told: ForceAtPort
    courses: Sequence[ForceCourse]
    law: str = ""


def missing_force(search: ForceSearch, found: Explained) -> MissingForce | None:
    """Return the missing force that a hypothesis is about, None where no force is missing at all.

    It is that at the port of its law, or else at the one with the most evidence; the law is drawn through it
    if it acts at one port. The share that the law is of it is not told.
    """
    nothing = max(of_nothing(one) for one in search.at.values())
    evidence = {name: one.log_evidence - nothing for name, one in search.at.items()}
    if max(evidence.values()) < GROUND:
        return None
    laws = {term.place for term in found.candidate.terms if term.place in search.ports}
    port = laws.pop() if len(laws) == 1 else max(evidence, key=lambda name: evidence[name])
    at = search.ports.index(port)
    if at not in found.processes:
        found = search.at[port]
    named = " and ".join(term.name_in_words for term in found.candidate.terms if term.place == port)
    courses = []
    for trial, motion in zip(found.view.trials, found.motions, strict=True):
        samples = slice(None, None, trial.parts)
        position, speed = motion.positions[samples, at], motion.speeds[samples, at]
        force, left = motion.forces[at][samples], motion.left[at][samples]
        law = force - left if named else None
        deviation = motion.deviations[at][0]
        courses.append(ForceCourse(trial.name, trial.time, position, speed, force, deviation, law))
    whole = [
        np.concatenate([getattr(item, name) for item in courses])
        for name in ("force", "position", "speed", "time")
    ]
    by_variable, ordered_by = orders(*whole)
    rms, displacement, velocity = (float(np.sqrt(np.mean(item**2))) for item in whole[:3])
    course = max(courses, key=lambda one: float(np.abs(one.force).max()))
    k = int(np.abs(course.force).argmax())
    most = (float(item[k]) for item in (course.time, course.force, course.position, course.speed))
    told = ForceAtPort(
        port, search.problem.model.port_units(port)[0], rms, displacement, velocity,
        ForceMoment(course.trial, *most), evidence, found.processes[at].time, by_variable, ordered_by, named,
    )  # fmt: skip
    return MissingForce(told, courses, named)


def of_nothing(found: Explained) -> float:
    """Return the evidence [nat] without any missing force."""
    return found.view.solve(scaled(found.processes, 1e-9, 1.0)).evidence


def seen_force(
    problem: Problem, force: ForceSearch | None, forces: Sequence[Explained], fit: CandidateFit
) -> MissingForce | None:
    """Return the missing force beside the fit of a verdict, its law drawn through it, and its share told.

    None where no force can be seen. `force`, `forces`: the missing force and hypotheses along it, if a search
    had any.
    """
    terms = fit.candidate.terms
    try:
        ports = problem.model.ports
        if not sees_forces(problem) or (terms and not any(term.place in ports for term in terms)):
            return None
        force = force or ForceSearch(problem)
        found = next((item for item in forces if item.candidate.key == fit.candidate.key), None)
        if found is None and terms:
            found = force.followed(force.whole, fit.candidate, fit.point.effect)
        missing = missing_force(force, force.whole if found is None else found)
    except CANNOT:
        return None
    if missing is None or not missing.law or found is None:
        return missing
    told, laws = missing.told, [(term.name_in_words, term.place) for term in terms if term.place in ports]
    if len({place for _, place in laws}) > 1:
        told = replace(told, law=" and ".join(f"{name} at {place}" for name, place in laws))
    with suppress(*CANNOT):
        shares = ForceShares(force)
        outside = _told(shares.of(found, held_out=True)) if shares.has_held_out else None
        told = replace(told, fitted=_told(shares.of(found, held_out=False)), held_out=outside)
    return replace(missing, told=told)


def _told(share: Share) -> ForceLeft:
    return ForceLeft(share.left, share.whole, trials=share.trials, tested=share.tested)
