"""Offline: the wing in a basis that is rich enough for the changes of `fe.runtime.patch`.

In two steps. A working basis of several hundred vectors holds what the full model answers to loads, to point
forces, to the gauges as loads (whose presence squares the error of a strain) and to each stiffness and mass
term, at two states of health. In it, many patched states are solved; the singular directions of their
solutions and modes, weighed by what is looked at most, are the basis that is kept.
"""

from typing import Any

import numpy as np
from scipy import sparse
from scipy.linalg import eigh

from fe.full.factorisation import Factorisation
from fe.runtime.arrays import FloatArray
from fe.runtime.patch import LocalStiffnessLoss, ModelPatch, PointMass, RootCompliance
from fe.runtime.patched_wing import PatchedState, PatchedWing
from fe.runtime.wing_rows import PatchArrays
from fe.structure.affine import natural_frequencies
from fe.wing.operators import AffineOperators
from fe.wing.patch_operators import PatchOperators, assemble_patch_operators
from reporting.progress import Progress, reporter

LARGEST_LOSS, COMPLIANCE_SHARE, LARGEST_MASS = 0.7, 0.4, 0.25
"""How far changes may go: loss of stiffness in a box along the span, root compliance as a share of the tip's,
point mass [kg]."""
VECTORS, STATES = 240, 240
"""Size n of the basis, and patched states that are solved in the working basis."""
DAMAGED_ANCHOR = 0.7
"""Stiffness loss of every damage region in the second state of health at which the full model is solved."""
LIFT_MOMENTS = 6
"""Courses of the lift along the span for which the full model is solved: Legendre polynomials."""
MODES, SHAPES = 8, 6
"""Modes that are snapshots, and those of them whose inertia and parts of the skin are answered, too."""
START_SHAPES = 16
"""Modes from which those of a patched wing are iterated."""
WORKING_TOLERANCE = 3e-7
"""Squared size, relative to the largest, of a direction that the working basis leaves out."""


def reduce_patches(operators: AffineOperators, progress: Progress | None = None) -> PatchArrays:
    """Make the arrays of a wing that can be patched.

    Parameters
    ----------
    operators : AffineOperators
        The full model.
    progress : Progress, optional
        Where to report.

    Raises
    ------
    SolutionError
        If the full model cannot be solved.
    """
    progress = reporter(progress)
    with progress.stage("Solving the wing for changes"):
        full = assemble_patch_operators(operators)
        healthy, damaged = _responses(full, 0.0), _responses(full, DAMAGED_ANCHOR)
        snapshots = np.concatenate((healthy, damaged), axis=1)
        values, vectors = np.linalg.eigh(snapshots.T @ (operators.stiffness() @ snapshots))
        kept = values > WORKING_TOLERANCE * values[-1]
        basis = snapshots @ (vectors[:, kept] / np.sqrt(values[kept]))
    with progress.stage("Reducing the patched wing"):
        return project(full, basis @ _directions(project(full, basis)))


def _responses(full: PatchOperators, loss: float) -> FloatArray:
    """Return solutions (n, k) of the full model, all damage regions with one loss, in their natural sizes."""
    operators, rows, stations = full.operators, full.rows, full.plain["stations"]
    health = dict.fromkeys(operators.regions, loss)
    factors = Factorisation(operators.stiffness(None, health))
    frequency, modes = natural_frequencies(operators, MODES, health, factors)
    step = max(1, len(stations) // 13)
    along_x, along_y, elastic, *others = rows["line_rows"]
    along, *turned = rows["strain_rows"]
    lines = (
        *turned,
        elastic[2:],  # where point masses may sit
        *(line[step::step] for line in others),
        *(line[2 * step :: 2 * step] for line in (along_x, along_y)),
    )
    single = [rows[name] for name in ("load_tip", "load_lift", "tip_row", "weight", "flap_row")]
    moments = np.polynomial.legendre.legvander(2.0 * stations / stations[-1] - 1.0, LIFT_MOMENTS - 1)
    inertia = [(term @ modes[:, :SHAPES]).T for term in operators.mass_terms]
    several = (line.toarray() for line in lines)
    loads = (along.toarray(), *single, moments.T @ rows["lift_rows"], *several, *inertia)
    answers = factors.whitened(np.vstack(loads).T)
    answers = factors.unwhitened(answers / np.linalg.norm(answers, axis=0))
    solutions = np.concatenate((answers, modes / (2.0 * np.pi * frequency)), axis=1)
    # what each part of the skin does to the main solutions, and to the gauges near it
    places, edges = full.plain["gauge_stations"], full.plain["strip_lines"]
    gauges, under_loads, _ = np.split(solutions, [len(places), len(places) + 2], axis=1)
    main = np.concatenate((under_loads, solutions[:, -MODES:][:, :SHAPES]), axis=1)
    middle = 0.5 * (edges[1:] + edges[:-1])[full.plain["strip_of"], np.newaxis]
    near = np.abs(places - middle) < 1.5 * np.diff(edges).max()
    changes = [
        part @ np.concatenate((main, gauges[:, close]), axis=1)
        for part, close in zip(full.strips, near, strict=True)
    ]
    return np.concatenate((solutions, factors.riesz(np.concatenate(changes, axis=1))), axis=1)


def _inner(matrix: sparse.csr_array, basis: FloatArray) -> FloatArray:
    """Return basis^T matrix basis, on the rows that the matrix has."""
    used = np.flatnonzero(np.diff(matrix.indptr))
    part = basis[used]
    product = part.T @ (matrix[used][:, used] @ part)
    return np.asarray(0.5 * (product + product.T))


def project(full: PatchOperators, basis: FloatArray) -> PatchArrays:
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
    whole, tip, load_place = stiffness.sum(axis=0), rows["load_tip"], full.plain["load_place"]
    nominal = np.tensordot((1.0, *operators.masses.values()), mass, 1)
    shapes = eigh(whole, nominal, subset_by_index=[0, START_SHAPES - 1])[1]
    return PatchArrays(
        design_hash=operators.design_hash,
        regions=operators.regions,
        validity_box=np.array(list(operators.ranges.values())),
        largest_loss=LARGEST_LOSS,
        largest_compliance=COMPLIANCE_SHARE * float(tip @ np.linalg.solve(whole, tip)) / load_place**2,
        largest_mass=LARGEST_MASS,
        stiffness=stiffness,
        mass=mass,
        strip_stiffness=np.stack([_inner(part, basis)[lower].astype(np.float32) for part in full.strips]),
        start_shapes=_unit(shapes * np.where(rows["tip_row"] @ shapes < 0.0, -1.0, 1.0)),
        **full.plain,
        **rows,
    )


LOAD_WEIGHT = 3.0
"""How much more the solutions under tip force, lift and washed-out lifts count than those under others."""
WASHOUTS = (0.5, 1.0, 2.0, 4.0)
"""Exponents of these."""
OUTBOARD = (0.75, 1.0)
"""Where point forces act, in semi-spans."""
TURNED_WEIGHT = 0.4
"""How much representatives of strain across a gauge and of shear count."""
MODE_WEIGHTS = np.array([3.0, 3.0, 6.0, 3.0, 1.5, 1.0, 0.5, 0.3])
CHANGED, TAKEN = 6, (0.5, 0.75, 0.4, 0.6)
"""Numbers of the changes: start, length, amount of a local loss, root compliance, point mass, its station;
and the shares of the states that have losses of their regions, and each of the three changes."""
PLAIN_WEIGHT = 10.0
"""How much more the wing as it was counts than one of the patched states."""


def _directions(arrays: PatchArrays) -> FloatArray:
    """Return the kept directions (N, n) of the working basis."""
    wing = PatchedWing(arrays)
    eta, upwards = arrays.stations / wing.span, arrays.line_rows[2:]
    washed = np.power.outer(eta, WASHOUTS).T @ arrays.lift_rows
    forces = upwards[:, np.searchsorted(eta, OUTBOARD)].reshape(-1, wing.size)
    span_row, (along, *turned) = arrays.station_weights @ upwards[0], arrays.strain_rows
    groups = (
        np.vstack((arrays.load_tip, arrays.load_lift, washed)),
        np.vstack((arrays.weight, forces, along, arrays.flap_row, span_row)),
        np.vstack(turned),
    )
    columns = np.concatenate(groups).T
    weights = np.repeat((LOAD_WEIGHT, 1.0, TURNED_WEIGHT), [len(rows) for rows in groups])
    all_snapshots = np.zeros((wing.size, wing.size))
    numbers = len(TAKEN) + CHANGED + len(arrays.validity_box) - 2
    places = np.random.default_rng(1).random((STATES, numbers))
    for number, shares in enumerate(places):
        structure = _patched_state(wing, shares, plain=number == 0)
        solutions, modes = _unit(structure.static(columns)), _unit(structure.lowest(MODES).shapes)
        shapes = np.concatenate((solutions * weights, modes * MODE_WEIGHTS), axis=1)
        all_snapshots += shapes @ shapes.T * (1.0 if number else PLAIN_WEIGHT**2)
    first = max(0, wing.size - VECTORS)
    return np.asarray(eigh(all_snapshots, subset_by_index=[first, wing.size - 1])[1][:, ::-1])


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=0))


def _patched_state(wing: PatchedWing, shares: FloatArray, *, plain: bool) -> PatchedState:
    """Return a state at shares of all ranges; `plain`: the wing as it was, in the middle of them."""
    arrays, span = wing.arrays, wing.span
    damaged, *changed = (shares[: len(TAKEN)] < TAKEN) & (not plain)
    start, length, loss, compliance, mass, station, *shares = shares[len(TAKEN) :].tolist()
    low, high = arrays.validity_box[:-2].T  # all but the loads
    values = low + (high - low) * (0.5 if plain else np.array(shares))
    values[1:-2] *= damaged
    changes = (
        LocalStiffnessLoss(loss**0.5 * arrays.largest_loss, start * span, (0.02 + 0.28 * length) * span),
        RootCompliance(compliance * arrays.largest_compliance),
        PointMass(mass * arrays.largest_mass, (0.1 + 0.9 * station) * span),
    )
    patch = ModelPatch(tuple(change for change, taken in zip(changes, changed, strict=True) if taken))
    return wing.at(np.append(values, (0.0, 0.0)), patch)
