"""The wing with changes, online: what the primitives of `patch` do to structure, loads and outputs.

NumPy and relative imports only: this file is copied into the FMU. The arrays are those of
`fe.runtime.wing_rows`; the equations are in `docs/patches.md`.
"""

from collections.abc import Callable
from functools import cached_property, partial
from math import isfinite
from typing import NamedTuple

import numpy as np

from .arrays import FloatArray
from .errors import InvalidPatchError
from .motion import STATION_PORTS, laws_of
from .patch import LOADS, LoadGain, ModelPatch, ModulusTemperature, PointMass, RootCompliance
from .reduced import lowest_modes
from .state import Losses
from .wing_rows import EMPTY, LOAD_PLACE, WingRows, remaining_skin

ITERATIONS = 3
"""Steps of the subspace iteration for the modes of a patched wing."""
HELD = 1e-7
"""Part of a static shape, relative to it, below which a basis of motion holds it already."""


Factorised = Callable[[FloatArray], Callable[[FloatArray], FloatArray]]


class Modes(NamedTuple):
    """Modes that move: frequencies (M,) [Hz], shapes (n, M), displacements to modal coordinates (M, n)."""

    frequency: FloatArray
    shapes: FloatArray
    to_modes: FloatArray


def motion_basis(
    static: Callable[[FloatArray], FloatArray], mass: FloatArray, start: FloatArray, solutions: FloatArray
) -> FloatArray:
    """Return a basis of the first modes of a structure, by subspace iteration.

    Parameters
    ----------
    static : callable
        K^-1 of loads (n, k).
    mass : (n, n) ndarray
        M.
    start : (n, r) ndarray
        Modes of a structure near by.
    solutions : (n, s) ndarray
        Static shapes that the basis is to hold as well.

    Returns
    -------
    (n, r + s) ndarray
        Orthonormal; fewer where the modes or other shapes hold a static shape already.
    """
    basis = start
    for _ in range(ITERATIONS):
        basis = np.linalg.qr(static(mass @ basis))[0]
    for shape in (solutions / np.linalg.norm(solutions, axis=0)).T:
        # a static shape is held already but for a small part: two passes
        rest = shape - basis @ (basis.T @ shape)
        rest = rest - basis @ (basis.T @ rest)
        size = float(np.linalg.norm(rest))
        # what is held already, or given twice, would add a direction of rounding
        if size > HELD:
            basis = np.concatenate((basis, rest[:, np.newaxis] / size), axis=1)
    return np.asarray(basis)


class PatchedWing(WingRows):
    """The wing in a basis that holds the changes of `fe.runtime.patch`.

    Parameters
    ----------
    arrays : PatchArrays
        From `fe.reduction.model_cache.patch_arrays`, or read from a file.

    Attributes
    ----------
    factorised : callable
        From a stiffness (n, n) to what gives K^-1 loads. By its inverse, as NumPy has no Cholesky solution;
        where SciPy is at hand another one takes a tenth of the time.
    """

    factorised: Factorised = staticmethod(lambda stiffness: partial(np.matmul, np.linalg.inv(stiffness)))

    def mass(self, servo_mass: float, pitot_mass: float, patch: ModelPatch = EMPTY) -> FloatArray:
        """Return the mass (n, n) with the point masses of a patch [kg].

        Raises
        ------
        InvalidPatchError
            If a place lies off the wing.
        """
        arrays = self.arrays
        mass = arrays.mass[0] + servo_mass * arrays.mass[1] + pitot_mass * arrays.mass[2]
        for item in patch:
            if isinstance(item, PointMass):
                for row in self._along(item.station) @ arrays.line_rows[:3]:
                    mass += item.mass * np.multiply.outer(row, row)
        return np.asarray(mass)

    def stiffness(
        self,
        young_modulus_factor: float,
        stiffness_loss: Losses,
        patch: ModelPatch = EMPTY,
        temperature_difference: float = 0.0,
    ) -> FloatArray:
        """Return the stiffness (n, n) at a state under a patch; primitives of other kinds are passed over.

        Parameters
        ----------
        young_modulus_factor, stiffness_loss
            As of `fe.runtime.state.DigitalState`.
        patch : ModelPatch
            Its root compliances, local losses and temperature coefficients act.
        temperature_difference : float
            Temperature less the reference temperature [K].

        Raises
        ------
        InvalidPatchError
            If a change leaves no stiffness.
        """
        arrays, e = self.arrays, young_modulus_factor
        compliance = 0.0
        for item in patch:
            if isinstance(item, ModulusTemperature):
                e = e * (1.0 - item.coefficient * temperature_difference)
            elif isinstance(item, RootCompliance):
                compliance += item.compliance
        theta = np.array((e, *(1.0 - z for z in arrays.losses(stiffness_loss)), 1.0))
        if not (isfinite(e) and theta.min() > 0.0):
            raise InvalidPatchError(
                f"The factors on the stiffness of skin and damage regions must be positive, but are "
                f"{', '.join(f'{factor:g}' for factor in theta[:-1])}; lessen the losses or the coefficient."
            )
        stiffness = np.tensordot(theta, arrays.stiffness, 1)
        if compliance != 0.0:
            flexibility = 1.0 / arrays.flap_spring + compliance
            if flexibility <= 0.0:
                raise InvalidPatchError(
                    f"The root's compliance of {1.0 / arrays.flap_spring:g} rad/(N m) cannot be reduced by "
                    f"{-compliance:g}; give a compliance above {-1.0 / arrays.flap_spring:g}."
                )
            spring = 1.0 / flexibility - arrays.flap_spring
            stiffness += spring * np.multiply.outer(arrays.flap_row, arrays.flap_row)
        skin = remaining_skin(patch, arrays.strip_lines)
        if skin is not None:
            weights = (skin.of_strips[arrays.strip_of] - 1.0) * theta[arrays.term_of]
            changed = np.flatnonzero(weights)
            lower = np.zeros_like(stiffness)
            lower[np.tril_indices(self.size)] = weights[changed] @ arrays.strip_stiffness[changed]
            stiffness += lower + np.tril(lower, -1).T
        return np.asarray(stiffness)

    def at(
        self, vector: FloatArray, patch: ModelPatch = EMPTY, temperature_difference: float = 0.0
    ) -> "PatchedState":
        """Return the wing at all that can be chosen, (V,), under a patch; see `stiffness` and `mass`.

        Raises
        ------
        InvalidPatchError
            If the wing cannot carry the patch.
        """
        e, *losses, servo, pitot = vector[:-2].tolist()
        stiffness = self.stiffness(e, tuple(losses), patch, temperature_difference)
        return PatchedState(self, stiffness, self.mass(servo, pitot, patch), patch)


class PatchedState:
    """The wing in one state and under one patch, as `fe.runtime.transient` takes it.

    The loads are load factor, its square, the force at the load point as the patch has it, and one at the
    load point itself, which holds the wing before a release. Outputs are the gauges and the tip.

    Attributes
    ----------
    stiffness, mass : (n, n) ndarray
        In the basis of the wing's arrays.
    components : (2, G, n) ndarray
        Rows of the strains across the gauges, and of shear.
    """

    holding, mode_count, on_modes = 3, 6, frozenset(STATION_PORTS)
    """Number of the load that holds the wing before a release; modes that move, whose frequencies the FMU
    shows; ports whose position in motion is that of the modes alone: beyond the modes, neighbouring stations
    move one another half as much as themselves, which a flexibility of each port by itself does not hold."""

    def __init__(self, wing: PatchedWing, stiffness: FloatArray, mass: FloatArray, patch: ModelPatch) -> None:
        self._arrays = arrays = wing.arrays
        self._gains = [item for item in patch if isinstance(item, LoadGain)]
        self.stiffness, self.mass, self._factorised = stiffness, mass, wing.factorised
        self.laws = laws_of(wing.internal_forces(patch), wing.port_rows)
        self._held = wing.held
        force = wing.force_row(LOAD_PLACE, patch.of(*LOADS))
        ports = self.laws.rows(wing.port_rows, wing.size)
        parts = wing.load_parts(patch.of(*LOADS, PointMass))
        self.loads = np.vstack((parts, force, arrays.load_tip, ports)).T
        factors, strains = wing.strain_factors(patch), arrays.strain_rows
        if factors is not None:
            strains = factors[:, np.newaxis] * strains
        self.outputs, self.components = np.vstack((strains[0], arrays.tip_row)), strains[1:]
        self.accelerations = np.zeros((0, wing.size))

    def acting(self, vector: FloatArray) -> FloatArray:
        """Return the coefficients (4,) of the loads."""
        load_factor, tip_force = vector[-2:].tolist()
        force = tip_force
        for item in self._gains:
            force = (1.0 + item.gain) * force + (item.tare if tip_force != 0.0 else 0.0)
        return np.array((load_factor, load_factor**2, force, 0.0))

    @cached_property
    def _solve(self) -> Callable[[FloatArray], FloatArray]:
        return self._factorised(self.stiffness)

    def static(self, loads: FloatArray) -> FloatArray:
        """Return the displacements K^-1 f of loads (n,) or (n, k)."""
        return np.asarray(self._solve(loads))

    @cached_property
    def answers(self) -> FloatArray:
        """Displacements (n, 4 + J) at rest under the unit loads."""
        return self.static(self.loads)

    def lowest(self, count: int, held: FloatArray | None = None) -> Modes:
        """Return the first undamped modes, Kapteyn et al. 2021, eq. (16); the tip moves up in each of them.

        The basis that they are found in holds the static shapes of the rows `held` (s, n) as well.
        """
        solutions = np.zeros((len(self.mass), 0)) if held is None else self.static(held.T)
        basis = motion_basis(self.static, self.mass, self._arrays.start_shapes, solutions)
        frequency, own = lowest_modes(basis.T @ self.stiffness @ basis, basis.T @ self.mass @ basis, count)
        shapes = basis @ own
        shapes = shapes * np.where(self._arrays.tip_row @ shapes < 0.0, -1.0, 1.0)
        return Modes(frequency, shapes, shapes.T @ self.mass)

    @cached_property
    def modes(self) -> Modes:
        """The modes that move."""
        return self.lowest(self.mode_count, self._held)

    shapes = property(lambda self: self.modes.shapes, doc="Their shapes (n, M).")
    to_modes = property(lambda self: self.modes.to_modes, doc="Modal coordinates (M, n) of a displacement.")
