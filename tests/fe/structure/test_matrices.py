"""Structures from matrices: shells and beams against CalculiX, formats, closed forms, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import io, sparse

from fe.full.modes import lowest_eigenpairs
from fe.full.statics import Factorisation
from fe.runtime.errors import FiniteElementError
from fe.structure.design import load_structure
from fe.structure.field import natural_frequencies, static_responses
from fe.structure.operators import assemble_structure, load_and_assemble
from tests.calculix_decks import (
    Deck,
    Point,
    frame,
    frequencies,
    needs_calculix,
    solved,
    stiffened_skin,
    write_structure,
)  # fmt: skip

FloatArray = NDArray[np.float64]

SKIN = ((50.0, 50.0, 0.0), (150.0, 50.0, 0.0))
FRAME = ((150.0, 0.0, 400.0), (450.0, 0.0, 400.0))
CASES = [
    pytest.param(stiffened_skin, "S8R", (300.0, 0.0, 0.0), (275.0, 0.0, 0.0), SKIN, id="skin of S8R"),
    pytest.param(stiffened_skin, "S4", (300.0, 0.0, 0.0), (250.0, 0.0, 0.0), SKIN, id="skin of S4"),
    pytest.param(frame, "B32", (600.0, 300.0, 400.0), (150.0, 0.0, 400.0), FRAME, id="frame of B32"),
    pytest.param(frame, "B31", (600.0, 300.0, 400.0), (150.0, 0.0, 400.0), FRAME, id="frame of B31"),
]


def tables(deck: Deck, forces: list[tuple[int, Point]], gauge: tuple[int, int]) -> str:
    """A load for each force, a gauge of 100 mm along x, and the displacements of all free nodes."""
    text = f'[[gauge]]\nname = "g"\nnodes = {list(gauge)}\ndirection = [2, 0, 0]\nlength = 100\n'
    for number, (node, force) in enumerate(forces):
        text += f'[[load]]\nname = "l{number}"\ncontrol = "push"\nnode = {node}\nforce = {[*force]}\n'
    for node in sorted(set(deck.node.values()) - set(deck.held)):
        for axis, name in enumerate("xyz"):
            direction = [float(axis == other) for other in range(3)]
            text += f'[[displacement]]\nname = "{name}{node}"\nnode = {node}\ndirection = {direction}\n'
    return text


@needs_calculix
@pytest.mark.parametrize(("build", "kind", "corner", "middle", "gauge"), CASES)
def test_shells_and_beams_are_calculixs_own(
    build: Callable[..., Deck],
    kind: str,
    corner: Point,
    middle: Point,
    gauge: tuple[Point, Point],
    tmp_path: Path,
) -> None:
    """Displacements, an extension, six frequencies, also in a state of which no matrix was made."""
    deck = build(kind)
    up, across = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)
    forces = [(deck.node[corner], up), (deck.node[corner], across), (deck.node[middle], up)]
    ends = deck.node[gauge[0]], deck.node[gauge[1]]
    file = write_structure(tmp_path, lambda **changes: build(kind, **changes), tables(deck, forces, ends))
    structure = assemble_structure(file)
    for e, loss in ((1.0, 0.0), (1.07, 0.7)):
        other = build(kind, skin=e, patch=e * (1.0 - loss))
        stiffness = structure.stiffness({"e": e}, {"z1": loss})
        factors = Factorisation(stiffness)
        for number, theirs in enumerate(solved(other, tmp_path / "calculix", forces)):
            ours = factors.solve(structure.load(f"l{number}"))
            nodes = sorted(set(deck.node.values()) - set(deck.held))
            wanted = np.array([theirs[node] for node in nodes])
            found = 1e3 * (structure.displacement_output @ ours).reshape(-1, 3)
            largest = np.abs(wanted).max()
            assert np.abs(found - wanted).max() < 1e-6 * largest
            strain = (theirs[ends[1]] - theirs[ends[0]])[0] / 100.0
            assert structure.gauge_output @ ours == pytest.approx(strain, abs=1e-6 * largest / 100.0)
        squares, _ = lowest_eigenpairs(stiffness, structure.mass(), 6)
        wanted = frequencies(other, tmp_path / "calculix")
        np.testing.assert_allclose(np.sqrt(squares) / (2.0 * np.pi), wanted, rtol=1e-6)


# ------------------------------------------------------------------ a chain of which everything is known
#
# Ground, 200 N/mm, node 4, 100 N/mm, node 7, 50 N/mm, node 9, along x; masses of 2, 1 and 0.5 kg.

PLACES = [(4, 1), (7, 1), (9, 1)]
STIFFNESS = np.array([[300.0, -100.0, 0.0], [-100.0, 150.0, -50.0], [0.0, -50.0, 50.0]])
MIDDLE = np.array([[100.0, -100.0, 0.0], [-100.0, 100.0, 0.0], [0.0, 0.0, 0.0]])
MASS = np.diag([2e-3, 1e-3, 0.5e-3])
CHAIN = """name = "chain"
length_unit = "mm"
stiffness_matrix = "k.mtx"
mass_matrix = "m.mtx"
unknowns = "rows.dof"
[[parameter]]
name = "e"
nominal = 2.0
[[control]]
name = "push"
unit = "N"
[[damage]]
name = "z1"
[[part]]
matrix = "middle.mtx"
scaled_by = "e"
damage = "z1"
[[load]]
name = "push"
control = "push"
node = 9
force = [1, 0, 0]
[[load]]
name = "weight"
acceleration = [10, 0, 0]
[[mass]]
name = "pump"
node = 7
mass = 0.5
free = true
[[gauge]]
name = "g"
nodes = [4, 7]
direction = [1, 0, 0]
length = 20
[[displacement]]
name = "end"
node = 9
direction = [-3, 0, 0]
"""


def half(matrix: FloatArray) -> list[tuple[int, int, float]]:
    """One of each two entries that mirror each other, above the diagonal or below, rows from 0."""
    pairs = [(0, 0), (1, 0), (1, 1), (1, 2), (2, 2)]
    return [(i, j, float(matrix[i, j])) for i, j in pairs if matrix[i, j]]


def write_chain(folder: Path, changes: dict[str, str] | None = None) -> Path:
    """The chain in MatrixMarket files, with texts exchanged in its structure file."""
    for name, matrix in (("k", STIFFNESS), ("m", MASS), ("middle", MIDDLE)):
        io.mmwrite(folder / f"{name}.mtx", sparse.coo_array(matrix), symmetry="general")
    (folder / "rows.dof").write_text("\n".join(f"{node}.{component}" for node, component in PLACES))
    text = CHAIN
    for old, new in (changes or {}).items():
        assert old in text
        text = text.replace(old, new, 1)
    file = folder / "chain.toml"
    file.write_text(text, encoding="utf-8")
    return file


def test_a_chain_answers_as_by_hand(tmp_path: Path) -> None:
    """Forces over springs: extensions add up; e = 2 is nominal, z1 takes from the middle spring alone."""
    chain = assemble_structure(write_chain(tmp_path))
    found = static_responses(chain)
    assert found["push"].output == pytest.approx([-1e-3 * (1 / 200 + 1 / 100 + 1 / 50)], rel=1e-12)
    assert found["push"].strain == pytest.approx([1 / 100 / 20], rel=1e-12)
    # 2, 1.5 (with the pump) and 0.5 kg at 10 m/s^2
    weight = -1e-3 * (40 / 200 + 20 / 100 + 5 / 50)
    assert found["weight"].output == pytest.approx([weight], rel=1e-12)
    assert chain.load("weight", masses={"pump": 1.0}) == pytest.approx([20.0, 20.0, 5.0], rel=1e-12)
    assert found["push"].largest == pytest.approx(-found["push"].output[0], rel=1e-12)
    changed = chain.stiffness({"e": 3.0}, {"z1": 0.6}).toarray()
    np.testing.assert_allclose(changed, STIFFNESS + (1.5 * 0.4 - 1.0) * MIDDLE, rtol=1e-12, atol=1e-10)
    pumped = MASS + np.diag([0.0, 0.5e-3, 0.0])
    wanted = np.sqrt(np.linalg.eigvals(np.linalg.solve(pumped, STIFFNESS))) / (2.0 * np.pi)
    np.testing.assert_allclose(natural_frequencies(chain, 2)[0], np.sort(wanted)[:2], rtol=1e-10)


def as_npz(folder: Path, name: str, matrix: FloatArray) -> str:
    sparse.save_npz(folder / f"{name}.npz", sparse.csr_array(matrix))
    return f"{name}.npz"


def as_arrays(folder: Path, name: str, matrix: FloatArray) -> str:
    np.savez(folder / f"{name}.npz", other=np.eye(2), **{name: matrix})
    return f"{name}.npz:{name}"


def as_table(folder: Path, name: str, matrix: FloatArray) -> str:
    lines = [f"{i + 1} {j + 1}  {value:.13e}" for i, j, value in half(matrix)]
    (folder / f"{name}.sti").write_text("\n".join(lines))
    return f"{name}.sti"


def as_abaqus(folder: Path, name: str, matrix: FloatArray) -> str:
    lines = ["** matrix input"]
    lines += [",".join(map(str, (*PLACES[i], *PLACES[j], f" {value:.13e}"))) for i, j, value in half(matrix)]
    (folder / f"{name}_STIF1.mtx").write_text("\n".join(lines))
    return f"{name}_STIF1.mtx"


def as_symmetric_market(folder: Path, name: str, matrix: FloatArray) -> str:
    io.mmwrite(folder / f"{name}.mtx", sparse.coo_array(matrix), symmetry="symmetric")
    return f"{name}.mtx"


def as_dmig(folder: Path, name: str, matrix: FloatArray) -> str:
    """All matrices in one punch file, as Nastran writes them: columns of the lower half, wide fields."""
    file, lines = folder / "all.pch", []
    title = f"{name[:4].upper()}AAX"
    lines.append(f"DMIG    {title:<8}{0:>8}{6:>8}{2:>8}{0:>8}{'':8}{'':8}{1:>8}")
    for j, (node, component) in enumerate(PLACES):
        lines.append(f"DMIG*   {title:<16}{node:>16}{component:>16}")
        for i, column, value in half(matrix):
            if column == j:
                number = f"{value:.9E}".replace("E", "D")
                lines.append(f"*       {PLACES[i][0]:>16}{PLACES[i][1]:>16}{number:>16}")
    with file.open("a", encoding="utf-8") as text:
        text.write("\n".join(lines) + "\n")
    return f"all.pch:{title}"


@pytest.mark.parametrize("write", [as_npz, as_arrays, as_table, as_symmetric_market, as_abaqus, as_dmig])
def test_every_format_is_the_same_structure(
    write: Callable[[Path, str, FloatArray], str], tmp_path: Path
) -> None:
    """Those that name nodes need no file of unknowns, and a part may name fewer of them."""
    wanted = assemble_structure(write_chain(tmp_path))
    changes = {
        f'"{name}.mtx"': f'"{write(tmp_path, name, matrix)}"'
        for name, matrix in (("k", STIFFNESS), ("m", MASS), ("middle", MIDDLE))
    }
    if write in (as_abaqus, as_dmig):
        changes['unknowns = "rows.dof"'] = ""
    found = assemble_structure(write_chain(tmp_path, changes))
    for values in ({}, {"e": 2.2, "z1": 0.5, "push": 3.0}):
        for ours, theirs in zip(found.at(values), wanted.at(values), strict=True):
            assert np.abs(ours - theirs).max() <= 1e-9 * np.abs(theirs).max()


def test_a_whole_may_be_a_sum_and_a_part_a_difference(tmp_path: Path) -> None:
    wanted = assemble_structure(write_chain(tmp_path))
    io.mmwrite(tmp_path / "rest.mtx", sparse.coo_array(STIFFNESS - MIDDLE))
    io.mmwrite(tmp_path / "soft.mtx", sparse.coo_array(STIFFNESS - 0.75 * MIDDLE))
    changes = {
        '"k.mtx"': '["rest.mtx", "middle.mtx"]',
        'matrix = "middle.mtx"': 'changed = "soft.mtx"\ntimes = 0.25',
    }
    found = assemble_structure(write_chain(tmp_path, changes))
    values = {"e": 1.9, "z1": 0.3}
    np.testing.assert_allclose(
        found.at(values)[0].toarray(), wanted.at(values)[0].toarray(), rtol=1e-12, atol=1e-9
    )


def test_vectors_stand_for_loads_and_outputs(tmp_path: Path) -> None:
    """In the order of the rows, or by node and component; a mass may be a matrix of its own."""
    wanted = assemble_structure(write_chain(tmp_path))
    (tmp_path / "push.txt").write_text("0\n0\n1\n")
    (tmp_path / "gauge.csv").write_text("4, 1, -0.05\n7, 1, 0.05\n")
    np.save(tmp_path / "end.npy", np.array([0.0, 0.0, -1.0]))
    io.mmwrite(tmp_path / "pump.mtx", sparse.coo_array(np.diag([0.0, 1e-3, 0.0])))
    changes = {
        "node = 9\nforce = [1, 0, 0]": 'vector = "push.txt"',
        "nodes = [4, 7]\ndirection = [1, 0, 0]\nlength = 20": 'vector = "gauge.csv"',
        "node = 9\ndirection = [-3, 0, 0]": 'vector = "end.npy"',
        "node = 7\nmass": 'matrix = "pump.mtx"\nmass',
    }
    found = assemble_structure(write_chain(tmp_path, changes))
    for ours, theirs in (
        (found.load("push"), wanted.load("push")),
        (found.gauge_output.toarray(), wanted.gauge_output.toarray()),
        (found.displacement_output.toarray(), wanted.displacement_output.toarray()),
        (found.mass().toarray(), wanted.mass().toarray()),
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-15)


def test_a_support_holds_what_the_matrices_leave_free(tmp_path: Path) -> None:
    """A free chain is told which motion is free; held at its first node it is a spring and a mass."""
    free = STIFFNESS - np.diag([200.0, 0.0, 0.0])
    wide = np.zeros((4, 4))
    wide[:3, :3] = free
    file = write_chain(tmp_path)
    io.mmwrite(tmp_path / "k.mtx", sparse.coo_array(free))
    words = r"leaves free, or nearly: 1; in one node \d, component 1 moves most\. Hold"
    with pytest.raises(FiniteElementError, match=words):
        assemble_structure(file)
    held = file.read_text(encoding="utf-8") + '[[support]]\nnodes = [4]\nhold = ["x"]\n'
    file.write_text(held, encoding="utf-8")
    found = static_responses(assemble_structure(file))["push"]
    assert found.output == pytest.approx([-1e-3 * (1 / 100 + 1 / 50)], rel=1e-12)
    # a row of nothing, as a solid's turns in Nastran, is left out
    io.mmwrite(tmp_path / "k.mtx", sparse.coo_array(wide))
    for name, matrix in (("m", MASS), ("middle", MIDDLE)):
        wide[:3, :3] = matrix
        io.mmwrite(tmp_path / f"{name}.mtx", sparse.coo_array(wide))
    (tmp_path / "rows.dof").write_text("4 1\n7,1\n 9.1\n9.4\n")
    assert static_responses(assemble_structure(file))["push"].output == pytest.approx(found.output, rel=1e-12)


def changed(matrix: FloatArray, **entries: float) -> FloatArray:
    """A matrix with entries such as a12 replaced."""
    new = matrix.copy()
    for name, value in entries.items():
        new[int(name[1]) - 1, int(name[2]) - 1] = value
    return new


HEADER = "%%MatrixMarket matrix coordinate real general\n3 3 1\n"
REFUSED = [
    # what stands in which file, or what is exchanged in the structure file, and the sentence
    ({"k.mtx": changed(STIFFNESS, a12=-90.0)}, r"not symmetric: .* node (4|7), component 1 .* 10; friction"),
    ({"k.mtx": changed(STIFFNESS, a33=np.nan)}, "holds a number that is not finite"),
    ({"k.mtx": changed(STIFFNESS, a33=-1.0)}, "node 9, component 1 has a negative stiffness"),
    ({"k.mtx": changed(STIFFNESS, a33=10.0)}, "the stiffness is indefinite"),
    ({"k.mtx": STIFFNESS * np.outer((1, 1, 0), (1, 1, 0))}, "node 9, component 1 has mass but no stiffness"),
    ({"k.mtx": 1j * STIFFNESS}, "of real numbers is expected, but complex128"),
    ({"k.mtx": 0.0 * STIFFNESS, "m.mtx": 0.0 * MASS}, "no row that is free and has stiffness or mass"),
    ({"middle.mtx": ""}, "it is empty"),
    ({"k.mtx": STIFFNESS[:2]}, r"of real numbers is expected, but float64 of shape \(2, 3\)"),
    ({"m.mtx": MASS[:2, :2]}, r"m\.mtx has 2 rows, but there are 3 unknowns; .* same run"),
    ({"m.mtx": changed(MASS, a22=-1e-3)}, "node 7, component 1 has a negative mass"),
    ({"m.mtx": changed(MASS, a12=9e-3, a21=9e-3)}, "mass matrix is indefinite"),
    ({"middle.mtx": 2.0 * STIFFNESS}, "the parts are together stiffer than the whole; two parts must"),
    ({"middle.mtx": -MIDDLE}, r"part\[1\] takes stiffness away somewhere"),
    ({"middle.mtx": 0.0 * MIDDLE}, r"part\[1\] has no stiffness"),
    ({"middle.mtx": HEADER}, r"middle\.mtx: the file cannot be read"),
    ({"middle.mtx": "1 2\n3 4\n"}, r"lines of row, column and value.* but 2 lines of 2 numbers came"),
    ({"middle.mtx": "4,1,8,1,5.0\n"}, r"part\[1\].*node 8 has no component 1 .* no such node"),
    ({"middle.mtx": "DMIG    K       0       6       3       0               3\n"}, "K is complex"),
    ({"rows.dof": "4.1\n7.1\n9.7\n"}, r"rows\.dof, line 3: a node and its component .* 6 .* '9\.7' came"),
    ({"rows.dof": "4.1\n7.1\n9.2\n"}, r"node 9 has no component 1 .* its components 2;"),
    ({"rows.dof": "4.1\n7.1\n7.1\n"}, r"node 9 has no component 1 .* no such node"),
    ({'unknowns = "rows.dof"': ""}, "does not say which node and component each row is; name a file"),
    ({'"m.mtx"': '"none.mtx"'}, r"none\.mtx cannot be read"),
    ({'"m.mtx"': "[]"}, "mass_matrix"),
    ({"node = 9\nforce": "node = 5\nforce"}, r"load\[1\]: node 5 has no component 1 .* no such node"),
    ({"force = [1, 0, 0]": "force = [1, 1, 0]"}, r"load\[1\]: node 9 has no component 2"),
    ({"force = [1, 0, 0]": "force = [0, 0, 0]"}, r"load\[1\]\.force: it must point somewhere"),
    ({"node = 9\nforce = [1, 0, 0]": 'vector = "k.mtx"'}, r"a vector of 3 numbers, .* shape \(3, 3\) came"),
    ({"acceleration = [10, 0, 0]": "node = 9"}, r"load\[2\]: either vector, or node and force, or"),
    ({"length = 20": ""}, r"gauge\[1\]: either vector, or nodes and direction and length is expected"),
    ({"direction = [-3, 0, 0]": ""}, r"displacement\[1\]: either vector, or node and direction"),
    ({"node = 7\nmass": "mass"}, r"mass\[1\]: either node, or matrix"),
    ({'matrix = "middle.mtx"': 'changed = "m.mtx"'}, r"part\[1\]: either matrix, or changed and times"),
    ({'matrix = "middle.mtx"': 'changed = "m.mtx"\ntimes = 1'}, r"part\[1\]\.times: input should be less"),
    ({'damage = "z1"': 'damage = "z2"'}, r"part\[1\] is of the region 'z2', but no \[\[damage\]\] has that"),
    ({'name = "z1"': 'name = "z1"\n[[damage]]\nname = "z2"'}, "'z2' has no stiffness: no part"),
    ({'scaled_by = "e"\n': ""}, "the parameter 'e' scales no part"),
    ({'"mm"\n': '"mm"\nmesh = "a.inp"\n'}, "mesh"),
]


@pytest.mark.parametrize(("changes", "sentence"), REFUSED)
def test_what_is_no_structure_is_refused_in_a_sentence(
    changes: dict[str, FloatArray | str], sentence: str, tmp_path: Path
) -> None:
    files = ("k.mtx", "m.mtx", "middle.mtx", "rows.dof")
    file = write_chain(tmp_path, {old: new for old, new in changes.items() if old not in files})
    for name in changes.keys() & set(files):
        if isinstance(changes[name], str):
            (tmp_path / name).write_text(changes[name])
        else:
            io.mmwrite(tmp_path / name, sparse.coo_array(changes[name]), symmetry="general")
    with pytest.raises(FiniteElementError, match=sentence) as found:
        assemble_structure(file)
    assert "\n" not in str(found.value)


def test_rows_that_share_a_name_have_no_weight(tmp_path: Path) -> None:
    """Rows that turn look like rows that shift there; nor is it known how five rows share a force."""
    file = write_chain(tmp_path, {"nodes = [4, 7]": "nodes = [9, 7]"})
    (tmp_path / "rows.dof").write_text("9.1\n7.1\n9.1\n")
    words = r"load\[2\]: several rows of the matrices carry one name.* as a vector"
    with pytest.raises(FiniteElementError, match=words):
        assemble_structure(file)


def test_a_mesh_is_asked_for_where_one_is_needed(tmp_path: Path) -> None:
    with pytest.raises(FiniteElementError, match="is a structure from matrices: without a mesh"):
        load_and_assemble(write_chain(tmp_path))


def test_the_hash_is_of_the_content_of_every_file(tmp_path: Path) -> None:
    file = write_chain(tmp_path)
    first = assemble_structure(file).design_hash
    assert assemble_structure(file).design_hash == first
    assert set(load_structure(file).files) == {"k.mtx", "m.mtx", "rows.dof", "middle.mtx"}
    io.mmwrite(tmp_path / "m.mtx", sparse.coo_array(2.0 * MASS))
    assert assemble_structure(file).design_hash != first
