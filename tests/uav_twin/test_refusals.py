"""What commands refuse (`inputs/refused.toml`: a sentence, an exit code, nothing written) and say."""

import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from scenarios import structure_files
from tests.command_line import refused, said
from tests.refusals import Inputs
from tests.twin_master.runs import text_of
from tests.uav_twin.test_discrepancy import TWO

INPUTS = Inputs(__file__)
RIG = "--model single_mass_rig"
ROWS = [row for name in INPUTS.table("refused.toml") for row in INPUTS.refused(name)]
ROWS += [(f"{line} --in-process", *rest) for line, *rest in INPUTS.refused("structural")]
TOLD = INPUTS.table("told.toml")["rows"]


@pytest.fixture(scope="module")
def folder(
    tmp_path_factory: pytest.TempPathFactory, foreign_fmu: Callable[..., Path], library_file: Path
) -> Path:
    """The files that the table names."""
    place = tmp_path_factory.mktemp("refused")
    for name in ("filled", "none", "lab/step1", "pairs/step2"):
        (place / name).mkdir(parents=True)
    library = f'[asset]\nkind = "strain_library"\nfile = "{library_file}"\n\n[belief]\nkind = "asset"\n\n'
    text = text_of("level_turns")
    flown = text[text.index("[asset]") : text.index("[calibration]")]
    for name, content in {
        "a file": "x", "filled/mine.txt": "mine", "pairs/step2/pairs.csv": "x", "broken.toml": "format = 3",
        "bad.ssp": "nothing", "bar.inp": INPUTS.text("bar.inp"), "bar.toml": INPUTS.text("bar.toml"),
        "library.toml": text.replace(flown, library), "pull.csv": TWO["pull.csv"].decode(),
        "filled/pull.csv": TWO["pull.csv"].decode(),
        "run.nc": "", "misspelt.csv": "turn,strian_24\n0,1e-4\n", "lines.jsonl": "{}\n",
        "torn.toml": "mass = [", "half.toml": "name = 'half a wing'",
        "hole.csv": "F [N];Weg [mm]\n1;0,5\n;0,75\n3;0,8\n",
        "back.csv": "t [ms];Weg [mm]\n" + "".join(f"{t};1,5\n" for t in (0, 2, 4, 6, 5, 8, 10, 12, 14)),
        "room.toml": INPUTS.text("room.toml"), "cold.csv": "time,outside\n120,5\n180,-41\n",
        "my_part.toml": structure_files()["bracket"].read_text(encoding="utf-8"),
    }.items():  # fmt: skip
        (place / name).write_text(content, encoding="utf-8")
    for name, model in (("ball", "ball2"), ("sized", "resize3"), ("room", "room2")):
        shutil.copy(foreign_fmu(model), place / f"{name}.fmu")
    said("discrepancy", "example", "static", place / "campaign", *RIG.split(), "--seed", "3")
    return place


@pytest.mark.parametrize(("line", "sentence", "code"), ROWS, ids=[" ".join(row[:2]) for row in ROWS])
def test_what_is_wrong_is_one_sentence_with_its_exit_code(
    folder, heat_exchanger, monkeypatch, line, sentence, code
):
    monkeypatch.chdir(folder)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    line = line.replace("RIG", RIG).replace("FOULING", shlex.quote(str(heat_exchanger / "fouling.toml")))
    assert sentence in refused(*shlex.split(line), code=code)
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


@pytest.mark.parametrize(("line", "words"), TOLD, ids=[row[0] for row in TOLD])
def test_what_is_said(folder, monkeypatch, line, words):
    monkeypatch.chdir(folder)
    text = said(*shlex.split(line))
    assert [word for word in words if word not in text] == []
