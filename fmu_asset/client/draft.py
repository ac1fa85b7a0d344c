"""Drafts a binding for an FMU: roles are guessed from causality, names and units."""

import re
import tomllib
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from fmu_asset.archive.declared import FLOAT_KINDS, FmuDescription, VariableInfo
from fmu_asset.description import rendered
from fmu_asset.errors import BindingError

from .binding import parse_binding
from .blocks import Blocks
from .bound_variables import PORT_QUANTITIES
from .units import same_dimension

_HEALTH = re.compile(
    r"health|damage|wear|foul|clog|crack|corro|erosi|degrad|fault|stiffness_?loss", re.IGNORECASE
)
_LOAD = re.compile(
    r"load(?!_?factor)|force|torque|moment|press|ambient|outside|disturb|wind|gust|weight",
    re.IGNORECASE,
)
_LOAD_UNITS = ("N", "N.m", "Pa", "N/m")
_AUXILIARY = re.compile(r"status|error|bound|count|iteration|frequency|ratio", re.IGNORECASE)
_PORT = re.compile(
    r"(?P<stem>.*?)[._ ]?(?P<quantity>force|displacement|velocity)(?P<index>\[\d+\])?",
    re.IGNORECASE,
)
_NUMBERED = re.compile(r"(?P<stem>.*\D|)(?P<number>\d{1,9})(?P<tail>\D*)", re.DOTALL)
_INTERNAL = ("local", "calculatedParameter", "none")
_PATTERN = re.compile(r"\{\d+\.\.\d+\}")

PortVariables = dict[str, VariableInfo]
"""Variables of a port by quantity."""


def draft_binding(description: FmuDescription, *, step_size: float | None = None) -> str:
    """Return a binding file for an FMU, to be corrected by somebody who knows its model.

    Inputs are controls, unless their name or unit indicates health or load. Real outputs are
    observations, numbered ones together; those whose names look auxiliary, and outputs of other
    types, are recorded in addition. A force with a displacement or velocity of the same stem on the
    other side of the FMU becomes a port. The text is checked against the FMU before it is returned.

    Parameters
    ----------
    step_size : float, optional
        Communication step size [s]; that of the FMU's default experiment, or 1.

    Raises
    ------
    BindingError
        If the FMU has no number to observe.
    """
    bindable_variables = [variable for variable in description.variables if bindable(variable)]
    observed_variables = _variables_to_observe(description, bindable_variables)
    ports = _ports([v for v in bindable_variables if v.causality in ("input", "output")])
    port_names = {variable.name for port in ports.values() for variable in port.values()}
    inputs = [v for v in bindable_variables if v.causality == "input" and v.name not in port_names]
    parameters = [
        v for v in bindable_variables if v.causality == "parameter" and v.variability != "constant"
    ]
    observed_names = {variable.name for variable in observed_variables}
    recorded_variables = [
        v for v in bindable_variables if v.causality == "output" and v.name not in observed_names
    ]
    usable_names = {variable.name for variable in bindable_variables}
    keys = _TableKeys()
    text = rendered(
        "draft.toml",
        fmu=description,
        name=keys.key("binding", description.model_name),
        step_size=description.step_of(step_size),
        inputs=[(_role(v), keys.key(_role(v), v.name), v) for v in inputs],
        observed=[
            (keys.key("observation", _stem(group)), group) for group in _groups(observed_variables)
        ],
        parameters=[(keys.key("parameter", v.name), v) for v in parameters],
        ports=[(keys.key("port", stem or "port"), port) for stem, port in ports.items()],
        recorded=_groups(recorded_variables),
        others=[v.name for v in bindable_variables if v.causality in _INTERNAL],
        left_out=[
            v.name
            for v in description.variables
            if v.name not in usable_names and v.causality != "local"
        ],
        float_kinds=FLOAT_KINDS,
        pattern=_pattern,
        comment=_comment,
    ).decode()
    text = text.rstrip() + "\n"
    # fails if the draft does not fit the FMU
    Blocks(description, parse_binding(tomllib.loads(text), where="the draft"))
    return text


def bindable(variable: VariableInfo) -> bool:
    """Return whether a binding can name a variable.

    It must be a number without a clock, and its name must not look like a pattern such as `{1..3}`,
    which would be expanded.
    """
    is_number = variable.numeric and not variable.clocked and variable.size > 0
    return is_number and not _PATTERN.search(variable.name)


def observable(description: FmuDescription, usable: Sequence[VariableInfo]) -> list[VariableInfo]:
    """Return the outputs among usable variables; if there are none, the first internal number.

    Raises
    ------
    BindingError
        If there is neither.
    """
    outputs = [v for v in usable if v.causality == "output"]
    internal = [v for v in usable if v.causality in _INTERNAL and v.kind in FLOAT_KINDS]
    if not outputs and not internal:
        raise BindingError(f"{description.label} has no number that could be observed.")
    return outputs or internal[:1]


def _variables_to_observe(
    description: FmuDescription, usable: Sequence[VariableInfo]
) -> list[VariableInfo]:
    """Return the real outputs whose names do not look auxiliary.

    If there are none, return all real outputs; without these, all outputs.
    """
    candidates = observable(description, usable)
    real_outputs = [v for v in candidates if v.kind in FLOAT_KINDS]
    main_outputs = [v for v in real_outputs if not _AUXILIARY.search(v.name)]
    return main_outputs or real_outputs or candidates


class _TableKeys:
    """Makes keys for the tables of a binding, which are unique within their role."""

    def __init__(self) -> None:
        self._uses: Counter[tuple[str, str]] = Counter()

    def key(self, role: str, name: str) -> str:
        """Return a key made from a name, with a number appended if it is used already.

        A name that begins with its role loses it: `health.z1` gives `z1`.
        """
        words = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_").lower()
        plain_key = words.removeprefix(f"{role}_") or "x"
        key = plain_key
        while self._uses[role, key]:
            self._uses[role, plain_key] += 1
            key = f"{plain_key}_{self._uses[role, plain_key]}"
        self._uses[role, key] += 1
        return key


def _role(variable: VariableInfo) -> str:
    """Return the role of an input, guessed from its name and unit."""
    if _HEALTH.search(variable.name):
        return "health"
    unit = variable.unit or ""
    if _LOAD.search(variable.name) or any(same_dimension(unit, load) for load in _LOAD_UNITS):
        return "load"
    return "control"


def _ports(variables: Sequence[VariableInfo]) -> dict[str, PortVariables]:
    """Return the mechanical ports among inputs and outputs, by the stem of their names.

    A port has a force on one side of the FMU, and displacement or velocity on the other.
    """
    candidates: dict[str, PortVariables] = {}
    for variable in sorted(variables, key=lambda variable: variable.causality):
        match = _PORT.fullmatch(variable.name)
        if match is None:
            continue
        quantity = match["quantity"].lower()
        units = PORT_QUANTITIES[quantity]
        if any(same_dimension(variable.unit or "", unit) for unit in units):
            stem = match["stem"] + (match["index"] or "")
            candidates.setdefault(stem, {})[quantity] = variable
    ports = {}
    for stem, port in candidates.items():
        if _is_port(port):
            ports[stem] = {name: port[name] for name in PORT_QUANTITIES if name in port}
    return ports


def _is_port(variables: PortVariables) -> bool:
    """Return whether variables form a port: one force, and motions of the other causality."""
    if len(variables) < 2 or "force" not in variables:
        return False
    causalities = [variable.causality for variable in variables.values()]
    return causalities.count(variables["force"].causality) == 1


class _NumberedName(NamedTuple):
    """The name of a variable with a number in it, and its unit.

    Attributes
    ----------
    stem, number, tail : str
        The name before the last number, the number, and the rest.
    """

    stem: str
    number: str
    tail: str
    unit: str | None

    def next(self) -> "_NumberedName | None":
        """Return the name with the next number; None if the number has leading zeros."""
        number = int(self.number)
        if str(number) != self.number:
            return None
        return self._replace(number=str(number + 1))


def _numbered_name(variable: VariableInfo) -> _NumberedName | None:
    """Return the name of a scalar, split at the number in it; None for any other variable."""
    if variable.shape:
        return None
    match = _NUMBERED.fullmatch(variable.name)
    if match is None:
        return None
    return _NumberedName(match["stem"], match["number"], match["tail"], variable.unit)


def _groups(variables: Iterable[VariableInfo]) -> list[list[VariableInfo]]:
    """Return variables in groups of successive numbers and equal units."""
    groups: list[list[VariableInfo]] = []
    expected_name: _NumberedName | None = None
    for variable in variables:
        name = _numbered_name(variable)
        if name is not None and name == expected_name:
            groups[-1].append(variable)
        else:
            groups.append([variable])
        expected_name = None if name is None else name.next()
    return groups


def _pattern(group: Sequence[VariableInfo]) -> str:
    """Return the name of a variable, or the pattern of a group."""
    first = _NUMBERED.fullmatch(group[0].name)
    last = _NUMBERED.fullmatch(group[-1].name)
    if len(group) == 1 or first is None or last is None:
        return group[0].name
    return f"{first['stem']}{{{first['number']}..{last['number']}}}{first['tail']}"


def _stem(group: Sequence[VariableInfo]) -> str:
    """Return the name of a variable, or the common beginning of the names of a group."""
    name = group[0].name
    match = _NUMBERED.fullmatch(name) if len(group) > 1 else None
    if match is None:
        return name
    return match["stem"].rstrip("[._ ") or "values"


def _comment(text: str) -> str:
    """Return a text as a short comment: one line without control characters."""
    return " ".join(re.sub(r"[\x00-\x1f\x7f]", " ", text).split())[:120]
