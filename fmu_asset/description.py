"""The declaration of an FMU that we build, and the files that templates make from it."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.metadata import version
from itertools import groupby
from typing import NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from fmu_asset.slaves.variables import ENUMERATIONS, EnumerationType, FmuVariable
from reporting.formats.toml_file import toml_value
from reporting.units import BASE_UNITS, conversion_of

_ELEMENT = re.compile(r"(?P<stem>.+)(?:\[(?P<index>[0-9]+)\]|\.(?P<label>[^.]+))")
"""Name of an element of an array: `strain[1]` or `health.z1`."""
LOG_CATEGORIES = {
    "logStatusWarning": "Log messages with fmi2Warning status.",
    "logStatusDiscard": "Log messages with fmi2Discard status.",
    "logStatusError": "Log messages with fmi2Error status.",
    "logStatusFatal": "Log messages with fmi2Fatal status.",
    "logAll": "Log all messages.",
}

PLACEHOLDER = "0_content_0_"
"""Placeholder for the first characters of the content hash, until the hash is known."""


class DeclaredUnit(NamedTuple):
    """A unit in SI base units.

    Attributes
    ----------
    base : dict of str to float
        The non-zero exponents of base units, and factor and offset if they differ from 1 and 0.
        Empty for an unknown unit.
    displays : dict of str to float
        The factors of display units.
    """

    base: dict[str, float]
    displays: dict[str, float]


@dataclass(frozen=True)
class Declaration:
    """The declarations of an FMU that we build.

    Attributes
    ----------
    name : str
        Model name, with which the model identifier begins.
    description : str
        A sentence that describes the FMU.
    table : tuple of FmuVariable
        The variables, in the order of their value references. Local variables are states, followed
        by as many derivatives.
    dependencies : mapping of str to sequence of str
        Inputs that each output depends on directly; an output without an entry depends on all
        inputs.
    """

    name: str
    description: str
    table: tuple[FmuVariable, ...]
    dependencies: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @property
    def units(self) -> dict[str, DeclaredUnit]:
        """The units of the table by name."""
        units: dict[str, DeclaredUnit] = {}
        for row in self.table:
            if row.unit:
                unit = units.setdefault(row.unit, DeclaredUnit({}, {}))
                _declare_unit(unit, row.unit, row.display_unit)
        return units

    @property
    def enumerations(self) -> tuple[EnumerationType, ...]:
        """The enumerations of the table."""
        names = {row.enumeration for row in self.table}
        return tuple(entry for entry in ENUMERATIONS if entry.name in names)

    @property
    def identifier(self) -> str:
        """Model identifier, the stem of the binary, before the content hash is known."""
        return f"{self.name}_{PLACEHOLDER}"


def _declare_unit(unit: DeclaredUnit, name: str, display_unit: str | None) -> None:
    """Add the meaning of a unit to its declaration: exponents, factor, offset and a display unit.

    The meaning is that of the name, such as "N/mm". A unit of another name is declared by its name
    alone, and stays unchanged.
    """
    meaning = conversion_of(name)
    if meaning is None:
        return
    for symbol, exponent in zip(BASE_UNITS, meaning.exponents, strict=True):
        if exponent:
            unit.base[symbol] = exponent
    if meaning.factor != 1.0 or meaning.offset != 0.0:
        unit.base["factor"] = meaning.factor
        unit.base["offset"] = meaning.offset
    if display_unit:
        display_meaning = conversion_of(display_unit)
        if display_meaning is not None:
            unit.displays[display_unit] = meaning.factor / display_meaning.factor


# ---------------------------------------------------------------------- templates


@cache
def _templates() -> Environment:
    """Return the templates of `fmu_asset/templates` with the filters that they use."""
    environment = Environment(
        loader=PackageLoader("fmu_asset"),
        autoescape=select_autoescape(
            ("xml.jinja", "html.jinja", "ssd.jinja", "ssv.jinja", "ssm.jinja")
        ),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "c_text": _c_text,
        "c_number": _c_number,
        "quoted": toml_value,
        "written": _xml_value,
    }
    return environment


def rendered(template: str, /, **values: object) -> bytes:
    """Return a template with values filled in, as UTF-8; floats are written with all their digits.

    Parameters
    ----------
    template : str
        The name of a file in `fmu_asset/templates`, without `.jinja`.
    **values : object
        The values that the template uses.
    """
    return _templates().get_template(f"{template}.jinja").render(**values).encode()


def _c_text(text: str) -> str:
    """Return a text as a string literal of C.

    Units may contain any character, and messages pass through printf, so everything but plain
    characters is escaped.
    """
    characters = []
    for byte in text.encode():
        character = chr(byte)
        is_plain = 32 <= byte < 127 and character not in '"\\?'
        characters.append(character if is_plain else f"\\{byte:03o}")
    return f'"{"".join(characters)}"'


def _c_number(value: float | None, absent: str) -> str:
    """Return a number as a constant of C that has exactly the same bits.

    Parameters
    ----------
    value : float or None
        The number.
    absent : str
        The text for None and for infinity.
    """
    if value is None or math.isinf(value):
        return absent
    return repr(float(value))


def _xml_value(value: float | None, kind: str) -> str | None:
    """Return a value as text for an XML attribute, by the type of its variable; None stays None."""
    if value is None:
        return None
    if kind == "Boolean":
        return repr(bool(value)).lower()
    if kind == "Real":
        return repr(float(value))
    return repr(int(value))


# ---------------------------------------------------------------------- arrays


@dataclass(frozen=True)
class ArrayVariable:
    """Successive rows as one array, which has the value reference of the first row.

    Attributes
    ----------
    name : str
        Common stem: `strain` for `strain[1]`, ...; `health` for `health.z1`, ...
    rows : tuple of FmuVariable
        The elements, which differ only in name, description and start value.
    """

    name: str
    rows: tuple[FmuVariable, ...]

    @property
    def description(self) -> str:
        """Description of the first element, with "i" instead of its index or label."""
        labels = []
        for row in self.rows:
            match = _ELEMENT.fullmatch(row.name)
            if match:
                labels.append(match["index"] or match["label"])
        first_label = labels[0]
        pattern = rf"\b{re.escape(first_label)}\b|\b1\b"
        text = re.sub(pattern, "i", self.rows[0].description, count=1)
        if first_label == "1":
            return text
        return f"{text}; i is one of {', '.join(labels)}"


def arrays_of(table: Sequence[FmuVariable]) -> tuple[ArrayVariable, ...]:
    """Return the arrays that the variables of a table form in FMI 3.

    An array consists of successive numbered variables such as `strain[1]`, or inputs and outputs
    such as `health.z1`. Rows with different units or ranges stay scalars.
    """
    arrays = []
    for stem, group in groupby(table, _array_stem):
        rows = tuple(group)
        common_fields = set()
        for row in rows:
            common_fields.add(replace(row, name="", reference=0, description="", start=None))
        if stem is not None and len(common_fields) == 1:
            arrays.append(ArrayVariable(stem, rows))
    return tuple(arrays)


def _array_stem(row: FmuVariable) -> str | None:
    """Return the name of the array that a row may belong to; None for a scalar."""
    match = _ELEMENT.fullmatch(row.name)
    if match is None or row.causality == "parameter" or row.kind != "Real":
        return None
    return match["stem"]


# ---------------------------------------------------------------------- model description


def description_members(
    declared: Declaration,
    *,
    generation_tool: str,
    host: str,
    source_files: Sequence[str] = (),
    fmi: int = 2,
    arrays: Sequence[ArrayVariable] = (),
) -> dict[str, bytes]:
    """Return the files modelDescription.xml and index.html (the documentation) of an FMU.

    The FMU is for co-simulation, or, with states, for model exchange. A placeholder stands for what
    the content hash will give. There is no generation date: equal content gives equal bytes.

    Parameters
    ----------
    generation_tool : str
        Attribute of the root element.
    host : str
        Sentence on the host that the FMU needs, for its documentation.
    source_files : sequence of str
        C sources in the folder `sources`; an FMU without any needs Python to run.
    fmi : {2, 3}
        Version of FMI.
    arrays : sequence of ArrayVariable
        Variables that are elements of arrays, in FMI 3.

    Returns
    -------
    dict of str to bytes
        Content by name in the archive.
    """
    later_elements = {row.reference for array in arrays for row in array.rows[1:]}
    rows = [row for row in declared.table if row.reference not in later_elements]
    local_rows = [row for row in rows if row.causality == "local"]
    state_count = len(local_rows) // 2
    states = local_rows[:state_count]
    rates = local_rows[state_count:]
    state_of = {}
    for state, rate in zip(states, rates, strict=True):
        # FMI 2 counts variables from 1, FMI 3 uses value references; ours differ by one
        state_of[rate.reference] = state.reference + 1 if fmi == 2 else state.reference
    index_of = {row.name: row.reference + 1 for row in rows}
    dependencies = {}
    for name, sources in declared.dependencies.items():
        dependencies[name] = sorted(index_of[source] for source in sources)
    xml = rendered(
        "modelDescription.xml",
        declared=declared,
        fmi=fmi,
        tool=generation_tool,
        version=version("uav-twin"),
        token=PLACEHOLDER,
        sources=source_files,
        exchange=bool(local_rows),
        categories=LOG_CATEGORIES,
        rows=rows,
        heads={array.rows[0].reference: array for array in arrays},
        state_of=state_of,
        dependencies=dependencies,
        rates=rates,
    )
    interface = "model-exchange" if local_rows else "co-simulation"
    page = rendered("index.html", declared=declared, host=host, fmi=fmi, interface=interface)
    return {"modelDescription.xml": xml, "documentation/index.html": page}
