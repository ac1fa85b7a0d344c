"""The variables of the wing as C: value references, ranges and start values, from the one table."""

import math
import re
from collections.abc import Iterable, Sequence

from fmu_asset.description import LOG_CATEGORIES
from fmu_asset.slaves.variables import ENUMERATIONS, FmuVariable

_NOTE = "/* Made by the build of the FMU from its table of variables; a change here is lost. */\n"


def variable_sources(table: Sequence[FmuVariable], *, guid: str, content_tag: str) -> dict[str, str]:
    """Return the C sources that say what the variables are.

    Parameters
    ----------
    table : sequence of FmuVariable
        The variables, in order of their value reference.
    guid : str
        The GUID that `fmi2Instantiate` asks for.
    content_tag : str
        What marks a saved state as one of this FMU, at most 16 letters.

    Returns
    -------
    dict of str to str
        File name to content: `wing_variables.h` and `wing_variables.c`.
    """
    return {
        "wing_variables.h": _header(table, guid, content_tag),
        "wing_variables.c": _source(table),
    }


def _header(table: Sequence[FmuVariable], guid: str, content_tag: str) -> str:
    """Return `wing_variables.h`: every constant, and the type of a row of the table."""
    outputs = [row for row in table if row.causality == "output"]
    counts = {
        "VARIABLE_COUNT": len(table),
        "INPUT_COUNT": sum(row.causality == "input" for row in table),
        "FIRST_OUTPUT": outputs[0].reference,
        "GAUGE_COUNT": sum(row.name.startswith("strain[") for row in outputs),
        "OUTPUT_MODES": sum(row.name.startswith("frequency[") for row in outputs),
        "LOG_CATEGORIES": len(LOG_CATEGORIES),
    }
    defines = _defines(counts.items())
    references = _defines((_identifier(row.name), row.reference) for row in table)
    values = "".join(
        _defines((f"{_identifier(e.name)}_{_identifier(name)}", value) for name, value, _ in e.items)
        for e in ENUMERATIONS
    )
    categories = _defines(
        (f"LOG_{name.removeprefix('log').removeprefix('Status').upper()}", index)
        for index, name in enumerate(LOG_CATEGORIES)
    )
    return f"""{_NOTE}#ifndef WING_VARIABLES_H
#define WING_VARIABLES_H

#include <stdbool.h>

#define WING_GUID "{guid}"
#define WING_CONTENT_TAG "{content_tag}"

{defines}
/* Value references, which are also the indices of the table. */
{references}
/* Values of the enumerations. */
{values}
/* Log categories. */
{categories}
#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

typedef struct {{
    const char *name;
    const char *unit; /* for messages; empty where there is none */
    bool enumeration;
    double minimum;
    double maximum;
    double start;
}} wing_variable;

extern const wing_variable wing_variables[WING_VARIABLE_COUNT];
extern const char *const wing_log_categories[WING_LOG_CATEGORIES];

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
"""


def _source(table: Sequence[FmuVariable]) -> str:
    """Return `wing_variables.c`: the table."""
    rows = "".join(f"    {{{_row(row)}}},\n" for row in table)
    names = "".join(f'    "{name}",\n' for name in LOG_CATEGORIES)
    return f"""{_NOTE}#include "wing_variables.h"

#include <math.h>

const wing_variable wing_variables[WING_VARIABLE_COUNT] = {{
{rows}}};

const char *const wing_log_categories[WING_LOG_CATEGORIES] = {{
{names}}};
"""


def _row(row: FmuVariable) -> str:
    unit = "" if row.unit in (None, "1") else row.unit
    numbers = (
        -math.inf if row.minimum is None else row.minimum,
        math.inf if row.maximum is None else row.maximum,
        row.start or 0.0,
    )
    enumeration = "true" if row.enumeration is not None else "false"
    return ", ".join((f'"{row.name}"', f'"{unit}"', enumeration, *map(_number, numbers)))


def _number(value: float) -> str:
    """Return a float as a C constant that has the same bits."""
    if math.isinf(value):
        return "HUGE_VAL" if value > 0.0 else "-HUGE_VAL"
    return repr(float(value))


def _identifier(name: str) -> str:
    return re.sub(r"\W+", "_", name).strip("_").upper()


def _defines(items: Iterable[tuple[str, int]]) -> str:
    return "".join(f"#define WING_{name} {value}\n" for name, value in items)
