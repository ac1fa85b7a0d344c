"""The wing under a patch: stiffness, mass, loads and outputs with the changes of its primitives.

NumPy and relative imports only: this file is copied into the FMU. The arrays are those of
`fe.runtime.wing_rows`; the equations are in `docs/explanation/patches.md`.
"""

from collections.abc import Callable
from functools import cached_property
from math import isfinite
from typing import NamedTuple

import numpy as np

from .arrays import FloatArray
from .dense_matrices import lowest_modes
from .errors import InvalidPatchError
from .patch import (
    LOADS,
    ROOT_TURN,
    LoadGain,
    ModelPatch,
    ModulusTemperature,
    PlaceMass,
    PointMass,
    RegionStiffnessLoss,
    SupportCompliance,
)
from .port_laws import STATION_PORTS, port_laws
from .skin_losses import remaining_skin
from .state import Losses
from .wing_rows import NO_PATCH, STATIC_TEST_LOAD, WingRows

ITERATIONS = 3
"""Number of subspace iterations for the modes of a patched wing."""
NEGLIGIBLE_REMAINDER = 1e-7
"""A basis contains a static shape if the remainder outside the basis is below this fraction of the
shape."""
MODE_COUNT = 6
"""Number of modes with inertia."""
HOLDING_LOAD = 3
"""Index of the load that holds the wing before a release."""

Solver = Callable[[FloatArray], FloatArray]
"""K^-1 of loads (n,) or (n, k)."""


class PatchedModes(NamedTuple):
    """The M lowest undamped modes of a patched wing.

    Attributes
    ----------
    frequency : (M,) array
        Natural frequencies [Hz].
    shapes : (n, M) array
        Mass-normalised shapes; the tip moves up in each.
    projection : (M, n) array
        Matrix from displacements to modal coordinates.
    """

    frequency: FloatArray
    shapes: FloatArray
    projection: FloatArray


def solver_by_inverse(stiffness: FloatArray) -> Solver:
    """Return a solver that inverts a stiffness (n, n), as NumPy cannot solve Cholesky factors."""
    inverse = np.linalg.inv(stiffness)

    def solve(loads: FloatArray) -> FloatArray:
        return np.asarray(inverse @ loads)

    return solve


def motion_basis(
    solve_stiffness: Solver, mass: FloatArray, start: FloatArray, static_shapes: FloatArray
) -> FloatArray:
    """Return an orthonormal basis of the lowest modes, by subspace iteration, and static shapes.

    Columns are orthonormal in the Euclidean inner product, without the mass matrix.

    Parameters
    ----------
    solve_stiffness : callable
        Returns the displacements K^-1 f under loads f (n, k).
    mass : (n, n) array
        The mass matrix M [kg].
    start : (n, r) array
        Modes of a similar structure.
    static_shapes : (n, s) array
        Static shapes that the basis must contain as well.

    Returns
    -------
    (n, r + s) array
        Orthonormal columns; fewer if the span of the others already contains a static shape.
    """
    basis = start
    for _ in range(ITERATIONS):
        basis = np.linalg.qr(solve_stiffness(mass @ basis))[0]
    for shape in (static_shapes / np.linalg.norm(static_shapes, axis=0)).T:
        # Gram-Schmidt in two passes: the first leaves rounding errors in the basis' directions,
        # which matter if the remainder is small
        remainder = shape - basis @ (basis.T @ shape)
        remainder = remainder - basis @ (basis.T @ remainder)
        norm = float(np.linalg.norm(remainder))
        # the remainder of a shape that the basis contains is only rounding, and must not be added
        if norm > NEGLIGIBLE_REMAINDER:
            basis = np.concatenate((basis, remainder[:, np.newaxis] / norm), axis=1)
    return np.asarray(basis)


class PatchedWing(WingRows):
    """The wing in a basis in which patches can change it.

    Attributes
    ----------
    solver : callable
        Function that returns the `Solver` of a stiffness (n, n). Where SciPy is available, a
        Cholesky solution takes a tenth of the time of the inverse.
    """

    solver: Callable[[FloatArray], Solver] = staticmethod(solver_by_inverse)

    def mass(
        self, servo_mass: float, pitot_mass: float, patch: ModelPatch = NO_PATCH
    ) -> FloatArray:
        """Return the mass matrix (n, n) [kg] for given masses and a patch.

        Parameters
        ----------
        servo_mass, pitot_mass : float
            Mass of each servo and of the pitot tube [kg].
        patch : ModelPatch
            Its point masses are added.

        Raises
        ------
        InvalidPatchError
            If a point mass lies off the wing.
        """
        arrays = self.arrays
        mass = arrays.mass[0] + servo_mass * arrays.mass[1] + pitot_mass * arrays.mass[2]
        for primitive in patch:
            if isinstance(primitive, PlaceMass):
                raise InvalidPatchError(
                    f"The wing has no place {primitive.place!r} for a mass; give a station instead."
                )
            if isinstance(primitive, PointMass):
                rows = self._station_weights(primitive.station) @ arrays.line_rows[:3]
                for row in rows:
                    mass += primitive.mass * np.multiply.outer(row, row)
        return np.asarray(mass)

    def stiffness(
        self,
        young_modulus_factor: float,
        stiffness_loss: Losses,
        patch: ModelPatch = NO_PATCH,
        temperature_difference: float = 0.0,
    ) -> FloatArray:
        """Return the stiffness (n, n) in a state under a patch.

        Parameters
        ----------
        young_modulus_factor, stiffness_loss
            As in `fe.runtime.state.DigitalState`.
        patch : ModelPatch
            Its root compliances, losses and temperature coefficients change the stiffness.
        temperature_difference : float
            Temperature minus the reference temperature [K].

        Raises
        ------
        InvalidPatchError
            If a change leaves no stiffness, or is in a damage region that the wing does not have.
        """
        factor = young_modulus_factor
        for primitive in patch:
            if isinstance(primitive, ModulusTemperature):
                factor = factor * (1.0 - primitive.coefficient * temperature_difference)
        theta = np.array([factor, *self._remaining_in_regions(stiffness_loss, patch), 1.0])
        if not (isfinite(factor) and theta.min() > 0.0):
            raise InvalidPatchError(
                "The factors on the stiffness of skin and damage regions must be positive, but are "
                f"{', '.join(f'{value:g}' for value in theta[:-1])}; lessen the losses or the "
                "coefficient."
            )
        stiffness = np.tensordot(theta, self.arrays.stiffness, 1)
        self._add_root_compliance(stiffness, patch)
        self._add_local_losses(stiffness, patch, theta)
        return np.asarray(stiffness)

    def _remaining_in_regions(self, stiffness_loss: Losses, patch: ModelPatch) -> list[float]:
        """Return the fraction of its stiffness that each damage region keeps.

        It is the product of what each loss of the state and of the patch leaves. Raises
        `InvalidPatchError` if the patch names a region that the wing does not have.
        """
        regions = self.arrays.regions
        remaining_fractions = [1.0 - loss for loss in self.arrays.losses(stiffness_loss)]
        for primitive in patch:
            if not isinstance(primitive, RegionStiffnessLoss):
                continue
            if primitive.region not in regions:
                raise InvalidPatchError(
                    f"The patch takes stiffness from the damage region {primitive.region!r}, but "
                    f"the wing has {', '.join(regions)}."
                )
            remaining_fractions[regions.index(primitive.region)] *= 1.0 - primitive.loss
        return remaining_fractions

    def _add_root_compliance(self, stiffness: FloatArray, patch: ModelPatch) -> None:
        """Put the root compliances of a patch in series with the root spring, in place.

        Raises `InvalidPatchError` if no spring remains, or another support is to yield.
        """
        spring = self.arrays.flap_spring
        compliance = 0.0
        for primitive in patch:
            if not isinstance(primitive, SupportCompliance):
                continue
            if (primitive.support, primitive.motion) != ROOT_TURN:
                raise InvalidPatchError(
                    f"The wing has no support {primitive.support!r} with the motion "
                    f"{primitive.motion!r}; it has {' '.join(ROOT_TURN)}."
                )
            compliance += primitive.compliance
        if compliance == 0.0:
            return
        flexibility = 1.0 / spring + compliance
        if flexibility <= 0.0:
            raise InvalidPatchError(
                f"The root's compliance of {1.0 / spring:g} rad/(N m) cannot be reduced by "
                f"{-compliance:g}; give a compliance above {-1.0 / spring:g}."
            )
        change = 1.0 / flexibility - spring
        stiffness += change * np.multiply.outer(self.arrays.flap_row, self.arrays.flap_row)

    def _add_local_losses(
        self, stiffness: FloatArray, patch: ModelPatch, theta: FloatArray
    ) -> None:
        """Subtract a patch's local losses, averaged over strips, from a stiffness (n, n), in place.

        `theta` (K + 2,) are the coefficients of the stiffness terms: of the skin, of K damage
        regions, and of the rest.
        """
        arrays = self.arrays
        skin = remaining_skin(patch, arrays.strip_lines)
        if skin is None:
            return
        changes = (skin.by_strip[arrays.strip_of] - 1.0) * theta[arrays.term_of]
        changed_strips = np.flatnonzero(changes)
        lower = np.zeros_like(stiffness)
        lower[np.tril_indices(self.size)] = (
            changes[changed_strips] @ arrays.strip_stiffness[changed_strips]
        )
        stiffness += lower + np.tril(lower, -1).T

    def structure_at(
        self,
        vector: FloatArray,
        patch: ModelPatch = NO_PATCH,
        temperature_difference: float = 0.0,
    ) -> "PatchedStructure":
        """Return the wing under a patch, for `fe.runtime.transient.ModalIntegrator`.

        Parameters
        ----------
        vector : (V,) array
            Values of all inputs, in the order of `fe.runtime.state.wing_input_names`; those of the
            controls do not matter.
        temperature_difference : float
            Temperature minus the reference temperature [K].

        Raises
        ------
        InvalidPatchError
            If the patch cannot be applied to the wing.
        """
        factor, *losses, servo_mass, pitot_mass = vector[:-2].tolist()
        return PatchedStructure(
            wing=self,
            stiffness=self.stiffness(factor, tuple(losses), patch, temperature_difference),
            mass=self.mass(servo_mass, pitot_mass, patch),
            patch=patch,
        )


class PatchedStructure:
    """The wing in one state and under one patch, as a `StructureInMotion` in n coordinates.

    Its loads are the load factor, its square, the force at the load point as the patch moves it,
    and a force at the load point itself, which holds the wing before a release. Its outputs are the
    gauges and the tip.

    Parameters
    ----------
    stiffness, mass : (n, n) array
        The matrices of the wing in this state and under this patch.

    Attributes
    ----------
    stiffness, mass : (n, n) array
        The same matrices.
    laws : PortLaws
        The laws of the patch at the ports of the wing.
    """

    holding_load = HOLDING_LOAD
    mode_count = MODE_COUNT
    # The residual flexibility couples neighbours (a force moves the next station half as far
    # as its own station), which one flexibility for each port cannot represent.
    rigid_ports = frozenset(STATION_PORTS)

    def __init__(
        self, wing: PatchedWing, stiffness: FloatArray, mass: FloatArray, patch: ModelPatch
    ) -> None:
        arrays = wing.arrays
        self.stiffness = stiffness
        self.mass = mass
        self._solver = wing.solver
        self._start_shapes = arrays.start_shapes
        self._tip_row = arrays.tip_row
        self._static_shape_rows = wing.static_shape_rows
        self._load_gains = [primitive for primitive in patch if isinstance(primitive, LoadGain)]
        # loads, and laws at ports
        self.laws = port_laws(wing.internal_forces(patch), wing.port_rows)
        self.unit_loads = np.vstack(
            (
                wing.manoeuvre_loads(patch.of(*LOADS, PointMass)),
                wing.force_row(STATIC_TEST_LOAD, patch.of(*LOADS)),
                arrays.load_tip,
                self.laws.port_rows(wing.port_rows, wing.size),
            )
        ).T
        # outputs
        strains = arrays.strain_rows
        factors = wing.strain_factors(patch)
        if factors is not None:
            strains = factors[:, np.newaxis] * strains
        self.output_rows = np.vstack((strains[0], arrays.tip_row))
        self.strain_component_rows = strains[1:]
        self.acceleration_rows = np.zeros((0, wing.size))

    def load_coefficients(self, vector: FloatArray) -> FloatArray:
        """Return the coefficients (4,) of the loads for inputs (V,) of the wing."""
        load_factor, tip_force = vector[-2:].tolist()
        force = tip_force
        for load_gain in self._load_gains:
            tare = load_gain.tare if tip_force != 0.0 else 0.0
            force = (1.0 + load_gain.gain) * force + tare
        return np.array((load_factor, load_factor**2, force, 0.0))

    @cached_property
    def _solve(self) -> Solver:
        return self._solver(self.stiffness)

    def static(self, loads: FloatArray) -> FloatArray:
        """Return the displacements K^-1 f of loads (n,) or (n, k)."""
        return np.asarray(self._solve(loads))

    @cached_property
    def unit_responses(self) -> FloatArray:
        """Static displacements (n, 4 + J) under the unit loads."""
        return self.static(self.unit_loads)

    def lowest_modes(self, count: int, static_shape_rows: FloatArray | None = None) -> PatchedModes:
        """Return the lowest undamped modes, Kapteyn et al. 2021, eq. (16).

        Parameters
        ----------
        static_shape_rows : (s, n) array, optional
            Loads whose static shapes the basis of the modes contains as well.
        """
        if static_shape_rows is None:
            static_shapes = np.zeros((len(self.mass), 0))
        else:
            static_shapes = self.static(static_shape_rows.T)
        basis = motion_basis(self.static, self.mass, self._start_shapes, static_shapes)
        frequency, coordinates = lowest_modes(
            basis.T @ self.stiffness @ basis, basis.T @ self.mass @ basis, count
        )
        shapes = basis @ coordinates
        shapes = shapes * np.where(self._tip_row @ shapes < 0.0, -1.0, 1.0)
        return PatchedModes(frequency, shapes, projection=shapes.T @ self.mass)

    @cached_property
    def modes(self) -> PatchedModes:
        """The modes of the motion."""
        return self.lowest_modes(MODE_COUNT, self._static_shape_rows)

    @property
    def mode_shapes(self) -> FloatArray:
        """Shapes (n, M) of the modes."""
        return self.modes.shapes

    @property
    def modal_projection(self) -> FloatArray:
        """Matrix (M, n) from displacements to modal coordinates."""
        return self.modes.projection
