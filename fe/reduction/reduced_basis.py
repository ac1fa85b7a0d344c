"""Offline: make the `ReducedModel` of a structure, as a wing is one, and measure its errors.

First a small basis in which the first eigenmodes are accurate for every stiffness and mass: a working basis
is grown by Davidson corrections until the modes of sampled states have small residuals in it; then the modes
of many states, computed in the working basis, are compressed by singular values. The method and what it
reaches are in `docs/reduced_model.md`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import eigh

from fe.full.factorisation import most_moved
from fe.full.subspace import ProjectedBasis, affine_product, turned
from fe.runtime.arrays import FloatArray
from fe.runtime.errors import ReductionError
from fe.runtime.reduced import ReducedModel
from fe.sentences import said
from fe.structure.affine import AffineStructure, natural_frequencies, static_response
from fe.structure.tables import StructureSettings
from reporting.progress import Progress, Stage, reporter

from .certified_basis import TOGETHER, StaticReduction, fewest_directions
from .terms import ModalState, ReductionTerms, State

START_ITERATIONS = 4
FURTHER_MODES = 2
"""Modes that are looked for beyond those wanted, because modes change places."""
RESIDUAL_TOLERANCE, FREQUENCY_TOLERANCE = 3e-3, 1e-5
"""Relative residual of the sampled modes in the working basis, of which frequencies err by about the square,
and relative error of any frequency that compression may add."""
MOST_CORRECTIONS = 12
"""Limit of Davidson corrections for one state."""


def eigenmodes(
    terms: Sequence[FloatArray], theta: FloatArray, mass_theta: FloatArray, count: int
) -> tuple[FloatArray, FloatArray]:
    """Return squared angular frequencies and mass-normalised shapes of the first modes of projected terms."""
    pair = (np.tensordot(values, part, 1) for values, part in zip((theta, mass_theta), terms, strict=True))
    values, vectors = eigh(*pair, subset_by_index=[0, count - 1])
    return np.asarray(values), np.asarray(vectors)


def modal_basis(terms: ReductionTerms, count: int, stage: Stage) -> tuple[FloatArray, dict[str, Any]]:
    """Make a basis (n, Nm) for the first modes of any structure, and the modal fields of `ReducedArrays`.

    Parameters
    ----------
    terms : ReductionTerms
        The full model, where the working basis is refined, and whose modes are compressed together.
    count : int
        Number of modes.
    stage : Stage
        Advances after each sampled state.

    Raises
    ------
    ReductionError
        If the modes of a sampled state do not converge, there are too few unknowns for the modes, or masses
        move in too few ways.
    """
    structure, factors, sought = terms.structure, terms.factors, count + FURTHER_MODES
    if structure.unknowns <= 2 * sought:
        raise ReductionError(said("reduction.few_unknowns", count=count, structure=structure))
    working = ProjectedBasis(factors, terms.stiffness_terms, structure.mass_terms, drop=1e-6)
    middle = np.append(1.0, terms.masses.mean(axis=1))
    # inverse iteration on a block; what it leaves is refined below
    vectors = np.random.default_rng(1).normal(size=(structure.unknowns, sought + 4))
    for _ in range(START_ITERATIONS):
        inertia = affine_product(structure.mass_terms, middle, factors.unwhitened(vectors))
        vectors = np.linalg.qr(factors.whitened(inertia))[0]
    working.add(vectors)
    sampled = terms.sampled_modes()
    try:
        for first in range(0, len(sampled), TOGETHER):
            for _ in _refined(terms, working, sampled[first : first + TOGETHER], sought):
                stage.advance()
        directions = _compressed(working, terms.compressed_modes(), count)
    except np.linalg.LinAlgError:
        why = said("reduction.few_masses", design=structure.design, sought=sought)
        raise ReductionError(why) from None
    stiffness, mass = (turned(inner, directions) for inner in working.inner)
    basis = working.displacements @ directions
    load, followed = terms.loads.T @ basis, np.empty((0, basis.shape[1]))
    if structure.followed_load is not None:
        healthy = terms.theta((*structure.parameters.values(), *np.zeros(len(terms.losses))))
        nominal = np.array((1.0, *structure.masses.values()))
        square, shapes = eigenmodes((stiffness, mass), healthy, nominal, count)
        followed = shapes[:, most_moved(load[structure.followed_load], square, shapes)].T
    output = (terms.outputs.T @ basis, structure.acceleration_output @ basis)
    return basis, {
        "mode_count": count,
        "modal_stiffness": stiffness,
        "modal_mass": mass,
        "modal_load": load,
        "modal_output": np.concatenate(output),
        "followed_shapes": followed,
    }


def _refined(
    terms: ReductionTerms, working: ProjectedBasis, states: list[ModalState], sought: int
) -> Iterator[int]:
    """Add Davidson corrections X^-1 (K - omega^2 M) phi until all modes are found; yield at each state."""
    largest = np.inf
    for _ in range(MOST_CORRECTIONS):
        modes = [eigenmodes(working.inner, *state, sought) for state in states]
        theta, mass_theta = (np.repeat(part, sought, axis=0).T for part in zip(*states, strict=True))
        squares = np.concatenate([square for square, _ in modes])
        shapes = working.displacements @ np.concatenate([shape for _, shape in modes], axis=1)
        residuals = affine_product(terms.stiffness_terms, theta, shapes)
        residuals -= affine_product(terms.structure.mass_terms, mass_theta * squares, shapes)
        corrections = working.factors.whitened(residuals)
        # (r, X^-1 r) / (phi, K phi); phi is mass-normalised
        sizes = np.linalg.norm(corrections, axis=0) / np.sqrt(squares)
        too_large = sizes > RESIDUAL_TOLERANCE
        still = too_large.reshape(len(states), -1).any(axis=1)
        yield from range(int(np.sum(~still)))
        if not still.any():
            return
        largest = float(sizes.max())
        working.add(corrections[:, too_large])
        states = [state for state, chosen in zip(states, still, strict=True) if chosen]
    reached = largest, MOST_CORRECTIONS, RESIDUAL_TOLERANCE
    raise ReductionError(said("reduction.corrections", reached=reached))


def _compressed(working: ProjectedBasis, states: list[ModalState], count: int) -> FloatArray:
    """Return the fewest singular directions (k, Nm) of many states' modes that keep every frequency."""
    modes = [eigenmodes(working.inner, *state, count) for state in states]

    def good(directions: FloatArray) -> bool:
        smaller = [turned(inner, directions) for inner in working.inner]
        found = [eigenmodes(smaller, *state, count)[0] for state in states]
        worst = np.max(np.array(found) / np.array([square for square, _ in modes]))
        return bool(0.5 * (worst - 1.0) <= FREQUENCY_TOLERANCE)

    # the error falls with size, because the bases are nested
    return fewest_directions(np.concatenate([shape for _, shape in modes], axis=1), count, good)


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


def reduce_structure(
    structure: AffineStructure, settings: StructureSettings | None = None, progress: Progress | None = None
) -> Reduction:
    """Make the reduced model of a structure.

    Parameters
    ----------
    structure : AffineStructure
        The full model.
    settings : StructureSettings, optional
        How well it is to hold; by default as its design says.
    progress : Progress, optional
        Where to report.

    Raises
    ------
    ReductionError
        If there is nothing to reduce it for, or the accuracy asked for is not reached.
    SolutionError
        If the full model cannot be solved.
    """
    limits, progress = structure.design.reduction, reporter(progress)
    settings = settings or StructureSettings(limits.tolerance, limits.most_solutions)
    terms = ReductionTerms(replace(structure, ranges=structure.ranges | settings.ranges))
    _check(terms)
    with progress.stage("Factorising the structure"):
        _ = terms.factors
    with progress.stage("Reducing the modes") as stage:
        basis, modal = modal_basis(terms, settings.mode_count, stage)
    with progress.stage("Reducing the statics") as stage:
        static = StaticReduction(terms, _named(terms) | modal, basis, stage)
        history = static.search(settings)
        directions = static.compressed(settings.bound_tolerance)
    static_basis = static.basis.displacements @ directions
    return Reduction(static.model(directions), static_basis, basis, tuple(static.snapshots), history)


def _check(terms: ReductionTerms) -> None:
    """Refuse a structure that a twin can do nothing with; raises `ReductionError`."""
    structure, name = terms.structure, terms.structure.design.name
    for missing, what in (
        (not structure.regions, "[[damage]]: a twin needs a region that may lose stiffness"),
        (not len(terms.load_factors), "[[load]] that does anything: nothing would strain it"),
        (not terms.groups, "[[gauge]] and no [[displacement]]: nothing could be observed"),
    ):
        if missing:
            raise ReductionError(f"The structure {name} has no {what}.")
    if not structure.mass().diagonal().any():
        raise ReductionError(said("reduction.no_mass", name=name))


def _named(terms: ReductionTerms) -> dict[str, Any]:
    """Return the fields of `ReducedArrays` that no basis changes: names, ranges, factors, damping."""
    structure = terms.structure
    chosen = (*structure.parameters, *structure.regions, *structure.masses, *structure.controls)
    nominal = structure.parameters | structure.masses | structure.controls
    kinds = ("regions", "parameters", "masses", "controls", "gauges", "displacements", "accelerations")
    return {
        "design_hash": structure.design_hash,
        "name": structure.design.name,
        **{kind: tuple(getattr(structure, kind)) for kind in kinds},
        "control_units": tuple(structure.control_units.values()),
        "validity_box": np.array([structure.ranges[name] for name in chosen], dtype=np.float64),
        "nominal": np.array([nominal.get(name, 0.0) for name in chosen], dtype=np.float64),
        "damping": np.array((structure.design.damping.alpha, structure.design.damping.beta)),
        "stiffness_factors": terms.stiffness_factors,
        "load_factors": terms.load_factors,
        "dual_split": terms.splits,
    }


@dataclass(frozen=True)
class MeasuredErrors:
    """Largest errors of a reduced structure at random states, against the full model.

    Attributes
    ----------
    strain, displacement : float
        Of the outputs, relative to the largest of the same load and state; NaN where there are none.
    bound : float
        The largest certified bound there, relative in the same way, of strains and displacements.
    frequency : float
        Relative error of the natural frequencies, at the first and the last of the states.
    states : int
        Number of states.
    broken : int
        In how many of them an error is larger than its bound.
    """

    strain: float
    displacement: float
    bound: float
    frequency: float
    states: int
    broken: int


def measured_errors(
    structure: AffineStructure, model: ReducedModel, states: int, seed: int = 2021
) -> MeasuredErrors:
    """Compare a reduced model with the full one, each control at its nominal value, or one where that is 0.

    Parameters
    ----------
    structure : AffineStructure
        The full model.
    model : ReducedModel
        Its reduced model.
    states : int
        Random states, uniform in the ranges; each costs a factorisation.
    seed : int
        Of the states.

    Raises
    ------
    SolutionError
        If the full model cannot be solved.
    """
    (low, high), first = model.validity_box.T, len(model.chosen) - len(model.controls)
    vectors = low + (high - low) * np.random.default_rng(seed).random((states, len(low)))
    one = np.clip(1.0, low, high)
    vectors[:, first:] = np.where(model.nominal == 0.0, one, model.nominal)[first:]
    errors, frequency = np.full((2, states, 2), np.nan), 0.0  # missed and bound, of strains and displacements
    for number, vector in enumerate(vectors):
        values = dict(zip(model.chosen, vector.tolist(), strict=True))
        full, found = static_response(structure, values), model.static_response(vector)
        wholes = full.strain, full.output
        for kind, (wanted, (came, bound)) in enumerate(zip(wholes, found.bounded, strict=True)):
            if wanted.size:
                size = np.abs(wanted).max()
                errors[:, number, kind] = np.abs(came - wanted).max() / size, bound / size
        if number in (0, states - 1):
            wanted = natural_frequencies(structure, model.mode_count, values)[0]
            frequency = max(frequency, float(np.abs(model.modes(vector).frequency / wanted - 1.0).max()))
    (strain, displacement), largest = np.fmax.reduce(errors[0]), np.nanmax(errors[1])
    broken = int((errors[0] > errors[1]).any(axis=1).sum())
    return MeasuredErrors(float(strain), float(displacement), float(largest), frequency, states, broken)
