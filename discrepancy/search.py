"""The search for the set of effects that explains a campaign: screen, fit, add, take away, try pairs."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from math import ceil, comb, exp, inf, log

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from fe.patch import ModelPatch

from .candidate import Candidate, Term
from .catalogue.entry import Effect, EffectParameter, ShapeParameter
from .errors import FitError, ModelError
from .fitting import Fit, fit
from .gates import SHAPE_GAIN, absolute_gate
from .problem import Point, Problem, shortened
from .screening import Change, Screen, is_magnitude, rescaled

FloatArray = NDArray[np.float64]

PRIOR_NONE = 0.5
SET_SHARES = (0.97, 0.029, 0.001)
"""How the rest of the prior is shared among sets of one, two and three effects."""
LARGEST_SET = len(SET_SHARES)
STARTS, FAR_STARTS = 2, 3
"""Starts of the fit of each effect, close to the truth and far from it."""
CHORD_STEPS = 8
CLOSE = 12.0
"""Candidates within this log evidence of the best are fitted exactly [nat]."""
EXACT_FITS = 4
WORTH_FITTING = 2.0
"""Screened gain below which an effect is not fitted at all: it could not win a name [nat]."""
WORTH_ADDING = 4.0
"""The same for one more effect, whose prior is smaller."""
OUT_OF_REACH = 3.0 * CLOSE
"""Chord steps end where they have no prospect to come within this of the best [nat]."""
PROMISING, LEAST_PROMISING = 0.3, 5
"""Far from the truth, effects are fitted whose screened gain is at least this share of the best one's, and at
least so many; the others too if none of these fits."""
PAIRS_FITTED = 8
RIDGES, RIDGE_STEPS, PLACE_STEPS = 2, (-0.8, -0.3, 0.3, 0.8), (-0.15, -0.05, 0.05, 0.15)
"""Candidates that do not fit whose neighbourhood is searched; steps along the ridge of the least-known
direction, and of parameters that are not mere sizes, in prior deviations."""
NEIGHBOUR_ITERATIONS, NEIGHBOUR_GAIN = 8, 1.0
"""Steps of each of these fits, and the gain [nat] that counts."""
SOLVER_SHARE, FINEST = 0.1, 8
"""Largest share of the noise that the time steps may cost (rms over a channel of a trial), and how much
smaller than the model's own they may become for it."""
REFITTED = 3
"""Candidates that are fitted again with smaller steps."""
FEW_PLACES = 3
"""Effects with more places than this are those of single channels, which are linear in their size."""
DELIVERED = 0.7
"""Share of the screened gain that chord steps must reach."""
FAR = 1.5
"""Chi-square per sample above which a fit is far from the truth."""
STRAINED = 4.0
"""Prior deviations beyond which a shared unknown says the same."""
BEGINNING, LEAST_SAMPLES = 4.0, 60
"""The beginning of a record: this many periods of the first mode, at least that many samples."""
SHORT_STEPS, FAR_STEPS = 12, 6
"""Steps on the beginnings, and then on whole records, before candidates are compared."""
FAR_FITS, FAR_EXTENSIONS = 6, 4
"""Candidates that go on from the beginnings to whole records: single effects, and longer sets."""

Key = tuple[tuple[str, str], ...]


def key_of(candidate: Candidate) -> Key:
    """Return what tells candidates apart: sorted (identifier, place)."""
    return tuple(sorted((term.label, term.place) for term in candidate.terms))


@dataclass
class Search:
    """All candidates fitted so far.

    Attributes
    ----------
    problem : Problem
        Campaign and model.
    effects : tuple of Effect
        Those that can act here.
    none : Fit
        Without effect.
    exact : dict of Key to Fit
        Fitted to convergence.
    rough : dict of Key to Fit
        Fitted by few steps only; their evidence is approximate.
    beginnings : Problem or None
        The problem with the beginnings of its records, once it was needed.
    """

    problem: Problem
    effects: tuple[Effect, ...]
    none: Fit
    exact: dict[Key, Fit] = field(default_factory=dict)
    rough: dict[Key, Fit] = field(default_factory=dict)
    beginnings: Problem | None = None

    def __post_init__(self) -> None:
        self.exact[()] = self.none

    # ---------------------------------------------------------------- probabilities

    def log_prior(self, candidate: Candidate) -> float:
        """Return ln of the prior probability of a candidate at its places.

        A free shape has to gain what the shape gate asks for.
        """
        count = len(candidate.terms)
        if count == 0:
            return log(PRIOR_NONE)
        sets = comb(len(self.effects), count)
        places = sum(log(self._places(term.effect)) for term in candidate.terms)
        free = sum(SHAPE_GAIN for term in candidate.terms if term.free_shape)
        return log((1.0 - PRIOR_NONE) * SET_SHARES[count - 1] / sets) - places - free

    def _places(self, effect: Effect) -> int:
        return len(effect.places(self.problem.setting))

    def score(self, found: Fit) -> float:
        """Return ln (evidence times prior), up to a constant."""
        return found.log_evidence + self.log_prior(found.candidate)

    def all(self) -> dict[Key, Fit]:
        """Return every candidate, the exact fit where there is one."""
        return {**self.rough, **self.exact}

    def best(self) -> Fit:
        """Return the most probable candidate."""
        return max(self.exact.values(), key=self.score)

    def set_probabilities(self) -> dict[tuple[str, ...], float]:
        """Return the probability of each set of identifiers, places summed, most probable first."""
        scores: dict[tuple[str, ...], list[float]] = {}
        for found in self.all().values():
            scores.setdefault(found.candidate.identifiers, []).append(self.score(found))
        sums = {identifiers: float(logsumexp(values)) for identifiers, values in scores.items()}
        total = float(logsumexp(list(sums.values())))
        ordered = sorted(sums.items(), key=lambda item: -item[1])
        return {identifiers: exp(value - total) for identifiers, value in ordered}

    # ---------------------------------------------------------------- fits

    def keep(self, found: Fit, *, exact: bool) -> None:
        """Keep a fit if it is better than what is known of the same candidate."""
        kept = self.exact if exact else self.rough
        key = key_of(found.candidate)
        if key not in kept or kept[key].log_evidence < found.log_evidence:
            kept[key] = found

    def screened(self, base: Fit, effects: Iterable[Effect]) -> dict[str, list[Change]]:
        """Return for each effect its most promising changes, best first, at different places or values."""
        screen = Screen(self.problem, base)
        return {effect.identifier: self._starts(screen, effect) for effect in effects}

    def _starts(self, screen: Screen, effect: Effect, count: int = STARTS) -> list[Change]:
        """Return the most promising changes of an effect; more of them where its place is a parameter."""
        if sum(not item.magnitude for item in effect.parameters) > 1:
            count *= 3
        found: list[Change] = []
        places = effect.places(self.problem.setting)
        for place in places:
            best: list[Change] = []
            for change in screen.changes(Term(effect, place), fine=len(places) <= FEW_PLACES):
                if change.size > 0.0:
                    best = sorted([*best, change], key=_worth)[:count]
            found.extend(best)
        return sorted(found, key=_worth)[:count]

    def scan(self, base: Fit, effects: Iterable[Effect]) -> list[Fit]:
        """Fit every effect roughly in addition to those of `base`; return the best of each, best first.

        Close to the truth one linearisation serves all (chord steps). Far from it phases slip over a long
        record, so that the beginnings of the records are fitted first, and the whole ones from there.
        """
        effects = tuple(effects)
        found = [] if self._misfits(base) else self._scan_near(base, effects)
        if self._far(base) and not any(absolute_gate(self.problem, item).passed for item in found):
            found += self._scan_far(base, effects)
        best: dict[tuple[str, ...], Fit] = {}
        for item in sorted(found, key=self.score):
            self.keep(item, exact=False)
            best[item.candidate.identifiers] = item
        return sorted(best.values(), key=lambda item: -self.score(item))

    def _far(self, base: Fit) -> bool:
        """Whether a fit is far from the truth: much is left, or what is shared had to leave its prior."""
        strain = np.abs(base.point.shared[self.problem.shared.precision > 0.0])
        return self._misfits(base) or bool(strain.max(initial=0.0) > STRAINED)

    def _misfits(self, base: Fit) -> bool:
        """Whether much is left by a fit."""
        return base.chi_square > FAR * float(self.problem.counts.sum())

    def _scan_near(self, base: Fit, effects: Iterable[Effect]) -> list[Fit]:
        found = []
        least = WORTH_ADDING if base.candidate.terms else WORTH_FITTING
        ranked = [changes for changes in self.screened(base, effects).values() if changes]
        ranked.sort(key=lambda changes: -max(change.gain for change in changes))
        enough = PROMISING * max((change.gain for change in ranked[0]), default=0.0) if ranked else 0.0
        prospect = base.objective - (least if base.candidate.terms else 0.0)
        for changes in ranked:
            fits = []
            for change in changes:
                if change.gain < least:
                    continue
                candidate = base.candidate.plus(change.term)
                try:
                    fits.append(self.roughly(base, candidate, rescaled(change), give_up=prospect))
                except (FitError, ModelError):  # the best scale is more than the structure can carry
                    continue
                prospect = min(prospect, fits[-1].objective + OUT_OF_REACH)
            if fits:
                best = max(fits, key=self.score)
                gain = max(change.gain for change in changes)
                if gain >= enough and base.objective - best.objective < DELIVERED * gain:
                    best = self._followed(best)
                found.append(best)
        return found

    def _followed(self, rough: Fit) -> Fit:
        """Fit on from chord steps that did not reach what the screen promised: shared unknowns move far."""
        try:
            return max(
                rough, fit(self.problem, rough.candidate, rough.point, iterations=SHORT_STEPS), key=self.score
            )
        except (FitError, ModelError):
            return rough

    def _scan_far(self, base: Fit, effects: tuple[Effect, ...]) -> list[Fit]:
        near = self._near(base)
        screen = Screen(self._short(), near)
        ranked = [changes for effect in effects if (changes := self._starts(screen, effect, FAR_STARTS))]
        ranked.sort(key=lambda changes: -changes[0].gain)
        enough = PROMISING * ranked[0][0].gain if ranked else 0.0
        first = max(LEAST_PROMISING, sum(changes[0].gain >= enough for changes in ranked))
        found = self._from_beginnings(base, near, ranked[:first])
        if not base.candidate.terms and not any(absolute_gate(self.problem, item).passed for item in found):
            found += self._from_beginnings(base, near, ranked[first:])
        return found

    def _from_beginnings(self, base: Fit, near: Fit, ranked: list[list[Change]]) -> list[Fit]:
        """Fit effects to the beginnings of the records, the best of them to whole records."""
        starts = []
        for changes in ranked:
            best = None
            for change in changes:
                candidate = base.candidate.plus(change.term)
                item = self._shortly(
                    near, candidate, rescaled(change), None if best is None else best.objective
                )
                if item is not None and (best is None or item.objective < best.objective):
                    best = item
            if best is not None:
                starts.append(best)
        return self._whole(starts, base.objective)

    def _near(self, base: Fit) -> Fit:
        """Fit the beginnings with the effects of a base; shared unknowns as expected before the data.

        The nuisances of a wrong model are far off and make a bad start.
        """
        expected = Point(
            np.zeros_like(base.point.shared),
            tuple(np.zeros_like(u) for u in base.point.local),
            base.point.effect,
        )
        return fit(self._short(), base.candidate, expected, local_only=True, evidence=False)

    def _shortly(
        self, near: Fit, candidate: Candidate, added: FloatArray, give_up: float | None = None
    ) -> Fit | None:
        """Fit a candidate to the beginnings, or return None where the structure cannot follow."""
        start = Point(near.point.shared, near.point.local, np.concatenate((near.point.effect, added)))
        try:
            return fit(
                self._short(), candidate, start, iterations=SHORT_STEPS, evidence=False, give_up=give_up
            )
        except (FitError, ModelError):
            return None

    def _whole(self, starts: list[Fit], least: float) -> list[Fit]:
        """Fit the most promising candidates to whole records from where the beginnings led."""
        found: list[Fit] = []
        count = FAR_FITS if all(len(item.candidate.terms) == 1 for item in starts) else FAR_EXTENSIONS
        for item in sorted(starts, key=lambda start: start.objective)[:count]:
            try:
                whole = fit(self.problem, item.candidate, item.point, iterations=FAR_STEPS, give_up=least)
            except (FitError, ModelError):
                continue
            least = min(least, whole.objective + CLOSE)
            found.append(whole)
        return found

    def _short(self) -> Problem:
        """Return the problem with the beginnings of its dynamic records only."""
        if self.beginnings is None:
            period = 2.0 * np.pi / self.problem.setting.scales.angular_frequency
            trials = []
            for data in self.problem.trials:
                trial = data.trial
                count = len(trial.time)
                if trial.is_dynamic:
                    count = min(count, max(LEAST_SAMPLES, ceil(BEGINNING * period / trial.interval)))
                trials.append(shortened(trial, count))
            self.beginnings = self.problem.with_trials(tuple(trials))
        return self.beginnings

    def roughly(
        self, base: Fit, candidate: Candidate, added: FloatArray, *, give_up: float | None = None
    ) -> Fit:
        """Fit a candidate by chord steps from a base; see `fit` for `give_up`."""
        start = Point(base.point.shared, base.point.local, np.concatenate((base.point.effect, added)))
        return fit(self.problem, candidate, start, base=base.base, iterations=CHORD_STEPS, give_up=give_up)

    def exactly(self, rough: Fit) -> Fit:
        """Fit a candidate to convergence from a rough fit, and keep it."""
        key = key_of(rough.candidate)
        found = self.exact.get(key)
        if found is None or found.log_evidence < rough.log_evidence - 5.0:
            try:
                found = fit(self.problem, rough.candidate, rough.point)
            except (FitError, ModelError):  # chord steps led to where the structure cannot follow
                found = rough
            self.keep(found, exact=True)
        return self.exact[key]

    def refine(self, rough: Sequence[Fit], floor: float) -> list[Fit]:
        """Fit exactly those that are close to the best of them and above a floor of the score."""
        if not rough:
            return []
        top = self.score(rough[0])
        # far from the truth, chord steps rank only roughly
        margin = max(CLOSE, 0.5 * (top - floor))
        chosen = [item for item in rough[:EXACT_FITS] if self.score(item) > max(top - margin, floor)]
        return sorted((self.exactly(item) for item in chosen), key=lambda item: -self.score(item))

    # ---------------------------------------------------------------- the search

    def run(self) -> None:
        """Search: singles, one more at a time, all pairs where a single one does not do, deletion."""
        floor = self.score(self.none) - 6.0
        ranked = self.refine(self.scan(self.none, self.effects), floor)
        for item in ranked[:RIDGES]:
            if not self._misfits(item) and not absolute_gate(self.problem, item).passed:
                self._around(item)
        self._settle_steps()
        current = self.best()
        if current.candidate.terms and absolute_gate(self.problem, current).passed is False:
            self._families()
            if self.best().candidate.is_family:
                return
        while current.candidate.terms and len(current.candidate.terms) < LARGEST_SET:
            if len(current.candidate.terms) > 1 and self._far(current):
                break  # a third effect is looked for only where two nearly do
            longer = self._extended(current)
            if longer is None:
                break
            current = longer
        if not absolute_gate(self.problem, self.best()).passed and len(self.effects) > 1:
            self.fit_pairs()
        self._deletions()
        self._settle_steps()

    def _families(self) -> None:
        """Fit the free-shape families of the single effects that come closest, and keep those that fit.

        A law with a shape of its own is a simpler cause than two laws, so it is tried before pairs are.
        """
        singles = [item for item in self.exact.values() if len(item.candidate.terms) == 1]
        kept: dict[tuple[str, str], Fit] = {}
        for named in sorted(singles, key=self.score, reverse=True)[:EXACT_FITS]:
            reach = named.objective if not kept else min(item.objective for item in kept.values()) + CLOSE
            family = free_shape(self.problem, named, 0, give_up=min(reach, self.best().objective))
            if family is None or family.log_evidence - named.log_evidence <= SHAPE_GAIN:
                continue
            (term,) = family.candidate.terms
            key = (term.effect.family, term.place)  # members of a family are the same law once it is free
            better = key not in kept or self.score(kept[key]) < self.score(family)
            if better and absolute_gate(self.problem, family).passed is not False:
                kept[key] = family
        for family in kept.values():
            self.keep(family, exact=True)

    def _settle_steps(self) -> None:
        """Halve the time steps while they cost the best candidate too much, and fit the best ones again."""
        while self.problem.refinement < FINEST and solver_share(self.problem, self.best()) > SOLVER_SHARE:
            self.problem.refinement *= 2
            if self.beginnings is not None:
                self.beginnings.refinement = self.problem.refinement
            ranked = sorted(self.exact.values(), key=lambda item: -self.score(item))[:REFITTED]
            for item in ranked:
                if item.candidate.terms:
                    try:
                        again = fit(self.problem, item.candidate, item.point)
                    except (FitError, ModelError):  # the rough one stands
                        continue
                    self.exact[key_of(item.candidate)] = again

    def _around(self, found: Fit) -> Fit:
        """Look for a better fit of the same candidate beside its optimum, and keep it.

        Hysteresis of several elements has many local optima along the direction that the data tell least of,
        and a place has them at each sensor that it passes.
        """
        free = [number for number, item in enumerate(_parameters(found.candidate)) if not is_magnitude(item)]
        while True:
            moves = [step * axis for axis in np.eye(found.candidate.size)[free] for step in PLACE_STEPS]
            if found.candidate.size > 1:
                _, directions = np.linalg.eigh(found.effect_covariance)
                moves += [step * directions[:, -1] for step in RIDGE_STEPS]
            better = found
            for move in moves:
                start = Point(found.point.shared, found.point.local, found.point.effect + move)
                try:
                    item = fit(
                        self.problem, found.candidate, start,
                        iterations=NEIGHBOUR_ITERATIONS, give_up=better.objective,
                    )  # fmt: skip
                except (FitError, ModelError):
                    continue
                if item.objective < better.objective - NEIGHBOUR_GAIN:
                    better = item
            if better is found:
                return found
            found = better
            self.keep(found, exact=True)

    def _extended(self, current: Fit) -> Fit | None:
        """Return a better set with one more effect, or None."""
        if len(current.candidate.terms) >= LARGEST_SET:
            return None
        before = self.score(current)
        there = {term.effect.identifier for term in current.candidate.terms}
        others = [effect for effect in self.effects if effect.identifier not in there]
        fitted = self.refine(self.scan(current, others), before - 2.0)
        return fitted[0] if fitted and self.score(fitted[0]) > before else None

    def fit_pairs(self) -> None:
        """Fit the most promising of all pairs of effects, by their changes at the fit without effect."""
        far = self._far(self.none)
        near = self._near(self.none) if far else self.none
        screen = Screen(self._short() if far else self.problem, near)
        changes = {effect.identifier: self._starts(screen, effect) for effect in self.effects}
        ranked = sorted(_pairs(changes, screen.sign), key=lambda item: item[0])[:PAIRS_FITTED]
        rough: list[Fit] = []
        for _, first, second in ranked:
            candidate = Candidate((first.term, second.term))
            if key_of(candidate) in self.exact:
                continue
            start = np.concatenate((rescaled(first), rescaled(second)))
            if far:
                found = self._shortly(near, candidate, start)
            else:
                try:
                    found = self.roughly(self.none, candidate, start)
                except (FitError, ModelError):
                    found = None
            if found is not None:
                rough.append(found)
        if far:
            rough = self._whole(rough, self.none.objective)
        for item in rough:
            self.keep(item, exact=False)
        rough.sort(key=lambda item: -self.score(item))
        self.refine(rough, self.score(self.best()) - CLOSE)

    def _deletions(self) -> None:
        """Fit the best set less one effect, for each."""
        best = self.best()
        if len(best.candidate.terms) < 2:
            return
        for index in range(len(best.candidate.terms)):
            less = best.candidate.without(index)
            if key_of(less) not in self.exact:
                parts = best.candidate.parts(best.point.effect)
                effect = np.concatenate(parts[:index] + parts[index + 1 :])
                start = Point(best.point.shared, best.point.local, effect)
                try:
                    self.keep(fit(self.problem, less, start), exact=True)
                except (FitError, ModelError):
                    continue


def free_shape(problem: Problem, named: Fit, number: int, *, give_up: float | None = None) -> Fit | None:
    """Fit the family of one effect of a fit: its shape free, from the canonical one.

    Parameters
    ----------
    problem : Problem
        Of the fit.
    named : Fit
        With canonical shapes.
    number : int
        Of the effect among its terms.
    give_up : float, optional
        See `fit`.

    Returns
    -------
    Fit or None
        None where no shape is to free, or the structure cannot follow.
    """
    terms, parts = list(named.candidate.terms), list(named.candidate.parts(named.point.effect))
    effect = terms[number].effect
    if not effect.shape:
        return None
    terms[number] = Term(effect, terms[number].place, free_shape=True)
    parts[number] = np.append(parts[number], [item.prior.normal(item.canonical) for item in effect.shape])
    start = Point(named.point.shared, named.point.local, np.concatenate(parts))
    try:
        return fit(problem, Candidate(tuple(terms)), start, give_up=give_up)
    except (FitError, ModelError):
        return None


def _parameters(candidate: Candidate) -> list[EffectParameter | ShapeParameter]:
    return [item for term in candidate.terms for item in term.parameters]


def _worth(change: Change) -> float:
    """Order of changes: misfit gained, less what the scale costs in the prior."""
    scaled = rescaled(change)
    return -change.gain + 0.5 * float(scaled @ scaled)


def _pairs(changes: dict[str, list[Change]], sign: FloatArray) -> Iterator[tuple[float, Change, Change]]:
    """Yield misfit and changes, scaled together, of all pairs of effects."""
    names = list(changes)
    for i, one in enumerate(names):
        for other in names[i + 1 :]:
            best: tuple[float, Change, Change] | None = None
            for first in changes[one]:
                for second in changes[other]:
                    overlap = float(first.vector * sign @ second.vector)
                    gram = np.array([[first.size, overlap], [overlap, second.size]])
                    fits = np.array([first.fits, second.fits])
                    if np.linalg.cond(gram) > 1e8:
                        continue
                    scale = np.linalg.solve(gram, fits)
                    misfit = -0.5 * float(fits @ scale)
                    if best is None or misfit < best[0]:
                        best = (misfit, _scaled(first, scale[0]), _scaled(second, scale[1]))
            if best is not None and best[0] > -inf:
                yield best


def _scaled(change: Change, scale: float) -> Change:
    """Return the change whose best scale alone is the given one."""
    return Change(change.term, change.start, change.vector, scale * change.size, change.size)


def search(problem: Problem, effects: Sequence[Effect]) -> Search:
    """Fit the model without effect, then search the catalogue.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    effects : sequence of Effect
        The catalogue; what is unavailable here is left out.

    Returns
    -------
    Search
        All candidates with their evidence.
    """
    none = fit(problem, Candidate(), problem.start(Candidate()))
    usable = tuple(effect for effect in effects if effect.unavailable(problem.setting) is None)
    found = Search(problem, usable, none)
    found.run()
    return found


def solver_share(problem: Problem, fit: Fit) -> float:
    """Return the largest rms change of a channel when the time steps are halved, over its noise."""
    largest = 0.0
    for number, data in enumerate(problem.trials):
        if not data.trial.is_dynamic:
            continue
        candidate = fit.candidate if data.trial.kind in fit.candidate.acts_on else Candidate()
        patch = candidate.patch(problem.setting, fit.point.effect) if candidate.terms else ModelPatch()
        finer, _ = problem.response(number, fit.point.shared, fit.point.local[number], patch, finer=2)
        change = (finer - fit.responses[number]) / data.deviation
        largest = max(largest, float(np.sqrt((change**2).mean(axis=0)).max()))
    return largest
