"""Compare a structure that was made from a deck with CalculiX, in statics and frequencies."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import CalculixError
from fe.structure.abaqus import KeywordBlock
from fe.structure.affine import natural_frequencies, static_responses
from fe.structure.matrix_files import READ_WEIGHTS
from fe.structure.operators import assemble_structure
from fe.structure.tables import UNITS

from .calculix_jobs import CalculixJobs
from .linear_model import TRANSLATIONS, HeldMotion, LinearModel
from .loads import DeckLoad
from .regions import Region
from .structure_file import DeckStructure

_COMPARED_MODES = 6
_UNKNOWNS_PER_MODE = 5
"""Unknowns that a structure needs for each compared mode: CalculiX looks for eigenvalues among four
vectors for each mode, and returns zeros if there are hardly more unknowns.
"""
MOMENT_TOLERANCE = 1e-4
"""Deviation that is accepted under moments on beams, if the tolerance is smaller.

CalculiX changes the weights of the mean rotation of a beam's section by up to 1e-5 at random
(routine usermpc.f), so that no two of its runs agree better.
"""


@dataclass(frozen=True)
class DeckReport:
    """A structure that was made from a deck, and its deviations from CalculiX.

    Attributes
    ----------
    unknowns : int
        Number of unknowns.
    regions : list of Region
        The regions that may lose stiffness.
    load_deviations : dict of str to float
        For each load the largest difference of a nodal displacement from CalculiX, relative to the
        largest displacement.
    load_limits : dict of str to float
        For each load the largest accepted deviation.
    has_mass : bool
        Whether the deck has a density.
    frequencies : (m,) array
        Lowest frequencies [Hz]. If the deck has no density, they are those with the density
        `COMPARED_DENSITY`, for the comparison only.
    frequency_deviation : float
        Largest relative difference of a frequency from CalculiX.
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


def compare_with_calculix(
    file: Path,
    structure: DeckStructure,
    jobs: CalculixJobs,
    blocks: list[KeywordBlock],
    remarks: list[str],
    tolerance: float,
) -> DeckReport:
    """Compare a structure file with CalculiX: displacements under each load, and frequencies.

    `blocks` are those of the model in the deck; `remarks` are handed on to the report.
    """
    assembled = assemble_structure(file)
    deviations = {}
    if structure.loads:
        # Our factors come first: they refuse a mechanism, on which CalculiX computes nonsense.
        responses = static_responses(assembled)
        printed = jobs.displacements(structure.loads, blocks)
        for load, calculix_displacement in zip(structure.loads, printed, strict=True):
            displacement = assembled.full_displacement(responses[load.name].displacement)
            scale = UNITS[structure.length_unit]
            largest = float(np.abs(responses[load.name].displacement).max()) / scale
            deviations[load.name] = _largest_deviation(
                structure, displacement / scale, calculix_displacement, largest
            )
    frequencies = np.empty(0)
    frequency_deviation = 0.0
    if assembled.unknowns >= _UNKNOWNS_PER_MODE:
        count = min(_COMPARED_MODES, assembled.unknowns // _UNKNOWNS_PER_MODE)
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
    """Return the largest accepted deviation under a load."""
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
    displacements: FloatArray,
    calculix_displacements: dict[int, FloatArray],
    largest_of_rows: float,
) -> float:
    """Return the largest difference to a displacement of CalculiX, over the largest displacement.

    The largest displacement is that of any node in CalculiX, or `largest_of_rows`, that of any row
    of the matrices: under torsion of a straight beam only the nodes of its expanded section move.
    `displacements` are (nodes, 3 or more), in the order of the node numbers.
    """
    counts = Counter(structure.matrices.dofs)
    held = set(structure.model.held)
    nodes = sorted({node for node, _ in structure.matrices.dofs})
    differences = [0.0]
    largest_of_nodes = max(float(np.abs(row).max()) for row in calculix_displacements.values())
    largest = max(largest_of_rows, largest_of_nodes)
    for node, displacement in zip(nodes, displacements, strict=True):
        for axis in TRANSLATIONS:
            is_read = counts.get((node, axis)) in READ_WEIGHTS
            if node in calculix_displacements and is_read and HeldMotion(node, axis) not in held:
                differences.append(
                    abs(float(displacement[axis - 1] - calculix_displacements[node][axis - 1]))
                )
    return max(differences) / largest if largest > 0.0 else 0.0


def refuse_deviations(deck: Path, report: DeckReport, tolerance: float) -> None:
    """Raise `CalculixError` if the structure deviates from CalculiX, or nothing was compared."""
    if not report.load_deviations and not len(report.frequencies):
        raise CalculixError(
            f"{deck}: nothing can be compared with CalculiX: {report.unknowns} unknowns are too "
            "few for frequencies, and no load of the deck was read; add a *STEP with *STATIC and a "
            "*CLOAD."
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
