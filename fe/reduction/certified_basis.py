"""The static part of a reduced model, by a greedy search with a certified error bound.

`docs/explanation/reduced_model.md` describes the method and its accuracy. Displacements and loads
are whitened, see `fe.full.subspace`.
"""

from math import ceil
from typing import NamedTuple

import numpy as np

from fe.full.subspace import (
    OrthonormalBasis,
    ProjectedBasis,
    fewest_directions,
    project_terms,
    solve_near,
)
from fe.runtime.arrays import FloatArray
from fe.runtime.errors import ReductionError
from fe.runtime.reduced import ReducedModel
from fe.runtime.reduced_results import ReducedResponse
from fe.structure.tables import StructureSettings
from reporting.progress import Stage
from reporting.words import counted

from .dual_solutions import dual_solutions
from .modal_basis import ModalReduction
from .terms import STATES_PER_ROUND, ReductionTerms, State

SEARCH_MARGIN = 0.5
"""The search continues to this fraction of the tolerance, so that the basis can be compressed."""
INSPECTED_ONE_OF = 6
"""In each round the bound is evaluated at one in this many training states, those with the largest
previous bounds; in the last round at all states."""
SOLUTION_TOLERANCE = 1e-6
"""Relative residual of full solutions."""
FIRST_SOLUTION_TOLERANCE = 1e-10
"""Relative residual of the first full solutions, from which the rounding error is measured."""
ROUNDING_FACTOR = 8.0
"""Ratio of the rounding allowance to the difference measured at the first full solutions."""
LEAST_ROUNDING = 5e-6
"""Least rounding allowance: with condition numbers of 1e10, full solutions differ by 1e-6."""
RESIDUAL_ROUNDING = 1e-7
"""Rounding allowance of the residual, per unit length of the reduced coordinates."""
BASIS_DROP = 1e-7
"""Directions shorter than this fraction of the solutions of their round are dropped."""
RESIDUAL_DROP = 1e-8
"""The same for images of the basis vectors under the stiffness terms, which span the residuals."""


class _ResidualFactors(NamedTuple):
    """Loads and images of the basis vectors in an orthonormal basis of R residuals.

    Attributes
    ----------
    load : (R, L) array
        The loads.
    stiffness : (R, T - 1, N) array
        The varied stiffness terms times the basis vectors.
    directions : (k, R) array
        The residuals' basis in the coordinates of `StaticReduction.residuals`.
    """

    load: FloatArray
    stiffness: FloatArray
    directions: FloatArray


class StaticReduction:
    """The greedy search, its bases, and the reduced model on them.

    Parameters
    ----------
    terms : ReductionTerms
        The full model, with n free unknowns.

    Attributes
    ----------
    basis : ProjectedBasis
        The static basis, of N vectors.
    snapshots : list of State
        The states of the full solutions, in the order of the search.
    """

    def __init__(self, terms: ReductionTerms, modal: ModalReduction, stage: Stage) -> None:
        self.terms = terms
        self.modal = modal
        self.stage = stage
        self.loads = terms.factors.whitened(terms.loads)
        self.outputs = terms.factors.whitened(terms.outputs)
        self.least_outputs = terms.least_outputs(self.loads, self.outputs)
        self.basis = ProjectedBasis(terms.factors, terms.stiffness_terms, drop=BASIS_DROP)
        # coordinates of loads and images in the basis of residuals
        self.residuals = OrthonormalBasis(len(self.loads), drop=RESIDUAL_DROP)
        self.residual_load = self.residuals.extend(self.loads)
        self.residual_stiffness: FloatArray = np.empty(
            (len(self.residual_load), len(terms.stiffness_terms), 0)
        )
        self.duals = dual_solutions(terms, self.outputs, stage)
        self.dual_correction = self.duals.functions @ self.residuals.vectors
        self.rounding = 0.0
        self.snapshots: list[State] = []

    def add_snapshots(self, states: list[State]) -> bool:
        """Solve the full model for all loads at several states, and extend the bases.

        Returns
        -------
        bool
            Whether the basis has grown. If not, the new solutions differ by rounding only.
        """
        thetas = [self.terms.theta(state) for state in states]
        solutions = self._solve_full(thetas)
        images = self.basis.add(solutions)
        has_grown = images.shape[2] > 0
        if not has_grown:
            return False
        self._extend_residuals(images)
        if not self.snapshots:
            self.rounding = self._measured_rounding(self._galerkin(thetas[0]), solutions)
        self.snapshots.extend(states)
        return True

    def _solve_full(self, thetas: list[FloatArray]) -> FloatArray:
        """Return the full solutions (n, S L) for L loads and S coefficient vectors."""
        count = self.loads.shape[1]
        # Solutions for the basis may be rough, since residuals bound the errors; only the first
        # ones, which measure rounding, must be accurate.
        tolerance = SOLUTION_TOLERANCE if self.snapshots else FIRST_SOLUTION_TOLERANCE
        return solve_near(
            self.terms.factors,
            self.terms.stiffness_terms,
            np.repeat(thetas, count, axis=0).T,
            np.tile(self.loads, len(thetas)),
            start=np.concatenate([self._galerkin(theta) for theta in thetas], axis=1),
            tolerance=tolerance,
        )

    def _extend_residuals(self, images: FloatArray) -> None:
        """Extend the basis of residuals by the images of new basis vectors.

        The `images` (T, n, k) are the T stiffness terms times the k new vectors. The basis of
        residuals grows from r to R vectors.
        """
        previous_size = self.residuals.vectors.shape[1]  # r
        whitened_images = self.terms.factors.whitened(np.concatenate(images, axis=1))  # (n, T k)
        coordinates = self.residuals.extend(whitened_images)  # (R, T k)
        # corrections of the outputs by the dual solutions: anchors, functions, outputs, residuals
        new_vectors = self.residuals.vectors[:, previous_size:]  # (n, R - r)
        new_correction = self.duals.functions @ new_vectors  # (A, M, O, R - r)
        self.dual_correction = np.concatenate((self.dual_correction, new_correction), axis=3)
        # loads and previous images have no component along the new vectors
        size = len(coordinates)  # R
        new_rows = (0, size - previous_size)
        unchanged = (0, 0)
        self.residual_load = np.pad(self.residual_load, (new_rows, unchanged))  # (R, L)
        previous_stiffness = np.pad(self.residual_stiffness, (new_rows, unchanged, unchanged))
        new_stiffness = coordinates.reshape(size, len(images), -1)  # (R, T, k)
        self.residual_stiffness = np.concatenate((previous_stiffness, new_stiffness), axis=2)

    def _galerkin(self, theta: FloatArray) -> FloatArray:
        """Return the Galerkin solutions (n, L) in the present basis for coefficients (T,)."""
        basis = self.basis.vectors
        stiffness = np.tensordot(theta, self.basis.stiffness, 1)
        return np.asarray(basis @ np.linalg.solve(stiffness, basis.T @ self.loads))

    def _measured_rounding(self, projected: FloatArray, solutions: FloatArray) -> float:
        """Return the relative difference of outputs between full and projected solutions (n, L)."""
        outputs = np.abs(self.outputs.T @ solutions)
        difference = np.abs(self.outputs.T @ (projected - solutions))
        relative_differences = []
        for group, least_output in zip(self.terms.groups, self.least_outputs, strict=True):
            largest_output = outputs[group].max(axis=0)
            largest_difference = difference[group].max(axis=0)
            scale = np.maximum(largest_output, least_output)
            relative_differences.append(largest_difference / scale)
        return float(np.max(relative_differences))

    def model(self, directions: FloatArray | None = None) -> ReducedModel:
        """Return the reduced model on the present basis, or on combinations of its vectors.

        Parameters
        ----------
        directions : (N, K) array, optional
            Orthonormal combinations of the N basis vectors.
        """
        terms = self.terms
        structure = terms.structure
        design = structure.design
        modal = self.modal
        # the inputs: parameters, losses, free masses and controls
        nominal_values = structure.parameters | structure.masses | structure.controls
        inputs = (
            *structure.parameters,
            *structure.regions,
            *structure.masses,
            *structure.controls,
        )
        # the static basis
        if directions is None:
            directions = np.eye(self.basis.vectors.shape[1])
        basis = self.basis.vectors @ directions
        displacements = self.basis.displacements @ directions
        residual = self._residual_factors(directions)
        return ReducedModel(
            design_hash=structure.design_hash,
            name=design.name,
            regions=structure.regions,
            parameters=tuple(structure.parameters),
            masses=tuple(structure.masses),
            controls=tuple(structure.controls),
            control_units=tuple(structure.control_units.values()),
            gauges=structure.gauges,
            displacements=structure.displacements,
            accelerations=structure.accelerations,
            nominal=np.array([nominal_values.get(name, 0.0) for name in inputs], dtype=np.float64),
            damping=np.array((design.damping.alpha, design.damping.beta)),
            validity_box=np.array([structure.ranges[name] for name in inputs], dtype=np.float64),
            stiffness_factors=terms.stiffness_factors,
            load_factors=terms.load_factors,
            dual_split=terms.splits,
            static_stiffness=project_terms(self.basis.stiffness, directions),
            static_load=self.loads.T @ basis,
            static_output=self.outputs.T @ basis,
            bound_reference=terms.reference[:-1],
            residual_load=residual.load,
            residual_stiffness=residual.stiffness,
            residual_allowance=self._residual_allowance(),
            rounding_allowance=max(ROUNDING_FACTOR * self.rounding, LEAST_ROUNDING),
            dual_correction=self.dual_correction @ residual.directions,
            dual_residual=self.duals.residual,
            dual_stiffness=self.duals.stiffness,
            dual_output=self.duals.output,
            mode_count=modal.mode_count,
            modal_stiffness=modal.stiffness,
            modal_mass=modal.mass,
            modal_load=modal.load,
            modal_output=modal.output,
            followed_shapes=modal.followed_shapes,
            cross_mass=np.stack(
                [modal.basis.T @ (term @ displacements) for term in structure.mass_terms]
            ),
        )

    def _residual_factors(self, directions: FloatArray) -> _ResidualFactors:
        """Return the loads, and the stiffness terms times the basis, in few coordinates.

        A residual of the reduced model is the load minus the stiffness times the displacement. All
        residuals lie in the span of the loads and of the images of the basis under the stiffness
        terms; the result has coordinates in an orthonormal basis of this span. The basis of the
        reduced model consists of the combinations `directions` (N, K) of the basis vectors.
        """
        # Images of the K basis vectors under each term of the stiffness
        images = self.residual_stiffness @ directions
        # A Galerkin residual is orthogonal to the basis. In whitened coordinates the reference
        # stiffness is the identity, so that the images of the basis under it are the basis itself:
        # their span is projected out of all columns.
        reference_images = np.tensordot(images, self.terms.reference, (1, 0))
        basis_directions = np.linalg.qr(reference_images)[0]
        # The order of columns is: terms that change with health, loads, other terms. A column of
        # the triangular factor is zero below its diagonal, so that this keeps the first ones short.
        _, region_numbers = self.terms.stiffness_factors[:-1].T
        is_constant = region_numbers == 0
        order = np.argsort(is_constant, kind="stable")
        first_load = directions.shape[1] * np.count_nonzero(~is_constant)
        images_and_loads = images[:, order].reshape(len(images), -1)
        images_and_loads = np.concatenate(
            (
                images_and_loads[:, :first_load],
                self.residual_load,
                images_and_loads[:, first_load:],
            ),
            axis=1,
        )
        residual_directions, factor = np.linalg.qr(
            images_and_loads - basis_directions @ (basis_directions.T @ images_and_loads)
        )
        # Separate the columns of the loads from those of the terms, and sort the terms again as in
        # the stiffness.
        load_columns = slice(first_load, first_load + self.loads.shape[1])
        term_columns = np.delete(factor, load_columns, axis=1)
        reordered_terms = term_columns.reshape(len(factor), len(order), -1)
        return _ResidualFactors(
            load=factor[:, load_columns],
            stiffness=reordered_terms[:, np.argsort(order)],
            directions=residual_directions,
        )

    def _residual_allowance(self) -> float:
        """Return a bound of the residual outside the basis of residuals, per unit coordinate.

        By Cauchy and Schwarz |sum c_q a_j d_qj| <= |c| |a| |d| with c = (1, theta), where theta is
        largest at the largest parameters and the least losses.
        """
        _, largest_parameters = self.terms.parameters.T
        least_losses, _ = self.terms.losses.T
        theta = self.terms.theta((*largest_parameters, *least_losses))
        dropped = np.sqrt((1.0 + theta @ theta) * self.residuals.dropped_square)
        return float(dropped) + RESIDUAL_ROUNDING

    def responses(self, model: ReducedModel, state: State) -> list[ReducedResponse]:
        """Return the responses of a reduced model in a state to each load alone."""
        values = model.nominal.copy()
        values[: len(state)] = state
        unit_loads = np.eye(len(self.terms.load_factors))
        return [model.static_response(values, load=load) for load in unit_loads]

    def bound(self, model: ReducedModel, state: State) -> float:
        """Return the certified relative error bound of a reduced model in a state.

        The result is the largest bound of all loads. The bound of a load is relative to the largest
        strain or displacement under the load, or to `least_outputs` if that is larger.
        """
        largest_bound = 0.0
        for number, response in enumerate(self.responses(model, state)):
            groups = [
                (outputs, bound) for outputs, bound in response.outputs_with_bounds if outputs.size
            ]
            least_outputs = self.least_outputs[:, number]
            for (outputs, bound), least in zip(groups, least_outputs, strict=True):
                largest = max(float(np.abs(outputs).max()), least)
                largest_bound = max(largest_bound, bound / largest)
        return largest_bound

    def search(self, settings: StructureSettings) -> tuple[float, ...]:
        """Run the weak greedy search, with the certified bound as surrogate of the error.

        Parameters
        ----------
        settings : StructureSettings
            The tolerance of the bound and the limit of full solutions.

        Returns
        -------
        tuple of float
            The largest bound on the training set after each round of full solutions.

        Raises
        ------
        ReductionError
            If the bound stays larger than the tolerance.
        SolutionError
            If the full model cannot be solved.
        """
        states = self.terms.training_states()
        points = np.array(states)
        target = SEARCH_MARGIN * settings.bound_tolerance
        latest_bounds = np.full(len(states), np.inf)
        history: list[float] = []
        next_states = [_most_central(states)]
        rounds = 1 + ceil((settings.most_snapshots - 1) / STATES_PER_ROUND)
        for _ in range(rounds):
            has_grown = self.add_snapshots(next_states)
            self.stage.advance(len(next_states), f"full solution {len(self.snapshots)}")
            remaining = settings.most_snapshots - len(self.snapshots)
            is_last = not (has_grown and remaining)
            inspect_all = is_last or not history
            bounds = self._training_bounds(states, latest_bounds, target, inspect_all=inspect_all)
            largest_bound = float(bounds.max())
            history.append(largest_bound)
            if is_last or largest_bound <= target:
                break
            state_count = min(STATES_PER_ROUND, remaining)
            next_states = _next_states(points, bounds, state_count, target)
        self._check_bound(history[-1], settings)
        return tuple(history)

    def _training_bounds(
        self, states: list[State], latest: FloatArray, target: float, *, inspect_all: bool
    ) -> FloatArray:
        """Return the error bounds (B,) of the present model in the training states.

        The states with the largest `latest` bounds (B,), which are updated, are evaluated first.
        Unless `inspect_all` is set, only one of `INSPECTED_ONE_OF` states is evaluated if one of
        these bounds exceeds `target`; the bound of states that are not evaluated is zero.
        """
        model = self.model()
        bounds = np.zeros(len(states))
        least_count = len(states) if inspect_all else len(states) // INSPECTED_ONE_OF
        largest_first = np.argsort(-latest, kind="stable")
        for evaluated_count, state in enumerate(largest_first):
            if evaluated_count == least_count and bounds.max() > target:
                break  # a snapshot is needed already
            bounds[state] = self.bound(model, states[state])
            latest[state] = bounds[state]
        return bounds

    def _check_bound(self, reached: float, settings: StructureSettings) -> None:
        """Raise `ReductionError` if the bound that the search reached is too large."""
        if reached <= settings.bound_tolerance:
            return
        solutions = counted(len(self.snapshots), "full solution")
        raise ReductionError(
            f"After {solutions} the error bound of {self.terms.structure.design.name} is "
            f"{reached:.2g} of the largest output, but {settings.bound_tolerance:.2g} was asked "
            f"for; raise most_solutions (now {settings.most_snapshots}) or tolerance in the table "
            "[reduction] of a structure file, or narrow the ranges of parameters and losses."
        )

    def compressed(self, tolerance: float) -> FloatArray:
        """Return the fewest combinations (N, K) of the basis with a bound within a tolerance."""
        model = self.model()
        states = self.terms.training_states()
        coordinates: list[FloatArray] = []
        for state in states:
            coordinates += [response.coordinates for response in self.responses(model, state)]

        def keeps_tolerance(directions: FloatArray) -> bool:
            smaller_model = self.model(directions)
            return all(self.bound(smaller_model, state) <= tolerance for state in states)

        return fewest_directions(np.array(coordinates).T, 2, keeps_tolerance)


def _most_central(states: list[State]) -> State:
    """Return the state closest to the mean of all states, where the search begins."""
    points = np.array(states)
    from_mean = points - points.mean(axis=0)
    squared_distance = (from_mean**2).sum(axis=1)
    most_central = int(squared_distance.argmin())
    return states[most_central]


def _next_states(states: FloatArray, bounds: FloatArray, count: int, least: float) -> list[State]:
    """Choose the states of the next full solutions: with large bounds, and far from each other.

    The first is the state with the largest bound. Each further state is the one with the largest
    product of its bound and its distance from the nearest chosen state, among those with a bound
    above `least`.

    Parameters
    ----------
    states : (B, P + K) array
        The training states.
    bounds : (B,) array
        The bound at each state.
    count : int
        The largest number of states.
    least : float
        Bound below which further states are not chosen.
    """
    # Distances are relative to the range of each input; one without a range counts as constant.
    ranges = np.ptp(states, axis=0)
    scaled_states = states / np.maximum(ranges, 1e-300)
    chosen_numbers = [int(bounds.argmax())]
    distance_from_nearest = np.full(len(states), np.inf)
    while len(chosen_numbers) < count:
        last_chosen = scaled_states[chosen_numbers[-1]]
        distance_from_last = np.linalg.norm(scaled_states - last_chosen, axis=1)
        distance_from_nearest = np.minimum(distance_from_nearest, distance_from_last)
        score = np.where(bounds > least, bounds * distance_from_nearest, 0.0)
        if not score.any():
            break
        chosen_numbers.append(int(score.argmax()))
    return [tuple(states[number].tolist()) for number in chosen_numbers]
