"""Decks of Abaqus and Nastran: sets, words, continuations, systems of coordinates."""

import re
from dataclasses import dataclass

import numpy as np
import pytest

from fe.runtime.errors import MeshError
from fe.structure.deck_text import words_of
from fe.structure.nastran import cards
from tests.fe.structure.mesh_texts import (
    ABAQUS_TETRAHEDRON,
    AXES,
    CUBES,
    NASTRAN_TETRAHEDRON,
    ORIGIN,
    assert_mesh_refused,
    card_of,
    coordinates_in_turned_system,
    read_lines,
    volume_of,
)
from tests.meshes import box
from tests.refusals import Inputs, refused

INPUTS = Inputs(__file__)


@dataclass(frozen=True)
class Dialect:
    """A tetrahedron in a dialect of decks, and how a deck includes another."""

    file_name: str
    lines: list[str]
    include: str
    included_lines: int


DIALECTS = {
    "abaqus": Dialect("m.inp", ABAQUS_TETRAHEDRON, "*INCLUDE, INPUT=", 5),
    "nastran": Dialect("m.bdf", NASTRAN_TETRAHEDRON, "BEGIN BULK\ninclude ", 4),
}

# ---------------------------------------------------------------- sets of Abaqus


@pytest.fixture(scope="module")
def cubes(tmp_path_factory):
    """Two cubes with sets, and a surface of two faces of the first."""
    path = tmp_path_factory.mktemp("deck") / "m.inp"
    return read_lines(path, CUBES, "*SURFACE, NAME=sides", "10, S3", "10, S5")


def test_elements_of_a_deck_keep_their_numbers(cubes):
    assert cubes.cell_numbers.tolist() == [10, 20]


@pytest.mark.parametrize(("name", "cells"), [("BODY", [0, 1]), ("left", [0])])
def test_sets_of_elements_are_read(cubes, name, cells):
    assert cubes.cells_of(name, "here").tolist() == cells


@pytest.mark.parametrize(
    ("name", "numbers"),
    [("root", [1, 4, 11, 14]), ("both", [1, 3, 4, 11, 14]), ("end", [3, 6, 13, 16])],
)
def test_sets_of_nodes_are_read(cubes, name, numbers):
    assert cubes.node_numbers[cubes.nodes_of(name, "here")].tolist() == numbers


def test_surfaces_are_read_as_faces_of_cells(cubes):
    top = cubes.faces_of("top", "here")

    assert top.cell.tolist() == [0, 1]
    assert top.face.tolist() == [1, 1]


def test_a_surface_has_nodes_and_a_set_of_nodes_has_faces(cubes):
    assert len(cubes.nodes_of("TOP", "here")) == 6
    assert len(cubes.faces_of("END", "here")) == 1


def test_a_surface_keeps_its_faces_if_its_nodes_are_those_of_all_faces(cubes):
    assert len(cubes.faces_of("sides", "here")) == 2


def test_nodes_that_touch_no_cell_are_known(cubes):
    assert cubes.loose.tolist() == [99]


def test_a_set_with_a_node_that_touches_no_cell_is_refused(cubes):
    sentence = r"1 of the nodes of the set 'Nall' .* touch no cell"

    with pytest.raises(MeshError, match=sentence):
        cubes.nodes_of("Nall", "support[1]")


# ---------------------------------------------------------------- words of both dialects


@pytest.mark.parametrize(
    ("name", "old", "new", "sentence"),
    [
        (name, *row)
        for name in ("cubes.inp", "tetrahedron.bdf")
        for row in INPUTS.refused(name.split(".")[0])
    ],
)
def test_a_fault_of_a_deck_is_said_with_its_line(name, old, new, sentence, tmp_path):
    path = tmp_path / f"m.{name[-3:]}"
    path.write_text(INPUTS.text(name, (old, new)))

    assert_mesh_refused(path, sentence)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_each_word_of_a_dialect_has_one_meaning(dialect):
    words = words_of(dialect)

    assert not words.harmless & words.refused.keys()
    assert not words.read.keys() & (words.harmless | words.refused.keys())


@pytest.mark.parametrize("dialect", DIALECTS)
def test_an_unknown_word_is_remarked_on_and_a_harmless_one_is_not(dialect, tmp_path):
    words = words_of(dialect)
    deck = DIALECTS[dialect]
    harmless = [f"{words.mark}{word}" for word in sorted(words.harmless)]

    mesh = read_lines(tmp_path / deck.file_name, *deck.lines, *harmless, f"{words.mark}NEWWORD")

    (remark,) = mesh.remarks
    line = len(deck.lines) + len(harmless) + 1
    assert f"line {line}: {words.mark}NEWWORD is not known and was passed" in remark


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_word_that_must_not_be_lost_is_refused_with_what_to_do(dialect, tmp_path):
    words = words_of(dialect)
    deck = DIALECTS[dialect]

    for word in sorted(words.refused):
        place = re.escape(f"{deck.file_name}, line {len(deck.lines) + 1}: {words.mark}{word} ")
        with refused(MeshError, f"{place}.*; "):
            read_lines(
                tmp_path / deck.file_name, *deck.lines, f"{words.mark}{word.lower()}, 1", "1, 2, 3"
            )


# ---------------------------------------------------------------- decks that include others


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_deck_includes_another(dialect, tmp_path):
    deck = DIALECTS[dialect]
    included = deck.lines[: deck.included_lines]
    (tmp_path / f"part{deck.file_name}").write_text("\n".join(included))

    mesh = read_lines(
        tmp_path / deck.file_name,
        f"{deck.include}part{deck.file_name}",
        *deck.lines[deck.included_lines :],
    )

    assert volume_of(mesh) == pytest.approx(1.0 / 6.0)


def test_a_deck_that_includes_itself_is_refused(tmp_path):
    include_itself = f"*INCLUDE, INPUT=../{tmp_path.name}/m.inp"

    with pytest.raises(MeshError, match=r"m\.inp, line 1: .*m\.inp includes itself"):
        read_lines(tmp_path / "m.inp", *[include_itself] * 100, *ABAQUS_TETRAHEDRON)


@pytest.mark.parametrize("type_name", ["C3D20RH", "C3D20H"])
def test_a_hybrid_element_is_built_without_pressure(tmp_path, type_name):
    """C3D20RH is integrated as C3D20R, unless meshio wrote it for C3D20."""
    mesh = read_lines(tmp_path / "m.inp", *cube_of(type_name))
    plain = read_lines(tmp_path / "plain.inp", *cube_of(type_name.removesuffix("H")))
    assert mesh.kind == plain.kind
    assert mesh.remarks[0].endswith(f"are built as {type_name.removesuffix('H')}.")


def test_hexahedra_of_meshio_are_plain(tmp_path):
    heading = ("*HEADING", "Abaqus DataFile Format", "written by meshio v5.3.5")
    mesh = read_lines(tmp_path / "m.inp", *heading, *cube_of("C3D20RH"))
    plain = read_lines(tmp_path / "plain.inp", *cube_of("C3D20"))
    assert mesh.kind == plain.kind


def cube_of(type_name: str) -> list[str]:
    """Return the lines of a deck with one hexahedron of 20 nodes."""
    points, cells = box("hexahedron20", (1, 1, 1))
    nodes = [
        f"{number}, {x}, {y}, {z}" for number, (x, y, z) in enumerate(points.tolist(), start=1)
    ]
    numbers = [str(index + 1) for index in cells[0].tolist()]
    element = [f"1, {', '.join(numbers[:10])},", ", ".join(numbers[10:])]
    return ["*NODE", *nodes, f"*ELEMENT, TYPE={type_name}", *element]


# ---------------------------------------------------------------- includes and replicas of Nastran


def test_the_name_of_an_included_file_goes_on_over_lines(tmp_path):
    folder = tmp_path / "a_long_name_of_a_folder"
    folder.mkdir()
    (folder / "nodes.bdf").write_text("\n".join(NASTRAN_TETRAHEDRON[:4]))
    include = ("BEGIN BULK", "INCLUDE 'a_long_name", "  _of_a_folder/", "nodes.bdf'")
    mesh = read_lines(tmp_path / "m.bdf", *include, *NASTRAN_TETRAHEDRON[4:])
    assert volume_of(mesh) == pytest.approx(1.0 / 6.0)


def test_an_open_quotation_mark_is_refused(tmp_path):
    lines = ("BEGIN BULK", "INCLUDE 'nodes.bdf", *NASTRAN_TETRAHEDRON)
    with pytest.raises(MeshError, match=r"m\.bdf: the quotation mark in .* does not close"):
        read_lines(tmp_path / "m.bdf", *lines)


def test_fields_are_replicated_with_increments(tmp_path):
    """Four cubes in a row: nodes and elements are repeated with `=`, `*(i)`, `==` and `=n`."""
    lines = ["BEGIN BULK"]
    for corner, (y, z) in enumerate([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]):
        lines += [f"GRID,{corner + 1},,0.,{y},{z}", "=,*(4),=,*(1.),==", "=(3)"]
    lines += ["CHEXA,1,1,1,2,3,4,5,6,", "+,7,8"]
    for element in range(1, 4):
        numbers = [str(4 * element + corner) for corner in range(1, 9)]
        lines += [f"CHEXA,{element + 1},1,{','.join(numbers[:6])},", f"+,{','.join(numbers[6:])}"]
    mesh = read_lines(tmp_path / "m.bdf", *lines)
    assert len(mesh.points) == 20
    assert volume_of(mesh) == pytest.approx(4.0)


def test_replicas_in_columns_are_read(tmp_path):
    """A tetrahedron whose node on z repeats the node at the origin."""
    lines = ["BEGIN BULK", "GRID    1               0.      0.      0."]
    lines += ["=       *1      =       =       =       *1.", "GRID,3,,1.,0.,0.", "GRID,4,,0.,1.,0."]
    mesh = read_lines(tmp_path / "m.bdf", *lines, "CTETRA,1,1,1,3,4,2")
    assert volume_of(mesh) == pytest.approx(1.0 / 6.0)


@pytest.mark.parametrize("lines", [["=,*1,=="], ["GRID,1,,0.,0.,0.", "=3"]])
def test_a_replica_of_nothing_is_refused(tmp_path, lines):
    with pytest.raises(MeshError, match="repeats a line above, but none is there"):
        read_lines(tmp_path / "m.bdf", "BEGIN BULK", *lines)


# ---------------------------------------------------------------- systems of Nastran

SHIFT = np.array([5.0, 6.0, 7.0])
"""The origin of the system that the turned system stands on."""
HEXAHEDRON_ORDER = [*range(12), *range(16, 20), *range(12, 16)]
"""Nastran has the middles of upright edges before those of the upper face."""


def three_points_of_system():
    """Return the points that define the turned system, in a system whose x is the y of space."""
    points = [ORIGIN, ORIGIN + 2.0 * AXES[2], ORIGIN + 3.0 * AXES[0] - AXES[2]]
    return [np.roll(point - SHIFT, -1).tolist() for point in points]


def system_by_grid_points(kind):
    return [f"CORD1{kind}       4     900     901     902"]


def system_by_coordinates(kind):
    origin, on_axis, in_plane = three_points_of_system()
    return [card_of(f"CORD2{kind}", 4, 9, *origin, *on_axis, "\n", *in_plane)]


def cards_of_hexahedra(cells):
    lines = []
    for number, cell in enumerate(cells[:, HEXAHEDRON_ORDER] + 1, start=1):
        lines.append(card_of("CHEXA", number, 7, *cell[:6], "+"))
        lines.append(card_of("+", *cell[6:14], ""))
        lines.append(card_of("", *cell[14:]))
    return lines


@pytest.mark.parametrize("kind", ["R", "C", "S"])
@pytest.mark.parametrize("define_system", [system_by_grid_points, system_by_coordinates])
def test_grid_points_of_any_coordinate_system(kind, define_system, tmp_path):
    """The system stands on another one that is shifted and turned; its points come before it."""
    points, cells = box("hexahedron20", (2, 1, 1))
    turned = coordinates_in_turned_system(points, kind)
    lines = [card_of("GRID", n, 4, *row.tolist()) for n, row in enumerate(turned, start=1)]
    lines.append(card_of("CORD2R", 9, 0, *SHIFT.tolist(), 6.0, 6.0, 7.0, "+"))
    lines.append(card_of("+", 5.0, 7.0, 7.0))
    for number, point in enumerate(three_points_of_system(), start=900):
        lines.append(card_of("GRID", number, "", *point))
    lines.append("GRDSET,,9")
    lines += define_system(kind)
    lines += cards_of_hexahedra(cells)

    mesh = read_lines(tmp_path / "m.bdf", "SOL 101", "BEGIN BULK", *lines, "ENDDATA", "nonsense")

    np.testing.assert_allclose(mesh.nodes, points[cells], atol=1e-10)
    assert volume_of(mesh) == pytest.approx(1.0)
    assert (len(mesh.cells_of("nastran:ref=7", "here")), mesh.remarks) == (2, ())


# ---------------------------------------------------------------- continuations of Nastran


def read_cards(path, *lines):
    path.write_text("\n".join(lines))
    return cards(path)


def filled_fields(card):
    return [field for field in card.fields if field]


@pytest.mark.parametrize("marker", ["+A", "+a"])
def test_a_continuation_of_nastran_goes_to_the_line_with_its_marker(marker, tmp_path):
    """Other lines may stand between, and the case of a marker does not count."""
    hexahedron, point = read_cards(
        tmp_path / "m.bdf",
        f"CHEXA          1       1       1       2       3       4       5       6{marker}",
        "GRID           1              0.      0.      0.",
        "+A             7       8",
    )

    assert hexahedron.fields[2:10] == list("12345678")
    assert point.fields[2:5] == ["0."] * 3
    assert not any(point.fields[5:])


CHAIN = [
    "+B            15      16      17      18      19      20",
    "+A             7       8       9      10      11      12      13      14+B",
    "CHEXA          1       1       1       2       3       4       5       6+A",
]
"""A hexahedron whose two continuations stand before it, the last one first."""
POINT = "GRID           1              0.      0.      0."


def test_a_chain_of_continuations_of_nastran_may_stand_before_its_line(tmp_path):
    point, hexahedron = read_cards(tmp_path / "m.bdf", f"{POINT:72}", *CHAIN)

    nodes = [str(number) for number in range(1, 21)]
    assert [field for field in hexahedron.fields[2:] if field] == nodes
    assert filled_fields(point) == ["1", "0.", "0.", "0."]


def test_continuations_of_nastran_may_stand_behind_a_line_that_goes_on(tmp_path):
    point, hexahedron = read_cards(tmp_path / "m.bdf", f"{POINT:72}+C", *CHAIN, "+C             5")

    nodes = [str(number) for number in range(1, 21)]
    assert [field for field in hexahedron.fields[2:] if field] == nodes
    assert filled_fields(point) == ["1", "0.", "0.", "0.", "5"]


def test_a_continuation_of_nastran_that_continues_nothing_is_refused(tmp_path):
    sentence = r"line 2: the continuation '\+B' follows no line that it could continue"

    with refused(MeshError, sentence):
        read_cards(tmp_path / "m.bdf", "GRID,1,,0.,0.,0.,,,+A", "+B,7,8", "GRID,2,,0.,0.,1.")


# ---------------------------------------------------------------- fields of Nastran

FIELDS = INPUTS.text("fields.bdf").splitlines()


@pytest.fixture(scope="module")
def bulk_data(tmp_path_factory):
    """Bulk data alone, as Gmsh writes it."""
    return read_lines(tmp_path_factory.mktemp("deck") / "m.bdf", *FIELDS)


def test_fields_of_nastran_have_several_forms(bulk_data):
    """Exponents without E, fields of 8 and 16, lines that go on by a comma, marker or blank."""
    corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]

    np.testing.assert_array_equal(bulk_data.nodes[0], corners)


def test_the_property_of_an_element_is_its_set(bulk_data):
    assert len(bulk_data.cells_of("nastran:ref=8", "here")) == 1


def test_an_unknown_card_is_remarked_on_once(bulk_data):
    (remark,) = bulk_data.remarks

    assert "m.bdf, line 8: RWHAT (2 times) is not known and was passed over" in remark


def test_a_whole_deck_is_read_as_its_bulk_data(bulk_data, tmp_path):
    whole = read_lines(tmp_path / "w.bdf", "SOL 101", "CEND", "BEGIN BULK", *FIELDS, "ENDDATA")

    np.testing.assert_array_equal(whole.nodes, bulk_data.nodes)


# ---------------------------------------------------------------- systems of Abaqus


@pytest.mark.parametrize("kind", ["R", "C"])
def test_nodes_of_abaqus_in_a_system_of_their_own(kind, tmp_path):
    points, cells = box("tetra10", (1, 1, 1))
    on_x = ORIGIN + 2.0 * AXES[0]
    near_y = ORIGIN + AXES[1] + AXES[0]
    turned = coordinates_in_turned_system(points, kind)
    lines = ["*SYSTEM", card_of(*ORIGIN.tolist(), *on_x.tolist()), card_of(*near_y.tolist())]
    lines.append(f"*NODE, NSET=A,\n SYSTEM={kind}")
    lines += [card_of(number, *row.tolist()) for number, row in enumerate(turned, start=1)]
    lines += ["*SYSTEM", "*NODE", "99, 1, 2, 3", "*ELEMENT, TYPE=C3D10, ELSET=E"]
    lines += [card_of(number, *cell.tolist()) for number, cell in enumerate(cells + 1, start=1)]

    mesh = read_lines(tmp_path / "m.inp", *lines)

    np.testing.assert_allclose(mesh.nodes, points[cells], atol=1e-10)
    assert len(mesh.nodes_of("a", "here")) == len(points)
    assert mesh.loose.tolist() == [99]


def test_a_system_of_abaqus_with_an_origin_alone_is_shifted(tmp_path):
    mesh = read_lines(tmp_path / "m.inp", "*SYSTEM", "1, 2, 3", *ABAQUS_TETRAHEDRON)

    np.testing.assert_allclose(mesh.nodes[0, 0], (1.0, 2.0, 3.0))


def test_a_system_of_abaqus_with_a_point_on_x_is_turned_about_z(tmp_path):
    """The height of the point is left out."""
    mesh = read_lines(tmp_path / "m.inp", "*SYSTEM", ",, 0, , 3, 4,", *ABAQUS_TETRAHEDRON)

    turned = [[0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 0, 1]]
    np.testing.assert_allclose(mesh.nodes[0], turned, atol=1e-15)
