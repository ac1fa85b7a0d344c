"""The box and the sandwich plate side by side: two idealisations of one design, nothing fitted to either."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .design import WingDesign
from .modes import cantilever_bending, cantilever_bending_shapes, lowest_eigenpairs, track
from .operators import AffineOperators, assemble
from .plate import FIELDS, B, W
from .sandwich_plate import PlateOperators, assemble_plate
from .statics import Factorisation

FloatArray = NDArray[np.float64]

DAMAGE = 0.8
"""Stiffness loss of either defect at which its effect is compared."""
MODES = 6
"""Number of modes compared."""


class WingModel(Protocol):
    """What both models of a wing have."""

    @property
    def unknowns(self) -> int:
        """Number n of free unknowns."""

    @property
    def stiffness_terms(self) -> tuple[Any, ...]:
        """Four matrices, csr (n, n) [N/m]; e scales the first."""

    @property
    def load_lift(self) -> FloatArray:
        """Load (n,) of load factor 1 [N]."""

    @property
    def load_tip(self) -> FloatArray:
        """Load (n,) of 1 N at the place of the static test, and the displacement there [1]."""

    @property
    def gauge_output(self) -> Any:
        """Strains of the gauges, csr (gauges, n) [1/m]."""

    def stiffness(
        self, young_modulus_factor: float = 1.0, stiffness_loss: tuple[float, float] = (0.0, 0.0)
    ) -> Any:
        """Stiffness, csr (n, n) [N/m]."""

    def mass(self, servo_mass: float, pitot_mass: float) -> Any:
        """Mass, csr (n, n) [kg]."""


@dataclass(frozen=True)
class WingResults:
    """What a model says about a wing.

    Attributes
    ----------
    unknowns : int
        Free unknowns of the model.
    tip_stiffness : float
        Of the static test at e = 1 [N/m].
    tip_stiffness_slope : float
        d ln k / d ln e at e = 1.
    frequency : (6,) Hz
        Lowest frequencies at the nominal masses.
    first_bending, second_bending : float
        Those of the flapwise bending modes [Hz].
    strain : (gauges,) dimensionless
        At the load factor of the design's lift.
    strain_slope : (gauges,)
        d ln strain / d ln e at e = 1.
    damage_ratio : (2, gauges)
        Strain with a loss of `DAMAGE` in either defect, over the healthy strain.
    """

    unknowns: int
    tip_stiffness: float
    tip_stiffness_slope: float
    frequency: FloatArray
    first_bending: float
    second_bending: float
    strain: FloatArray
    strain_slope: FloatArray
    damage_ratio: FloatArray


@dataclass(frozen=True)
class PlateAgreement:
    """Box and plate of one design on the same mesh lines; differences are plate against box.

    Attributes
    ----------
    box, plate : WingResults
        What either says.
    """

    box: WingResults
    plate: WingResults

    def relative(self, name: str) -> float:
        """Plate over box, less one, of a single figure of `WingResults`."""
        return float(getattr(self.plate, name) / getattr(self.box, name) - 1.0)

    @property
    def tip_stiffness_slope(self) -> float:
        """Difference of d ln k / d ln e."""
        return self.plate.tip_stiffness_slope - self.box.tip_stiffness_slope

    @property
    def strain(self) -> FloatArray:
        """Relative differences (gauges,) of the healthy strains."""
        return np.asarray(self.plate.strain / self.box.strain - 1.0)

    @property
    def strain_slope(self) -> FloatArray:
        """Differences (gauges,) of d ln strain / d ln e."""
        return np.asarray(self.plate.strain_slope - self.box.strain_slope)

    @property
    def damage_ratio(self) -> FloatArray:
        """Differences (2, gauges) of the strain ratios under damage."""
        return np.asarray(self.plate.damage_ratio - self.box.damage_ratio)


def compare_with_plate(
    design: WingDesign, box: AffineOperators | None = None, *, straight_section: bool = False
) -> PlateAgreement:
    """Evaluate both models of a design.

    The box's section is straight between its mesh lines, which makes it a little thinner than the design's.
    With the same section in the plate, what is left is the idealisation alone.

    Parameters
    ----------
    design : WingDesign
        The wing.
    box : AffineOperators, optional
        Its box, where that is at hand.

    Raises
    ------
    MeshError
        If the mesh cannot hold what the design asks for.
    SolutionError
        If a solution is not accurate.
    """
    solid = assemble(design) if box is None else box
    plate = assemble_plate(design, straight_section=straight_section)
    return PlateAgreement(
        wing_results(solid, design, cantilever_bending_shapes(solid)),
        wing_results(plate, design, plate_bending_shapes(plate)),
    )


def wing_results(model: WingModel, design: WingDesign, bending_shapes: FloatArray) -> WingResults:
    """Evaluate a model.

    Parameters
    ----------
    model : WingModel
        Box or plate.
    design : WingDesign
        The wing, for its load factor and masses.
    bending_shapes : (n, 2)
        First and second bending shape of a uniform cantilever, by which the modes are told apart.
    """
    loads = np.column_stack((model.load_tip, design.lift.load_factor * model.load_lift))

    def strain(found: FloatArray) -> FloatArray:
        return np.asarray(model.gauge_output @ found[:, 1])

    def damaged(loss: tuple[float, float]) -> FloatArray:
        return strain(Factorisation(model.stiffness(1.0, loss)).solve(loads))

    factors = Factorisation(model.stiffness())
    found = factors.solve(loads)
    # K = e K_skin + ...: the derivative of the solution with respect to e, at e = 1
    slope = -factors.solve(model.stiffness_terms[0] @ found)
    tip, healthy = float(model.load_tip @ found[:, 0]), strain(found)
    mass = model.mass(design.masses.servo, design.masses.pitot)
    values, shapes = lowest_eigenpairs(model.stiffness(), mass, MODES)
    frequency = np.sqrt(values) / (2.0 * np.pi)
    first, second = frequency[track(bending_shapes, shapes, mass)]
    return WingResults(
        unknowns=model.unknowns,
        tip_stiffness=1.0 / tip,
        tip_stiffness_slope=-float(model.load_tip @ slope[:, 0]) / tip,
        frequency=frequency,
        first_bending=float(first),
        second_bending=float(second),
        strain=healthy,
        strain_slope=strain(slope) / healthy,
        damage_ratio=np.stack([damaged(loss) / healthy for loss in ((DAMAGE, 0.0), (0.0, DAMAGE))]),
    )


def plate_bending_shapes(operators: PlateOperators, count: int = 2) -> FloatArray:
    """Flapwise bending shapes (n, count) of a uniform cantilever on the plate: w(y) and b = -w'(y)."""
    points, span = operators.plate.node_points, operators.design.planform.semi_span
    shapes = []
    for deflection, slope in cantilever_bending(points[:, 1], span, count):
        fields = np.zeros((len(FIELDS), len(points)))
        fields[W], fields[B] = deflection, -slope
        shapes.append(operators.free_unknowns(fields))
    return np.stack(shapes, axis=1)
