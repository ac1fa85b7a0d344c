"""Offline: the wing in a basis that is rich enough for the changes of `fe.runtime.patch`.

In two steps. A working basis of several hundred vectors holds what the full model answers to loads, to point
forces and to each stiffness and mass term, at two states of health, and representatives of the gauges (whose
presence squares the error of a strain). In it, many patched states are solved; the singular directions of
their solutions and modes, weighed by what is looked at most, are the basis that is kept.
"""

from typing import Any

import numpy as np
from scipy import sparse
from scipy.linalg import eigh

from fe.full.subspace import Norm
from fe.runtime.arrays import FloatArray
from fe.runtime.patch import LocalStiffnessLoss, ModelPatch, PointMass, RootCompliance
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.patched_wing import PatchedState, PatchedWing
from fe.runtime.state import DigitalState
from fe.wing.operators import AffineOperators
from fe.wing.patch_operators import PatchOperators, assemble_patch_operators
from reporting.progress import Progress, SilentProgress

from .settings import PatchSettings

DAMAGED_ANCHOR = 0.7
"""Stiffness loss of every damage region in the second state of health at which the full model is solved."""
LIFT_MOMENTS = 6
"""Courses of the lift along the span for which the full model is solved: Legendre polynomials."""
MODES = 8
SUBSPACE_ITERATIONS = 6
START_SHAPES = 16
"""Modes from which those of a patched wing are iterated."""


def reduce_patches(
    operators: AffineOperators, settings: PatchSettings | None = None, progress: Progress | None = None
) -> PatchArrays:
    """Make the arrays of a wing that can be patched.

    Parameters
    ----------
    operators : AffineOperators
        The full model.
    settings : PatchSettings, optional
        How far and how well.
    progress : Progress, optional
        Where to report.

    Raises
    ------
    SolutionError
        If the full model cannot be solved.
    """
    settings, progress = settings or PatchSettings(), progress or SilentProgress()
    with progress.stage("Solving the wing for changes"):
        full = assemble_patch_operators(operators, settings.strip_count)
        healthy = Norm(operators.stiffness())
        damaged = Norm(operators.stiffness(None, (DAMAGED_ANCHOR,) * len(operators.regions)))
        snapshots = np.concatenate(
            [_responses(full, healthy, settings, main=True), _responses(full, damaged, settings, main=False)],
            axis=1,
        )
        basis = _orthonormal(snapshots, healthy.stiffness)
    with progress.stage("Reducing the patched wing"):
        directions = _directions(project(full, basis, settings), settings)
        return project(full, basis @ directions, settings)


def _unit_energy(vectors: FloatArray, stiffness: Any) -> FloatArray:
    energy = np.einsum("ik,ik->k", vectors, stiffness @ vectors)
    return np.asarray(vectors / np.sqrt(np.where(energy > 0.0, energy, 1.0)))


def _responses(full: PatchOperators, norm: Norm, settings: PatchSettings, *, main: bool) -> FloatArray:
    """Return solutions (n, k) of the full model at one state of health, in their natural sizes.

    `main`: more of them, for the state of health that is looked at most.
    """
    operators, stiffness, rows, plain = full.operators, norm.stiffness, full.rows, full.plain
    eta = plain["stations"] / plain["stations"][-1]
    moments = np.polynomial.legendre.legvander(2.0 * eta - 1.0, LIFT_MOMENTS - 1)
    step = max(1, len(eta) // 13)
    along_x, along_y, elastic, *others = rows["line_rows"]
    along, *turned = rows["strain_rows"]
    lines = [
        elastic[2 : None : 1 if main else step],  # where point masses may sit
        *(line[step::step] for line in others),
        *(line[2 * step :: 2 * step] for line in (along_x, along_y)),
        *(turned if main else ()),
        along,
    ]
    loads = np.vstack(
        [
            *(rows[name] for name in ("load_tip", "load_lift", "tip_row")),
            (rows["lift_rows"].T @ moments).T,
            *(rows[name] for name in ("weight", "flap_row")),
            *(line.toarray() for line in lines),
        ]
    ).T
    solutions = norm.riesz(loads)
    gauges = solutions[:, -operators.gauge_output.shape[0] :]
    solutions = _unit_energy(solutions, stiffness)
    mass = operators.mass({name: float(np.mean(operators.ranges[name])) for name in operators.masses})
    vectors = np.random.default_rng(settings.seed).normal(size=(operators.unknowns, MODES + 6))
    for _ in range(SUBSPACE_ITERATIONS):
        vectors = np.linalg.qr(norm.riesz(np.asarray(mass @ vectors)))[0]
    _, coordinates = eigh(vectors.T @ (stiffness @ vectors), vectors.T @ (mass @ vectors))
    modes = _unit_energy(vectors @ coordinates[:, :MODES], stiffness)
    # what each part of the skin does to the main solutions, and to the gauges near it
    shapes = np.concatenate((solutions[:, :2], modes[:, : 6 if main else 3]), axis=1)
    changes = [np.asarray(part @ shapes) for part in full.strips]
    places, edges = plain["gauge_stations"], plain["strip_lines"]
    middle = 0.5 * (edges[1:] + edges[:-1])
    reach = 1.5 * float(np.diff(edges).max())
    gauges = _unit_energy(gauges, stiffness)
    for part, strip in zip(full.strips, plain["strip_of"], strict=True):
        near = np.flatnonzero(np.abs(places - middle[strip]) < reach)
        if main and near.size:
            changes.append(np.asarray(part @ gauges[:, near]))
    inertia = [np.asarray(term @ modes[:, :6]) for term in operators.mass_terms]
    answered = norm.riesz(np.concatenate((*changes, *inertia), axis=1))
    count = inertia[0].shape[1] * len(inertia)
    answered[:, -count:] = 0.3 * _unit_energy(answered[:, -count:], stiffness)
    return np.concatenate((solutions, modes, answered), axis=1)


def _orthonormal(snapshots: FloatArray, stiffness: Any) -> FloatArray:
    """Basis (n, k), orthonormal in the energy, of all but the least directions of snapshots."""
    gram = snapshots.T @ (stiffness @ snapshots)
    values, vectors = np.linalg.eigh(0.5 * (gram + gram.T))
    kept = values > WORKING_TOLERANCE * values[-1]
    return np.asarray(snapshots @ (vectors[:, kept] / np.sqrt(values[kept])))


WORKING_TOLERANCE = 3e-7
"""Squared size, relative to the largest, of a direction that the working basis leaves out."""


def _inner(matrix: sparse.csr_array, basis: FloatArray) -> FloatArray:
    """Return basis^T matrix basis, on the rows that the matrix has."""
    used = np.flatnonzero(np.diff(matrix.indptr))
    part = basis[used]
    product = part.T @ (matrix[used][:, used] @ part)
    return np.asarray(0.5 * (product + product.T))


def project(full: PatchOperators, basis: FloatArray, settings: PatchSettings) -> PatchArrays:
    """Return the arrays of a wing in a basis (n_full, n), without reducing it further."""
    lower, operators = np.tril_indices(basis.shape[1]), full.operators
    rows: dict[str, Any] = {
        name: np.stack([part @ basis for part in own]) if isinstance(own, tuple) else np.asarray(own @ basis)
        for name, own in full.rows.items()
    }
    stiffness, mass = (
        np.stack([_inner(term, basis) for term in terms])
        for terms in ([term.matrix for term in operators.stiffness_terms], operators.mass_terms)
    )
    whole, tip = stiffness.sum(axis=0), rows["load_tip"]
    nominal = np.tensordot((1.0, *operators.masses.values()), mass, 1)
    shapes = eigh(whole, nominal, subset_by_index=[0, START_SHAPES - 1])[1]
    return PatchArrays(
        design_hash=operators.design_hash,
        region_names=" ".join(operators.regions),
        validity_box=np.array(list(operators.ranges.values())),
        largest_loss=settings.largest_loss,
        largest_compliance=settings.compliance_share
        * float(tip @ np.linalg.solve(whole, tip))
        / full.plain["load_place"] ** 2,
        largest_mass=settings.largest_mass,
        stiffness=stiffness,
        mass=mass,
        strip_stiffness=np.stack([_inner(part, basis)[lower].astype(np.float32) for part in full.strips]),
        start_shapes=_unit(shapes * np.where(rows["tip_row"] @ shapes < 0.0, -1.0, 1.0)),
        **full.plain,
        **rows,
    )


def _directions(arrays: PatchArrays, settings: PatchSettings) -> FloatArray:
    """Return the kept directions (N, n) of the working basis."""
    generator, wing = np.random.default_rng(settings.seed), PatchedWing(arrays)
    span_row = arrays.station_weights @ arrays.line_rows[2]
    gauges = np.concatenate(arrays.strain_rows).T
    all_snapshots = np.zeros((wing.size, wing.size))
    for number in range(settings.states):
        structure, loads = _patched_state(wing, settings, generator, plain=number == 0)
        columns = np.concatenate((loads, gauges, arrays.flap_row[:, None], span_row[:, None]), axis=1)
        weights = np.ones(columns.shape[1])
        weights[:3] = LOAD_WEIGHT
        weights[len(loads.T) + len(gauges.T) // 3 : -2] = TURNED_WEIGHT
        solutions = _unit(structure.static(columns)) * weights
        modes = _unit(structure.lowest(MODES).shapes) * MODE_WEIGHTS
        plainly = 10.0 if number == 0 else 1.0  # the wing as it was is looked at most
        shapes = np.concatenate((solutions, modes), axis=1) * plainly
        all_snapshots += shapes @ shapes.T
    first = max(0, wing.size - settings.vectors)
    return np.asarray(eigh(all_snapshots, subset_by_index=[first, wing.size - 1])[1][:, ::-1])


LOAD_WEIGHT = 3.0
"""How much more the solutions under tip force, lift and a washed-out lift count than those under others."""
TURNED_WEIGHT = 0.4
"""How much representatives of strain across a gauge and of shear count."""
MODE_WEIGHTS = np.array([3.0, 3.0, 4.0, 3.0, 1.5, 1.0, 0.5, 0.3])


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=0))


def _patched_state(
    wing: PatchedWing, settings: PatchSettings, generator: np.random.Generator, *, plain: bool
) -> tuple[PatchedState, FloatArray]:
    """Return a random state and its loads (N, 3 + 2 L); `plain`: of the wing as it was."""
    arrays, span = wing.arrays, wing.span
    drawn = np.array(generator.uniform(*arrays.validity_box[:-2].T))  # all but the loads
    e, *losses, servo, pitot = drawn.tolist()
    damaged, *changed = generator.random(4) < (0.5, 0.75, 0.4, 0.6)
    start, length = generator.uniform(-0.05, 0.9) * span, generator.uniform(0.02, 0.3) * span
    changes = (
        LocalStiffnessLoss(generator.uniform(0.1, arrays.largest_loss), start, length),
        RootCompliance(generator.uniform(0.0, arrays.largest_compliance)),
        PointMass(generator.uniform(0.0, arrays.largest_mass), generator.uniform(0.1, 1.0) * span),
    )
    exponent, stations = generator.uniform(0.5, 4.0), arrays.stations
    outboard = int(generator.integers(int(0.55 * len(stations)), len(stations)))
    if plain:
        e, servo, pitot = DigitalState().values.values()
        damaged, changed = False, [False] * len(changes)
    patch = ModelPatch(tuple(change for change, taken in zip(changes, changed, strict=True) if taken))
    structure = wing.structure(e, tuple(losses) if damaged else (), servo, pitot, patch)
    loads = np.stack(
        (
            arrays.load_tip,
            arrays.load_lift,
            (stations / span) ** exponent @ arrays.lift_rows,
            arrays.weight,
            arrays.line_rows[2, outboard],
            *arrays.line_rows[3:, outboard],
            *arrays.line_rows[3:, -1],
        ),
        axis=1,
    )
    return structure, loads
