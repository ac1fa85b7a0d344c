"""The variables of a structure as C: value references, ranges and start values, from the one table."""

import math
from collections.abc import Iterable, Mapping, Sequence

from fmu_asset.description import LOG_CATEGORIES, PLACEHOLDER, ArrayVariable
from fmu_asset.slaves.table import Roles
from fmu_asset.slaves.variables import ENUMERATIONS, FmuVariable

_NOTE = "/* Made by the build of the FMU from its table of variables; a change here is lost. */\n"

_PLACES = {
    "DAMPING_ALPHA": "damping.alpha",
    "DAMPING_BETA": "damping.beta",
    "RESPONSE": "response",
    "STRAIN_BOUND": "strain_error_bound",
    "FIRST_FREQUENCY": "frequency[1]",
    "STATUS": "status",
}
_DECLARATIONS = """#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

typedef struct {
    const char *name;
    size_t length; /* of an array its values, zero for its further elements; else 1 */
    const char *unit; /* for messages; empty where there is none */
    bool enumeration;
    double minimum;
    double maximum;
    double start;
} structure_variable;

extern const structure_variable structure_variables[STRUCTURE_VARIABLE_COUNT];
extern const char *const structure_log_categories[STRUCTURE_LOG_CATEGORIES];

/* Value references of all that can be chosen, in the order of the model. */
extern const unsigned int structure_chosen_places[STRUCTURE_CHOSEN_COUNT];

/* Value references of what some structures have; STRUCTURE_VARIABLE_COUNT where there is none. */
extern const unsigned int structure_displacement_bound_place;
extern const unsigned int structure_release_place;
extern const unsigned int structure_load_point_place;
extern const unsigned int structure_time_place;

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
"""


def variable_sources(
    table: Sequence[FmuVariable], roles: Roles, arrays: Sequence[ArrayVariable] = ()
) -> dict[str, bytes]:
    """Return the C sources that say what the variables are; placeholders stand for GUID and content tag.

    Parameters
    ----------
    table : sequence of FmuVariable
        The variables, in order of their value reference.
    roles : Roles
        Which of them is what.
    arrays : sequence of ArrayVariable
        Which rows of the table pass together, in FMI 3.

    Returns
    -------
    dict of str to bytes
        File name to content: `structure_variables.h` and `structure_variables.c`.
    """
    place = {row.name: row.reference for row in table}
    return {
        "structure_variables.h": _header(table, roles, place).encode(),
        "structure_variables.c": _source(table, roles, place, arrays).encode(),
    }


def _header(table: Sequence[FmuVariable], roles: Roles, place: Mapping[str, int]) -> str:
    """Return `structure_variables.h`: every constant, and the type of a row of the table."""
    outputs = [row for row in table if row.causality == "output"]
    counts = {
        "VARIABLE_COUNT": len(table),
        "INPUT_COUNT": sum(row.causality == "input" for row in table),
        "FIRST_OUTPUT": outputs[0].reference,
        "OUTPUT_COUNT": roles.outputs,
        "OUTPUT_MODES": sum(row.name.startswith("frequency[") for row in outputs),
        "CHOSEN_COUNT": len(roles.chosen),
        "POINT_LOAD": roles.point_load,
        "LOG_CATEGORIES": len(LOG_CATEGORIES),
        # Of model exchange: states, and then as many rates.
        "FIRST_STATE": min((row.reference for row in table if row.causality == "local"), default=len(table)),
        "STATE_COUNT": sum(row.causality == "local" for row in table) // 2,
    }
    defines = _defines(counts.items())
    references = _defines((name, place[variable]) for name, variable in _PLACES.items())
    values = "".join(
        _defines((f"{e.name}_{name}".upper(), value) for name, value, _ in e.items) for e in ENUMERATIONS
    )
    categories = _defines(
        (f"LOG_{name.removeprefix('log').removeprefix('Status').upper()}", index)
        for index, name in enumerate(LOG_CATEGORIES)
    )
    return f"""{_NOTE}#ifndef STRUCTURE_VARIABLES_H
#define STRUCTURE_VARIABLES_H

#include <stdbool.h>
#include <stddef.h>

#define STRUCTURE_GUID "{PLACEHOLDER}"
#define STRUCTURE_CONTENT_TAG "{PLACEHOLDER}"

{defines}
/* Value references of what every structure has; they are also the indices of the table. */
{references}
/* Values of the enumerations. */
{values}
/* Log categories. */
{categories}
{_DECLARATIONS}"""


def _source(
    table: Sequence[FmuVariable], roles: Roles, place: Mapping[str, int], arrays: Sequence[ArrayVariable]
) -> str:
    """Return `structure_variables.c`: the table, and which of it is what."""
    chosen = "".join(f"    {place[name]},\n" for name in roles.chosen)
    others = "".join(
        f"const unsigned int structure_{what}_place = {len(table) if name is None else place[name]};\n"
        for what, name in (
            ("displacement_bound", roles.displacement_bound),
            ("release", roles.release),
            ("load_point", roles.load_point),
            ("time", "time" if "time" in place else None),
        )
    )
    named = {row.reference: (row.name, 1) for row in table}
    for array in arrays:
        for index, row in enumerate(array.rows):
            named[row.reference] = (f"{array.name}[{index + 1}]", len(array.rows) if index == 0 else 0)
    rows = "".join(f"    {{{_row(row, *named[row.reference])}}},\n" for row in table)
    names = "".join(f'    "{name}",\n' for name in LOG_CATEGORIES)
    return f"""{_NOTE}#include "structure_variables.h"

#include <math.h>

const structure_variable structure_variables[STRUCTURE_VARIABLE_COUNT] = {{
{rows}}};

const char *const structure_log_categories[STRUCTURE_LOG_CATEGORIES] = {{
{names}}};

const unsigned int structure_chosen_places[STRUCTURE_CHOSEN_COUNT] = {{
{chosen}}};

{others}"""


def _row(row: FmuVariable, name: str, length: int) -> str:
    unit = "" if row.unit in (None, "1") else row.unit
    numbers = (
        -math.inf if row.minimum is None else row.minimum,
        math.inf if row.maximum is None else row.maximum,
        row.start or 0.0,
    )
    enumeration = "true" if row.enumeration is not None else "false"
    return ", ".join((_text(name), str(length), _text(unit or ""), enumeration, *map(_number, numbers)))


def _text(text: str) -> str:
    """Return a text as a C string; units are anything that a user writes, and messages go through printf."""
    plain = (
        chr(byte) if 32 <= byte < 127 and chr(byte) not in '"\\?' else f"\\{byte:03o}"
        for byte in text.encode()
    )
    return f'"{"".join(plain)}"'


def _number(value: float) -> str:
    """Return a float as a C constant that has the same bits."""
    if math.isinf(value):
        return "HUGE_VAL" if value > 0.0 else "-HUGE_VAL"
    return repr(float(value))


def _defines(items: Iterable[tuple[str, int]]) -> str:
    return "".join(f"#define STRUCTURE_{name} {value}\n" for name, value in items)
