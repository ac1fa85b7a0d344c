"""Decks, meshes, TOML, JSON and tables with faults, or of one long word: read or refused, never for long."""

from __future__ import annotations

import itertools
import signal
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from random import Random
from types import FrameType
from typing import Any

import meshio
import pytest

from fe.runtime.errors import DesignFileError, InvalidDesignError, MeshError
from fe.structure.deck import words_of
from fe.structure.design import parse_structure
from fe.structure.mesh_file import read_mesh
from reporting.json_file import parse_json
from reporting.table_file import TableErrors, parse_table
from reporting.toml_file import parse_toml
from scenarios import structure_files

LIMIT = 60
"""Seconds after which a reader hangs; every file here is read in hundredths of one."""
ABAQUS = """*HEADING
a brick
*SYSTEM
0, 0, 0, 1, 0, 0
0, 1, 0
*NODE, NSET=FLOOR, SYSTEM=C
1, 1, 0, 0
2, 2, 0, 0
11, 1, 90, 0
12, 2, 90, 0
*SYSTEM
*NODE
101, 1, 0, 1
102, 2, 0, 1
111, 0, 1, 1
112, 0, 2, 1
*ELEMENT, TYPE=C3D8, ELSET=BODY
1, 1, 2, 12, 11,
101, 102, 112, 111
*NSET, NSET=ROOT, GENERATE
1, 11, 10
*NSET, NSET=BOTH
ROOT, 2
*SURFACE, NAME=TOP
BODY, S2
*SOLID SECTION, ELSET=BODY, MATERIAL=M
*STEP
*STATIC
*END STEP
"""
NASTRAN = """SOL 101
BEGIN BULK
CORD2C         3       0      0.      0.      0.      0.      0.      1.+A
+A            1.      0.      0.
GRID           1       3      1.      0.      0.
GRID           2       3      1.     90.      0.
GRID,3,,-1.,0.,0.
GRID*                  4                              0.              0.*B
*B                    2.
CORD1R,7,1,2,4
PSOLID,1,1
CTETRA,9,1,1,2,3,
,4
CTRIA3,10,2,1,2,3
ENDDATA
"""
PIECES = (
    *"*,+=.$#-\n\t \"'[]{}", "0", "-1", "1e999", "nan", "99999999999999999999", "1.5-3", "7" * 5000, "\0",
    "é",     "*NODE", "GENERATE", "ELSET=BODY", "1, 99999999", "a.a.a", "GRID", "=", '"""', "[[load]]",
)  # fmt: skip


@pytest.fixture
def alarm() -> Iterator[None]:
    def ring(number: int, frame: FrameType | None) -> None:
        raise TimeoutError(f"nothing was read or refused within {LIMIT} s")

    before = signal.signal(signal.SIGALRM, ring)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def mutations(text: str, count: int, extra: tuple[str, ...], seed: int) -> Iterator[str]:
    """One to three faults in each: a piece lost, put in or doubled, lines moved, the end cut off."""
    random = Random(seed)
    for _ in range(count):
        found = text
        for _ in range(random.choice((1, 1, 1, 2, 3))):
            start = random.randrange(len(found) + 1)
            end = min(len(found), start + random.choice((0, 0, 0, 1, 1, 2, 10)))
            piece = random.choice((*PIECES, *extra, found[start:end] * 2, ""))
            found = found[:start] + (piece if random.random() < 0.9 else "") + found[end:]
            if random.random() < 0.1:
                lines = found.split("\n")
                random.shuffle(lines)
                found = "\n".join(lines)
            if random.random() < 0.05:
                found = found[: random.randrange(len(found) + 1)]
        yield found


def check(read: Callable[[], Any], *expected: type[Exception]) -> bool:
    """Whether something was read; what is refused is one sentence."""
    signal.alarm(LIMIT)
    try:
        read()
    except expected as refused:
        sentence = str(refused)
        assert "\n" not in sentence
        assert len(sentence) < 2000
        return False
    return True


@pytest.mark.parametrize("count", [40, pytest.param(300, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", ["m.inp", "m.bdf", "m.msh", "m.vtu", "s.toml"])
@pytest.mark.usefixtures("alarm")
def test_a_file_with_faults_is_read_or_refused(
    name: str, count: int, box: Callable[..., Any], tmp_path: Path
) -> None:
    path = tmp_path / name
    texts: dict[str, str] = {"m.inp": ABAQUS, "m.bdf": NASTRAN}
    points, cells = box("tetra", (1, 1, 1))
    tags = {"gmsh:physical": [[1, 1, 1, 2, 2, 2]], "gmsh:geometrical": [[1] * 6]}
    mesh = meshio.Mesh(points, [("tetra", cells)], cell_data=tags if name == "m.msh" else {"part": [[1] * 6]})
    if name == "m.msh":
        meshio.write(path, mesh, file_format="gmsh22", binary=False)
    elif name == "m.vtu":
        mesh.write(path, binary=False)
    elif name == "s.toml":
        path.write_text(structure_files()["bracket"].read_text())
    text = texts.get(name) or path.read_text()
    words = (*words_of("abaqus").refused, *words_of("nastran").refused)
    read = refused = 0
    for mutated in mutations(text, count, words, seed=2028):
        path.write_text(mutated, encoding="utf-8", newline="")
        if name == "s.toml":
            done = check(
                lambda: parse_structure(parse_toml(path.read_bytes(), "s.toml", DesignFileError)),
                DesignFileError,
                InvalidDesignError,
            )
        else:
            done = check(lambda: read_mesh(path, 1.0, "m"), MeshError)
        read, refused = read + done, refused + (not done)
    assert min(read, refused) > 1, "the faults are too small, or too large, to find anything"


LONG = 300_000
HOSTILE = {
    "a word": "a" * LONG,
    "digits": "1" * LONG,
    "commas": "," * LONG,
    "quotes": '"' * LONG,
    "brackets": "[" * LONG,
    "a dotted key": "a" + ".a" * (LONG // 2) + " = 1",
    "words with dots": ("a" * 20 + " . ") * (LONG // 23),
    "a key in quotes": '"a".' * (LONG // 4),
    "texts that stay open": '"""\\' * (LONG // 4),
    "keys below the limit": "\n".join("a.a.a.a.a." * 3 + f"k{n} = 1" for n in range(LONG // 40)),
    "an object": "{" + ", ".join(f'"k{n}": 1' for n in [*range(60_000), 59_999]) + "}",
    "many keys": "\n".join(f"k{n} = {n}" for n in range(LONG // 15)),
}


@pytest.mark.parametrize("what", HOSTILE)
@pytest.mark.usefixtures("alarm")
def test_a_long_text_is_read_or_refused(what: str, tmp_path: Path) -> None:
    """None of these takes a time that grows with the square of its length."""
    check(lambda: parse_toml(HOSTILE[what], "f", DesignFileError), DesignFileError)
    check(lambda: parse_json(HOSTILE[what], "f", DesignFileError), DesignFileError)
    errors = TableErrors(DesignFileError, InvalidDesignError)
    check(lambda: parse_table(HOSTILE[what], "f", errors), DesignFileError)
    for name, before in itertools.product(
        ("m.inp", "m.bdf"), ("", "*NODE\n", "*ELEMENT, TYPE=C3D8\n", "GRID,")
    ):
        path = tmp_path / name
        path.write_text(before + HOSTILE[what])
        assert not check(partial(read_mesh, path, 1.0, "m"), MeshError)


@pytest.mark.parametrize(
    "rows",
    [
        [f"*NSET, NSET=S{n}\nS{n + 1}, 1" for n in range(20_000)],
        ["*NSET, NSET=A, GENERATE\n1, 9, 2"]
        + [f"*NSET, NSET=B{n}\n" + f"B{n - 1}, " * 50 for n in range(30)],
        [f"*NODE, NSET=S\n{n}, 0, 0, 0" for n in range(20_000)],
        ["*ELSET, ELSET=E, GENERATE", *["1, 1"] * 50_000, "*SURFACE, NAME=T", *["E, S1"] * 10_000],
        ["*SURFACE, NAME=T"] + ["E, S1"] * 20_000,
        [f"*UNKNOWN{n}" for n in range(20_000)],
    ],
    ids=["sets of sets", "sets that grow", "blocks", "large faces", "faces", "words"],
)
@pytest.mark.usefixtures("alarm")
def test_short_lines_that_ask_for_much_are_read_or_refused(rows: list[str], tmp_path: Path) -> None:
    solid = ["*NODE", "1, 0, 0, 0", "2, 1, 0, 0", "3, 0, 1, 0", "4, 0, 0, 1", "*ELEMENT, TYPE=C3D4, ELSET=E"]
    (tmp_path / "m.inp").write_text("\n".join((*solid, "1, 1, 2, 3, 4", *rows)))
    check(lambda: read_mesh(tmp_path / "m.inp", 1.0, "m"), MeshError)


def test_a_chain_of_coordinate_systems_ends(tmp_path: Path) -> None:
    rows = [f"CORD2R,{n},{n + 1},0.,0.,0.,0.,0.,1.\n,1.,0.,0." for n in range(1, 3000)]
    (tmp_path / "m.bdf").write_text("\n".join([*rows, "GRID,1,1,0.,0.,0."]))
    with pytest.raises(MeshError, match="rests on itself, or on too many others"):
        read_mesh(tmp_path / "m.bdf", 1.0, "m")


def test_the_decks_are_read_before_they_are_changed(tmp_path: Path) -> None:
    for name, text in {"m.inp": ABAQUS, "m.bdf": NASTRAN}.items():
        (tmp_path / name).write_text(text)
        assert len(read_mesh(tmp_path / name, 1.0, "m").cells) == 1
