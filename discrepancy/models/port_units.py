"""Units of what acts at ports: forces, moments, and flows of states."""

import numpy as np

from discrepancy.campaign.records import Quantity
from discrepancy.campaign.units import UNITS
from discrepancy.models.interface import Model
from discrepancy.models.lumped import LumpedModel
from discrepancy.models.wing import WingModel
from discrepancy.models.wrapped import innermost

ROTATING_PORT = "root"
"""Port of the wing that turns; its others move up and down."""


def port_unit(port: str, model: Model) -> str:
    """Return the unit of a force: "N", "N m", both where the model does not say it, or that of a flow."""
    if state := unit_of_state(port, model):
        return f"{state}/s times capacity"
    return {True: "N m", False: "N", None: "N or N m"}[turns(port, model)]


def unit_of_state(port: str, model: Model) -> str:
    """Return the unit of what a law at a port of states acts on; empty for a port that moves or turns."""
    model = innermost(model)
    if not isinstance(model, LumpedModel):
        return ""
    first = model.description.size
    if not any(any(item.vector[first:]) for item in model.description.port if item.name == port):
        return ""
    shown = {item.quantity for item in model.description.output if item.vector and any(item.vector[first:])}
    return UNITS[shown.pop()].si if len(shown) == 1 else "of the state's unit"


def turns(port: str, model: Model) -> bool | None:
    """Return whether a port turns; None where the model does not say it.

    A port of a lumped model moves or turns as the unknowns do of which it is a sum or difference, and these
    as what is measured or prescribed of them.
    """
    model = innermost(model)
    if isinstance(model, WingModel):
        return port == ROTATING_PORT
    if not isinstance(model, LumpedModel):
        return None
    vectors = [np.array(item.vector) for item in model.description.port if item.name == port]
    if not vectors or not np.all(np.isin(vectors[0], (-1.0, 0.0, 1.0))):
        return None
    known = [(item.vector, item.quantity) for item in model.description.output]
    known += [(item.vector, item.quantity) for item in model.description.input]
    told: dict[int, set[bool]] = {}
    for row, quantity in known:
        if row is not None and quantity.moving and np.count_nonzero(row) == 1 and max(row) == 1.0:
            told.setdefault(int(np.argmax(row)), set()).add(Quantity.ANGLE in quantity.moving)
    kinds = set().union(*(told.get(int(at), {True, False}) for at in np.flatnonzero(vectors[0])))
    return kinds.pop() if len(kinds) == 1 else None
