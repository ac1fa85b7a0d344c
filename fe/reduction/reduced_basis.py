"""Offline: make the `ReducedModel` of a structure, as a wing is one, and measure its errors.

First a small basis in which the first eigenmodes are accurate for every stiffness and mass: a working basis
is grown by Davidson corrections until the modes of sampled states have small residuals in it; then the modes
of many states, computed in the working basis, are compressed by singular values. The method and what it
reaches are in `docs/reduced_model.md`.
"""

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import eigh

from fe.full.factorisation import most_moved
from fe.full.subspace import Norm, ProjectedBasis
from fe.runtime.arrays import FloatArray
from fe.runtime.errors import ReductionError
from fe.runtime.reduced import ReducedModel
from fe.runtime.state import TIP_FORCE
from fe.structure.affine import AffineStructure, affine_sum, natural_frequencies, static_response
from fe.wing.operators import AffineWing
from reporting.progress import Progress, SilentProgress, Stage
from reporting.words import counted

from .certified_basis import StaticReduction, compressed, fewest_directions, greedy
from .settings import TOGETHER, ModalSettings, StructureSettings, loss_splits
from .terms import ModalState, ReductionTerms, State

START_ITERATIONS = 4


def eigenmodes(
    terms: Sequence[FloatArray], theta: FloatArray, mass_theta: FloatArray, count: int
) -> tuple[FloatArray, FloatArray]:
    """Return squared angular frequencies and mass-normalised shapes of the first modes of projected terms."""
    pair = (np.tensordot(values, part, 1) for values, part in zip((theta, mass_theta), terms, strict=True))
    values, vectors = eigh(*pair, subset_by_index=[0, count - 1])
    return np.asarray(values), np.asarray(vectors)


def modal_basis(
    system: ReductionTerms, norm: Norm, settings: ModalSettings, stage: Stage, followed_load: int | None
) -> tuple[FloatArray, dict[str, Any]]:
    """Make a basis (n, Nm) for the first modes of any structure, and the modal fields of `ReducedArrays`.

    Parameters
    ----------
    system : ReductionTerms
        The full model, where the working basis is refined, and whose modes are compressed together.
    norm : Norm
        The energy norm of one of its stiffnesses.
    settings : ModalSettings
        Accuracy.
    stage : Stage
        Advances after each sampled state.
    followed_load : int, optional
        As of `reduce_structure`.

    Raises
    ------
    ReductionError
        If the modes of a sampled state do not converge, there are too few unknowns for the modes, or masses
        move in too few ways.
    """
    unknowns, count = system.stiffness_terms[0].shape[0], settings.sought
    if unknowns <= 2 * count:
        raise ReductionError(
            f"{settings.mode_count} modes cannot be had from {unknowns} unknowns; ask for fewer or refine."
        )
    working = ProjectedBasis(norm, (system.stiffness_terms, system.mass_terms), drop=1e-6)
    matrix = affine_sum([1.0, *(0.5 * (low + high) for low, high in system.masses)], system.mass_terms)
    # inverse iteration on a block; what it leaves is refined below
    vectors = np.random.default_rng(1).normal(size=(unknowns, count + 4))
    for _ in range(START_ITERATIONS):
        vectors = np.linalg.qr(norm.riesz(np.asarray(matrix @ vectors)))[0]
    working.extend(vectors)
    sampled = system.sampled_modes()
    try:
        for first in range(0, len(sampled), TOGETHER):
            for _ in _refined(system, working, sampled[first : first + TOGETHER], settings):
                stage.advance()
        directions = _compress(working, system.compressed_modes(), settings)
    except np.linalg.LinAlgError:
        raise ReductionError(
            f"The masses of {system.structure.design.name} move in fewer ways than the {count} modes that "
            "are looked for; give its materials a density."
        ) from None
    stiffness, mass = (
        # What rounding made of the symmetry of large entries is averaged out.
        0.5 * (terms + terms.transpose(0, 2, 1))
        for terms in (directions.T @ inner @ directions for inner in working.inner)
    )
    basis = working.vectors @ directions
    load, followed = system.loads.T @ basis, np.empty((0, basis.shape[1]))
    if followed_load is not None:
        square, shapes = eigenmodes((stiffness, mass), *system.nominal, settings.mode_count)
        followed = shapes[:, most_moved(load[followed_load], square, shapes)].T
    output = (system.outputs.T @ basis, system.structure.acceleration_output @ basis)
    return basis, {
        "mode_count": settings.mode_count,
        "modal_stiffness": stiffness,
        "modal_mass": mass,
        "modal_load": load,
        "modal_output": np.concatenate(output),
        "followed_shapes": followed,
    }


def _refined(
    system: ReductionTerms, working: ProjectedBasis, states: list[ModalState], settings: ModalSettings
) -> Iterator[int]:
    """Add Davidson corrections X^-1 (K - omega^2 M) phi until all modes are found; yield at each state."""
    open_states = [(*state, system.stiffness(state[0]), system.mass(state[1])) for state in states]
    largest = np.inf
    for _ in range(settings.most_corrections):
        modes = [
            eigenmodes(working.inner, theta, mass_theta, settings.sought)
            for theta, mass_theta, _, _ in open_states
        ]
        residual = []
        for (_, _, stiffness, mass), (square, coefficients) in zip(open_states, modes, strict=True):
            shape = working.vectors @ coefficients
            residual.append(stiffness @ shape - (mass @ shape) * square)
        residuals = np.concatenate(residual, axis=1)
        correction = working.norm.riesz(residuals)
        # (r, X^-1 r) / (phi, K phi); phi is mass-normalised
        squares = np.concatenate([square for square, _ in modes])
        sizes = np.sqrt(np.einsum("ik,ik->k", residuals, correction) / squares)
        too_large = sizes > settings.residual_tolerance
        still = too_large.reshape(len(open_states), -1).any(axis=1)
        yield from range(int(np.sum(~still)))
        if not still.any():
            return
        largest = float(sizes.max())
        working.extend(correction[:, np.flatnonzero(too_large)])
        open_states = [state for state, chosen in zip(open_states, still, strict=True) if chosen]
    raise ReductionError(
        f"The modes of a sampled state reached a residual of {largest:.2g} only, "
        f"{settings.residual_tolerance:.2g} was asked for; allow more corrections."
    )


def _compress(working: ProjectedBasis, states: list[ModalState], settings: ModalSettings) -> FloatArray:
    """Return the fewest singular directions (k, Nm) of many states' modes that keep every frequency."""
    modes = [eigenmodes(working.inner, *state, settings.sought) for state in states]
    kept = settings.mode_count
    snapshots = np.concatenate(
        [shape[:, :kept] / np.linalg.norm(shape[:, :kept], axis=0) for _, shape in modes], axis=1
    )
    directions, singular, _ = np.linalg.svd(snapshots, full_matrices=False)
    most = int(np.sum(singular > 1e-7 * singular[0]))

    def good(size: int) -> bool:
        smaller = [directions[:, :size].T @ inner @ directions[:, :size] for inner in working.inner]
        worst = max(
            float(np.max(eigenmodes(smaller, *state, kept)[0] / square[:kept]))
            for state, (square, _) in zip(states, modes, strict=True)
        )
        return 0.5 * (worst - 1.0) <= settings.frequency_tolerance

    # the error falls with size, because the bases are nested
    return directions[:, : bisect_left(range(most), True, kept, key=good)]


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
    structure: AffineStructure,
    settings: StructureSettings | None = None,
    progress: Progress | None = None,
    followed_load: int | None = None,
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
    followed_load : int, optional
        Number of the load by which two modes are followed: those that contribute most to its compliance.

    Raises
    ------
    ReductionError
        If there is nothing to reduce it for, or the accuracy asked for is not reached.
    SolutionError
        If the full model cannot be solved.
    """
    settings, progress = settings or StructureSettings.of(structure.design), progress or SilentProgress()
    structure = replace(structure, ranges=structure.ranges | settings.ranges)
    terms, name = ReductionTerms(structure), structure.design.name
    _check(terms, name)
    with progress.stage("Factorising the structure"):
        norm = Norm(affine_sum(terms.reference, terms.stiffness_terms))
    with progress.stage("Reducing the modes") as stage:
        basis, modal = modal_basis(terms, norm, settings.modal, stage, followed_load)
    with progress.stage("Reducing the statics") as stage:
        fixed, states = _named(terms, name) | modal, terms.training()
        static = StaticReduction(terms, norm, fixed, basis, stage)
        history = greedy(
            static, states, tolerance=settings.bound_tolerance, most_snapshots=settings.most_snapshots
        )
    if history[-1] > settings.bound_tolerance:
        raise ReductionError(
            f"After {counted(len(static.snapshots), 'full solution')} the error bound of {name} is "
            f"{history[-1]:.2g} of the largest output, but {settings.bound_tolerance:.2g} was asked for; "
            f"raise most_solutions (now {settings.most_snapshots}) or tolerance in the table [reduction] of "
            "a structure file, or narrow the ranges of parameters and losses."
        )
    model = static.model()
    directions = fewest_directions(model, static, states, settings.bound_tolerance)
    return Reduction(
        compressed(model, directions),
        static.basis.vectors @ directions,
        basis,
        tuple(static.snapshots),
        tuple(history),
    )


def _check(terms: ReductionTerms, name: str) -> None:
    """Refuse a structure that a twin can do nothing with; raises `ReductionError`."""
    structure = terms.structure
    for missing, what in (
        (not structure.regions, "[[damage]]: a twin needs a region that may lose stiffness"),
        (not len(terms.load_factors), "[[load]] that does anything: nothing would strain it"),
        (not terms.groups, "[[gauge]] and no [[displacement]]: nothing could be observed"),
    ):
        if missing:
            raise ReductionError(f"The structure {name} has no {what}.")
    if not structure.mass().diagonal().any():
        raise ReductionError(
            f"The structure {name} has no mass, hence no modes; give its materials a density."
        )


def _named(terms: ReductionTerms, name: str) -> dict[str, Any]:
    """Return the fields of `ReducedArrays` that no basis changes: names, ranges, factors, damping."""
    structure = terms.structure
    chosen = (*structure.parameters, *structure.regions, *structure.masses, *structure.controls)
    nominal = structure.parameters | structure.masses | structure.controls
    kinds = ("regions", "parameters", "masses", "controls", "gauges", "displacements", "accelerations")
    return {
        "design_hash": structure.design_hash,
        "name": name,
        **{kind: tuple(getattr(structure, kind)) for kind in kinds},
        "control_units": tuple(part.unit for part in structure.design.control),
        "validity_box": np.array([structure.ranges[name] for name in chosen], dtype=np.float64),
        "nominal": np.array([nominal.get(name, 0.0) for name in chosen], dtype=np.float64),
        "damping": np.array((structure.design.damping.alpha, structure.design.damping.beta)),
        "stiffness_factors": terms.stiffness_factors,
        "load_factors": terms.load_factors,
        "dual_counts": np.array(terms.counts, dtype=np.int64),
        "dual_split": np.concatenate(
            [loss_splits(ends, count) for ends, count in zip(terms.losses, terms.counts, strict=True)]
        ),
    }


def reduce_model(
    wing: AffineWing, settings: StructureSettings | None = None, progress: Progress | None = None
) -> Reduction:
    """Make the reduced model of a wing, its flapwise bendings followed; see `reduce_structure`."""
    return reduce_structure(wing, settings, progress, TIP_FORCE)


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
    random = np.random.default_rng(seed)
    low, high = model.validity_box.T
    first_control = len(model.chosen) - len(model.controls)
    broken = set()
    worst = {"strain": np.nan, "displacement": np.nan, "bound": 0.0, "frequency": 0.0}
    for number in range(states):
        vector = low + (high - low) * random.random(len(low))
        nominal = model.nominal[first_control:]
        vector[first_control:] = np.where(
            nominal == 0.0, np.clip(1.0, *model.validity_box[first_control:].T), nominal
        )
        values = dict(zip(model.chosen, vector.tolist(), strict=True))
        full, found = static_response(structure, values), model.static_response(vector)
        for what, wanted in (("strain", full.strain), ("displacement", full.output)):
            came, error = getattr(found, what), getattr(found, f"{what}_error_bound")
            if wanted.size:
                size, missed = float(np.abs(wanted).max()), float(np.abs(came - wanted).max())
                worst[what] = np.fmax(worst[what], missed / size)
                if missed > error:
                    broken.add(number)
                worst["bound"] = max(worst["bound"], error / size)
        if number in (0, states - 1):
            ratio = (
                model.modes(vector).frequency / natural_frequencies(structure, model.mode_count, values)[0]
            )
            worst["frequency"] = max(worst["frequency"], float(np.abs(ratio - 1.0).max()))
    return MeasuredErrors(
        **{name: float(value) for name, value in worst.items()}, states=states, broken=len(broken)
    )
