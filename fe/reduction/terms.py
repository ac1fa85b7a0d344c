"""Offline: a structure as its reduction sees it, where it is looked at, and how a reduced model is judged."""

import itertools
from functools import cached_property

import numpy as np
from scipy import sparse

from fe.full.factorisation import Factorisation
from fe.runtime.arrays import FloatArray
from fe.structure.affine import AffineStructure, affine_sum

MOST_GRID_REGIONS = 3
"""Regions up to which the states that are looked at form a full grid; with more, they are chosen."""
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


def loss_at(ends: FloatArray, share: FloatArray) -> FloatArray:
    """Return losses at shares of their ranges (K, 2) or (2,), by equal ratios of what is kept."""
    low, high = ends.T
    return np.asarray(1.0 - (1.0 - low) * ((1.0 - high) / (1.0 - low)) ** share)


def halton(dimensions: int, count: int) -> FloatArray:
    """Return the first points (N, D) of the Halton sequence."""
    from scipy.stats import qmc  # takes a second to load, and who has the reduced model needs no points

    return np.asarray(qmc.Halton(dimensions, scramble=False).random(count))


def corners(dimensions: int) -> FloatArray:
    """Return corners (N, D) of a unit cube: all up to four dimensions, of more those on one edge with two.

    These two are where all coordinates are 0, and 1; in the others one differs from all the others.
    """
    if dimensions <= MOST_GRID_REGIONS:
        return np.array(list(itertools.product((0.0, 1.0), repeat=dimensions)))
    alone, ends = np.eye(dimensions), np.zeros((1, dimensions))
    return np.concatenate((ends, alone, 1.0 - alone, 1.0 - ends))


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
        self.loads = np.stack([np.zeros(structure.unknowns), *columns.values()], axis=1)[:, 1:]
        self.outputs = np.asarray(outputs.toarray())
        self.groups = tuple(part for part in groups if part.stop > part.start)
        self.parameters, self.losses, self.masses = (
            np.array([structure.ranges[name] for name in names], dtype=np.float64).reshape(-1, 2)
            for names in (parameters, regions, masses)
        )
        self.varied = len(parameters) + len(regions)
        self.middle = [float(np.mean(ends)) for ends in self.parameters]
        (halves,) = self.levels(0.5)
        self.reference = self.theta((*self.middle, *halves))
        # between two anchors along each loss; with many regions there is but one
        self.splits = halves[: len(regions) if len(regions) <= MOST_GRID_REGIONS else 0]

    @cached_property
    def factors(self) -> Factorisation:
        """The factorised stiffness at the reference, whose energy norm is that of the reduction."""
        return Factorisation(affine_sum(self.reference, self.stiffness_terms))

    def theta(self, state: State) -> FloatArray:
        """Coefficients (T,) of the stiffness terms at parameters and losses."""
        values, count = np.array(state), len(self.parameters)
        factor, kept = np.append(1.0, values[:count]), np.append(1.0, 1.0 - values[count:])
        return np.asarray(factor[self.stiffness_factors[:, 0]] * kept[self.stiffness_factors[:, 1]])

    def levels(self, *shares: float) -> FloatArray:
        """Losses (B, K) at shares of all their ranges."""
        return loss_at(self.losses, np.array(shares)[:, np.newaxis])

    def anchors(self) -> list[list[FloatArray]]:
        """Coefficients (T,) where dual solutions are wanted, at each anchor; the last loss changes first.

        Around a single anchor for many regions they are the corners.
        """
        if not self.splits.size:
            return [[self.theta(state) for state in self.states(corners(self.varied))]]
        losses = itertools.product(*self.levels(0.25, 0.75).T)
        return [[self.theta((*self.middle, *own))] for own in losses]

    def states(self, shares: FloatArray) -> list[State]:
        """States at shares (B, P + K) of the ranges; a loss goes by equal ratios of what is kept."""
        first, (low, high) = len(self.parameters), np.concatenate((self.parameters, self.losses)).T
        places = low + (high - low) * shares
        places[:, first:] = loss_at(self.losses, shares[:, first:])
        return [tuple(state) for state in np.clip(places, low, high).tolist()]

    def training(self) -> list[State]:
        """States on which the greedy search looks for the largest bound: corners, and points between them."""
        count = CHOSEN_STATES if len(self.losses) <= MOST_GRID_REGIONS else CHOSEN_OF_MANY
        return self.states(np.concatenate((corners(self.varied), halton(self.varied, count))))

    def sampled_modes(self) -> list[ModalState]:
        """Corners under least and largest masses in turns, and a few states inside."""
        ends = corners(self.varied)
        turns = np.add.outer(np.arange(len(ends)), np.arange(len(self.masses))) % 2
        return self._modal_states(np.concatenate((ends, turns), axis=1), SAMPLED_INSIDE)

    def compressed_modes(self) -> list[ModalState]:
        """Corners under all least and largest masses, at most 64 of them, and states inside."""
        masses = list(itertools.product((0.0, 1.0), repeat=len(self.masses)))[:64]
        ends = itertools.product(corners(self.varied), masses)
        return self._modal_states(np.array([np.append(*pair) for pair in ends]), 4 * SAMPLED_INSIDE)

    def _modal_states(self, ends: FloatArray, count: int) -> list[ModalState]:
        """Return states at shares of all ranges and masses, and after them `count` inside."""
        shares = np.concatenate((ends, halton(ends.shape[1], 1 + count)[1:]))
        low, high = self.masses.T
        masses = low + (high - low) * shares[:, self.varied :]
        return [
            (self.theta(state), np.append(1.0, chosen))
            for state, chosen in zip(self.states(shares[:, : self.varied]), masses, strict=True)
        ]

    def least(self, loads: FloatArray, outputs: FloatArray) -> FloatArray:
        """Return the outputs (groups, L) below which a load is not seen; see `LEAST_COSINE`.

        Loads (n, L) and outputs (n, O) are those of the structure, whitened by `factors`.
        """
        controls, masses = (
            np.abs([(1.0, 1.0), *(self.structure.ranges[name] for name in names)]).max(axis=1)
            for names in (self.structure.controls, self.structure.masses)
        )
        largest = controls[self.load_factors[:, 0]] * masses[self.load_factors[:, 1]]  # coefficients
        seen, found = np.abs(outputs.T @ loads), []
        for part in self.groups:
            most = np.linalg.norm(outputs[:, part], axis=0).max() * np.linalg.norm(loads, axis=0)
            least, size = LEAST_COSINE * most, seen[part].max(axis=0)
            of_others = UNSEEN_SHARE * (size * largest).max() / largest
            found.append(np.where(size < least, np.maximum(least, of_others), least))
        return np.array(found)
