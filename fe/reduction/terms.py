"""Offline: a structure as its reduction sees it, where it is looked at, and how a reduced model is judged."""

import itertools
from collections.abc import Iterable, Sequence

import numpy as np
from scipy import sparse

from fe.full.subspace import Norm, conjugate_gradients
from fe.runtime.arrays import FloatArray
from fe.structure.affine import AffineStructure, AffineSum

from .settings import MOST_GRID_REGIONS, remaining_levels

State = tuple[float, ...]
"""Parameters and losses."""
ModalState = tuple[FloatArray, FloatArray]
"""Coefficients of the stiffness terms (T,) and of the mass terms (1 + P,)."""

LEAST_COSINE = 1e-3
"""A load whose outputs are smaller than this part of what its energy could do to them is judged by that part:
nothing of the structure sees it there."""
UNSEEN_SHARE = 0.1
"""Where another load is seen, one that is not is judged by this part of what that does, each at its most."""
SAMPLED_INSIDE = 10
"""States inside the box at which the modes are refined."""
CHOSEN_STATES, CHOSEN_OF_MANY = 128, 1024
"""States inside the box on the training set, beside corners; of more regions than a grid would take."""


def halton(dimensions: int, count: int) -> FloatArray:
    """Return the first points (N, D) of the Halton sequence."""
    from scipy.stats import qmc  # takes a second to load, and who has the reduced model needs no points

    return np.asarray(qmc.Halton(dimensions, scramble=False).random(count))


def loss_corners(regions: int) -> list[tuple[int, ...]]:
    """Return which end of its range each loss takes, (K,) of 0 and 1, where modes are computed.

    All corners up to `MOST_GRID_REGIONS`; beyond, all healthy, all damaged, each region alone damaged, and
    each alone healthy.
    """
    if regions <= MOST_GRID_REGIONS:
        return list(itertools.product((0, 1), repeat=regions))
    alone = [tuple(int(number == chosen) for number in range(regions)) for chosen in range(regions)]
    others = [tuple(1 - end for end in corner) for corner in alone]
    return [(0,) * regions, *alone, *others, (1,) * regions]


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
        self.stiffness_terms = tuple(matrix for matrix, _ in terms)
        self.mass_terms = structure.mass_terms
        self.stiffness, self.mass = (
            AffineSum(part).matrix for part in (self.stiffness_terms, self.mass_terms)
        )
        self.loads = (
            np.stack(list(columns.values()), axis=1) if columns else np.empty((structure.unknowns, 0))
        )
        self.outputs = np.asarray(outputs.toarray())
        self.groups = tuple(part for part in groups if part.stop > part.start)
        self.parameters = [structure.ranges[name] for name in parameters]
        self.losses = [structure.ranges[name] for name in regions]
        self.masses = [structure.ranges[name] for name in masses]
        # two approximate dual solutions along each loss, or one where they are combined
        self.counts = (2 if len(regions) <= MOST_GRID_REGIONS else 1,) * len(regions)
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

    def dual_states(self) -> tuple[list[FloatArray], bool]:
        """Coefficients (T,) where dual solutions are wanted, and whether they are to be combined."""
        kept = [remaining_levels(ends, 1)[0] for ends in self.losses]
        middle, split = np.array([*(np.mean(ends) for ends in self.parameters), *kept]), len(self.parameters)
        combined = len(self.losses) > MOST_GRID_REGIONS
        if combined:
            ends = np.array([*self.parameters, *(1.0 - np.array(self.losses))])
            one_by_one = zip(np.eye(len(middle)), ends, strict=True)
            alone = [np.where(row, end, middle) for row, span in one_by_one for end in span]
            states = [middle, *alone]
        else:
            levels = itertools.product(*map(remaining_levels, self.losses, self.counts))
            states = [np.array([*middle[:split], *left]) for left in levels]
        return [self._coefficients(values[:split], values[split:]) for values in states], combined

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
        points = halton(len(self.parameters) + len(self.losses), count)
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
            (state, [ends[(number + place) % 2] for place, ends in enumerate(self.masses)])
            for number, state in enumerate(self.corners())
        ]
        return self._modal_states(at_corners, SAMPLED_INSIDE)

    def compressed_modes(self) -> list[ModalState]:
        """Corners under all least and largest masses, at most 64 of them, and states inside."""
        masses = list(itertools.islice(itertools.product(*self.masses), 64))
        return self._modal_states(itertools.product(self.corners(), masses), 4 * SAMPLED_INSIDE)

    def _modal_states(self, corners: Iterable[tuple[State, Sequence[float]]], count: int) -> list[ModalState]:
        """Return states with their masses, and after them `count` of a Halton sequence inside."""
        varied = len(self.parameters) + len(self.losses)
        points = halton(varied + len(self.masses), 1 + count)[1:]
        low, high = np.array(self.masses).reshape(-1, 2).T
        inside = zip(self.inside(points[:, :varied]), low + (high - low) * points[:, varied:], strict=True)
        return [(self.theta(state), np.array((1.0, *chosen))) for state, chosen in (*corners, *inside)]

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

    def least(self, norm: Norm) -> FloatArray:
        """Return the outputs (groups, L) below which a load is not seen; see `LEAST_COSINE`."""
        controls, masses = (
            np.abs([(1.0, 1.0), *(self.structure.ranges[name] for name in names)]).max(axis=1)
            for names in (self.structure.controls, self.structure.masses)
        )
        largest = controls[self.load_factors[:, 0]] * masses[self.load_factors[:, 1]]  # coefficients
        seen = np.abs(self.outputs.T @ norm.riesz(self.loads))
        loads, outputs = (
            np.linalg.norm(norm.whitened(columns), axis=0) for columns in (self.loads, self.outputs)
        )
        found = []
        for part in self.groups:
            least, size = LEAST_COSINE * loads * outputs[part].max(), seen[part].max(axis=0)
            of_others = UNSEEN_SHARE * (size * largest).max() / largest
            found.append(np.where(size < least, np.maximum(least, of_others), least))
        return np.array(found)

    def solved_together(
        self, norm: Norm, at: list[FloatArray], right: FloatArray, starts: list[FloatArray], tolerance: float
    ) -> list[FloatArray]:
        """Solve the full model at coefficients (T,) for the same right-hand sides (n, k); (n, k) each."""
        matrices = [self.stiffness(theta) for theta in at]
        rights, begin = (np.concatenate(part, axis=1) for part in ([right] * len(at), starts))
        solved = conjugate_gradients(matrices, norm, rights, begin, tolerance)
        return np.split(solved, len(at), axis=1)
