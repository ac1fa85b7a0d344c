"""The structure file, matrices and vectors that describe a deck as a structure from matrices."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import sparse

from fe.runtime.arrays import FloatArray
from fe.structure.matrix_files import FORCE_WEIGHTS, READ_WEIGHTS
from fe.structure.matrix_tables import Place

from .calculix_jobs import StoredMatrices
from .linear_model import TRANSLATIONS, HeldMotion, LinearModel
from .loads import DeckLoad
from .regions import Region, name_in_file

PARAMETER = "e"
"""Name of the parameter that scales the moduli of all regions."""
LARGEST_NAME = 28
"""Longest name of a set in the file, to which an axis is added."""
MOST_OUTPUTS = 12
"""Sets of nodes that become outputs, if none is named."""


@dataclass(frozen=True)
class DeckStructure:
    """A deck as matrices.

    Attributes
    ----------
    model : LinearModel
        The model of the deck.
    matrices : StoredMatrices
        Stiffness and mass of the whole.
    region_stiffness : dict of Region to sparse (n, n) array
        The stiffness of each region.
    loads : list of DeckLoad
        The loads.
    gravity_forces : dict of str to (n,) array
        Force of gravity of each load that has one.
    output_sets : dict of str to list of int
        Nodes of each set that is an output.
    length_unit : str
        Unit of length of the deck.
    """

    model: LinearModel
    matrices: StoredMatrices
    region_stiffness: dict[Region, sparse.csr_array]
    loads: list[DeckLoad]
    gravity_forces: dict[str, FloatArray]
    output_sets: dict[str, list[int]]
    length_unit: str

    def row_counts(self) -> dict[Place, int]:
        """Return how many rows of the matrices each direction of a node has."""
        return row_counts(self.matrices.places)


def row_counts(places: Sequence[Place]) -> dict[Place, int]:
    """Return how many rows have each name."""
    counts: dict[Place, int] = {}
    for place in places:
        counts[place] = counts.get(place, 0) + 1
    return counts


def choose_output_sets(
    model: LinearModel, counts: dict[Place, int], names: Sequence[str]
) -> dict[str, list[int]]:
    """Return the nodes of each set whose displacement is an output.

    Parameters
    ----------
    model : LinearModel
        The model of the deck.
    counts : dict of Place to int
        How many rows each direction of a node has.
    names : sequence of str
        Names of sets of nodes; if it is empty, the first sets that do not hold all nodes.
    """
    held = set(model.held)
    sets = {}
    for name in [name.upper() for name in names] or list(model.mesh.node_sets):
        movable = [
            node
            for node in dict.fromkeys(model.mesh.nodes_named(name, "--output"))
            if _can_be_read(node, counts, held)
        ]
        has_all_nodes = len(movable) > 0.5 * len(model.mesh.points) and not names
        if movable and not has_all_nodes:
            sets[name] = movable
    return dict(list(sets.items())[: None if names else MOST_OUTPUTS])


def _can_be_read(node: int, counts: dict[Place, int], held: set[HeldMotion]) -> bool:
    """Return whether the displacement of a node along all axes follows from the rows."""
    return all(
        counts.get((node, axis)) in READ_WEIGHTS and HeldMotion(node, axis) not in held
        for axis in TRANSLATIONS
    )


def has_rows_for(load: DeckLoad, counts: dict[Place, int], held: set[HeldMotion]) -> bool:
    """Return whether every force of a load acts on rows of the matrices, or on what is held."""
    return all(
        HeldMotion(*place) in held or counts.get(place) in FORCE_WEIGHTS
        for place, force in load.forces.items()
        if force
    )


def write_structure_files(structure: DeckStructure, folder: Path, name: str) -> Path:
    """Write the structure file `NAME.toml` with its matrices and vectors into a folder.

    Returns
    -------
    Path
        The structure file.
    """
    sparse.save_npz(folder / "stiffness.npz", structure.matrices.stiffness)
    sparse.save_npz(folder / "mass.npz", structure.matrices.mass)
    unknowns = "".join(f"{node}.{axis}\n" for node, axis in structure.matrices.places)
    (folder / "unknowns.dof").write_text(unknowns, encoding="ascii")
    lines = [
        f"name = {json.dumps(name)}",
        f"length_unit = {json.dumps(structure.length_unit)}",
        'stiffness_matrix = "stiffness.npz"',
        'mass_matrix = "mass.npz"',
        'unknowns = "unknowns.dof"',
    ]
    if structure.region_stiffness:
        lines += ["", "[[parameter]]", f'name = "{PARAMETER}"']
    for region, stiffness in structure.region_stiffness.items():
        sparse.save_npz(folder / f"{region.name}.npz", stiffness)
        lines += ["", "[[damage]]", f'name = "{region.name}"']
        lines += ["", "[[part]]", f'matrix = "{region.name}.npz"']
        lines += [f'scaled_by = "{PARAMETER}"', f'damage = "{region.name}"']
    for load in structure.loads:
        lines += ["", "[[control]]", f'name = "{load.name}_factor"']
        lines += ["", "[[load]]", f'name = "{load.name}"', f'control = "{load.name}_factor"']
        lines += [f'vector = "{_write_load(structure, load, folder)}"']
    for set_name, nodes in structure.output_sets.items():
        lines += _output_lines(structure, set_name, nodes, folder)
    file = folder / f"{name}.toml"
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file


def _write_load(structure: DeckStructure, load: DeckLoad, folder: Path) -> str:
    """Write the vector of a load, and return the name of its file."""
    if load.name in structure.gravity_forces:
        file = f"{load.name}.npy"
        np.save(folder / file, structure.gravity_forces[load.name])
        return file
    counts = structure.row_counts()
    rows = [
        f"{node} {axis} {force!r}"
        for (node, axis), force in sorted(load.forces.items())
        if (node, axis) in counts and HeldMotion(node, axis) not in structure.model.held
    ]
    file = f"{load.name}.txt"
    (folder / file).write_text("\n".join(rows) + "\n", encoding="ascii")
    return file


def _output_lines(
    structure: DeckStructure, set_name: str, nodes: Sequence[int], folder: Path
) -> Iterator[str]:
    """Yield the lines of the outputs of a set: mean displacements, and the strain of a pair."""
    name = name_in_file(set_name)[:LARGEST_NAME]
    if not name[0].isalpha():
        name = f"n{name}"[:LARGEST_NAME]
    for axis, letter in zip(TRANSLATIONS, "xyz", strict=True):
        file = f"{name}_{letter}.txt"
        rows = [f"{node} {axis} {1.0 / len(nodes)!r}" for node in nodes]
        (folder / file).write_text("\n".join(rows) + "\n", encoding="ascii")
        yield from ("", "[[displacement]]", f'name = "{name}_{letter}"', f'vector = "{file}"')
    if len(nodes) == 2:
        first, second = (structure.model.mesh.points[node] for node in nodes)
        span = second - first
        length = float(np.linalg.norm(span))
        if length > 0.0:
            yield from ("", "[[gauge]]", f'name = "{name}"', f"nodes = {list(nodes)}")
            yield from (f"direction = {(span / length).tolist()}", f"length = {length!r}")
