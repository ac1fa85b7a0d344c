"""Decks of CalculiX' own tests, read as structures, against its published results.

The decks are in Debian's package calculix-ccx-test. They are beams of 10-node tetrahedra, 20- and
8-node hexahedra, with the same load along y at each node of a set. The results have seven digits.
"""

import gzip
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fe.structure.affine import static_responses
from fe.structure.mesh_file import read_mesh
from fe.structure.operators import load_and_assemble

FloatArray = NDArray[np.float64]

DECKS = Path("/usr/share/doc/calculix-ccx-test/examples/test")
NAMES = ("beam10p", "beam20p", "beam8p")
MESH_FILE = "m.inp"
HEAD = """name = "deck"
mesh = "m.inp"
length_unit = "mm"
material = [{ name = "steel", density = 0, young_modulus = 2.1e11, poisson_ratio = 0.3 }]
"""


def published_difference(name: str, folder: Path, decks: Path = DECKS) -> float:
    """Return the largest difference to the published displacements, over the largest displacement.

    It is infinite if the results are those of other nodes.

    Parameters
    ----------
    name : str
        Name of a deck, one of `NAMES`.
    folder : Path
        Folder into which the structure is written.
    decks : Path
        Folder of the decks.
    """
    deck = _unpacked_text(decks / f"{name}.inp.gz")
    results = _unpacked_text(decks / f"{name}.dat.ref.gz")
    structure_file = _write_structure(deck, folder)
    structure = load_and_assemble(structure_file)
    responses = static_responses(structure).values()
    displacement = np.asarray(sum(response.displacement for response in responses))
    # The deck is in millimetres.
    computed = 1e3 * structure.full_displacement(displacement)

    mesh = read_mesh(folder / MESH_FILE, 1.0, "m")
    rows = _published_rows(results, len(mesh.points))
    node_numbers, *components = rows.T
    if node_numbers.tolist() != mesh.node_numbers.tolist():
        return float("inf")
    published = np.column_stack(components)
    return float(np.abs(published - computed).max() / np.abs(computed).max())


def _unpacked_text(file: Path) -> str:
    """Return the text of a file packed by gzip."""
    return gzip.decompress(file.read_bytes()).decode()


def _published_rows(results: str, count: int) -> FloatArray:
    """Return node number and displacement [mm] (count, 4) of the first nodes in the results."""
    lines = results.split("displacements")[1].splitlines()[2:]
    rows = [line.split() for line in lines]
    node_rows = [row for row in rows if len(row) == 4]
    return np.array(node_rows[:count], dtype=float)


def _write_structure(deck: str, folder: Path) -> Path:
    """Write a deck as a structure, and return its file.

    The same force along y at each node of the loaded set becomes a load for each of them.
    """
    # Supports may name a single node: node sets for these.
    node_sets = [f"\n*NSET, NSET=NODE{number}\n{number}" for number in (1, 3)]
    mesh_file = folder / MESH_FILE
    mesh_file.write_text(deck.rstrip() + "".join(node_sets) + "\n", encoding="latin-1")
    mesh = read_mesh(mesh_file, 1.0, "m")
    loaded_set, direction, force = _second_line(deck.split("*CLOAD")[1]).split(",")
    if direction != "2":
        raise ValueError(f"the deck must load its nodes along y, direction 2, not {direction}.")
    text = HEAD + "".join(_supports(deck))
    positions = mesh.points[mesh.nodes_of(loaded_set, "here")].tolist()
    for number, position in enumerate(positions):
        text += (
            f'[[load]]\nname = "n{number}"\npoint = {position}\nforce = [0, {float(force)}, 0]\n'
        )
    structure_file = folder / "s.toml"
    structure_file.write_text(text, encoding="utf-8")
    return structure_file


def _second_line(text: str) -> str:
    """Return the second line of a text: the data after the rest of a keyword's line."""
    return text.splitlines()[1]


def _supports(deck: str) -> Iterator[str]:
    """Yield the supports of a deck as tables of a structure."""
    for block in deck.split("*BOUNDARY")[1:]:
        data_lines = block.split("*")[0].splitlines()[1:]
        for line in data_lines:
            entries = [entry.strip() for entry in line.split(",") if entry.strip()]
            node_set, first, *optional_last = entries
            last = optional_last[0] if optional_last else first
            axes = list("xyz"[int(first) - 1 : int(last)])
            set_name = f"NODE{node_set}" if node_set.isdigit() else node_set
            yield f'[[support]]\nset = "{set_name}"\nhold = {axes}\n'
