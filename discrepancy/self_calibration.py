"""Simulation-based calibration of the workflow itself, on the geometry of a user's own campaign.

Campaigns are simulated with the model, the inputs, the channels and the noise of a real one. A
third of them contains no effect. The others contain a hidden effect that is drawn from its prior,
at a size that this campaign can detect (d^2 >= 25, see
`discrepancy.judgement.separability`). Each campaign is investigated like the real one, and
its verdict is compared with the hidden effect. Motion is simulated with half the time step of the
fits.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context

import numpy as np
from scipy.stats import binomtest

from discrepancy.campaign.records import Campaign, IntArray
from discrepancy.catalogue.entry import Effect
from discrepancy.errors import ModelError
from discrepancy.judgement.separability import usable_effects
from discrepancy.simulation import HiddenEffect, Simulator
from discrepancy.system.interface import Model
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import check_and_prepare, investigate

NULL_SHARE = 3
"""One of this many campaigns contains no effect."""
NOTHING = "nothing"
"""What stands for the identifier of the hidden effect if there is none."""
OTHER = {kind: kind.value for kind in VerdictKind if kind is not VerdictKind.NAMED}
OTHER[VerdictKind.FAMILY] = "family only"
"""Columns of the confusion matrix besides the names, by the kind of verdict."""
OUTCOMES = {VerdictKind.FAMILY: "family", VerdictKind.NAMED_IN_PART: "in part"}
"""Outcomes of verdicts that say less than a name, if they contain the hidden effect."""


@dataclass(frozen=True)
class ParameterCoverage:
    """A parameter of a named effect: its true value, and the 90 % interval that was found."""

    parameter: str
    """Name of the parameter."""
    true: float
    """The value with which the campaign was simulated [unit of the parameter]."""
    low: float
    """Lower limit of the 90 % interval that was found [unit of the parameter]."""
    high: float
    """Upper limit of this interval [unit of the parameter]."""

    @property
    def contains_true_value(self) -> bool:
        """Whether the interval holds the true value."""
        return self.low <= self.true <= self.high


@dataclass(frozen=True)
class CalibrationCase:
    """One simulated campaign."""

    hidden: str
    """Identifier of the hidden effect; "nothing" if there is none."""
    place: str
    """Place where the effect acts."""
    distance: float
    """Squared distance d^2 of the readings with and without the effect [noise variances]."""
    kind: VerdictKind
    """Kind of the verdict."""
    named: tuple[str, ...]
    """Identifiers of the effects in the verdict: the named ones, the members of a group, or the
    nearest member of a family."""
    outcome: str
    """"right", "wrong", "missed", "in part", "group", "family", "unexplained", "below
    detectability" or "data error"; see `outcome_of`."""
    covered: tuple[ParameterCoverage, ...]
    """Parameters of the effect with their intervals, if it was named correctly."""


@dataclass(frozen=True)
class Proportion:
    """A fraction of cases with its 90 % Wilson interval."""

    count: int
    total: int
    low: float
    high: float

    @property
    def value(self) -> float:
        """The fraction; nan without cases."""
        return self.count / self.total if self.total else float("nan")


@dataclass(frozen=True)
class SelfCalibration:
    """Results of all simulated campaigns.

    Attributes
    ----------
    cases : tuple of CalibrationCase
        The campaigns in the order of their simulation.
    not_detectable : tuple of str
        Identifiers of testable effects of which no draw of the prior was detectable.
    seed : int
        Seed of the `SeedSequence`.
    """

    cases: tuple[CalibrationCase, ...]
    not_detectable: tuple[str, ...]
    seed: int

    def share(self, outcome: str, *, null: bool = False) -> Proportion:
        """Return the fraction of an outcome among campaigns with a hidden effect, or without one.

        `null` is True for the campaigns in which nothing was hidden.
        """
        outcomes = self.outcomes(null=null)
        return wilson_interval(outcomes.count(outcome), len(outcomes))

    def outcomes(self, *, null: bool) -> list[str]:
        """Return the outcome of each campaign with a hidden effect, or of each one without.

        `null` is True for the campaigns in which nothing was hidden.
        """
        outcomes = []
        for case in self.cases:
            hides_nothing = case.hidden == NOTHING
            if hides_nothing == null:
                outcomes.append(case.outcome)
        return outcomes

    def coverage(self) -> Proportion:
        """Return the fraction of 90 % intervals of named effects that contain the true value."""
        are_inside = [
            covered.contains_true_value for case in self.cases for covered in case.covered
        ]
        return wilson_interval(sum(are_inside), len(are_inside))

    def confusion(self) -> tuple[list[str], list[str], IntArray]:
        """Return the confusion matrix.

        Returns
        -------
        rows : list of str
            Hidden effects; "nothing" comes first.
        columns : list of str
            Verdicts: "nothing missing", then names, then other verdicts.
        counts : (R, C) ndarray of int
            Numbers of campaigns.
        """
        rows = self._confusion_rows()
        columns = self._confusion_columns(rows)
        counts = np.zeros((len(rows), len(columns)), dtype=np.int64)
        for case in self.cases:
            row = rows.index(case.hidden)
            column = columns.index(_confusion_column(case))
            counts[row, column] += 1
        return rows, columns, counts

    def _confusion_rows(self) -> list[str]:
        """Return the hidden effects, sorted; "nothing" comes first."""
        hidden = {case.hidden for case in self.cases}
        rows = sorted(hidden - {NOTHING})
        if NOTHING in hidden:
            rows.insert(0, NOTHING)
        return rows

    def _confusion_columns(self, rows: list[str]) -> list[str]:
        """Return the verdicts that occurred: "nothing missing", then names, then other verdicts.

        Names have the order of the rows; those that are no row (of several effects) come after.
        """
        verdicts = {_confusion_column(case) for case in self.cases}
        names = verdicts.difference(OTHER.values())
        names_of_rows = [row for row in rows if row in names]
        other_names = sorted(names.difference(rows))
        # several kinds of verdict may share one column
        other_verdicts = [
            verdict for verdict in dict.fromkeys(OTHER.values()) if verdict in verdicts
        ]
        nothing_missing = OTHER[VerdictKind.NOTHING_MISSING]
        if nothing_missing in other_verdicts:
            other_verdicts.remove(nothing_missing)
            return [nothing_missing, *names_of_rows, *other_names, *other_verdicts]
        return [*names_of_rows, *other_names, *other_verdicts]


def _confusion_column(case: CalibrationCase) -> str:
    """Return the column of a case in the confusion matrix: the name, or the kind of verdict."""
    if case.kind is VerdictKind.NAMED:
        return " + ".join(case.named)
    return OTHER[case.kind]


def wilson_interval(count: int, total: int) -> Proportion:
    """Return a fraction with its 90 % interval (Wilson 1927); from 0 to 1 without cases."""
    if total == 0:
        return Proportion(0, 0, 0.0, 1.0)
    interval = binomtest(count, total).proportion_ci(0.9, method="wilson")
    return Proportion(count, total, float(interval.low), float(interval.high))


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
    """Test the workflow on simulated campaigns with known effects, and return its verdicts.

    Parameters
    ----------
    campaign : Campaign
        The real campaign, whose geometry is used.
    model : Model
        The model without a patch.
    effects : sequence of Effect
        The catalogue; effects that cannot be tested here are not hidden.
    count : int
        Number of campaigns. Every third contains no effect; the effects alternate in the others.
    seed : int
        Seed; the result depends on it, and not on the number of workers.
    workers : int
        Number of processes; with more than one, a script must guard its own start (`if __name__ ==
        "__main__"`).
    advance : callable, optional
        Called after each campaign.

    Raises
    ------
    DiscrepancyError
        If nothing can be tested here.
    """
    campaign, _ = check_and_prepare(campaign, model)
    simulator = Simulator(campaign, model)
    testable = usable_effects(effects, simulator.setting)
    drawing_seed, *case_seeds = np.random.SeedSequence(seed).spawn(count + 1)
    hidden, not_detectable = _hidden_effects(
        simulator, testable, count, np.random.default_rng(drawing_seed)
    )
    cases: list[CalibrationCase] = []
    investigate_case = partial(_investigate_simulated, simulator, effects)
    with ProcessPoolExecutor(max(workers, 1), get_context("spawn")) as pool:
        map_cases = pool.map if workers > 1 and count > 1 else map
        for case in map_cases(investigate_case, hidden, case_seeds):
            cases.append(case)
            if advance is not None:
                advance()
    return SelfCalibration(tuple(cases), tuple(not_detectable), seed)


def _hidden_effects(
    simulator: Simulator,
    testable: Sequence[Effect],
    count: int,
    generator: np.random.Generator,
) -> tuple[list[HiddenEffect | None], list[str]]:
    """Draw the effects that are hidden in the campaigns.

    All testable effects are used in a random order before one is used again. Every `NULL_SHARE`-th
    campaign has no effect, and neither has any further one if no effect is detectable.

    Parameters
    ----------
    simulator : Simulator
        Draws the effects.
    testable : sequence of Effect
        Effects that can be tested.
    count : int
        Number of campaigns.
    generator : Generator
        Source of the order, and of places and parameters.

    Returns
    -------
    hidden : list of HiddenEffect or None
        The effect of each campaign; None for none.
    not_detectable : list of str
        Identifiers of the effects of which no draw was detectable.
    """
    screen = simulator.screen()
    queue: list[Effect] = []
    not_detectable: list[str] = []
    hidden: list[HiddenEffect | None] = []
    for case_number in range(count):
        drawn: HiddenEffect | None = None
        hides_nothing = case_number % NULL_SHARE == 0
        while not hides_nothing and drawn is None and len(not_detectable) < len(testable):
            if not queue:
                queue = [testable[index] for index in generator.permutation(len(testable))]
            effect = queue.pop()
            if effect.identifier in not_detectable:
                continue
            drawn = simulator.draw_effect(effect, screen, generator)
            if drawn is None:
                not_detectable.append(effect.identifier)
        hidden.append(drawn)
    return hidden, not_detectable


def _investigate_simulated(
    simulator: Simulator,
    effects: Sequence[Effect],
    hidden: HiddenEffect | None,
    seed: np.random.SeedSequence,
) -> CalibrationCase:
    """Simulate a campaign, investigate it, and compare the verdict with the hidden effect.

    `effects` is the catalogue of the investigation. If the structure cannot carry the effect with
    the nuisances that were drawn, they are drawn once more.
    """
    try:
        campaign = simulator.simulate(hidden, np.random.default_rng(seed))
    except ModelError:
        campaign = simulator.simulate(hidden, np.random.default_rng(seed.spawn(1)[0]))
    verdict = investigate(campaign, simulator.model, effects, thorough=False).verdict
    identifier, place, distance = NOTHING, "", 0.0
    if hidden is not None:
        identifier = hidden.term.effect.identifier
        place = hidden.term.place
        distance = hidden.distance
    named = tuple(dict.fromkeys(effect.identifier for effect in verdict.effects))
    outcome = outcome_of(identifier, verdict.kind, named, verdict.group)
    covered: list[ParameterCoverage] = []
    if outcome == "right" and hidden is not None:
        true_values = hidden.term.physical_values(hidden.normal)
        for effect in verdict.effects:
            if effect.place != place:
                continue
            for estimate in effect.parameters:
                true_value = true_values[estimate.name]
                covered.append(
                    ParameterCoverage(estimate.name, true_value, estimate.low, estimate.high)
                )
    return CalibrationCase(
        hidden=identifier,
        place=place,
        distance=distance,
        kind=verdict.kind,
        named=named,
        outcome=outcome,
        covered=tuple(covered),
    )


def outcome_of(
    hidden: str, kind: VerdictKind, named: tuple[str, ...], group: tuple[str, ...]
) -> str:
    """Return the outcome of a verdict, given the hidden effect.

    A group that contains the effect, a family whose nearest member it is, and a verdict that names
    it in part are correct but say less than the name; they have outcomes of their own. Without the
    effect they are wrong, and so is any name if there is no effect. For other kinds of verdict the
    outcome is the kind, such as "unexplained".

    Parameters
    ----------
    hidden : str
        Identifier of the hidden effect, or `NOTHING`.
    kind : VerdictKind
        Kind of the verdict.
    named, group : tuple of str
        Identifiers of its effects, and members of its group; those of a member with several effects
        are joined by " + ".
    """
    if kind is VerdictKind.NOTHING_MISSING:
        return "right" if hidden == NOTHING else "missed"
    if kind is VerdictKind.NAMED:
        return "right" if named == (hidden,) else "wrong"
    if kind is VerdictKind.GROUP:
        members = [identifier for member in group for identifier in member.split(" + ")]
        return "group" if hidden in members else "wrong"
    if kind in (VerdictKind.FAMILY, VerdictKind.NAMED_IN_PART):
        return OUTCOMES[kind] if hidden in named else "wrong"
    return kind.value


def ordered_outcomes(self_calibration: SelfCalibration, *, null: bool) -> list[str]:
    """Return the outcomes that occurred, and "right" and "wrong" always, in a fixed order.

    `null` is True for the campaigns in which nothing was hidden.
    """
    outcomes = {"right", "wrong"}.union(self_calibration.outcomes(null=null))
    return [outcome for outcome in _OUTCOMES_IN_ORDER if outcome in outcomes]


_OUTCOMES_IN_ORDER = (
    "right",
    "wrong",
    "group",
    "in part",
    "family",
    "missed",
    "unexplained",
    "below detectability",
    "data error",
)
