"""Offline: make the `ReducedModel` of a structure, as a wing is one, from its full model.

The method and what it reaches are in `docs/reduced_model.md`.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.stats import qmc

from fe.full.affine import affine_sum
from fe.full.subspace import Norm
from fe.runtime.errors import ReductionError
from fe.runtime.reduced import ReducedModel, StaticResponse
from fe.structure.affine import AffineStructure
from reporting.progress import Progress, SilentProgress
from reporting.words import counted

from .certified_basis import AffineProblem, Judgement, State, StaticReduction, greedy
from .compression import compressed, fewest_directions
from .dual_solutions import DualData, DualProblem
from .modal_basis import ModalState, eigenmodes, loss_corners, modal_basis
from .settings import (
    MOST_GRID_REGIONS,
    ModalSettings,
    StructureSettings,
    default_anchors,
    loss_splits,
    remaining_levels,
)

FloatArray = npt.NDArray[np.float64]

LEAST_COSINE = 1e-3
"""A load whose outputs are smaller than this part of what its energy could do to them is judged by that part:
nothing of the structure sees it there."""
UNSEEN_SHARE = 0.1
"""Where another load is seen, one that is not is judged by this part of what that does, each at its most."""
SAMPLED_INSIDE = 10
"""States inside the box at which the modes are refined."""
CHOSEN_STATES, CHOSEN_OF_MANY = 128, 1024
"""States inside the box on the training set, beside corners; of more regions than a grid would take."""


@dataclass(frozen=True)
class Reduction:
    """A reduced model with the bases that made it.

    Attributes
    ----------
    model : ReducedModel
        What is evaluated online.
    static_basis : (n, N) ndarray
        Static basis vectors, on the unknowns of the full model.
    modal_basis : (n, Nm) ndarray
        Modal basis vectors.
    snapshots : tuple of tuple
        Parameters and losses of the full solutions, in the order of the search.
    bound_history : tuple of float
        Largest relative bound on the training set before each round of them and at the end.
    """

    model: ReducedModel
    static_basis: FloatArray
    modal_basis: FloatArray
    snapshots: tuple[State, ...]
    bound_history: tuple[float, ...]


@dataclass(frozen=True)
class _ModalData:
    """Modal basis (n, Nm), the terms in it, and the shapes (F, Nm) that modes are followed by."""

    basis: FloatArray
    stiffness: FloatArray
    mass: FloatArray
    followed: FloatArray


class ReductionTerms:
    """What the reduction takes of a structure: terms merged by what they are times, the constant one last."""

    def __init__(self, structure: AffineStructure) -> None:
        self.structure = structure
        parameters, controls = list(structure.parameters), list(structure.controls)
        masses, regions = list(structure.masses), list(structure.regions)

        def number(names: list[str], name: str | None) -> int:
            return 0 if name is None else 1 + names.index(name)

        terms = [
            (term.matrix, (number(parameters, term.parameter), number(regions, term.region)))
            for term in structure.stiffness_terms
        ]
        if terms[-1][1] != (0, 0):  # the error bound has a constant term
            terms.append((sparse.csr_array(terms[0][0].shape), (0, 0)))
        self.stiffness_factors = np.array([factors for _, factors in terms], dtype=np.int64)
        columns: dict[tuple[int, int], FloatArray] = {}
        for load in structure.load_terms:
            place = (number(controls, structure.loads[load.load]), number(masses, load.mass))
            columns[place] = columns[place] + load.vector if place in columns else load.vector
        columns = {place: vector for place, vector in columns.items() if vector.any()}
        self.load_factors = np.array(list(columns), dtype=np.int64).reshape(-1, 2)
        outputs = sparse.vstack((structure.gauge_output, structure.displacement_output)).T
        count, gauges = outputs.shape[1], len(structure.gauges)
        groups = (slice(0, gauges), slice(gauges, count))
        self.problem = AffineProblem(
            stiffness_terms=tuple(matrix for matrix, _ in terms),
            mass_terms=structure.mass_terms,
            loads=np.stack(list(columns.values()), axis=1) if columns else np.empty((structure.unknowns, 0)),
            outputs=np.asarray(outputs.toarray()),
            groups=tuple(part for part in groups if part.stop > part.start),
            theta=self.theta,
        )
        self.parameters = [structure.ranges[name] for name in parameters]
        self.losses = [structure.ranges[name] for name in regions]
        self.masses = [structure.ranges[name] for name in masses]
        self.counts = default_anchors(len(regions))
        self.reference = self._coefficients(
            np.array([np.mean(ends) for ends in self.parameters]),
            np.array([remaining_levels(ends, 1)[0] for ends in self.losses]),
        )

    def _coefficients(self, parameters: FloatArray, kept: FloatArray) -> FloatArray:
        """Coefficients (T,) of the stiffness terms at parameters and what the regions have kept."""
        factor, left = np.append(1.0, parameters), np.append(1.0, kept)
        return np.asarray(factor[self.stiffness_factors[:, 0]] * left[self.stiffness_factors[:, 1]])

    def theta(self, state: State) -> FloatArray:
        """Coefficients (T,) of the stiffness terms at parameters and losses."""
        values, count = np.array(state), len(self.parameters)
        return self._coefficients(values[:count], 1.0 - values[count:])

    def duals(self, problem: DualProblem) -> DualData:
        """Dual solutions, at parameters and what the regions have kept."""
        split, kept = len(self.parameters), [remaining_levels(ends, 1)[0] for ends in self.losses]
        middle = np.array([*(np.mean(ends) for ends in self.parameters), *kept])
        ends = np.array([*self.parameters, *(1.0 - np.array(self.losses))])
        return problem.solved(
            lambda values: self._coefficients(values[:split], values[split:]), middle, ends, self.counts
        )

    def corners(self) -> list[State]:
        """Corners of parameters and losses: all of a few, else those of `loss_corners`."""
        box = (*self.parameters, *self.losses)
        return [
            tuple(float(span[end]) for span, end in zip(box, ends, strict=True))
            for ends in loss_corners(len(box))
        ]

    def training(self) -> list[State]:
        """States on which the greedy search looks for the largest bound: corners, and points between them."""
        count = CHOSEN_STATES if len(self.losses) <= MOST_GRID_REGIONS else CHOSEN_OF_MANY
        points = qmc.Halton(len(self.parameters) + len(self.losses), scramble=False).random(count)
        return [*self.corners(), *self.inside(points)]

    def inside(self, shares: FloatArray) -> list[State]:
        """States at shares (B, P + K) of the ranges; a loss goes by equal ratios of what is kept."""
        columns = [
            low + (high - low) * share for (low, high), share in zip(self.parameters, shares.T, strict=False)
        ] + [
            1.0 - (1.0 - low) * ((1.0 - high) / (1.0 - low)) ** share
            for (low, high), share in zip(self.losses, shares.T[len(self.parameters) :], strict=True)
        ]
        return [tuple(state) for state in np.column_stack(columns).tolist()]

    def sampled_modes(self) -> list[ModalState]:
        """Corners under least and largest masses in turns, and a few states inside."""
        at_corners = [
            (
                self.theta(state),
                np.array((1.0, *(ends[(number + place) % 2] for place, ends in enumerate(self.masses)))),
            )
            for number, state in enumerate(self.corners())
        ]
        return [*at_corners, *self._modes_inside(SAMPLED_INSIDE)]

    def compressed_modes(self) -> list[ModalState]:
        """Corners under all least and largest masses, at most 64 of them, and states inside."""
        masses = list(itertools.islice(itertools.product(*self.masses), 64))
        at_corners = [
            (self.theta(state), np.array((1.0, *chosen))) for state in self.corners() for chosen in masses
        ]
        return [*at_corners, *self._modes_inside(4 * SAMPLED_INSIDE)]

    def _modes_inside(self, count: int) -> list[ModalState]:
        """States of a Halton sequence, masses among them."""
        varied = len(self.parameters) + len(self.losses)
        points = qmc.Halton(varied + len(self.masses), scramble=False).random(1 + count)[1:]
        low, high = np.array(self.masses).reshape(-1, 2).T
        masses = low + (high - low) * points[:, varied:]
        return [
            (self.theta(state), np.array((1.0, *chosen)))
            for state, chosen in zip(self.inside(points[:, :varied]), masses, strict=True)
        ]

    def largest_loads(self) -> FloatArray:
        """Largest coefficient (L,) of each load."""
        controls, masses = (
            np.abs([(1.0, 1.0), *(self.structure.ranges[name] for name in names)]).max(axis=1)
            for names in (self.structure.controls, self.structure.masses)
        )
        return np.asarray(controls[self.load_factors[:, 0]] * masses[self.load_factors[:, 1]])

    def farthest(self) -> FloatArray:
        """Largest distance (T,) of each coefficient from its reference."""
        factor = np.array([(1.0, 1.0), *self.parameters])[self.stiffness_factors[:, 0]]
        kept = 1.0 - np.array([(0.0, 0.0), *self.losses])[self.stiffness_factors[:, 1]]
        ends = (factor[:, :, np.newaxis] * kept[:, np.newaxis, :]).reshape(len(factor), -1)
        return np.asarray(np.abs(ends - self.reference[:, np.newaxis]).max(axis=1))

    @property
    def nominal(self) -> ModalState:
        """The structure as it is nominally, healthy."""
        parameters = np.array([*self.structure.parameters.values()])
        masses = np.array((1.0, *self.structure.masses.values()))
        return self._coefficients(parameters, np.ones(len(self.losses))), masses

    @property
    def middle_mass(self) -> FloatArray:
        """Coefficients (1 + P,) of the mass terms in the middle."""
        return np.array([1.0, *(np.mean(span) for span in self.masses)])


def reduce_structure(
    structure: AffineStructure,
    name: str,
    settings: StructureSettings | None = None,
    progress: Progress | None = None,
    followed_load: int | None = None,
) -> Reduction:
    """Make the reduced model of a structure.

    Parameters
    ----------
    structure : AffineStructure
        The full model.
    name : str
        What the structure is called.
    settings : StructureSettings, optional
        How well it is to hold.
    progress : Progress, optional
        Where to report.
    followed_load : int, optional
        Number of the load by which two modes are followed: those that contribute most to its compliance.

    Raises
    ------
    ReductionError
        If there is nothing to reduce it for, or the accuracy asked for is not reached.
    SolutionError
        If the full model cannot be solved.
    """
    settings, progress = settings or StructureSettings(), progress or SilentProgress()
    terms = ReductionTerms(structure)
    _check(terms, name)
    with progress.stage("Factorising the structure"):
        norm = Norm(affine_sum(terms.reference, terms.problem.stiffness_terms))
    with progress.stage("Reducing the modes") as stage:
        modes = _modes(terms, norm, name, settings.modal, stage.advance, followed_load)
    with progress.stage("Reducing the statics") as stage:
        static = StaticReduction(
            terms.problem,
            norm,
            terms.reference[:-1],
            terms.duals,
            terms.farthest()[:-1],
            stage.advance,
            least := _least(terms, norm),
        )
        judgement, states = judgement_of(terms, least), terms.training()
        history = greedy(
            static,
            lambda: _model(static, terms, name, modes, settings.modal.mode_count),
            judgement,
            states,
            tolerance=settings.bound_tolerance,
            most_snapshots=settings.most_snapshots,
        )
    if history[-1] > settings.bound_tolerance:
        raise ReductionError(
            f"After {counted(len(static.snapshots), 'full solution')} the error bound of {name} is "
            f"{history[-1]:.2g} of the largest output, but {settings.bound_tolerance:.2g} was asked for; "
            f"raise most_solutions (now {settings.most_snapshots}) or tolerance in the table [reduction] of "
            "a structure file, or narrow the ranges of parameters and losses."
        )
    model = _model(static, terms, name, modes, settings.modal.mode_count)
    directions = fewest_directions(model, judgement, states, settings.bound_tolerance)
    return Reduction(
        compressed(model, directions),
        static.basis.vectors @ directions,
        modes.basis,
        tuple(static.snapshots),
        tuple(history),
    )


def _modes(
    terms: ReductionTerms,
    norm: Norm,
    name: str,
    settings: ModalSettings,
    advance: Callable[[], object],
    followed_load: int | None,
) -> _ModalData:
    """Return the modal basis with the terms in it; raises `ReductionError`."""
    sampled, compression = terms.sampled_modes(), terms.compressed_modes()
    try:
        basis, stiffness, mass = modal_basis(
            terms.problem, norm, terms.middle_mass, sampled, compression, settings, advance
        )
    except np.linalg.LinAlgError:
        raise ReductionError(
            f"The masses of {name} move in fewer ways than the {settings.mode_count + 2} modes that are "
            "looked for; give its materials a density."
        ) from None
    if followed_load is None:
        return _ModalData(basis, stiffness, mass, np.empty((0, basis.shape[1])))
    square, shapes = eigenmodes(stiffness, mass, *terms.nominal, settings.mode_count)
    contribution = (terms.problem.loads[:, followed_load] @ basis @ shapes) ** 2 / square
    return _ModalData(basis, stiffness, mass, shapes[:, np.sort(np.argsort(contribution)[-2:])].T)


def _check(terms: ReductionTerms, name: str) -> None:
    """Refuse a structure that a twin can do nothing with; raises `ReductionError`."""
    structure = terms.structure
    for missing, what in (
        (not structure.regions, "[[damage]]: a twin needs a region that may lose stiffness"),
        (not len(terms.load_factors), "[[load]] that does anything: nothing would strain it"),
        (not terms.problem.groups, "[[gauge]] and no [[displacement]]: nothing could be observed"),
    ):
        if missing:
            raise ReductionError(f"The structure {name} has no {what}.")
    if not structure.mass().diagonal().any():
        raise ReductionError(
            f"The structure {name} has no mass, hence no modes; give its materials a density."
        )


def _model(
    static: StaticReduction,
    terms: ReductionTerms,
    name: str,
    modes: _ModalData,
    mode_count: int,
) -> ReducedModel:
    """Return the reduced model of the present bases."""
    structure, problem, basis = terms.structure, terms.problem, modes.basis
    chosen = (*structure.parameters, *structure.regions, *structure.masses, *structure.controls)
    nominal = structure.parameters | structure.masses | structure.controls
    return ReducedModel(
        design_hash=structure.design_hash,
        name=name,
        region_names=" ".join(structure.regions),
        parameter_names=" ".join(structure.parameters),
        mass_names=" ".join(structure.masses),
        control_names=" ".join(structure.controls),
        control_units=" ".join(structure.control_units[name] for name in structure.controls),
        gauge_names=" ".join(structure.gauges),
        displacement_names=" ".join(structure.displacements),
        acceleration_names=" ".join(structure.accelerations),
        validity_box=np.array([structure.ranges[name] for name in chosen], dtype=np.float64),
        nominal=np.array([nominal.get(name, 0.0) for name in chosen], dtype=np.float64),
        damping=np.array((structure.damping_alpha, structure.damping_beta)),
        stiffness_factors=terms.stiffness_factors,
        load_factors=terms.load_factors,
        dual_counts=np.array(terms.counts, dtype=np.int64),
        dual_split=np.concatenate(
            [loss_splits(ends, count) for ends, count in zip(terms.losses, terms.counts, strict=True)]
        ),
        modal_stiffness=modes.stiffness,
        modal_mass=modes.mass,
        modal_load=problem.loads.T @ basis,
        modal_output=np.concatenate((problem.outputs.T @ basis, structure.acceleration_output @ basis)),
        cross_mass=static.cross_mass(basis),
        mode_count=mode_count,
        followed_shapes=modes.followed,
        **static.arrays(),
    )


def _least(terms: ReductionTerms, norm: Norm) -> FloatArray:
    """Return the outputs (groups, L) below which a load is not seen; see `LEAST_COSINE`."""
    problem, largest = terms.problem, terms.largest_loads()
    solutions = norm.riesz(problem.loads)
    loads = np.linalg.norm(norm.whitened(problem.loads), axis=0)
    outputs = np.linalg.norm(norm.whitened(problem.outputs), axis=0)
    seen = np.abs(problem.outputs.T @ solutions)
    found = []
    for part in problem.groups:
        least, size = LEAST_COSINE * loads * outputs[part].max(), seen[part].max(axis=0)
        of_others = UNSEEN_SHARE * (size * largest).max() / largest
        found.append(np.where(size < least, np.maximum(least, of_others), least))
    return np.array(found)


def judgement_of(terms: ReductionTerms, least: FloatArray) -> Judgement:
    """Return how the model is judged: each load alone, gauges and displacements each by their largest.

    Outputs (groups, L) that are smaller than `least` are judged by it.
    """
    unit = np.eye(len(terms.load_factors))

    def responses(model: ReducedModel, state: State) -> list[StaticResponse]:
        chosen = model.nominal.copy()
        chosen[: len(state)] = state
        return [model.static_response(chosen, load=load) for load in unit]

    def bound(model: ReducedModel, state: State) -> float:
        worst = 0.0
        for number, found in enumerate(responses(model, state)):
            kinds = (
                (found.strain, found.strain_error_bound),
                (found.displacement, found.displacement_error_bound),
            )
            present = [(values, error) for values, error in kinds if values.size]
            for (values, error), floor in zip(present, least[:, number], strict=True):
                worst = max(worst, error / max(float(np.abs(values).max()), floor))
        return worst

    return Judgement(lambda model, state: [found.coordinates for found in responses(model, state)], bound)
