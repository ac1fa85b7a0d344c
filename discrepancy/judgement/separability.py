"""Which effects a campaign can detect and tell apart, before its data are compared with the model.

Every effect is added to the model at the median of its prior. The part of the change of the
readings that nuisances cannot compensate is compared with the noise, which shows whether the effect
can be detected, and with the changes that every other effect can make, which shows whether the two
can be told apart. A *confusion group* is a set of effects that cannot. Squared distances are in
units of the noise variance, sigma^2.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from math import inf, isfinite, sqrt
from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components

from discrepancy.campaign.records import Campaign, FloatArray, NoiseRecord, Start, Trial
from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import PARAMETER_STEP, Candidate, EffectTerm, Point
from discrepancy.fits.fitting import fit
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Screen, ScreenedChange
from discrepancy.fits.trial_data import stand_in_deviation
from discrepancy.system.interface import Model
from reporting.arrays import LEAST_DIVISOR

from .noise_forecast import NoiseForecast

CONFUSION_DISTANCE = 9.0
"""Squared distance below which two effects form a confusion group [sigma^2]."""
DETECTION_DISTANCE = 25.0
"""Squared distance from the model at which an effect is found [sigma^2]: 3 nats of Bayes factor,
the cost of its parameters and of its place in the catalogue."""
VISIBILITY_DISTANCE = 1e-6
"""Squared distance from the model below which an effect is not compared with others [sigma^2]."""


@dataclass(frozen=True)
class Detectability:
    """How well a campaign can detect one effect.

    Attributes
    ----------
    effect : Effect
        The effect of the catalogue.
    reason : str
        The reason why the campaign cannot test it; empty if it can.
    place : str
        The place at which the effect changes the readings most.
    distance : float
        The squared distance of the effect at its prior median from the model without it [sigma^2],
        or, if that is less, that of a small effect scaled up to the median.
    parameter : str
        The name of the parameter that is the magnitude of the effect.
    detectable : float
        The least detectable value of that parameter [unit of the parameter]; infinite if none
        is.
    unit : str
        The unit of the parameter.
    typical : float
        The prior median of the parameter (one prior deviation for a signed one).
    noise_factor : float
        How many times smaller the noise would have to be for the effect to be detected at that
        median; 1 if it is detected, infinite if less noise would not help.
    imitated_by : tuple of str
        If less noise would not help, the unknowns that can change the readings as the effect does,
        with what is stated of them.
    """

    effect: Effect
    reason: str
    place: str = ""
    distance: float = 0.0
    parameter: str = ""
    detectable: float = inf
    unit: str = "1"
    typical: float = 0.0
    noise_factor: float = 1.0
    imitated_by: tuple[str, ...] = ()


@dataclass(frozen=True)
class Confusion:
    """Two effects that a campaign cannot tell apart.

    Attributes
    ----------
    true_term : EffectTerm
        The effect that acts, at the place at which it changes the readings most.
    true_values : (E,) array
        Its scaled parameters.
    other_effect : Effect
        The effect that can change the readings nearly as it does.
    """

    true_term: EffectTerm
    true_values: FloatArray
    other_effect: Effect

    @property
    def effects(self) -> frozenset[str]:
        """The identifiers of both effects."""
        return frozenset((self.true_term.effect.identifier, self.other_effect.identifier))


@dataclass(frozen=True)
class Separability:
    """Which effects a campaign can detect, and which it can tell apart.

    Attributes
    ----------
    detectability : tuple of Detectability
        How well each effect can be detected, in the order of the catalogue.
    identifiers : tuple of str
        The effects that can be tested: the rows and columns of `distance`.
    distance : (E, E) array
        The squared distance of the change due to the row's effect from the nearest change that the
        column's effect can make [sigma^2]. The row's effect is at its prior median, or at the least
        detectable size if that is larger.
    groups : tuple of tuple of str
        The confusion groups of two or more effects.
    confusions : tuple of Confusion
        Each pair of effects that are closer than `CONFUSION_DISTANCE`, in the direction in which
        they are closer.
    """

    detectability: tuple[Detectability, ...]
    identifiers: tuple[str, ...]
    distance: FloatArray
    groups: tuple[tuple[str, ...], ...]
    confusions: tuple[Confusion, ...]


# ---------------------------------------------------------------- a campaign as predicted


def campaign_as_predicted(campaign: Campaign, model: Model, setting: Setting) -> Campaign:
    """Return a campaign in which the readings of the fitted trials are those that a model predicts.

    Such readings leave no residuals from which an unrecorded noise could be estimated. So a channel
    without a noise record gets one, of a thousandth of its range. An unknown initial state of a
    trial is fitted to the measured readings, since without it nothing would move.

    Parameters
    ----------
    setting : Setting
        The scales by which the catalogue states its priors.
    """
    problem = Problem(campaign, model, setting)
    point = prior_point_with_initial_states(problem)
    predictions = {}
    for trial_index, data in enumerate(problem.trials):
        response = problem.response_of_candidate(trial_index, point, Candidate())
        predictions[data.trial.name] = problem.prediction(trial_index, point, response)
    trials: list[Trial] = []
    for trial in campaign.trials:
        if trial.name in predictions:
            trial = replace(trial, values=predictions[trial.name])
        trials.append(trial)
    predicted_campaign = replace(campaign, trials=tuple(trials))
    channels = dict(campaign.channels)
    for name, channel in campaign.channels.items():
        if channel.noise is None:
            noise = NoiseRecord(stand_in_deviation(predicted_campaign, name), inf)
            channels[name] = replace(channel, noise=noise)
    return replace(predicted_campaign, channels=channels)


def has_free_initial_state(trial: Trial) -> bool:
    """Return whether a trial begins in an unknown state, which only its readings can show."""
    if trial.begins is Start.UNKNOWN:
        return True
    return trial.release is not None and not trial.release.at_rest


def prior_point_with_initial_states(problem: Problem) -> Point:
    """Return the point of the prior means, with unknown initial states fitted to the data.

    Raises
    ------
    FitError
        If the model gives numbers that are not finite.
    """
    start = problem.prior_mean_point(Candidate())
    if not any(has_free_initial_state(data.trial) for data in problem.trials):
        return start
    # parameters are fitted, too: with a wrong frequency the initial motion would fade out
    fitted_point = fit(problem, Candidate(), start).point
    local_unknowns = []
    for data, fitted_unknowns, prior_unknowns in zip(
        problem.trials, fitted_point.local, start.local, strict=True
    ):
        is_free = has_free_initial_state(data.trial)
        local_unknowns.append(fitted_unknowns if is_free else prior_unknowns)
    return replace(start, local=tuple(local_unknowns))


# ---------------------------------------------------------------- detection and separation


def compute_separability(
    campaign: Campaign, model: Model, setting: Setting, effects: Sequence[Effect]
) -> Separability:
    """Return which effects a campaign can detect, and which it can tell apart.

    Parameters
    ----------
    campaign : Campaign
        The campaign with its inputs, channels and noise records. The readings are used only to
        determine unknown initial states, see `campaign_as_predicted`.
    setting : Setting
        The scales by which the catalogue states its priors.
    """
    problem = Problem(campaign_as_predicted(campaign, model, setting), model, setting)
    start = prior_point_with_initial_states(problem)
    no_effect = fit(problem, Candidate(), start, iterations=1)
    screen = Screen(problem, no_effect)
    forecast = NoiseForecast(problem, no_effect)
    detectability: list[Detectability] = []
    visible_effects: list[_VisibleEffect] = []
    for effect in effects:
        reason = effect.unavailable(setting)
        if reason is not None:
            detectability.append(Detectability(effect, reason))
            continue
        grid_changes = _all_changes(screen, effect)
        reference = _reference_change(screen, effect, grid_changes)
        if reference is None:
            reason = "The structure cannot carry it at any size that was tried."
            detectability.append(Detectability(effect, reason))
            continue
        # A large change may saturate, for example if it shifts phases by more than a radian. The
        # squared distance of the small change, scaled back to the reference, is taken if smaller.
        small_reference = _SmallChange(*screen.shrink_change(reference))
        distance = min(
            reference.squared_length,
            small_reference.change.squared_length / small_reference.factor**2,
        )
        row = _detectability(effect, reference, distance)
        if distance < DETECTION_DISTANCE:
            row = _with_forecast(row, reference, small_reference, forecast)
        detectability.append(row)
        if reference.squared_length > VISIBILITY_DISTANCE:
            visible_effects.append(
                _VisibleEffect(effect.identifier, reference, [reference, *grid_changes])
            )
    identifiers = tuple(effect.identifier for effect in visible_effects)
    distance_matrix = _distances(screen, visible_effects)
    return Separability(
        detectability=tuple(detectability),
        identifiers=identifiers,
        distance=distance_matrix,
        groups=_confusion_groups(identifiers, distance_matrix),
        confusions=tuple(_confusions(visible_effects, distance_matrix)),
    )


class _VisibleEffect(NamedTuple):
    """An effect that changes the readings.

    Attributes
    ----------
    identifier : str
        The identifier of the effect.
    reference : ScreenedChange
        The change at its prior median, see `_reference_change`.
    options : list of ScreenedChange
        The changes over a grid of its parameters and places, the reference first.
    """

    identifier: str
    reference: ScreenedChange
    options: list[ScreenedChange]


class _SmallChange(NamedTuple):
    """A change that is linear in its magnitude, and the factor by which it was made smaller."""

    change: ScreenedChange
    factor: float


def _all_changes(screen: Screen, effect: Effect) -> list[ScreenedChange]:
    """Return the changes due to an effect over the grid of its parameters, at all its places."""
    changes: list[ScreenedChange] = []
    for place in effect.places(screen.problem.setting):
        changes.extend(screen.changes_on_grid(EffectTerm(effect, place)))
    return changes


def _reference_change(
    screen: Screen, effect: Effect, options: Sequence[ScreenedChange]
) -> ScreenedChange | None:
    """Return the largest change of the readings due to an effect at its prior median.

    If the change is not detectable, the other parameters, such as a place along the span, are
    varied as in `options`, the changes over a grid. If the model cannot be evaluated at the median,
    the largest of the options is returned, and None if there are none.
    """
    references = _changes_at_prior_median(screen, effect) or options
    if not references:
        return None
    largest_change = _largest_change(references)
    # the median of a place along the span may be where nothing is measured
    if largest_change.squared_length < DETECTION_DISTANCE:
        at_reference = [change for change in options if _has_reference_magnitude(change)]
        largest_change = _largest_change([largest_change, *at_reference])
    return largest_change


def _largest_change(changes: Sequence[ScreenedChange]) -> ScreenedChange:
    """Return the largest change, and of those that differ by rounding errors alone the first."""
    largest = max(change.squared_length for change in changes)
    return next(change for change in changes if change.squared_length >= largest * (1.0 - 1e-9))


def _changes_at_prior_median(screen: Screen, effect: Effect) -> list[ScreenedChange]:
    """Return the changes due to an effect at its prior median, one for each of its places.

    A signed magnitude, whose median is zero, is at one prior deviation. Places at which the model
    cannot be evaluated with the effect are left out.
    """
    changes = []
    for place in effect.places(screen.problem.setting):
        term = EffectTerm(effect, place)
        start = term.start_values()
        for index, parameter in enumerate(term.parameters):
            if parameter.magnitude and parameter.prior.value(0.0) == 0.0:
                start[index] = 1.0
        with suppress(DiscrepancyError):
            changes.append(screen.change_by_effect(term, start))
    return changes


def _has_reference_magnitude(change: ScreenedChange) -> bool:
    """Return whether a change has magnitudes as in `_changes_at_prior_median`."""
    for parameter, scaled_value in zip(change.term.parameters, change.effect_values, strict=True):
        if parameter.magnitude and abs(scaled_value) not in (0.0, 1.0):
            return False
    return True


def _detectability(effect: Effect, change: ScreenedChange, distance: float) -> Detectability:
    """Return how well an effect can be detected.

    `distance` is the squared distance of the effect at its reference magnitude from the model
    without it [sigma^2]. It grows with the square of the magnitude, so the least detectable
    magnitude is typical * sqrt(DETECTION_DISTANCE / distance).
    """
    for index, parameter in enumerate(change.term.parameters):
        if parameter.magnitude:
            typical_value = abs(parameter.prior.value(float(change.effect_values[index])))
            least_detectable_value = (
                typical_value * sqrt(DETECTION_DISTANCE / distance) if distance > 0.0 else inf
            )
            return Detectability(
                effect=effect,
                reason="",
                place=change.term.place,
                distance=distance,
                parameter=parameter.name,
                detectable=least_detectable_value,
                unit=parameter.unit,
                typical=typical_value,
            )
    return Detectability(effect, "", change.term.place, distance)


def _with_forecast(
    row: Detectability,
    reference: ScreenedChange,
    small_reference: "_SmallChange",
    forecast: NoiseForecast,
) -> Detectability:
    """Return the record of an undetected effect with the noise at which it would be detected.

    If less noise would not help, the unknowns that imitate the effect are added. `small_reference`
    is the reference change at a small magnitude.
    """
    if row.distance <= 0.0:
        return replace(row, noise_factor=inf)
    # both distances count, since a large change may saturate
    small_distance = DETECTION_DISTANCE * small_reference.factor**2
    factor = max(
        forecast.needed_noise_reduction(reference, DETECTION_DISTANCE),
        forecast.needed_noise_reduction(small_reference.change, small_distance),
    )
    imitated_by = () if isfinite(factor) else forecast.imitating_unknowns(reference)
    return replace(row, noise_factor=factor, imitated_by=imitated_by)


# ---------------------------------------------------------------- distances


def _distances(screen: Screen, effects: Sequence[_VisibleEffect]) -> FloatArray:
    """Return the squared distance of each effect from the nearest change by each other effect.

    The effects are compared at their prior medians and at small magnitudes, and the smaller
    distance is taken: effects that differ at their medians may be alike to first order.

    Returns
    -------
    (E, E) array
        The distances, see `Separability.distance` [sigma^2].
    """
    small_changes = [_small_changes(screen, effect) for effect in effects]
    references = [effect.reference for effect in effects]
    # the first option of an effect is its reference
    small_references = [changes_of_effect[0] for changes_of_effect in small_changes]
    small_targets = [small_reference.change for small_reference in small_references]
    # scale back to the reference: squared distances grow with the square of the magnitude
    growth = np.array([1.0 / reference.factor**2 for reference in small_references])
    distance = np.zeros((len(effects), len(effects)))
    for j, other_effect in enumerate(effects):
        reachable = _ReachableChanges(screen, other_effect.options)
        small_reachable = _ReachableChanges(
            screen, [small_change.change for small_change in small_changes[j]]
        )
        at_reference = reachable.squared_distances(references)
        to_first_order = small_reachable.squared_distances(small_targets) * growth
        distance[:, j] = np.minimum(at_reference, to_first_order)
    # an effect whose reference cannot be detected is compared at the least magnitude that can
    squared_lengths = np.array([reference.squared_length for reference in references])
    distance *= np.maximum(1.0, DETECTION_DISTANCE / squared_lengths)[:, None]
    np.fill_diagonal(distance, 0.0)
    return distance


def _confusions(effects: Sequence[_VisibleEffect], distance: FloatArray) -> Iterator[Confusion]:
    """Yield the pairs of effects that are confused, given their distances (E, E) [sigma^2]."""
    for pair in combinations(range(len(effects)), 2):
        row, column = min((pair, pair[::-1]), key=lambda indices: distance[indices])
        if distance[row, column] >= CONFUSION_DISTANCE:
            continue
        reference = effects[row].reference
        # an effect that is not detected at its reference is compared at the least size that is
        factor = max(1.0, sqrt(DETECTION_DISTANCE / reference.squared_length))
        yield Confusion(
            true_term=reference.term,
            true_values=reference.term.multiply_magnitudes(reference.effect_values, factor),
            other_effect=effects[column].options[0].term.effect,
        )


def _small_changes(screen: Screen, effect: _VisibleEffect) -> list[_SmallChange]:
    """Return the changes of an effect, made so small that they are linear in its magnitude."""
    small_changes = []
    for option in effect.options:
        change, factor = screen.shrink_change(option)
        small_changes.append(_SmallChange(change, factor))
    return small_changes


class _LinearSpace(NamedTuple):
    """The linear space of the changes that an effect can make near one of them.

    Attributes
    ----------
    directions : (B, D) array
        The changes that span the space, scaled to unit length.
    gram : (B, B) array
        Their inner products.
    """

    directions: FloatArray
    gram: FloatArray


class _ReachableChanges:
    """All changes of the readings that an effect can make, and distances of others from them.

    Near each of the options they are approximated by a linear space. It is spanned by the option,
    and by its differences when the parameters of the effect are varied.

    Parameters
    ----------
    screen : Screen
        The fit whose inner product measures distances.
    options : sequence of ScreenedChange
        The changes due to the effect over a grid of its parameters.
    """

    def __init__(self, screen: Screen, options: Sequence[ScreenedChange]) -> None:
        self._screen = screen
        self._options = options
        self._spaces: dict[int, _LinearSpace] = {}  # by the number of the option

    def squared_distances(self, targets: Sequence[ScreenedChange]) -> FloatArray:
        """Return the squared distances (T,) of T changes from the nearest reachable ones [sigma^2].

        The nearest option is the one closest in direction.
        """
        return np.array(
            [
                self._squared_distance(target, option_number)
                for target, option_number in zip(
                    targets, self._nearest_options(targets), strict=True
                )
            ]
        )

    def _nearest_options(self, targets: Sequence[ScreenedChange]) -> list[int]:
        """Return the number of the option that is nearest in direction to each target."""
        signed_options = np.array([option.vector for option in self._options])
        signed_options *= self._screen.inner_product_signs
        target_vectors = np.array([target.vector for target in targets])
        products = np.abs(signed_options @ target_vectors.T)  # (options, targets)
        squared_lengths = np.array([option.squared_length for option in self._options])
        inverse_lengths = np.zeros(len(self._options))
        has_length = squared_lengths > 0.0
        inverse_lengths[has_length] = 1.0 / np.sqrt(squared_lengths[has_length])
        cosines = products * inverse_lengths[:, None]  # times the length of the target
        nearest: list[int] = np.argmax(cosines, axis=0).tolist()
        return nearest

    def _squared_distance(self, target: ScreenedChange, option_number: int) -> float:
        """Return the squared distance of a change from the linear space near an option."""
        if target.squared_length <= 0.0:
            return 0.0
        if self._options[option_number].squared_length <= 0.0:
            return target.squared_length
        if option_number not in self._spaces:
            self._spaces[option_number] = self._space_near(self._options[option_number])
        space = self._spaces[option_number]
        overlaps = space.directions @ (self._screen.inner_product_signs * target.vector)
        explained_squares = float(overlaps @ np.linalg.solve(space.gram, overlaps))
        return max(target.squared_length - explained_squares, 0.0)

    def _space_near(self, option: ScreenedChange) -> _LinearSpace:
        """Return the linear space near an option.

        The differences by the parameters are taken over ten times the step of derivatives. A small
        multiple of the identity is added to the inner products, because changes by several
        parameters may be nearly parallel.
        """
        changes = [option.vector]
        for index in range(len(option.effect_values)):
            stepped_values = option.effect_values.copy()
            stepped_values[index] += 10.0 * PARAMETER_STEP
            with suppress(DiscrepancyError):  # the option may be at the limit of the model
                change = self._screen.change_by_effect(option.term, stepped_values)
                changes.append(change.vector - option.vector)
        directions = np.stack(changes)
        sign = self._screen.inner_product_signs
        squared_lengths = np.sum(directions * sign * directions, axis=1)
        directions /= np.sqrt(np.maximum(squared_lengths, LEAST_DIVISOR))[:, None]
        gram = (directions * sign) @ directions.T + 1e-6 * np.eye(len(directions))
        return _LinearSpace(directions, gram)


def _confusion_groups(
    identifiers: Sequence[str], distance: FloatArray
) -> tuple[tuple[str, ...], ...]:
    """Return the connected sets of effects that these data cannot tell apart.

    Two effects are connected if they are closer than `CONFUSION_DISTANCE` in either direction.
    """
    is_confused = np.minimum(distance, distance.T) < CONFUSION_DISTANCE
    _, labels = connected_components(is_confused)
    groups = []
    for label in range(labels.max(initial=-1) + 1):
        indices = np.flatnonzero(labels == label).tolist()
        if len(indices) > 1:
            groups.append(tuple(identifiers[index] for index in indices))
    return tuple(groups)


def usable_effects(effects: Sequence[Effect], setting: Setting) -> tuple[Effect, ...]:
    """Return the effects of a catalogue that can be tested with a campaign and model.

    Raises
    ------
    DiscrepancyError
        If no effect can be tested.
    """
    usable_catalogue = tuple(effect for effect in effects if effect.unavailable(setting) is None)
    if not usable_catalogue:
        raise DiscrepancyError(
            "No effect of the catalogue can be tested with this campaign and model: the campaign "
            "needs static, ring-down, forced or flight trials whose channels are outputs of the "
            "model."
        )
    return usable_catalogue
