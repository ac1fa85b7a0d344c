"""Simulation-based calibration of the workflow itself, on the geometry of a user's own campaign.

Campaigns are simulated with the model, the inputs, the channels and the noise of a real one. In a third of
them nothing is hidden; in the others an effect drawn from its prior, where this campaign can detect it
(d^2 >= 25, the limit of `discrepancy.judgement.separability`). Each is investigated as the real one is, and
verdicts are compared with what was hidden. Motion is simulated with half the time step of the naming side.
"""

import json
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from math import isinf
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import lfilter
from scipy.stats import binomtest

from discrepancy.campaign.noise import NoiseModel
from discrepancy.campaign.records import Campaign, FloatArray, IntArray, Trial
from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.document import Origin, plain
from discrepancy.errors import DiscrepancyError, ModelError
from discrepancy.fits.candidate import Candidate, EffectTerm, Point
from discrepancy.fits.fitting import fit
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Screen
from discrepancy.judgement.separability import DETECTED, as_predicted, has_free_initial_state, usable_effects
from discrepancy.system.interface import Model
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import checked, investigate
from reporting.files import atomic_write_text

TRIES = 60
"""Draws of an effect's prior until one is detectable; without success the effect is not detectable here."""
REFINEMENT = 2
"""Finer time steps than on the naming side."""


@dataclass(frozen=True)
class Hidden:
    """An effect to hide: the term, its scaled parameters, its d^2."""

    term: EffectTerm
    normal: FloatArray
    distance: float


class Simulator:
    """Draws campaigns of the geometry of a real one.

    Parameters
    ----------
    campaign : Campaign
        The real one; its values count only where a nuisance has no prior (a free zero, a motion that began
        before the record): these stay as the fit without effect has them.
    model : Model
        The model as it is.
    """

    def __init__(self, campaign: Campaign, model: Model) -> None:
        self.campaign, self.model = campaign, model
        self.setting = Setting(campaign, model, model.scales(campaign))
        problem = Problem(campaign, model, self.setting)
        self.fitted = fit(problem, Candidate(), problem.start(Candidate()))
        self.problem = problem.with_trials(campaign.trials)
        zeros = tuple(np.zeros(data.unknowns.size) for data in self.problem.trials)
        start = replace(self.fitted.point, local=zeros)
        self.found = fit(self.problem, Candidate(), start, local_only=True).point

    def screen(self) -> Screen:
        """Return what measures d^2 of an effect under this campaign, on the predicted data."""
        problem = Problem(as_predicted(self.campaign, self.model, self.setting), self.model, self.setting)
        return Screen(problem, fit(problem, Candidate(), problem.start(Candidate()), iterations=1))

    def draw_effect(self, effect: Effect, screen: Screen, generator: np.random.Generator) -> Hidden | None:
        """Return a detectable draw of an effect's prior, or None if there was none."""
        places = effect.places(self.setting)
        for _ in range(TRIES):
            term = EffectTerm(effect, places[int(generator.integers(len(places)))])
            normal = generator.standard_normal(len(term.parameters))
            try:
                size = screen.change(term, normal).squared_size
            except DiscrepancyError:  # more than the structure can carry
                continue
            if size >= DETECTED:
                return Hidden(term, normal, size)
        return None

    def simulate(self, hidden: Hidden | None, generator: np.random.Generator) -> Campaign:
        """Return a campaign with values in the place of the measured ones.

        Raises
        ------
        ModelError
            If the structure cannot carry the effect under the nuisances that were drawn.
        """
        problem = self.problem
        candidate = Candidate() if hidden is None else Candidate((hidden.term,))
        shared = _drawn(self.found.shared, problem.shared.precision, generator)
        patch = candidate.patch(self.setting, np.empty(0) if hidden is None else hidden.normal)
        nothing = Candidate().patch(self.setting, np.empty(0))
        channels = {name: self._deviation(name, generator) for name in self.campaign.channels}
        trials: list[Trial] = []
        for number, data in enumerate(problem.trials):
            local = _drawn(self.found.local[number], data.unknowns.precision, generator)
            if has_free_initial_state(
                data.trial
            ):  # whose prior has no information: the state stays as fitted
                initials = slice(*data.unknowns.ends[:2])
                local[initials] = self.found.local[number][initials]
            acts = data.trial.kind in candidate.acts_on
            response, _ = problem.response(number, shared, local, patch if acts else nothing, REFINEMENT)
            point = Point(shared, (*self.found.local[:number], local), np.empty(0))
            values = problem.prediction(number, point, response).copy()
            for column, name in enumerate(data.trial.channels):
                noise = _noise(data.noise[column], data.trial, generator)
                values[:, column] += channels[name] * data.trial.noise_factor * noise
            trials.append(replace(data.trial, values=values))
        return replace(self.campaign, name=f"{self.campaign.name} (simulated)", trials=tuple(trials))

    def _deviation(self, name: str, generator: np.random.Generator) -> float:
        """Return the true noise deviation over the recorded one: a draw of what the record leaves open."""
        freedom = self.problem.noise[name].degrees_of_freedom
        if isinf(freedom) or freedom <= 0.0:
            return 1.0
        return float(np.sqrt(freedom / generator.chisquare(freedom)))


def _drawn(found: FloatArray, precision: FloatArray, generator: np.random.Generator) -> FloatArray:
    """Return draws of N(0, 1) where there is a prior, the fitted values where there is none."""
    draws = generator.standard_normal(len(found))
    return np.where(precision > 0.0, draws, found)


def _noise(model: NoiseModel, trial: Trial, generator: np.random.Generator) -> FloatArray:
    """Return noise (N,) of one channel [channel's unit], coloured as its record is."""
    count = len(trial.time)
    if not trial.is_dynamic or not model.applies(trial.interval):
        return np.asarray(model.static_deviation * generator.standard_normal(count))
    lead = 20 * len(model.autoregression)  # until the start is forgotten
    white = model.standard_deviation * generator.standard_normal(lead + count)
    return np.asarray(lfilter([1.0], np.r_[1.0, -model.autoregression], white)[lead:])


SELF_CALIBRATION_NAME = "self_calibration.json"
SCHEMA = "uav-twin self calibration 1"
NULL_SHARE = 3
"""One campaign in so many hides nothing."""
NOTHING = "nothing"
OTHER = {kind: kind.value for kind in VerdictKind if kind is not VerdictKind.NAMED}
OTHER[VerdictKind.FAMILY] = "family only"
"""Columns of the confusion matrix besides the names."""
OUTCOMES = {VerdictKind.FAMILY: "family", VerdictKind.NAMED_IN_PART: "in part"}
"""Of verdicts that say less than a name, where they hold what was hidden."""


@dataclass(frozen=True)
class Covered:
    """Whether the 90 % interval of a parameter holds its true value."""

    parameter: str
    true: float
    low: float
    high: float

    @property
    def inside(self) -> bool:
        """Whether it does."""
        return self.low <= self.true <= self.high


@dataclass(frozen=True)
class CalibrationCase:
    """One simulated campaign.

    Attributes
    ----------
    hidden : str
        Identifier of the effect, "nothing" where there is none.
    place : str
        Where it acts.
    distance : float
        d^2 from the model without it [sigma^2].
    kind : VerdictKind
        Of the verdict.
    named : tuple of str
        Identifiers that were named; members where the verdict is a group, the nearest where it is a family.
    outcome : str
        "right", "wrong", "in part", "group", "family", "unexplained", "below detectability" or "data error".
    covered : tuple of Covered
        Parameters of the effect, where it was named.
    """

    hidden: str
    place: str
    distance: float
    kind: VerdictKind
    named: tuple[str, ...]
    outcome: str
    covered: tuple[Covered, ...]


@dataclass(frozen=True)
class Share:
    """A share of cases with its 90 % Wilson interval."""

    count: int
    total: int
    low: float
    high: float

    @property
    def value(self) -> float:
        """The share; nan without cases."""
        return self.count / self.total if self.total else float("nan")


@dataclass(frozen=True)
class SelfCalibration:
    """What came out of all simulated campaigns.

    Attributes
    ----------
    cases : tuple of CalibrationCase
        In the order of their simulation.
    not_detectable : tuple of str
        Effects that can be tested here, but were in no draw of their prior detectable.
    seed : int
        Of the `SeedSequence`.
    """

    cases: tuple[CalibrationCase, ...]
    not_detectable: tuple[str, ...]
    seed: int

    def share(self, outcome: str, *, null: bool = False) -> Share:
        """Return the share of an outcome among campaigns with an effect, or among those with none."""
        cases = [case for case in self.cases if (case.hidden == NOTHING) is null]
        return wilson(sum(case.outcome == outcome for case in cases), len(cases))

    def coverage(self) -> Share:
        """Return the share of 90 % intervals of named effects that hold the true value."""
        inside = [item.inside for case in self.cases for item in case.covered]
        return wilson(sum(inside), len(inside))

    def confusion(self) -> tuple[list[str], list[str], IntArray]:
        """Return what was hidden (rows), verdicts (columns), and counts."""
        rows = list(dict.fromkeys(case.hidden for case in self.cases))
        rows.sort(key=lambda name: (name != NOTHING, name))
        named = {_column(case) for case in self.cases} - set(OTHER.values())
        others = [name for name in OTHER.values() if any(_column(case) == name for case in self.cases)]
        columns = [name for name in rows if name in named] + sorted(named - set(rows))
        columns = [*(name for name in others if name == OTHER[VerdictKind.NOTHING_MISSING]), *columns]
        columns += [name for name in others if name not in columns]
        counts = np.zeros((len(rows), len(columns)), dtype=np.int64)
        for case in self.cases:
            counts[rows.index(case.hidden), columns.index(_column(case))] += 1
        return rows, columns, counts


def _column(case: CalibrationCase) -> str:
    return " + ".join(case.named) if case.kind is VerdictKind.NAMED else OTHER[case.kind]


def wilson(count: int, total: int) -> Share:
    """Return a share with its 90 % interval after Wilson 1927; from 0 to 1 without cases."""
    if total == 0:
        return Share(0, 0, 0.0, 1.0)
    interval = binomtest(count, total).proportion_ci(0.9, method="wilson")
    return Share(count, total, float(interval.low), float(interval.high))


# ---------------------------------------------------------------- the study


def self_calibrate(
    campaign: Campaign,
    model: Model,
    effects: Sequence[Effect],
    count: int,
    *,
    seed: int = 0,
    workers: int = 2,
    advance: Callable[[], object] | None = None,
) -> SelfCalibration:
    """Simulate and investigate campaigns of one geometry.

    Parameters
    ----------
    campaign : Campaign
        The real one.
    model : Model
        The model as it is.
    effects : sequence of Effect
        The catalogue; effects that cannot be tested here take no part.
    count : int
        Number of campaigns; every third hides nothing, the effects take turns in the others.
    seed : int
        The result depends on it, not on the number of workers.
    workers : int
        Processes; 1: this one. With more, a script must guard its own start (`if __name__ == "__main__"`).
    advance : callable, optional
        Called after each campaign.

    Raises
    ------
    DiscrepancyError
        If nothing can be tested here.
    """
    campaign, _ = checked(campaign, model)
    simulator = Simulator(campaign, model)
    testable = usable_effects(effects, simulator.setting)
    screen = simulator.screen()
    root = np.random.SeedSequence(seed)
    drawing, *own = root.spawn(count + 1)
    generator = np.random.default_rng(drawing)
    turns: list[Effect] = []
    absent: dict[str, None] = {}
    hidden: list[Hidden | None] = []
    for number in range(count):
        found: Hidden | None = None
        while number % NULL_SHARE and found is None and len(absent) < len(testable):
            if not turns:
                turns = [testable[n] for n in generator.permutation(len(testable))]
            effect = turns.pop()
            if effect.identifier in absent:
                continue
            found = simulator.draw_effect(effect, screen, generator)
            if found is None:
                absent[effect.identifier] = None
        hidden.append(found)
    cases: list[CalibrationCase] = []
    work = partial(_investigated, simulator, effects)
    with ProcessPoolExecutor(max(workers, 1), get_context("spawn")) as pool:
        for case in (pool.map if workers > 1 and count > 1 else map)(work, hidden, own):
            cases.append(case)
            if advance is not None:
                advance()
    return SelfCalibration(tuple(cases), tuple(absent), seed)


def _investigated(
    simulator: Simulator, effects: Sequence[Effect], hidden: Hidden | None, seed: np.random.SeedSequence
) -> CalibrationCase:
    generator = np.random.default_rng(seed)
    try:
        campaign = simulator.simulate(hidden, generator)
    except ModelError:  # at the edge of what the structure carries: it goes at its mean conditions
        generator = np.random.default_rng(seed.spawn(1)[0])
        campaign = simulator.simulate(hidden, generator)
    found = investigate(campaign, simulator.model, effects, thorough=False).verdict
    true, place, distance = NOTHING, "", 0.0
    if hidden is not None:
        true, place, distance = hidden.term.effect.identifier, hidden.term.place, hidden.distance
    named = tuple(dict.fromkeys(effect.identifier for effect in found.effects))
    outcome = outcome_of(true, found.kind, named, found.group)
    covered: tuple[Covered, ...] = ()
    if outcome == "right" and hidden is not None:
        values = hidden.term.values(hidden.normal)
        covered = tuple(
            Covered(item.name, values[item.name], item.low, item.high)
            for effect in found.effects
            if effect.place == hidden.term.place
            for item in effect.parameters
        )
    return CalibrationCase(true, place, distance, found.kind, named, outcome, covered)


def outcome_of(hidden: str, kind: VerdictKind, named: tuple[str, ...], group: tuple[str, ...]) -> str:
    """Return how a verdict compares with what was hidden.

    A group that holds the effect, and a family whose nearest member it is, are honest but less than the name;
    a group or a family without it is wrong, and so is any name where nothing was hidden.
    """
    if kind is VerdictKind.NOTHING_MISSING:
        return "right" if hidden == NOTHING else "missed"
    if kind is VerdictKind.NAMED:
        return "right" if named == (hidden,) else "wrong"
    if kind is VerdictKind.GROUP:
        return "group" if any(hidden in item.split(" + ") for item in group) else "wrong"
    if kind in (VerdictKind.FAMILY, VerdictKind.NAMED_IN_PART):
        return OUTCOMES[kind] if hidden in named else "wrong"
    return kind.value


def write_self_calibration(path: Path, found: SelfCalibration, origin: Origin) -> Path:
    """Write self_calibration.json: every case, the shares and the confusion matrix; whole or not at all.

    Raises
    ------
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """

    def told(share: Share) -> dict[str, Any]:
        return {**plain(share), "share": plain(share.value)}

    rows, columns, counts = found.confusion()
    content = {
        "schema": SCHEMA,
        **plain(origin),
        "seed": found.seed,
        "not_detectable": list(found.not_detectable),
        "outcomes": {
            name: {outcome: told(found.share(outcome, null=null)) for outcome in outcomes(found, null=null)}
            for name, null in (("with_an_effect", False), ("with_nothing", True))
        },
        "coverage_90": told(found.coverage()),
        "confusion": {"hidden": rows, "verdict": columns, "counts": counts.tolist()},
        "cases": [plain(case) for case in found.cases],
    }
    return atomic_write_text(path, json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def outcomes(found: SelfCalibration, *, null: bool) -> list[str]:
    """Return the outcomes that occurred, "right" and "wrong" always, in a fixed order."""
    counts = Counter(case.outcome for case in found.cases if (case.hidden == NOTHING) is null)
    order = (
        "right", "wrong", "group", "in part", "family", "missed", "unexplained", "below detectability",
        "data error",
    )  # fmt: skip
    return [name for name in order if counts[name] or name in ("right", "wrong")]
