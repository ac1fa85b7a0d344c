"""The table of variables of a compiled FMU for model exchange: health is discrete, and there are states."""

from collections.abc import Sequence
from dataclasses import replace

from fmu_asset.slaves.variables import TRANSIENT, FmuVariable

STATES = ("modal_displacement", "modal_velocity")


def exchange_table(
    table: Sequence[FmuVariable], mode_count: int, *, arrays: bool = False
) -> tuple[FmuVariable, ...]:
    """Return the table for model exchange.

    Parameters
    ----------
    table : sequence of FmuVariable
        That of co-simulation.
    mode_count : int
        Number M of modes.
    arrays : bool
        Whether the rows are to become arrays, whose derivative is an array too.

    Returns
    -------
    tuple of FmuVariable
        The same with discrete health and the transient response, then 2 M states (coordinates of the modes
        and their rates, mass-normalised) and as many derivatives of them.
    """
    rows = []
    for row in table:
        if row.causality == "input" and row.name.startswith("health."):
            row = replace(row, variability="discrete")
        elif row.name == "response":
            row = replace(row, start=float(TRANSIENT))
        rows.append(row)
    states = [f"{name}[{mode}]" for name in STATES for mode in range(1, mode_count + 1)]
    rates = [f"der({name})[{mode}]" for name in STATES for mode in range(1, mode_count + 1)]
    for name in (*states, *(rates if arrays else (f"der({state})" for state in states))):
        what = "Coordinate" if "displacement" in name else "Rate of the coordinate"
        text = f"{what} of mode {name.partition('[')[2].partition(']')[0]}, mass-normalised"
        rows.append(
            FmuVariable(
                name=name,
                reference=len(rows),
                kind="Real",
                causality="local",
                variability="continuous",
                description=f"Derivative of: {text}" if name.startswith("der(") else text,
            )
        )
    return tuple(rows)
