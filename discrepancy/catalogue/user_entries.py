"""A user's own effects: Python entry points, and TOML files of primitives with arithmetic in their values.

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

Keys that may be left out: `confusable` (identifiers), `places` (names, or one of "ports", "channels",
"strain channels", "runs"), `[[shape]]` (as a parameter, with `canonical` in place of `unit` and `magnitude`).
Text values of a primitive (port, channel, run) are taken as they are; "place" stands for the place.

Time and events of the campaign (`docs/when.md`)::

    events = ["pump_on"]                                # names of [[event]] that expressions below use

    [[primitives]]
    kind = "port_load"                                  # a force at a port; "channel_offset": of a reading
    port = "place"
    force = "slope * max(0, time - pump_on)"            # a formula in `time` [s] of the trial
    begin = "pump_on"                                   # of laws and sensors too: it acts from then on,
    end = "pump_on_until"                               # until then; in trials with these events only
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import entry_points
from math import pi
from pathlib import Path
from typing import Any

from discrepancy.campaign.records import Quantity, TrialKind
from discrepancy.catalogue.building import carried, channels, needs, somewhere, trial_of, trials
from discrepancy.catalogue.effect_table import Table
from discrepancy.catalogue.entry import Effect, EffectParameter, Setting, ShapeParameter, nowhere_else
from discrepancy.errors import CatalogueError
from fe.runtime.errors import InvalidPatchError
from fe.runtime.expression import RESERVED, Expression
from fe.runtime.patch import PRIMITIVES, SENSORS, ModelPatch, Primitive, Window
from reporting.toml_file import read_toml

GROUP = "uav_twin.effects"
"""Group of the entry points: each a function without arguments that returns an Effect or several."""

SCALES = (
    "length",
    "tip_stiffness",
    "modal_mass",
    "angular_frequency",
    "force",
    "load_factor",
    "duration",
    "campaign_time",
)
PORT_SCALES = ("port_displacement", "port_stiffness", "port_angular_frequency")
"""Names that an expression may use besides the parameters; those of the port need a place that is one."""


def effects_of_entry_points() -> tuple[Effect, ...]:
    """Return the effects of installed packages; raises `CatalogueError` naming the entry point at fault."""
    found: list[Effect] = []
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        where = f"The entry point {point.name!r} of the group {GROUP!r}"
        try:
            given = point.load()()
        except Exception as cause:
            raise CatalogueError(f"{where} failed: {type(cause).__name__}: {cause}.") from cause
        effects = (given,) if isinstance(given, Effect) else given
        if not isinstance(effects, Iterable):
            raise CatalogueError(f"{where} must return effects, but returned a {type(given).__name__}.")
        for effect in effects:
            if not isinstance(effect, Effect):
                raise CatalogueError(f"{where} must return effects, but returned a {type(effect).__name__}.")
            found.append(effect)
    return tuple(found)


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
    return tuple(_effect(Table(row, f"{path}, effect {n}")) for n, row in enumerate(rows, start=1))


def _effect(table: Table) -> Effect:
    table.only(
        "id",
        "name",
        "family",
        "equation",
        "signature",
        "reference",
        "acts_on",
        "confusable",
        "places",
        "events",
        "parameters",
        "shape",
        "primitives",
    )
    acts_on = []
    for kind in table.texts("acts_on"):
        if kind not in list(TrialKind):
            known = ", ".join(TrialKind)
            raise CatalogueError(f"{table.where}: 'acts_on' has {kind!r}, but trials are {known}.")
        acts_on.append(TrialKind(kind))
    parameters = tuple(_parameter(row) for row in table.tables("parameters"))
    shape = tuple(_shape(row) for row in table.tables("shape"))
    names = frozenset([*(item.name for item in parameters), *(item.name for item in shape)])
    events = table.texts("events")
    _check_names(table, names, events)
    rows = table.tables("primitives")
    if not rows:
        raise CatalogueError(f"{table.where} has no [[primitives]].")
    moments = frozenset(word for name in events for word in (name, f"{name}_until"))
    recipes = tuple(_recipe(row, names, moments) for row in rows)
    _check_in_time(table, recipes, acts_on)
    places = _places(table)
    wanted = tuple(PRIMITIVES[recipe.kind] for recipe in recipes)
    structural = tuple(kind for kind in wanted if kind not in SENSORS)
    return Effect(
        identifier=table.text("id"),
        name=table.text("name"),
        family=table.text("family"),
        equation=table.text("equation"),
        signature=table.text("signature"),
        reference=table.text("reference"),
        acts_on=frozenset(acts_on),
        parameters=parameters,
        build=partial(_build, table.where, recipes),
        shape=shape,
        places=places,
        unavailable=needs(
            trial_of(frozenset(acts_on)),
            partial(_no_event, frozenset().union(*(recipe.moments for recipe in recipes))),
            carried(*structural),
            somewhere(
                places, f"Neither model nor campaign has a place where {table.text('id')!r} could act."
            ),
        ),
        confusable=table.texts("confusable"),
    )


def _check_names(table: Table, names: frozenset[str], events: tuple[str, ...]) -> None:
    """Refuse names of parameters and events that mean something else in an expression."""
    taken = {*SCALES, *PORT_SCALES, *RESERVED}
    for name in names:
        if not name.isidentifier() or name in taken:
            raise CatalogueError(f"{table.where}: a parameter must not be called {name!r}.")
    for name in events:
        if not name.isidentifier() or name in taken | names:
            raise CatalogueError(f"{table.where}: an event must not be called {name!r}.")


def _parameter(table: Table) -> EffectParameter:
    table.only("name", "symbol", "unit", "description", "prior", "magnitude")
    magnitude = table.row.get("magnitude", False)
    if not isinstance(magnitude, bool):
        raise CatalogueError(f"{table.where}: 'magnitude' must be true or false, but is {magnitude!r}.")
    return EffectParameter(
        table.text("name"),
        table.text("symbol"),
        table.text("unit"),
        table.text("description"),
        table.prior(),
        magnitude,
    )


def _shape(table: Table) -> ShapeParameter:
    table.only("name", "symbol", "description", "canonical", "prior")
    return ShapeParameter(
        table.text("name"),
        table.text("symbol"),
        table.text("description"),
        table.number("canonical"),
        table.prior(),
    )


# ---------------------------------------------------------------- places


def _places(table: Table) -> Any:
    given = table.row.get("places")
    if given is None:
        return nowhere_else
    known = {
        "ports": _all_ports, "channels": _all_channels, "strain channels": _strain_channels,
        "runs": _all_runs,
    }  # fmt: skip
    if isinstance(given, str):
        if given not in known:
            raise CatalogueError(
                f"{table.where}: 'places' must be a list or one of {', '.join(known)}, but is {given!r}."
            )
        return known[given]
    names = table.texts("places")
    words = [name for name in names if name in known]
    if words:
        raise CatalogueError(
            f"{table.where}: 'places' is a list that holds {words[0]!r}, which would be the name of a single "
            f'place; for all {words[0]} write places = "{words[0]}", without brackets.'
        )
    return partial(_given_places, names)


def _given_places(names: tuple[str, ...], setting: Setting) -> tuple[str, ...]:
    return names


def _all_ports(setting: Setting) -> tuple[str, ...]:
    return setting.model.ports()


def _all_channels(setting: Setting) -> tuple[str, ...]:
    return tuple(channel.name for channel in channels(setting))


def _strain_channels(setting: Setting) -> tuple[str, ...]:
    return tuple(channel.name for channel in channels(setting, Quantity.STRAIN))


def _all_runs(setting: Setting) -> tuple[str, ...]:
    return tuple(dict.fromkeys(trial.run for trial in trials(setting)))


# ---------------------------------------------------------------- primitives


@dataclass(frozen=True)
class _Recipe:
    """A primitive whose values are still expressions; `moments` are those of events that it uses."""

    where: str
    kind: str
    values: Mapping[str, str | int | float | Expression]
    window: Mapping[str, Expression]
    moments: frozenset[str]

    @property
    def in_time(self) -> bool:
        """Whether it asks for the time of trials."""
        return bool(self.window) or bool(PRIMITIVES[self.kind].courses)

    def window_in(self, trial: str, known: Mapping[str, float]) -> Window:
        """Return when it acts in a trial."""
        begin, end = (
            self.window[key].value(known) if key in self.window else None for key in ("begin", "end")
        )
        return Window(trial, begin, end)

    def primitive(self, known: Mapping[str, float], place: str, windows: tuple[Window, ...]) -> Primitive:
        """Return the primitive at values of the names."""
        row: dict[str, Any] = {}
        for name, value in self.values.items():
            if not isinstance(value, Expression):
                row[name] = place if value == "place" else value
            elif name in PRIMITIVES[self.kind].courses:
                row[name] = value.with_numbers({key: known[key] for key in value.used() if key in known})
            else:
                row[name] = value.value(known)
        return replace(_primitive_of(self.kind, row), windows=windows)


def _recipe(table: Table, names: frozenset[str], moments: frozenset[str]) -> _Recipe:
    kind = table.text("kind")
    if kind not in PRIMITIVES:
        raise CatalogueError(f"{table.where}: 'kind' is {kind!r}, but known are {', '.join(PRIMITIVES)}.")
    primitive = PRIMITIVES[kind]
    types = primitive.values()
    table.only("kind", *types, *(("begin", "end") if primitive.in_windows else ()))
    known = names.union(SCALES, PORT_SCALES, {"pi"})
    values: dict[str, str | int | float | Expression] = {}
    window: dict[str, Expression] = {}
    for name, value in table.row.items():
        where = f"{table.where}: {name!r}"
        if name == "kind":
            continue
        if name in ("begin", "end") and name not in types:
            text = value if isinstance(value, str) else repr(table.number(name))
            window[name] = _expression(text, known | moments, where)
        elif name in primitive.courses:
            text = value if isinstance(value, str) else repr(table.number(name))
            values[name] = _expression(text, known | moments | {"time"}, where)
        elif types[name] is str:
            values[name] = value if value == "" else table.text(name)
        elif isinstance(value, str):
            values[name] = _expression(value, known, where)
        else:
            number = table.number(name)
            values[name] = int(number) if types[name] is int and number == int(number) else number
    try:  # whether all values are there, with numbers in the place of expressions
        _primitive_of(
            kind,
            {
                name: ("1" if name in primitive.courses else 1.0) if isinstance(value, Expression) else value
                for name, value in values.items()
            },
        )
    except InvalidPatchError as cause:
        raise CatalogueError(f"{table.where}: {cause}") from cause
    timed = (*window.values(), *(values[name] for name in primitive.courses))
    used = frozenset(name for item in timed if isinstance(item, Expression) for name in item.used())
    return _Recipe(table.where, kind, values, window, used & moments)


def _expression(text: str, names: frozenset[str], where: str) -> Expression:
    try:
        return Expression(text, names, where)
    except InvalidPatchError as cause:
        raise CatalogueError(str(cause)) from cause


def _check_in_time(table: Table, recipes: tuple[_Recipe, ...], acts_on: list[TrialKind]) -> None:
    """Refuse effects that ask for the time of trials which have none."""
    still = [kind.value for kind in acts_on if kind in (TrialKind.STATIC, TrialKind.FLIGHT)]
    timed = [recipe for recipe in recipes if recipe.in_time]
    if timed and still:
        raise CatalogueError(
            f"{timed[0].where} asks for the time of trials, but 'acts_on' has {still[0]!r}, whose rows "
            "are no course in time."
        )


def _no_event(moments: frozenset[str], setting: Setting) -> str | None:
    """Return why an effect cannot act: no trial that is fitted has all of its events."""
    if not moments:
        return None
    campaign = setting.campaign
    if any(moments <= campaign.event_times(trial.name).keys() for trial in campaign.fitted):
        return None
    there = {name for trial in campaign.fitted for name in campaign.event_times(trial.name)}
    return (
        f"No trial to fit has {' and '.join(sorted(moments))} as [[event]]; those that are fitted have "
        f"{', '.join(sorted(there)) or 'none'}."
    )


def _build(
    where: str, recipes: tuple[_Recipe, ...], setting: Setting, values: Mapping[str, float], place: str
) -> ModelPatch:
    scales = setting.scales
    known: dict[str, float] = {**values, "pi": pi, **{name: float(getattr(scales, name)) for name in SCALES}}
    if (port := scales.ports.get(place)) is not None:
        known |= dict(
            zip(PORT_SCALES, (port.displacement, port.stiffness, port.angular_frequency), strict=True)
        )
    primitives: list[Primitive] = []
    for recipe in recipes:
        try:
            if not recipe.moments and not recipe.window:
                primitives.append(recipe.primitive(known, place, ()))
                continue
            for trial in setting.campaign.trials:
                moments = setting.campaign.event_times(trial.name)
                if trial.is_dynamic and recipe.moments <= moments.keys():
                    there = {**known, **moments}
                    window = recipe.window_in(trial.name, there)
                    primitives.append(recipe.primitive(there, place, (window,)))
        except InvalidPatchError as cause:
            raise CatalogueError(f"{recipe.where}: {cause}") from cause
    return ModelPatch(tuple(primitives))


def _primitive_of(kind: str, row: Mapping[str, Any]) -> Primitive:
    """Return the primitive; whole numbers of expressions become integers where integers are wanted."""
    types = PRIMITIVES[kind].values()
    whole = {
        name: int(value)
        for name, value in row.items()
        if types[name] is int and isinstance(value, float) and value == int(value)
    }
    return next(iter(ModelPatch.from_list([{"kind": kind, **row, **whole}])))
