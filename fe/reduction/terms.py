"""The terms of a structure for its reduction, and the states in which the model is tested."""

import itertools
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import sparse

from fe.full.factorisation import Factorisation
from fe.runtime.arrays import FloatArray, IntArray
from fe.structure.affine import AffineStructure, affine_sum

MOST_GRID_REGIONS = 3
"""Largest number of damage regions for which the tested states form a full grid."""
State = tuple[float, ...]
"""Values of the parameters, then the losses of the damage regions."""

LEAST_COSINE = 1e-3
"""Least output to which errors are relative, as a fraction of the largest output that a load of the
same energy could cause."""
UNSEEN_FRACTION = 0.1
"""If no output responds to a load, its errors are relative to this fraction of the largest output
of all loads, each at its largest coefficient."""
STATES_PER_ROUND = 4
"""Full solutions in a round of the search, and states whose modes are refined together."""
INNER_MODAL_STATES = 10
"""Number of states inside the box in which the working basis of the modes is refined."""
INNER_TRAINING_STATES = 128
"""Number of states in the training set that lie inside the box, in addition to its corners."""
INNER_TRAINING_STATES_MANY_REGIONS = 1024
"""The same with more than `MOST_GRID_REGIONS` regions."""
MOST_MASS_CORNERS = 64
"""Largest number of corners of the box of masses in which modes are compressed."""


class ModalCoefficients(NamedTuple):
    """The coefficients that determine the modes.

    Attributes
    ----------
    stiffness : (T,) array
        Coefficients of the stiffness terms.
    mass : (1 + P,) array
        Coefficients of the mass terms: one, then the free masses [kg].
    """

    stiffness: FloatArray
    mass: FloatArray


def loss_at(ranges: FloatArray, fraction: FloatArray) -> FloatArray:
    """Return losses at fractions of their ranges, with geometric steps of the remaining stiffness.

    The remaining stiffness 1 - loss goes from 1 - low to 1 - high as a geometric sequence.

    Parameters
    ----------
    ranges : (K, 2) or (2,) array
        Least and largest loss.
    fraction : array
        Fractions of the ranges, 0 to 1, that broadcast against (K,).
    """
    low, high = ranges.T
    return np.asarray(1.0 - (1.0 - low) * ((1.0 - high) / (1.0 - low)) ** fraction)


def halton_points(dimensions: int, count: int) -> FloatArray:
    """Return the first points (count, dimensions) of the Halton sequence."""
    # SciPy's module takes a second to load, and a cached reduced model does not need it.
    from scipy.stats import qmc

    return np.asarray(qmc.Halton(dimensions, scramble=False).random(count))


def cube_corners(dimensions: int) -> FloatArray:
    """Return corners (N, dimensions) of a unit cube.

    These are all corners in up to `MOST_GRID_REGIONS` dimensions. In more dimensions they are the
    corner at 0, the corner at 1, and all corners that share an edge with one of these two.
    """
    if dimensions <= MOST_GRID_REGIONS:
        return np.array(list(itertools.product((0.0, 1.0), repeat=dimensions)))
    zero = np.zeros((1, dimensions))
    unit_vectors = np.eye(dimensions)
    return np.concatenate((zero, unit_vectors, 1.0 - unit_vectors, 1.0 - zero))


def _number_from_one(names: Sequence[str], name: str | None) -> int:
    """Return the number of a name, counted from one, or zero for no name."""
    return 0 if name is None else 1 + names.index(name)


def _ranges_of(structure: AffineStructure, names: Sequence[str]) -> FloatArray:
    """Return the least and the largest value (N, 2) of named quantities."""
    ranges = [structure.ranges[name] for name in names]
    return np.array(ranges, dtype=np.float64).reshape(-1, 2)


class ReductionTerms:
    """The terms of a structure, merged by their factors, with the constant stiffness term last.

    Parameters
    ----------
    structure : AffineStructure
        The full model, with n free unknowns.

    Attributes
    ----------
    stiffness_terms : tuple of csr (n, n)
        The T stiffness terms.
    stiffness_factors : (T, 2) array of int
        Parameter and damage region that each stiffness term is proportional to, counted from one;
        zero for none.
    loads : (n, L) array
        The loads, without those that are zero.
    load_factors : (L, 2) array of int
        Control and free mass that each load is proportional to, counted from one; zero for none.
    outputs : (n, O) array
        Strains of the gauges, then displacement outputs.
    groups : tuple of slice
        The outputs that are judged by the largest among them: strains, displacements.
    parameters, losses, masses : (P, 2), (K, 2), (M, 2) array
        Least and largest values.
    varied : int
        Number of parameters and losses.
    middle : list of float
        Mean of the range of each parameter.
    reference : (T,) array
        Coefficients of the stiffness terms in the middle of all ranges.
    splits : (K,) or (0,) array
        Losses that separate two anchors along each region; none if there is a single anchor.
    """

    def __init__(self, structure: AffineStructure) -> None:
        self.structure = structure
        self.parameters = _ranges_of(structure, tuple(structure.parameters))
        self.losses = _ranges_of(structure, structure.regions)
        self.masses = _ranges_of(structure, tuple(structure.masses))
        self.varied = len(self.parameters) + len(self.losses)
        self._set_stiffness_terms()
        self._set_loads()
        self._set_outputs()
        self._set_reference()

    def _set_stiffness_terms(self) -> None:
        """Set the stiffness terms, with the parameter and region of each.

        The error bound needs a constant term, which must be the last one. If there is none, a
        constant term of zeros is added.
        """
        parameters = tuple(self.structure.parameters)
        regions = self.structure.regions
        matrices = [term.matrix for term in self.structure.stiffness_terms]
        factors = [
            (_number_from_one(parameters, term.parameter), _number_from_one(regions, term.region))
            for term in self.structure.stiffness_terms
        ]
        constant = (0, 0)
        if factors[-1] != constant:
            matrices.append(sparse.csr_array(matrices[0].shape))
            factors.append(constant)
        self.stiffness_terms = tuple(matrices)
        self.stiffness_factors: IntArray = np.array(factors, dtype=np.int64)

    def _set_loads(self) -> None:
        """Set the load vectors; load terms of the same control and free mass are added up.

        A load term is proportional to a control (such as the load factor), to a free mass, to both
        or to neither. Sums that are zero are left out.
        """
        controls = tuple(self.structure.controls)
        masses = tuple(self.structure.masses)
        load_sums: dict[tuple[int, int], FloatArray] = {}
        for term in self.structure.load_terms:
            control = self.structure.loads[term.load]
            control_and_mass = (
                _number_from_one(controls, control),
                _number_from_one(masses, term.mass),
            )
            if control_and_mass in load_sums:
                load_sums[control_and_mass] = load_sums[control_and_mass] + term.vector
            else:
                load_sums[control_and_mass] = term.vector
        load_sums = {
            control_and_mass: vector
            for control_and_mass, vector in load_sums.items()
            if vector.any()
        }
        self.load_factors: IntArray = np.array(list(load_sums), dtype=np.int64).reshape(-1, 2)
        # np.stack needs an array, also if there is no load: a column of zeros is stacked and cut.
        zero_column = np.zeros(self.structure.unknowns)
        self.loads: FloatArray = np.stack([zero_column, *load_sums.values()], axis=1)[:, 1:]

    def _set_outputs(self) -> None:
        """Set the outputs, and the groups of outputs whose errors have a common scale."""
        rows = sparse.vstack((self.structure.gauge_output, self.structure.displacement_output))
        self.outputs: FloatArray = np.asarray(rows.T.toarray())
        output_count = self.outputs.shape[1]
        gauge_count = len(self.structure.gauges)
        groups = []
        if gauge_count:
            groups.append(slice(0, gauge_count))
        if output_count > gauge_count:
            groups.append(slice(gauge_count, output_count))
        self.groups = tuple(groups)

    def _set_reference(self) -> None:
        """Set the midpoints of all ranges, and the losses that separate anchors."""
        self.middle = [float(np.mean(limits)) for limits in self.parameters]
        (middle_losses,) = self.losses_at(0.5)
        self.reference = self.theta((*self.middle, *middle_losses))
        regions = len(self.losses)
        self.splits = middle_losses[: regions if regions <= MOST_GRID_REGIONS else 0]

    @cached_property
    def factors(self) -> Factorisation:
        """The factorised stiffness at the reference, whose energy norm the reduction uses."""
        return Factorisation(affine_sum(self.reference, self.stiffness_terms))

    def theta(self, state: State) -> FloatArray:
        """Return the coefficients (T,) of the stiffness terms in a state."""
        values = np.array(state)
        count = len(self.parameters)
        parameter = np.append(1.0, values[:count])
        remaining_stiffness = np.append(1.0, 1.0 - values[count:])
        parameter_numbers, region_numbers = self.stiffness_factors.T
        return np.asarray(parameter[parameter_numbers] * remaining_stiffness[region_numbers])

    def losses_at(self, *fractions: float) -> FloatArray:
        """Return losses (B, K): a row for each fraction of all regions' ranges."""
        return loss_at(self.losses, np.array(fractions)[:, np.newaxis])

    def anchors(self) -> list[list[FloatArray]]:
        """Return the anchors: groups of states in which dual solutions are computed.

        The error bound of an output needs the output's dual solution. In any state it is
        approximated by a combination of the dual solutions in the states of one anchor.

        With few regions, the range of each of K losses is halved, and each of the 2^K combinations
        of halves has an anchor of one state, in their middle. With many regions there is a single
        anchor, whose states are the corners of the box of all parameters and losses.

        Returns
        -------
        list of list of (T,) array
            For each anchor the coefficients of the T stiffness terms in its states. If there are
            several anchors, the loss of the last region changes fastest.
        """
        has_many_regions = self.splits.size == 0
        if has_many_regions:
            corner_states = self.states(cube_corners(self.varied))
            return [[self.theta(state) for state in corner_states]]
        anchors = []
        middles_of_halves = self.losses_at(0.25, 0.75).T  # (K, 2)
        for losses in itertools.product(*middles_of_halves):
            state = (*self.middle, *losses)
            anchors.append([self.theta(state)])
        return anchors

    def states(self, fractions: FloatArray) -> list[State]:
        """Return states at fractions of the ranges.

        Parameters
        ----------
        fractions : (B, P + K) array
            Fractions of the ranges of parameters and losses; for losses see `loss_at`.
        """
        first_loss = len(self.parameters)
        ranges = np.concatenate((self.parameters, self.losses))
        low, high = ranges.T
        values = low + (high - low) * fractions
        loss_fractions = fractions[:, first_loss:]
        values[:, first_loss:] = loss_at(self.losses, loss_fractions)
        # rounding must not leave the ranges
        values = np.clip(values, low, high)
        return [tuple(state) for state in values.tolist()]

    def training_states(self) -> list[State]:
        """Return the states of the greedy search: corners of the box, and points inside."""
        if len(self.losses) <= MOST_GRID_REGIONS:
            count = INNER_TRAINING_STATES
        else:
            count = INNER_TRAINING_STATES_MANY_REGIONS
        fractions = (cube_corners(self.varied), halton_points(self.varied, count))
        return self.states(np.concatenate(fractions))

    def refinement_states(self) -> list[ModalCoefficients]:
        """Return the states in which the working basis of the modes is refined.

        These are corners of the box, with least and largest masses in turn, and some states inside.
        """
        corners = cube_corners(self.varied)
        corner_numbers = np.arange(len(corners))
        mass_numbers = np.arange(len(self.masses))
        mass_fractions = np.add.outer(corner_numbers, mass_numbers) % 2
        fractions = np.concatenate((corners, mass_fractions), axis=1)
        return self._modal_states(fractions, INNER_MODAL_STATES)

    def compression_states(self) -> list[ModalCoefficients]:
        """Return the states whose modes the modal basis must represent.

        These are corners of the box with each corner of the box of masses, and some states inside.
        """
        all_mass_corners = itertools.product((0.0, 1.0), repeat=len(self.masses))
        mass_corners = list(itertools.islice(all_mass_corners, MOST_MASS_CORNERS))
        state_corners = cube_corners(self.varied)
        fractions = []
        for state_corner, mass_corner in itertools.product(state_corners, mass_corners):
            fractions.append(np.append(state_corner, mass_corner))
        return self._modal_states(np.array(fractions), 4 * INNER_MODAL_STATES)

    def _modal_states(self, fractions: FloatArray, inner_count: int) -> list[ModalCoefficients]:
        """Return states at fractions of all ranges and masses, then `inner_count` states inside."""
        # the first Halton point is the corner of zeros, which is no inner state
        inner_fractions = halton_points(fractions.shape[1], 1 + inner_count)[1:]
        fractions = np.concatenate((fractions, inner_fractions))
        state_fractions, mass_fractions = np.split(fractions, [self.varied], axis=1)
        low, high = self.masses.T
        masses = low + (high - low) * mass_fractions
        modal_states = []
        for state, kilograms in zip(self.states(state_fractions), masses, strict=True):
            mass_coefficients = np.append(1.0, kilograms)  # one for the mass that is always there
            modal_states.append(ModalCoefficients(self.theta(state), mass_coefficients))
        return modal_states

    def least_outputs(self, loads: FloatArray, outputs: FloatArray) -> FloatArray:
        """Return the least output of each group and load by which an error is divided.

        A relative error would have no meaning for an output that hardly responds. In whitened
        coordinates, an output l responds to a load f by l . f, which is at most |l| |f| (Cauchy and
        Schwarz); the least output is `LEAST_COSINE` of this. If no output of a group responds to a
        load more than that, it is at least `UNSEEN_FRACTION` of the largest response to any load.

        Parameters
        ----------
        loads : (n, L) array
            The loads, whitened by `factors`.
        outputs : (n, O) array
            The outputs, whitened by `factors`.

        Returns
        -------
        (G, L) array
            The least output of each group and load.
        """
        coefficients = self._largest_load_coefficients()
        responses = np.abs(outputs.T @ loads)
        load_norm = np.linalg.norm(loads, axis=0)
        least = []
        for group in self.groups:
            largest_output = np.linalg.norm(outputs[:, group], axis=0).max()
            floor = LEAST_COSINE * (largest_output * load_norm)
            largest_response = responses[group].max(axis=0)
            # a load that the group hardly sees is compared with the responses to all loads
            largest_of_all = (largest_response * coefficients).max()
            floor_of_unseen = np.maximum(floor, UNSEEN_FRACTION * largest_of_all / coefficients)
            is_unseen = largest_response < floor
            least.append(np.where(is_unseen, floor_of_unseen, floor))
        return np.array(least)

    def _largest_load_coefficients(self) -> FloatArray:
        """Return the largest coefficient (L,) of each load in the ranges of controls and masses."""
        constant = (1.0, 1.0)
        control_ranges = _ranges_of(self.structure, tuple(self.structure.controls))
        controls = np.abs([constant, *control_ranges]).max(axis=1)
        masses = np.abs([constant, *self.masses]).max(axis=1)
        control_numbers, mass_numbers = self.load_factors.T
        return np.asarray(controls[control_numbers] * masses[mass_numbers])
