"""A reduced structure whose supports, masses and stiffness can be changed by a patch.

Its coordinates are those of a `ReducedStructure`, followed by extra columns for each possible
change. `fe.runtime.changed_structure` solves it in its own basis and the columns of the changes
that act. NumPy and relative imports only.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import inf
from sys import float_info
from typing import Annotated, NamedTuple

import numpy as np

from .arrays import FloatArray, IntArray
from .dense_matrices import dense_sum
from .errors import InvalidPatchError
from .patch import (
    InterfaceCompliance,
    LoadOffset,
    LoadTilt,
    PlaceMass,
    Primitive,
    RegionStiffnessLoss,
    SupportCompliance,
)
from .reduced import ReducedModel
from .structural_changes import FITTED_REACH, AddedMass, StructuralChanges, taylor_factors

LEAST_DIRECTION = 1e-11
"""Eigenvalue, relative to the largest, below which a direction of the columns is left out."""
KEPT_SUBSPACES = 32
"""Number of sets of changes whose matrices are kept."""


class Subspace(NamedTuple):
    """The coordinates in which a structure with certain changes is solved.

    Attributes
    ----------
    basis : (n, k) array
        The coordinates of the model from those of the subspace. The last are the released motions.
    released : int
        Number of motions that the supports hold unless changed.
    stiffness : (T, k, k) array
        The stiffness terms.
    mass : (1 + P, k, k) array
        The mass terms.
    lost : dict of int to (Q,) array and (Q, k, k) array
        For each change that is a loss, the stiffness terms to which the patch contributes, and the
        contributions.
    """

    basis: FloatArray
    released: int
    stiffness: FloatArray
    mass: FloatArray
    lost: dict[int, tuple[IntArray, FloatArray]]


@dataclass(frozen=True, repr=False)
class ChangeableModel(ReducedModel):
    """A reduced model with the columns that changes of `fe.runtime.patch` need.

    There are n coordinates: Nm of the modal basis, N of the static basis, and the columns of the
    changes. S motions of supports and of interfaces may change.

    Attributes
    ----------
    whole_stiffness : (T, n, n) array
        The stiffness terms.
    whole_mass : (1 + P, n, n) array
        The mass terms.
    whole_load : (L, n) array
        The loads.
    load_accelerations : (L, 3) array
        Acceleration that each load gives to all that has mass, per unit of its control; zero for a
        load that is none, and for the part of one that acts on a free mass.
    whole_output : (O, n) array
        The outputs.
    column_owner : (n,) array of int64
        Number of the change that a column belongs to, counted from one; zero for the structure
        itself. The first S changes are motions of supports and interfaces.
    supports, motions : tuple of str
        Support and motion ("x" to "rz"), or interface and motion ("n" to "rt"), of each of the S
        motions.
    support_rows : (S, n) array
        Rows that give each motion [m or rad]. That of a motion that is held has a one at a column
        of its own, and zeros.
    support_springs : (S,) array
        Spring that resists each motion [N/m or N m/rad], zero if it is held.
    spring_parameters : (S,) array of int64
        Number of the parameter that scales each spring, from one; zero for none.
    mass_places : tuple of str
        Names of the C places where a mass may be added or lost, the next changes.
    mass_rows : (C, 3, n) array
        Rows that give the displacement of a mass at each place.
    mass_slopes : (C, 15, n) array
        Derivatives of these rows by distances from the place, see `fe.structure.candidates`.
    mass_points : (C, 3) array
        The places, or the centres of sets; zero for matrices [m].
    mass_axes : (C, 2, 3) array
        Unit vectors of the distances from each place.
    mass_reaches : (C,) array
        How far a node can lie from the nearest place [m]; zero for a place beside which no mass can
        lie.
    loss_places : tuple of str
        Names of the R patches that may lose stiffness, the last changes.
    loss_patch, loss_term : (Q,) array of int64
        Patch, and stiffness term, of each part of the stiffness that patches hold.
    loss_stiffness : (Q, n (n + 1) / 2) array
        Lower triangle, row by row, of each part.
    possible_gauges : tuple of str
        Points and directions of H gauges that may be added.
    possible_gauge_output : (3, H, n) array
        Their strains, the strains across them, and the shear strains.
    patch_of_gauge : (G,) array of int64
        Patch on which each gauge sits, -1 for none.
    size : float
        Diagonal of the box around the structure, or 1 if that is not known [m].
    load_controls, load_change_kinds, load_change_axes : tuple of str
        Control of a force, "offset" or "tilt", and axis, of D changes of loads.
    load_changes : (D, n) array
        Change of the load per unit of its control, and per metre or radian.
    load_curvatures : (D, n) array
        Second derivatives of the load by an offset, per unit of its control and square metre.
    shifted_gauges, shift_axes : tuple of str
        Gauge, and "along" or "across", of E changes of the places of gauges.
    shift_output : (E, 2, n) array
        First and second derivative of the strain of each by the distance [1/m and 1/m2].
    across_output : (2, G, n) array
        Strains across the gauges, and shear strains; without gauges if they are not known.
    change_errors : (S + C + R,) array
        Largest relative error of outputs and frequencies under each change, against the full model,
        at both ends of its range.
    """

    record_name = "a reduced model with changes"

    whole_stiffness: Annotated[FloatArray, "terms", "whole", "whole"]
    whole_mass: Annotated[FloatArray, "masses", "whole", "whole"]
    whole_load: Annotated[FloatArray, "loads", "whole"]
    load_accelerations: Annotated[FloatArray, "loads", 3]
    whole_output: Annotated[FloatArray, "all outputs", "whole"]
    column_owner: Annotated[IntArray, "whole"]
    supports: tuple[str, ...]
    motions: tuple[str, ...]
    support_rows: Annotated[FloatArray, "supports", "whole"]
    support_springs: Annotated[FloatArray, "supports"]
    spring_parameters: Annotated[IntArray, "supports"]
    mass_places: tuple[str, ...]
    mass_rows: Annotated[FloatArray, "masses added", 3, "whole"]
    mass_slopes: Annotated[FloatArray, "masses added", 15, "whole"]
    mass_points: Annotated[FloatArray, "masses added", 3]
    mass_axes: Annotated[FloatArray, "masses added", 2, 3]
    mass_reaches: Annotated[FloatArray, "masses added"]
    loss_places: tuple[str, ...]
    loss_patch: Annotated[IntArray, "parts"]
    loss_term: Annotated[IntArray, "parts"]
    loss_stiffness: Annotated[FloatArray, "parts", "triangle"]
    possible_gauges: tuple[str, ...]
    possible_gauge_output: Annotated[FloatArray, 3, "gauges that may be added", "whole"]
    patch_of_gauge: Annotated[IntArray, "gauges"]
    size: Annotated[float, float_info.min, inf]
    load_controls: tuple[str, ...]
    load_change_kinds: tuple[str, ...]
    load_change_axes: tuple[str, ...]
    load_changes: Annotated[FloatArray, "changed loads", "whole"]
    load_curvatures: Annotated[FloatArray, "changed loads", "whole"]
    shifted_gauges: tuple[str, ...]
    shift_axes: tuple[str, ...]
    shift_output: Annotated[FloatArray, "gauge shifts", 2, "whole"]
    across_output: Annotated[FloatArray, 2, "gauges across", "whole"]
    change_errors: Annotated[FloatArray, "changes"]

    def _axis_lengths(self) -> dict[str, int]:
        size = len(self.column_owner)
        return super()._axis_lengths() | {
            "masses added": len(self.mass_places),
            "gauges that may be added": len(self.possible_gauges),
            "changed loads": len(self.load_controls),
            "gauge shifts": len(self.shifted_gauges),
            "triangle": size * (size + 1) // 2,
            "changes": len(self.supports) + len(self.mass_places) + len(self.loss_places),
        }

    def changes_of(self, patch: Iterable[Primitive]) -> StructuralChanges:
        """Collect the structural changes of a patch, by the numbers of the changes.

        Changes are numbered from 1: motions of supports, then places of masses, then patches that
        may lose stiffness. Several compliances of one support motion are added. If several losses
        act on one patch, the fractions of its stiffness that they leave are multiplied.

        Raises
        ------
        InvalidPatchError
            If the structure has no such support or location, or a value is not possible.
        """
        compliances: dict[int, float] = {}
        masses: list[AddedMass] = []
        remaining_fractions: dict[int, float] = {}
        for primitive in patch:
            if isinstance(primitive, SupportCompliance | InterfaceCompliance):
                if primitive.compliance < 0.0:
                    raise InvalidPatchError(
                        f"The compliance of {primitive.location!r} must not be negative, but is "
                        f"{primitive.compliance:g}."
                    )
                number = 1 + self.support_number(primitive.location, primitive.motion)
                compliances[number] = compliances.get(number, 0.0) + primitive.compliance
            elif isinstance(primitive, PlaceMass):
                place = self._place_number(self.mass_places, primitive.place, "a mass")
                self._check_distances(primitive, float(self.mass_reaches[place]))
                number = 1 + len(self.supports) + place
                masses.append(AddedMass(number, primitive.mass, primitive.along, primitive.across))
            elif isinstance(primitive, RegionStiffnessLoss):
                if not 0.0 <= primitive.loss < 1.0:
                    raise InvalidPatchError(
                        f"The loss of the patch {primitive.region!r} must be at least 0 and below "
                        f"1, but is {primitive.loss:g}."
                    )
                if not primitive.extent > 0.0:
                    raise InvalidPatchError(
                        f"The extent of the loss of {primitive.region!r} must be positive, but is "
                        f"{primitive.extent:g}."
                    )
                place = self._place_number(self.loss_places, primitive.region, "a loss")
                number = 1 + len(self.supports) + len(self.mass_places) + place
                remaining_fractions.setdefault(number, 1.0)
                remaining_fractions[number] *= 1.0 - primitive.loss
        losses = {number: 1.0 - fraction for number, fraction in remaining_fractions.items()}
        return StructuralChanges(compliances, tuple(masses), losses)

    def rows_of_mass(self, added: AddedMass) -> FloatArray:
        """Return the rows (3, n) that give the displacement of an added mass."""
        place = added.number - 1 - len(self.supports)
        rows: FloatArray = self.mass_rows[place]
        if added.along == 0.0 and added.across == 0.0:
            return rows
        slopes = self.mass_slopes[place].reshape(-1, *rows.shape)
        factors = taylor_factors(added.along, added.across)
        return np.asarray(rows + np.tensordot(factors, slopes, 1))

    def weight_of_masses(self, patch: Iterable[Primitive], coefficients: FloatArray) -> FloatArray:
        """Return the load (n,) that accelerations exert on the masses of a patch.

        `coefficients` (L,) are those of the loads, from `load_coefficients`.
        """
        acceleration = coefficients @ self.load_accelerations
        load = np.zeros(len(self.column_owner))
        if acceleration.any():
            for added in self.changes_of(patch).masses:
                load += added.kilograms * acceleration @ self.rows_of_mass(added)
        return load

    def strain_factor(self, gauge: str, patch: Iterable[Primitive]) -> float:
        """Return the strain under a gauge over that of its patch, which lost stiffness on average.

        See `fe.runtime.patch.RegionStiffnessLoss.strain_over_mean`.
        """
        factor = 1.0
        number = int(self.patch_of_gauge[self.gauges.index(gauge)])
        place = self.loss_places[number] if number >= 0 else None
        for primitive in patch:
            if isinstance(primitive, RegionStiffnessLoss) and primitive.region == place:
                factor *= primitive.strain_over_mean
        return factor

    def changed_load(
        self, load: FloatArray, control: str, patch: Iterable[Primitive]
    ) -> FloatArray:
        """Return the load (n,) of a control after a patch has moved or turned its force.

        By an offset, the load changes as a Taylor series of second order in the distance. By a
        tilt, it is turned towards the load of a force perpendicular to it.

        Parameters
        ----------
        load : (n,) array
            The load per unit of the control.
        patch : iterable of Primitive
            Only `LoadOffset` and `LoadTilt` of this control act.
        """
        change_keys = list(
            zip(self.load_controls, self.load_change_kinds, self.load_change_axes, strict=True)
        )
        for primitive in patch:
            if isinstance(primitive, LoadOffset) and primitive.control == control:
                number = change_keys.index((control, "offset", primitive.axis))
                load = (
                    load
                    + primitive.distance * self.load_changes[number]
                    + 0.5 * primitive.distance**2 * self.load_curvatures[number]
                )
            elif isinstance(primitive, LoadTilt) and primitive.control == control:
                number = change_keys.index((control, "tilt", primitive.axis))
                perpendicular_load = self.load_changes[number]
                load = np.cos(primitive.angle) * load + np.sin(primitive.angle) * perpendicular_load
        return load

    def _check_distances(self, mass: PlaceMass, reach: float) -> None:
        """Raise `InvalidPatchError` if a mass lies too far from its place, whose reach is in m.

        The displacement is a Taylor series about the place, which does not hold further away.
        """
        largest = FITTED_REACH * reach
        if max(abs(mass.along), abs(mass.across)) > largest:
            raise InvalidPatchError(
                f"A mass lies {mass.along:g} m along and {mass.across:g} m across from "
                f"{mass.place!r}, but both distances must be at most {largest:.3g} m; take a "
                "nearer place."
            )

    def _place_number(self, places: tuple[str, ...], place: str, what: str) -> int:
        """Return the index of a location; raise `InvalidPatchError` if there is none."""
        if place not in places:
            raise InvalidPatchError(
                f"The structure {self.name} has no place {place!r} for {what}; it has "
                f"{'; '.join(places) or 'none'}."
            )
        return places.index(place)

    def parts_of_patch(
        self, change: int, columns: IntArray, basis: FloatArray
    ) -> tuple[IntArray, FloatArray]:
        """Return what a patch of the structure contributes to the stiffness terms, in a subspace.

        Parameters
        ----------
        change : int
            Number of the change, from one.
        columns : (m,) array of int
            The coordinates of the model that the subspace uses.
        basis : (m, k) array
            The matrix from coordinates of the subspace to these coordinates.

        Returns
        -------
        terms : (Q,) array of int
            Indices of the stiffness terms.
        parts : (Q, k, k) array
            The contribution to each of these terms.
        """
        patch = change - 1 - len(self.supports) - len(self.mass_places)
        parts_in_patch = np.flatnonzero(self.loss_patch == patch)
        # entries of the lower triangle, which is stored row by row
        rows = np.maximum.outer(columns, columns)
        triangle = rows * (rows + 1) // 2 + np.minimum.outer(columns, columns)
        parts = [
            basis.T @ self.loss_stiffness[number][triangle] @ basis for number in parts_in_patch
        ]
        return self.loss_term[parts_in_patch], np.array(parts)

    def support_number(self, support: str, motion: str) -> int:
        """Return the index of a motion of a support or interface.

        Raises `InvalidPatchError` if there is none.
        """
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
        """The subspaces in which sets of changes are solved."""
        return _Subspaces(self)

    def __getstate__(self) -> dict[str, object]:
        """Return the fields alone, as computed properties cannot be pickled."""
        return self.field_values()

    @cached_property
    def released_columns(self) -> IntArray:
        """The column (S,) of each held motion, -1 for a motion against a spring."""
        is_held = self.support_springs == 0.0
        return np.where(is_held, np.abs(self.support_rows).argmax(axis=1), -1)

    def springs_at(self, vector: FloatArray) -> FloatArray:
        """Return the spring (S,) of each motion for values (V,) of the inputs."""
        factors = np.append(1.0, vector[: len(self.parameters)])
        return np.asarray(self.support_springs * factors[self.spring_parameters])


class _Subspaces:
    """The subspaces of a model for sets of changes, each computed once."""

    def __init__(self, model: ChangeableModel) -> None:
        self._model = model
        self._of_changes = lru_cache(KEPT_SUBSPACES)(self._build)

    def __call__(self, changes: Iterable[int]) -> Subspace:
        """Return the subspace for some changes, by their numbers from one."""
        return self._of_changes(tuple(sorted(set(changes))))

    def _build(self, changes: tuple[int, ...]) -> Subspace:
        """Build the subspace of a set of changes.

        Its coordinates are directions that are orthonormal in the energy norm, then the motions of
        supports that the changes release.
        """
        model = self._model
        released_columns = model.released_columns
        released = [
            released_columns[change - 1]
            for change in changes
            if change <= len(released_columns) and released_columns[change - 1] >= 0
        ]
        is_column_used = np.isin(model.column_owner, (0, *changes))
        is_column_used[released_columns[released_columns >= 0]] = False
        columns = np.flatnonzero(is_column_used)
        # orthonormal in the energy norm at the midpoint of all ranges
        reference = np.append(model.bound_reference, 1.0)
        own_block = (slice(None), columns[:, np.newaxis], columns)
        energy = dense_sum(reference, model.whole_stiffness[own_block])
        scale = 1.0 / np.sqrt(np.diag(energy))
        eigenvalues, eigenvectors = np.linalg.eigh(scale[:, np.newaxis] * energy * scale)
        is_used = eigenvalues > LEAST_DIRECTION * eigenvalues[-1]
        orthonormal_directions = eigenvectors[:, is_used] / np.sqrt(eigenvalues[is_used])
        direction_count = int(is_used.sum())
        # the terms hold hundreds of columns of other changes, which are left out of the products
        columns = np.concatenate((columns, np.array(released, dtype=np.int64)))
        rows_of_basis = np.zeros((len(columns), direction_count + len(released)))
        rows_of_basis[: len(scale), :direction_count] = (
            scale[:, np.newaxis] * orthonormal_directions
        )
        rows_of_basis[len(scale) :, direction_count:] = np.eye(len(released))
        basis = np.zeros((len(is_column_used), direction_count + len(released)))
        basis[columns] = rows_of_basis
        block = (slice(None), columns[:, np.newaxis], columns)
        return Subspace(
            basis=basis,
            released=len(released),
            stiffness=rows_of_basis.T @ model.whole_stiffness[block] @ rows_of_basis,
            mass=rows_of_basis.T @ model.whole_mass[block] @ rows_of_basis,
            lost={
                change: model.parts_of_patch(change, columns, rows_of_basis)
                for change in changes
                if change > len(model.supports) + len(model.mass_places)
            },
        )
