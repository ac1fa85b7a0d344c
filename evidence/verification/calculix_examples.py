"""Decks of CalculiX' own tests, read as structures, against its published results.

They are in Debian's package calculix-ccx-test: beams of 10-node tetrahedra, 20- and 8-node hexahedra under
the same load along y at each node of a set. Results are printed with seven digits.
"""

import gzip
from pathlib import Path

import numpy as np

from fe.structure.affine import static_responses
from fe.structure.mesh_file import read_mesh
from fe.structure.operators import load_and_assemble

DECKS = Path("/usr/share/doc/calculix-ccx-test/examples/test")
NAMES = ("beam10p", "beam20p", "beam8p")
HEAD = """name = "deck"
mesh = "m.inp"
length_unit = "mm"
material = [{ name = "steel", density = 0, young_modulus = 2.1e11, poisson_ratio = 0.3 }]
"""


def published_difference(name: str, folder: Path, decks: Path = DECKS) -> float:
    """Return the largest difference to the published displacements, over the largest.

    Parameters
    ----------
    name : str
        Of a deck, one of `NAMES`.
    folder : Path
        Where the structure is written.
    decks : Path
        Where the decks are.
    """
    deck, results = (
        gzip.decompress((decks / f"{name}{end}").read_bytes()).decode() for end in (".inp.gz", ".dat.ref.gz")
    )
    extra = "".join(f"\n*NSET, NSET=NODE{number}\n{number}" for number in (1, 3))
    (folder / "m.inp").write_text(deck.rstrip() + extra + "\n", encoding="latin-1")
    mesh = read_mesh(folder / "m.inp", 1.0, "m")
    part, direction, force = deck.split("*CLOAD")[1].splitlines()[1].split(",")
    assert direction == "2"
    text = HEAD
    for block in deck.split("*BOUNDARY")[1:]:
        for line in block.split("*")[0].splitlines()[1:]:
            place, first, *last = (item.strip() for item in line.split(",") if item.strip())
            axes = [*"xyz"[int(first) - 1 : int((last or [first])[0])]]
            text += f'[[support]]\nset = "{"NODE" * place.isdigit()}{place}"\nhold = {axes}\n'
    for number, point in enumerate(mesh.points[mesh.nodes_of(part, "here")].tolist()):
        text += f'[[load]]\nname = "n{number}"\npoint = {point}\nforce = [0, {float(force)}, 0]\n'
    (folder / "s.toml").write_text(text, encoding="utf-8")
    structure = load_and_assemble(folder / "s.toml")
    total = sum(found.displacement for found in static_responses(structure).values())
    field = 1e3 * structure.full_displacement(np.asarray(total))
    printed = [line.split() for line in results.split("displacements")[1].splitlines()[2:]]
    rows = np.array([line for line in printed if len(line) == 4][: len(mesh.points)], dtype=float)
    if rows[:, 0].tolist() != mesh.node_numbers.tolist():
        return float("inf")
    return float(np.abs(rows[:, 1:] - field).max() / np.abs(field).max())
