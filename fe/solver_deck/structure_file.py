"""Write a deck as a structure file with matrices and vectors."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import sparse

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import MeshError
from fe.structure.matrix_tables import Dof

from .calculix_jobs import StoredMatrices
from .linear_model import TRANSLATIONS, HeldMotion, LinearModel
from .loads import DeckLoad
from .regions import Region, name_in_file
from .row_vectors import MotionRows

MASS_FILE = "mass.npz"
"""Name of the file of the mass matrix."""
PARAMETER = "e"
"""Name of the parameter that scales the moduli of all regions."""
LONGEST_NAME = 28
"""Largest number of letters of a set's name in the file; names of outputs add the axis to it."""
MOST_OUTPUTS = 12
"""Largest number of sets that become outputs, if none is named."""


class OutputSet(NamedTuple):
    """A set of nodes whose mean displacement is an output.

    Attributes
    ----------
    name : str
        Name of the set in the deck.
    nodes : list of int
        Its nodes, each once. Those that are held or tied belong to the mean.
    axes : str
        The axes of the displacements: some of "xyz".
    """

    name: str
    nodes: list[int]
    axes: str

    def dofs(self) -> list[Dof]:
        """Return the degrees of freedom whose mean is an output."""
        return [(node, "xyz".index(letter) + 1) for letter in self.axes for node in self.nodes]


@dataclass(frozen=True)
class DeckStructure:
    """A deck as matrices, loads and outputs.

    Attributes
    ----------
    region_stiffness : dict of Region to sparse (n, n) array
        The stiffness of each region.
    load_vectors : dict of str to (n,) array
        Forces of loads that cannot be given by nodes and directions, such as gravity.
    motion_rows : MotionRows
        How the motions of output sets follow from the rows.
    """

    model: LinearModel
    matrices: StoredMatrices
    region_stiffness: dict[Region, sparse.csr_array]
    loads: list[DeckLoad]
    load_vectors: dict[str, FloatArray]
    output_sets: list[OutputSet]
    motion_rows: MotionRows
    length_unit: str


def choose_output_sets(model: LinearModel, names: Sequence[str]) -> list[OutputSet]:
    """Return the sets of nodes whose displacement may be an output.

    Parameters
    ----------
    names : sequence of str
        Names of sets of nodes, each alone or with axes, such as `TIP` or `TIP:z`; if empty, all
        sets with at most half of the nodes are taken.

    Raises
    ------
    MeshError
        If a name is neither that of a set of nodes nor the number of a node, or if its axes are not
        some of x, y, z.
    """
    if not names:
        return [
            OutputSet(name, list(dict.fromkeys(members)), "xyz")
            for name, members in model.mesh.node_sets.items()
            if members and len(members) <= 0.5 * len(model.mesh.points)
        ]
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
        sets.append(OutputSet(name.upper(), list(dict.fromkeys(members)), axes))
    return sets


def movable_output(output: OutputSet, rows: MotionRows, option: str | None) -> OutputSet | None:
    """Restrict an output to those of its axes along which its mean displacement is known.

    The result is None for a set that the user did not name and that has no such axis.

    Parameters
    ----------
    option : str or None
        The text of `--output`; None if the user did not name the set.

    Raises
    ------
    MeshError
        If a named set has no such axis, or lacks one that the user named.
    """
    unknown_nodes = []
    known_axes = ""
    for letter in output.axes:
        motions = output._replace(axes=letter).dofs()
        unknown = [node for node, axis in motions if rows.displacement((node, axis)) is None]
        unknown_nodes += unknown
        if not unknown and not all(map(rows.is_held, motions)):
            known_axes += letter
    is_whole = known_axes == output.axes or (option is not None and ":" not in option)
    if known_axes and (is_whole or option is None):
        return output._replace(axes=known_axes)
    if option is None:
        return None
    reason = "all its nodes are held"
    if unknown_nodes:
        reason = f"how node {unknown_nodes[0]} moves does not follow from the matrices of CalculiX"
    raise MeshError(
        f"--output {option}: a set with nodes that can move is expected, but {reason}; name "
        "another set, or other axes."
    )


def write_structure_files(structure: DeckStructure, folder: Path, name: str) -> Path:
    """Write the structure file `NAME.toml` with its matrices and vectors; return its path."""
    sparse.save_npz(folder / "stiffness.npz", structure.matrices.stiffness)
    sparse.save_npz(folder / MASS_FILE, structure.matrices.mass)
    unknowns = "".join(f"{node}.{axis}\n" for node, axis in structure.matrices.dofs)
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
        lines += _write_outputs(structure, output, folder)
    file = folder / f"{name}.toml"
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file


def _write_load(structure: DeckStructure, load: DeckLoad, folder: Path) -> str:
    """Write the vector of a load; return the name of its file."""
    if load.name in structure.load_vectors:
        file = f"{load.name}.npy"
        np.save(folder / file, structure.load_vectors[load.name])
        return file
    matrix_dofs = set(structure.matrices.dofs)
    rows = [
        f"{node} {axis} {force!r}"
        for (node, axis), force in sorted(load.forces.items())
        if (node, axis) in matrix_dofs and HeldMotion(node, axis) not in structure.model.held
    ]
    file = f"{load.name}.txt"
    (folder / file).write_text("\n".join(rows) + "\n", encoding="ascii")
    return file


def _write_outputs(structure: DeckStructure, output: OutputSet, folder: Path) -> list[str]:
    """Write the vector of each output of a set; return the lines of the structure file for them.

    The outputs are the mean displacements of the set along its axes. A set of two nodes is also a
    gauge, which reads the strain between them, if the nodes lie at different points and all their
    translations are degrees of freedom of the matrices.
    """
    name = name_in_file(output.name)[:LONGEST_NAME]
    if not name[0].isalpha():
        name = f"n{name}"[:LONGEST_NAME]
    lines = []
    for letter in output.axes:
        file = _write_mean(structure, output._replace(axes=letter), f"{name}_{letter}", folder)
        lines += ["", "[[displacement]]", f'name = "{name}_{letter}"', f'vector = "{file}"']
    nodes = output.nodes
    matrix_dofs = set(structure.matrices.dofs)
    translations = {(node, axis) for node in nodes for axis in TRANSLATIONS}
    if len(nodes) == 2 and translations <= matrix_dofs:
        first, second = (structure.model.mesh.points[node] for node in nodes)
        span = second - first
        length = float(np.linalg.norm(span))
        if length > 0.0:
            lines += ["", "[[gauge]]", f'name = "{name}"', f"nodes = {nodes}"]
            lines += [f"direction = {(span / length).tolist()}", f"length = {length!r}"]
    return lines


def _write_mean(structure: DeckStructure, output: OutputSet, name: str, folder: Path) -> str:
    """Write the vector of a set's mean displacement along one axis; return the name of its file.

    It is written as a table of nodes, which is easy to read. If a node is tied, and so has no row
    of its own, it is written as a vector of all rows.
    """
    rows = structure.motion_rows
    weight = 1.0 / len(output.nodes)
    dofs = [dof for dof in output.dofs() if not rows.is_held(dof)]
    if any(dof in rows.bound for dof in dofs):
        mean = np.zeros(len(rows.dofs))
        for dof in dofs:
            motion = rows.displacement(dof)
            assert motion is not None  # checked when the output was chosen
            mean += weight * motion.vector(len(mean))
        np.save(folder / f"{name}.npy", mean)
        return f"{name}.npy"
    lines = [f"{node} {axis} {weight!r}" for node, axis in dofs]
    (folder / f"{name}.txt").write_text("\n".join(lines) + "\n", encoding="ascii")
    return f"{name}.txt"
