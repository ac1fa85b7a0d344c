"""The wing in a basis that is rich enough for the changes of `fe.runtime.patch`.

The basis is made in two steps. A working basis of several hundred vectors spans the solutions of
the full model under loads, point forces, the gauges as loads (which squares the error of a strain),
and each stiffness and mass term, in two states of health. In the working basis many patched states
are solved. The final basis consists of the singular directions of their solutions and modes, with
larger weights for those that are used most.
"""

from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre
from scipy import sparse
from scipy.linalg import eigh

from fe.full.factorisation import Factorisation
from fe.runtime.arrays import FloatArray
from fe.runtime.patch import LocalStiffnessLoss, ModelPatch, PointMass, SupportCompliance
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.patched_wing import PatchedStructure, PatchedWing
from fe.structure.affine import natural_frequencies
from fe.wing.operators import AffineOperators
from fe.wing.patch_operators import PatchOperators, assemble_patch_operators
from reporting.progress import Progress, reporter

LARGEST_LOSS = 0.7
"""Largest loss of stiffness in a box along the span."""
COMPLIANCE_FRACTION = 0.4
"""Largest root compliance as a fraction of the compliance at the tip."""
LARGEST_MASS = 0.25
"""Largest point mass [kg]."""
BASIS_VECTORS = 240
"""Size of the basis."""
PATCHED_STATES = 240
"""Patched states that are solved in the working basis."""
DAMAGED_LOSS = 0.7
"""Stiffness loss of every damage region in the second state of health of the working basis."""
LIFT_POLYNOMIALS = 6
"""Number of Legendre polynomials along the span that weight the lift for the working basis."""
MODES = 8
"""Number of modes among the snapshots."""
INERTIA_SHAPES = 6
"""Number of these modes whose inertia, and whose forces in the skin, are loads as well."""
POINT_STATIONS = 13
"""Approximate number of stations at which point forces act."""
NEAR_GAUGE = 1.5
"""A strip is near a gauge within this multiple of the widest strip."""
START_SHAPES = 16
"""Number of modes from which those of a patched wing are iterated."""
WORKING_TOLERANCE = 3e-7
"""Eigenvalue, relative to the largest, below which the working basis leaves out a direction."""

MAIN_LOAD_WEIGHT = 3.0
"""Weight of the solutions under tip force, lift and washed-out lifts; others have one."""
WASHOUT_EXPONENTS = (0.5, 1.0, 2.0, 4.0)
"""Exponents of the washed-out lifts."""
OUTBOARD_STATIONS = (0.75, 1.0)
"""Stations of point forces, as fractions of the semi-span."""
OTHER_STRAIN_WEIGHT = 0.4
"""Weight of the solutions under strains across a gauge, and under shear strains, as loads."""
MODE_WEIGHTS = np.array([3.0, 3.0, 6.0, 3.0, 1.5, 1.0, 0.5, 0.3])
UNCHANGED_WEIGHT = 10.0
"""Weight of the snapshots of the unchanged wing; those of a patched state have a weight of one."""


class _ChangeProbabilities(NamedTuple):
    """Probabilities that a patched state has losses in regions, and each change."""

    region_losses: float = 0.5
    local_loss: float = 0.75
    compliance: float = 0.4
    point_mass: float = 0.6


class _ChangeFractions(NamedTuple):
    """The values of a patched state's changes, as fractions of their ranges."""

    start: float
    length: float
    loss: float
    compliance: float
    mass: float
    station: float


PROBABILITIES = _ChangeProbabilities()


def reduce_patches(operators: AffineOperators, progress: Progress | None = None) -> PatchArrays:
    """Reduce a wing to the arrays from which it is solved with changes (patches) of its structure.

    Raises
    ------
    SolutionError
        If the full model cannot be solved.
    """
    progress = reporter(progress)
    with progress.stage("Computing solutions of the wing with changes"):
        full_model = assemble_patch_operators(operators)
        basis = _working_basis(full_model)
    with progress.stage("Reducing the patched wing"):
        directions = _kept_directions(project(full_model, basis))
        return project(full_model, basis @ directions)


def _working_basis(full_model: PatchOperators) -> FloatArray:
    """Return a basis (n, N) of the snapshots of the healthy and the damaged wing.

    The columns are orthonormal in the energy norm (method of snapshots): with the eigenpairs of the
    Gram matrix S^T K S v = w v, they are S v / sqrt(w).
    """
    snapshots = np.concatenate(
        (_snapshots(full_model, 0.0), _snapshots(full_model, DAMAGED_LOSS)), axis=1
    )
    gram = snapshots.T @ (full_model.operators.stiffness() @ snapshots)
    squares, vectors = np.linalg.eigh(gram)
    is_large = squares > WORKING_TOLERANCE * squares[-1]
    coordinates = vectors[:, is_large] / np.sqrt(squares[is_large])
    return np.asarray(snapshots @ coordinates)


def _snapshots(full_model: PatchOperators, loss: float) -> FloatArray:
    """Return solutions (n, S) of the full model with the same loss in all damage regions.

    The columns are:

    1. the solutions under the loads of `_snapshot_loads`, each scaled to unit energy norm;
    2. the lowest modes, also of unit energy norm (before scaling, it is the angular frequency);
    3. the solutions under the elastic forces that each part of the skin has in 1 and 2, not scaled.
    """
    operators = full_model.operators
    health = dict.fromkeys(operators.regions, loss)
    factors = Factorisation(operators.stiffness(None, health))
    frequency, modes = natural_frequencies(operators, MODES, health, factors)
    loads = _snapshot_loads(full_model, modes).T
    whitened_loads = factors.whitened(loads)
    dual_norm = np.linalg.norm(whitened_loads, axis=0)
    responses = factors.unwhitened(whitened_loads / dual_norm)
    angular_frequency = 2.0 * np.pi * frequency
    unit_modes = modes / angular_frequency
    solutions = np.concatenate((responses, unit_modes), axis=1)
    skin_forces = np.concatenate(_skin_forces(full_model, solutions), axis=1)
    skin_responses = factors.riesz(skin_forces)
    return np.concatenate((solutions, skin_responses), axis=1)


def _snapshot_loads(full_model: PatchOperators, modes: FloatArray) -> FloatArray:
    """Return the loads (L, n) of the snapshots: rows of the gauges, tip force, lift, then others.

    The row of an output is used as a load, since its solution makes the output accurate. `modes`
    (n, m) are the lowest modes of the model.
    """
    operators = full_model.operators
    lines = full_model.line_rows
    stations = full_model.layout["stations"]
    step = max(1, len(stations) // POINT_STATIONS)
    polynomials = legendre.legvander(2.0 * stations / stations[-1] - 1.0, LIFT_POLYNOMIALS - 1)
    point_forces = (
        lines.elastic_z[2:],  # where point masses may sit
        *(line[step::step] for line in lines.others_z),
        lines.elastic_x[2 * step :: 2 * step],
        lines.elastic_y[2 * step :: 2 * step],
    )
    inertia = [(term @ modes[:, :INERTIA_SHAPES]).T for term in operators.mass_terms]
    return np.vstack(
        (
            full_model.strain_rows.along.toarray(),
            operators.load_tip,
            operators.load_lift,
            operators.tip_row,
            full_model.weight,
            full_model.flap_row,
            polynomials.T @ full_model.lift_rows,
            full_model.strain_rows.across.toarray(),
            full_model.strain_rows.shear.toarray(),
            *(force.toarray() for force in point_forces),
            *inertia,
        )
    )


def _skin_forces(full_model: PatchOperators, solutions: FloatArray) -> list[FloatArray]:
    """Return for each part of the skin its elastic forces (n, s) in some of the snapshot solutions.

    `solutions` (n, S) are those under the loads of `_snapshot_loads`, then the modes. The solutions
    of a gauge are left out for parts far from it.
    """
    layout = full_model.layout
    gauge_stations = layout["gauge_stations"]
    gauge_count = len(gauge_stations)
    main_loads = 2  # tip force and lift
    gauge_solutions, main_load_solutions, _ = np.split(
        solutions, [gauge_count, gauge_count + main_loads], axis=1
    )
    main_modes = solutions[:, -MODES:][:, :INERTIA_SHAPES]
    main_solutions = np.concatenate((main_load_solutions, main_modes), axis=1)
    # the solutions of a gauge's loads matter only for changes in strips close to the gauge
    edges = layout["strip_lines"]
    strip_middles = 0.5 * (edges[1:] + edges[:-1])
    part_middles = strip_middles[layout["strip_of"], np.newaxis]
    widest_strip = np.diff(edges).max()
    distance = np.abs(gauge_stations - part_middles)
    is_near = distance < NEAR_GAUGE * widest_strip
    forces = []
    for part, near_gauges in zip(full_model.strips, is_near, strict=True):
        part_solutions = np.concatenate((main_solutions, gauge_solutions[:, near_gauges]), axis=1)
        forces.append(part @ part_solutions)
    return forces


def _projected(matrix: sparse.csr_array, basis: FloatArray) -> FloatArray:
    """Return basis^T matrix basis (N, N), computed on the rows that the matrix has."""
    rows = np.flatnonzero(np.diff(matrix.indptr))
    basis_rows = basis[rows]
    product = basis_rows.T @ (matrix[rows][:, rows] @ basis_rows)
    return np.asarray(0.5 * (product + product.T))


def project(full_model: PatchOperators, basis: FloatArray) -> PatchArrays:
    """Project the matrices, loads and outputs of a wing on a basis (n, N)."""
    operators = full_model.operators
    stiffness = np.stack([_projected(term.matrix, basis) for term in operators.stiffness_terms])
    mass = np.stack([_projected(term, basis) for term in operators.mass_terms])
    load_tip = np.asarray(operators.load_tip @ basis)
    tip_row = np.asarray(operators.tip_row @ basis)
    # the wing as it was
    nominal_stiffness = stiffness.sum(axis=0)
    nominal_mass = np.tensordot((1.0, *operators.masses.values()), mass, 1)
    # its lowest modes, with an upward motion of the tip
    _, shapes = eigh(nominal_stiffness, nominal_mass, subset_by_index=[0, START_SHAPES - 1])
    moves_down = tip_row @ shapes < 0.0
    upward_shapes = shapes * np.where(moves_down, -1.0, 1.0)
    # its compliance under a force at the tip, as a compliance of the root in rotation
    tip_compliance = float(load_tip @ np.linalg.solve(nominal_stiffness, load_tip))
    squared_arm = full_model.layout["load_place"] ** 2
    largest_compliance = COMPLIANCE_FRACTION * tip_compliance / squared_arm
    # stiffness of the strips, as lower triangles
    lower = np.tril_indices(basis.shape[1])
    strips = []
    for strip in full_model.strips:
        triangle = _projected(strip, basis)[lower]
        strips.append(triangle.astype(np.float32))
    return PatchArrays(
        design_hash=operators.design_hash,
        regions=operators.regions,
        validity_box=np.array(list(operators.ranges.values())),
        largest_loss=LARGEST_LOSS,
        largest_compliance=largest_compliance,
        largest_mass=LARGEST_MASS,
        stiffness=stiffness,
        mass=mass,
        strip_stiffness=np.stack(strips),
        start_shapes=_unit_columns(upward_shapes),
        flap_row=np.asarray(full_model.flap_row @ basis),
        line_rows=np.stack([rows @ basis for rows in full_model.line_rows.stacked]),
        load_tip=load_tip,
        load_lift=np.asarray(operators.load_lift @ basis),
        lift_rows=np.asarray(full_model.lift_rows @ basis),
        weight=np.asarray(full_model.weight @ basis),
        strain_rows=np.stack([rows @ basis for rows in full_model.strain_rows]),
        tip_row=tip_row,
        **full_model.layout,
    )


class _SnapshotLoads(NamedTuple):
    """Loads whose solutions are compressed.

    Attributes
    ----------
    columns : (N, L) array
        The loads in the working basis.
    weights : (L,) array
        The weights of their solutions.
    """

    columns: FloatArray
    weights: FloatArray


def _kept_directions(arrays: PatchArrays) -> FloatArray:
    """Choose directions (N, n) of the working basis by proper orthogonal decomposition.

    They are the eigenvectors with the largest eigenvalues of the weighted sum of the outer products
    of all snapshots: static solutions and modes of the wing with random changes.
    """
    wing = PatchedWing(arrays)
    loads = _weighted_loads(wing)
    outer_products = np.zeros((wing.size, wing.size))
    change_count = len(_ChangeProbabilities._fields) + len(_ChangeFractions._fields)
    value_count = len(arrays.validity_box) - 2  # the last two are load factor and tip force
    generator = np.random.default_rng(1)
    fractions = generator.random((PATCHED_STATES, change_count + value_count))
    for number, state_fractions in enumerate(fractions):
        is_unchanged = number == 0
        structure = _patched_state(wing, state_fractions, unchanged=is_unchanged)
        solutions = structure.static(loads.columns)
        modes = structure.lowest_modes(MODES).shapes
        weighted_solutions = _unit_columns(solutions) * loads.weights
        weighted_modes = _unit_columns(modes) * MODE_WEIGHTS
        snapshots = np.concatenate((weighted_solutions, weighted_modes), axis=1)
        weight = UNCHANGED_WEIGHT**2 if is_unchanged else 1.0
        outer_products += snapshots @ snapshots.T * weight
    first_kept = max(0, wing.size - BASIS_VECTORS)
    _, directions = eigh(outer_products, subset_by_index=[first_kept, wing.size - 1])
    return np.asarray(directions[:, ::-1])


def _weighted_loads(wing: PatchedWing) -> _SnapshotLoads:
    """Return the loads whose solutions span the basis, with the weights of these solutions."""
    arrays = wing.arrays
    eta = arrays.stations / wing.span
    upward_rows = arrays.line_rows[2:]
    washed_out_lifts = np.power.outer(eta, WASHOUT_EXPONENTS).T @ arrays.lift_rows
    point_forces = upward_rows[:, np.searchsorted(eta, OUTBOARD_STATIONS)].reshape(-1, wing.size)
    mean_displacement = arrays.station_weights @ upward_rows[0]
    strain_along, *other_strains = arrays.strain_rows
    main_loads = np.vstack((arrays.load_tip, arrays.load_lift, washed_out_lifts))
    # The rows of an output are loads, too: their solutions make the output accurate.
    output_loads = np.vstack(
        (arrays.weight, point_forces, strain_along, arrays.flap_row, mean_displacement)
    )
    other_strain_loads = np.vstack(other_strains)
    weights = (MAIN_LOAD_WEIGHT, 1.0, OTHER_STRAIN_WEIGHT)
    counts = [len(main_loads), len(output_loads), len(other_strain_loads)]
    return _SnapshotLoads(
        columns=np.concatenate((main_loads, output_loads, other_strain_loads)).T,
        weights=np.repeat(weights, counts),
    )


def _unit_columns(vectors: FloatArray) -> FloatArray:
    """Scale vectors (N, k) to length one."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=0))


def _patched_state(
    wing: PatchedWing, fractions: FloatArray, *, unchanged: bool
) -> PatchedStructure:
    """Return a wing whose modulus, damage, masses and changes are fractions of their ranges.

    Parameters
    ----------
    fractions : (F,) array
        Numbers from 0 to 1. The first decide which changes the wing has, by `PROBABILITIES`. The
        next are fractions of the ranges of these changes (`_ChangeFractions`), and the last are
        fractions of the ranges of modulus, losses and masses.
    unchanged : bool
        Whether to return the wing without changes and damage, at the midpoints of its ranges.
    """
    arrays = wing.arrays
    draws, change_values, value_fractions = np.split(
        fractions,
        [len(PROBABILITIES), len(PROBABILITIES) + len(_ChangeFractions._fields)],
    )
    occurs = (draws < PROBABILITIES) & (not unchanged)
    has_losses, *has_change = occurs
    # modulus, losses of the regions and masses
    low, high = arrays.validity_box[:-2].T  # without load factor and tip force
    values = low + (high - low) * (0.5 if unchanged else value_fractions)
    values[1:-2] *= has_losses  # between the modulus and the two masses
    # changes of the patch
    change = _ChangeFractions(*change_values.tolist())
    changes = (
        LocalStiffnessLoss(
            change.loss**0.5 * arrays.largest_loss,
            change.start * wing.span,
            (0.02 + 0.28 * change.length) * wing.span,
        ),
        SupportCompliance("root", "rx", change.compliance * arrays.largest_compliance),
        PointMass(change.mass * arrays.largest_mass, (0.1 + 0.9 * change.station) * wing.span),
    )
    patch = ModelPatch(
        tuple(part for part, is_present in zip(changes, has_change, strict=True) if is_present)
    )
    no_loads = (0.0, 0.0)
    return wing.structure_at(np.append(values, no_loads), patch)
