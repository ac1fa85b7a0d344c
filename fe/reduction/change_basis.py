"""From a structure and its reduced model to one whose supports may yield.

A support that yields moves the structure by the unit responses to its motions: the displacements of
the structure when one motion of a support is prescribed and all else is held. They are added to the
basis of the reduced model (the constraint modes of Craig and Bampton 1968, AIAA Journal 6 (7),
1313-1319), with the static responses to their inertia. A change of the stiffness of the structure
changes them, so that they are computed at several states.
"""

from collections.abc import Callable
from dataclasses import fields
from typing import NamedTuple

import numpy as np
from scipy import sparse

from fe.full.subspace import OrthonormalBasis, affine_product, solve_near
from fe.runtime.arrays import FloatArray
from fe.runtime.changeable import ChangeableModel, ChangedStructure
from fe.runtime.patch import ModelPatch, SupportCompliance
from fe.runtime.reduced import ReducedModel
from fe.structure.affine import AffineStructure, SupportMotion

from .reduced_basis import Reduction
from .terms import ReductionTerms, cube_corners

LEAST_REMAINDER = 1e-4
"""Length outside the basis, relative to that of the vector, below which a direction is left out."""
SAME_DIRECTION = 1e-7
"""Directions of the structure's own bases below this relative length are left out."""
SOLUTION_TOLERANCE = 1e-8
"""Relative residual of unit responses at other states."""
MOST_STATES = 8
"""Number of states at which unit responses are computed, beside the middle one."""
INERTIA_RESPONSES = 1
"""Static responses to inertia: to that of the unit response, to that of this response, and on."""
GAIN_RANGE = (0.01, 1.0)
"""Range of compliance in which the errors are measured: the largest relative gain of compliance
under a load or in a mode."""


def with_changes(yielding: AffineStructure, reduction: Reduction) -> ChangeableModel:
    """Return the reduced model with the columns that changes of its supports need.

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
    numbers = range(len(yielding.support_motions))
    for motion in yielding.support_motions:
        columns.add_motion(motion)
    model = columns.model()
    for number in numbers:
        columns.refine(model, number)
    model = columns.model()
    errors = [columns.error(model, number) for number in numbers]
    values = {field.name: getattr(model, field.name) for field in fields(ChangeableModel)}
    return ChangeableModel(**values | {"support_errors": np.array(errors, dtype=np.float64)})


class _Columns:
    """The columns of a changeable model on the n' unknowns of the structure that yields.

    Parameters
    ----------
    yielding : AffineStructure
        The structure whose supports yield.
    reduction : Reduction
        The reduction of the same structure with its n unknowns, supports held.
    """

    def __init__(self, yielding: AffineStructure, reduction: Reduction) -> None:
        self.structure = yielding
        self.reduction = reduction
        self.held_terms = reduction.terms
        self.factors = reduction.terms.factors
        self.terms = ReductionTerms(yielding)
        self.free = reduction.terms.structure.unknowns
        masses = self._nominal_masses()
        self.mass = sum(
            (value * term for value, term in zip(masses, yielding.mass_terms, strict=True)),
            sparse.csr_array(yielding.mass_terms[0].shape),
        ).tocsr()
        base = np.concatenate((reduction.modal_basis, reduction.static_basis), axis=1)
        self.blocks = [np.pad(base, ((0, yielding.unknowns - self.free), (0, 0)))]
        self.owners = [np.zeros(base.shape[1], dtype=np.int64)]
        self.base = OrthonormalBasis(self.free, drop=SAME_DIRECTION)
        self.base.extend(self._whitened(base))

    def _nominal_masses(self) -> FloatArray:
        """Return the coefficients (1 + P,) of the mass terms at nominal masses."""
        return np.array([1.0, *self.structure.masses.values()])

    def _whitened(self, displacements: FloatArray) -> FloatArray:
        """Return displacements (n, k) in whitened coordinates, in which energy is length."""
        return self.factors.whitened(self.factors.stiffness @ displacements)

    def add_motion(self, motion: SupportMotion) -> None:
        """Add the columns of a motion of a support: unit responses, and responses to inertia."""
        number = 1 + self.structure.support_motions.index(motion)
        is_held = motion.spring == 0.0
        unit_response = self._unit_responses(motion, self.held_terms.reference[np.newaxis])
        others = self._unit_responses(motion, self._other_states()) - unit_response
        # the displacements of all unknowns when the support moves
        whole = np.zeros((self.structure.unknowns, 1))
        whole[: self.free] = unit_response
        if is_held:
            whole[motion.unknown] = 1.0
            self.blocks.append(whole)
            self.owners.append(np.array([number], dtype=np.int64))
        snapshots = [] if is_held else [unit_response]
        inertia_force = (self.mass @ whole)[: self.free]
        free_mass = self.mass[: self.free, : self.free]
        for _ in range(INERTIA_RESPONSES):
            snapshots.append(self.factors.riesz(inertia_force))
            inertia_force = free_mass @ snapshots[-1]
        directions = [self._whitened(snapshot) for snapshot in snapshots]
        directions = [vector / np.linalg.norm(vector) for vector in directions]
        # a change of the unit response counts by its part of the unit response
        scale = np.linalg.norm(self._whitened(unit_response))
        block = np.concatenate((*directions, self._whitened(others) / scale), axis=1)
        self._add_remainders(number, block)

    def refine(self, model: ChangeableModel, number: int) -> None:
        """Add the modes of the full model, by a step of inverse iteration, when one support yields.

        Parameters
        ----------
        model : ChangeableModel
            The model on the present columns.
        number : int
            Number of the motion of the support.
        """
        motion = self.structure.support_motions[number]
        for gain in GAIN_RANGE:
            case = self._yielding_case(model, number, gain)
            modes = case.full_solution(self.mass @ self._shapes(case.structure))
            if motion.spring == 0.0:
                modes = modes - modes[[motion.unknown]] * case.direction
            block = self._whitened(modes[: self.free])
            self._add_remainders(1 + number, block / np.linalg.norm(block, axis=0))

    def _add_remainders(self, number: int, block: FloatArray) -> None:
        """Add to the columns of a change what whitened vectors (n, k) have outside its columns."""
        known = OrthonormalBasis(self.free, drop=SAME_DIRECTION)
        known.vectors = self.base.vectors
        for owned, owner in zip(self.blocks, self.owners, strict=True):
            free_part = owned[: self.free]
            is_lift = owned[self.free :].any()
            if owner[:1].tolist() == [number] and not is_lift and owned.shape[1]:
                known.extend(self._whitened(free_part))
        for _ in range(2):
            block = block - known.vectors @ (known.vectors.T @ block)
        directions, lengths, _ = np.linalg.svd(block, full_matrices=False)
        kept = self.factors.unwhitened(directions[:, lengths > LEAST_REMAINDER])
        self.blocks.append(np.pad(kept, ((0, self.structure.unknowns - self.free), (0, 0))))
        self.owners.append(np.full(kept.shape[1], number, dtype=np.int64))

    def _shapes(self, structure: ChangedStructure) -> FloatArray:
        """Return the mode shapes of a structure on all unknowns (n', M)."""
        shapes = structure.modes.shapes
        count = len(shapes)
        return np.asarray(np.concatenate(self.blocks, axis=1)[:, :count] @ shapes)

    def _other_states(self) -> FloatArray:
        """Return the coefficients (B, T) of the stiffness terms at corners of the ranges."""
        corners = cube_corners(self.held_terms.varied)[:MOST_STATES]
        states = self.held_terms.states(corners)
        return np.array([self.held_terms.theta(state) for state in states])

    def _unit_responses(self, motion: SupportMotion, thetas: FloatArray) -> FloatArray:
        """Return displacements (n, B) per unit motion, or force against a spring, at B states."""
        if motion.spring > 0.0:
            unit_force = np.zeros((self.free, 1))
            unit_force[motion.unknown] = 1.0
            loads = np.tile(unit_force, len(thetas))
        else:
            coupling = np.column_stack(
                [
                    term[: self.free, [motion.unknown]].toarray()
                    for term in self.terms.stiffness_terms
                ]
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
        """Return the model on all columns, its errors not measured yet."""
        columns = np.concatenate(self.blocks, axis=1)
        terms = self.terms
        # a load that acts on held nodes alone is none of the reduced model
        factors = terms.load_factors.tolist()
        loads = [
            terms.loads[:, factors.index(row)] for row in self.held_terms.load_factors.tolist()
        ]
        outputs = np.concatenate(
            (terms.outputs.T, self.structure.acceleration_output.toarray()), axis=0
        )
        motions = self.structure.support_motions
        rows = np.array([columns[motion.unknown] for motion in motions])
        model = self.reduction.model
        return ChangeableModel(
            **{field.name: getattr(model, field.name) for field in fields(ReducedModel)},
            whole_stiffness=_projected(terms.stiffness_terms, columns),
            whole_mass=_projected(self.structure.mass_terms, columns),
            whole_load=np.array(loads) @ columns,
            whole_output=outputs @ columns,
            column_owner=np.concatenate(self.owners),
            supports=tuple(motion.support for motion in motions),
            motions=tuple(motion.motion for motion in motions),
            support_rows=rows.reshape(len(motions), columns.shape[1]),
            support_springs=np.array([motion.spring for motion in motions], dtype=np.float64),
            support_errors=np.zeros(len(motions)),
        )

    def _yielding_case(self, model: ChangeableModel, number: int, gain: float) -> "_YieldingCase":
        """Return the reduced and the full structure whose support yields, mid-range.

        Parameters
        ----------
        model : ChangeableModel
            The reduced model.
        number : int
            Number of the motion of the support.
        gain : float
            The largest relative gain of compliance under a load or in a mode.
        """
        motion = self.structure.support_motions[number]
        terms = self.held_terms
        vector = model.nominal.copy()
        (middle_losses,) = terms.losses_at(0.5)
        vector[: terms.varied] = (*terms.middle, *middle_losses)
        compliance = gain / float(model.compliance_gains(vector)[number].max())
        primitive = SupportCompliance(motion.support, motion.motion, compliance)
        structure = ChangedStructure(model, vector, ModelPatch((primitive,)))
        # the full model by Sherman and Morrison: the held structure, and its unit response
        direction = np.zeros((self.structure.unknowns, 1))
        response = self._unit_responses(motion, terms.reference[np.newaxis])
        direction[: self.free] = response
        if motion.spring == 0.0:
            direction[motion.unknown] = 1.0
            image = affine_product(self.terms.stiffness_terms, terms.reference, direction)
            factor = 1.0 / (1.0 / compliance + float((direction.T @ image).item()))
        else:
            change = 1.0 / (1.0 / motion.spring + compliance) - motion.spring
            factor = -change / (1.0 + change * float(response[motion.unknown, 0]))

        def full_solution(loads: FloatArray) -> FloatArray:
            held = np.zeros_like(loads)
            held[: self.free] = self.factors.solve(loads[: self.free])
            return np.asarray(held + factor * direction @ (direction.T @ loads))

        return _YieldingCase(structure, full_solution, direction)

    def error(self, model: ChangeableModel, number: int) -> float:
        """Return the largest relative error of a model when one support yields.

        Outputs at rest are compared with those of the full model, in the middle of all ranges. The
        error of a frequency is its change by one step of inverse iteration with the full model.
        """
        return max(
            self._error_of(model, self._yielding_case(model, number, gain)) for gain in GAIN_RANGE
        )

    def _error_of(self, model: ChangeableModel, case: "_YieldingCase") -> float:
        """Return the largest relative error in one case; see `error`."""
        structure = case.structure
        # statics
        factors = self.terms.load_factors.tolist()
        numbers = [factors.index(row) for row in self.held_terms.load_factors.tolist()]
        outputs = self.terms.outputs.T @ case.full_solution(self.terms.loads[:, numbers])
        reduced = model.whole_output[: len(outputs)] @ structure.static(model.whole_load.T)
        worst = 0.0
        for group in self.terms.groups:
            largest = np.abs(outputs[group]).max(axis=0)
            difference = np.abs(reduced[group] - outputs[group]).max(axis=0)
            is_seen = largest > 0.0
            worst = max(worst, float((difference[is_seen] / largest[is_seen]).max(initial=0.0)))
        # frequencies by the Rayleigh quotient of the improved modes
        inertia = self.mass @ self._shapes(structure)
        improved = case.full_solution(inertia)
        stiffness = np.sum(improved * inertia, axis=0)
        mass = np.sum(improved * (self.mass @ improved), axis=0)
        frequency = np.sqrt(stiffness / mass) / (2.0 * np.pi)
        frequency_errors = np.abs(structure.modes.frequency / frequency - 1.0)
        return max(worst, float(frequency_errors.max()))


class _YieldingCase(NamedTuple):
    """A structure whose support yields.

    Attributes
    ----------
    structure : ChangedStructure
        The reduced structure.
    full_solution : callable
        Returns the displacements (n', k) of the full model under loads (n', k).
    direction : (n', 1) array
        The unit response of the motion.
    """

    structure: ChangedStructure
    full_solution: Callable[[FloatArray], FloatArray]
    direction: FloatArray


def _projected(terms: tuple[sparse.csr_array, ...], columns: FloatArray) -> FloatArray:
    """Return symmetric terms (T, k, k) on columns (n, k)."""
    projected = np.array([columns.T @ (term @ columns) for term in terms])
    return np.asarray(0.5 * (projected + projected.swapaxes(1, 2)))
