"""Offline: a wing as a structure with names, and its reduced model."""

import numpy as np
from scipy import sparse

from fe.full.affine import AffineSystem
from fe.runtime.state import TIP_FORCE, WING, DigitalState
from fe.structure.affine import AffineStructure, LoadTerm, StiffnessTerm
from reporting.progress import Progress

from .reduced_basis import Reduction, reduce_structure
from .settings import ReductionSettings


def wing_structure(system: AffineSystem, settings: ReductionSettings) -> AffineStructure:
    """Return a wing as a structure with names: lift and tip force, gauges and the displacement of the tip."""
    state, (servo, pitot) = DigitalState(), settings.nominal_masses
    pairs = (("young_modulus_factor", None), *((None, name) for name in system.regions), (None, None))
    gauges = system.gauge_output.shape[0]
    return AffineStructure(
        parameters={"young_modulus_factor": 1.0},
        masses={"servo_mass": servo, "pitot_mass": pitot},
        controls={"load_factor": 1.0, "tip_force": 0.0},
        control_units={"load_factor": "1", "tip_force": "N"},
        ranges=settings.named_ranges(system.regions),
        regions=system.regions,
        stiffness_terms=tuple(
            StiffnessTerm(term, *pair) for term, pair in zip(system.stiffness_terms, pairs, strict=True)
        ),
        mass_terms=system.mass_terms,
        loads={"lift": "load_factor", "tip": "tip_force"},
        load_terms=(LoadTerm("lift", system.load_lift), LoadTerm("tip", system.load_tip)),
        gauges=tuple(f"gauge_{number}" for number in range(1, gauges + 1)),
        displacements=("tip",),
        accelerations=(),
        gauge_output=system.gauge_output,
        displacement_output=sparse.csr_array(system.tip_displacement_output[np.newaxis]),
        acceleration_output=sparse.csr_array((0, system.unknowns)),
        expansion=system.expansion,
        damping_alpha=state.damping_alpha,
        damping_beta=state.damping_beta,
        design_hash=system.design_hash,
    )


def reduce_model(
    system: AffineSystem, settings: ReductionSettings | None = None, progress: Progress | None = None
) -> Reduction:
    """Make the reduced model of a wing, its flapwise bendings followed; see `reduce_structure`."""
    settings = settings or ReductionSettings()
    return reduce_structure(wing_structure(system, settings), WING, settings, progress, TIP_FORCE)
