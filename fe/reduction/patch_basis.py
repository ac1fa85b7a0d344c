"""Offline: the wing in a basis that is rich enough for the changes of `fe.runtime.patch`.

In two steps. A working basis of several hundred vectors holds what the full model answers to loads, to point
forces and to each stiffness and mass term, at two states of health, and representatives of the gauges (whose
presence squares the error of a strain). In it, many patched states are solved; the singular directions of
their solutions and modes, weighed by what is looked at most, are the basis that is kept.
"""

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve, eigh

from fe.full.subspace import Norm
from fe.runtime.patch_arrays import PatchArrays
from fe.wing.operators import AffineOperators, point_masses
from fe.wing.patch_operators import PatchOperators, assemble_patch_operators
from reporting.progress import Progress, SilentProgress

from .settings import ReductionSettings

FloatArray = npt.NDArray[np.float64]

DAMAGED_ANCHOR = 0.7
"""Stiffness loss of every damage region in the second state of health at which the full model is solved."""
LIFT_MOMENTS = 6
"""Courses of the lift along the span for which the full model is solved: Legendre polynomials."""
MODES = 8
SUBSPACE_ITERATIONS = 6
START_SHAPES = 16
"""Modes from which those of a patched wing are iterated."""


@dataclass(frozen=True)
class PatchSettings:
    """How far changes may go and how many vectors hold them.

    Attributes
    ----------
    ranges : ReductionSettings
        Ranges of e, the losses and the masses, those of the reduced model.
    strip_count : int
        Largest number of strips of the skin; by default each row of cells along the span is one.
    vectors : int
        Size n of the basis.
    states : int
        Patched states that are solved in the working basis.
    largest_loss : float
        Loss of stiffness in a box along the span.
    compliance_share : float
        Root compliance, as a share of the tip's compliance.
    largest_mass : float
        Point mass [kg].
    seed : int
        Of the states.
    """

    ranges: ReductionSettings = field(default_factory=ReductionSettings)
    strip_count: int = 64
    vectors: int = 240
    states: int = 160
    largest_loss: float = 0.7
    compliance_share: float = 0.4
    largest_mass: float = 0.25
    seed: int = 1


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
        working = project(full, basis, settings)
        return projected(working, _directions(working, settings), settings)


def _unit_energy(vectors: FloatArray, stiffness: Any) -> FloatArray:
    energy = np.einsum("ik,ik->k", vectors, stiffness @ vectors)
    return np.asarray(vectors / np.sqrt(np.where(energy > 0.0, energy, 1.0)))


def _responses(full: PatchOperators, norm: Norm, settings: PatchSettings, *, main: bool) -> FloatArray:
    """Return solutions (n, k) of the full model at one state of health, in their natural sizes.

    `main`: more of them, for the state of health that is looked at most.
    """
    operators, stiffness = full.operators, norm.stiffness
    stations = len(full.stations)
    eta = full.stations / full.stations[-1]
    moments = np.polynomial.legendre.legvander(2.0 * eta - 1.0, LIFT_MOMENTS - 1)
    step = max(1, stations // 13)
    lines = [
        full.line_rows[2][2 : None : 1 if main else step].toarray(),  # where point masses may sit
        *(rows[step::step].toarray() for rows in full.line_rows[3:]),
        *(rows[2 * step :: 2 * step].toarray() for rows in full.line_rows[:2]),
    ]
    flap = np.zeros(operators.unknowns)
    flap[full.flap] = 1.0
    loads = np.vstack(
        [
            operators.load_tip,
            operators.load_lift,
            operators.tip_row,
            (full.lift_rows.T @ moments).T,
            full.weight,
            flap,
            *lines,
            *(rows.toarray() for rows in (full.strain_rows if main else ())),
            operators.gauge_output.toarray(),
        ]
    ).T
    solutions = norm.riesz(loads)
    gauges = solutions[:, -operators.gauge_output.shape[0] :]
    solutions = _unit_energy(solutions, stiffness)
    mean = settings.ranges
    mass = operators.mass(point_masses(*map(float, map(np.mean, (mean.servo_mass, mean.pitot_mass)))))
    vectors = np.random.default_rng(settings.seed).normal(size=(operators.unknowns, MODES + 6))
    for _ in range(SUBSPACE_ITERATIONS):
        vectors = np.linalg.qr(norm.riesz(np.asarray(mass @ vectors)))[0]
    _, coordinates = eigh(vectors.T @ (stiffness @ vectors), vectors.T @ (mass @ vectors))
    modes = _unit_energy(vectors @ coordinates[:, :MODES], stiffness)
    # what each part of the skin does to the main solutions, and to the gauges near it
    shapes = np.concatenate((solutions[:, :2], modes[:, : 6 if main else 3]), axis=1)
    changes = [np.asarray(part @ shapes) for part in full.strip_stiffness]
    places = np.array(operators.wing_mesh.design.gauges.positions)[:, 0]
    middle = 0.5 * (full.strip_lines[1:] + full.strip_lines[:-1])
    reach = 1.5 * float(np.diff(full.strip_lines).max())
    gauges = _unit_energy(gauges, stiffness)
    for part, strip in zip(full.strip_stiffness, full.strip_of, strict=True):
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
    operators = full.operators
    size = basis.shape[1]
    lower = np.tril_indices(size)
    along = full.operators.gauge_output
    stiffness = np.stack([_inner(term.matrix, basis) for term in operators.stiffness_terms])
    tip = operators.load_tip @ basis
    compliance = float(tip @ np.linalg.solve(stiffness.sum(axis=0), tip))
    design = operators.wing_mesh.design
    span, place = design.planform.semi_span, design.planform.semi_span - design.tip_load.distance_from_tip
    return PatchArrays(
        design_hash=operators.design_hash,
        region_names=" ".join(operators.regions),
        validity_box=np.array(list(settings.ranges.named_ranges(operators.regions).values())),
        largest_loss=settings.largest_loss,
        largest_compliance=settings.compliance_share * compliance / place**2,
        largest_mass=settings.largest_mass,
        stiffness=stiffness,
        mass=np.stack([_inner(term, basis) for term in operators.mass_terms]),
        strip_lines=np.array(full.strip_lines),
        strip_stiffness=np.stack(
            [_inner(part, basis)[lower].astype(np.float32) for part in full.strip_stiffness]
        ),
        strip_of=full.strip_of.astype(np.int64),
        term_of=full.term_of.astype(np.int64),
        flap_row=np.array(basis[full.flap]),
        flap_spring=full.flap_spring,
        semi_span=span,
        root_chord=design.planform.root_chord,
        tip_chord=design.planform.tip_chord,
        straight_chord_line=design.planform.straight_chord_line,
        load_place=place,
        stations=full.stations,
        line_chord=full.line_chord,
        line_rows=np.stack([np.asarray(rows @ basis) for rows in full.line_rows]),
        station_weights=area_shares(full.stations, design.planform.root_chord, design.planform.tip_chord),
        load_tip=tip,
        load_lift=operators.load_lift @ basis,
        lift_rows=np.asarray(full.lift_rows @ basis),
        weight=full.weight @ basis,
        strain_rows=np.stack([np.asarray(rows @ basis) for rows in (along, *full.strain_rows)]),
        gauge_stations=np.array([place for place, _ in design.gauges.positions]),
        gauge_length=design.gauges.averaging_spanwise,
        tip_row=operators.tip_row @ basis,
        start_shapes=np.eye(size)[:, :START_SHAPES],
    )


def area_shares(stations: FloatArray, root_chord: float, tip_chord: float) -> FloatArray:
    """Return weights (P,), of sum one, whose sum with a course along the span is its mean over the planform.

    The course is a parabola through each mesh line, the middle and the next; Simpson's rule with the chord
    times it a cubic is exact.
    """
    chord = root_chord + (tip_chord - root_chord) * stations / stations[-1]
    weights = np.zeros(len(stations))
    length = stations[2::2] - stations[:-2:2]
    for offset, share in ((0, 1.0), (1, 4.0), (2, 1.0)):
        np.add.at(weights, np.arange(offset, len(stations) - 2 + offset, 2), share / 6.0 * length)
    weights *= chord
    return np.asarray(weights / weights.sum())


def projected(arrays: PatchArrays, directions: FloatArray, settings: PatchSettings) -> PatchArrays:
    """Return the arrays in a part of their basis, `directions` (N, n) orthonormal."""
    size = directions.shape[1]
    lower = np.tril_indices(size)
    strips = [
        (directions.T @ unpacked(part, len(directions)) @ directions)[lower]
        for part in arrays.strip_stiffness
    ]

    def symmetric(terms: FloatArray) -> FloatArray:
        small = directions.T @ terms @ directions
        return np.asarray(0.5 * (small + small.transpose(0, 2, 1)))

    values = {item.name: getattr(arrays, item.name) for item in fields(arrays)}
    for name in (
        "flap_row", "line_rows", "load_tip", "load_lift", "lift_rows", "weight", "strain_rows", "tip_row"
    ):  # fmt: skip
        values[name] = values[name] @ directions
    values["stiffness"], values["mass"] = symmetric(arrays.stiffness), symmetric(arrays.mass)
    values["strip_stiffness"] = np.array(strips, dtype=np.float32)
    mass = np.tensordot((1.0, *settings.ranges.nominal_masses), values["mass"], 1)
    shapes = eigh(values["stiffness"].sum(axis=0), mass, subset_by_index=[0, START_SHAPES - 1])[1]
    values["start_shapes"] = _unit(shapes * np.where(values["tip_row"] @ shapes < 0.0, -1.0, 1.0))
    return PatchArrays(**values)


def unpacked(part: npt.NDArray[np.float32], size: int) -> FloatArray:
    """Return the symmetric matrix (n, n) of its packed lower triangle."""
    matrix = np.zeros((size, size))
    matrix[np.tril_indices(size)] = part
    return matrix + np.tril(matrix, -1).T


def _directions(arrays: PatchArrays, settings: PatchSettings) -> FloatArray:
    """Return the kept directions (N, n) of the working basis."""
    generator = np.random.default_rng(settings.seed)
    size = len(arrays.load_tip)
    strips = [unpacked(part, size) for part in arrays.strip_stiffness]
    span_row = arrays.station_weights @ arrays.line_rows[2]
    start = _first_modes(
        np.eye(size)[:, : MODES + 6], arrays.stiffness.sum(axis=0), _mass(arrays, 0.17, 0.13)
    )
    all_snapshots = np.zeros((size, size))
    for number in range(settings.states):
        stiffness, mass, loads = _patched_state(arrays, strips, settings, generator, plain=number == 0)
        factor = cho_factor(stiffness)
        gauges = np.concatenate(arrays.strain_rows).T
        columns = np.concatenate((loads, gauges, arrays.flap_row[:, None], span_row[:, None]), axis=1)
        solutions = _unit(cho_solve(factor, columns))
        modes = start
        for _ in range(3):
            modes = _first_modes(cho_solve(factor, mass @ modes), stiffness, mass)
        modes = _unit(modes[:, :MODES])
        weights = np.ones(solutions.shape[1])
        weights[:3] = LOAD_WEIGHT
        weights[len(loads.T) + len(gauges.T) // 3 : -2] = TURNED_WEIGHT
        plainly = 10.0 if number == 0 else 1.0  # the wing as it was is looked at most
        shapes = np.concatenate((solutions * weights, modes * MODE_WEIGHTS), axis=1) * plainly
        all_snapshots += shapes @ shapes.T
    return _leading(all_snapshots, settings.vectors)


LOAD_WEIGHT = 3.0
"""How much more the solutions under tip force, lift and a washed-out lift count than those under others."""
TURNED_WEIGHT = 0.4
"""How much representatives of strain across a gauge and of shear count."""
MODE_WEIGHTS = np.array([3.0, 3.0, 4.0, 3.0, 1.5, 1.0, 0.5, 0.3])


def _leading(gram: FloatArray, count: int) -> FloatArray:
    """Return the `count` eigenvectors (N, count) of the largest eigenvalues."""
    size = len(gram)
    first = max(0, size - count)
    return np.asarray(eigh(gram, subset_by_index=[first, size - 1])[1][:, ::-1])


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=0))


def _mass(arrays: PatchArrays, servo: float, pitot: float) -> FloatArray:
    return np.asarray(arrays.mass[0] + servo * arrays.mass[1] + pitot * arrays.mass[2])


def _first_modes(vectors: FloatArray, stiffness: FloatArray, mass: FloatArray) -> FloatArray:
    vectors = np.linalg.qr(vectors)[0]
    return np.asarray(vectors @ eigh(vectors.T @ stiffness @ vectors, vectors.T @ mass @ vectors)[1])


def _patched_state(
    arrays: PatchArrays,
    strips: list[FloatArray],
    settings: PatchSettings,
    generator: np.random.Generator,
    *,
    plain: bool,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return stiffness, mass and loads (N, 3 + 2 L) of a random state; `plain`: of the wing as it was."""
    ranges, span = settings.ranges, arrays.semi_span
    e, *losses, servo, pitot = (
        float(generator.uniform(*pair))
        for pair in (
            ranges.young_modulus_factor,
            *(ranges.stiffness_loss,) * len(arrays.regions),
            ranges.servo_mass,
            ranges.pitot_mass,
        )
    )
    with_damage, with_box, with_compliance, with_mass = generator.random(4) < (0.5, 0.75, 0.4, 0.6)
    start, length = generator.uniform(-0.05, 0.9) * span, generator.uniform(0.02, 0.3) * span
    loss = generator.uniform(0.1, arrays.largest_loss)
    compliance = generator.uniform(0.0, arrays.largest_compliance)
    added, station = generator.uniform(0.0, arrays.largest_mass), generator.uniform(0.1, 1.0) * span
    exponent = generator.uniform(0.5, 4.0)
    stations, lines = arrays.stations, arrays.strip_lines
    outboard = int(generator.integers(int(0.55 * len(stations)), len(stations)))
    if plain:
        e, servo, pitot = 1.0, *settings.ranges.nominal_masses
        with_damage = with_box = with_compliance = with_mass = False
    theta = np.array((e, *(1.0 - z if with_damage else 1.0 for z in losses), 1.0))
    stiffness = np.tensordot(theta, arrays.stiffness, 1)
    if with_box:
        overlap = np.minimum(lines[1:], start + length) - np.maximum(lines[:-1], start)
        share = np.clip(overlap, 0.0, None) / np.diff(lines)
        for part, strip, term in zip(strips, arrays.strip_of, arrays.term_of, strict=True):
            if share[strip] > 0.0:
                stiffness -= loss * share[strip] * theta[term] * part
    if with_compliance:
        softer = 1.0 / (1.0 / arrays.flap_spring + compliance) - arrays.flap_spring
        stiffness += softer * np.outer(arrays.flap_row, arrays.flap_row)
    mass = _mass(arrays, servo, pitot)
    if with_mass:
        nearest = int(np.abs(stations - station).argmin())
        for row in arrays.line_rows[:3, nearest]:
            mass += added * np.outer(row, row)
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
    return stiffness, mass, loads
