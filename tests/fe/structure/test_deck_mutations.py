"""Decks, meshes, TOML, JSON and tables with faults, or of one long word: read or refused, never for long."""

import signal
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

from benchmarks.fuzz_mutations import TEXT
from fe.runtime.errors import DesignFileError, InvalidDesignError, MeshError
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


@pytest.fixture
def alarm() -> Iterator[None]:
    def ring(*_: object) -> None:
        raise TimeoutError(f"nothing was read or refused within {LIMIT} s")

    before = signal.signal(signal.SIGALRM, ring)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


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


def read_file(path: Path) -> None:
    if path.suffix == ".toml":
        parse_structure(parse_toml(path.read_bytes(), "s.toml", DesignFileError))
    else:
        read_mesh(path, 1.0, "m")


@pytest.mark.parametrize("count", [60, pytest.param(400, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", ["m.inp", "m.bdf", "m.msh", "m.vtu", "s.toml"])
def test_a_file_with_faults_is_read_or_refused(name: str, count: int, box, tmp_path: Path) -> None:
    """One to three faults in each, as of the other files of a user."""
    path, (points, cells) = tmp_path / name, box("tetra", (1, 1, 1))
    if name in ("m.msh", "m.vtu"):
        halves = {"gmsh:physical": [[1, 1, 1, 2, 2, 2]], "gmsh:geometrical": [[1] * 6]}
        form, tags = {"m.msh": ("gmsh22", halves), "m.vtu": ("vtu", {"part": [[1] * 6]})}[name]
        meshio.write(path, meshio.Mesh(points, [("tetra", cells)], cell_data=tags), form, binary=False)
    else:
        bracket = structure_files()["bracket"].read_text(encoding="utf-8")
        decks = {"m.inp": INPUTS.text("brick.inp"), "m.bdf": INPUTS.text("pieces.bdf"), "s.toml": bracket}
        path.write_text(decks[name], encoding="utf-8")
    good, draw, done = path.read_bytes(), np.random.default_rng(2028), []
    assert check(partial(read_file, path)), "it is read before it is changed"
    for _ in range(count):
        damaged = good
        for kind in draw.choice([*TEXT], draw.integers(1, 4)):
            damaged = TEXT[kind](damaged, draw) or b" "
        path.write_bytes(damaged)
        done.append(check(partial(read_file, path), MeshError, DesignFileError, InvalidDesignError))
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
    (tmp_path / "m.inp").write_text(INPUTS.text("tetrahedron.inp") + "\n".join(MUCH[what]))
    check(partial(read_mesh, tmp_path / "m.inp", 1.0, "m"), MeshError)


def test_a_chain_of_coordinate_systems_ends(tmp_path: Path) -> None:
    rows = [f"CORD2R,{n},{n + 1},0.,0.,0.,0.,0.,1.\n,1.,0.,0." for n in range(1, 3000)]
    (tmp_path / "m.bdf").write_text("\n".join([*rows, "GRID,1,1,0.,0.,0."]))
    with pytest.raises(MeshError, match="rests on itself, or on too many others"):
        read_mesh(tmp_path / "m.bdf", 1.0, "m")
