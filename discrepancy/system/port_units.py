"""Units of force and motion at the ports of a lumped model."""

from collections.abc import Iterator

import numpy as np

from discrepancy.campaign.records import FloatArray, Quantity
from discrepancy.campaign.units import UNITS
from discrepancy.system.lumped_file import LumpedDescription
from discrepancy.system.lumped_sections import InputSection, OutputSection
from discrepancy.system.response import EITHER, MOVES, TURNS


def units_at_port(description: LumpedDescription, row: FloatArray) -> tuple[str, str]:
    """Return the units of the force and of the motion at a port, `EITHER` if they are not known.

    A port with the row of an output, or of a prescribed input, has the unit of that. Another port
    that is a sum or difference of unknowns has their unit, if all have the same. An unknown has the
    unit of an output or an input that measures or prescribes it alone.

    Parameters
    ----------
    description : LumpedDescription
        The file of the model.
    row : (n,) array
        The motion of the port is row . unknowns.
    """
    if not np.any(row[: description.displacement_count]):
        return _units_of_state_port(description)
    units_of_same_motion = {
        units
        for vector, units in _measured_motions(description)
        if np.array_equal(vector, row) or np.array_equal(np.negative(vector), row)
    }
    if len(units_of_same_motion) == 1:
        return units_of_same_motion.pop()
    if not np.all(np.isin(row, (-1.0, 0.0, 1.0))):
        return EITHER
    units_by_unknown = _units_by_unknown(description)
    units_of_unknowns: set[tuple[str, str]] = set()
    for unknown_index in np.flatnonzero(row).tolist():
        units_of_unknowns |= units_by_unknown.get(unknown_index, {MOVES, TURNS})
    return units_of_unknowns.pop() if len(units_of_unknowns) == 1 else EITHER


def _units_of_state_port(description: LumpedDescription) -> tuple[str, str]:
    """Return the units of a flow at a port of a state, and of the state.

    The state has the unit of the outputs of states, if these measure a single quantity.
    """
    first_state = description.displacement_count
    quantities = {
        output.quantity
        for output in description.output
        if output.vector and any(output.vector[first_state:])
    }
    unit = UNITS[quantities.pop()].si if len(quantities) == 1 else "of the state's unit"
    return f"{unit}/s times capacity", unit


def _units_by_unknown(description: LumpedDescription) -> dict[int, set[tuple[str, str]]]:
    """Return the units of force and motion of unknowns that are measured or prescribed alone.

    More than one pair of units for an unknown means that the file contradicts itself.
    """
    units: dict[int, set[tuple[str, str]]] = {}
    for vector, units_of_vector in _measured_motions(description):
        if np.count_nonzero(vector) == 1 and max(vector) == 1.0:
            units.setdefault(vector.index(1.0), set()).add(units_of_vector)
    return units


def _measured_motions(
    description: LumpedDescription,
) -> Iterator[tuple[tuple[float, ...], tuple[str, str]]]:
    """Yield the vector (n,) of each motion that an output measures or an input prescribes.

    With it come the units of force and motion in its direction.
    """
    sections: list[InputSection | OutputSection] = [*description.output]
    sections += description.input
    for section in sections:
        quantities_of_motion = section.quantity.motion_chain
        if section.vector and quantities_of_motion:
            units = TURNS if Quantity.ANGLE in quantities_of_motion else MOVES
            yield tuple(section.vector), units
