"""Structures from matrices: shells against CalculiX, formats, closed forms, and what is refused."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy import io, sparse

import uav_twin
from fe.full.factorisation import Factorisation, lowest_eigenpairs
from fe.runtime.arrays import FloatArray
from fe.runtime.errors import FiniteElementError
from fe.structure.affine import natural_frequencies, static_responses
from fe.structure.design import load_structure
from fe.structure.operators import assemble_structure
from tests import calculix_decks as decks
from tests.calculix_decks import Point, needs_calculix
from tests.refusals import Inputs, refused

INPUTS = Inputs(__file__)
PLACES = (300.0, 0.0, 0.0), (275.0, 0.0, 0.0), (50.0, 50.0, 0.0), (150.0, 50.0, 0.0)
"""Two nodes that are loaded, the ends of the gauge."""


def tables(free: list[int], forces: list[tuple[int, Point]], gauge: tuple[int, int]) -> str:
    """A load for each force, a gauge of 100 mm along x, and the displacements of all free nodes."""
    text = f'[[gauge]]\nname = "g"\nnodes = {list(gauge)}\ndirection = [2, 0, 0]\nlength = 100\n'
    for number, (node, force) in enumerate(forces):
        text += (
            f'[[load]]\nname = "l{number}"\ncontrol = "push"\nnode = {node}\nforce = {[*force]}\n'
        )
    for node in free:
        for name, direction in zip("xyz", np.eye(3).tolist(), strict=True):
            text += (
                f'[[displacement]]\nname = "{name}{node}"\nnode = {node}\ndirection = {direction}\n'
            )
    return text


@needs_calculix
def test_shells_are_calculixs_own(tmp_path):
    """Displacements, an extension, six frequencies, also in a state of which no matrix was made."""
    deck = decks.stiffened_skin()
    corner, middle, *ends = (deck.node[place] for place in PLACES)
    forces = [(corner, (0.0, 0.0, 1.0)), (corner, (0.0, 1.0, 0.0)), (middle, (0.0, 0.0, 1.0))]
    free = sorted(set(deck.node.values()) - set(deck.held))
    rest = tables(free, forces, (ends[0], ends[1]))
    structure = assemble_structure(decks.write_structure(tmp_path, rest))
    for e, loss in ((1.0, 0.0), (1.07, 0.7)):
        other = decks.stiffened_skin(skin=e, patch=e * (1.0 - loss))
        stiffness = structure.stiffness({"e": e}, {"z1": loss})
        factors = Factorisation(stiffness)
        for number, theirs in enumerate(decks.solved(other, tmp_path / "calculix", forces)):
            ours = factors.solve(structure.load(f"l{number}"))
            wanted = np.array([theirs[node] for node in free])
            found = 1e3 * (structure.displacement_output @ ours).reshape(-1, 3)
            largest = np.abs(wanted).max()
            assert np.abs(found - wanted).max() < 1e-6 * largest
            strain = (theirs[ends[1]] - theirs[ends[0]])[0] / 100.0
            assert structure.gauge_output @ ours == pytest.approx(
                strain, abs=1e-6 * largest / 100.0
            )
        squares, _ = lowest_eigenpairs(stiffness, structure.mass(), 6)
        wanted = decks.frequencies(other, tmp_path / "calculix")
        np.testing.assert_allclose(np.sqrt(squares) / (2.0 * np.pi), wanted, rtol=1e-6)


# ------------------------------------------------------------------ a chain of which everything is known
#
# Ground, 200 N/mm, node 4, 100 N/mm, node 7, 50 N/mm, node 9, along x; masses of 2, 1 and 0.5 kg.

STIFFNESS = np.array([[300.0, -100.0, 0.0], [-100.0, 150.0, -50.0], [0.0, -50.0, 50.0]])
MIDDLE = np.array([[100.0, -100.0, 0.0], [-100.0, 100.0, 0.0], [0.0, 0.0, 0.0]])
MASS = np.diag([2e-3, 1e-3, 0.5e-3])
FILES = {"k.mtx": STIFFNESS, "m.mtx": MASS, "middle.mtx": MIDDLE, "rows.dof": "4.1\n7.1\n9.1"}


def write_chain(folder: Path, changes: dict[str, FloatArray | str] | None = None) -> Path:
    """The chain in MatrixMarket files, with whole files or texts in its structure file exchanged."""
    changes = changes or {}
    for name, content in (FILES | {name: changes[name] for name in FILES.keys() & changes}).items():
        if isinstance(content, str):
            (folder / name).write_text(content)
        else:
            io.mmwrite(folder / name, sparse.coo_array(content), symmetry="general")
    file = folder / "chain.toml"
    texts = [(old, str(new)) for old, new in changes.items() if old not in FILES]
    file.write_text(INPUTS.text("chain.toml", *texts), encoding="utf-8")
    return file


@pytest.fixture
def chain(tmp_path: Path):
    """A maker of the chain with changes; without one, as it is."""
    return lambda changes=None: assemble_structure(write_chain(tmp_path, changes))


def test_a_chain_answers_as_by_hand(chain):
    """Forces over springs: extensions add up; e = 2 is nominal, z1 takes from the middle spring alone."""
    structure = chain()
    found = static_responses(structure)
    assert found["push"].output == pytest.approx([-1e-3 * (1 / 200 + 1 / 100 + 1 / 50)], rel=1e-12)
    assert found["push"].strain == pytest.approx([1 / 100 / 20], rel=1e-12)
    # 2, 1.5 (with the pump) and 0.5 kg at 10 m/s^2
    weight = -1e-3 * (40 / 200 + 20 / 100 + 5 / 50)
    assert found["weight"].output == pytest.approx([weight], rel=1e-12)
    assert structure.load("weight", masses={"pump": 1.0}) == pytest.approx(
        [20.0, 20.0, 5.0], rel=1e-12
    )
    assert found["push"].largest == pytest.approx(-found["push"].output[0], rel=1e-12)
    changed = structure.stiffness({"e": 3.0}, {"z1": 0.6}).toarray()
    wanted = 1e3 * (STIFFNESS + (1.5 * 0.4 - 1.0) * MIDDLE)  # N/m
    np.testing.assert_allclose(changed, wanted, rtol=1e-12, atol=1e-7)
    pumped = MASS + np.diag([0.0, 0.5e-3, 0.0])
    wanted = np.sqrt(np.linalg.eigvals(np.linalg.solve(pumped, STIFFNESS))) / (2.0 * np.pi)
    np.testing.assert_allclose(
        natural_frequencies(structure, 2)[0], np.sort(wanted)[:2], rtol=1e-10
    )


FORMATS = {  # in `inputs/chain` one of each two entries that mirror each other stands, on either side
    "npz": "{0}.npz", "arrays": "{0}_all.npz:{0}", "table": "{0}.sti", "symmetric market": "half_{0}.mtx",
    "abaqus": "{0}_STIF1.mtx", "dmig": "all.pch:{1}AAX",
}  # fmt: skip


@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_is_the_same_structure(kind, chain, tmp_path):
    """Those that name nodes need no file of unknowns, and a part may name fewer of them."""
    wanted, changes = chain(), {}
    shutil.copytree(INPUTS.folder / "chain", tmp_path, dirs_exist_ok=True)
    for name, matrix in (("k", STIFFNESS), ("m", MASS), ("middle", MIDDLE)):
        sparse.save_npz(tmp_path / f"{name}.npz", sparse.csr_array(matrix))
        np.savez(tmp_path / f"{name}_all.npz", other=np.eye(2), **{name: matrix})
        changes[f'"{name}.mtx"'] = f'"{FORMATS[kind].format(name, name[:4].upper())}"'
    if kind in ("abaqus", "dmig"):
        changes['unknowns = "rows.dof"'] = ""
    found = chain(changes)
    for values in ({}, {"e": 2.2, "z1": 0.5, "push": 3.0}):
        for ours, theirs in zip(found.system_at(values), wanted.system_at(values), strict=True):
            assert np.abs(ours - theirs).max() <= 1e-9 * np.abs(theirs).max()


def test_other_ways_to_say_the_same(chain, tmp_path):
    """A whole as a sum, a part as a difference, vectors in the order of the rows or by node and component."""
    wanted = chain()
    for name, matrix in (("rest", STIFFNESS - MIDDLE), ("soft", STIFFNESS - 0.75 * MIDDLE)):
        io.mmwrite(tmp_path / f"{name}.mtx", sparse.coo_array(matrix))
    (tmp_path / "push.txt").write_text("0\n0\n1\n")
    (tmp_path / "gauge.csv").write_text("4, 1, -0.05\n7, 1, 0.05\n")
    np.save(tmp_path / "end.npy", np.array([0.0, 0.0, -1.0]))
    io.mmwrite(tmp_path / "pump.mtx", sparse.coo_array(np.diag([0.0, 1e-3, 0.0])))
    found = chain({
        '"k.mtx"': '["rest.mtx", "middle.mtx"]',
        'matrix = "middle.mtx"': 'changed = "soft.mtx"\ntimes = 0.25',
        "node = 9\nforce = [1, 0, 0]": 'vector = "push.txt"',
        "nodes = [4, 7]\ndirection = [1, 0, 0]\nlength = 20": 'vector = "gauge.csv"',
        "node = 9\ndirection = [-3, 0, 0]": 'vector = "end.npy"',
        "node = 7\nmass": 'matrix = "pump.mtx"\nmass',
    })  # fmt: skip
    values = {"e": 1.9, "z1": 0.3}
    ours, theirs = (
        structure.system_at(values).stiffness.toarray() for structure in (found, wanted)
    )
    np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(found.load("push"), wanted.load("push"), rtol=1e-12, atol=1e-15)
    for name in ("gauge_output", "displacement_output"):
        ours, theirs = (getattr(structure, name).toarray() for structure in (found, wanted))
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(
        found.mass().toarray(), wanted.mass().toarray(), rtol=1e-12, atol=1e-15
    )


def test_a_support_holds_what_the_matrices_leave_free(chain):
    """A free chain is told which motion is free; held at its first node it is a spring and a mass."""
    free: dict[str, FloatArray | str] = {"k.mtx": STIFFNESS - np.diag([200.0, 0.0, 0.0])}
    words = r"leaves free, or nearly: 1; in one node \d, component 1 moves most\. Hold"
    with refused(FiniteElementError, words):
        chain(free)
    held = free | {"[[mass]]": '[[support]]\nnodes = [4]\nhold = ["x"]\n[[mass]]'}
    found = static_responses(chain(held))["push"]
    assert found.output == pytest.approx([-1e-3 * (1 / 100 + 1 / 50)], rel=1e-12)
    # a row of nothing, as a solid's turns in Nastran, is left out
    held |= {
        name: np.pad(matrix, (0, 1))
        for name, matrix in (FILES | held).items()
        if name.endswith("mtx")
    }
    wide = chain(held | {"rows.dof": "4 1\n7,1\n 9.1\n9.4\n"})
    assert static_responses(wide)["push"].output == pytest.approx(found.output, rel=1e-12)


CHANGED = [({old: new}, sentence) for old, new, sentence in INPUTS.refused("chain")]


@pytest.mark.parametrize(("changes", "sentence"), [*CHANGED, *INPUTS.refused("chains")])
def test_what_is_no_structure_is_refused_in_a_sentence(changes, sentence, chain):
    with refused(FiniteElementError, sentence):
        chain(changes)


def test_the_hash_is_of_the_content_of_every_file(chain, tmp_path):
    first = chain().design_hash
    assert chain().design_hash == first
    assert set(load_structure(tmp_path / "chain.toml").files) == set(FILES)
    for name, content in FILES.items():
        factor = 1.1 if name == "k.mtx" else 0.9
        other = f"{content} " if isinstance(content, str) else factor * content
        assert chain({name: other}).design_hash != first


def test_the_same_verbs_serve_wings_and_structures(tmp_path, coarse_design):
    """They take the design of a wing, or the path of a structure file, and values by name."""
    wing = uav_twin.assemble(coarse_design)
    response = uav_twin.static_response(wing, {"z1": 0.4, "load_factor": 3.0})
    lift = wing.turn(3.0)
    displacement = Factorisation(wing.stiffness(stiffness_loss={"z1": 0.4})).solve(lift)
    assert response.strain == pytest.approx(wing.gauge_output @ displacement, rel=1e-9)
    modes = uav_twin.natural_frequencies(wing, 4)
    assert uav_twin.flapwise_bending_modes(wing, modes).tolist()[0] == 0
    chain = uav_twin.assemble(write_chain(tmp_path))
    squares, _ = lowest_eigenpairs(chain.stiffness(), chain.mass(), 2)
    found = uav_twin.natural_frequencies(chain, 2).frequency
    assert found == pytest.approx(np.sqrt(squares) / (2.0 * np.pi), rel=1e-9)
