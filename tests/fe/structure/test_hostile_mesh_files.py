"""Mesh files that are long, deep or ask for much: they are read or refused, and nothing hangs."""

import signal
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from fe.runtime.errors import DesignFileError, InvalidDesignError, MeshError
from fe.structure.mesh_file import read_mesh
from reporting.formats.table_file import TableErrors, parse_table
from reporting.formats.toml_file import parse_toml
from reporting.json_file import parse_json
from tests.refusals import Inputs, refused

INPUTS = Inputs(__file__)


def check(read: Callable[[], Any], *expected: type[Exception]) -> bool:
    """Whether something was read; what is refused is one sentence."""
    signal.alarm(600)  # seconds; who hangs is ended with the process
    try:
        read()
    except expected as error:
        sentence = str(error)
        assert "\n" not in sentence
        assert len(sentence) < 2000
        return False
    finally:
        signal.alarm(0)
    return True


LONG = 300_000
HOSTILE = {f"many {mark}": mark * LONG for mark in 'a1,"['} | {
    "a dotted key": "a" + ".a" * (LONG // 2) + " = 1",
    "words with dots": ("a" * 20 + " . ") * (LONG // 23),
    "a key in quotes": '"a".' * (LONG // 4),
    "texts that stay open": '"""\\' * (LONG // 4),
    "keys below the limit": "\n".join("a.a.a.a.a." * 3 + f"k{n} = 1" for n in range(LONG // 40)),
    "an object": "{" + ", ".join(f'"k{n}": 1' for n in [*range(60_000), 59_999]) + "}",
    "many keys": "\n".join(f"k{n} = {n}" for n in range(LONG // 15)),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_a_long_text_is_read_or_refused(what, tmp_path):
    """None of these takes a time that grows with the square of its length."""
    errors = TableErrors(DesignFileError, InvalidDesignError)
    for parse, last in (
        (parse_toml, DesignFileError),
        (parse_json, DesignFileError),
        (parse_table, errors),
    ):
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
    "large faces": [
        "*ELSET, ELSET=E, GENERATE",
        *["1, 1"] * 50_000,
        "*SURFACE, NAME=T",
        *["E, S1"] * 10_000,
    ],
    "faces": ["*SURFACE, NAME=T"] + ["E, S1"] * 20_000,
    "words": [f"*UNKNOWN{n}" for n in range(20_000)],
}


@pytest.mark.parametrize("what", MUCH)
def test_short_lines_that_ask_for_much_are_read_or_refused(what, tmp_path):
    (tmp_path / "m.inp").write_text(INPUTS.text("tetrahedron.inp") + "\n".join(MUCH[what]))
    check(partial(read_mesh, tmp_path / "m.inp", 1.0, "m"), MeshError)


def test_a_chain_of_coordinate_systems_ends(tmp_path):
    rows = [f"CORD2R,{n},{n + 1},0.,0.,0.,0.,0.,1.\n,1.,0.,0." for n in range(1, 3000)]
    (tmp_path / "m.bdf").write_text("\n".join([*rows, "GRID,1,1,0.,0.,0."]))
    with refused(MeshError, "refers to itself, or to a chain of more than 50 others"):
        read_mesh(tmp_path / "m.bdf", 1.0, "m")
