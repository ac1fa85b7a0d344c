"""Effects as TOML files, those of the package and a user's own: primitives with arithmetic in their values.

A TOML file describes one effect at its top level, or several as tables `[[effect]]`::

    id = "store_pylon"
    name = "store on a pylon"
    family = "mass at a free place"
    equation = "M += m delta(y - y_p)"
    signature = "f1 falls, the static response stays"
    reference = "drawing 12-003"
    acts_on = ["ringdown", "forced"]

    [[parameters]]
    name = "mass_ratio"
    symbol = "mu"
    unit = "1"
    description = "mass over the first modal mass"
    prior = { shape = "log_normal", low = 0.01, high = 0.3 }
    magnitude = true

    [[primitives]]
    kind = "point_mass"
    mass = "mass_ratio * modal_mass"
    station = "0.5 * length"

Keys that may be left out: `confusable` (identifiers), `places` (names, or a word of `PLACES` such as
"ports"), `preferred` (ports that stand for all where the model has them), `needs` (words of `NEEDS`),
`spectral` (see `Effect`), `[[shape]]` (as a parameter, with `canonical` in place of `unit` and `magnitude`),
`levels` of a parameter. Names in arithmetic are the parameters and `SCALES`. Text values of a primitive
(port, channel, run) are taken as they are; "place" stands for the place, "quantity of the place" for what it
measures. A primitive with `if` is left out where that is zero.

Time and events of the campaign (`docs/when.md`)::

    events = ["pump_on"]                                # names of [[event]] that expressions below use

    [[primitives]]
    kind = "port_load"                                  # a force at a port; "channel_offset": of a reading
    port = "place"
    force = "slope * max(0, time - pump_on)"            # a formula in `time` [s] of the trial
    begin = "pump_on"                                   # of laws and sensors too: it acts from then on,
    end = "pump_on_until"                               # until then; in trials with these events only
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from pydantic import Field

from discrepancy.campaign.records import TrialKind
from discrepancy.errors import CatalogueError, said
from fe.runtime.errors import InvalidPatchError
from fe.runtime.expression import RESERVED, Expression
from fe.runtime.patch import PRIMITIVES, ModelPatch, Primitive, Window
from reporting.toml_file import checked, read_toml

from .entry import ROW, Effect, EffectKeys, Number, Setting
from .needs import DYNAMIC, NEEDS, PLACES, USUAL, Asked, Target
from .scales import SCALES, Here, names_with

Text = Annotated[str, Field(min_length=0)]


@dataclass(frozen=True, kw_only=True)
class EffectSection(EffectKeys):
    """`[[effect]]`, or the whole of a file with one."""

    __pydantic_config__ = ROW

    primitives: tuple[dict[str, Text | Number], ...] = ()
    places: str | tuple[str, ...] | None = None
    preferred: tuple[str, ...] = ()
    needs: tuple[str, ...] = USUAL
    events: tuple[str, ...] = ()


def effects_of_file(path: Path) -> tuple[Effect, ...]:
    """Return the effects of a TOML file.

    Raises
    ------
    CatalogueError
        If the file cannot be read, or an effect in it is not sound; the sentence says where.
    """
    data = read_toml(path, CatalogueError, what="file of effects")
    rows = data.get("effect", [data])
    if "effect" in data and len(data) > 1:
        other = next(key for key in data if key != "effect")
        raise CatalogueError(f"The file of effects {path} has {other!r} beside its tables [[effect]].")
    if not isinstance(rows, list) or not rows:
        raise CatalogueError(f"The file of effects {path} has no table [[effect]].")
    return tuple(_effect(row, f"{path}, effect {n}") for n, row in enumerate(rows, start=1))


def _effect(row: object, where: str) -> Effect:
    section = checked(EffectSection, row, where, CatalogueError, what="an effect")
    names = frozenset([*(item.name for item in section.parameters), *(item.name for item in section.shape)])
    moments = frozenset(word for name in section.events for word in (name, f"{name}_until"))
    _check_words(section, names, where)
    recipes = tuple(
        _recipe(item, names, moments, f"{where}, primitives {n}")
        for n, item in enumerate(section.primitives, start=1)
    )
    timed = [item for item in recipes if item.in_windows or PRIMITIVES[item.kind].courses]
    if timed and (still := [kind for kind in TrialKind if kind in section.acts_on - DYNAMIC]):
        raise CatalogueError(said("effects.no_course", where=timed[0].where, kind=still[0].value))
    law = _Law(section, recipes)
    return Effect(
        build=law.build,
        places=law.places,
        unavailable=law.unavailable,
        **{key: getattr(section, key) for key in EffectKeys.__dataclass_fields__},
    )


def _check_words(section: EffectSection, names: frozenset[str], where: str) -> None:
    """Refuse names that mean something else in an expression, and words for places and needs that do not."""
    taken = {*SCALES, *RESERVED}
    for what, given, known in (("a parameter", names, taken), ("an event", section.events, taken | names)):
        for name in given:
            if not name.isidentifier() or name in known:
                raise CatalogueError(f"{where}: {what} must not be called {name!r}.")
    for need in section.needs:
        if need not in NEEDS:
            raise CatalogueError(f"{where}: 'needs' has {need!r}, but known are {', '.join(NEEDS)}.")
    places = section.places
    if isinstance(places, str) and places not in PLACES:
        raise CatalogueError(said("effects.places", where=where, known="; ".join(PLACES), places=places))
    for name in () if isinstance(places, str) else places or ():
        if name in PLACES:
            raise CatalogueError(said("effects.listed", where=where, name=name))
    if not section.primitives:
        raise CatalogueError(f"{where} has no [[primitives]].")


# ---------------------------------------------------------------- primitives


@dataclass(frozen=True)
class _Recipe:
    """A primitive whose values are still expressions.

    Attributes
    ----------
    where, kind : str
        Of the primitive.
    values, when : mapping
        Its values; when it acts: "begin", "end", "if".
    scales, moments : frozenset of str
        Natural scales and moments of events that they use.
    """

    where: str
    kind: str
    values: Mapping[str, str | float | Expression]
    when: Mapping[str, Expression]
    scales: frozenset[str]
    moments: frozenset[str]

    @property
    def in_windows(self) -> bool:
        """Whether it asks when it begins or ends."""
        return bool({"begin", "end"} & self.when.keys())

    def built(self, here: Here) -> Iterator[Primitive]:
        """Yield the primitive: once, or for each trial that has its events; not at all where `if` is zero."""
        known = {**here.values, **{name: SCALES[name](here) for name in self.scales}}
        if "if" in self.when and self.when["if"].value(known) == 0.0:
            return
        if not self.moments and not self.in_windows:
            yield self._primitive(known, here.target, ())
            return
        for trial in here.setting.campaign.trials:
            moments = here.setting.campaign.event_times(trial.name)
            if trial.is_dynamic and self.moments <= moments.keys():
                there = {**known, **moments}
                times = [
                    self.when[key].value(there) if key in self.when else None for key in ("begin", "end")
                ]
                yield self._primitive(there, here.target, (Window(trial.name, *times),))

    def _primitive(
        self, known: Mapping[str, float], target: Target, windows: tuple[Window, ...]
    ) -> Primitive:
        words = {"place": target.name, "quantity of the place": target.quantity}
        row: dict[str, str | float] = {}
        for name, value in self.values.items():
            if not isinstance(value, Expression):
                row[name] = words.get(value, value) if isinstance(value, str) else value
            elif name in PRIMITIVES[self.kind].courses:
                row[name] = value.with_numbers({key: known[key] for key in value.used() if key in known})
            else:
                row[name] = value.value(known)
        primitive = _primitive_of(self.kind, row)
        return replace(primitive, windows=windows) if windows else primitive


def _recipe(
    row: Mapping[str, str | float], names: frozenset[str], moments: frozenset[str], where: str
) -> _Recipe:
    kind = str(row.get("kind"))
    if kind not in PRIMITIVES:
        raise CatalogueError(f"{where}: 'kind' is {kind!r}, but known are {', '.join(PRIMITIVES)}.")
    primitive = PRIMITIVES[kind]
    types = primitive.values()
    times = ("begin", "end") if primitive.in_windows else ()
    keys = ("kind", *types, *times, "if")
    known = names | names_with(names)
    values: dict[str, str | float | Expression] = {}
    when: dict[str, Expression] = {}
    try:
        for name, value in row.items():
            if name not in keys:
                raise CatalogueError(f"{where} has the unknown key {name!r}; known are {', '.join(keys)}.")
            text, place = value if isinstance(value, str) else repr(value), f"{where}: {name!r}"
            if name not in types:
                if name != "kind":
                    when[name] = Expression(text, known | moments if name in times else known, place)
            elif name in primitive.courses:
                values[name] = Expression(text, known | moments | {"time"}, place)
            else:
                numeric = isinstance(value, str) and types[name] is not str
                values[name] = Expression(text, known, place) if numeric else value
        # whether all values are there, with numbers in the place of expressions
        one = {name: "1" if name in primitive.courses else 1.0 for name in values}
        _primitive_of(kind, {n: one[n] if isinstance(v, Expression) else v for n, v in values.items()})
    except InvalidPatchError as cause:
        message = str(cause)
        raise CatalogueError(message if message.startswith(where) else f"{where}: {message}") from cause
    written = [item for item in (*values.values(), *when.values()) if isinstance(item, Expression)]
    used = frozenset(name for item in written for name in item.used())
    return _Recipe(where, kind, values, when, used & SCALES.keys() - names, used & moments)


@dataclass(frozen=True)
class _Law:
    """What an effect of a file does in a setting."""

    section: EffectSection
    recipes: tuple[_Recipe, ...]

    def _asked(self, setting: Setting) -> Asked:
        section = self.section
        return Asked(
            setting, section.identifier, section.acts_on, section.places, section.preferred, section.needs,
            primitives=tuple(PRIMITIVES[recipe.kind] for recipe in self.recipes),
            moments=frozenset().union(*(recipe.moments for recipe in self.recipes)),
        )  # fmt: skip

    def places(self, setting: Setting) -> tuple[str, ...]:
        return self._asked(setting).found_places()

    def unavailable(self, setting: Setting) -> str | None:
        return self._asked(setting).reason()

    def build(self, setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
        primitives: list[Primitive] = []
        asked = self._asked(setting)
        for target in asked.targets(place):
            here = Here(asked, target, values)
            for recipe in self.recipes:
                try:
                    primitives += recipe.built(here)
                except InvalidPatchError as cause:
                    raise CatalogueError(f"{recipe.where}: {cause}") from cause
        return ModelPatch(tuple(primitives))


def _primitive_of(kind: str, row: Mapping[str, str | float]) -> Primitive:
    """Return the primitive; whole numbers of expressions become integers where integers are wanted."""
    types = PRIMITIVES[kind].values()
    whole = {
        name: int(value)
        for name, value in row.items()
        if types[name] is int and isinstance(value, float) and value == int(value)
    }
    return next(iter(ModelPatch.from_list([{"kind": kind, **row, **whole}])))
