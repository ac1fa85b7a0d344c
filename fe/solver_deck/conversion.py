"""Convert a deck of CalculiX to a structure from matrices, and check it against CalculiX."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import ArpackError

from fe.full.factorisation import Factorisation
from fe.runtime.arrays import FloatArray
from fe.runtime.errors import CalculixError, FiniteElementError, SolutionError
from fe.structure.abaqus import KeywordBlock
from fe.verification.calculix_run import required_calculix

from .bound_motions import MOST_MOMENTS, read_rotations, read_tied_motions
from .calculix_jobs import CalculixJobs, StoredMatrices
from .comparison import DeckReport, compare_with_calculix, refuse_deviations
from .couplings import share_over_couplings
from .linear_model import (
    ContactChoice,
    LinearModel,
    PreloadChoice,
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
from .row_vectors import MotionRows
from .structure_file import (
    MASS_FILE,
    MOST_OUTPUTS,
    DeckStructure,
    OutputSet,
    choose_output_sets,
    movable_output,
    write_structure_files,
)

_CHANGED_MODULUS = 0.5
"""Factor on the modulus of a region with which its stiffness is found."""
_LIFT = 5e-4
"""Fraction of the stiffness that is added before the remainder is tested for definiteness."""
_ROUNDING = 1e-12
"""Fraction of the largest entry below which a change of the stiffness is rounding."""


@dataclass(frozen=True)
class DeckOptions:
    """The choices of a user on the conversion of a deck.

    Attributes
    ----------
    regions, outputs : sequence of str
        Sets of elements that may lose stiffness, and of nodes whose displacement is an output; if
        empty, they are chosen.
    contact : "tied" or "open"
        How contact pairs are modelled.
    preload : "tangent" or "none"
        How a preload is modelled.
    time_limit : float
        Longest time of a run of CalculiX [s].
    tolerance : float
        Largest relative deviation from CalculiX.
    """

    length_unit: str = "mm"
    regions: Sequence[str] = ()
    outputs: Sequence[str] = ()
    contact: ContactChoice = "tied"
    preload: PreloadChoice = "tangent"
    time_limit: float = 600.0
    tolerance: float = 1e-5


def convert_deck(deck: Path, folder: Path, name: str, options: DeckOptions) -> DeckReport:
    """Convert a deck to a structure from matrices, and compare it with CalculiX.

    Parameters
    ----------
    folder : Path
        An existing empty folder for the structure. CalculiX works in its folder `calculix`.
    name : str
        Name of the structure and of its file.

    Raises
    ------
    CalculixError
        If CalculiX is not installed or fails, if the structure deviates from it by more than the
        tolerance, or if nothing of the structure can be compared with it.
    MeshError
        If the deck cannot be read, or does not describe an elastic structure.
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
    """Return a message with the deck's name in place of files in the scratch folder."""
    scratch_file = re.escape(str(folder)) + r"[^\s:,;()\[\]]*[^\s:,;()\[\].]"
    sentence = re.sub(scratch_file, lambda _: str(deck), message)
    if str(deck) in sentence:
        return sentence
    return f"{deck}: {sentence}"


def _convert(deck: Path, folder: Path, name: str, options: DeckOptions) -> DeckReport:
    """Convert a deck, as `convert_deck` does, but with messages on scratch files."""
    required_calculix()
    model = read_linear_model(deck, options.contact, options.preload)
    regions = choose_regions(model, options.regions)
    jobs = CalculixJobs(model, folder / "calculix", options.time_limit)
    blocks = with_densities(model, with_own_materials(model, regions))
    structure, remarks = _structure_of_deck(jobs, blocks, regions, options)
    file = write_structure_files(structure, folder, name)
    report = compare_with_calculix(
        file, structure, jobs, blocks, [*model.remarks, *remarks], options.tolerance
    )
    refuse_deviations(deck, report, options.tolerance)
    if not model.has_mass:
        sparse.save_npz(folder / MASS_FILE, 0.0 * structure.matrices.mass)
    return report


def _structure_of_deck(
    jobs: CalculixJobs, blocks: list[KeywordBlock], regions: list[Region], options: DeckOptions
) -> tuple[DeckStructure, list[str]]:
    """Return a deck as matrices, and remarks on its regions, its loads and its mass."""
    model = jobs.model
    unloaded = jobs.matrices("whole", blocks)
    matrices = _preloaded_matrices(jobs, blocks, unloaded)
    region_stiffness, remarks = _stiffness_of_regions(jobs, blocks, regions, unloaded)
    if model.preload and region_stiffness:
        weight = _stable_weight(model, matrices.stiffness, list(region_stiffness.values()))
        region_stiffness = {
            region: weight * stiffness for region, stiffness in region_stiffness.items()
        }
        if weight < 1.0:
            remarks.append(
                f"a loss of 1 of a region stands for a loss of {weight:.1f} of its modulus: with "
                "more in all regions, the preload would make the structure unstable"
            )
    chosen = _choose_loads(jobs, blocks, unloaded)
    remarks += chosen.remarks
    if not model.has_mass:
        remarks.append("the deck has no *DENSITY: the structure has no mass, hence no modes")
    output_rows, output_sets = _choose_outputs(jobs, blocks, matrices, options.outputs)
    structure = DeckStructure(
        model=model,
        matrices=matrices,
        region_stiffness=region_stiffness,
        loads=chosen.loads,
        load_vectors=chosen.vectors,
        output_sets=output_sets,
        motion_rows=output_rows,
        length_unit=options.length_unit,
    )
    return structure, remarks


def _stiffness_of_regions(
    jobs: CalculixJobs,
    blocks: list[KeywordBlock],
    regions: list[Region],
    unloaded: StoredMatrices,
) -> tuple[dict[Region, sparse.csr_array], list[str]]:
    """Return the stiffness of each region, and remarks on sets that have none.

    It follows from the stiffness of the structure with a smaller modulus in the region.
    """
    region_stiffness: dict[Region, sparse.csr_array] = {}
    remarks: list[str] = []
    for number, region in enumerate(regions, start=1):
        changed = jobs.matrices(
            f"region{number}", with_scaled_modulus(blocks, number, _CHANGED_MODULUS)
        )
        if changed.dofs != unloaded.dofs:
            raise CalculixError(
                f"{jobs.model.path}: the matrices of one run have other rows when the modulus of "
                f"{region.set_name} changes; name other regions by --region."
            )
        difference = unloaded.stiffness - changed.stiffness
        if abs(difference).max() > _ROUNDING * abs(unloaded.stiffness).max():
            region_stiffness[region] = (difference / (1.0 - _CHANGED_MODULUS)).tocsr()
        else:
            remarks.append(
                f"{region.set_name} is no region: its modulus changes nothing that can move"
            )
    return region_stiffness, remarks


def _stable_weight(
    model: LinearModel, stiffness: sparse.csr_array, regions: Sequence[sparse.csr_array]
) -> float:
    """Return the fraction of all regions' stiffness that a preloaded structure can lose.

    It is the largest multiple of 0.1 for which the remaining stiffness is not indefinite. Raises
    `SolutionError` if a loss of 0.1 makes the structure unstable.
    """
    lost = regions[0]
    for region in regions[1:]:
        lost = lost + region
    for tenths in range(10, 0, -1):
        # A small part of the stiffness lifts what is exactly singular without the regions.
        remaining = stiffness * (1.0 + _LIFT) - 0.1 * tenths * lost
        try:
            Factorisation(sparse.csr_array(remaining))
        except SolutionError:
            continue
        return 0.1 * tenths
    raise SolutionError(
        f"{model.path}: the preload makes the structure unstable if its regions lose a tenth of "
        "their stiffness; leave it out by --preload none, or lower it."
    )


def _preloaded_matrices(
    jobs: CalculixJobs, blocks: list[KeywordBlock], unloaded: StoredMatrices
) -> StoredMatrices:
    """Return the matrices at the end of the preload, or the unloaded ones if there is none.

    Raises `CalculixError` if CalculiX fails, or if the preload changes which motions are unknowns.
    """
    if not jobs.model.preload:
        return unloaded
    preloaded = jobs.matrices("preloaded", blocks, preloaded=True)
    if preloaded.dofs != unloaded.dofs:
        raise CalculixError(
            f"{jobs.model.path}: the matrices after the preload have other rows than those before "
            "it, as where the preload has forces on nodes of shells or beams; leave it out by "
            "--preload none."
        )
    return preloaded


class _ChosenLoads(NamedTuple):
    """The loads that act on a structure, and sentences on those that are left out.

    Attributes
    ----------
    vectors : dict of str to (n,) array
        The forces of loads that cannot be given by nodes and directions.
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
    shared_loads = share_over_couplings(jobs, blocks, deck_loads.loads)
    load_rows = _load_rows(jobs, blocks, matrices, shared_loads)
    loads = []
    for load in shared_loads:
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
                f"from the matrices, as on node {load_rows.missing(load)[0][0]}"
            )
        else:
            loads.append(load)
    vectors = _gravity_forces(jobs, blocks, loads, matrices)
    for load in loads:
        if load.name not in vectors and not load_rows.has_only_nodal_forces(load):
            vectors[load.name] = load_rows.vector(load)
    return _ChosenLoads(loads, vectors, remarks)


def _choose_outputs(
    jobs: CalculixJobs,
    blocks: list[KeywordBlock],
    matrices: StoredMatrices,
    names: Sequence[str],
) -> tuple[MotionRows, list[OutputSet]]:
    """Return how the motions of nodes follow from the matrices, and the sets that become outputs.

    The output of a set is its mean displacement. If nodes of a set are tied, CalculiX runs again on
    the deck `blocks`, to find how they move. Raises `MeshError` if a name does not name a set of
    nodes or a node, or if the displacement of these nodes is not known.

    Parameters
    ----------
    names : sequence of str
        The texts of the options `--output`. If there are none, the first `MOST_OUTPUTS` of the sets
        with a known displacement are taken.
    """
    candidates = choose_output_sets(jobs.model, names)
    rows = MotionRows(matrices.dofs, set(jobs.model.held))
    element_nodes = _nodes_of_elements(jobs.model)
    free_dofs = {
        dof
        for output in candidates
        for dof in output.dofs()
        if dof[0] in element_nodes and not rows.is_held(dof)
    }
    tied_dofs = sorted(free_dofs - set(matrices.dofs))
    rows = replace(rows, bound=read_tied_motions(jobs, blocks, matrices, tied_dofs))
    # a set has an option `--output` if the user named it
    options: Sequence[str | None] = names or [None] * len(candidates)
    outputs = [
        movable_output(output, rows, option)
        for output, option in zip(candidates, options, strict=True)
    ]
    chosen = [output for output in outputs if output is not None]
    return rows, chosen if names else chosen[:MOST_OUTPUTS]


def _nodes_of_elements(model: LinearModel) -> set[int]:
    """Return the nodes that belong to an element of a deck."""
    return {node for element in model.mesh.elements.values() for node in element.nodes}


def _load_rows(
    jobs: CalculixJobs,
    blocks: list[KeywordBlock],
    matrices: StoredMatrices,
    loads: list[DeckLoad],
) -> MotionRows:
    """Return how loads act on the rows of the matrices, also on motions that have no rows there."""
    load_rows = MotionRows(matrices.dofs, set(jobs.model.held))
    element_nodes = _nodes_of_elements(jobs.model)
    matrix_dofs = set(matrices.dofs)
    tied_dofs = [
        dof
        for load in loads
        for dof in load_rows.missing(load)
        if dof[0] in element_nodes and dof not in matrix_dofs
    ]
    nodes_with_rotations = {
        node
        for element in jobs.model.mesh.elements.values()
        if element.has_rotations
        for node in element.nodes
    }
    rotations = [
        dof
        for load in loads
        for dof in load_rows.missing_rotations(load)
        if dof[0] in nodes_with_rotations
    ]
    bound = read_tied_motions(jobs, blocks, matrices, list(dict.fromkeys(tied_dofs)))
    bound |= read_rotations(jobs, blocks, matrices, list(dict.fromkeys(rotations))[:MOST_MOMENTS])
    return MotionRows(matrices.dofs, load_rows.held, bound)


def _gravity_forces(
    jobs: CalculixJobs,
    blocks: list[KeywordBlock],
    loads: list[DeckLoad],
    matrices: StoredMatrices,
) -> dict[str, FloatArray]:
    """Return the nodal forces (n,) of each load that has an acceleration.

    The rows of held nodes are missing in the mass matrix, but their mass also loads the adjacent
    nodes. For this reason the mass matrix of the structure without supports is multiplied by the
    acceleration, and the rows of both are matched by their degrees of freedom.
    """
    accelerations = {
        load.name: load.acceleration for load in loads if load.acceleration is not None
    }
    if not accelerations:
        return {}
    matrices_without_supports = jobs.matrices("free", blocks, free=True)
    forces = {}
    for name, acceleration in accelerations.items():
        field = [
            acceleration[axis - 1] if node in jobs.model.mesh.points else 0.0
            for node, axis in matrices_without_supports.dofs
        ]
        free_forces = matrices_without_supports.mass @ np.array(field)
        forces[name] = _matched_rows(free_forces, matrices_without_supports, matrices)
    return forces


def _matched_rows(values: FloatArray, source: StoredMatrices, target: StoredMatrices) -> FloatArray:
    """Return the values of the source's rows (n,) for the rows of the target (m,).

    Rows are matched by their degree of freedom. One that CalculiX has expanded, as at a node of a
    shell, has several rows; these are matched in the order in which they occur. The two sets of
    matrices differ by the supports alone, so a degree of freedom with different numbers of rows
    belongs to a held node. Its values are zero.
    """
    source_counts = Counter(source.dofs)
    target_counts = Counter(target.dofs)
    values_of_dof: dict[tuple[int, int], list[float]] = {}
    for dof, value in zip(source.dofs, values.tolist(), strict=True):
        values_of_dof.setdefault(dof, []).append(value)
    values_to_come = {dof: iter(dof_values) for dof, dof_values in values_of_dof.items()}
    matched = []
    for dof in target.dofs:
        if source_counts[dof] == target_counts[dof]:
            matched.append(next(values_to_come[dof]))
        else:
            matched.append(0.0)
    return np.array(matched)
