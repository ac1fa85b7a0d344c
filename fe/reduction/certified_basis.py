"""Offline: the static part of a reduced model by a certified greedy search (pyMOR), for any affine structure.

First approximate dual solutions, on which the sharpness of the error bound rests: either the solution at the
nearest of several anchors is taken, or those at a few states are combined for each state, as a reduced basis
of each output (Rozza, Huynh and Patera 2008). The method and what it reaches are in `docs/reduced_model.md`.
"""

from bisect import bisect_left
from dataclasses import replace
from math import ceil
from typing import Any

import numpy as np

from fe.full.subspace import FunctionalBasis, Norm, ProjectedBasis
from fe.runtime.arrays import FloatArray
from fe.runtime.errors import ReductionError
from fe.runtime.reduced import ReducedModel, StaticResponse
from reporting.progress import Stage

from .settings import TOGETHER
from .terms import ReductionTerms, State

DUAL_TOLERANCE, COMBINED_TOLERANCE = 0.05, 0.01
"""Relative residual of approximate dual solutions at their own states, taken alone and combined."""
DEPENDENT = 1e-3
"""Combinations of the dual solutions of an output that are shorter, relative to the longest, are left out."""
MOST_COLUMNS = 48
"""Columns of approximate dual solutions that are iterated together."""


def dual_solutions(
    terms: ReductionTerms, norm: Norm, stage: Stage
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Solve K psi = l for each output l, roughly: the norms of what that leaves are computed, not assumed.

    Parameters
    ----------
    terms : ReductionTerms
        The full model.
    norm : Norm
        Energy norm X of one stiffness.
    stage : Stage
        Told one more part, and of what.

    Returns
    -------
    products : (A or M, n, O) ndarray
        X times the functions, whitened.
    arrays : dict of str to ndarray
        `dual_residual`, `dual_stiffness` and `dual_output` of `ReducedArrays`.
    """
    states, combined = terms.dual_states()
    at_once = max(1, MOST_COLUMNS // terms.outputs.shape[1])
    start, found = norm.riesz(terms.outputs), []
    for first in range(0, len(states), at_once):
        chosen = states[first : first + at_once]
        tolerance = COMBINED_TOLERANCE if combined else DUAL_TOLERANCE
        found += terms.solved_together(norm, chosen, terms.outputs, [start] * len(chosen), tolerance)
        stage.advance(len(chosen), "dual solutions")
    solutions = np.stack(found)
    del found  # as large as they are
    duals, arrays = (_combined if combined else _nearest)(terms, norm, solutions)
    return np.stack([norm.whitened(norm.product(dual)) for dual in duals]), arrays


def _nearest(
    terms: ReductionTerms, norm: Norm, duals: FloatArray
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Take the solutions (A, n, O) at anchors alone, with the norms of their residuals elsewhere."""
    factors = []
    for dual in duals:
        *varied, constant = (np.asarray(term @ dual) for term in terms.stiffness_terms)
        functionals = np.stack((terms.outputs - constant, *varied), axis=2)
        factors.append([_factor(norm, part) for part in functionals.swapaxes(0, 1)])
    count = terms.outputs.shape[1]
    none = np.empty((count, len(terms.stiffness_terms), 0, 0))
    arrays = {"dual_stiffness": none, "dual_output": np.empty((count, 0))}
    return duals, {"dual_residual": np.array(factors), **arrays}


def _combined(
    terms: ReductionTerms, norm: Norm, solutions: FloatArray
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Make the solutions (M, n, O) at states orthonormal for each output, to be combined."""
    duals, kept = np.ascontiguousarray(solutions.transpose(2, 1, 0)), 0  # (O, n, M)
    for dual in duals:
        square, turn = np.linalg.eigh(dual.T @ norm.product(dual))
        used = np.flatnonzero(square > DEPENDENT**2 * square[-1])[::-1]
        basis = dual @ (turn[:, used] / np.sqrt(square[used]))
        dual[:, : len(used)], dual[:, len(used) :] = basis, 0.0
        kept = max(kept, len(used))
    duals = duals[:, :, :kept]
    stiffness = np.empty((len(duals), len(terms.stiffness_terms), kept, kept))
    factors = []
    for dual, output, inner in zip(duals, terms.outputs.T, stiffness, strict=True):
        images = [np.asarray(term @ dual) for term in terms.stiffness_terms]
        inner[:] = [dual.T @ image for image in images]
        factors.append(_factor(norm, np.column_stack((output, *images))))
    absent = np.asarray(~duals.any(axis=1))
    stiffness[:, -1] += absent[:, :, np.newaxis] * np.eye(kept)  # a function that is not there gets no part
    return duals.transpose(2, 1, 0), {
        "dual_residual": np.array([factors]),
        "dual_stiffness": stiffness,
        "dual_output": np.einsum("no,onm->om", terms.outputs, duals),
    }


def _factor(norm: Norm, functionals: FloatArray) -> Any:
    """Return R (k, k) with |functionals (n, k) @ c| = |R @ c| in the dual norm."""
    found = np.linalg.qr(norm.whitened(functionals), mode="r")
    if not np.isfinite(found).all():
        raise ReductionError("The dual residuals are not finite; the full model holds a value that is not.")
    return found


SEARCH_MARGIN = 0.5
"""The search goes on to this fraction of the tolerance, so that its basis can be compressed after."""
LOOKED_AT = 6
"""One of so many states is looked at in each round, where the bound was largest; all of them at the end."""
FIRST_TOLERANCE, SNAPSHOT_TOLERANCE = 1e-10, 1e-6
"""Relative residual of the first full solutions and of the others."""
ROUNDING_FACTOR, LEAST_ROUNDING = 8.0, 5e-6
"""Rounding allowance as a multiple of the difference seen at the first full solutions, and its least value:
with condition numbers of 1e10, full solutions differ by 1e-6 among themselves."""


class StaticReduction:
    """State of the greedy search: the bases that full solutions have given.

    Parameters
    ----------
    terms : ReductionTerms
        The full model.
    norm : Norm
        Energy norm at the reference of the terms.
    fixed : dict of str to anything
        What a reduced model holds beside the statics, by the names of its fields.
    modal_basis : (n, Nm) ndarray
        Its modal basis.
    stage : Stage
        Told one more part, and of what.
    """

    def __init__(
        self, terms: ReductionTerms, norm: Norm, fixed: dict[str, Any], modal_basis: FloatArray, stage: Stage
    ) -> None:
        self.terms, self.norm, self.modal_basis, self.stage = terms, norm, modal_basis, stage
        self.least = terms.least(norm)
        n, count = len(terms.loads), len(terms.stiffness_terms)
        self.basis = ProjectedBasis(norm, [terms.stiffness_terms], drop=1e-7)
        self.rounding = 0.0
        self.residual_basis = FunctionalBasis(n, norm, drop=1e-8)
        self.residual_load = self.residual_basis.extend(terms.loads)
        self.residual_stiffness = np.empty((len(self.residual_load), count, 0))
        products, duals = dual_solutions(terms, norm, stage)
        self.fixed: dict[str, Any] = fixed | duals
        self.dual_products = np.swapaxes(products, 1, 2)
        self.correction = self.dual_products @ self.residual_basis.vectors
        self.snapshots: list[State] = []

    def add_snapshots(self, states: list[State]) -> bool:
        """Solve the full model for all loads at several states and extend the bases."""
        thetas = [self.terms.theta(state) for state in states]
        # a basis vector may be rough, since errors are bounded by residuals; the first one measures rounding
        tolerance = SNAPSHOT_TOLERANCE if self.snapshots else FIRST_TOLERANCE
        starts = [self._galerkin(theta) for theta in thetas]
        solutions = self.terms.solved_together(self.norm, thetas, self.terms.loads, starts, tolerance)
        (images,) = self.basis.extend(np.concatenate(solutions, axis=1))
        if not images[0].size:
            return False  # rounding is reached; what the search reached is judged after it
        known = self.residual_basis.vectors.shape[1]
        found = self.residual_basis.extend(np.concatenate(images, axis=1))
        added = self.dual_products @ self.residual_basis.vectors[:, known:]
        self.correction = np.concatenate((self.correction, added), axis=2)
        # what was there lies in the basis that was there
        self.residual_load = _with_rows(self.residual_load, len(found))
        self.residual_stiffness = np.concatenate(
            (_with_rows(self.residual_stiffness, len(found)), found.reshape(len(found), len(images), -1)),
            axis=2,
        )
        if not self.snapshots:
            self.rounding = self._rounding(thetas[0], self.terms.outputs.T @ solutions[0])
        self.snapshots.extend(states)
        return True

    def _galerkin(self, theta: FloatArray) -> FloatArray:
        """Return the solutions (n, L) in the present basis."""
        basis, stiffness = self.basis.vectors, np.tensordot(theta, self.basis.inner[0], 1)
        return np.asarray(basis @ np.linalg.solve(stiffness, basis.T @ self.terms.loads))

    def _rounding(self, theta: FloatArray, wanted: FloatArray) -> float:
        """Return the relative difference of outputs between full solutions and the basis that holds them."""
        difference = np.abs(self.terms.outputs.T @ self._galerkin(theta) - wanted)
        return max(
            float(np.divide(largest, size, out=np.zeros_like(size), where=size > 0.0).max())
            for rows, least in zip(self.terms.groups, self.least, strict=True)
            for largest, size in (
                (difference[rows].max(axis=0), np.maximum(np.abs(wanted[rows]).max(axis=0), least)),
            )
        )

    def model(self) -> ReducedModel:
        """Return the reduced model of the present bases."""
        terms, basis, (stiffness,) = self.terms, self.basis.vectors, self.basis.inner
        # residuals in the images of the basis under the norm, then in what is orthogonal to them
        own = np.tensordot(self.residual_stiffness, terms.reference, (1, 0))
        across, images = np.linalg.qr(own)[0], self.residual_stiffness[:, :-1]
        load = self.residual_load - across @ (across.T @ self.residual_load)
        images = images - np.tensordot(across, np.tensordot(across, images, (0, 0)), 1)
        # |sum c_q a_j d_qj| <= |c| |a| |d| with c = (1, theta); plus rounding
        largest = (terms.reference + terms.farthest())[:-1]
        dropped = np.sqrt((2.0 + largest @ largest) * self.residual_basis.dropped_square)
        return ReducedModel(
            static_stiffness=0.5 * (stiffness + stiffness.transpose(0, 2, 1)),
            static_load=terms.loads.T @ basis,
            static_output=terms.outputs.T @ basis,
            bound_reference=terms.reference[:-1],
            residual_load=np.concatenate((basis.T @ terms.loads, load)),
            residual_stiffness=np.concatenate((np.moveaxis(stiffness[:-1], 1, 0), images)),
            residual_allowance=float(dropped) + 1e-7,
            rounding_allowance=max(ROUNDING_FACTOR * self.rounding, LEAST_ROUNDING),
            dual_correction=np.concatenate((self.correction @ own, self.correction), axis=2),
            cross_mass=np.stack([self.modal_basis.T @ (term @ basis) for term in terms.mass_terms]),
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
            kinds = (
                (found.strain, found.strain_error_bound),
                (found.displacement, found.displacement_error_bound),
            )
            present = [(values, error) for values, error in kinds if values.size]
            for (values, error), floor in zip(present, self.least[:, number], strict=True):
                worst = max(worst, error / max(float(np.abs(values).max()), floor))
        return worst


def greedy(
    static: StaticReduction, states: list[State], *, tolerance: float, most_snapshots: int
) -> list[float]:
    """Run the weak greedy search with the certified bound as its surrogate.

    Parameters
    ----------
    static : StaticReduction
        Takes the full solutions.
    states : list of State
        Where it is looked at.
    tolerance : float
        Relative bound wanted; the search goes on to `SEARCH_MARGIN` of it.
    most_snapshots : int
        Limit of full solutions.

    Returns
    -------
    list of float
        Largest bound before each full solution and at the end.
    """
    wanted, places = SEARCH_MARGIN * tolerance, np.array(states)
    known, history = np.full(len(states), np.inf), []
    # nothing to bound yet: begin in the middle
    chosen = [states[int(((places - places.mean(axis=0)) ** 2).sum(axis=1).argmin())]]
    for number in range(1 + ceil((most_snapshots - 1) / TOGETHER)):
        if number:
            few = len(states) // LOOKED_AT if number > 1 and static.fixed["dual_output"].size else 0
            bounds = _bounds(static, states, known, few, wanted)
            history.append(float(bounds.max()))
            if history[-1] <= wanted:
                return history
            chosen = _spread(places, bounds, min(TOGETHER, most_snapshots - len(static.snapshots)), wanted)
        if not static.add_snapshots(chosen):
            break
        static.stage.advance(len(chosen), f"full solution {len(static.snapshots)}")
    return [*history, float(_bounds(static, states, known, len(states), wanted).max())]


def _bounds(
    static: StaticReduction, states: list[State], known: FloatArray, few: int, wanted: float
) -> FloatArray:
    """Bounds of the `few` states that were worst when last looked at; of all where these are good enough."""
    present, bounds = static.model(), np.zeros(len(states))
    order, first = np.argsort(-known, kind="stable"), 0
    for count in (few, len(states)):
        for number in order[first:count]:
            bounds[number] = known[number] = static.bound(present, states[number])
        first = count
        if bounds.max() > wanted:
            break
    return bounds


def _with_rows(array: FloatArray, count: int) -> FloatArray:
    """Return an array with zeros below, so that it has so many rows."""
    return np.concatenate((array, np.zeros((count - len(array), *array.shape[1:]))))


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


def compressed(model: ReducedModel, directions: FloatArray) -> ReducedModel:
    """Return the model on fewer static basis vectors, its residuals on as few as they then need.

    Parameters
    ----------
    model : ReducedModel
        A model with N static basis vectors.
    directions : (N, K) ndarray
        Orthonormal combinations of them.

    Returns
    -------
    ReducedModel
        The Galerkin model on the combinations; its bound is as certified as before.
    """
    stiffness = directions.T @ model.static_stiffness @ directions
    stiffness = 0.5 * (stiffness + stiffness.transpose(0, 2, 1))
    # what changes with health first, the loads, then the rest: columns of the triangular factor become longer
    lasting = model.stiffness_factors[:-1, 1] == 0
    order, first = np.argsort(lasting, kind="stable"), directions.shape[1] * np.count_nonzero(~lasting)
    images = (model.residual_stiffness @ directions)[:, order].reshape(len(model.residual_load), -1)
    images = np.concatenate((images[:, :first], model.residual_load, images[:, first:]), axis=1)
    own = np.eye(len(images), len(directions)) @ directions
    orthonormal, factor = np.linalg.qr(images - own @ (own.T @ images))
    loads = slice(first, first + len(model.load_factors))
    terms = np.delete(factor, loads, axis=1).reshape(len(factor), len(order), -1)[:, np.argsort(order)]
    static_load = model.static_load @ directions
    return replace(
        model,
        static_stiffness=stiffness,
        static_load=static_load,
        static_output=model.static_output @ directions,
        residual_load=np.concatenate((static_load.T, factor[:, loads])),
        residual_stiffness=np.concatenate((np.moveaxis(stiffness[:-1], 1, 0), terms)),
        dual_correction=model.dual_correction @ np.concatenate((own, orthonormal), axis=1),
        cross_mass=model.cross_mass @ directions,
    )


def fewest_directions(
    model: ReducedModel, static: StaticReduction, states: list[State], tolerance: float
) -> FloatArray:
    """Return the fewest singular directions of the reduced solutions that keep the bound below a tolerance.

    Parameters
    ----------
    model : ReducedModel
        The model that the greedy search made.
    static : StaticReduction
        What it was made of.
    states : list of tuple
        States to look at.
    tolerance : float
        Relative bound wanted.

    Returns
    -------
    (N, K) ndarray
        Orthonormal combinations of its static basis vectors; all of them if fewer do not suffice.
    """
    solutions = []
    for state in states:
        for response in static.responses(model, state):
            solutions.append(response.coordinates / np.linalg.norm(response.coordinates))
    directions = np.linalg.svd(np.array(solutions).T, full_matrices=False)[0]

    def good(count: int) -> bool:
        smaller = compressed(model, directions[:, :count])
        return all(static.bound(smaller, state) <= tolerance for state in states)

    most = directions.shape[1]
    return directions[:, : bisect_left(range(most), True, min(2, most), key=good)]
