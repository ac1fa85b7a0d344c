"""The catalogue: the effects that come with the package, and those that a user adds."""

import re
from collections import Counter
from collections.abc import Iterable
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

from discrepancy.catalogue.effect_file import effects_of_file
from discrepancy.catalogue.entry import Effect, EffectParameter, Prior, ShapeParameter
from discrepancy.errors import CatalogueError

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
    effects = [*library()]
    if installed:
        effects += effects_of_entry_points()
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


def check(effects: Iterable[Effect]) -> None:
    """Raise `CatalogueError` at the first entry that is not sound, by itself or among the others."""
    effects = tuple(effects)
    for effect in effects:
        _check_one(effect)
    known = Counter(effect.identifier for effect in effects)
    for identifier, count in known.items():
        if count > 1:
            raise CatalogueError(f"The catalogue has {count} effects with the identifier {identifier!r}.")
    for effect in effects:
        for other in effect.confusable:
            if other not in known or other == effect.identifier:
                raise CatalogueError(
                    f"The effect {effect.identifier!r} names {other!r} as confusable, "
                    "which is no other effect of the catalogue."
                )


def _check_one(effect: Effect) -> None:
    where = f"The effect {effect.identifier!r}"
    if not _IDENTIFIER.fullmatch(effect.identifier):
        raise CatalogueError(
            f"{where} must have an identifier of lower-case letters, digits and underscores."
        )
    for field in ("name", "family", "equation", "signature", "reference"):
        if not getattr(effect, field).strip():
            raise CatalogueError(f"{where} has no {field}.")
    if not effect.acts_on:
        raise CatalogueError(f"{where} does not say which trials it acts on.")
    names = Counter([item.name for item in effect.parameters] + [item.name for item in effect.shape])
    for name, count in names.items():
        if count > 1:
            raise CatalogueError(f"{where} has {count} parameters with the name {name!r}.")
    if not effect.parameters:
        raise CatalogueError(f"{where} has no parameters.")
    free: tuple[EffectParameter | ShapeParameter, ...] = (*effect.parameters, *effect.shape)
    for parameter in free:
        _check_prior(parameter.prior, f"{where}, parameter {parameter.name!r}")
    for shape in effect.shape:
        if not shape.prior.low < shape.canonical < shape.prior.high:
            raise CatalogueError(
                f"{where}: the canonical value {shape.canonical:g} of {shape.name!r} must lie between "
                f"{shape.prior.low:g} and {shape.prior.high:g}."
            )


def _check_prior(prior: Prior, where: str) -> None:
    if not prior.low < prior.high:
        raise CatalogueError(
            f"{where}: the prior must have low < high, but has {prior.low:g}, {prior.high:g}."
        )
    if prior.shape == "log_normal" and prior.low <= 0.0:
        raise CatalogueError(f"{where}: a log-normal prior must have low > 0, but has {prior.low:g}.")
