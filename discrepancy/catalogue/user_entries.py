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
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from functools import partial
from importlib.metadata import entry_points
from math import isfinite, pi
from pathlib import Path
from typing import Any, Literal, cast, get_args

from discrepancy.campaign.records import Quantity, TrialKind
from discrepancy.catalogue.building import carried, channels, needs, somewhere, trial_of, trials
from discrepancy.catalogue.entry import Effect, EffectParameter, Prior, Setting, ShapeParameter, nowhere_else
from discrepancy.catalogue.expression import Expression
from discrepancy.errors import CatalogueError
from fe.runtime.errors import InvalidPatchError
from fe.runtime.patch import PRIMITIVES, SENSORS, ModelPatch, Primitive
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
    return tuple(_effect(_Table(row, f"{path}, effect {n}")) for n, row in enumerate(rows, start=1))


@dataclass(frozen=True)
class _Table:
    """A table of a TOML file that knows where it stands."""

    row: Any
    where: str

    def __post_init__(self) -> None:
        if not isinstance(self.row, Mapping):
            raise CatalogueError(f"{self.where} must be a table, but is {self.row!r}.")

    def only(self, *keys: str) -> None:
        """Refuse keys that are not among `keys`."""
        for key in self.row:
            if key not in keys:
                raise CatalogueError(
                    f"{self.where} has the unknown key {key!r}; known are {', '.join(keys)}."
                )

    def text(self, key: str) -> str:
        """Return a text that must be there."""
        value = self.row.get(key)
        if not isinstance(value, str) or not value.strip():
            raise CatalogueError(f"{self.where}: {key!r} must be a text, but is {value!r}.")
        return value

    def number(self, key: str) -> float:
        """Return a finite number that must be there."""
        value = self.row.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
            raise CatalogueError(f"{self.where}: {key!r} must be a finite number, but is {value!r}.")
        return float(value)

    def texts(self, key: str) -> tuple[str, ...]:
        """Return a list of texts, empty if it is not there."""
        value = self.row.get(key, [])
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise CatalogueError(f"{self.where}: {key!r} must be a list of texts, but is {value!r}.")
        return tuple(value)

    def tables(self, key: str) -> tuple["_Table", ...]:
        """Return an array of tables, empty if it is not there."""
        value = self.row.get(key, [])
        if not isinstance(value, list):
            raise CatalogueError(f"{self.where}: {key!r} must be an array of tables ([[{key}]]).")
        return tuple(_Table(row, f"{self.where}, {key} {n}") for n, row in enumerate(value, start=1))

    def prior(self) -> Prior:
        """Return the table `prior`."""
        prior = _Table(self.row.get("prior"), f"{self.where}: 'prior'")
        prior.only("shape", "low", "high")
        shape = prior.text("shape")
        known = get_args(Literal["log_normal", "normal", "uniform"])
        if shape not in known:
            raise CatalogueError(
                f"{prior.where}: 'shape' must be one of {', '.join(known)}, but is {shape!r}."
            )
        return Prior(
            cast("Literal['log_normal', 'normal', 'uniform']", shape),
            prior.number("low"),
            prior.number("high"),
        )


def _effect(table: _Table) -> Effect:
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
    for name in names:
        if not name.isidentifier() or name in {*SCALES, *PORT_SCALES, "pi", "place"}:
            raise CatalogueError(f"{table.where}: a parameter must not be called {name!r}.")
    rows = table.tables("primitives")
    if not rows:
        raise CatalogueError(f"{table.where} has no [[primitives]].")
    recipes = tuple(_recipe(row, names) for row in rows)
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
            carried(*structural),
            somewhere(
                places, f"Neither model nor campaign has a place where {table.text('id')!r} could act."
            ),
        ),
        confusable=table.texts("confusable"),
    )


def _parameter(table: _Table) -> EffectParameter:
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


def _shape(table: _Table) -> ShapeParameter:
    table.only("name", "symbol", "description", "canonical", "prior")
    return ShapeParameter(
        table.text("name"),
        table.text("symbol"),
        table.text("description"),
        table.number("canonical"),
        table.prior(),
    )


# ---------------------------------------------------------------- places


def _places(table: _Table) -> Any:
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
    """A primitive whose values are still expressions."""

    where: str
    kind: str
    values: Mapping[str, str | int | float | Expression]


def _recipe(table: _Table, names: frozenset[str]) -> _Recipe:
    kind = table.text("kind")
    if kind not in PRIMITIVES:
        raise CatalogueError(f"{table.where}: 'kind' is {kind!r}, but known are {', '.join(PRIMITIVES)}.")
    types = {item.name: item.type for item in fields(PRIMITIVES[kind])}
    table.only("kind", *types)
    values: dict[str, str | int | float | Expression] = {}
    for name, value in table.row.items():
        if name == "kind":
            continue
        where = f"{table.where}: {name!r}"
        if types[name] is str:
            values[name] = value if value == "" else table.text(name)
        elif isinstance(value, str):
            values[name] = Expression(value, names.union(SCALES, PORT_SCALES, {"pi"}), where)
        else:
            number = table.number(name)
            values[name] = int(number) if types[name] is int and number == int(number) else number
    try:  # whether all values are there, with numbers in the place of expressions
        _primitive_of(
            kind, {name: 1.0 if isinstance(value, Expression) else value for name, value in values.items()}
        )
    except InvalidPatchError as cause:
        raise CatalogueError(f"{table.where}: {cause}") from cause
    return _Recipe(table.where, kind, values)


def _build(
    where: str, recipes: tuple[_Recipe, ...], setting: Setting, values: Mapping[str, float], place: str
) -> ModelPatch:
    scales = setting.scales
    known: dict[str, float] = {**values, "pi": pi, **{name: float(getattr(scales, name)) for name in SCALES}}
    if (port := scales.ports.get(place)) is not None:
        known |= dict(
            zip(PORT_SCALES, (port.displacement, port.stiffness, port.angular_frequency), strict=True)
        )
    primitives = []
    for recipe in recipes:
        row: dict[str, Any] = {}
        for name, value in recipe.values.items():
            if isinstance(value, Expression):
                row[name] = value.value(known)
            else:
                row[name] = place if value == "place" else value
        try:
            primitives.append(_primitive_of(recipe.kind, row))
        except InvalidPatchError as cause:
            raise CatalogueError(f"{recipe.where}: {cause}") from cause
    return ModelPatch(tuple(primitives))


def _primitive_of(kind: str, row: Mapping[str, Any]) -> Primitive:
    """Return the primitive; whole numbers of expressions become integers where integers are wanted."""
    types = {item.name: item.type for item in fields(PRIMITIVES[kind])}
    whole = {
        name: int(value)
        for name, value in row.items()
        if types[name] is int and isinstance(value, float) and value == int(value)
    }
    return next(iter(ModelPatch.from_list([{"kind": kind, **row, **whole}])))
