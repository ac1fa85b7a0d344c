"""From a deck of CalculiX to a structure from matrices, checked against CalculiX itself."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import ArpackError

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import CalculixError, FiniteElementError, SolutionError
from fe.structure.abaqus import KeywordBlock
from fe.structure.affine import natural_frequencies, static_responses
from fe.structure.matrix_files import READ_WEIGHTS
from fe.structure.operators import assemble_structure
from fe.structure.tables import UNITS
from fe.verification.calculix_run import required_calculix

from .bound_motions import MOST_MOMENTS, read_rotations, read_tied_motions
from .calculix_jobs import CalculixJobs, StoredMatrices
from .linear_model import (
    TRANSLATIONS,
    ContactChoice,
    HeldMotion,
    LinearModel,
    read_linear_model,
)
from .loads import DeckLoad, read_loads
from .regions import (
    Region,
    choose_regions,
    with_densities,
    with_own_materials,
    with_scaled_modulus,
)
from .row_vectors import LoadRows
from .structure_file import (
    MASS_FILE,
    DeckStructure,
    choose_output_sets,
    row_counts,
    write_structure_files,
)

_CHANGED_MODULUS = 0.5
"""By what the modulus of a region is multiplied to find its stiffness."""
_COMPARED_MODES = 6
MOMENT_TOLERANCE = 1e-4
"""Deviation that is accepted under moments on beams, if the tolerance is smaller.

CalculiX changes the weights of the mean rotation of a beam's section by up to 1e-5 at random
(routine usermpc.f), so that no two of its runs agree better.
"""
_ROUNDING = 1e-12
"""A region changes nothing if it changes no entry by this fraction of the largest one."""


@dataclass(frozen=True)
class DeckOptions:
    """What a user chooses of a deck.

    Attributes
    ----------
    length_unit : str
        Unit of length of the deck.
    regions, outputs : sequence of str
        Sets of elements that may lose stiffness, and of nodes whose displacement is an output; if
        empty, they are chosen.
    contact : "tied" or "open"
        What becomes of contact pairs.
    time_limit : float
        Time that a run of CalculiX may take [s].
    tolerance : float
        Largest relative deviation from CalculiX.
    """

    length_unit: str = "mm"
    regions: Sequence[str] = ()
    outputs: Sequence[str] = ()
    contact: ContactChoice = "tied"
    time_limit: float = 600.0
    tolerance: float = 1e-5


@dataclass(frozen=True)
class DeckReport:
    """A structure that was made from a deck, and how it agrees with CalculiX.

    Attributes
    ----------
    unknowns : int
        Number of unknowns.
    regions : list of Region
        The regions that may lose stiffness.
    load_deviations : dict of str to float
        For each load the largest difference of a nodal displacement to that of CalculiX, over the
        largest displacement.
    load_limits : dict of str to float
        For each load the largest deviation that is accepted.
    has_mass : bool
        Whether the deck has a density.
    frequencies : (m,) array
        Lowest frequencies [Hz]. If the deck has no density, they are those with the density
        `COMPARED_DENSITY`, and serve for the comparison alone.
    frequency_deviation : float
        Largest relative difference of a frequency to that of CalculiX.
    remarks : list of str
        Sentences on what is linearised and what is left out.
    """

    unknowns: int
    regions: list[Region]
    load_deviations: dict[str, float]
    load_limits: dict[str, float]
    has_mass: bool
    frequencies: FloatArray
    frequency_deviation: float
    remarks: list[str]


def convert_deck(deck: Path, folder: Path, name: str, options: DeckOptions) -> DeckReport:
    """Write a deck as a structure from matrices, and compare it with CalculiX.

    Parameters
    ----------
    deck : Path
        The deck.
    folder : Path
        An existing empty folder for the structure. CalculiX works in its folder `calculix`.
    name : str
        Name of the structure and of its file.
    options : DeckOptions
        What the user chooses.

    Raises
    ------
    CalculixError
        If CalculiX is not installed or fails, if the structure deviates from it by more than the
        tolerance, or if nothing of the structure can be compared with it.
    MeshError
        If the deck cannot be read, or is not one of an elastic structure.
    SolutionError
        If the structure is not held.
    """
    try:
        return _convert(deck, folder, name, options)
    except FiniteElementError as error:
        raise type(error)(_sentence_on_deck(deck, folder, str(error))) from None
    except (np.linalg.LinAlgError, ArpackError) as error:
        raise SolutionError(
            f"{deck}: the matrices of CalculiX cannot be solved ({error}); see that every part of "
            "the structure is held and has stiffness."
        ) from None


def _sentence_on_deck(deck: Path, folder: Path, message: str) -> str:
    """Return a message that names the deck in place of files in the scratch folder."""
    scratch_file = re.escape(str(folder)) + r"[^\s:,;()\[\]]*[^\s:,;()\[\].]"
    sentence = re.sub(scratch_file, lambda _: str(deck), message)
    if str(deck) in sentence:
        return sentence
    return f"{deck}: {sentence}"


def _convert(deck: Path, folder: Path, name: str, options: DeckOptions) -> DeckReport:
    """Write a deck as a structure; the parameters are those of `convert_deck`."""
    required_calculix()
    model = read_linear_model(deck, options.contact)
    regions = choose_regions(model, options.regions)
    jobs = CalculixJobs(model, folder / "calculix", options.time_limit)
    blocks = with_densities(model, with_own_materials(model, regions))
    structure, remarks = _structure_of_deck(jobs, blocks, regions, options)
    file = write_structure_files(structure, folder, name)
    report = _compare(file, structure, jobs, blocks, [*model.remarks, *remarks], options.tolerance)
    _refuse_deviations(deck, report, options.tolerance)
    if not model.has_mass:
        sparse.save_npz(folder / MASS_FILE, 0.0 * structure.matrices.mass)
    return report


def _structure_of_deck(
    jobs: CalculixJobs, blocks: list[KeywordBlock], regions: list[Region], options: DeckOptions
) -> tuple[DeckStructure, list[str]]:
    """Return a deck as matrices, and sentences on loads that are left out."""
    model = jobs.model
    matrices = jobs.matrices("whole", blocks)
    remarks: list[str] = []
    region_stiffness = {}
    for number, region in enumerate(regions, start=1):
        changed = jobs.matrices(
            f"region{number}", with_scaled_modulus(blocks, number, _CHANGED_MODULUS)
        )
        if changed.places != matrices.places:
            raise CalculixError(
                f"{model.path}: the matrices of one run have other rows when the modulus of "
                f"{region.set_name} changes; name other regions by --region."
            )
        difference = matrices.stiffness - changed.stiffness
        if abs(difference).max() > _ROUNDING * abs(matrices.stiffness).max():
            region_stiffness[region] = (difference / (1.0 - _CHANGED_MODULUS)).tocsr()
        else:
            remarks.append(
                f"{region.set_name} is no region: its modulus changes nothing that can move"
            )
    chosen = _choose_loads(jobs, blocks, matrices)
    remarks += chosen.remarks
    if not model.has_mass:
        remarks.append("the deck has no *DENSITY: the structure has no mass, hence no modes")
    structure = DeckStructure(
        model=model,
        matrices=matrices,
        region_stiffness=region_stiffness,
        loads=chosen.loads,
        load_vectors=chosen.vectors,
        output_sets=choose_output_sets(model, row_counts(matrices.places), options.outputs),
        length_unit=options.length_unit,
    )
    return structure, remarks


class _ChosenLoads(NamedTuple):
    """The loads that act on a structure, and sentences on those that are left out.

    Attributes
    ----------
    loads : list of DeckLoad
        The loads.
    vectors : dict of str to (n,) array
        The forces of those that nodes and directions alone do not describe.
    remarks : list of str
        The sentences.
    """

    loads: list[DeckLoad]
    vectors: dict[str, FloatArray]
    remarks: list[str]


def _choose_loads(
    jobs: CalculixJobs, blocks: list[KeywordBlock], matrices: StoredMatrices
) -> _ChosenLoads:
    """Return the loads of a deck whose action on the rows of the matrices is known."""
    deck_loads = read_loads(jobs.model)
    remarks = list(deck_loads.remarks)
    load_rows = _load_rows(jobs, blocks, matrices, deck_loads.loads)
    loads = []
    for load in deck_loads.loads:
        if load.acceleration is not None and not jobs.model.has_mass:
            remarks.append(f"the load {load.name} is left out: the deck has no *DENSITY")
        elif load_rows.missing_rotations(load):
            node, _ = load_rows.missing_rotations(load)[0]
            remarks.append(
                f"the load {load.name} is left out: node {node} has no rotation on which its "
                "moment could act"
            )
        elif load_rows.missing(load):
            remarks.append(
                f"the load {load.name} is left out: it acts on nodes whose motion does not follow "
                "from the matrices, such as those of shells that are tied"
            )
        else:
            loads.append(load)
    vectors = _gravity_forces(jobs, blocks, loads, matrices)
    for load in loads:
        if load.name not in vectors and not load_rows.names_all(load):
            vectors[load.name] = load_rows.vector(load)
    return _ChosenLoads(loads, vectors, remarks)


def _load_rows(
    jobs: CalculixJobs,
    blocks: list[KeywordBlock],
    matrices: StoredMatrices,
    loads: list[DeckLoad],
) -> LoadRows:
    """Return how the loads act on the rows, also where CalculiX has eliminated what they move."""
    load_rows = LoadRows(matrices.places, set(jobs.model.held))
    of_elements = {node for element in jobs.model.mesh.elements.values() for node in element.nodes}
    with_rows = set(matrices.places)
    tied = [
        place
        for load in loads
        for place in load_rows.missing(load)
        if place[0] in of_elements and place not in with_rows
    ]
    with_rotations = {
        node
        for element in jobs.model.mesh.elements.values()
        if element.has_rotations
        for node in element.nodes
    }
    rotations = [
        place
        for load in loads
        for place in load_rows.missing_rotations(load)
        if place[0] in with_rotations
    ]
    bound = read_tied_motions(jobs, blocks, matrices, list(dict.fromkeys(tied)))
    bound |= read_rotations(jobs, blocks, matrices, list(dict.fromkeys(rotations))[:MOST_MOMENTS])
    return LoadRows(matrices.places, load_rows.held, bound)


def _gravity_forces(
    jobs: CalculixJobs,
    blocks: list[KeywordBlock],
    loads: list[DeckLoad],
    matrices: StoredMatrices,
) -> dict[str, FloatArray]:
    """Return the nodal forces (n,) of each load that has an acceleration.

    The rows of held nodes are missing in the mass matrix, but their mass also loads the nodes
    beside them. For this reason the mass matrix of the structure without supports is multiplied by
    the acceleration, and the rows of both are matched by name.
    """
    accelerations = {
        load.name: load.acceleration for load in loads if load.acceleration is not None
    }
    if not accelerations:
        return {}
    free = jobs.matrices("free", blocks, free=True)
    forces = {}
    for name, acceleration in accelerations.items():
        field = [
            acceleration[axis - 1] if node in jobs.model.mesh.points else 0.0
            for node, axis in free.places
        ]
        free_forces = free.mass @ np.array(field)
        forces[name] = _matched_rows(free_forces, free, matrices)
    return forces


def _matched_rows(values: FloatArray, source: StoredMatrices, target: StoredMatrices) -> FloatArray:
    """Return the values of the target's rows, matched by name and order.

    Names with other numbers of rows belong to held nodes; their values are zero.
    """
    source_counts = row_counts(source.places)
    target_counts = row_counts(target.places)
    values_of_place: dict[tuple[int, int], list[float]] = {}
    for place, value in zip(source.places, values.tolist(), strict=True):
        values_of_place.setdefault(place, []).append(value)
    matched = []
    for place in target.places:
        if source_counts.get(place) == target_counts[place]:
            matched.append(values_of_place[place].pop(0))
        else:
            matched.append(0.0)
    return np.array(matched)


def _compare(
    file: Path,
    structure: DeckStructure,
    jobs: CalculixJobs,
    blocks: list[KeywordBlock],
    remarks: list[str],
    tolerance: float,
) -> DeckReport:
    """Return how a structure file agrees with CalculiX in statics and frequencies."""
    assembled = assemble_structure(file)
    deviations = {}
    if structure.loads:
        # Our factors come first: they refuse a mechanism, on which CalculiX computes nonsense.
        responses = static_responses(assembled)
        printed = jobs.displacements(structure.loads, blocks)
        for load, theirs in zip(structure.loads, printed, strict=True):
            ours = assembled.full_displacement(responses[load.name].displacement)
            scale = UNITS[structure.length_unit]
            largest = float(np.abs(responses[load.name].displacement).max()) / scale
            deviations[load.name] = _largest_deviation(structure, ours / scale, theirs, largest)
    frequencies = np.empty(0)
    frequency_deviation = 0.0
    if assembled.unknowns > 1:
        count = min(_COMPARED_MODES, max(1, assembled.unknowns // 4))
        frequencies = natural_frequencies(assembled, count).frequency
        calculix_frequencies = jobs.frequencies(count, blocks)
        frequencies = frequencies[: len(calculix_frequencies)]
        frequency_deviation = float(np.abs(frequencies / calculix_frequencies - 1.0).max())
    return DeckReport(
        unknowns=assembled.unknowns,
        regions=list(structure.region_stiffness),
        load_deviations=deviations,
        load_limits={
            load.name: _limit(structure.model, load, tolerance) for load in structure.loads
        },
        has_mass=structure.model.has_mass,
        frequencies=frequencies,
        frequency_deviation=frequency_deviation,
        remarks=remarks,
    )


def _limit(model: LinearModel, load: DeckLoad, tolerance: float) -> float:
    """Return the largest deviation that is accepted under a load."""
    of_beams = {
        node
        for element in model.mesh.elements.values()
        if element.type_name.startswith("B")
        for node in element.nodes
    }
    if any(node in of_beams for node, _ in load.moments):
        return max(tolerance, MOMENT_TOLERANCE)
    return tolerance


def _largest_deviation(
    structure: DeckStructure,
    ours: FloatArray,
    theirs: dict[int, FloatArray],
    largest_of_rows: float,
) -> float:
    """Return the largest difference of a nodal displacement, over the largest displacement.

    The largest displacement is that of any node, or of any row: under torsion of a straight beam
    its section alone moves.
    """
    counts = structure.row_counts()
    held = set(structure.model.held)
    nodes = sorted({node for node, _ in structure.matrices.places})
    differences = [0.0]
    largest = max(largest_of_rows, *(float(np.abs(row).max()) for row in theirs.values()))
    for node, displacement in zip(nodes, ours, strict=True):
        for axis in TRANSLATIONS:
            is_read = counts.get((node, axis)) in READ_WEIGHTS
            if node in theirs and is_read and HeldMotion(node, axis) not in held:
                differences.append(abs(float(displacement[axis - 1] - theirs[node][axis - 1])))
    return max(differences) / largest if largest > 0.0 else 0.0


def _refuse_deviations(deck: Path, report: DeckReport, tolerance: float) -> None:
    """Raise `CalculixError` if the structure deviates from CalculiX, or nothing was compared."""
    if not report.load_deviations and not len(report.frequencies):
        raise CalculixError(
            f"{deck}: a structure of {report.unknowns} unknown has no frequency that could be "
            "compared with CalculiX, and no load of the deck was read; add a *STEP with *STATIC "
            "and a *CLOAD."
        )
    deviations = {
        f"displacements under {name}": value for name, value in report.load_deviations.items()
    }
    limits = {f"displacements under {name}": value for name, value in report.load_limits.items()}
    deviations["frequencies"] = report.frequency_deviation
    limits["frequencies"] = tolerance
    worst = max(deviations, key=lambda name: deviations[name] / limits[name])
    if not deviations[worst] <= limits[worst]:
        raise CalculixError(
            f"{deck}: the matrices and CalculiX must agree to {limits[worst]:g}, but the {worst} "
            f"differ by {deviations[worst]:.2g}; no structure was written. Remove what is not "
            "linear, or allow more by --tolerance."
        )
