"""Decks, meshes, TOML, JSON and tables with faults, or of one long word: read or refused, never for long."""

import signal
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from random import Random
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
from tests.refusals import Inputs

pytestmark = pytest.mark.usefixtures("alarm")

INPUTS = Inputs(__file__)
LIMIT = 60
"""Seconds after which a reader hangs; every file here is read in hundredths of one."""
WORDS = (*words_of("abaqus").refused, *words_of("nastran").refused)
PIECES = (
    *"*,+=.$#-\n\t \"'[]{}", "0", "-1", "1e999", "nan", "99999999999999999999", "1.5-3", "7" * 5000, "\0",
    "é",     "*NODE", "GENERATE", "ELSET=BODY", "1, 99999999", "a.a.a", "GRID", "=", '"""', "[[load]]",
)  # fmt: skip


@pytest.fixture
def alarm() -> Iterator[None]:
    def ring(*_: object) -> None:
        raise TimeoutError(f"nothing was read or refused within {LIMIT} s")

    before = signal.signal(signal.SIGALRM, ring)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def mutations(text: str, count: int, seed: int) -> Iterator[str]:
    """One to three faults in each: a piece lost, put in or doubled, lines moved, the end cut off."""
    random = Random(seed)
    for _ in range(count):
        found = text
        for _ in range(random.choice((1, 1, 1, 2, 3))):
            start = random.randrange(len(found) + 1)
            end = min(len(found), start + random.choice((0, 0, 0, 1, 1, 2, 10)))
            piece = random.choice((*PIECES, *WORDS, found[start:end] * 2, ""))
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


def read_structure(path: Path) -> None:
    parse_structure(parse_toml(path.read_bytes(), "s.toml", DesignFileError))


@pytest.mark.parametrize("count", [40, pytest.param(300, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", ["m.inp", "m.bdf", "m.msh", "m.vtu", "s.toml"])
def test_a_file_with_faults_is_read_or_refused(name: str, count: int, box, tmp_path: Path) -> None:
    path, (points, cells) = tmp_path / name, box("tetra", (1, 1, 1))
    tags = {"gmsh:physical": [[1, 1, 1, 2, 2, 2]], "gmsh:geometrical": [[1] * 6]}
    mesh = meshio.Mesh(points, [("tetra", cells)], cell_data=tags if name == "m.msh" else {"part": [[1] * 6]})
    if name in ("m.msh", "m.vtu"):
        mesh.write(path, **({"file_format": "gmsh22"} if name == "m.msh" else {}), binary=False)
        text = path.read_text()
    elif name == "s.toml":
        text = structure_files()["bracket"].read_text()
    else:
        text = INPUTS.text({"m.inp": "brick.inp", "m.bdf": "pieces.bdf"}[name])
    read, faults = partial(read_mesh, path, 1.0, "m"), (MeshError,)
    if name == "s.toml":
        read, faults = partial(read_structure, path), (DesignFileError, InvalidDesignError)
    path.write_text(text, encoding="utf-8")
    assert check(read), "it is read before it is changed"
    done = []
    for mutated in mutations(text, count, seed=2028):
        path.write_text(mutated, encoding="utf-8", newline="")
        done.append(check(read, *faults))
    assert 1 < sum(done) < count - 1, "the faults are too small, or too large, to find anything"


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
def test_a_long_text_is_read_or_refused(what: str, tmp_path: Path) -> None:
    """None of these takes a time that grows with the square of its length."""
    errors = TableErrors(DesignFileError, InvalidDesignError)
    for parse, last in ((parse_toml, DesignFileError), (parse_json, DesignFileError), (parse_table, errors)):
        check(partial(parse, HOSTILE[what], "f", last), DesignFileError)
    for path in (tmp_path / "m.inp", tmp_path / "m.bdf"):
        for before in ("", "*NODE\n", "*ELEMENT, TYPE=C3D8\n", "GRID,"):
            path.write_text(before + HOSTILE[what])
            assert not check(partial(read_mesh, path, 1.0, "m"), MeshError)


MUCH = {
    "sets of sets": [f"*NSET, NSET=S{n}\nS{n + 1}, 1" for n in range(20_000)],
    "sets that grow": ["*NSET, NSET=A, GENERATE\n1, 9, 2"]
    + [f"*NSET, NSET=B{n}\n" + f"B{n - 1}, " * 50 for n in range(30)],
    "blocks": [f"*NODE, NSET=S\n{n}, 0, 0, 0" for n in range(20_000)],
    "large faces": ["*ELSET, ELSET=E, GENERATE", *["1, 1"] * 50_000, "*SURFACE, NAME=T", *["E, S1"] * 10_000],
    "faces": ["*SURFACE, NAME=T"] + ["E, S1"] * 20_000,
    "words": [f"*UNKNOWN{n}" for n in range(20_000)],
}


@pytest.mark.parametrize("what", MUCH)
def test_short_lines_that_ask_for_much_are_read_or_refused(what: str, tmp_path: Path) -> None:
    solid = (
        "*NODE\n1, 0, 0, 0\n2, 1, 0, 0\n3, 0, 1, 0\n4, 0, 0, 1\n*ELEMENT, TYPE=C3D4, ELSET=E\n1, 1, 2, 3, 4"
    )
    (tmp_path / "m.inp").write_text("\n".join((solid, *MUCH[what])))
    check(partial(read_mesh, tmp_path / "m.inp", 1.0, "m"), MeshError)


def test_a_chain_of_coordinate_systems_ends(tmp_path: Path) -> None:
    rows = [f"CORD2R,{n},{n + 1},0.,0.,0.,0.,0.,1.\n,1.,0.,0." for n in range(1, 3000)]
    (tmp_path / "m.bdf").write_text("\n".join([*rows, "GRID,1,1,0.,0.,0."]))
    with pytest.raises(MeshError, match="rests on itself, or on too many others"):
        read_mesh(tmp_path / "m.bdf", 1.0, "m")
