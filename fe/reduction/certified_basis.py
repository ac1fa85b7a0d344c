"""Offline: the static part of a reduced model by a certified greedy search (pyMOR), for any affine structure.

First approximate dual solutions, on which the sharpness of the error bound rests: at each anchor a few of
each output span what is combined for each state, a reduced basis of the output (Rozza, Huynh and Patera
2008). The method and what it reaches are in `docs/reduced_model.md`. Displacements and loads are whitened,
which `fe.full.subspace` explains.
"""

from bisect import bisect_left
from collections.abc import Callable
from math import ceil
from typing import Any

import numpy as np

from fe.full.subspace import OrthonormalBasis, ProjectedBasis, solved_near, turned
from fe.runtime.arrays import FloatArray
from fe.runtime.errors import ReductionError
from fe.runtime.reduced import ReducedModel, StaticResponse
from fe.sentences import said
from fe.structure.tables import StructureSettings
from reporting.progress import Stage
from reporting.words import counted

from .terms import ReductionTerms, State

OUTPUTS_TOGETHER = 8
"""Outputs whose dual solutions are judged at once."""
TOGETHER = 4
"""Full solutions of the search, and states whose modes are refined, at once."""
DUAL_TOLERANCE = 0.01
"""Relative residual of approximate dual solutions at their own states."""
LEAST_DUAL = 1e-5
"""What rounding may leave of an output beside the residual of its dual solution, relative to it."""
DEPENDENT = 1e-3
"""Combinations of the dual solutions of an output that are shorter, relative to the longest, are left out."""
SEARCH_MARGIN = 0.5
"""The search goes on to this fraction of the tolerance, so that its basis can be compressed after."""
LOOKED_AT = 6
"""One of so many states is looked at in each round, where the bound was largest; all of them at the end."""
FIRST_TOLERANCE, SNAPSHOT_TOLERANCE = 1e-10, 1e-6
"""Relative residual of the first full solutions and of the others."""
ROUNDING_FACTOR, LEAST_ROUNDING = 8.0, 5e-6
"""Rounding allowance as a multiple of the difference seen at the first full solutions, and its least value:
with condition numbers of 1e10, full solutions differ by 1e-6 among themselves."""


def fewest_directions(snapshots: FloatArray, least: int, good: Callable[[FloatArray], bool]) -> FloatArray:
    """Return the fewest singular directions (N, K) of snapshots (N, S), at their unit lengths, that are good.

    They are taken to become better with their number, from `least` on; all of them if fewer do not suffice.
    """
    unit = snapshots / np.linalg.norm(snapshots, axis=0)
    directions, singular, _ = np.linalg.svd(unit, full_matrices=False)
    most = int(np.sum(singular > 1e-7 * singular[0]))
    number = bisect_left(range(most), True, min(least, most), key=lambda count: good(directions[:, :count]))
    return np.asarray(directions[:, :number])


def dual_solutions(
    terms: ReductionTerms, outputs: FloatArray, stage: Stage
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Solve K psi = l for each output l, roughly: the norms of what that leaves are computed, not assumed.

    Parameters
    ----------
    terms : ReductionTerms
        The full model.
    outputs : (n, O) ndarray
        Its outputs.
    stage : Stage
        Told one more part, and of what.

    Returns
    -------
    functions : (A, M, O, n) ndarray
        What the solutions at each anchor span, orthonormal for each output; zero where that is less.
    arrays : dict of str to ndarray
        `dual_residual`, `dual_stiffness` and `dual_output` of `ReducedArrays`.
    """
    factors, (size, count), functions = terms.factors, outputs.shape, []
    residual, stiffness = [], []
    for anchor in terms.anchors():
        solutions = []
        for theta in anchor:
            system = terms.stiffness_terms, np.tile(theta[:, np.newaxis], count)
            solutions.append(solved_near(factors, *system, outputs, outputs, DUAL_TOLERANCE))
            stage.advance(1, "dual solutions")
        own, lengths, _ = np.linalg.svd(np.stack(solutions, axis=2).swapaxes(0, 1), full_matrices=False)
        own *= (lengths > DEPENDENT * lengths[:, :1])[:, np.newaxis]
        functions.append(own.transpose(2, 0, 1))
        moved = factors.unwhitened(own.swapaxes(0, 1).reshape(size, -1)).reshape(size, count, -1)
        for few in np.array_split(np.arange(count), ceil(count / OUTPUTS_TOGETHER)):
            flat = moved[:, few].reshape(size, -1)
            images = np.stack([(term @ flat).reshape(size, len(few), -1) for term in terms.stiffness_terms])
            forces = factors.whitened(np.moveaxis(images, 0, 2).reshape(size, -1))
            for output, inner, force in zip(
                outputs[:, few].T,
                np.einsum("nom,tnok->otmk", moved[:, few], images, optimize=True),
                forces.reshape(size, len(few), -1).swapaxes(0, 1),
                strict=True,
            ):
                # a function that is not there gets no part
                inner[-1] += np.diag(np.diagonal(inner.sum(axis=0)) == 0.0)
                stiffness.append(inner)
                forced = np.column_stack((output, force))
                rounded = LEAST_DUAL * np.linalg.norm(output) * np.eye(1, forced.shape[1])
                residual.append(np.concatenate((np.linalg.qr(forced, mode="r"), rounded)))
    duals = np.array(functions)
    inner, norms = (
        np.array(part).reshape(len(duals), count, *np.shape(part)[1:]) for part in (stiffness, residual)
    )
    of_output = np.einsum("no,amon->aom", outputs, duals)
    return duals, {"dual_residual": norms, "dual_stiffness": inner, "dual_output": of_output}


class StaticReduction:
    """State of the greedy search: the bases that full solutions have given.

    Parameters
    ----------
    terms : ReductionTerms
        The full model.
    fixed : dict of str to anything
        What a reduced model holds beside the statics, by the names of its fields.
    modal_basis : (n, Nm) ndarray
        Its modal basis.
    stage : Stage
        Told one more part, and of what.
    """

    def __init__(
        self, terms: ReductionTerms, fixed: dict[str, Any], modal_basis: FloatArray, stage: Stage
    ) -> None:
        self.terms, self.modal_basis, self.stage = terms, modal_basis, stage
        self.loads, self.outputs = (terms.factors.whitened(own) for own in (terms.loads, terms.outputs))
        self.least = terms.least(self.loads, self.outputs)
        self.basis = ProjectedBasis(terms.factors, terms.stiffness_terms, drop=1e-7)
        self.residuals = OrthonormalBasis(len(self.loads), drop=1e-8)
        self.residual_load = self.residuals.extend(self.loads)
        self.residual_stiffness = np.empty((len(self.residual_load), len(terms.stiffness_terms), 0))
        self.duals, arrays = dual_solutions(terms, self.outputs, stage)
        self.correction = self.duals @ self.residuals.vectors
        self.fixed = fixed | arrays
        self.rounding, self.snapshots = 0.0, list[State]()

    def add_snapshots(self, states: list[State]) -> bool:
        """Solve the full model for all loads at several states and extend the bases."""
        terms, loads = self.terms, self.loads.shape[1]
        thetas = [terms.theta(state) for state in states]
        # a basis vector may be rough, since errors are bounded by residuals; the first one measures rounding
        tolerance = SNAPSHOT_TOLERANCE if self.snapshots else FIRST_TOLERANCE
        right, coefficients = np.tile(self.loads, len(states)), np.repeat(thetas, loads, axis=0).T
        start = np.concatenate([self._galerkin(theta) for theta in thetas], axis=1)
        solutions = solved_near(terms.factors, terms.stiffness_terms, coefficients, right, start, tolerance)
        (images,) = self.basis.add(solutions)
        if not images.size:
            return False  # rounding is reached; what the search reached is judged after it
        known = self.residuals.vectors.shape[1]
        found = self.residuals.extend(terms.factors.whitened(np.concatenate(images, axis=1)))
        added = self.duals @ self.residuals.vectors[:, known:]
        self.correction = np.concatenate((self.correction, added), axis=3)
        # what was there lies in the basis that was there
        rows = (0, len(found) - known)
        self.residual_load = np.pad(self.residual_load, (rows, (0, 0)))
        before, new = np.pad(self.residual_stiffness, (rows, (0, 0), (0, 0))), (len(found), len(images), -1)
        self.residual_stiffness = np.concatenate((before, found.reshape(new)), axis=2)
        if not self.snapshots:
            self.rounding = self._rounding(self._galerkin(thetas[0]), solutions)
        self.snapshots.extend(states)
        return True

    def _galerkin(self, theta: FloatArray) -> FloatArray:
        """Return the solutions (n, L) in the present basis."""
        basis, stiffness = self.basis.vectors, np.tensordot(theta, self.basis.inner[0], 1)
        return np.asarray(basis @ np.linalg.solve(stiffness, basis.T @ self.loads))

    def _rounding(self, found: FloatArray, solutions: FloatArray) -> float:
        """Return the relative difference of outputs between full solutions and those of their basis."""
        wanted = np.abs(self.outputs.T @ solutions)
        difference = np.abs(self.outputs.T @ (found - solutions))
        shares = [
            difference[rows].max(axis=0) / np.maximum(wanted[rows].max(axis=0), least)
            for rows, least in zip(self.terms.groups, self.least, strict=True)
        ]
        return float(np.max(shares))

    def model(self, directions: FloatArray | None = None) -> ReducedModel:
        """Return the reduced model of the present basis, or of combinations of it.

        Parameters
        ----------
        directions : (N, K) ndarray, optional
            Orthonormal combinations of the N basis vectors.
        """
        terms, rounding = self.terms, ROUNDING_FACTOR * self.rounding
        turn = np.eye(self.basis.vectors.shape[1]) if directions is None else directions
        basis, images = self.basis.vectors @ turn, self.residual_stiffness @ turn
        # along the images of the basis under the norm a solution leaves nothing
        own = np.linalg.qr(np.tensordot(images, terms.reference, (1, 0)))[0]
        # what changes with health first, loads, then the rest: columns of the triangular factor become longer
        lasting = terms.stiffness_factors[:-1, 1] == 0
        order, first = np.argsort(lasting, kind="stable"), turn.shape[1] * np.count_nonzero(~lasting)
        columns = images[:, order].reshape(len(images), -1)
        columns = np.concatenate((columns[:, :first], self.residual_load, columns[:, first:]), axis=1)
        across, factor = np.linalg.qr(columns - own @ (own.T @ columns))
        loads = slice(first, first + self.loads.shape[1])
        changes = np.delete(factor, loads, axis=1).reshape(len(factor), len(order), -1)
        # |sum c_q a_j d_qj| <= |c| |a| |d| with c = (1, theta); plus rounding
        high, low = [ends[1] for ends in terms.parameters], [ends[0] for ends in terms.losses]
        largest = terms.theta((*high, *low))
        dropped = np.sqrt((1.0 + largest @ largest) * self.residuals.dropped_square)
        moved = self.basis.displacements @ turn
        return ReducedModel(
            static_stiffness=turned(self.basis.inner[0], turn),
            static_load=self.loads.T @ basis,
            static_output=self.outputs.T @ basis,
            bound_reference=terms.reference[:-1],
            residual_load=factor[:, loads],
            residual_stiffness=changes[:, np.argsort(order)],
            residual_allowance=float(dropped) + 1e-7,
            rounding_allowance=max(rounding, LEAST_ROUNDING),
            dual_correction=self.correction @ across,
            cross_mass=np.stack([self.modal_basis.T @ (term @ moved) for term in terms.structure.mass_terms]),
            **self.fixed,
        )

    def responses(self, model: ReducedModel, state: State) -> list[StaticResponse]:
        """Return the responses of a reduced model at a state to each load alone."""
        chosen = model.nominal.copy()
        chosen[: len(state)] = state
        return [model.static_response(chosen, load=load) for load in np.eye(len(self.terms.load_factors))]

    def bound(self, model: ReducedModel, state: State) -> float:
        """Return the certified bound of a model of these bases at a state.

        It is that of the load where it is largest, by the largest gauge or displacement, or by `least`.
        """
        worst = 0.0
        for number, found in enumerate(self.responses(model, state)):
            present = [(values, error) for values, error in found.bounded if values.size]
            for (values, error), floor in zip(present, self.least[:, number], strict=True):
                worst = max(worst, error / max(float(np.abs(values).max()), floor))
        return worst

    def search(self, settings: StructureSettings) -> tuple[float, ...]:
        """Run the weak greedy search with the certified bound as its surrogate.

        Returns
        -------
        tuple of float
            Largest bound on the training set before each round of full solutions and at the end.

        Raises
        ------
        ReductionError
            If the bound stays too large.
        """
        states, wanted = self.terms.training(), SEARCH_MARGIN * settings.bound_tolerance
        places, history = np.array(states), list[float]()
        known = np.full(len(states), np.inf)
        # nothing to bound yet: begin in the middle
        chosen = [states[int(((places - places.mean(axis=0)) ** 2).sum(axis=1).argmin())]]
        for _ in range(1 + ceil((settings.most_snapshots - 1) / TOGETHER)):
            grown, left = self.add_snapshots(chosen), settings.most_snapshots - len(self.snapshots)
            self.stage.advance(len(chosen), f"full solution {len(self.snapshots)}")
            last = not (grown and left)
            model, bounds = self.model(), np.zeros(len(states))
            few = len(states) // LOOKED_AT if history and not last else len(states)
            for place, number in enumerate(np.argsort(-known, kind="stable")):
                if place == few and bounds.max() > wanted:
                    break
                bounds[number] = known[number] = self.bound(model, states[number])
            history.append(float(bounds.max()))
            if history[-1] <= wanted or last:
                break
            chosen = _spread(places, bounds, min(TOGETHER, left), wanted)
        if history[-1] > settings.bound_tolerance:
            made, design = counted(len(self.snapshots), "full solution"), self.terms.structure.design
            why = {"made": made, "design": design, "reached": history[-1], "settings": settings}
            raise ReductionError(said("reduction.bound", **why))
        return tuple(history)

    def compressed(self, tolerance: float) -> FloatArray:
        """Return the fewest combinations (N, K) of the basis whose bound keeps a tolerance."""
        model, states = self.model(), self.terms.training()
        solutions = [found.coordinates for state in states for found in self.responses(model, state)]

        def good(directions: FloatArray) -> bool:
            smaller = self.model(directions)
            return all(self.bound(smaller, state) <= tolerance for state in states)

        return fewest_directions(np.array(solutions).T, 2, good)


def _spread(states: FloatArray, bounds: FloatArray, count: int, least: float) -> list[State]:
    """Return the worst state, then those above `least` by bound times distance from all that are chosen."""
    places = states / np.maximum(np.ptp(states, axis=0), 1e-300)
    chosen = [int(bounds.argmax())]
    distance = np.full(len(states), np.inf)
    while len(chosen) < count:
        distance = np.minimum(distance, np.linalg.norm(places - places[chosen[-1]], axis=1))
        score = np.where(bounds > least, bounds * distance, 0.0)
        if not score.any():
            break
        chosen.append(int(score.argmax()))
    return [tuple(states[number].tolist()) for number in chosen]
