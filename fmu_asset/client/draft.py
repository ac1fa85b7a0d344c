"""A first binding for an FMU nobody has bound yet: roles guessed from causality, names and units."""

import re
import tomllib
from collections import Counter
from collections.abc import Iterable, Sequence

from fmu_asset.archive.declared import FLOAT_KINDS, FmuDescription, VariableInfo
from fmu_asset.description import rendered
from fmu_asset.errors import BindingError

from .binding import PORT_QUANTITIES, parse_binding
from .exchange import Exchange
from .units import same_dimension

_HEALTH = re.compile(r"health|damage|wear|foul|crack|degrad|fault|stiffness_?loss", re.IGNORECASE)
_LOAD = re.compile(
    r"load(?!_?factor)|force|torque|moment|press|ambient|outside|disturb|wind|gust|weight",
    re.IGNORECASE,
)
_LOAD_UNITS = ("N", "N.m", "Pa", "N/m")
_AUXILIARY = re.compile(r"status|error|bound|count|iteration|frequency|ratio", re.IGNORECASE)
_PORT = re.compile(
    r"(?P<stem>.*?)[._ ]?(?P<quantity>force|displacement|velocity)(?P<rest>\[\d+\])?", re.IGNORECASE
)
_NUMBERED = re.compile(r"(?P<stem>.*\D|)(?P<number>\d{1,9})(?P<rest>\D*)", re.DOTALL)
_INNER = ("local", "calculatedParameter", "none")
_PATTERN = re.compile(r"\{\d+\.\.\d+\}")


def draft_binding(description: FmuDescription, *, step_size: float | None = None) -> str:
    """Return a binding file for an FMU, to be corrected by whoever knows what it models.

    Inputs are controls, unless name or unit say health or load; real outputs are observations, those that are
    numbered together; other outputs are recorded beside them; parameters are parameters. A force input that
    has a displacement or velocity output of the same stem becomes a port. The text is checked against the FMU
    before it is returned.

    Parameters
    ----------
    description : FmuDescription
        The FMU.
    step_size : float, optional
        Communication step size [s]; that of the FMU's default experiment, or 1.

    Raises
    ------
    BindingError
        If the FMU has no number to observe.
    """
    usable = [v for v in description.variables if bindable(v)]
    seen = observable(description, usable)
    reals = [v for v in seen if v.kind in FLOAT_KINDS]
    observed = [v for v in reals if not _AUXILIARY.search(v.name)] or reals or seen
    ports = _ports([v for v in usable if v.causality in ("input", "output")])
    in_port = {variable.name for port in ports.values() for variable in port.values()}
    known, shown = {v.name for v in usable}, {v.name for v in observed}
    keys = _Keys()
    inputs = [(_role(v), v) for v in usable if v.causality == "input" and v.name not in in_port]
    chosen = [v for v in usable if v.causality == "parameter" and v.variability != "constant"]
    text = rendered(
        "draft.toml",
        fmu=description,
        name=keys.of("binding", description.model_name),
        step_size=description.step_of(step_size),
        inputs=[(role, keys.of(role, v.name), v) for role, v in inputs],
        observed=[(keys.of("observation", _stem(group)), group) for group in _groups(observed)],
        parameters=[(keys.of("parameter", v.name), v) for v in chosen],
        ports=[(keys.of("port", stem or "port"), port) for stem, port in ports.items()],
        recorded=_groups(v for v in usable if v.causality == "output" and v.name not in shown),
        others=[v.name for v in usable if v.causality in _INNER],
        left_out=[
            v.name for v in description.variables if v.name not in known and v.causality != "local"
        ],
        float_kinds=FLOAT_KINDS,
        pattern=_pattern,
        comment=_comment,
    ).decode()
    text = text.rstrip() + "\n"
    Exchange(description, parse_binding(tomllib.loads(text), where="the draft"))
    return text


def bindable(variable: VariableInfo) -> bool:
    """Return whether a variable can be bound; a pattern of ours in somebody's name would be expanded."""
    numbers = variable.numeric and not variable.clocked and variable.size > 0
    return numbers and not _PATTERN.search(variable.name)


def observable(description: FmuDescription, usable: Sequence[VariableInfo]) -> list[VariableInfo]:
    """Return the outputs, those of real numbers if there are; a local variable where there is no output.

    Raises
    ------
    BindingError
        If there is nothing.
    """
    outputs = [variable for variable in usable if variable.causality == "output"]
    inner = [v for v in usable if v.causality in _INNER and v.kind in FLOAT_KINDS]
    if not (outputs or inner):
        raise BindingError(f"{description.label} has no number that could be observed.")
    return outputs or inner[:1]


class _Keys:
    """Names of tables, unique within their role."""

    def __init__(self) -> None:
        self._wished: Counter[tuple[str, str]] = Counter()

    def of(self, role: str, name: str) -> str:
        """Return a name for a table: what is wished or, where that is taken, its first free number."""
        key = wish = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_").lower() or "x"
        while self._wished[role, key]:
            self._wished[role, wish] += 1
            key = f"{wish}_{self._wished[role, wish]}"
        self._wished[role, key] += 1
        return key


def _role(variable: VariableInfo) -> str:
    if _HEALTH.search(variable.name):
        return "health"
    unit = variable.unit or ""
    if _LOAD.search(variable.name) or any(same_dimension(unit, load) for load in _LOAD_UNITS):
        return "load"
    return "control"


def _ports(variables: Sequence[VariableInfo]) -> dict[str, dict[str, VariableInfo]]:
    """Return by stem a force that goes one way and a motion that goes the other."""
    found: dict[str, dict[str, VariableInfo]] = {}
    for variable in sorted(variables, key=lambda variable: variable.causality):
        match = _PORT.fullmatch(variable.name)
        quantity = match["quantity"].lower() if match else ""
        units = PORT_QUANTITIES.get(quantity, ())
        if match and any(same_dimension(variable.unit or "", unit) for unit in units):
            found.setdefault(match["stem"] + (match["rest"] or ""), {})[quantity] = variable
    ports = {}
    for stem, port in found.items():
        # The force stands alone on its side.
        sides = [variable.causality for variable in port.values()]
        if len(port) > 1 and "force" in port and sides.count(port["force"].causality) == 1:
            ports[stem] = {
                quantity: port[quantity] for quantity in PORT_QUANTITIES if quantity in port
            }
    return ports


def _groups(variables: Iterable[VariableInfo]) -> list[list[VariableInfo]]:
    """Put variables together that are numbered one after the other and have one unit."""
    groups: list[list[VariableInfo]] = []
    following: object = None  # what the next one of the last group is called
    for variable in variables:
        now = None if variable.shape else _NUMBERED.fullmatch(variable.name)
        own = now and (now["stem"], now["number"], now["rest"], variable.unit)
        if now and own == following:
            groups[-1].append(variable)
        else:
            groups.append([variable])
        following = None
        if now and str(int(now["number"])) == now["number"]:
            following = (now["stem"], str(int(now["number"]) + 1), now["rest"], variable.unit)
    return groups


def _pattern(group: Sequence[VariableInfo]) -> str:
    """Return the name of a variable, or the pattern of a group."""
    first, last = (_NUMBERED.fullmatch(group[end].name) for end in (0, -1))
    if len(group) == 1 or first is None or last is None:
        return group[0].name
    return f"{first['stem']}{{{first['number']}..{last['number']}}}{first['rest']}"


def _stem(group: Sequence[VariableInfo]) -> str:
    numbered = _NUMBERED.fullmatch(group[0].name) if len(group) > 1 else None
    return numbered["stem"].rstrip("[._ ") or "values" if numbered else group[0].name


def _comment(text: str) -> str:
    return " ".join(re.sub(r"[\x00-\x1f\x7f]", " ", text).split())[:120]
