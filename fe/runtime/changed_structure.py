"""A structure with fixed inputs under a patch: its statics, modes and gains of compliance.

NumPy and relative imports only.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np

from .arrays import FloatArray
from .changeable import ChangeableModel
from .dense_matrices import dense_sum, lowest_modes
from .patch import ModelPatch


class ChangedModes(NamedTuple):
    """The modes of a changed structure.

    Attributes
    ----------
    frequency : (M,) array
        Natural frequencies [Hz].
    shapes : (k, M) array
        Mass-normalised shapes.
    """

    frequency: FloatArray
    shapes: FloatArray


class ChangedStructure:
    """A reduced structure with fixed inputs under a patch, in k coordinates.

    Parameters
    ----------
    vector : (V,) array
        Values of the inputs.

    Attributes
    ----------
    basis : (n, k) array
        The coordinates of the model from those of this structure: `Subspace.basis`.
    mass, stiffness : (k, k) array
        Mass [kg] and stiffness [N/m].

    Raises
    ------
    InvalidPatchError
        If the structure has no such support or location, or a value is not possible.
    OutsideModelError
        If an input lies outside its range.
    """

    rigid_ports: frozenset[str] = frozenset()

    def __init__(self, model: ChangeableModel, vector: FloatArray, patch: ModelPatch) -> None:
        model.check_validity(vector.tolist())
        self.mode_count = model.mode_count
        self._last_output = model.whole_output[-1]
        changes = model.changes_of(patch)
        subspace = model.subspace(changes.numbers)
        self.basis = subspace.basis
        theta = model.stiffness_coefficients(vector)
        self.stiffness = dense_sum(theta, subspace.stiffness)
        self.mass = dense_sum(model.mass_coefficients(vector), subspace.mass)
        for added in changes.masses:
            rows = model.rows_of_mass(added) @ self.basis
            self.mass += added.kilograms * rows.T @ rows
        for change, loss in changes.losses.items():
            terms, parts = subspace.lost[change]
            self.stiffness -= dense_sum(loss * theta[terms], parts)
        # A released motion q = sqrt(c) y against its spring 1 / c has the energy y^2 / 2: the
        # limit c = 0 is regular, and holds the support.
        count = len(self.stiffness)
        first_released = count - subspace.released
        self._scale = np.ones(count)
        released = first_released
        added_springs = np.zeros(count)
        springs = model.springs_at(vector)
        for number, compliance in sorted(changes.compliances.items()):
            spring = springs[number - 1]
            if spring == 0.0:
                self._scale[released] = np.sqrt(compliance)
                added_springs[released] = 1.0 / compliance if compliance > 0.0 else 0.0
                released += 1
            else:
                added_spring = 1.0 / (1.0 / spring + compliance) - spring
                row = model.support_rows[number - 1] @ self.basis
                self.stiffness += added_spring * np.multiply.outer(row, row)
        self._scaled_stiffness = self._scale[:, np.newaxis] * self.stiffness * self._scale
        is_released = np.arange(first_released, count)
        self._scaled_stiffness[is_released, is_released] += 1.0
        self._scaled_mass = self._scale[:, np.newaxis] * self.mass * self._scale
        self.stiffness[is_released, is_released] += added_springs[first_released:]

    @cached_property
    def _inverse_cholesky(self) -> FloatArray:
        """The inverse L^-1 of the Cholesky factor of the scaled stiffness K = L L^T."""
        return np.linalg.inv(np.linalg.cholesky(self._scaled_stiffness))

    def static(self, loads: FloatArray) -> FloatArray:
        """Return the displacements K^-1 f of loads (k,) or (k, m)."""
        inverse = self._inverse_cholesky
        scaled_loads = (self._scale * loads.T).T
        scaled_displacements = inverse.T @ (inverse @ scaled_loads)
        return np.asarray((self._scale * scaled_displacements.T).T)

    @cached_property
    def modes(self) -> ChangedModes:
        """The lowest undamped modes, with the sign that makes the last output positive."""
        frequency, coordinates = lowest_modes(
            self._scaled_stiffness, self._scaled_mass, self.mode_count
        )
        shapes = self._scale[:, np.newaxis] * coordinates
        last_output = self._last_output @ self.basis
        shapes = shapes * np.where(last_output @ shapes < 0.0, -1.0, 1.0)
        return ChangedModes(frequency, shapes)

    @property
    def mode_shapes(self) -> FloatArray:
        """The mass-normalised shapes (k, M) of the modes."""
        return self.modes.shapes


def compliance_gains(model: ChangeableModel, vector: FloatArray) -> FloatArray:
    """Return the relative increase of compliance per unit of compliance added at each support.

    The values (V,) of the inputs are in `vector`.

    Returns
    -------
    (S, L + M) array
        For each of S support motions the increase [N/m or N m/rad] of the compliance under each
        load, then that of the inverse squared frequency of each mode, each over its value.
    """
    structure = ChangedStructure(model, vector, ModelPatch())
    loads = model.whole_load.T
    displacements = structure.basis @ structure.static(structure.basis.T @ loads)
    work = np.sum(loads * displacements, axis=0)
    springs = model.springs_at(vector)
    gains_of_loads = _reactions(model, loads, displacements, springs) ** 2 / np.where(
        work > 0.0, work, np.inf
    )
    frequency = structure.modes.frequency
    shapes = structure.basis @ structure.mode_shapes
    squared_angular_frequency = (2.0 * np.pi * frequency) ** 2
    # a mode is the displacement at rest under its inertia forces
    mass = dense_sum(model.mass_coefficients(vector), model.whole_mass)
    inertia_forces = squared_angular_frequency * (mass @ shapes)
    gains_of_modes = (
        _reactions(model, inertia_forces, shapes, springs) ** 2 / squared_angular_frequency
    )
    return np.concatenate((gains_of_loads, gains_of_modes), axis=1)


def _reactions(
    model: ChangeableModel, loads: FloatArray, displacements: FloatArray, springs: FloatArray
) -> FloatArray:
    """Return the force or moment (S, k) that each support motion exerts on loads (n, k).

    `displacements` (n, k) are the static ones under the loads, with unchanged supports. `springs`
    (S,) are those of the motions [N/m or N m/rad], zero where a motion is held.
    """
    is_held = springs[:, np.newaxis] == 0.0
    reaction_of_rigid_support = model.support_rows @ loads
    reaction_of_spring = springs[:, np.newaxis] * (model.support_rows @ displacements)
    return np.where(is_held, reaction_of_rigid_support, reaction_of_spring)
