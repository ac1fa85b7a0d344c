"""Extend the reduced model of a structure by columns for changes of supports, mass and stiffness.

A support or an interface that yields moves the structure by the unit responses to its motions: the
displacements of the structure when one such motion is prescribed and all else is held. They are
added to the basis of the reduced model (the constraint modes of Craig and Bampton 1968, AIAA
Journal 6 (7), 1313-1319), with the static responses to their inertia. They depend on the stiffness
of the structure, so they are computed in several states.

For a point mass, the static responses to forces at its location are added. For a loss of stiffness
of a patch, the changes of the solutions under loads, of those under outputs as loads, and of the
modes are added.
"""

from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.linalg import eigh

from fe.full.subspace import OrthonormalBasis, affine_product, solve_near
from fe.runtime.arrays import FloatArray
from fe.runtime.changeable import ChangeableModel
from fe.runtime.changed_structure import ChangedStructure, compliance_gains
from fe.runtime.patch import (
    InterfaceCompliance,
    ModelPatch,
    PlaceMass,
    RegionStiffnessLoss,
    SupportCompliance,
)
from fe.structure.affine import AffineStructure, SupportMotion
from fe.structure.candidates import (
    LossCandidate,
    MassCandidate,
    load_changes,
    loss_places,
    mass_places,
)
from fe.structure.tables import INTERFACE_MOTIONS

from .change_model import PossibleChanges, WholeColumns, model_on_columns
from .changed_case import ChangedCase, case_error
from .reduced_basis import Reduction
from .terms import ReductionTerms, cube_corners

LEAST_REMAINDER = 1e-4
"""Norm outside the basis, relative to that of the vector, below which a direction is left out."""
SAME_DIRECTION = 1e-7
"""Relative norm below which directions of the structure's own bases are left out."""
SOLUTION_TOLERANCE = 1e-7
"""Relative residual of solutions in other states, and of full solutions for measuring errors."""
SNAPSHOT_TOLERANCE = 1e-5
"""Relative residual of solutions with losses from which the basis is made."""
MOST_STATES = 8
"""Number of states in which unit responses are computed, in addition to the central one."""
BESIDE = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))
"""Distances beside a location for which responses to forces are added, over its reach."""
LEAST_REMAINDER_BESIDE = 0.3
"""The same as `LEAST_REMAINDER` for responses to forces beside the location of a mass."""
INERTIA_RESPONSES = 1
"""Number of static responses to inertia: of the unit response, then of the previous one."""
LARGE_LOSSES = (0.45, 0.7)
"""Losses of patches for which solutions are computed."""
LEAST_LOSS_REMAINDER = 1e-3
"""The same as `LEAST_REMAINDER` for changes of solutions by a loss, relative to the solutions."""
LARGEST_MASS_GAIN = 0.5
"""Mass with which the errors are measured: the largest relative gain of a modal mass."""
LARGEST_ERROR = 1e-3
"""Largest relative error under a change; above it, the columns of this change are refined again."""
MOST_REFINEMENTS = 3
"""Most refinements of the columns of a change."""
DIAGONAL = 0.7
"""Distance along and across a location at which the errors are measured, too, over its reach."""
LOSS_RANGE = (0.05, 0.7)
"""Range of losses of stiffness in which the errors are measured."""
GAIN_RANGE = (0.01, 1.0)
"""Range of compliance in which the errors are measured: the largest relative gain of compliance
under a load or in a mode."""


def with_changes(yielding: AffineStructure, reduction: Reduction) -> ChangeableModel:
    """Extend a reduced model by the columns that changes of the structure need.

    The columns of all changes are refined once, and those of changes whose largest error exceeds
    `LARGEST_ERROR` again, at most `MOST_REFINEMENTS` times in all. `change_errors` of the model has
    the remaining errors.

    Parameters
    ----------
    yielding : AffineStructure
        The structure whose supports yield (`assemble_structure(..., yielding=True)`).
    reduction : Reduction
        The reduction of the same structure with its supports held.

    Raises
    ------
    SolutionError
        If the full model cannot be solved.
    """
    columns = _Columns(yielding, reduction)
    for motion in yielding.support_motions:
        columns.add_motion(motion)
    for place in columns.mass_places:
        columns.add_mass(place)
    for patch in columns.loss_places:
        columns.add_loss(patch)
    model = columns.model()
    errors = np.full(len(model.change_errors), np.inf)
    inexact = list(range(len(errors)))
    for _ in range(MOST_REFINEMENTS):
        for number in inexact:
            columns.refine(model, number)
        model = columns.model()
        errors[inexact] = [columns.error(model, number) for number in inexact]
        inexact = np.flatnonzero(~(errors <= LARGEST_ERROR)).tolist()
        if not inexact:
            break
    return replace(model, change_errors=errors)


class _Columns:
    """The columns of a changeable model on the n' unknowns of the structure that yields.

    Parameters
    ----------
    yielding : AffineStructure
        The structure whose supports yield.
    reduction : Reduction
        The reduction of the same structure with its supports held, with n unknowns: the first n of
        the n'.

    Attributes
    ----------
    free_count : int
        The number n of unknowns that are free if the supports are held.
    free : slice
        These unknowns among all n'.
    column_blocks : list of (n', k) array
        The columns, in the order in which they were added.
    block_owners : list of (k,) array of int
        The number of the change that each column belongs to, from 1; 0 for the structure itself.
    base : OrthonormalBasis
        A basis, in whitened coordinates, of the columns of the reduction.
    """

    def __init__(self, yielding: AffineStructure, reduction: Reduction) -> None:
        self.structure = yielding
        self.reduction = reduction
        self.held_terms = reduction.terms
        self.factors = reduction.terms.factors
        self.terms = ReductionTerms(yielding)
        self.free_count = reduction.terms.structure.unknowns
        self.free = slice(self.free_count)
        masses = (1.0, *yielding.masses.values())
        self.mass = sum(
            (value * term for value, term in zip(masses, yielding.mass_terms, strict=True)),
            sparse.csr_array(yielding.mass_terms[0].shape),
        ).tocsr()
        base = np.concatenate((reduction.modal_basis, reduction.static_basis), axis=1)
        self.column_blocks = [self._padded(base)]
        self.block_owners = [np.zeros(base.shape[1], dtype=np.int64)]
        self.base = OrthonormalBasis(self.free_count, drop=SAME_DIRECTION)
        self.base.extend(self._whitened(base))
        self.mass_places = mass_places(yielding)
        self.loss_places = loss_places(yielding)
        self.load_changes = load_changes(yielding)
        # the responses to forces at another point, or in another direction
        forces = [change.vector[self.free] for change in self.load_changes]
        forces += [
            change.curvature[self.free] for change in self.load_changes if change.curvature.any()
        ]
        responses = self.factors.whitened(np.array(forces).reshape(-1, self.free_count).T)
        self._add_orthogonal_part(0, responses / np.linalg.norm(responses, axis=0))

    def _padded(self, columns: FloatArray) -> FloatArray:
        """Return columns (n, k) on all n' unknowns, with zeros where supports hold."""
        return np.pad(columns, ((0, self.structure.unknowns - self.free_count), (0, 0)))

    def _whitened(self, displacements: FloatArray) -> FloatArray:
        """Return displacements (n, k) in whitened coordinates, in which energy is length."""
        return self.factors.whitened(self.factors.stiffness @ displacements)

    def add_motion(self, motion: SupportMotion) -> None:
        """Add the columns of a support motion: its unit response, and responses to their inertia.

        The unit response is the displacement if the support moves by one. Its changes with the
        parameters and losses are added, too.
        """
        number = 1 + self.structure.support_motions.index(motion)
        is_held = motion.spring == 0.0
        unit_response = self._unit_responses(motion, self.held_terms.reference[np.newaxis])
        changes_of_response = self._unit_responses(motion, self._other_states()) - unit_response
        # the displacements of all unknowns when the support moves
        unit_displacement = np.zeros((self.structure.unknowns, 1))
        unit_displacement[self.free] = unit_response
        if is_held:
            unit_displacement[motion.unknown] = 1.0
            self.column_blocks.append(unit_displacement)
            self.block_owners.append(np.array([number], dtype=np.int64))
        snapshots = [] if is_held else [unit_response]
        inertia_force = (self.mass @ unit_displacement)[self.free]
        free_mass = self.mass[self.free, self.free]
        for _ in range(INERTIA_RESPONSES):
            snapshots.append(self.factors.riesz(inertia_force))
            inertia_force = free_mass @ snapshots[-1]
        directions = [self._whitened(snapshot) for snapshot in snapshots]
        directions = [vector / np.linalg.norm(vector) for vector in directions]
        # a change of the unit response is relative to the unit response
        scale = np.linalg.norm(self._whitened(unit_response))
        block = np.concatenate((*directions, self._whitened(changes_of_response) / scale), axis=1)
        self._add_orthogonal_part(number, block)

    def refine(self, model: ChangeableModel, number: int) -> None:
        """Add the modes of the full model under one change, after a step of inverse iteration.

        `number` counts the changes from zero.
        """
        for case in self._cases(model, number):
            modes = case.full_solution(case.mass @ self._shapes(case.structure))
            if len(case.direction):
                modes = modes - modes[[self.structure.support_motions[number].unknown]] * (
                    case.direction
                )
            block = self._whitened(modes[self.free])
            self._add_orthogonal_part(1 + number, block / np.linalg.norm(block, axis=0))

    def _add_orthogonal_part(
        self, change: int, block: FloatArray, least_norm: float = LEAST_REMAINDER
    ) -> None:
        """Add that part of a block to the columns which is orthogonal to the columns of a change.

        It is also orthogonal to the columns of the reduction. The new columns belong to the change.

        Parameters
        ----------
        change : int
            The number of the change, from 1; 0 for the structure itself.
        block : (n, k) array
            Whitened vectors.
        least_norm : float
            Singular value of the orthogonal part up to which its directions are left out.
        """
        basis_of_change = OrthonormalBasis(self.free_count, drop=SAME_DIRECTION)
        basis_of_change.vectors = self.base.vectors
        for columns, owners in zip(self.column_blocks, self.block_owners, strict=True):
            is_of_change = owners.size > 0 and owners[0] == change  # all owners of a block agree
            # unit motions of supports are left out: in whitened coordinates all supports are held
            moves_support = columns[self.free_count :].any()
            if is_of_change and not moves_support:
                basis_of_change.extend(self._whitened(columns[self.free]))
        # twice: the second pass removes what rounding left
        for _ in range(2):
            block = block - basis_of_change.vectors @ (basis_of_change.vectors.T @ block)
        # singular directions by the method of snapshots
        eigenvalues, eigenvectors = np.linalg.eigh(block.T @ block)
        is_kept = eigenvalues > least_norm**2
        directions = block @ (eigenvectors[:, is_kept] / np.sqrt(eigenvalues[is_kept]))
        columns = self.factors.unwhitened(directions)
        self.column_blocks.append(self._padded(columns))
        self.block_owners.append(np.full(columns.shape[1], change, dtype=np.int64))

    def _shapes(self, structure: ChangedStructure) -> FloatArray:
        """Return the mode shapes (n', M) of a structure on all unknowns."""
        shapes = structure.basis @ structure.mode_shapes
        count = len(shapes)
        return np.asarray(np.concatenate(self.column_blocks, axis=1)[:, :count] @ shapes)

    def _other_states(self) -> FloatArray:
        """Return the coefficients (B, T) of the stiffness terms at corners of the ranges."""
        corners = cube_corners(self.held_terms.varied)[:MOST_STATES]
        states = self.held_terms.states(corners)
        return np.array([self.held_terms.theta(state) for state in states])

    def _unit_responses(self, motion: SupportMotion, thetas: FloatArray) -> FloatArray:
        """Return the displacements (n, B) under a unit motion of a support, in B states.

        A support on a spring gets a unit force instead. `thetas` (B, T) are the coefficients of the
        T stiffness terms in each state.
        """
        if motion.spring > 0.0:
            unit_force = np.zeros((self.free_count, 1))
            unit_force[motion.unknown] = 1.0
            loads = np.tile(unit_force, len(thetas))
        else:
            coupling = np.column_stack(
                [term[self.free, [motion.unknown]].toarray() for term in self.terms.stiffness_terms]
            )
            loads = -coupling @ thetas.T
        whitened = self.factors.whitened(loads)
        solutions = solve_near(
            self.factors,
            self.held_terms.stiffness_terms,
            thetas.T,
            whitened,
            start=whitened,
            tolerance=SOLUTION_TOLERANCE,
        )
        return self.factors.unwhitened(solutions)

    def model(self) -> ChangeableModel:
        """Return the model on all columns; its errors are not measured yet."""
        whole = WholeColumns(
            np.concatenate(self.column_blocks, axis=1), np.concatenate(self.block_owners)
        )
        changes = PossibleChanges(self.mass_places, self.loss_places, self.load_changes)
        return model_on_columns(
            self.structure,
            self.reduction.model,
            self.terms,
            self.held_terms.load_factors,
            whole,
            changes,
        )

    def add_mass(self, place: MassCandidate) -> None:
        """Add the columns of a point mass: the static responses to forces at its location.

        Those to forces beside the location are added as far as they differ from these.
        """
        names = [candidate.name for candidate in self.mass_places]
        number = self._first_mass + names.index(place.name)
        self._add_orthogonal_part(number, self._unit_responses_to(place.rows))
        if place.reach > 0.0:
            rows = [place.rows_beside(*ends) for ends in place.reach * np.array(BESIDE)]
            responses = self._unit_responses_to(sparse.vstack(rows).tocsr())
            self._add_orthogonal_part(number, responses, LEAST_REMAINDER_BESIDE)

    def _unit_responses_to(self, rows: sparse.csr_array) -> FloatArray:
        """Return the static responses (n, k) to forces along rows, whitened and of unit length."""
        block = self.factors.whitened(rows[:, self.free].toarray().T)
        lengths = np.linalg.norm(block, axis=0)
        is_moved = lengths > SAME_DIRECTION * lengths.max()
        return np.asarray(block[:, is_moved] / lengths[is_moved])

    def add_loss(self, patch: LossCandidate) -> None:
        """Add the columns of a loss of stiffness: the changes of solutions and modes.

        They are the derivative for a small loss, and the differences for some large losses.
        """
        number = self._first_loss + self.loss_places.index(patch)
        forces = self._forces_of_snapshots
        snapshots = self.factors.riesz(forces)
        patch_stiffness = {
            term: matrix[self.free, self.free] for term, matrix in patch.terms.items()
        }
        lost_forces = np.zeros_like(snapshots)
        for term, matrix in patch_stiffness.items():
            lost_forces += self.held_terms.reference[term] * (matrix @ snapshots)
        changes_by_small_loss = self.factors.riesz(lost_forces)
        changes_by_large_losses = [
            self._solution_with_loss(patch_stiffness, loss, forces, start=snapshots) - snapshots
            for loss in LARGE_LOSSES
        ]
        block = np.concatenate((changes_by_small_loss, *changes_by_large_losses), axis=1)
        self._add_orthogonal_part(number, self._whitened(block), LEAST_LOSS_REMAINDER)

    @cached_property
    def _forces_of_snapshots(self) -> FloatArray:
        """Loads, outputs as loads and inertia of modes (n, k); their solutions have unit energy."""
        terms = self.held_terms
        modes = self.reduction.modal_basis
        stiffness = terms.structure.stiffness()
        mass = self.mass[self.free, self.free]
        _, shapes = eigh(
            modes.T @ (stiffness @ modes),
            modes.T @ (mass @ modes),
            subset_by_index=[0, self.reduction.model.mode_count - 1],
        )
        forces = np.concatenate((terms.loads, terms.outputs, mass @ (modes @ shapes)), axis=1)
        return np.asarray(forces / np.linalg.norm(self.factors.whitened(forces), axis=0))

    def _solution_with_loss(
        self,
        lost: dict[int, sparse.csr_array],
        loss: float,
        forces: FloatArray,
        start: FloatArray,
        tolerance: float = SNAPSHOT_TOLERANCE,
    ) -> FloatArray:
        """Return the solutions (n, k) under forces for a loss of a patch, with supports held.

        `lost` is the patch's contribution to each stiffness term; the iteration starts at the
        displacements `start` (n, k).
        """
        reference = self.held_terms.reference
        coefficients = np.array([1.0, *(-loss * reference[term] for term in lost)])
        solutions = solve_near(
            self.factors,
            (self.factors.stiffness, *lost.values()),
            np.tile(coefficients[:, np.newaxis], forces.shape[1]),
            self.factors.whitened(forces),
            start=self._whitened(start),
            tolerance=tolerance,
        )
        return self.factors.unwhitened(solutions)

    @property
    def _first_mass(self) -> int:
        """Number, from one, of the first change that is a mass."""
        return 1 + len(self.structure.support_motions)

    @property
    def _first_loss(self) -> int:
        """Number, from one, of the first change that is a loss of stiffness."""
        return self._first_mass + len(self.mass_places)

    def _middle_vector(self, model: ChangeableModel) -> FloatArray:
        """Return the inputs of a model at the midpoints of all ranges."""
        vector = model.nominal.copy()
        (middle_losses,) = self.held_terms.losses_at(0.5)
        vector[: self.held_terms.varied] = (*self.held_terms.middle, *middle_losses)
        return vector

    def _yielding_case(self, model: ChangeableModel, number: int, gain: float) -> "ChangedCase":
        """Return the model with a support that yields, beside the full solution of this case.

        `number` is the index of the support motion. The added compliance is such that the
        compliance under a load, or of a mode, grows at most by the fraction `gain`.
        """
        motion = self.structure.support_motions[number]
        reference = self.held_terms.reference
        vector = self._middle_vector(model)
        compliance = gain / float(compliance_gains(model, vector)[number].max())
        primitive = (
            InterfaceCompliance(motion.support, motion.motion, compliance)
            if motion.motion in INTERFACE_MOTIONS
            else SupportCompliance(motion.support, motion.motion, compliance)
        )
        structure = ChangedStructure(model, vector, ModelPatch((primitive,)))
        # the full model by Sherman and Morrison: the held structure, and its unit response
        direction = np.zeros((self.structure.unknowns, 1))
        response = self._unit_responses(motion, reference[np.newaxis])
        direction[self.free] = response
        if motion.spring == 0.0:
            direction[motion.unknown] = 1.0
            stiffness_times_direction = affine_product(
                self.terms.stiffness_terms, reference, direction
            )
            factor = 1.0 / (
                1.0 / compliance + float((direction.T @ stiffness_times_direction).item())
            )
        else:
            spring = float(model.springs_at(vector)[number])
            stiffness_change = 1.0 / (1.0 / spring + compliance) - spring
            factor = -stiffness_change / (
                1.0 + stiffness_change * float(response[motion.unknown, 0])
            )

        def full_solution(loads: FloatArray) -> FloatArray:
            return self._held_solution(loads) + factor * direction @ (direction.T @ loads)

        released_direction = direction if motion.spring == 0.0 else direction[:0]
        return ChangedCase(structure, full_solution, self.mass, released_direction)

    def _held_solution(self, loads: FloatArray) -> FloatArray:
        """Return the displacements (n', k) of the full model under loads, with supports held."""
        solution = np.zeros_like(loads)
        solution[self.free] = self.factors.solve(loads[self.free])
        return solution

    def _case_with_mass(
        self, model: ChangeableModel, number: int, distance: float
    ) -> "ChangedCase":
        """Return the model with a point mass, beside the full solution of this case.

        The mass lies beside the place, by `distance` times its reach along both axes.
        """
        place = self.mass_places[number]
        offset = distance * place.reach
        vector = self._middle_vector(model)
        unchanged = ChangedStructure(model, vector, ModelPatch())
        shapes = unchanged.basis @ unchanged.mode_shapes
        largest_square = float(np.sum((model.mass_rows[number] @ shapes) ** 2, axis=0).max())
        primitive = PlaceMass(place.name, LARGEST_MASS_GAIN / largest_square, offset, offset)
        structure = ChangedStructure(model, vector, ModelPatch((primitive,)))
        rows = place.rows_beside(offset, offset)
        mass = (self.mass + primitive.mass * (rows.T @ rows)).tocsr()
        return ChangedCase(structure, self._held_solution, mass)

    def _case_with_loss(self, model: ChangeableModel, number: int, loss: float) -> "ChangedCase":
        """Return the model with a loss of stiffness, beside the full solution of this case."""
        patch = self.loss_places[number]
        patch_stiffness = {
            term: matrix[self.free, self.free] for term, matrix in patch.terms.items()
        }
        primitive = RegionStiffnessLoss(patch.name, loss)
        vector = self._middle_vector(model)
        structure = ChangedStructure(model, vector, ModelPatch((primitive,)))

        basis = (
            np.concatenate(self.column_blocks, axis=1)[:, : len(structure.basis)] @ structure.basis
        )

        def full_solution(loads: FloatArray) -> FloatArray:
            solution = basis @ structure.static(basis.T @ loads)
            solution[self.free] = self._solution_with_loss(
                patch_stiffness,
                loss,
                loads[self.free],
                start=solution[self.free],
                tolerance=SOLUTION_TOLERANCE,
            )
            return solution

        return ChangedCase(structure, full_solution, self.mass)

    def error(self, model: ChangeableModel, number: int) -> float:
        """Return the largest relative error of a model under one change, at both ends of its range.

        Static outputs are compared with those of the full model, at the midpoints of all input
        ranges. The error of a frequency is its change by one step of inverse iteration with the
        full model.
        """
        return max(
            case_error(case, model, self.terms, self.held_terms, self._shapes(case.structure))
            for case in self._cases(model, number)
        )

    def _cases(self, model: ChangeableModel, number: int) -> "list[ChangedCase]":
        """Return the cases of one change, counted from zero, at both ends of its range."""
        change = 1 + number
        if change < self._first_mass:
            return [self._yielding_case(model, number, gain) for gain in GAIN_RANGE]
        if change < self._first_loss:
            place = change - self._first_mass
            distances = (0.0, DIAGONAL) if self.mass_places[place].reach > 0.0 else (0.0,)
            return [self._case_with_mass(model, place, distance) for distance in distances]
        patch = change - self._first_loss
        return [self._case_with_loss(model, patch, loss) for loss in LOSS_RANGE]
