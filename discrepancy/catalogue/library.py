"""The catalogue: the effects that come with the package, and those that a user adds."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

from discrepancy.catalogue.effect_file import effects_of_file
from discrepancy.catalogue.effect_in_setting import DYNAMIC
from discrepancy.catalogue.entry import Effect, EffectParameter, Setting, ShapeParameter
from discrepancy.errors import CatalogueError
from fe.runtime.errors import PlugInError
from fe.runtime.patch import SENSORS, ModelPatch, Window
from fe.runtime.plug_ins import load_plug_ins
from reporting.choices import did_you_mean

THEMES = (
    "structure",
    "damping",
    "stiffness",
    "hysteresis",
    "outflow",
    "sensors",
    "loads",
    "clock_and_lines",
)
"""Files of the effects that come with the package, in their order."""
GROUP = "uav_twin.effects"
"""Group of entry points.

Each is a function without arguments that returns one Effect or several.
"""
_IDENTIFIER = re.compile(r"[a-z][a-z0-9_]*")


@cache
def library() -> tuple[Effect, ...]:
    """Return the effects that come with the package, by theme."""
    folder = Path(__file__).parent
    return tuple(effect for theme in THEMES for effect in effects_of_file(folder / f"{theme}.toml"))


def effects_of_entry_points() -> tuple[Effect, ...]:
    """Return the effects that installed packages add to the catalogue.

    A package adds effects by an entry point of the group `GROUP`: a function without arguments
    that returns an effect or several. The effects are sorted by the names of their entry points.

    Raises
    ------
    CatalogueError
        If two entry points have the same name, or one fails or returns something other than
        effects. The message names the entry point and its package.
    """
    all_effects: list[Effect] = []
    with CatalogueError.instead_of(PlugInError):
        plug_ins = load_plug_ins(GROUP)
    for plug_in in plug_ins:
        if not callable(plug_in.value):
            raise CatalogueError(
                f"{plug_in.subject} must be a function that returns effects, but is "
                f"{plug_in.value!r}."
            )
        try:
            returned = plug_in.value()
        except Exception as cause:  # the function of a plug-in may fail with any error
            raise CatalogueError(
                f"{plug_in.subject} failed: {type(cause).__name__}: {cause}. Mend the package, or "
                "uninstall it."
            ) from cause
        effects = tuple(returned) if isinstance(returned, Iterable) else (returned,)
        for effect in effects:
            if not isinstance(effect, Effect):
                raise CatalogueError(
                    f"{plug_in.subject} must return effects, but returned a "
                    f"{type(effect).__name__}."
                )
        all_effects += effects
    return tuple(all_effects)


def load_catalogue(
    extra: Iterable[Effect | Path] = (), *, installed: bool = True
) -> tuple[Effect, ...]:
    """Return the effects of the package, followed by those of installed packages and of a user.

    Parameters
    ----------
    extra : iterable of Effect or Path
        Further effects, or TOML files of them (`discrepancy.catalogue.effect_file`).
    installed : bool
        False to leave out the entry points of the group "uav_twin.effects".

    Raises
    ------
    CatalogueError
        If an entry cannot be read, is not sound, or has an identifier that is taken.
    """
    effects = [*library()]
    if installed:
        effects += effects_of_entry_points()
    for effect_or_file in extra:
        if isinstance(effect_or_file, Effect):
            effects.append(effect_or_file)
        else:
            effects += effects_of_file(effect_or_file)
    check_effects(effects)
    return tuple(effects)


def effect_by_identifier(identifier: str, effects: Iterable[Effect]) -> Effect:
    """Return the effect with an identifier; raise `CatalogueError` if there is none."""
    effects_by_identifier = {effect.identifier: effect for effect in effects}
    if identifier not in effects_by_identifier:
        raise CatalogueError(
            f"The catalogue has no effect {identifier!r}; it has "
            f"{', '.join(effects_by_identifier)}."
            f"{did_you_mean(identifier, effects_by_identifier)}"
        )
    return effects_by_identifier[identifier]


def variants_in_events(effects: Sequence[Effect], setting: Setting) -> tuple[Effect, ...]:
    """Return variants of effects that act only during an event, as further hypotheses.

    Such a variant acts from the start of the event to its end, which the campaign states, in all
    trials that have the event, also in held-out ones. Effects that cannot be limited to a window of
    time, or that the model cannot switch on and off, have no variant.

    Parameters
    ----------
    effects : sequence of Effect
        Effects of the catalogue.
    setting : Setting
        Campaign and model.

    Returns
    -------
    tuple of Effect
        Variants of the effects, event by event; empty if no fitted trial has an event.
    """
    names_of_fitted_trials = {trial.name for trial in setting.campaign.fitted}
    event_names: list[str] = []
    for event in setting.campaign.events:
        is_fitted = not names_of_fitted_trials.isdisjoint(event.trials)
        if is_fitted and event.name not in event_names:
            event_names.append(event.name)
    if not event_names:
        return ()
    switchable_effects = [effect for effect in effects if _can_act_in_windows(effect, setting)]
    variants = []
    for name in event_names:
        for effect in switchable_effects:
            variants.append(_variant_in_event(effect, name, setting))
    return tuple(variants)


def _can_act_in_windows(effect: Effect, setting: Setting) -> bool:
    """Return whether an effect can be limited to windows of time with this model.

    The effect must act in dynamic trials, have no windows of its own, and consist of primitives
    that allow windows. The model must be able to switch laws in time, unless the effect concerns
    sensors only.
    """
    places = effect.places(setting)
    if not places or not effect.acts_on & DYNAMIC:
        return False
    # any values of the parameters show of which primitives the patch consists
    values = {parameter.name: parameter.prior.value(0.5) for parameter in effect.parameters}
    patch = effect.patch(setting, values, places[0])
    has_other_windows = patch.has_windows
    primitives_allow_it = all(primitive.can_act_in_windows for primitive in patch)
    if not len(patch) or has_other_windows or not primitives_allow_it:
        return False
    only_sensors = all(isinstance(primitive, SENSORS) for primitive in patch)
    return setting.model.follows_windows or only_sensors


def _variant_in_event(effect: Effect, event_name: str, setting: Setting) -> Effect:
    """Return the variant of an effect that acts only during the events of a given name."""
    windows: list[Window] = []
    for event in setting.campaign.events:
        if event.name == event_name:
            windows += [Window(trial, event.time, event.until) for trial in event.trials]

    def build(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
        patch = effect.build(setting, values, place)
        return ModelPatch(tuple(replace(primitive, windows=tuple(windows)) for primitive in patch))

    return replace(
        effect,
        identifier=f"{effect.identifier}_during_{event_name}",
        name=f"{effect.name} during {event_name}",
        variant_of=effect.identifier,
        acts_on=effect.acts_on & DYNAMIC,
        build=build,
    )


def with_prior_weights(effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """Give effects with a stated frequency prior weights in proportion to their frequencies.

    An effect without a frequency keeps its weight. The effects with a frequency have, in total, as
    much weight as the same number of effects of weight 1. This total is divided among kinds of
    effects by their frequencies, and within a kind evenly among the effect and its variants in
    events.
    """
    frequencies: dict[str, float] = {}  # by kind, as the counts
    variant_counts: Counter[str] = Counter()
    for effect in effects:
        if effect.relative_frequency is not None:
            frequencies[effect.kind] = effect.relative_frequency
            variant_counts[effect.kind] += 1
    effects_per_frequency = (
        variant_counts.total() / sum(frequencies.values()) if frequencies else 0.0
    )
    weighted_effects = []
    for effect in effects:
        if effect.kind in frequencies:
            weight_of_kind = effects_per_frequency * frequencies[effect.kind]
            weight = weight_of_kind / variant_counts[effect.kind]
            effect = replace(effect, prior_weight=weight)
        weighted_effects.append(effect)
    return tuple(weighted_effects)


def check_effects(effects: Iterable[Effect]) -> None:
    """Raise `CatalogueError` for the first effect that is not valid, or if identifiers clash.

    An effect that names an unknown effect as confusable is not valid either.
    """
    effects = tuple(effects)
    counts = Counter(effect.identifier for effect in effects)
    for effect in effects:
        for message in _faults_of_effect(effect):
            raise CatalogueError(message)
    for identifier, count in counts.items():
        if count > 1:
            raise CatalogueError(
                f"The catalogue has {count} effects with the identifier {identifier!r}."
            )
    for effect in effects:
        for confusable in effect.confusable:
            if confusable not in counts or confusable == effect.identifier:
                raise CatalogueError(
                    f"The effect {effect.identifier!r} names {confusable!r} as confusable, which "
                    "is not another effect of the catalogue."
                )


def _faults_of_effect(effect: Effect) -> Iterator[str]:
    """Yield a message for each fault of an effect."""
    subject = f"The effect {effect.identifier!r}"
    if not (effect.name and _IDENTIFIER.fullmatch(str(effect.identifier))):
        yield (
            f"{subject} must have a name, and an identifier of lower-case letters, digits and "
            "underscores."
        )
    if not effect.acts_on:
        yield f"{subject} does not say which trials it acts on."
    if not effect.parameters:
        yield f"{subject} has no parameters."
    parameters: tuple[EffectParameter | ShapeParameter, ...] = (*effect.parameters, *effect.shape)
    for name, count in Counter(parameter.name for parameter in parameters).items():
        if count > 1:
            yield f"{subject} has {count} parameters with the name {name!r}."
    if effect.relative_frequency is not None and effect.relative_frequency <= 0.0:
        yield (
            f"{subject} must have a positive relative_frequency, but has "
            f"{effect.relative_frequency:g}."
        )
    for parameter in parameters:
        prior = parameter.prior
        subject_of_parameter = f"{subject}, parameter {parameter.name!r}"
        if not prior.low < prior.high:
            yield (
                f"{subject_of_parameter}: the prior must have low < high, but has {prior.low:g}, "
                f"{prior.high:g}."
            )
        if prior.shape == "log_normal" and prior.low <= 0.0:
            yield (
                f"{subject_of_parameter}: a log-normal prior must have low > 0, but has "
                f"{prior.low:g}."
            )
    for shape_parameter in effect.shape:
        prior = shape_parameter.prior
        if not prior.low < shape_parameter.canonical < prior.high:
            yield (
                f"{subject}: the canonical value {shape_parameter.canonical:g} of "
                f"{shape_parameter.name!r} must lie between {prior.low:g} and {prior.high:g}."
            )
