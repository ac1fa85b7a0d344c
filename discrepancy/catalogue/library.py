"""The catalogue: the effects that come with the package, and those that a user adds."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

from discrepancy.catalogue.effect_file import effects_of_file
from discrepancy.catalogue.effect_in_setting import DYNAMIC
from discrepancy.catalogue.entry import Effect, EffectParameter, Setting, ShapeParameter
from discrepancy.errors import CatalogueError
from fe.runtime.patch import SENSORS, ModelPatch, Window

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
    """Return the effects of installed packages that offer some, by the name of the entry point.

    Raises
    ------
    CatalogueError
        If an entry point fails or does not return effects; the sentence names it.
    """
    all_effects: list[Effect] = []
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        subject = f"The entry point {point.name!r} of the group {GROUP!r}"
        try:
            returned = point.load()()
        except Exception as cause:
            raise CatalogueError(f"{subject} failed: {type(cause).__name__}: {cause}.") from cause
        effects = tuple(returned) if isinstance(returned, Iterable) else (returned,)
        for effect in effects:
            if not isinstance(effect, Effect):
                raise CatalogueError(
                    f"{subject} must return effects, but returned a {type(effect).__name__}."
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
    check(effects)
    return tuple(effects)


def effect_by_identifier(identifier: str, effects: Iterable[Effect]) -> Effect:
    """Return the effect of an identifier; raise `CatalogueError` with the known ones otherwise."""
    known = {effect.identifier: effect for effect in effects}
    if identifier not in known:
        raise CatalogueError(
            f"The catalogue has no effect {identifier!r}; it has {', '.join(known)}."
        )
    return known[identifier]


def in_events(effects: Sequence[Effect], setting: Setting) -> tuple[Effect, ...]:
    """Return the effects as they act during each event of a campaign, as further hypotheses.

    An effect acts in the trials that have the event, held-out ones too, from its begin to its end;
    the moments are not fitted. Effects that cannot act in a window of time, or whose law the model
    cannot switch, are left out.

    Parameters
    ----------
    effects : sequence of Effect
        Effects of the catalogue.
    setting : Setting
        Campaign and model.

    Returns
    -------
    tuple of Effect
        Effects in the order of events; none without events in fitted trials.
    """
    fitted = {trial.name for trial in setting.campaign.fitted}
    events = [event for event in setting.campaign.events if fitted.intersection(event.trials)]
    names = dict.fromkeys(event.name for event in events)
    if not names:
        return ()
    switched = [effect for effect in effects if _can_act_in_windows(effect, setting)]
    return tuple(_during_event(effect, name, setting) for name in names for effect in switched)


def _can_act_in_windows(effect: Effect, setting: Setting) -> bool:
    """Return whether an effect can act in windows of time of this model's trials."""
    places = effect.places(setting)
    if not places or not effect.acts_on & DYNAMIC:
        return False
    values = {parameter.name: parameter.prior.value(0.5) for parameter in effect.parameters}
    patch = effect.patch(setting, values, places[0])
    has_other_windows = patch.has_windows
    primitives_allow_it = all(primitive.can_act_in_windows for primitive in patch)
    if not len(patch) or has_other_windows or not primitives_allow_it:
        return False
    only_sensors = all(isinstance(primitive, SENSORS) for primitive in patch)
    return setting.model.follows_windows or only_sensors


def _during_event(effect: Effect, event_name: str, setting: Setting) -> Effect:
    """Return an effect as it acts during the events of a name."""
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
        acts_on=effect.acts_on & DYNAMIC,
        build=build,
    )


def check(effects: Iterable[Effect]) -> None:
    """Raise `CatalogueError` for the first effect that is not sound."""
    effects = tuple(effects)
    counts = Counter(effect.identifier for effect in effects)
    for effect in effects:
        for fault in _faults(effect):
            raise CatalogueError(f"The effect {effect.identifier!r}{fault}")
    for identifier, count in counts.items():
        if count > 1:
            raise CatalogueError(
                f"The catalogue has {count} effects with the identifier {identifier!r}."
            )
    for effect in effects:
        for other in effect.confusable:
            if other not in counts or other == effect.identifier:
                raise CatalogueError(
                    f"The effect {effect.identifier!r} names {other!r} as confusable, which is no "
                    "other effect of the catalogue."
                )


def _faults(effect: Effect) -> Iterator[str]:
    """Yield what is not sound in an effect, as the end of a sentence about it."""
    if not (effect.name and _IDENTIFIER.fullmatch(str(effect.identifier))):
        yield " must have a name, and an identifier of lower-case letters, digits and underscores."
    if not effect.acts_on:
        yield " does not say which trials it acts on."
    if not effect.parameters:
        yield " has no parameters."
    parameters: tuple[EffectParameter | ShapeParameter, ...] = (*effect.parameters, *effect.shape)
    for name, count in Counter(parameter.name for parameter in parameters).items():
        if count > 1:
            yield f" has {count} parameters with the name {name!r}."
    for parameter in parameters:
        prior = parameter.prior
        place = f", parameter {parameter.name!r}: "
        if not prior.low < prior.high:
            yield f"{place}the prior must have low < high, but has {prior.low:g}, {prior.high:g}."
        if prior.shape == "log_normal" and prior.low <= 0.0:
            yield f"{place}a log-normal prior must have low > 0, but has {prior.low:g}."
    for shape in effect.shape:
        prior = shape.prior
        if not prior.low < shape.canonical < prior.high:
            yield (
                f": the canonical value {shape.canonical:g} of {shape.name!r} must lie between "
                f"{prior.low:g} and {prior.high:g}."
            )
