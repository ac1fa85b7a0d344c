"""The arrays of a model whose supports, masses and stiffness can be changed, on given columns."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse

from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.changeable import ChangeableModel
from fe.runtime.reduced import ReducedModel
from fe.structure.affine import AffineStructure
from fe.structure.candidates import (
    LoadChange,
    LossCandidate,
    MassCandidate,
    gauge_shifts,
    possible_gauges,
    strains_across,
)
from fe.structure.operators import Structure

from .terms import ReductionTerms


class WholeColumns(NamedTuple):
    """The columns of a changeable model.

    Attributes
    ----------
    columns : (n', n) array
        The columns on the unknowns of the structure whose supports yield.
    owners : (n,) array of int
        Number of the change that each belongs to, see `ChangeableModel.column_owner`.
    """

    columns: FloatArray
    owners: IntArray


class PossibleChanges(NamedTuple):
    """The changes of a structure other than those of its supports."""

    masses: Sequence[MassCandidate]
    losses: Sequence[LossCandidate]
    loads: Sequence[LoadChange]


def model_on_columns(
    structure: AffineStructure,
    model: ReducedModel,
    terms: ReductionTerms,
    load_factors: IntArray,
    whole: WholeColumns,
    changes: PossibleChanges,
) -> ChangeableModel:
    """Return a changeable model on given columns; its errors are zero until they are measured.

    Parameters
    ----------
    structure : AffineStructure
        The structure whose supports yield.
    model : ReducedModel
        The reduced model of the structure with its supports held.
    terms : ReductionTerms
        The terms of the structure whose supports yield.
    load_factors : (L, 2) array of int
        The loads of the reduced model, see `ReductionTerms.load_factors`. A load that acts on held
        nodes alone is not among them.
    whole : WholeColumns
        The columns.
    changes : PossibleChanges
        The changes other than those of supports.
    """
    columns = whole.columns
    factors = terms.load_factors.tolist()
    loads = [terms.loads[:, factors.index(row)] for row in load_factors.tolist()]
    outputs = np.concatenate((terms.outputs.T, structure.acceleration_output.toarray()), axis=0)
    added_gauges, strain_rows = possible_gauges(structure)
    change_count = len(structure.support_motions) + len(changes.masses) + len(changes.losses)
    return ChangeableModel(
        **model.field_values(ReducedModel),
        whole_stiffness=_projected(terms.stiffness_terms, columns),
        whole_mass=_projected(structure.mass_terms, columns),
        whole_load=np.array(loads) @ columns,
        load_accelerations=_load_accelerations(structure, load_factors),
        whole_output=outputs @ columns,
        column_owner=whole.owners,
        size=structure.mesh.size if isinstance(structure, Structure) else 1.0,
        across_output=np.array([rows @ columns for rows in strains_across(structure)]),
        possible_gauges=added_gauges,
        possible_gauge_output=np.array([rows @ columns for rows in strain_rows]),
        patch_of_gauge=_patch_of_gauges(structure, changes.losses),
        change_errors=np.zeros(change_count),
        **_support_arrays(structure, columns),
        **_mass_arrays(changes.masses, columns),
        **_loss_arrays(changes.losses, columns),
        **_load_arrays(changes.loads, columns),
        **_shift_arrays(structure, columns),
    )


def _support_arrays(structure: AffineStructure, columns: FloatArray) -> dict[str, Any]:
    """Return the fields on motions of supports."""
    motions = structure.support_motions
    parameters = [None, *structure.parameters]
    rows = np.array([columns[motion.unknown] for motion in motions])
    return {
        "supports": tuple(motion.support for motion in motions),
        "motions": tuple(motion.motion for motion in motions),
        "support_rows": rows.reshape(len(motions), columns.shape[1]),
        "support_springs": np.array([motion.spring for motion in motions], dtype=np.float64),
        "spring_parameters": np.array(
            [parameters.index(motion.scaled_by) for motion in motions], dtype=np.int64
        ),
    }


def _mass_arrays(places: Sequence[MassCandidate], columns: FloatArray) -> dict[str, Any]:
    """Return the fields on places of masses."""
    count = len(places)
    width = columns.shape[1]
    return {
        "mass_places": tuple(place.name for place in places),
        "mass_rows": np.array([place.rows @ columns for place in places]).reshape(count, 3, width),
        "mass_slopes": np.array([place.slopes @ columns for place in places]).reshape(
            count, 15, width
        ),
        "mass_points": np.array([place.point for place in places]).reshape(-1, 3),
        "mass_axes": np.array([place.axes for place in places]).reshape(-1, 2, 3),
        "mass_reaches": np.array([place.reach for place in places], dtype=np.float64),
    }


def _loss_arrays(patches: Sequence[LossCandidate], columns: FloatArray) -> dict[str, Any]:
    """Return the fields of `ChangeableModel` on patches of the structure that may lose stiffness.

    The stiffness of each patch is projected on the `columns` of the reduced basis. As the result is
    symmetric, only its lower triangle is stored.
    """
    lower_triangle = np.tril_indices(columns.shape[1])
    patch_numbers = []
    term_numbers = []
    triangles = []
    for number, patch in enumerate(patches):
        for term, matrix in patch.terms.items():
            (projected,) = _projected((matrix,), columns)
            patch_numbers.append(number)
            term_numbers.append(term)
            triangles.append(projected[lower_triangle])
    rows, _ = lower_triangle
    return {
        "loss_places": tuple(patch.name for patch in patches),
        "loss_patch": np.array(patch_numbers, dtype=np.int64),
        "loss_term": np.array(term_numbers, dtype=np.int64),
        "loss_stiffness": np.array(triangles).reshape(len(triangles), len(rows)),
    }


def _load_arrays(changes: Sequence[LoadChange], columns: FloatArray) -> dict[str, Any]:
    """Return the fields on forces at another place or in another direction."""
    shape = (len(changes), columns.shape[1])
    return {
        "load_controls": tuple(change.control for change in changes),
        "load_change_kinds": tuple(change.change for change in changes),
        "load_change_axes": tuple(change.axis for change in changes),
        "load_changes": np.array([change.vector @ columns for change in changes]).reshape(shape),
        "load_curvatures": np.array([change.curvature @ columns for change in changes]).reshape(
            shape
        ),
    }


def _shift_arrays(structure: AffineStructure, columns: FloatArray) -> dict[str, Any]:
    """Return the fields on gauges beside their places."""
    shifts = gauge_shifts(structure)
    return {
        "shifted_gauges": tuple(shift.gauge for shift in shifts),
        "shift_axes": tuple(shift.axis for shift in shifts),
        "shift_output": np.array([shift.rows @ columns for shift in shifts]).reshape(
            len(shifts), 2, columns.shape[1]
        ),
    }


def _patch_of_gauges(structure: AffineStructure, patches: Sequence[LossCandidate]) -> IntArray:
    """Return the index (G,) of the patch on which each gauge sits, -1 for none."""
    patch_of_gauge = np.full(len(structure.gauges), -1, dtype=np.int64)
    for number, patch in enumerate(patches):
        patch_of_gauge[list(patch.gauges)] = number
    return patch_of_gauge


def _load_accelerations(structure: AffineStructure, load_factors: IntArray) -> FloatArray:
    """Return the acceleration (L, 3) that each load applies, per unit of its control.

    A row of `load_factors` has the numbers of the control and of the free mass to which the load is
    proportional, counted from one; 0 means none. The row of a load on a free mass is zero.
    """
    no_acceleration = np.zeros(3)
    acceleration_of_control: dict[int, FloatArray] = {}
    controls = [None, *structure.controls]
    for load in structure.design.load:
        if load.acceleration is not None:
            number = controls.index(structure.loads[load.name])
            acceleration_so_far = acceleration_of_control.get(number, no_acceleration)
            acceleration_of_control[number] = acceleration_so_far + np.asarray(load.acceleration)
    rows = [
        acceleration_of_control.get(control, no_acceleration) if mass == 0 else no_acceleration
        for control, mass in load_factors.tolist()
    ]
    return np.array(rows).reshape(-1, 3)


def _projected(terms: tuple[sparse.csr_array, ...], columns: FloatArray) -> FloatArray:
    """Project symmetric terms on columns (n, k): an array (T, k, k)."""
    projected = np.array([columns.T @ (term @ columns) for term in terms])
    return np.asarray(0.5 * (projected + projected.swapaxes(1, 2)))
