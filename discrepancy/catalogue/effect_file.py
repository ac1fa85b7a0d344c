"""Effects as TOML files: primitives of a patch with arithmetic in their values.

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

Keys that may be left out: `confusable` (identifiers), `counterpart` (see `Effect`), `places`
(names, or a word of `PLACES` such as "ports"), `preferred` (ports of a wing that stand for its
others), `campaign_needs` (words of `NEEDS`), `spectral` and `at_several_places` (see `Effect`),
`[[shape]]` (as a parameter, with `canonical` in place of `unit` and `magnitude`), `levels` of a
parameter. Names in arithmetic are the parameters and `SCALES`. Text values of a primitive (port,
channel, run) are taken as they are; "place" stands for the place, "quantity of the place" for what
it measures, "motion of the place" for the motion of a support. A primitive with `if` is left out
where that is zero.

Time and events of the campaign (`docs/explanation/when.md`)::

    events = ["pump_on"]                         # names of [[event]] that expressions below use

    [[primitives]]
    kind = "port_load"                           # a force at a port; "channel_offset": of a reading
    port = "place"
    force = "slope * max(0, time - pump_on)"     # a formula in `time` [s] of the trial
    begin = "pump_on"                            # laws and sensors, too, act from then on,
    end = "pump_on_until"                        # until then, in trials with these events only

Equivalent damping: in each cycle of a harmonic motion x = A sin w t, a force
F = F_0 |v / (A w)|^p |x / A|^a sgn v dissipates the energy 2 F_0 A B, where B is the beta function
of (p + 2) / 2 and (a + 1) / 2. A viscous damper of ratio zeta dissipates 2 pi zeta k A^2. Equal
losses give the equivalent viscous ratio zeta_eq = F_0 B / (pi k A); expressions know B by the name
`cycle_loss`. A force that is spread over a wing acts at each place with its fraction u of the area,
on the motion r x of that place, where x is the mean motion. Its loss is larger by the factor
sum u r^(p + a + 1).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from discrepancy.campaign.records import TrialKind
from discrepancy.catalogue.effect_in_setting import (
    DYNAMIC,
    EffectInSetting,
    EffectSection,
    Target,
)
from discrepancy.catalogue.entry import Effect, EffectKeys, Setting
from discrepancy.catalogue.needs import NEEDS, untestable_reason
from discrepancy.catalogue.places import PLACES, places_of
from discrepancy.catalogue.scale_names import SCALES, SHAPES_OF_SCALES, BuildContext
from discrepancy.errors import CatalogueError
from fe.runtime.errors import InvalidPatchError
from fe.runtime.expression import RESERVED, Expression
from fe.runtime.patch import PRIMITIVES, ModelPatch, Primitive, Window
from reporting.formats.toml_file import read_toml, validate


def effects_of_file(path: Path) -> tuple[Effect, ...]:
    """Read the effects of a TOML file: those of its tables [[effect]], or the file as one effect.

    Raises
    ------
    CatalogueError
        If the file cannot be read, or an effect in it is not valid; the message says where.
    """
    content = read_toml(path, CatalogueError, what="file of effects")
    tables = content.get("effect", [content])
    if "effect" in content and len(content) > 1:
        other_key = next(key for key in content if key != "effect")
        raise CatalogueError(
            f"The file of effects {path} has {other_key!r} beside its tables [[effect]]."
        )
    if not isinstance(tables, list) or not tables:
        raise CatalogueError(f"The file of effects {path} has no table [[effect]].")
    return tuple(
        _parse_effect(table, f"{path}, effect {number}")
        for number, table in enumerate(tables, start=1)
    )


def _parse_effect(table: object, place: str) -> Effect:
    """Return the effect that a table describes; raise `CatalogueError` if it is not valid.

    `place` is the file and the number of the effect, for messages.
    """
    section = validate(EffectSection, table, place, CatalogueError, what="an effect")
    names_of_parameters = [parameter.name for parameter in section.parameters]
    names_of_shape = [parameter.name for parameter in section.shape]
    names = frozenset(names_of_parameters + names_of_shape)
    event_times = frozenset(name for event in section.events for name in (event, f"{event}_until"))
    _check_names(section, names, place)
    _check_places_and_needs(section, place)
    templates = tuple(
        _parse_primitive(row, names, event_times, f"{place}, primitives {number}")
        for number, row in enumerate(section.primitives, start=1)
    )
    _check_acts_on_dynamic_trials(section, templates)
    effect = _EffectFunctions(section, templates)
    return Effect(
        build=effect.build,
        places=effect.places,
        unavailable=effect.unavailable,
        **{key: getattr(section, key) for key in EffectKeys.__dataclass_fields__},
    )


_REASON_OF_NAME = (
    "a name is letters, digits and `_`, and must not mean something else in an expression."
)


def _check_names(section: EffectSection, names: frozenset[str], place: str) -> None:
    """Raise an error if the name of a parameter or event has another meaning in expressions.

    `names` are those of parameters and shape parameters; `place` is the file and the number of the
    effect, for messages.
    """
    used_names = {*SCALES, *RESERVED}
    for name in names:
        if not name.isidentifier() or name in used_names:
            raise CatalogueError(
                f"{place}: a parameter must not be called {name!r}: {_REASON_OF_NAME}"
            )
    for name in section.events:
        if not name.isidentifier() or name in used_names | names:
            raise CatalogueError(
                f"{place}: an event must not be called {name!r}: {_REASON_OF_NAME}"
            )


def _check_places_and_needs(section: EffectSection, place: str) -> None:
    """Raise an error for an unknown word in `places` or `needs`, or if there are no primitives.

    `places` is a word of `PLACES`, which stands for many places, or a list of names of places. A
    word of `PLACES` in such a list is refused, since it would be taken as a name.
    """
    for need in section.needs:
        if need not in NEEDS:
            raise CatalogueError(
                f"{place}: 'needs' has {need!r}, but the known ones are {', '.join(NEEDS)}."
            )
    places = section.places
    if isinstance(places, str):
        if places not in PLACES:
            raise CatalogueError(
                f"{place}: 'places' must be a list or one of {'; '.join(PLACES)}, but is "
                f"{places!r}."
            )
    else:
        for name in places or ():
            if name in PLACES:
                raise CatalogueError(
                    f"{place}: 'places' is a list that holds {name!r}, which would be the name of "
                    f'a single place; for all {name} write places = "{name}", without brackets.'
                )
    if not section.primitives:
        raise CatalogueError(f"{place} has no [[primitives]].")


def _check_acts_on_dynamic_trials(
    section: EffectSection, templates: Sequence["_PrimitiveTemplate"]
) -> None:
    """Raise an error if an effect depends on time, but is to act on trials that have no time.

    The rows of static trials and of flights are not samples of a motion in time. A primitive
    depends on time if it acts in windows of time or has a value that is a formula in time.
    """
    time_dependent = [
        template
        for template in templates
        if template.acts_in_windows or PRIMITIVES[template.kind].formula_fields
    ]
    if not time_dependent:
        return
    kinds_without_time = section.acts_on - DYNAMIC
    # in the order of the enumeration, so that the message is always the same
    for kind in TrialKind:
        if kind in kinds_without_time:
            raise CatalogueError(
                f"{time_dependent[0].place} asks for the time of trials, but 'acts_on' has "
                f"{kind.value!r}, whose rows have no time."
            )


# ---------------------------------------------------------------- primitives


@dataclass(frozen=True)
class _PrimitiveTemplate:
    """A primitive of a patch whose values are expressions that are not evaluated yet.

    Attributes
    ----------
    place : str
        File, effect and number of the primitive, for messages.
    kind : str
        Kind of the primitive.
    values : mapping of str to (str, float or Expression)
        Values of the primitive's fields, constant or as expressions.
    conditions : mapping of str to Expression
        Expressions for when it acts, by key: "begin" and "end" of a window, and "if".
    scales : frozenset of str
        Names in `SCALES` that the expressions use.
    event_times : frozenset of str
        Names of the event times that the expressions use.
    """

    place: str
    kind: str
    values: Mapping[str, str | float | Expression]
    conditions: Mapping[str, Expression]
    scales: frozenset[str]
    event_times: frozenset[str]

    @property
    def acts_in_windows(self) -> bool:
        """Whether the primitive acts only in a window of time."""
        return "begin" in self.conditions or "end" in self.conditions

    def primitives(self, context: BuildContext) -> Iterator[Primitive]:
        """Yield the evaluated primitive, once for each occurrence of its events in dynamic trials.

        Each primitive then acts in a window of time of its trial. A template without events and
        windows gives one primitive. If its expression `if` is zero, it gives none.
        """
        values_by_name = dict(context.values)
        for name in self.scales:
            values_by_name[name] = SCALES[name](context)
        if "if" in self.conditions and self.conditions["if"].value(values_by_name) == 0.0:
            return
        if not self.event_times and not self.acts_in_windows:
            yield self._evaluate_primitive(values_by_name, context.target)
            return
        for trial in context.setting.campaign.trials:
            if not trial.is_dynamic:
                continue
            occurrences = context.setting.campaign.event_times(trial.name, self.event_times)
            for times_by_name in occurrences:
                values_and_times = {**values_by_name, **times_by_name}
                begin = self._end_of_window("begin", values_and_times)
                end = self._end_of_window("end", values_and_times)
                primitive = self._evaluate_primitive(values_and_times, context.target)
                yield replace(primitive, windows=(Window(trial.name, begin, end),))

    def _end_of_window(self, key: str, values_by_name: Mapping[str, float]) -> float | None:
        """Return the "begin" or "end" of the primitive's window [s]; None if it is open there."""
        expression = self.conditions.get(key)
        return None if expression is None else expression.value(values_by_name)

    def _evaluate_primitive(self, values_by_name: Mapping[str, float], target: Target) -> Primitive:
        """Return the primitive with its expressions evaluated.

        In a formula in time, all names but the time are replaced by numbers. Texts such as "place",
        which stand for the place of the effect, are replaced by the names of the target.
        """
        texts_of_place = {
            "place": target.name,
            "quantity of the place": target.quantity,
            "motion of the place": target.motion,
        }
        formulas = PRIMITIVES[self.kind].formula_fields
        fields_of_primitive: dict[str, str | float] = {}
        for name, value in self.values.items():
            if isinstance(value, str):
                fields_of_primitive[name] = texts_of_place.get(value, value)
            elif not isinstance(value, Expression):
                fields_of_primitive[name] = value
            elif name in formulas:
                used_numbers = {
                    key: values_by_name[key] for key in value.used_names() if key in values_by_name
                }
                fields_of_primitive[name] = value.with_numbers(used_numbers)
            else:
                fields_of_primitive[name] = value.value(values_by_name)
        return _build_primitive(self.kind, fields_of_primitive)


def _parse_primitive(
    row: Mapping[str, str | float],
    parameters: frozenset[str],
    event_times: frozenset[str],
    place: str,
) -> _PrimitiveTemplate:
    """Parse a table `[[primitives]]` into a template with expressions.

    Numbers, and texts of fields that hold texts, stay as they are.

    Parameters
    ----------
    row : mapping of str to (str or float)
        The table.
    parameters, event_times : frozenset of str
        Names of parameters and of event times that expressions may use.
    place : str
        File, effect and number of the primitive, for messages.

    Raises
    ------
    CatalogueError
        If a key is unknown or missing, or an expression is not sound.
    """
    kind = str(row.get("kind"))
    if kind not in PRIMITIVES:
        raise CatalogueError(
            f"{place}: 'kind' is {kind!r}, but the known ones are {', '.join(PRIMITIVES)}."
        )
    primitive = PRIMITIVES[kind]
    types = primitive.value_types()
    window_keys = ("begin", "end") if primitive.can_act_in_windows else ()
    allowed_keys = ("kind", *types, *window_keys, "if")
    # a scale can be used only if the effect has the shape parameters that it depends on
    scales = {name for name in SCALES if SHAPES_OF_SCALES.get(name, set()) <= parameters}
    known_names = parameters | scales
    values: dict[str, str | float | Expression] = {}
    conditions: dict[str, Expression] = {}
    with CatalogueError.instead_of(InvalidPatchError, before=f"{place}: "):
        for key, value in row.items():
            if key not in allowed_keys:
                raise CatalogueError(
                    f"{place} has the unknown key {key!r}; the known keys are "
                    f"{', '.join(allowed_keys)}."
                )
            text = value if isinstance(value, str) else repr(value)
            if key == "kind":
                continue
            if key not in types:
                names = known_names | event_times if key in window_keys else known_names
                conditions[key] = Expression(text, names, repr(key))
            elif key in primitive.formula_fields:
                values[key] = Expression(text, known_names | event_times | {"time"}, repr(key))
            elif isinstance(value, str) and types[key] is not str:
                values[key] = Expression(text, known_names, repr(key))
            else:
                values[key] = value
        _check_values(kind, values)
    used: set[str] = set()
    for expression in (*values.values(), *conditions.values()):
        if isinstance(expression, Expression):
            used.update(expression.used_names())
    return _PrimitiveTemplate(
        place=place,
        kind=kind,
        values=values,
        conditions=conditions,
        scales=frozenset(used & SCALES.keys() - parameters),
        event_times=frozenset(used & event_times),
    )


def _check_values(kind: str, values: Mapping[str, str | float | Expression]) -> None:
    """Raise an error if a primitive lacks a value.

    The primitive is built with the number one in the place of each expression, which raises an
    error if a value is missing.
    """
    row: dict[str, str | float] = {}
    for key, value in values.items():
        if not isinstance(value, Expression):
            row[key] = value
        else:
            row[key] = "1" if key in PRIMITIVES[kind].formula_fields else 1.0
    _build_primitive(kind, row)


@dataclass(frozen=True)
class _EffectFunctions:
    """The functions of an `Effect` that a file describes.

    Attributes
    ----------
    section : EffectSection
        Content of the file.
    templates : tuple of _PrimitiveTemplate
        Primitives of its patch.
    """

    section: EffectSection
    templates: tuple[_PrimitiveTemplate, ...]

    def _in_setting(self, setting: Setting) -> EffectInSetting:
        """Return the effect in a setting."""
        kinds = tuple(PRIMITIVES[template.kind] for template in self.templates)
        event_times: set[str] = set()
        for template in self.templates:
            event_times |= template.event_times
        return EffectInSetting(setting, self.section, kinds, frozenset(event_times))

    def places(self, setting: Setting) -> tuple[str, ...]:
        """Return the places where the effect may act in a setting."""
        return places_of(self._in_setting(setting))

    def unavailable(self, setting: Setting) -> str | None:
        """Return the reason if the effect cannot be tested in a setting, else None."""
        return untestable_reason(self._in_setting(setting))

    def build(self, setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
        """Return the patch of the effect.

        Parameters
        ----------
        setting : Setting
            Campaign and model.
        values : mapping of str to float
            Values of the parameters and shape parameters by name.
        place : str
            Name of the place where the effect acts.
        """
        effect = self._in_setting(setting)
        primitives: list[Primitive] = []
        for target in effect.targets(place):
            context = BuildContext(effect, target, values)
            for template in self.templates:
                with CatalogueError.instead_of(InvalidPatchError, before=f"{template.place}: "):
                    primitives += template.primitives(context)
        return ModelPatch(tuple(primitives))


def _build_primitive(kind: str, row: Mapping[str, str | float]) -> Primitive:
    """Build a primitive from its values; floats become integers for fields that are integers."""
    types = PRIMITIVES[kind].value_types()
    integers: dict[str, int] = {}
    for name, value in row.items():
        if types[name] is int and isinstance(value, float) and value == int(value):
            integers[name] = int(value)
    (primitive,) = ModelPatch.from_list([{"kind": kind, **row, **integers}])
    return primitive
