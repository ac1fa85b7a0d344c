"""The wing's reduced model in motion, by the names of its digital state."""

from typing import Any

from fe.runtime.reduced import ReducedModel
from fe.runtime.transient import ModalIntegrator


def wing_integrator(
    model: ReducedModel, *, damping_alpha: float, damping_beta: float, **values: Any
) -> ModalIntegrator:
    """Return the integrator at values by name, the losses together as `stiffness_loss`."""
    return ModalIntegrator(model, model.vector(**values), damping_alpha, damping_beta)
