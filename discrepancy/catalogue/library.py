"""The catalogue: the effects that come with the package, and those that a user adds."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

from discrepancy.errors import CatalogueError, said
from fe.runtime.patch import SENSORS, ModelPatch, Window

from .effect_file import effects_of_file
from .entry import Effect, EffectParameter, Setting, ShapeParameter
from .needs import DYNAMIC

THEMES = (
    "structure", "damping", "stiffness", "hysteresis", "outflow", "sensors", "loads", "clock_and_lines",
)  # fmt: skip
"""Files of the effects that come with the package, in their order."""
GROUP = "uav_twin.effects"
"""Group of the entry points: each a function without arguments that returns an Effect or several."""
_IDENTIFIER = re.compile(r"[a-z][a-z0-9_]*")


@cache
def library() -> tuple[Effect, ...]:
    """Return the effects that come with the package, by theme."""
    folder = Path(__file__).parent
    return tuple(effect for theme in THEMES for effect in effects_of_file(folder / f"{theme}.toml"))


def effects_of_entry_points() -> tuple[Effect, ...]:
    """Return the effects of installed packages; raises `CatalogueError` naming the entry point at fault."""
    found: list[Effect] = []
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        where = f"The entry point {point.name!r} of the group {GROUP!r}"
        try:
            given = point.load()()
        except Exception as cause:
            raise CatalogueError(f"{where} failed: {type(cause).__name__}: {cause}.") from cause
        effects = tuple(given) if isinstance(given, Iterable) else (given,)
        for effect in effects:
            if not isinstance(effect, Effect):
                raise CatalogueError(f"{where} must return effects, but returned a {type(effect).__name__}.")
        found += effects
    return tuple(found)


def load_catalogue(extra: Iterable[Effect | Path] = (), *, installed: bool = True) -> tuple[Effect, ...]:
    """Return the library with a user's own entries after it.

    Parameters
    ----------
    extra : iterable of Effect or Path
        Further effects, or TOML files of them (`discrepancy.catalogue.effect_file`).
    installed : bool
        Whether the entry points of the group "uav_twin.effects" are asked as well.

    Raises
    ------
    CatalogueError
        If an entry cannot be read, is not sound, or has an identifier that is taken.
    """
    effects = [*library(), *(effects_of_entry_points() if installed else ())]
    for item in extra:
        effects += (item,) if isinstance(item, Effect) else effects_of_file(item)
    check(effects)
    return tuple(effects)


def effect_by_identifier(identifier: str, effects: Iterable[Effect]) -> Effect:
    """Return the effect of an identifier; raises `CatalogueError` with the known ones."""
    known = {effect.identifier: effect for effect in effects}
    if identifier not in known:
        raise CatalogueError(f"The catalogue has no effect {identifier!r}; it has {', '.join(known)}.")
    return known[identifier]


def in_events(effects: Sequence[Effect], setting: Setting) -> tuple[Effect, ...]:
    """Return the effects as they act while each event lasts, in the trials that have it; none without events.

    They are hypotheses beside the others. The moments are those of the campaign, in held-out trials too;
    nothing of them is fitted. Effects that cannot be switched, or whose law the model cannot switch, are left
    out.
    """
    fitted = {trial.name for trial in setting.campaign.fitted}
    events = [event for event in setting.campaign.events if fitted.intersection(event.trials)]
    names = dict.fromkeys(event.name for event in events)
    return tuple(
        _during(effect, name, setting) for name in names for effect in effects if _switches(effect, setting)
    )


def _switches(effect: Effect, setting: Setting) -> bool:
    """Whether an effect can act in windows of this model's trials."""
    places = effect.places(setting)
    if not places or not effect.acts_on & DYNAMIC:
        return False
    sizes = {item.name: item.prior.value(0.5) for item in effect.parameters}
    patch = effect.patch(setting, sizes, places[0])
    if not len(patch) or patch.has_windows or not all(item.can_act_in_windows for item in patch):
        return False
    return setting.model.follows_windows or all(isinstance(item, SENSORS) for item in patch)


def _during(effect: Effect, event: str, setting: Setting) -> Effect:
    """Return an effect as it acts while an event lasts."""
    windows = tuple(
        Window(trial, item.time, item.until)
        for item in setting.campaign.events
        if item.name == event
        for trial in item.trials
    )

    def build(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
        patch = effect.build(setting, values, place)
        return ModelPatch(tuple(replace(item, windows=windows) for item in patch))

    identifier, name = f"{effect.identifier}_during_{event}", f"{effect.name} during {event}"
    return replace(effect, identifier=identifier, name=name, acts_on=effect.acts_on & DYNAMIC, build=build)


def check(effects: Iterable[Effect]) -> None:
    """Raise `CatalogueError` at the first entry that is not sound, by itself or among the others."""
    effects = tuple(effects)
    known = Counter(effect.identifier for effect in effects)
    for effect in effects:
        if fault := next(_faults(effect), ""):
            raise CatalogueError(f"The effect {effect.identifier!r}{fault}")
    if twice := next((name for name, count in known.items() if count > 1), None):
        raise CatalogueError(f"The catalogue has {known[twice]} effects with the identifier {twice!r}.")
    for effect in effects:
        for other in effect.confusable:
            if other not in known or other == effect.identifier:
                raise CatalogueError(said("effects.confusable", effect=effect, other=other))


def _faults(effect: Effect) -> Iterator[str]:
    """Yield what is not sound in an entry, as a sentence goes on after its identifier."""
    if not (effect.name and _IDENTIFIER.fullmatch(str(effect.identifier))):
        yield " must have a name, and an identifier of lower-case letters, digits and underscores."
    if not effect.acts_on:
        yield " does not say which trials it acts on."
    if not effect.parameters:
        yield " has no parameters."
    free: tuple[EffectParameter | ShapeParameter, ...] = (*effect.parameters, *effect.shape)
    for name, count in Counter(item.name for item in free).items():
        if count > 1:
            yield f" has {count} parameters with the name {name!r}."
    for item in free:
        where, prior = f", parameter {item.name!r}: ", item.prior
        if not prior.low < prior.high:
            yield f"{where}the prior must have low < high, but has {prior.low:g}, {prior.high:g}."
        if prior.shape == "log_normal" and prior.low <= 0.0:
            yield f"{where}a log-normal prior must have low > 0, but has {prior.low:g}."
    for shape in effect.shape:
        if not shape.prior.low < shape.canonical < shape.prior.high:
            yield said("effects.canonical", shape=shape)
