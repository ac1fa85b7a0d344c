"""A first binding for an FMU nobody has bound yet: roles guessed from causality, names and units."""

import json
import math
import re
import tomllib
from collections import Counter
from collections.abc import Iterable, Sequence

from fmu_asset.archive.declared import FLOAT_KINDS, FmuDescription, VariableInfo
from fmu_asset.errors import BindingError

from .binding import PORT_QUANTITIES, parse_binding
from .exchange import Exchange
from .units import same_dimension

_HEALTH = re.compile(r"health|damage|wear|foul|crack|degrad|fault|stiffness_?loss", re.IGNORECASE)
_LOAD = re.compile(
    r"load(?!_?factor)|force|torque|moment|press|ambient|outside|disturb|wind|gust|weight", re.IGNORECASE
)
_LOAD_UNITS = ("N", "N.m", "Pa", "N/m")
_AUXILIARY = re.compile(r"status|error|bound|count|iteration|frequency|ratio", re.IGNORECASE)
_PORT = re.compile(
    r"(?P<stem>.*?)[._ ]?(?P<quantity>force|displacement|velocity)(?P<rest>\[\d+\])?", re.IGNORECASE
)
_NUMBERED = re.compile(r"(?P<stem>.*\D|)(?P<number>\d+)(?P<rest>\D*)", re.DOTALL)
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
    draft = _Draft(description, step_size)
    text = draft.text()
    Exchange(description, parse_binding(tomllib.loads(text), where="the draft"))
    return text


def bindable(variable: VariableInfo) -> bool:
    """Return whether a variable can be bound; a pattern of ours in somebody's name would be expanded."""
    return bool(
        variable.numeric and not variable.clocked and variable.size and not _PATTERN.search(variable.name)
    )


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
        raise BindingError(f"{description.path} has no number that could be observed.")
    return outputs or inner[:1]


class _Draft:
    def __init__(self, description: FmuDescription, step_size: float | None) -> None:
        if step_size is not None and not (math.isfinite(step_size) and step_size > 0.0):
            raise BindingError(f"The step size must be a positive number of seconds, and {step_size:g} came.")
        self._description = description
        usable = [v for v in description.variables if bindable(v)]
        self._inputs = [v for v in usable if v.causality == "input"]
        self._outputs = [v for v in usable if v.causality == "output"]
        self._parameters = [v for v in usable if v.causality == "parameter" and v.variability != "constant"]
        self._others = [v for v in usable if v.causality in _INNER]
        self._observable = observable(description, usable)
        names = {v.name for v in usable}
        self._left_out = [v for v in description.variables if v.name not in names and v.causality != "local"]
        declared = step_size or description.fixed_step or description.step_size
        self._step_size, self._step_known = declared or 1.0, declared is not None
        self._keys: set[tuple[str, str]] = set()
        self._wished: Counter[tuple[str, str]] = Counter()

    def text(self) -> str:
        lines = self._header()
        ports = self._ports()
        bound = {variable.name for port in ports.values() for variable in port.values()}
        for variable in self._inputs:
            if variable.name not in bound:
                lines += self._table(self._role(variable), variable)
        reals = [v for v in self._observable if v.kind in FLOAT_KINDS]
        observed = [v for v in reals if not _AUXILIARY.search(v.name)] or reals or self._observable
        for group in _groups(observed):
            lines += self._table("observation", *group, key="variables")
        names = {variable.name for variable in observed}
        recorded = [variable for variable in self._outputs if variable.name not in names]
        for variable in self._parameters:
            lines += self._table("parameter", variable)
        for stem, port in ports.items():
            lines += self._port(stem, port)
        lines += self._record(recorded)
        return "\n".join(lines).rstrip() + "\n"

    def _header(self) -> list[str]:
        description = self._description
        known = "" if self._step_known else "; the FMU does not say one, choose it"
        lines = [
            f"# Drafted from {_comment(description.path.name)}: {_comment(description.model_name)}, FMI "
            f"{description.fmi_version}, {description.interface}.",
            "# The roles are guesses: control (chosen), health (damage), load (other inputs), "
            "observation (measured),",
            "# monitor (recorded beside), parameter (set before the first step), port (coupled to "
            "another FMU).",
            "[binding]",
            f"name = {_quoted(self._key('binding', description.model_name))}",
            f'fmi_version = "{description.major_version}.0"',
            f"step_size = {self._step_size!r} # s{known}",
        ]
        if description.start_time:
            lines.append(f"start_time = {description.start_time!r} # s")
        if len(description.interfaces) > 1:
            lines.append(f'interface = "{description.interface}"')
        if not description.can_vary_step and description.interface == "co-simulation":
            lines.append("# The FMU takes this step size only; `decimation = n` observes every n-th step.")
        return [*lines, ""]

    def _role(self, variable: VariableInfo) -> str:
        if _HEALTH.search(variable.name):
            return "health"
        unit = variable.unit or ""
        if _LOAD.search(variable.name) or any(same_dimension(unit, load) for load in _LOAD_UNITS):
            return "load"
        return "control"

    def _table(self, role: str, *group: VariableInfo, key: str = "variable") -> list[str]:
        """Return the table of a variable, or of several that are numbered."""
        first = group[0]
        numbered = _NUMBERED.fullmatch(first.name) if len(group) > 1 else None
        stem = numbered["stem"].rstrip("[._ ") or "values" if numbered else first.name
        return [
            f"[{role}.{self._key(role, stem)}]{_about(first)}",
            f"{key} = {_quoted(_pattern(group))}",
            f"unit = {_quoted(first.unit or '1')}{_unit_note(first)}",
            "",
        ]

    def _ports(self) -> dict[str, dict[str, VariableInfo]]:
        """Return stems with a force that goes one way and a motion that goes the other."""
        found: dict[str, dict[str, VariableInfo]] = {}
        for variable in [*self._inputs, *self._outputs]:
            match = _PORT.fullmatch(variable.name)
            units = PORT_QUANTITIES[match["quantity"].lower()] if match else ()
            if match and any(same_dimension(variable.unit or "", unit) for unit in units):
                own = found.setdefault(match["stem"] + (match["rest"] or ""), {})
                own[match["quantity"].lower()] = variable
        return {
            stem: port
            for stem, port in found.items()
            if "force" in port
            and len(port) > 1
            and all(
                (variable.causality == "input") != (port["force"].causality == "input")
                for quantity, variable in port.items()
                if quantity != "force"
            )
        }

    def _port(self, stem: str, port: dict[str, VariableInfo]) -> list[str]:
        quantities = [
            f"{quantity} = {{ variables = {_quoted(port[quantity].name)}, "
            f"unit = {_quoted(port[quantity].unit or '1')} }}"
            for quantity in PORT_QUANTITIES
            if quantity in port
        ]
        return [f"[port.{self._key('port', stem or 'port')}]", *quantities, ""]

    def _record(self, recorded: Sequence[VariableInfo]) -> list[str]:
        lines = []
        if recorded:
            lines += ["[record] # beside the observations, in the FMU's units", "variables = ["]
            lines += [f"    {_quoted(_pattern(group))}," for group in _groups(recorded)]
            lines += ["]"]
        if self._others:
            lines += [f"# Can be recorded as well: {_listed(v.name for v in self._others)}"]
        if self._left_out:
            lines.append(
                f"# Not bindable (texts, clocks, binaries): {_listed(v.name for v in self._left_out)}"
            )
        return lines

    def _key(self, role: str, name: str) -> str:
        """Return a name for a table, unique within its role."""
        wish = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_").lower() or "x"
        while True:
            self._wished[role, wish] += 1
            number = self._wished[role, wish]
            key = wish if number == 1 else f"{wish}_{number}"
            if (role, key) not in self._keys:
                self._keys.add((role, key))
                return key


def _groups(variables: Iterable[VariableInfo]) -> list[list[VariableInfo]]:
    """Put variables together that are numbered one after the other and have one unit."""
    groups: list[list[VariableInfo]] = []
    for variable in variables:
        now = _NUMBERED.fullmatch(variable.name)
        before = _NUMBERED.fullmatch(groups[-1][-1].name) if groups else None
        follows = (
            now is not None
            and before is not None
            and (now["stem"], now["rest"]) == (before["stem"], before["rest"])
            and now["number"] == str(int(before["number"]) + 1)
            and before["number"] == str(int(before["number"]))
            and not (variable.shape or groups[-1][-1].shape)
            and variable.unit == groups[-1][-1].unit
        )
        if follows:
            groups[-1].append(variable)
        else:
            groups.append([variable])
    return groups


def _pattern(group: Sequence[VariableInfo]) -> str:
    """Return the name of a variable, or the pattern of a group."""
    first, last = (_NUMBERED.fullmatch(group[end].name) for end in (0, -1))
    if len(group) == 1 or first is None or last is None:
        return group[0].name
    return f"{first['stem']}{{{first['number']}..{last['number']}}}{first['rest']}"


def _about(variable: VariableInfo) -> str:
    """Return a comment with what the FMU says of a variable."""
    parts = [_comment(variable.description)] if variable.description else []
    if variable.shape:
        parts.append(f"array {' x '.join(map(str, variable.shape))}")
    if variable.minimum is not None or variable.maximum is not None:
        low = "-inf" if variable.minimum is None else f"{variable.minimum:g}"
        high = "inf" if variable.maximum is None else f"{variable.maximum:g}"
        parts.append(f"{low} to {high}")
    if variable.start is not None and variable.causality in ("input", "parameter"):
        parts.append(f"start {_comment(variable.start)}")
    return f" # {'; '.join(parts)}" if parts else ""


def _unit_note(variable: VariableInfo) -> str:
    return "" if variable.unit or variable.kind not in FLOAT_KINDS else " # not declared by the FMU"


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _comment(text: str) -> str:
    return " ".join(re.sub(r"[\x00-\x1f\x7f]", " ", text).split())[:120]


def _listed(names: Iterable[str]) -> str:
    given = [_comment(name) for name in names]
    more = f" and {len(given) - 20} more" if len(given) > 20 else ""
    return ", ".join(given[:20]) + more
