"""The patched wing beside its full model, which is changed in its own way."""

from typing import Any

import numpy as np
import pytest

from fe.full.factorisation import Factorisation
from fe.runtime.arrays import FloatArray
from fe.runtime.patch import ModelPatch, Primitive
from fe.runtime.patched_wing import PatchedWing
from fe.runtime.state import STANDARD_GRAVITY
from fe.wing.operators import AffineOperators, point_masses
from tests.wings import rigid

MODULUS_FACTOR = 1.0073
LOSSES = (0.2, 0.1)
STATE = (MODULUS_FACTOR, LOSSES)
"""The digital state of the wing: factor of Young's modulus, stiffness losses of both regions."""
SOUND = (1.0, (0.0, 0.0))
"""The state of a wing without damage."""
MASSES = (0.1688, 0.1344)
"""Servo and pitot mass [kg]."""

STRAIN_ACCURACY = 1e-3
"""Accuracy wanted of strains, relative to the largest one."""
DISPLACEMENT_ACCURACY = 1e-3
"""Accuracy wanted of the displacement at the tip, relative."""
FREQUENCY_ACCURACY = 1e-4
"""Accuracy wanted of the first frequencies, relative."""


class WingComparison:
    """The patched wing, and its full model to compare with."""

    def __init__(self, wing: PatchedWing, operators: AffineOperators) -> None:
        self.wing = wing
        self.arrays = wing.arrays
        self.operators = operators
        self.mesh = operators.wing_mesh
        self.design = operators.wing_mesh.design
        self.load_place = wing.arrays.load_place
        self.tip_load = wing.force_row("tip_load")
        self.stiffness = operators.stiffness({"young_modulus_factor": MODULUS_FACTOR}, LOSSES)
        self.factors = Factorisation(self.stiffness)
        masses = self.design.masses
        mass = operators.mass(point_masses(masses.servo, masses.pitot))
        self.upwards = rigid(operators)
        self.weight = STANDARD_GRAVITY * (mass @ self.upwards)  # along the free unknowns [N]

    def patched_structure(
        self,
        *primitives: Primitive,
        state: Any = STATE,
        masses: tuple[float, float] = MASSES,
        temperature: float = 0.0,
    ) -> Any:
        """Return the patched wing in a state, with point masses [kg] and at a temperature [K]."""
        modulus_factor, losses = state
        vector = np.array((modulus_factor, *losses, *masses, 0.0, 0.0))
        return self.wing.structure_at(vector, ModelPatch(primitives), temperature)

    def manoeuvre_load(self, load_factor: float, *primitives: Primitive) -> FloatArray:
        """Return the reduced load of a manoeuvre."""
        powers = np.array((load_factor, load_factor**2))
        return powers @ self.wing.manoeuvre_loads(ModelPatch(primitives))

    def assert_same_response(
        self, reduced: FloatArray, full: FloatArray, operators: AffineOperators
    ) -> None:
        """Compare strains and the displacement at the tip of a reduced and a full solution."""
        full_strain = operators.gauge_output @ full
        full_tip = float(operators.tip_row @ full)
        strain_error = np.abs(self.strain_rows @ reduced - full_strain).max()
        assert strain_error <= STRAIN_ACCURACY * np.abs(full_strain).max()
        assert self.tip_displacement(reduced) == pytest.approx(full_tip, rel=DISPLACEMENT_ACCURACY)

    @property
    def strain_rows(self) -> FloatArray:
        """Rows of the strains along the gauges."""
        along, _, _ = self.arrays.strain_rows
        return np.asarray(along)

    def tip_displacement(self, reduced: FloatArray) -> float:
        """Return the displacement at the tip of a reduced solution."""
        return float(self.arrays.tip_row @ reduced)

    def softened_stiffness(
        self, operators: AffineOperators, start: float, end: float, loss: float
    ) -> Any:
        """Return the full stiffness with a loss in the skin between two lines.

        The wing is in `STATE` if the operators are those of this comparison, else it is sound.
        """
        mesh = operators.wing_mesh
        _, centre_y, _ = mesh.centres.T
        is_inside = (centre_y > start) & (centre_y < end)
        if operators is self.operators:
            factors = {"young_modulus_factor": MODULUS_FACTOR}
            losses = LOSSES
        else:
            factors = None
            losses = ()
        stiffness = operators.stiffness(factors, losses)
        for region, factor in enumerate(operators.theta(factors, losses)[:3]):  # those of the skin
            cells = np.flatnonzero((mesh.stiffness_term == region) & is_inside)
            if cells.size:
                stiffness = stiffness - loss * factor * operators.body.stiffness(cells)
        return stiffness.tocsr()
