"""`uav-twin structure` as a user calls it."""

import json
from pathlib import Path

import meshio
import pytest

from fe.verification.calculix_comparison import calculix_program
from tests.command_line import command, refused, said
from tests.refusals import Inputs

INPUTS = Inputs(__file__)
DECK = INPUTS.text("bar.inp")
STRUCTURE = INPUTS.text("bar.toml")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "bar.inp").write_text(DECK)
    (tmp_path / "bar.toml").write_text(STRUCTURE)
    return tmp_path / "bar.toml"


def test_info_says_what_a_structure_is(file):
    record = json.loads(said("structure", "info", file, "--modes", "2", "--quiet", "--json"))
    assert record["mass"] == pytest.approx(7800 * 0.1 * 0.01**2)
    assert record["centre_of_gravity"] == pytest.approx([50, 5, 5])
    assert (record["unknowns"], record["held"], record["loose_nodes"]) == (12, 12, [9])
    # A bar under 20 MPa: 100 microstrain, 0.01 mm.
    (load,) = record["loads"]
    assert load["strain"]["top"] == pytest.approx(1e-4, rel=1e-9)
    assert load["output"]["end"] == pytest.approx(1e-5, rel=1e-9)
    assert len(record["frequencies"]) == 2
    text = said("structure", "info", file, "--modes", "2")
    for part in (
        "1 8-node hexahedra, 8 nodes",
        "linear: far too stiff in bending",
        "line 17: *INITIAL CONDITIONS is not known and was passed over; make sure that the model may do",
        "1 touch no element, among them 9",
        "scaled by e",
        "holds x, y, z",
    ):
        assert part in text
    assert "Load pull: largest displacement 0.01 mm" in text


@pytest.mark.skipif(calculix_program() is None, reason="CalculiX (ccx) is not installed")
def test_verify_compares_with_calculix(file, tmp_path, monkeypatch):
    out = tmp_path / "jobs"
    text = said("structure", "verify", file, "--modes", "2", "--out", out)
    assert text.count("kept") == 4
    assert "BROKEN" not in text
    assert (out / "static.inp").is_file()
    assert "is not an empty folder" in refused("structure", "verify", file, "--out", out)
    assert (
        json.loads(said("structure", "verify", file, "--modes", "2", "--json", "--quiet"))["passed"] is True
    )
    monkeypatch.setattr("uav_twin.structure.FREQUENCY_LIMIT", 0.0)
    found = command("structure", "verify", file, "--modes", "2")
    assert "BROKEN" in found.stdout
    assert (found.returncode, found.stderr.strip().splitlines()[-1]) == (
        1,
        "1 of 4 checks broke their limit: 2 modes, frequencies.",
    )


def test_a_fault_ends_in_one_sentence(file):
    file.write_text(STRUCTURE.replace('"ROOT"', '"WALL"'))
    assert "no set of nodes or faces named 'WALL'; there are ROOT, END." in refused("structure", "info", file)


def test_a_shipped_structure_goes_by_its_name_and_nothing_moves_without_mass(file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "HEEL" in said("structure", "info", "bracket", "--modes", "1")
    file.write_text(STRUCTURE.replace("density = 7800", "density = 0"))
    assert "No modes: nothing has mass." in said("structure", "info", file, "--modes", "3")


def test_a_structure_is_reduced_and_compared(write_beam, tmp_path, monkeypatch):
    """`structure reduce` says ranges and measured errors; a second call finds the model in the cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    file = str(write_beam(tmp_path))
    record = json.loads(said("structure", "reduce", file, "--json", "--states", "2", "--quiet"))
    assert record["ranges"]["z1"] == [0.0, 0.8]
    assert record["errors"]["strain"] < record["errors"]["bound"] < 1e-3
    kept = list((tmp_path / "cache" / "uav-twin").glob("structure-*.npz"))
    before = kept[0].stat().st_mtime_ns
    assert "load_factor" in said("structure", "reduce", file, "--states", "0")
    assert kept[0].stat().st_mtime_ns == before
    write_beam(tmp_path, {'name = "z1",': 'name = "z1", largest_loss = 2,'})
    assert "largest_loss" in refused("structure", "reduce", file, code=None)


def test_the_field_is_written_for_paraview(file, tmp_path):
    """A bar under 20 MPa: 100 microstrain along, none across, and by 1 / e more of all."""
    out = tmp_path / "bar.vtu"
    said("structure", "field", file, "--out", out, "--at", "e=0.9")
    field = meshio.read(out)
    assert field.cell_data["strain"][0][0] == pytest.approx([1e-4 / 0.9, 0, 0, 0, 0, 0], abs=1e-12)
    assert field.point_data["displacement"][:, 0].max() == pytest.approx(1e-5 / 0.9, rel=1e-9)


def test_fmu_build_packs_a_structure_too(tmp_path):
    """`fmu build --design` gives the bytes of `structure fmu`."""
    target, other = tmp_path / "one.fmu", tmp_path / "two.fmu"
    said("structure", "fmu", "bracket", "--out", str(target))
    said("fmu", "build", "--design", "bracket", "--out", other)
    assert target.read_bytes() == other.read_bytes()
