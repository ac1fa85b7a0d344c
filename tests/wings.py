"""The wing's reduced model in motion, and its static test, by the names of its digital state."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fe.runtime.reduced import ReducedModel
from fe.runtime.state import Losses
from fe.runtime.transient import ModalIntegrator
from fe.structure.affine import static_response
from fe.wing.operators import ROOT_UNKNOWNS, AffineOperators, AffineWing, upward, wing_values


def wing_integrator(
    model: ReducedModel, *, damping_alpha: float, damping_beta: float, **values: Any
) -> ModalIntegrator:
    """Return the integrator at values by name, the losses together as `stiffness_loss`."""
    return ModalIntegrator(model.structure_at(model.vector(**values)), damping_alpha, damping_beta)


def tip_stiffness(wing: AffineWing, young_modulus_factor: float = 1.0, loss: Losses = ()) -> float:
    """Stiffness [N/m] of the static test of the full wing: force near the tip over the displacement there."""
    values = wing_values(wing, young_modulus_factor, loss, load_factor=0.0, tip_force=1.0)
    found = static_response(wing, values)
    return 1.0 / float(wing.load_tip @ found.displacement)


def rigid(wing: AffineOperators, lever: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """Free unknowns of a heave, or of a flap where the lever is that of the nodes."""
    nodes = len(wing.wing_mesh.points)
    free = np.asarray(wing.expansion.T @ upward(np.ones(nodes) if lever is None else lever))
    if lever is None:
        free[-ROOT_UNKNOWNS:] = 1.0, 0.0, 0.0
    return free
