"""A reduced structure whose supports, masses and stiffness may change; see `fe.runtime.patch`.

Its coordinates are those of a `ReducedStructure`, followed by the columns that changes need: for
each change a few of its own, so that a change is solved in the basis of the structure and in its
own columns alone. NumPy and relative imports only.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Annotated, NamedTuple

import numpy as np

from .arrays import FloatArray, IntArray
from .dense_matrices import dense_sum, lowest_modes
from .errors import InvalidPatchError
from .patch import ModelPatch, Primitive, SupportCompliance
from .reduced import ReducedModel

LEAST_DIRECTION = 1e-11
"""Squared length, relative to the largest, of a direction of the columns that is not used."""
KEPT_SUBSPACES = 32
"""Number of sets of changes whose matrices are kept."""


class Subspace(NamedTuple):
    """The coordinates in which a structure with certain changes is solved.

    Attributes
    ----------
    basis : (n, k) array
        The coordinates of the structure from those of the subspace. The last are the motions of
        supports that are held otherwise.
    released : int
        The number of these motions.
    stiffness : (T, k, k) array
        The stiffness terms.
    mass : (1 + P, k, k) array
        The mass terms.
    """

    basis: FloatArray
    released: int
    stiffness: FloatArray
    mass: FloatArray


@dataclass(frozen=True, repr=False)
class ChangeableModel(ReducedModel):
    """A reduced model with the columns that changes of `fe.runtime.patch` need.

    There are n coordinates: Nm of the modal basis, N of the static basis, and the columns of the
    changes. S motions of supports may change.

    Attributes
    ----------
    whole_stiffness : (T, n, n) array
        The stiffness terms.
    whole_mass : (1 + P, n, n) array
        The mass terms.
    whole_load : (L, n) array
        The loads.
    whole_output : (O, n) array
        The outputs.
    column_owner : (n,) array of int64
        Number of the change that a column belongs to, counted from one; zero for the structure
        itself. The first S changes are motions of supports.
    supports, motions : tuple of str
        Support and motion ("x" to "rz") of each of the S motions.
    support_rows : (S, n) array
        Rows that give each motion [m or rad]. That of a motion that is held has a one at a column
        of its own, and zeros.
    support_springs : (S,) array
        Spring that resists each motion [N/m or N m/rad], zero if it is held.
    support_errors : (S,) array
        Largest relative error of outputs and frequencies when the support yields, against the full
        model, at both ends of the range of its compliance.
    """

    record_name = "a reduced model with changes"

    whole_stiffness: Annotated[FloatArray, "terms", "whole", "whole"]
    whole_mass: Annotated[FloatArray, "masses", "whole", "whole"]
    whole_load: Annotated[FloatArray, "loads", "whole"]
    whole_output: Annotated[FloatArray, "all outputs", "whole"]
    column_owner: Annotated[IntArray, "whole"]
    supports: tuple[str, ...]
    motions: tuple[str, ...]
    support_rows: Annotated[FloatArray, "supports", "whole"]
    support_springs: Annotated[FloatArray, "supports"]
    support_errors: Annotated[FloatArray, "supports"]

    def support_number(self, support: str, motion: str) -> int:
        """Return the number of a motion of a support; raise `InvalidPatchError` without one."""
        pairs = list(zip(self.supports, self.motions, strict=True))
        if (support, motion) not in pairs:
            names = ", ".join(f"{name} {of_name}" for name, of_name in pairs) or "none"
            raise InvalidPatchError(
                f"The structure {self.name} has no support {support!r} with the motion {motion!r}; "
                f"it has {names}."
            )
        return pairs.index((support, motion))

    @cached_property
    def subspace(self) -> "_Subspaces":
        """The subspaces of sets of changes."""
        return _Subspaces(self)

    def __getstate__(self) -> dict[str, object]:
        """Return the fields: what is computed from them cannot be handed to another process."""
        return {name: vars(self)[name] for name in self.__dataclass_fields__}

    @cached_property
    def released_columns(self) -> IntArray:
        """The column (S,) of each motion that is held, -1 for one against a spring."""
        is_held = self.support_springs == 0.0
        return np.where(is_held, np.abs(self.support_rows).argmax(axis=1), -1)

    def reactions(self, loads: FloatArray, displacements: FloatArray) -> FloatArray:
        """Return what the supports take of loads, along each motion [N or N m].

        Parameters
        ----------
        loads : (n, k) array
            The loads.
        displacements : (n, k) array
            The displacements at rest under them, with all supports as they are.

        Returns
        -------
        (S, k) array
            The force or moment along each motion.
        """
        springs = self.support_springs[:, np.newaxis]
        is_held = springs == 0.0
        return np.where(
            is_held, self.support_rows @ loads, springs * (self.support_rows @ displacements)
        )

    def compliance_gains(self, vector: FloatArray) -> FloatArray:
        """Return how much softer the structure gets per compliance of each motion of a support.

        Parameters
        ----------
        vector : (V,) array
            Values of the inputs.

        Returns
        -------
        (S, L + M) array
            The relative gain of the compliance under each load, and in each mode (of the inverse
            squared frequency), per compliance [N/m or N m/rad].
        """
        structure = ChangedStructure(self, vector, ModelPatch())
        loads = self.whole_load.T
        displacements = structure.static(loads)
        work = np.sum(loads * displacements, axis=0)
        by_load = self.reactions(loads, displacements) ** 2 / np.where(work > 0.0, work, np.inf)
        frequency, shapes = structure.modes
        squares = (2.0 * np.pi * frequency) ** 2
        # a mode is the displacement at rest under its inertia forces
        inertia = squares * (structure.mass @ shapes)
        by_mode = self.reactions(inertia, shapes) ** 2 / squares
        return np.concatenate((by_load, by_mode), axis=1)


class _Subspaces:
    """The subspaces of a model by the changes that act, each computed once."""

    def __init__(self, model: ChangeableModel) -> None:
        self._model = model
        self._of_changes = lru_cache(KEPT_SUBSPACES)(self._build)

    def __call__(self, changes: Iterable[int]) -> Subspace:
        """Return the subspace in which some changes act, by their numbers from one."""
        return self._of_changes(tuple(sorted(set(changes))))

    def _build(self, changes: tuple[int, ...]) -> Subspace:
        """Return the subspace: orthonormal directions, then the motions of released supports."""
        model = self._model
        released_columns = model.released_columns
        released = [
            released_columns[change - 1]
            for change in changes
            if change <= len(released_columns) and released_columns[change - 1] >= 0
        ]
        acts = np.isin(model.column_owner, (0, *changes))
        acts[released_columns[released_columns >= 0]] = False
        columns = np.flatnonzero(acts)
        # orthonormal in the energy of the middle of all ranges
        reference = np.append(model.bound_reference, 1.0)
        energy = dense_sum(reference, model.whole_stiffness)[np.ix_(columns, columns)]
        scale = 1.0 / np.sqrt(np.diag(energy))
        squares, directions = np.linalg.eigh(scale[:, np.newaxis] * energy * scale)
        is_used = squares > LEAST_DIRECTION * squares[-1]
        used_directions = directions[:, is_used] / np.sqrt(squares[is_used])
        count = int(is_used.sum())
        basis = np.zeros((len(acts), count + len(released)))
        basis[columns, :count] = scale[:, np.newaxis] * used_directions
        basis[released, np.arange(count, count + len(released))] = 1.0
        return Subspace(
            basis=basis,
            released=len(released),
            stiffness=basis.T @ model.whole_stiffness @ basis,
            mass=basis.T @ model.whole_mass @ basis,
        )


class ChangedModes(NamedTuple):
    """The modes of a changed structure.

    Attributes
    ----------
    frequency : (M,) array
        Natural frequencies [Hz].
    shapes : (n, M) array
        Mass-normalised shapes.
    """

    frequency: FloatArray
    shapes: FloatArray


class ChangedStructure:
    """A reduced structure at fixed inputs under a patch, in the n coordinates of its model.

    Parameters
    ----------
    model : ChangeableModel
        The structure.
    vector : (V,) array
        Values of its inputs.
    patch : ModelPatch
        The primitives that change the structure.

    Attributes
    ----------
    mass, stiffness : (n, n) array
        The matrices. Motions of supports that stay held are columns that nothing moves.
    mode_count : int
        The number of modes.

    Raises
    ------
    InvalidPatchError
        If the structure has no such support, or a compliance is negative.
    """

    rigid_ports: frozenset[str] = frozenset()

    def __init__(self, model: ChangeableModel, vector: FloatArray, patch: ModelPatch) -> None:
        model.check_validity(vector.tolist())
        self.mode_count = model.mode_count
        self._last_output = model.whole_output[-1]
        compliances = _compliances(model, patch)
        changes = [1 + number for number in compliances]
        subspace = model.subspace(changes)
        theta = model.stiffness_coefficients(vector)
        masses = model.mass_coefficients(vector)
        self.mass = dense_sum(masses, model.whole_mass)
        self.stiffness = dense_sum(theta, model.whole_stiffness)
        stiffness = dense_sum(theta, subspace.stiffness)
        mass = dense_sum(masses, subspace.mass)
        # A released motion q = sqrt(c) y against its spring 1 / c has the energy y^2 / 2: the
        # limit c = 0 is regular, and holds the support.
        scale = np.ones(len(stiffness))
        first_released = len(scale) - subspace.released
        released = first_released
        for number, compliance in sorted(compliances.items()):
            row = model.support_rows[number]
            spring = model.support_springs[number]
            if spring == 0.0:
                scale[released] = np.sqrt(compliance)
                released += 1
                change = 1.0 / compliance if compliance > 0.0 else 0.0
            else:
                change = 1.0 / (1.0 / spring + compliance) - spring
                row_in_subspace = row @ subspace.basis
                stiffness += change * np.multiply.outer(row_in_subspace, row_in_subspace)
            self.stiffness += change * np.multiply.outer(row, row)
        stiffness = scale[:, np.newaxis] * stiffness * scale
        stiffness[np.arange(first_released, len(scale)), np.arange(first_released, len(scale))] += (
            1.0
        )
        self._basis = subspace.basis * scale
        self._stiffness = stiffness
        self._mass = scale[:, np.newaxis] * mass * scale

    def static(self, loads: FloatArray) -> FloatArray:
        """Return the displacements K^-1 f of loads (n,) or (n, k)."""
        return np.asarray(self._basis @ np.linalg.solve(self._stiffness, self._basis.T @ loads))

    @cached_property
    def modes(self) -> ChangedModes:
        """The lowest undamped modes; the last output is positive in each."""
        frequency, coordinates = lowest_modes(self._stiffness, self._mass, self.mode_count)
        shapes = self._basis @ coordinates
        shapes = shapes * np.where(self._last_output @ shapes < 0.0, -1.0, 1.0)
        return ChangedModes(frequency, shapes)

    @property
    def mode_shapes(self) -> FloatArray:
        """The mass-normalised shapes (n, M) of the modes."""
        return self.modes.shapes


def _compliances(model: ChangeableModel, patch: Iterable[Primitive]) -> dict[int, float]:
    """Return the added compliance of each motion that a patch releases, by the motion's number."""
    compliances: dict[int, float] = {}
    for primitive in patch:
        if not isinstance(primitive, SupportCompliance):
            continue
        if primitive.compliance < 0.0:
            raise InvalidPatchError(
                f"The compliance of the support {primitive.support!r} must not be negative, but is "
                f"{primitive.compliance:g}."
            )
        number = model.support_number(primitive.support, primitive.motion)
        compliances[number] = compliances.get(number, 0.0) + primitive.compliance
    return compliances
