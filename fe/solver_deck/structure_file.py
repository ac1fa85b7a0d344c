"""The structure file, matrices and vectors that describe a deck as a structure from matrices."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import sparse

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import MeshError
from fe.structure.matrix_files import READ_WEIGHTS
from fe.structure.matrix_tables import Place

from .calculix_jobs import StoredMatrices
from .linear_model import TRANSLATIONS, HeldMotion, LinearModel
from .loads import DeckLoad
from .regions import Region, name_in_file

MASS_FILE = "mass.npz"
"""Name of the file of the mass matrix."""
PARAMETER = "e"
"""Name of the parameter that scales the moduli of all regions."""
LARGEST_NAME = 28
"""Longest name of a set in the file, to which an axis is added."""
MOST_OUTPUTS = 12
"""Sets of nodes that become outputs, if none is named."""


class OutputSet(NamedTuple):
    """A set of nodes whose mean displacement is an output.

    Attributes
    ----------
    name : str
        Name of the set in the deck.
    nodes : list of int
        Those of its nodes that can move and have rows in the matrices.
    axes : str
        The axes of the displacements: some of "xyz".
    """

    name: str
    nodes: list[int]
    axes: str


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
    load_vectors : dict of str to (n,) array
        Forces of each load that nodes and directions alone do not describe, such as gravity.
    output_sets : list of OutputSet
        The sets of nodes whose displacement is an output.
    length_unit : str
        Unit of length of the deck.
    """

    model: LinearModel
    matrices: StoredMatrices
    region_stiffness: dict[Region, sparse.csr_array]
    loads: list[DeckLoad]
    load_vectors: dict[str, FloatArray]
    output_sets: list[OutputSet]
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
) -> list[OutputSet]:
    """Return the sets of nodes whose displacement is an output.

    Parameters
    ----------
    model : LinearModel
        The model of the deck.
    counts : dict of Place to int
        How many rows each direction of a node has.
    names : sequence of str
        Names of sets of nodes, each alone or with axes, as `TIP` or `TIP:z`; if it is empty, the
        first sets that hold at most half of the nodes.

    Raises
    ------
    MeshError
        If a name is no set or number of nodes, if its axes are none, or if none of its nodes can
        be read.
    """
    if not names:
        return _sets_of_deck(model, counts)
    sets = []
    for text in names:
        name, _, axes = text.partition(":")
        axes = axes.lower() or "xyz"
        if not set(axes) <= set("xyz"):
            raise MeshError(
                f"--output {text}: a set of nodes is expected, alone or with axes, as TIP:z, but "
                f"the axes {axes} were given."
            )
        members = model.mesh.nodes_named(name, f"--output {text}")
        nodes = _readable_nodes(model, counts, members)
        if not nodes:
            raise MeshError(
                f"--output {text}: a set with nodes that can move is expected, but all its nodes "
                "are held, or tied to others; name another set."
            )
        sets.append(OutputSet(name.upper(), nodes, axes))
    return sets


def _sets_of_deck(model: LinearModel, counts: dict[Place, int]) -> list[OutputSet]:
    """Return the first sets of a deck that can move and hold at most half of the nodes."""
    sets = []
    for name, members in model.mesh.node_sets.items():
        nodes = _readable_nodes(model, counts, members)
        if nodes and len(nodes) <= 0.5 * len(model.mesh.points):
            sets.append(OutputSet(name, nodes, "xyz"))
    return sets[:MOST_OUTPUTS]


def _readable_nodes(
    model: LinearModel, counts: dict[Place, int], members: Sequence[int]
) -> list[int]:
    """Return the members whose displacement follows from the rows of the matrices, each once."""
    held = set(model.held)
    return [node for node in dict.fromkeys(members) if _can_be_read(node, counts, held)]


def _can_be_read(node: int, counts: dict[Place, int], held: set[HeldMotion]) -> bool:
    """Return whether the displacement of a node along all axes follows from the rows."""
    return all(
        counts.get((node, axis)) in READ_WEIGHTS and HeldMotion(node, axis) not in held
        for axis in TRANSLATIONS
    )


def write_structure_files(structure: DeckStructure, folder: Path, name: str) -> Path:
    """Write the structure file `NAME.toml` with its matrices and vectors into a folder.

    Returns
    -------
    Path
        The structure file.
    """
    sparse.save_npz(folder / "stiffness.npz", structure.matrices.stiffness)
    sparse.save_npz(folder / MASS_FILE, structure.matrices.mass)
    unknowns = "".join(f"{node}.{axis}\n" for node, axis in structure.matrices.places)
    (folder / "unknowns.dof").write_text(unknowns, encoding="ascii")
    lines = [
        f"name = {json.dumps(name)}",
        f"length_unit = {json.dumps(structure.length_unit)}",
        'stiffness_matrix = "stiffness.npz"',
        f'mass_matrix = "{MASS_FILE}"',
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
    for output in structure.output_sets:
        lines += _output_lines(structure, output, folder)
    file = folder / f"{name}.toml"
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file


def _write_load(structure: DeckStructure, load: DeckLoad, folder: Path) -> str:
    """Write the vector of a load, and return the name of its file."""
    if load.name in structure.load_vectors:
        file = f"{load.name}.npy"
        np.save(folder / file, structure.load_vectors[load.name])
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


def _output_lines(structure: DeckStructure, output: OutputSet, folder: Path) -> Iterator[str]:
    """Yield the lines of the outputs of a set: mean displacements, and the strain of a pair."""
    name = name_in_file(output.name)[:LARGEST_NAME]
    if not name[0].isalpha():
        name = f"n{name}"[:LARGEST_NAME]
    nodes = output.nodes
    for letter in output.axes:
        axis = "xyz".index(letter) + 1
        file = f"{name}_{letter}.txt"
        rows = [f"{node} {axis} {1.0 / len(nodes)!r}" for node in nodes]
        (folder / file).write_text("\n".join(rows) + "\n", encoding="ascii")
        yield from ("", "[[displacement]]", f'name = "{name}_{letter}"', f'vector = "{file}"')
    if len(nodes) == 2:
        first, second = (structure.model.mesh.points[node] for node in nodes)
        span = second - first
        length = float(np.linalg.norm(span))
        if length > 0.0:
            yield from ("", "[[gauge]]", f'name = "{name}"', f"nodes = {nodes}")
            yield from (f"direction = {(span / length).tolist()}", f"length = {length!r}")
