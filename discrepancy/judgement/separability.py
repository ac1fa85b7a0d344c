"""What a campaign can decide, before its data are looked at: detectable sizes and confusion groups.

Every effect is put on the model at its prior median; the change it makes, with all nuisances projected out,
is compared with the noise (can it be seen?) and with what every other effect can do (can it be told apart?).
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import inf, sqrt
from operator import attrgetter

import numpy as np
from scipy.sparse.csgraph import connected_components

from discrepancy.campaign.records import Campaign, FloatArray, NoiseRecord, Start, Trial
from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.errors import DiscrepancyError, said
from discrepancy.fits.candidate import PARAMETER_STEP, Candidate, Point, Term
from discrepancy.fits.fitting import fit
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Change, Screen
from discrepancy.fits.trial_data import stand_in
from discrepancy.system.interface import Model

CONFUSED = 9.0
"""Squared distance [sigma^2] below which two effects form a confusion group."""
DETECTED = 25.0
"""Squared distance from the model [sigma^2] at which an effect is found: 3 nats of Bayes factor, the cost of
its parameters and of its place in the catalogue."""


@dataclass(frozen=True)
class Detectability:
    """How well a campaign sees one effect.

    Attributes
    ----------
    effect : Effect
        Which.
    reason : str
        Why it cannot be tested here; empty if it can.
    place : str
        Where it shows best.
    distance : float
        d^2 from the model without it at the prior median [sigma^2].
    parameter : str
        The parameter that scales it.
    detectable : float
        Value of that parameter from which on it is found [unit of the parameter]; infinite if never.
    unit : str
        Of it.
    typical : float
        Its prior median (for a signed parameter one prior deviation).
    """

    effect: Effect
    reason: str
    place: str = ""
    distance: float = 0.0
    parameter: str = ""
    detectable: float = inf
    unit: str = "1"
    typical: float = 0.0


@dataclass(frozen=True)
class Separability:
    """What a campaign can and cannot decide.

    Attributes
    ----------
    detectability : tuple of Detectability
        In the order of the catalogue.
    identifiers : tuple of str
        Of the effects that can be tested, rows and columns of `distance`.
    distance : (E, E) ndarray
        d^2 of the row's effect from the nearest that the column's effect can do [sigma^2]: at its median, or
        where it is not seen there, at the size from which it is. What nobody sees is close to everything.
    groups : tuple of tuple of str
        Confusion groups of two or more.
    """

    detectability: tuple[Detectability, ...]
    identifiers: tuple[str, ...]
    distance: FloatArray
    groups: tuple[tuple[str, ...], ...]


def as_predicted(campaign: Campaign, model: Model, setting: Setting) -> Campaign:
    """Return the campaign with what the model predicts in the place of the data.

    Such data leave no rest from which an unknown noise could be told: channels without a noise record get one
    of a thousandth of their range. Where the state at the begin of a trial is not known, the data say it:
    from rest nothing would move, and nothing could be seen.
    """
    problem = Problem(campaign, model, setting)
    point = begun(problem)
    trials: list[Trial] = []
    predicted = {}
    for number, data in enumerate(problem.trials):
        response = problem.answer(number, point, Candidate())
        predicted[data.trial.name] = problem.prediction(number, point, response)
    for trial in campaign.trials:
        values = predicted.get(trial.name)
        trials.append(trial if values is None else replace(trial, values=values))
    ideal = replace(campaign, trials=tuple(trials))
    channels = {
        name: channel
        if channel.noise is not None
        else replace(channel, noise=NoiseRecord(stand_in(ideal, name), inf))
        for name, channel in campaign.channels.items()
    }
    return replace(ideal, channels=channels)


def began_before(trial: Trial) -> bool:
    """Whether a motion began before its record, in a state that only the data tell."""
    return trial.begins is Start.UNKNOWN or bool(trial.release and not trial.release.at_rest)


def begun(problem: Problem) -> Point:
    """Return the prior means, with the initial states that only the data tell, fitted with the model.

    Raises
    ------
    FitError
        As `fit`.
    """
    start = problem.start(Candidate())
    unknown = [began_before(data.trial) for data in problem.trials]
    if not any(unknown):
        return start
    # parameters follow: beside a frequency that is off, what begins would fade out of the record
    found = fit(problem, Candidate(), start).point.local
    chosen = zip(unknown, found, start.local, strict=True)
    return replace(start, local=tuple(own if free else kept for free, own, kept in chosen))


def separability(
    campaign: Campaign, model: Model, setting: Setting, effects: Sequence[Effect]
) -> Separability:
    """Return what a campaign can decide.

    Parameters
    ----------
    campaign : Campaign
        Inputs, channels and noise count; the measured values do not, but where a trial begins in a state that
        is not known. See `as_predicted`, for unknown noise too.
    model : Model
        The model as it is.
    setting : Setting
        Scales.
    effects : sequence of Effect
        The catalogue.
    """
    ideal = as_predicted(campaign, model, setting)
    problem = Problem(ideal, model, setting)
    none = fit(problem, Candidate(), begun(problem), iterations=1)
    screen = Screen(problem, none)
    rows: list[Detectability] = []
    changes: dict[str, list[Change]] = {}
    for effect in effects:
        reason = effect.unavailable(setting)
        if reason is not None:
            rows.append(Detectability(effect, reason))
            continue
        options = [
            change for place in effect.places(setting) for change in screen.changes(Term(effect, place))
        ]
        central = _references(screen, effect, effect.places(setting)) or options
        if not central:
            rows.append(Detectability(effect, "The structure cannot carry it at any size that was tried."))
            continue
        best = max(central, key=attrgetter("size"))
        if best.size < DETECTED:  # its median place may be where nothing is measured
            best = max([best, *filter(_at_reference, options)], key=attrgetter("size"))
        little, factor = screen.shrunk(best)
        rows.append(_detectability(effect, best, min(best.size, little.size / factor**2)))
        if best.size > 1e-6:
            changes[effect.identifier] = [best, *options]
    names = tuple(changes)
    small = {name: [screen.shrunk(change) for change in changes[name]] for name in names}
    distance = np.zeros((len(names), len(names)))
    for i, one in enumerate(names):
        target, (little, factor) = changes[one][0], small[one][0]
        for j, other in enumerate(names):
            if i != j:
                first_order = _distance(screen, little, [change for change, _ in small[other]]) / factor**2
                found = min(_distance(screen, target, changes[other]), first_order)
                distance[i, j] = found * max(1.0, DETECTED / target.size)
    return Separability(tuple(rows), names, distance, _groups(names, distance))


def _references(screen: Screen, effect: Effect, places: Sequence[str]) -> list[Change]:
    """Return the changes of an effect at its prior median, at the places where the structure can carry it.

    Signed magnitudes are at one prior deviation.
    """
    found = []
    for term in (Term(effect, place) for place in places):
        start = term.start()
        for number, item in enumerate(term.parameters):
            if item.magnitude and item.prior.value(0.0) == 0.0:
                start[number] = 1.0
        with suppress(DiscrepancyError):
            found.append(screen.change(term, start))
    return found


def _at_reference(change: Change) -> bool:
    """Whether the magnitude is that of `_references`."""
    return all(
        abs(u) in (0.0, 1.0)
        for item, u in zip(change.term.parameters, change.start, strict=True)
        if item.magnitude
    )


def _detectability(effect: Effect, change: Change, distance: float) -> Detectability:
    for number, item in enumerate(change.term.parameters):
        if item.magnitude:
            typical = abs(item.prior.value(float(change.start[number])))
            detectable = typical * sqrt(DETECTED / distance) if distance > 0.0 else inf
            return Detectability(
                effect, "", change.term.place, distance, item.name, detectable, item.unit, typical
            )
    return Detectability(effect, "", change.term.place, distance)


def _distance(screen: Screen, target: Change, options: list[Change]) -> float:
    """Return d^2 of a change from what an effect can do: its nearest grid point, moved by its parameters."""
    sign = screen.sign
    if target.size <= 0.0:
        return 0.0

    def overlap(option: Change) -> float:
        return (
            abs(float(target.vector * sign @ option.vector)) / sqrt(option.size) if option.size > 0.0 else 0.0
        )

    nearest = max(options, key=overlap)
    if nearest.size <= 0.0:
        return target.size
    columns = [nearest.vector]
    for number in range(len(nearest.start)):
        moved = nearest.start.copy()
        moved[number] += 10.0 * PARAMETER_STEP
        with suppress(DiscrepancyError):  # the nearest point may be the last that the model can follow
            columns.append(screen.change(nearest.term, moved).vector - nearest.vector)
    span = np.stack(columns)
    gram = (span * sign) @ span.T
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    gram = gram / np.outer(scale, scale) + 1e-6 * np.eye(len(gram))
    right = (span * sign) @ target.vector / scale
    return max(target.size - float(right @ np.linalg.solve(gram, right)), 0.0)


def _groups(names: tuple[str, ...], distance: FloatArray) -> tuple[tuple[str, ...], ...]:
    """Return connected sets of effects that are closer than `CONFUSED` in either direction."""
    _, labels = connected_components(np.minimum(distance, distance.T) < CONFUSED)
    sets = (np.flatnonzero(labels == label) for label in range(labels.max(initial=-1) + 1))
    return tuple(tuple(names[i] for i in found) for found in sets if len(found) > 1)


def usable(effects: Sequence[Effect], setting: Setting) -> tuple[Effect, ...]:
    """Return the effects that can be tested here.

    Raises
    ------
    DiscrepancyError
        If there is none.
    """
    found = tuple(effect for effect in effects if effect.unavailable(setting) is None)
    if not found:
        raise DiscrepancyError(said("effects.none_testable"))
    return found
