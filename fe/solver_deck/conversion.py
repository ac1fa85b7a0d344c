"""From a deck of CalculiX to a structure from matrices, checked against CalculiX itself."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

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

from .calculix_jobs import CalculixJobs, StoredMatrices
from .linear_model import TRANSLATIONS, ContactChoice, HeldMotion, read_linear_model
from .loads import DeckLoad, read_loads
from .regions import (
    Region,
    choose_regions,
    with_densities,
    with_own_materials,
    with_scaled_modulus,
)
from .structure_file import (
    MASS_FILE,
    DeckStructure,
    choose_output_sets,
    has_rows_for,
    row_counts,
    write_structure_files,
)

_CHANGED_MODULUS = 0.5
"""By what the modulus of a region is multiplied to find its stiffness."""
_COMPARED_MODES = 6
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
    report = _compare(file, structure, jobs, blocks, [*model.remarks, *remarks])
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
    deck_loads = read_loads(model)
    remarks += deck_loads.remarks
    counts = row_counts(matrices.places)
    loads = []
    for load in deck_loads.loads:
        if load.acceleration is not None and not model.has_mass:
            remarks.append(f"the load {load.name} is left out: the deck has no *DENSITY")
        elif has_rows_for(load, counts, set(model.held)):
            loads.append(load)
        else:
            remarks.append(
                f"the load {load.name} is left out: it acts on nodes that the matrices do not "
                "have, such as those of a tied surface"
            )
    if not model.has_mass:
        remarks.append("the deck has no *DENSITY: the structure has no mass, hence no modes")
    structure = DeckStructure(
        model=model,
        matrices=matrices,
        region_stiffness=region_stiffness,
        loads=loads,
        gravity_forces=_gravity_forces(jobs, blocks, loads, matrices),
        output_sets=choose_output_sets(model, counts, options.outputs),
        length_unit=options.length_unit,
    )
    return structure, remarks


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
            deviations[load.name] = _largest_deviation(structure, ours / scale, theirs)
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
        has_mass=structure.model.has_mass,
        frequencies=frequencies,
        frequency_deviation=frequency_deviation,
        remarks=remarks,
    )


def _largest_deviation(
    structure: DeckStructure, ours: FloatArray, theirs: dict[int, FloatArray]
) -> float:
    """Return the largest difference of a nodal displacement, over the largest displacement."""
    counts = structure.row_counts()
    held = set(structure.model.held)
    nodes = sorted({node for node, _ in structure.matrices.places})
    differences = [0.0]
    largest = max(float(np.abs(row).max()) for row in theirs.values())
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
    deviations["frequencies"] = report.frequency_deviation
    worst = max(deviations, key=lambda name: deviations[name])
    if not deviations[worst] <= tolerance:
        raise CalculixError(
            f"{deck}: the matrices and CalculiX must agree to {tolerance:g}, but the {worst} "
            f"differ by {deviations[worst]:.2g}; no structure was written. Remove what is not "
            "linear, or allow more by --tolerance."
        )
