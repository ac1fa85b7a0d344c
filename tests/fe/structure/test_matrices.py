"""Structures from matrices: shells against CalculiX, formats, closed forms, and what is refused."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
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
from fe.structure.operators import Structure, assemble_structure
from tests import calculix_decks as decks
from tests.calculix_decks import Deck, Point, needs_calculix
from tests.refusals import Inputs, refused

INPUTS = Inputs(__file__)

# ---------------------------------------------------------------- shells of CalculiX

CORNER = (300.0, 0.0, 0.0)
MIDDLE_OF_EDGE = (275.0, 0.0, 0.0)
GAUGE_START = (50.0, 50.0, 0.0)
GAUGE_END = (150.0, 50.0, 0.0)
"""Places of nodes [mm]."""


def structure_tables(
    free_nodes: list[int], forces: list[tuple[int, Point]], gauge: tuple[int, int]
) -> str:
    """Return a load for each force, a gauge of 100 mm along x, displacements of all free nodes."""
    text = f'[[gauge]]\nname = "g"\nnodes = {list(gauge)}\ndirection = [2, 0, 0]\nlength = 100\n'
    for number, (node, force) in enumerate(forces):
        text += f'[[load]]\nname = "l{number}"\ncontrol = "push"\n'
        text += f"node = {node}\nforce = {[*force]}\n"
    for node in free_nodes:
        for name, direction in zip("xyz", np.eye(3).tolist(), strict=True):
            text += f'[[displacement]]\nname = "{name}{node}"\n'
            text += f"node = {node}\ndirection = {direction}\n"
    return text


@dataclass(frozen=True)
class StoredShells:
    """A stiffened skin that CalculiX has stored as matrices.

    Attributes
    ----------
    structure : Structure
        What is read of these matrices.
    deck : Deck
    forces : list
        Node and force of each load.
    free_nodes : list of int
    gauge : tuple of int
        The nodes at both ends of the gauge.
    """

    structure: Structure
    deck: Deck
    forces: list[tuple[int, Point]]
    free_nodes: list[int]
    gauge: tuple[int, int]


@pytest.fixture(scope="module")
def shells(tmp_path_factory) -> StoredShells:
    deck = decks.stiffened_skin()
    corner = deck.node[CORNER]
    forces = [
        (corner, (0.0, 0.0, 1.0)),
        (corner, (0.0, 1.0, 0.0)),
        (deck.node[MIDDLE_OF_EDGE], (0.0, 0.0, 1.0)),
    ]
    free_nodes = sorted(set(deck.node.values()) - set(deck.held))
    gauge = (deck.node[GAUGE_START], deck.node[GAUGE_END])
    tables = structure_tables(free_nodes, forces, gauge)
    file = decks.write_structure(tmp_path_factory.mktemp("shells"), tables)
    return StoredShells(assemble_structure(file), deck, forces, free_nodes, gauge)


STATES = [(1.0, 0.0), (1.07, 0.7)]
"""Factor of the modulus and loss of the patch; of the second one no matrix was made."""


@needs_calculix
@pytest.mark.parametrize(("modulus_factor", "loss"), STATES)
def test_displacements_and_extensions_of_shells_are_those_of_calculix(
    shells, tmp_path, modulus_factor, loss
):
    deck = decks.stiffened_skin(skin=modulus_factor, patch=modulus_factor * (1.0 - loss))
    factors = Factorisation(shells.structure.stiffness({"e": modulus_factor}, {"z1": loss}))
    start, end = shells.gauge

    for number, theirs in enumerate(decks.solved(deck, tmp_path / "calculix", shells.forces)):
        solution = factors.solve(shells.structure.load(f"l{number}"))

        displacement = 1e3 * (shells.structure.displacement_output @ solution).reshape(-1, 3)
        expected = np.array([theirs[node] for node in shells.free_nodes])
        largest = np.abs(expected).max()
        extension, _, _ = theirs[end] - theirs[start]
        strain = pytest.approx(extension / 100.0, abs=1e-6 * largest / 100.0)
        assert np.abs(displacement - expected).max() < 1e-6 * largest
        assert shells.structure.gauge_output @ solution == strain


@needs_calculix
@pytest.mark.parametrize(("modulus_factor", "loss"), STATES)
def test_frequencies_of_shells_are_those_of_calculix(shells, tmp_path, modulus_factor, loss):
    deck = decks.stiffened_skin(skin=modulus_factor, patch=modulus_factor * (1.0 - loss))
    stiffness = shells.structure.stiffness({"e": modulus_factor}, {"z1": loss})

    squares, _ = lowest_eigenpairs(stiffness, shells.structure.mass(), 6)

    expected = decks.frequencies(deck, tmp_path / "calculix")
    np.testing.assert_allclose(np.sqrt(squares) / (2.0 * np.pi), expected, rtol=1e-6)


# ---------------------------------------------------------------- a chain in closed form
#
# Ground, 200 N/mm, node 4, 100 N/mm, node 7, 50 N/mm, node 9, along x; masses of 2, 1 and 0.5 kg.

STIFFNESS = np.array([[300.0, -100.0, 0.0], [-100.0, 150.0, -50.0], [0.0, -50.0, 50.0]])
MIDDLE_SPRING = np.array([[100.0, -100.0, 0.0], [-100.0, 100.0, 0.0], [0.0, 0.0, 0.0]])
MASS = np.diag([2e-3, 1e-3, 0.5e-3])
FILES = {
    "k.mtx": STIFFNESS,
    "m.mtx": MASS,
    "middle.mtx": MIDDLE_SPRING,
    "rows.dof": "4.1\n7.1\n9.1",
}
Changes = dict[str, FloatArray | str]


def write_chain(folder: Path, changes: Changes | None = None) -> Path:
    """Write the chain in MatrixMarket files, and return its structure file.

    Files by their names, and texts of the structure file, can be exchanged.
    """
    changes = changes or {}
    for name, original in FILES.items():
        content = changes.get(name, original)
        if isinstance(content, str):
            (folder / name).write_text(content)
        else:
            io.mmwrite(folder / name, sparse.coo_array(content), symmetry="general")
    texts = [(old, str(new)) for old, new in changes.items() if old not in FILES]
    file = folder / "chain.toml"
    file.write_text(INPUTS.text("chain.toml", *texts), encoding="utf-8")
    return file


@pytest.fixture
def make_chain(tmp_path: Path) -> Callable[..., Structure]:
    """A maker of the chain with changes; without one, as it is."""

    def make(changes: Changes | None = None) -> Structure:
        return assemble_structure(write_chain(tmp_path, changes))

    return make


@pytest.fixture(scope="module")
def chain(tmp_path_factory) -> Structure:
    return assemble_structure(write_chain(tmp_path_factory.mktemp("chain")))


@pytest.fixture(scope="module")
def chain_responses(chain):
    return static_responses(chain)


def test_a_pushed_chain_answers_as_by_hand(chain_responses):
    """Extensions of springs add up."""
    push = chain_responses["push"]
    end = -1e-3 * (1 / 200 + 1 / 100 + 1 / 50)

    assert push.output == pytest.approx([end], rel=1e-12)
    assert push.strain == pytest.approx([1 / 100 / 20], rel=1e-12)
    assert push.largest == pytest.approx(-end, rel=1e-12)


def test_a_chain_under_its_weight_answers_as_by_hand(chain_responses):
    """2, 1.5 (with the pump) and 0.5 kg at 10 m/s^2."""
    end = -1e-3 * (40 / 200 + 20 / 100 + 5 / 50)

    assert chain_responses["weight"].output == pytest.approx([end], rel=1e-12)


def test_another_mass_has_another_weight(chain):
    weight = chain.load("weight", masses={"pump": 1.0})

    assert weight == pytest.approx([20.0, 20.0, 5.0], rel=1e-12)


def test_parameter_and_loss_change_the_stiffness(chain):
    """e = 2 is nominal, z1 takes from the middle spring alone."""
    stiffness = chain.stiffness({"e": 3.0}, {"z1": 0.6}).toarray()

    expected = 1e3 * (STIFFNESS + (1.5 * 0.4 - 1.0) * MIDDLE_SPRING)  # N/m
    np.testing.assert_allclose(stiffness, expected, rtol=1e-12, atol=1e-7)


def test_frequencies_of_a_chain_are_those_of_its_matrices(chain):
    mass_with_pump = MASS + np.diag([0.0, 0.5e-3, 0.0])
    squares = np.sort(np.linalg.eigvals(np.linalg.solve(mass_with_pump, STIFFNESS)))

    frequency, _ = natural_frequencies(chain, 2)

    np.testing.assert_allclose(frequency, np.sqrt(squares[:2]) / (2.0 * np.pi), rtol=1e-10)


# ---------------------------------------------------------------- formats

# In `inputs/chain` stands one of each two entries that mirror each other, on either side.
FORMATS = {
    "npz": "{0}.npz",
    "arrays": "{0}_all.npz:{0}",
    "table": "{0}.sti",
    "symmetric market": "half_{0}.mtx",
    "abaqus": "{0}_STIF1.mtx",
    "dmig": "all.pch:{1}AAX",
}
"""Names of files, given the name of a matrix and its first four letters in capitals."""
FORMATS_WITH_NODES = ("abaqus", "dmig")
VALUES = [{}, {"e": 2.2, "z1": 0.5, "push": 3.0}]


@pytest.fixture(scope="module", params=FORMATS)
def chain_of_format(request, tmp_path_factory) -> Structure:
    """Formats that name nodes need no file of unknowns, and a term may name fewer of them."""
    folder = tmp_path_factory.mktemp("format")
    shutil.copytree(INPUTS.folder / "chain", folder, dirs_exist_ok=True)
    changes: Changes = {}
    for name, matrix in (("k", STIFFNESS), ("m", MASS), ("middle", MIDDLE_SPRING)):
        sparse.save_npz(folder / f"{name}.npz", sparse.csr_array(matrix))
        np.savez(folder / f"{name}_all.npz", other=np.eye(2), **{name: matrix})
        file = FORMATS[request.param].format(name, name[:4].upper())
        changes[f'"{name}.mtx"'] = f'"{file}"'
    if request.param in FORMATS_WITH_NODES:
        changes['unknowns = "rows.dof"'] = ""
    return assemble_structure(write_chain(folder, changes))


@pytest.mark.parametrize("values", VALUES, ids=["nominal", "changed"])
def test_every_format_is_the_same_structure(chain, chain_of_format, values):
    system = chain_of_format.system_at(values)

    for matrix, expected in zip(system, chain.system_at(values), strict=True):
        assert np.abs(matrix - expected).max() <= 1e-9 * np.abs(expected).max()


# ---------------------------------------------------------------- other ways to say the same


@pytest.fixture(scope="module")
def chain_said_otherwise(tmp_path_factory) -> Structure:
    """A whole as a sum, a term as a difference, vectors by rows or by node and component."""
    folder = tmp_path_factory.mktemp("otherwise")
    without_middle = sparse.coo_array(STIFFNESS - MIDDLE_SPRING)
    softened = sparse.coo_array(STIFFNESS - 0.75 * MIDDLE_SPRING)
    io.mmwrite(folder / "rest.mtx", without_middle)
    io.mmwrite(folder / "soft.mtx", softened)
    io.mmwrite(folder / "pump.mtx", sparse.coo_array(np.diag([0.0, 1e-3, 0.0])))
    (folder / "push.txt").write_text("0\n0\n1\n")
    (folder / "gauge.csv").write_text("4, 1, -0.05\n7, 1, 0.05\n")
    np.save(folder / "end.npy", np.array([0.0, 0.0, -1.0]))
    gauge = "nodes = [4, 7]\ndirection = [1, 0, 0]\nlength = 20"
    changes: Changes = {
        '"k.mtx"': '["rest.mtx", "middle.mtx"]',
        'matrix = "middle.mtx"': 'changed = "soft.mtx"\ntimes = 0.25',
        "node = 9\nforce = [1, 0, 0]": 'vector = "push.txt"',
        gauge: 'vector = "gauge.csv"',
        "node = 9\ndirection = [-3, 0, 0]": 'vector = "end.npy"',
        "node = 7\nmass": 'matrix = "pump.mtx"\nmass',
    }
    return assemble_structure(write_chain(folder, changes))


def test_stiffness_may_be_a_sum_and_a_term_a_difference(chain, chain_said_otherwise):
    values = {"e": 1.9, "z1": 0.3}

    stiffness = chain_said_otherwise.system_at(values).stiffness.toarray()

    expected = chain.system_at(values).stiffness.toarray()
    np.testing.assert_allclose(stiffness, expected, rtol=1e-12, atol=1e-9)


def test_a_load_may_be_a_vector(chain, chain_said_otherwise):
    push = chain_said_otherwise.load("push")

    np.testing.assert_allclose(push, chain.load("push"), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("name", ["gauge_output", "displacement_output"])
def test_outputs_may_be_vectors(chain, chain_said_otherwise, name):
    rows = getattr(chain_said_otherwise, name).toarray()

    np.testing.assert_allclose(rows, getattr(chain, name).toarray(), rtol=1e-12, atol=1e-15)


def test_a_free_mass_may_be_a_matrix(chain, chain_said_otherwise):
    mass = chain_said_otherwise.mass().toarray()

    np.testing.assert_allclose(mass, chain.mass().toarray(), rtol=1e-12, atol=1e-15)


# ---------------------------------------------------------------- supports

FREE: Changes = {"k.mtx": STIFFNESS - np.diag([200.0, 0.0, 0.0])}
"""The chain without the spring that holds it."""
HELD: Changes = FREE | {"[[mass]]": '[[support]]\nnodes = [4]\nhold = ["x"]\n[[mass]]'}
PUSHED_END = -1e-3 * (1 / 100 + 1 / 50)


def test_a_free_chain_is_refused_with_the_motion_that_is_free(make_chain):
    sentence = r"leaves free, or nearly: 1; in one node \d, component 1 moves most\. Hold"

    with refused(FiniteElementError, sentence):
        make_chain(FREE)


def test_a_support_holds_what_the_matrices_leave_free(make_chain):
    response = static_responses(make_chain(HELD))["push"]

    assert response.output == pytest.approx([PUSHED_END], rel=1e-12)


def test_a_row_of_nothing_is_left_out(make_chain):
    """As the turns of a solid in Nastran."""
    wider = {
        name: np.pad(matrix, (0, 1))
        for name, matrix in (FILES | HELD).items()
        if name.endswith("mtx")
    }

    structure = make_chain(HELD | wider | {"rows.dof": "4 1\n7,1\n 9.1\n9.4\n"})

    response = static_responses(structure)["push"]
    assert response.output == pytest.approx([PUSHED_END], rel=1e-12)


# ---------------------------------------------------------------- refusals, hash

CHANGED_TEXTS = [({old: new}, sentence) for old, new, sentence in INPUTS.refused("chain")]


@pytest.mark.parametrize(("changes", "sentence"), [*CHANGED_TEXTS, *INPUTS.refused("chains")])
def test_what_is_no_structure_is_refused_in_a_sentence(changes, sentence, make_chain):
    with refused(FiniteElementError, sentence):
        make_chain(changes)


def test_the_same_files_have_the_same_hash(chain, make_chain):
    assert make_chain().design_hash == chain.design_hash


def test_a_design_lists_its_files(tmp_path):
    assert set(load_structure(write_chain(tmp_path)).files) == set(FILES)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("k.mtx", 1.1 * STIFFNESS),
        ("m.mtx", 0.9 * MASS),
        ("middle.mtx", 0.9 * MIDDLE_SPRING),
        ("rows.dof", f"{FILES['rows.dof']} "),
    ],
)
def test_another_content_of_a_file_is_another_hash(chain, make_chain, name, content):
    assert make_chain({name: content}).design_hash != chain.design_hash


# ---------------------------------------------------------------- the same verbs for wings


def test_static_responses_of_a_wing_are_those_of_its_matrices(coarse_design):
    """`assemble` takes the design of a wing, and `static_response` values by name."""
    wing = uav_twin.assemble(coarse_design)

    response = uav_twin.static_response(wing, {"z1": 0.4, "load_factor": 3.0})

    factors = Factorisation(wing.stiffness(stiffness_loss={"z1": 0.4}))
    expected = wing.gauge_output @ factors.solve(wing.turn(3.0))
    assert response.strain == pytest.approx(expected, rel=1e-9)


def test_the_first_mode_of_a_wing_is_bending(coarse_operators):
    modes = uav_twin.natural_frequencies(coarse_operators, 4)

    first, *_ = uav_twin.flapwise_bending_modes(coarse_operators, modes)
    assert first == 0


def test_frequencies_of_a_structure_file_are_those_of_its_matrices(tmp_path):
    """`assemble` takes the path of a structure file, too."""
    chain = uav_twin.assemble(write_chain(tmp_path))

    frequency = uav_twin.natural_frequencies(chain, 2).frequency

    squares, _ = lowest_eigenpairs(chain.stiffness(), chain.mass(), 2)
    assert frequency == pytest.approx(np.sqrt(squares) / (2.0 * np.pi), rel=1e-9)
