"""The search for the set of effects that explains a campaign: screen, fit, add, take away, try pairs."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fe.patch import MicroSlip, ModelPatch

from .beginnings import CLOSE, PROMISING, SHORT_STEPS, Beginnings
from .candidate import Candidate
from .catalogue.entry import Effect
from .errors import FitError, ModelError
from .fitting import Fit, fit
from .gates import SHAPE_GAIN, absolute_gate
from .hypotheses import LARGEST_SET, Hypotheses, key_of
from .neighbourhood import around, free_shape, is_box
from .problem import Point, Problem
from .promising import acts_within, are_related, pairs, starts
from .screening import Change, Screen, rescaled

FloatArray = NDArray[np.float64]

CHORD_STEPS = 8
EXACT_FITS = 4
WORTH_FITTING = 2.0
"""Screened gain below which an effect is not fitted at all: it could not win a name [nat]."""
WORTH_ADDING = 4.0
"""The same for one more effect, whose prior is smaller."""
OUT_OF_REACH = 3.0 * CLOSE
"""Chord steps end where they have no prospect to come within this of the best [nat]."""
PAIRS_FITTED = 8
RIVALS = 30.0
"""Effects that fit within this log evidence of the best one have families that may overtake it [nat]."""
RIDGES = 2
"""Candidates that do not quite fit whose neighbourhood is searched."""
SOLVER_SHARE, FINEST = 0.1, 8
"""Largest share of the noise that the time steps may cost (rms over a channel of a trial), and how much
smaller than the model's own they may become for it."""
REFITTED = 3
"""Candidates that are fitted again with smaller steps or more elements."""
FINE_JOINT = 96
"""Elements of joints that slip in what is named. Fewer serve the search; but along the ridge of slip force
and stiffness the misfit of few elements has dents of its own, which would count as knowledge."""
DELIVERED = 0.7
"""Share of the screened gain that chord steps must reach."""
FAR = 1.5
"""Chi-square per sample above which a fit is far from the truth."""
STRAINED = 4.0
"""Prior deviations beyond which a shared unknown says the same."""


@dataclass
class Search(Hypotheses):
    """Hypotheses, and the way to more of them.

    Attributes
    ----------
    beginnings : Beginnings
        For fits far from the truth.
    """

    beginnings: Beginnings = field(init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.beginnings = Beginnings(self.problem)

    def screened(self, base: Fit, effects: Iterable[Effect]) -> dict[str, list[Change]]:
        """Return for each effect its most promising changes, best first, at different places or values."""
        screen = Screen(self.problem, base)
        return {effect.identifier: starts(screen, effect) for effect in effects}

    def scan(self, base: Fit, effects: Iterable[Effect]) -> list[Fit]:
        """Fit every effect roughly in addition to those of `base`; return the best of each, best first.

        Close to the truth one linearisation serves all (chord steps). Far from it phases slip over a long
        record, so that the beginnings of the records are fitted first, and the whole ones from there.
        """
        effects = near = tuple(effects)
        if self._misfits(base):  # what acts on readings only turns no phases
            near = tuple(effect for effect in effects if not acts_within(effect, self.problem.setting))
        found = self._scan_near(base, near)
        explained = any(absolute_gate(self.problem, item).passed for item in found)
        if self._misfits(base) or (self._far(base) and not explained):
            found += self.beginnings.scan(base, effects)
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
            fits: list[Fit] = []
            for change in changes:
                if change.gain < least:
                    continue
                candidate = base.candidate.plus(change.term)
                try:
                    rough = self.roughly(base, candidate, rescaled(change), give_up=prospect)
                except (FitError, ModelError):  # the best scale is more than the structure can carry
                    continue
                delivered = base.objective - rough.objective
                reached = max((base.objective - item.objective for item in fits), default=0.0)
                if change.gain >= enough and max(delivered, reached) < DELIVERED * change.gain:
                    rough = self._followed(rough, base, rescaled(change))
                fits.append(rough)
                prospect = min(prospect, rough.objective + OUT_OF_REACH)
            if fits:
                found.append(max(fits, key=self.score))
        return found

    def _followed(self, rough: Fit, base: Fit, added: FloatArray) -> Fit:
        """Fit anew where chord steps did not reach what the screen promised: shared unknowns move far."""
        start = Point(base.point.shared, base.point.local, np.concatenate((base.point.effect, added)))
        try:
            return max(
                rough, fit(self.problem, rough.candidate, start, iterations=SHORT_STEPS), key=self.score
            )
        except (FitError, ModelError):
            return rough

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
        for rank, item in enumerate(ranked[:RIDGES]):
            misses = absolute_gate(self.problem, item).passed is False
            if not self._misfits(item) and (misses or (rank == 0 and is_box(item.candidate))):
                self.keep(around(self.problem, item), exact=True)
        if ranked and absolute_gate(self.problem, self.best()).passed is False and self._misfits(self.none):
            self._relatives()
        self._settle_steps()
        self._settle_joints()
        self._families()
        current = self.best()
        if current.candidate.is_family:  # a second effect beside a law that is free would be anything
            self._settle_joints()
            self._settle_steps()
            current = self.best()  # finely divided, the joint may have the shape of the name
            if current.candidate.is_family:
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
        self._settle_joints()
        self._settle_steps()
        fewer = self.best()
        if not fewer.candidate.is_family and 0 < len(fewer.candidate.terms) < len(current.candidate.terms):
            self._extended(fewer)  # what stood in for it hid what is beside it

    def _relatives(self) -> None:
        """Fit effects that are easily taken for the best one, from where it stands."""
        best = self.best()
        if len(best.candidate.terms) != 1:
            return
        (term,) = best.candidate.terms
        related = [effect for effect in self.effects if are_related(effect, term.effect)]
        for item in self.beginnings.related(best, related):
            self.keep(item, exact=False)
            if self.score(item) > self.score(best) - CLOSE:
                self.exactly(item)

    def _families(self) -> None:
        """Fit the free-shape families of single effects that come close, and keep those that fit.

        A law with a shape of its own is a simpler cause than two laws, so it is tried before pairs are. Where
        the best effect fits, families compete only if others fit as well: its own is for the shape gate.
        """
        singles = [item for item in self.exact.values() if len(item.candidate.terms) == 1]
        singles = sorted(singles, key=self.score, reverse=True)[:EXACT_FITS]
        fitting = [item for item in singles if absolute_gate(self.problem, item).passed is not False]
        if fitting and fitting[0] is singles[0]:
            close = self.score(singles[0]) - RIVALS
            singles = [item for item in fitting if self.score(item) > close]
            if len(singles) == 1 or absolute_gate(self.problem, self.none).passed is not False:
                return
        # a rival that fits is followed to its end; one that does not has to promise more than the best
        give_up = None if fitting else self.best().objective
        kept: dict[tuple[str, str], Fit] = {}
        for named in singles:
            family = free_shape(self.problem, named, 0, give_up=give_up)
            if family is None or family.log_evidence - named.log_evidence <= SHAPE_GAIN:
                continue
            (term,) = family.candidate.terms
            key = (term.effect.family, term.place)  # one verdict; the member from which it is reached best
            better = key not in kept or self.score(kept[key]) < self.score(family)
            if better and absolute_gate(self.problem, family).passed is not False:
                kept[key] = family
        for family in kept.values():
            self.keep(family, exact=True)

    def _settle_steps(self) -> None:
        """Halve the time steps while they cost the best candidate too much, and fit the best ones again."""
        while self.problem.refinement < FINEST and solver_share(self.problem, self.best()) > SOLVER_SHARE:
            self.problem.refinement *= 2
            self.beginnings.refine(self.problem.refinement)
            ranked = sorted(self.exact.values(), key=lambda item: -self.score(item))[:REFITTED]
            for item in ranked:
                if item.candidate.terms:
                    try:
                        again = fit(self.problem, item.candidate, item.point)
                    except (FitError, ModelError):  # the rough one stands
                        continue
                    self.exact[key_of(item.candidate)] = again

    def _settle_joints(self) -> None:
        """Divide a joint that slips more finely where the best candidate has one; fit the best ones again."""
        setting = self.problem.setting
        if setting.joint_elements >= FINE_JOINT or not _slips(self.problem, self.best()):
            return
        ranked = sorted(self.exact.values(), key=lambda item: -self.score(item))
        self.problem.setting = replace(setting, joint_elements=FINE_JOINT)
        self.beginnings.set_up(self.problem.setting)
        for item in [item for item in ranked if _slips(self.problem, item)][:REFITTED]:
            try:
                again = fit(self.problem, item.candidate, item.point)
            except (FitError, ModelError):  # the rough one stands
                continue
            self.exact[key_of(item.candidate)] = again
        if _slips(self.problem, self.best()):
            self.keep(around(self.problem, self.best()), exact=True)

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
        near = self.beginnings.near(self.none) if far else self.none
        screen = Screen(self.beginnings.short if far else self.problem, near)
        changes = {effect.identifier: starts(screen, effect) for effect in self.effects}
        ranked = sorted(pairs(changes, screen.sign), key=lambda item: item[0])[:PAIRS_FITTED]
        rough: list[Fit] = []
        for _, first, second in ranked:
            candidate = Candidate((first.term, second.term))
            if key_of(candidate) in self.exact:
                continue
            start = np.concatenate((rescaled(first), rescaled(second)))
            if far:
                found = self.beginnings.shortly(near, candidate, start)
            else:
                try:
                    found = self.roughly(self.none, candidate, start)
                except (FitError, ModelError):
                    found = None
            if found is not None:
                rough.append(found)
        if far:
            rough = self.beginnings.whole(rough, self.none.objective)
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
            # from here even a set that was fitted before may find a better optimum
            less = best.candidate.without(index)
            parts = best.candidate.parts(best.point.effect)
            effect = np.concatenate(parts[:index] + parts[index + 1 :])
            try:
                found = fit(self.problem, less, Point(best.point.shared, best.point.local, effect))
            except (FitError, ModelError):
                continue
            self.keep(found, exact=True)


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


def _slips(problem: Problem, found: Fit) -> bool:
    """Whether a fit has a joint that slips."""
    patch = found.candidate.patch(problem.setting, found.point.effect) if found.candidate.terms else ()
    return any(isinstance(item, MicroSlip) for item in patch)


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
