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
"ports"), `preferred` (ports of a wing that stand for its others), `needs` (words of `NEEDS`),
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

A force F = F_0 |v / (A w)|^p |x / A|^a sgn v takes F_0 A 2 B((p + 2) / 2, (a + 1) / 2) from a harmonic motion
x = A sin w t in each cycle (B is the beta function), a viscous damper of ratio zeta 2 pi zeta k A^2. Equal
losses give the equivalent viscous ratio zeta_eq = F_0 B / (pi k A); B is the name `cycle_loss`. Spread over a
wing, a force acts at each place by its share w of the area, on the place's motion r x, x the mean's: the loss
is sum w r^(p + a + 1) times as large.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from math import inf, pi
from operator import attrgetter
from pathlib import Path

import numpy as np
from scipy.special import beta

from discrepancy.campaign.records import TrialKind
from discrepancy.catalogue.entry import Effect, EffectKeys, Setting
from discrepancy.catalogue.needs import DYNAMIC, NEEDS, PLACES, Asked, EffectSection, Target
from discrepancy.errors import CatalogueError, said
from discrepancy.system.scales import PortScale
from fe.runtime.errors import InvalidPatchError
from fe.runtime.expression import RESERVED, Expression
from fe.runtime.patch import EVERY_CHANNEL, PRIMITIVES, ModelPatch, Primitive, Window
from reporting.toml_file import read_toml, validate

# ---------------------------------------------------------------- names in arithmetic
LARGEST_SHARE = 0.9
"""Largest share of a port's stiffness at rest that a force which does not fall with the speed may have."""


@dataclass(frozen=True)
class Here:
    """Where a law is to be built: what is asked, what its place stands for, values of its parameters."""

    asked: Asked
    target: Target
    values: Mapping[str, float]

    @property
    def setting(self) -> Setting:
        """Campaign and model."""
        return self.asked.setting

    @property
    def port(self) -> PortScale:
        """Natural scales of the port; raises `CatalogueError` if the model has no such port."""
        ports = self.setting.scales.ports
        if self.target.name not in ports:
            known = ", ".join(ports) or "none"
            raise CatalogueError(
                said("effects.no_port", setting=self.setting, target=self.target, ports=known)
            )
        return ports[self.target.name]


def loss_integral(velocity_exponent: float, displacement_exponent: float) -> float:
    """Return B((p + 2) / 2, (a + 1) / 2): half the loss of a cycle over F_0 A; 2 for p = a = 0."""
    return float(beta(0.5 * velocity_exponent + 1.0, 0.5 * displacement_exponent + 0.5))


def _cycle_loss(here: Here) -> float:
    p = max(here.values["velocity_exponent"], 0.0)
    a = max(here.values["displacement_exponent"], 0.0) * _held(here)
    return loss_integral(p, a) * here.port.mean_power(p + a + 1.0)


def _held(here: Here) -> float:
    return 0.0 if here.port.free else 1.0  # a port that nothing holds has no zero


def _holding_force(here: Here) -> float:
    """Return the largest force that lets the port move: more, not falling with the speed, holds it still."""
    port = here.port
    if port.static_stiffness is None or port.driven or here.values["velocity_exponent"] >= 1.0:
        return inf
    return LARGEST_SHARE * port.static_stiffness * port.displacement


def _known(scale: str, usual: str) -> Callable[[Here], float]:
    """Return what gives a natural scale of the port, the usual one where it is not known."""
    return lambda here: next(x for key in (scale, usual) if (x := getattr(here.port, key)) is not None)


def _largest_reading(here: Here) -> float:
    """Return the largest magnitude among the used readings of the place [its unit], 1 if all are zero."""
    target, kept, key = here.target, here.setting.largest, (here.target, here.asked.section.acts_on)
    if key not in kept:  # patches are built at every step of a fit
        every = here.asked.channels_of(lambda item: target.quantity in ("", item.quantity.value))
        names = every if target.name == EVERY_CHANNEL else (target.name,)
        read = [
            np.abs(trial.values[trial.used[:, column], column])
            for trial in here.asked.trials
            for column, name in enumerate(trial.channels)
            if name in names
        ]
        largest = float(max((np.max(values) for values in read if values.size), default=0.0))
        kept[key] = largest if largest > 0.0 and np.isfinite(largest) else 1.0
    return kept[key]


def _sampling_interval(here: Here) -> float:
    """Return the median time between two samples of the trials that the effect changes [s]."""
    intervals = [np.diff(trial.time) for trial in here.asked.trials if len(trial.time) > 1]
    return float(np.median(np.concatenate(intervals))) if intervals else 0.0


def _largest_release(here: Here) -> float:
    releases = [
        abs(trial.release.displacement)
        for trial in here.setting.campaign.fitted
        if trial.release is not None and here.target.name in trial.channels
    ]
    return max(releases, default=0.0) or 1.0


def _station(end: int, here: Here) -> float:
    return (here.setting.model.stations or (0.0, 0.0))[end]


SCALES: dict[str, Callable[[Here], float]] = {
    **{
        name: attrgetter(f"setting.scales.{name}")
        for name in (
            "length", "tip_stiffness", "modal_mass", "angular_frequency", "force", "load_factor", "duration",
            "campaign_time",
        )
    },
    "pi": lambda here: pi,
    "root_station": partial(_station, 0),
    "tip_station": partial(_station, 1),
    "largest_reading": _largest_reading,
    "largest_release": _largest_release,
    "sampling_interval": _sampling_interval,
    "number": lambda here: here.target.number,
    "port_displacement": lambda here: here.port.displacement,
    "port_stiffness": lambda here: here.port.stiffness,
    "port_angular_frequency": lambda here: here.port.angular_frequency,
    "port_stiffness_at_rest": _known("static_stiffness", "stiffness"),
    "port_largest_displacement": _known("largest_displacement", "displacement"),
    "port_holding_force": _holding_force,
    "port_is_held": _held,
    "mean_power": lambda here: here.port.mean_power(here.values["exponent"] + 1.0),
    "cycle_loss": _cycle_loss,
}  # fmt: skip
"""Every name: the value where a law is built [SI].

`number` is what the place has of it (side of a skin, frequency of a line), `mean_power` of the motion of a
spread force with `exponent`.
"""
_OF_SHAPES: dict[str, set[str]] = {
    "mean_power": {"exponent"},
    "cycle_loss": {"velocity_exponent", "displacement_exponent"},
    "port_holding_force": {"velocity_exponent"},
}


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
    section = validate(EffectSection, row, where, CatalogueError, what="an effect")
    names = frozenset([*(item.name for item in section.parameters), *(item.name for item in section.shape)])
    moments = frozenset(word for name in section.events for word in (name, f"{name}_until"))
    _check_words(section, names, where)
    recipes = tuple(
        _recipe(item, names, moments, f"{where}, primitives {n}")
        for n, item in enumerate(section.primitives, start=1)
    )
    timed = [item for item in recipes if item.in_windows or PRIMITIVES[item.kind].formula_fields]
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
        """Yield the primitive, once for each time that its events happened; none where `if` is zero."""
        known = {**here.values, **{name: SCALES[name](here) for name in self.scales}}
        if "if" in self.when and self.when["if"].value(known) == 0.0:
            return
        if not self.moments and not self.in_windows:
            yield self._primitive(known, here.target, ())
            return
        for trial in here.setting.campaign.trials:
            if not trial.is_dynamic:
                continue
            for moments in here.setting.campaign.event_moments(trial.name, self.moments):
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
            elif name in PRIMITIVES[self.kind].formula_fields:
                row[name] = value.with_numbers(
                    {key: known[key] for key in value.used_names() if key in known}
                )
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
    types = primitive.value_types()
    times = ("begin", "end") if primitive.can_act_in_windows else ()
    keys = ("kind", *types, *times, "if")
    known = names | {name for name in SCALES if _OF_SHAPES.get(name, set()) <= names}
    values: dict[str, str | float | Expression] = {}
    when: dict[str, Expression] = {}
    with CatalogueError.instead_of(InvalidPatchError, before=f"{where}: "):
        for name, value in row.items():
            if name not in keys:
                raise CatalogueError(f"{where} has the unknown key {name!r}; known are {', '.join(keys)}.")
            text, place = value if isinstance(value, str) else repr(value), repr(name)
            if name not in types:
                if name != "kind":
                    when[name] = Expression(text, known | moments if name in times else known, place)
            elif name in primitive.formula_fields:
                values[name] = Expression(text, known | moments | {"time"}, place)
            else:
                numeric = isinstance(value, str) and types[name] is not str
                values[name] = Expression(text, known, place) if numeric else value
        # whether all values are there, with numbers in the place of expressions
        one = {name: "1" if name in primitive.formula_fields else 1.0 for name in values}
        _primitive_of(kind, {n: one[n] if isinstance(v, Expression) else v for n, v in values.items()})
    written = [item for item in (*values.values(), *when.values()) if isinstance(item, Expression)]
    used = frozenset(name for item in written for name in item.used_names())
    return _Recipe(where, kind, values, when, used & SCALES.keys() - names, used & moments)


@dataclass(frozen=True)
class _Law:
    """What an effect of a file does in a setting."""

    section: EffectSection
    recipes: tuple[_Recipe, ...]

    def _asked(self, setting: Setting) -> Asked:
        kinds = tuple(PRIMITIVES[recipe.kind] for recipe in self.recipes)
        moments = frozenset[str]().union(*(recipe.moments for recipe in self.recipes))
        return Asked(setting, self.section, kinds, moments)

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
                with CatalogueError.instead_of(InvalidPatchError, before=f"{recipe.where}: "):
                    primitives += recipe.built(here)
        return ModelPatch(tuple(primitives))


def _primitive_of(kind: str, row: Mapping[str, str | float]) -> Primitive:
    """Return the primitive; whole numbers of expressions become integers where integers are wanted."""
    types = PRIMITIVES[kind].value_types()
    whole = {
        name: int(value)
        for name, value in row.items()
        if types[name] is int and isinstance(value, float) and value == int(value)
    }
    return next(iter(ModelPatch.from_list([{"kind": kind, **row, **whole}])))
