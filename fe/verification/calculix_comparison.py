"""Compare structures and the wing with CalculiX on the identical mesh: statics and modes."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from fe.elements.kinds import HEXAHEDRA_20, gauss_points
from fe.full.factorisation import Factorisation
from fe.runtime.arrays import FloatArray
from fe.runtime.errors import CalculixError
from fe.structure.affine import natural_frequencies

from .calculix_deck import CALCULIX_STRAINS, CalculixDeck, Step
from .calculix_run import read_frequencies, read_tables, run_calculix

INTEGRATION_POINTS = np.fliplr(gauss_points(3).points)
"""Local positions (27, 3) of the integration points of a C3D20, in the order of its output."""


def _relative_difference(theirs: FloatArray, ours: FloatArray) -> float:
    """Return the largest difference relative to our largest value."""
    return float(np.abs(theirs - ours).max() / np.abs(ours).max())


class Agreement(NamedTuple):
    """Differences between a model and CalculiX.

    Attributes
    ----------
    loads : dict of str to dict of str to float
        For each load the relative differences, over the largest value of their kind: of `nodal
        displacements`; of `gauge strains` and `displacement outputs`, if there are any; of 20-node
        hexahedra also of `strains at integration points`, which CalculiX evaluates itself.
    ours, calculix : (m,) array
        Lowest frequencies of both codes [Hz].
    """

    loads: dict[str, dict[str, float]]
    ours: FloatArray
    calculix: FloatArray

    @property
    def modal(self) -> float:
        """Largest relative difference of the frequencies."""
        return float(np.abs(self.calculix / self.ours - 1.0).max())


class _PrintedResults(NamedTuple):
    """Results of a static load that CalculiX printed.

    Attributes
    ----------
    displacements : (nodes, 3) array
        Nodal displacements [m].
    probes : (m,) array
        Displacements of the probe nodes, in the order of their directions.
    strains : (points, 6) array
        Strains at the integration points, with tensor shear; empty if they were not printed.
    """

    displacements: FloatArray
    probes: FloatArray
    strains: FloatArray


def agreement(deck: CalculixDeck, folder: Path, modes: int = 6) -> Agreement:
    """Return how far solutions of this program and of CalculiX agree for one model.

    Both solve each load alone, and compute the lowest natural frequencies.

    Parameters
    ----------
    deck : CalculixDeck
        The model in one state. A structure is to be assembled with `mass_as_stiffness`, so that
        frequencies can be compared.
    folder : Path
        CalculiX writes its files there.
    modes : int
        Number of modes.

    Raises
    ------
    CalculixError
        If CalculiX is not installed or fails.
    """
    printed_results = _static_results(deck, folder)
    frequencies, _ = natural_frequencies(deck.structure, modes, deck.values)
    calculix_frequencies = _calculix_frequencies(deck, folder, modes)
    system = deck.structure.system_at(deck.values)
    factors = Factorisation(system.stiffness)
    differences = {}
    for (name, step), results in zip(deck.loads.items(), printed_results, strict=True):
        displacement = factors.solve(step.load)
        differences[name] = _differences(deck, displacement, results)
    return Agreement(differences, frequencies, calculix_frequencies)


def _prints_strains(deck: CalculixDeck) -> bool:
    """Return whether strains at integration points are compared."""
    return deck.body.mesh.kind is HEXAHEDRA_20


def _static_results(deck: CalculixDeck, folder: Path) -> list[_PrintedResults]:
    """Run CalculiX for each load alone, and return its results.

    Raises `CalculixError` if it fails, or prints results for another number of loads.
    """
    if not deck.loads:
        return []
    prints = ["*NODE PRINT, NSET=NALL", "U"]
    if len(deck.probes):
        prints += ["*NODE PRINT, NSET=NPROBES", "U"]
    if _prints_strains(deck):
        prints += ["*EL PRINT, ELSET=EALL, GLOBAL=YES", "E"]
    steps = [step._replace(lines=[*step.lines, *prints]) for step in deck.loads.values()]
    tables = read_tables(run_calculix(deck.text(*steps), folder, "static"))
    count = len(tables.get("NALL", ()))
    if count != len(deck.loads):
        raise CalculixError(
            f"CalculiX printed {count} static solutions instead of {len(deck.loads)}."
        )
    results = []
    for number in range(count):
        # A row of nodal results begins with the number of the node.
        displacements = tables["NALL"][number][:, 1:]
        probes = np.empty(0)
        if len(deck.probes):
            probes = tables["NPROBES"][number][:, 1:].ravel()
        # A row of strains begins with the numbers of the element and of its integration point.
        strains = np.empty((0, 0))
        if _prints_strains(deck):
            strains = tables["EALL"][number][:, 2:]
        results.append(_PrintedResults(displacements, probes, strains))
    return results


def _calculix_frequencies(deck: CalculixDeck, folder: Path, modes: int) -> FloatArray:
    """Return the lowest frequencies (modes,) [Hz] of CalculiX."""
    text = deck.text(Step(procedure=("*FREQUENCY", f"{modes}")))
    frequencies = read_frequencies(run_calculix(text, folder, "modes"))
    if len(frequencies) < modes:
        raise CalculixError(f"CalculiX printed {len(frequencies)} frequencies instead of {modes}.")
    return frequencies[:modes]


def _differences(
    deck: CalculixDeck, displacement: FloatArray, printed_results: _PrintedResults
) -> dict[str, float]:
    """Return the relative differences from CalculiX for one load, see `Agreement.loads`.

    `displacement` (n,) is the solution of this program for the free unknowns [m].
    """
    probe_outputs = deck.probes @ displacement
    nodal_displacements = deck.structure.full_displacement(displacement)
    differences = {
        "nodal displacements": _relative_difference(
            printed_results.displacements, nodal_displacements
        )
    }
    gauge_count = len(deck.structure.gauges)
    probes_by_quantity = {
        "gauge strains": slice(0, gauge_count),
        "displacement outputs": slice(gauge_count, len(probe_outputs)),
    }
    for quantity, probe_rows in probes_by_quantity.items():
        if len(probe_outputs[probe_rows]):
            difference = _relative_difference(
                printed_results.probes[probe_rows], probe_outputs[probe_rows]
            )
            differences[quantity] = difference
    if _prints_strains(deck):
        strains = deck.body.mesh.strains(nodal_displacements, INTEGRATION_POINTS).reshape(-1, 6)
        strains[:, 3:] *= 0.5  # engineering to tensor shear strains, as CalculiX prints them
        difference = _relative_difference(printed_results.strains, strains[:, CALCULIX_STRAINS])
        differences["strains at integration points"] = difference
    return differences
