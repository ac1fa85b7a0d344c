"""What an FMU declares, and the texts that are made of it by the templates of this package."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.metadata import version
from itertools import groupby
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from fmu_asset.slaves.variables import ENUMERATIONS, EnumerationType, FmuVariable
from reporting.toml_file import toml_value
from reporting.units import BASE_UNITS, meaning_of

_ELEMENT = re.compile(r"(?P<stem>.+)(?:\[(?P<index>[0-9]+)\]|\.(?P<label>[^.]+))")
LOG_CATEGORIES = {
    "logStatusWarning": "Log messages with fmi2Warning status.",
    "logStatusDiscard": "Log messages with fmi2Discard status.",
    "logStatusError": "Log messages with fmi2Error status.",
    "logStatusFatal": "Log messages with fmi2Fatal status.",
    "logAll": "Log all messages.",
}

PLACEHOLDER = "0_content_0_"
"""Stands for the tag, the first characters of the content hash, until that is known."""


@dataclass(frozen=True)
class Declaration:
    """What an FMU declares, whatever it is made of.

    Attributes
    ----------
    name : str
        Model name, with which the model identifier begins.
    description : str
        One sentence for people.
    table : tuple of FmuVariable
        The variables, in order of their value reference. Local ones are states, and then as many derivatives.
    dependencies : mapping of str to sequence of str
        For each output, the inputs that it depends on directly; an output that is missing depends on all.
    """

    name: str
    description: str
    table: tuple[FmuVariable, ...]
    dependencies: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @property
    def units(self) -> dict[str, tuple[dict[str, float], dict[str, float]]]:
        """For each unit of the table exponents, factor and offset to SI, and factors of display units.

        What a text does not say is left out: of a unit that is not understood no more than its name is told.
        """
        units: dict[str, tuple[dict[str, float], dict[str, float]]] = {}
        for row in self.table:
            meaning, shown = meaning_of(row.unit or ""), meaning_of(row.display_unit or "")
            base, displays = units.setdefault(row.unit, ({}, {})) if row.unit else ({}, {})
            if meaning is not None:
                base |= {symbol: n for symbol, n in zip(BASE_UNITS, meaning.exponents, strict=True) if n}
                if meaning[1:] != (1.0, 0.0):
                    base |= {"factor": meaning.factor, "offset": meaning.offset}
                if shown is not None and row.display_unit:
                    displays[row.display_unit] = meaning.factor / shown.factor
        return units

    @property
    def enumerations(self) -> tuple[EnumerationType, ...]:
        """Enumerations of the table."""
        return tuple(item for item in ENUMERATIONS if item.name in {row.enumeration for row in self.table})

    @property
    def identifier(self) -> str:
        """Model identifier, the stem of the binary, before the content hash is known."""
        return f"{self.name}_{PLACEHOLDER}"


@cache
def _templates() -> Environment:
    environment = Environment(
        loader=PackageLoader("fmu_asset"),
        autoescape=select_autoescape(("xml.jinja", "html.jinja", "ssd.jinja", "ssv.jinja", "ssm.jinja")),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    own = {"c_text": _c_text, "c_number": _c_number, "quoted": toml_value, "written": _written}
    environment.filters |= own
    return environment


def rendered(name: str, /, **values: Any) -> bytes:
    """Return what a template of `fmu_asset/templates` makes of values, as UTF-8; floats keep their bits."""
    return _templates().get_template(f"{name}.jinja").render(**values).encode()


def _c_text(text: str) -> str:
    """Return a text as a C string; units are anything that a user writes, and messages go through printf."""
    plain = (
        chr(byte) if 32 <= byte < 127 and chr(byte) not in '"\\?' else f"\\{byte:03o}"
        for byte in text.encode()
    )
    return f'"{"".join(plain)}"'


def _c_number(value: float | None, absent: str) -> str:
    """Return a float as a C constant that has the same bits."""
    return absent if value is None or math.isinf(value) else repr(float(value))


def _written(value: float | None, kind: str) -> str | None:
    """Return a value of a variable as XML has it."""
    if value is None:
        return None
    shown = {"Real": float, "Boolean": bool}.get(kind, int)(value)
    return repr(shown).lower() if kind == "Boolean" else repr(shown)


@dataclass(frozen=True)
class ArrayVariable:
    """Rows that follow one another, as one array; its value reference is that of the first row.

    Attributes
    ----------
    name : str
        What the names of the rows have in common: `strain` of `strain[1]`, ...; `health` of `health.z1`, ...
    rows : tuple of FmuVariable
        The elements in order, alike but for name, description and start value.
    """

    name: str
    rows: tuple[FmuVariable, ...]

    @property
    def description(self) -> str:
        """Return that of the first element with i in the place of its index or name, and all names."""
        labels = [
            found["index"] or found["label"]
            for found in (_ELEMENT.fullmatch(row.name) for row in self.rows)
            if found
        ]
        text = re.sub(rf"\b{re.escape(labels[0])}\b|\b1\b", "i", self.rows[0].description, count=1)
        return text if labels[0] == "1" else f"{text}; i is one of {', '.join(labels)}"


def arrays_of(table: Sequence[FmuVariable]) -> tuple[ArrayVariable, ...]:
    """Return the arrays of a table: numbered variables, and inputs and outputs such as `health.z1`.

    Rows of one stem that differ in unit or range stay scalars.
    """
    found = []
    for stem, group in groupby(table, _stem):
        rows = tuple(group)
        plain = {replace(row, name="", reference=0, description="", start=None) for row in rows}
        if stem is not None and len(plain) == 1:
            found.append(ArrayVariable(stem, rows))
    return tuple(found)


def _stem(row: FmuVariable) -> str | None:
    match = _ELEMENT.fullmatch(row.name)
    return None if match is None or row.causality == "parameter" or row.kind != "Real" else match["stem"]


def description_members(
    declared: Declaration,
    *,
    generation_tool: str,
    host: str,
    source_files: Sequence[str] = (),
    fmi: int = 2,
    arrays: Sequence[ArrayVariable] = (),
) -> dict[str, bytes]:
    """Return the files that say what an FMU is, for co-simulation or with states for model exchange.

    The placeholder stands for what the content hash will give. There is no generation date: equal content
    gives equal bytes.

    Parameters
    ----------
    declared : Declaration
        The model.
    generation_tool : str
        Attribute of the root element.
    host : str
        What the FMU runs in, for its documentation.
    source_files : sequence of str
        C sources in the folder `sources`; an FMU with none needs Python to run.
    fmi : {2, 3}
        Version of FMI.
    arrays : sequence of ArrayVariable
        Which variables are elements of arrays, in FMI 3.

    Returns
    -------
    dict of str to bytes
        By name in the archive: the model description, and a page for people without any request.
    """
    inner = {row.reference for array in arrays for row in array.rows[1:]}
    rows = [row for row in declared.table if row.reference not in inner]
    local = [row for row in rows if row.causality == "local"]
    states, rates = local[: len(local) // 2], local[len(local) // 2 :]
    # FMI 2 counts variables from 1, and ours stand at their value references.
    state_of = {
        rate.reference: state.reference + (fmi == 2) for state, rate in zip(states, rates, strict=True)
    }
    place = {row.name: row.reference + 1 for row in rows}
    xml = rendered(
        "modelDescription.xml",
        declared=declared,
        fmi=fmi,
        tool=generation_tool,
        version=version("uav-twin"),
        token=PLACEHOLDER,
        sources=source_files,
        exchange=bool(local),
        categories=LOG_CATEGORIES,
        rows=rows,
        heads={array.rows[0].reference: array for array in arrays},
        state_of=state_of,
        dependencies={
            name: sorted(place[source] for source in sources)
            for name, sources in declared.dependencies.items()
        },
        rates=rates,
    )
    interface = "model-exchange" if local else "co-simulation"
    page = rendered("index.html", declared=declared, host=host, fmi=fmi, interface=interface)
    return {"modelDescription.xml": xml, "documentation/index.html": page}
