"""A structure against CalculiX on the same mesh: displacements, gauge strains and frequencies."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fe.runtime.errors import CalculixError
from fe.structure.operators import Structure
from fe.structure.solution import natural_frequencies, static_responses

from .calculix_job import read_frequencies, read_tables, run_calculix
from .calculix_models import structure_deck, structure_loads

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class LoadAgreement:
    """Differences under one load, relative to the largest of their kind under that load.

    Attributes
    ----------
    load : str
        Its name.
    field : float
        Nodal displacements.
    strain, output : float or None
        Strains of the gauges and displacement outputs; None where there are none.
    """

    load: str
    field: float
    strain: float | None
    output: float | None


@dataclass(frozen=True)
class StructureAgreement:
    """A structure and CalculiX.

    Attributes
    ----------
    loads : tuple of LoadAgreement
        One for each load.
    ours, calculix : (m,) Hz
        Lowest frequencies of both.
    """

    loads: tuple[LoadAgreement, ...]
    ours: FloatArray
    calculix: FloatArray

    @property
    def frequency(self) -> float:
        """Largest relative difference of a frequency."""
        return float(np.abs(self.calculix / self.ours - 1.0).max())


def structure_agreement(structure: Structure, folder: Path, modes: int = 6) -> StructureAgreement:
    """Solve every load and the lowest modes by both codes, undamaged and with nominal values.

    Parameters
    ----------
    structure : Structure
        The model; assembled with `mass_as_stiffness`, for frequencies that can be compared.
    folder : Path
        Where CalculiX works.
    modes : int
        Number of modes.

    Raises
    ------
    CalculixError
        If CalculiX is not there, fails, or has no such element.
    """
    deck = structure_deck(structure)
    loads = []
    if structure.loads:
        tables = read_tables(
            run_calculix(deck.static_steps(structure_loads(structure, deck)), folder, "static")
        )
        fields = [table.rows[:, 1:] for table in tables if table.set_name == "NALL"]
        probes = [table.rows[:, 1:].ravel() for table in tables if table.set_name == "NPROBES"]
        if len(fields) != len(structure.loads):
            raise CalculixError(
                f"CalculiX printed {len(fields)} static solutions instead of {len(structure.loads)}."
            )
        for number, (name, ours) in enumerate(static_responses(structure).items()):
            field = structure.full_displacement(ours.displacement)
            read = probes[number] if probes else np.zeros(0)
            middle = len(ours.strain)
            loads.append(
                LoadAgreement(
                    name,
                    float(np.abs(fields[number] - field).max() / np.abs(field).max()),
                    _relative(read[:middle], ours.strain),
                    _relative(read[middle : middle + len(ours.output)], ours.output),
                )
            )
    theirs = read_frequencies(run_calculix(deck.frequency_step(modes), folder, "modes"))
    if len(theirs) < modes:
        raise CalculixError(f"CalculiX printed {len(theirs)} frequencies instead of {modes}.")
    return StructureAgreement(tuple(loads), natural_frequencies(structure, modes)[0], theirs[:modes])


def _relative(theirs: FloatArray, ours: FloatArray) -> float | None:
    return float(np.abs(theirs - ours).max() / np.abs(ours).max()) if len(ours) else None
