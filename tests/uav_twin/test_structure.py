"""Structures as a user has them: commands; from matrices of CalculiX and a campaign to FMU and twin."""

import json
import shutil
from pathlib import Path

import meshio
import numpy as np
import pytest
from fmpy.validation import validate_fmu

from calibration.errors import CalibrationRecordError
from fe.full.factorisation import Factorisation
from fe.structure.operators import load_and_assemble
from fe.verification.calculix_run import calculix_program
from fmu_asset.archive.fmu_file import packed_design_hash
from reporting.progress import SilentProgress
from tests.calculix_decks import needs_calculix, solved, stiffened_skin, write_structure
from tests.command_line import command, refused, said
from tests.refusals import Inputs
from tests.twin_master.runs import changed_scenario, loaded_from, noted, prepared, written
from twin_master.assets.resolution import Overrides, asset_source, resolve_scenario
from twin_master.errors import MissionInputError
from twin_master.network.twin import build_graphical_model
from twin_master.scenario.reading import LoadedScenario, parse_scenario
from twin_master.watch.opening import begin_watch
from uav_twin import fly, load_calibration, open_run, structure_files

INPUTS = Inputs(__file__)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "bar.inp").write_text(INPUTS.text("bar.inp"))
    (tmp_path / "bar.toml").write_text(INPUTS.text("bar.toml"))
    return tmp_path / "bar.toml"


def test_info_gives_as_data_what_a_structure_is(file):
    record = json.loads(said("structure", "info", file, "--modes", "2", "--quiet", "--json"))
    assert record["mass"] == pytest.approx(7800 * 0.1 * 0.01**2)
    assert record["centre_of_gravity"] == pytest.approx([50, 5, 5])
    assert (record["unknowns"], record["held"], record["loose_nodes"]) == (12, 12, [9])
    # A bar under 20 MPa: 100 microstrain, 0.01 mm.
    (load,) = record["loads"]
    assert load["strain"]["top"] == pytest.approx(1e-4, rel=1e-9)
    assert load["output"]["end"] == pytest.approx(1e-5, rel=1e-9)
    assert len(record["frequencies"]) == 2
    file.write_text(INPUTS.text("bar.toml", ("density = 7800", "density = 0")))
    assert "No modes: nothing has mass." in said("structure", "info", file, "--modes", "3")
    file.write_text(INPUTS.text("bar.toml", ('"ROOT"', '"WALL"')))
    assert "no set of nodes or faces named 'WALL'; there are ROOT, END." in refused("structure", "info", file)


@pytest.mark.skipif(calculix_program() is None, reason="CalculiX (ccx) is not installed")
def test_verify_compares_with_calculix(file, tmp_path, monkeypatch):
    out = tmp_path / "jobs"
    text = said("structure", "verify", file, "--modes", "2", "--out", out)
    assert text.count("kept") == 4
    assert "BROKEN" not in text
    assert (out / "static.inp").is_file()
    assert "is not an empty folder" in refused("structure", "verify", file, "--out", out)
    told = json.loads(said("structure", "verify", file, "--modes", "2", "--json", "--quiet"))
    assert told["passed"] is True
    monkeypatch.setattr("uav_twin.structure.FREQUENCY_LIMIT", 0.0)
    found = command("structure", "verify", file, "--modes", "2")
    assert "BROKEN" in found.stdout
    assert found.returncode == 1
    assert found.stderr.strip().endswith("1 of 4 checks exceeded their limits: 2 modes, frequencies.")


def test_a_structure_is_reduced_and_compared(write_beam, tmp_path, monkeypatch):
    """`structure reduce` says ranges and measured errors; a second call finds the model in the cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    file = str(write_beam(tmp_path))
    record = json.loads(said("structure", "reduce", file, "--json", "--states", "4", "--quiet"))
    assert record["ranges"]["z1"] == [0.0, 0.8]
    errors = record["errors"]  # the bound holds, nearly as asked for, and tells the error within a few times
    assert max(errors["strain"], errors["displacement"]) < errors["bound"] < min(1e-3, 15 * errors["strain"])
    assert (errors["broken"], errors["states"]) == (0, 4)
    assert errors["frequency"] < 2e-5
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


SKIN = stiffened_skin()
CORNER = SKIN.node[300.0, 0.0, 0.0]
PATCH, OTHER = ([SKIN.node[x, y, 0.0] for x in (50.0, 150.0)] for y in (50.0, 150.0))
"""Nodes at the ends of two gauges of 100 mm, on the patch and beside it."""


@pytest.fixture(scope="module")
def matrices(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The structure file beside the matrices that CalculiX stored."""
    places = ("PATCH", PATCH), ("SKIN", OTHER), ("CORNER", CORNER), ("CORNER", CORNER)
    tables = INPUTS.text("skin.toml", *((place, str(nodes)) for place, nodes in places))
    return write_structure(tmp_path_factory.mktemp("skin"), tables)


@needs_calculix
def test_every_command_takes_it(matrices, tmp_path):
    """Info, reduce and fmu as of a mesh; FMPy finds nothing; what needs a mesh says so."""
    info = said("structure", "info", matrices, "--modes", "2")
    assert "725 free" in info
    assert "whole.sti, whole.mas, whole.dof" in info
    said("structure", "reduce", matrices, "--states", "2")
    for kind in ("python", "compiled"):
        target = tmp_path / f"{kind}.fmu"
        said("structure", "fmu", matrices, "--out", target, "--kind", kind)
        assert validate_fmu(str(target)) == []
    said("fmu", "build", "--design", matrices, "--out", tmp_path / "b.fmu")
    assert (tmp_path / "b.fmu").read_bytes() == (tmp_path / "python.fmu").read_bytes()
    for words in (("verify", matrices), ("field", matrices, "--out", tmp_path / "field.vtu")):
        assert "is a structure from matrices: without a mesh" in refused("structure", *words)


@needs_calculix
def test_a_twin_finds_the_patch_that_calculix_weakened(matrices, tmp_path):
    """The strains flown are CalculiX' with that patch."""
    scenario = parse_scenario(INPUTS.table("skin_mission.toml"), "mission")
    loaded = LoadedScenario(scenario, matrices.with_name("mission.toml"), "0" * 64)
    folder = fly(loaded, tmp_path / "run", report=False).folder
    tree = open_run(folder)
    assert tree["truth"]["state"].values[-1] == pytest.approx([0.4])
    deck = stiffened_skin(skin=1.03, patch=1.03 * (1.0 - 0.4))
    (found,) = solved(deck, tmp_path / "calculix", [(CORNER, (0.0, 0.5, 1.0))])  # by 1 N
    strain = np.array([float(found[last][0] - found[first][0]) / 100.0 for first, last in (PATCH, OTHER)])
    wanted, flown = float(tree["observed"]["push"][-1]) * strain, tree["truth"]["strain"].values[-1]
    np.testing.assert_allclose(flown, wanted, rtol=0.0, atol=1e-3 * np.abs(wanted).max())
    assert tree["filtered"]["mean"].values[-1] == pytest.approx([0.4], abs=0.1)
    copies = {path.name for path in (folder / "asset" / "flown").iterdir()}
    assert {"whole.sti", "whole.mas", "whole.dof", "patch_half.sti", "skin_half.sti"} <= copies
    assert not (folder / "structure.vtu").exists()


TRUTH = {"e": 0.96}


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The calibration file of a bracket: what its full model shows at eight load factors, with noise."""
    folder = tmp_path_factory.mktemp("bracket")
    source = structure_files()["bracket"]
    for file in (source, source.with_suffix(".inp")):
        shutil.copy(file, folder)
    full = load_and_assemble(folder / source.name)
    solution = Factorisation(full.stiffness(TRUTH, {})).solve(full.load("weight", 1.0))
    shown = np.append(1e6 * (full.gauge_output @ solution), 1e3 * (full.displacement_output @ solution))
    factors, noise = np.linspace(0.5, 4.0, 8), np.array([4.0] * 4 + [0.005])
    rows = np.outer(factors, shown) + noise * np.random.default_rng(4).standard_normal((8, 5))
    lines = [",".join(map(repr, [n, *row])) for n, row in zip(factors.tolist(), rows.tolist(), strict=True)]
    (folder / "lab").mkdir()
    (folder / "lab/loads.csv").write_text("\n".join(["load_factor,heel,arm,tip,back,sag", *lines]))
    (folder / "lab/campaign.toml").write_text(INPUTS.text("bracket_campaign.toml"))
    model, out = folder / "model.toml", folder / "out"
    said("structure", "fmu", folder / source.name, "--rig", model)
    words = ("--model", model, "--asset", "bracket 7", "--out", out, "--no-report")
    said("calibrate", "campaign", folder / "lab", *words)
    return out / "calibration.nc"


def mission(**calibration: object) -> LoadedScenario:
    """The shipped mission in six shifts, of an asset whose parameters are not named."""
    changes = {"mission": {"steps": 6, "prediction_steps": 2}, "asset": {"isolated": False, "parameters": ""}}
    return changed_scenario("bracket", changes | {"truth": {"gains": []}, "calibration": calibration})


def test_the_twin_flies_with_it(calibrated, tmp_path, monkeypatch):
    """The campaign tells the modulus and not the mass, which follows it; what flies stands at the means."""
    found, told, given = load_calibration(calibrated), noted(monkeypatch), Overrides(calibration=calibrated)
    assert abs(found.mean("e") - TRUTH["e"]) < 3.0 * found.standard_deviation("e") < 0.03
    assert found.explained is True
    assert any("does not tell pump" in sentence for sentence in found.findings)
    folder = fly(mission(), tmp_path / "run", given, report=False).folder
    wanted_words = f"The calibrated model was {found.model}; flown is the FMU of the structure bracket, and"
    assert found.design_hash == packed_design_hash(calibrated.parents[1] / "bracket.fmu")
    believed = f"The twin believes the design that was calibrated, {found.design_hash[:12]}."
    assert any(note.startswith(wanted_words) and note.endswith(believed) for note in told)
    tree = open_run(folder)
    draws = tree["calibration"]["draw_value"].values
    assert set(draws) <= set(found.draws_of("e"))
    np.testing.assert_allclose(draws.mean(), found.mean("e"), atol=0.1 * found.standard_deviation("e"))
    assert (folder / "asset/calibration.nc").read_bytes() == calibrated.read_bytes()
    full = load_and_assemble(structure_files()["bracket"])
    solution = Factorisation(full.stiffness({"e": found.mean("e")}, {})).solve(full.load("weight", 1.0))
    wanted = float(tree["observed"]["load_factor"][0]) * (full.gauge_output @ solution)
    np.testing.assert_allclose(tree["truth"]["strain"].values[0], wanted, rtol=5e-4)

    told.clear()
    with begin_watch(
        resolve_scenario(mission(), given), mission().file, tmp_path / "watch", SilentProgress()
    ):
        pass
    assert any("flown is the watched asset" in note and note.endswith(believed) for note in told)

    scenario = mission(draws=3).scenario
    source = prepared(mission(draws=3), tmp_path, given)
    drawn = source.draws(scenario.mission.seed)
    assert dict(drawn.others).keys() == {"pump"}
    table = source.observation_table(drawn, build_graphical_model(scenario))
    row = {"e": float(drawn.values[1])}
    solution = Factorisation(full.stiffness(row, {})).solve(full.load("weight", 1.0))
    ratio = table[1, 0, 0] / (1.5 * (full.gauge_output @ solution))
    arm = (drawn.others["pump"][1] - 2.5) / 2.5  # the pump bends the bracket with nearly all of the load
    np.testing.assert_allclose(ratio, 1.0 + arm, rtol=1e-3)


def test_what_the_calibration_does_not_fit_is_refused(calibrated, tmp_path):
    given = Overrides(calibration=calibrated)
    with pytest.raises(CalibrationRecordError, match="has no samples of `pomp`; it has e, pump"):
        fly(mission(parameter="pomp"), tmp_path / "run", given, report=False)
    source = structure_files()["bracket"]
    shutil.copy(source.with_suffix(".inp"), tmp_path)
    text, table = source.read_text(encoding="utf-8"), mission().scenario.to_dict()
    for tables, change, words in (
        (("asset", "belief"), ("free = true", ""), "pump, which the structure bracket does not know"),
        (("belief",), ("density = ", "density = 1"), "bracket, which the twin believes, has the design"),
    ):
        own = {name: table[name] | {"structure": str(written(tmp_path, text, change))} for name in tables}
        other = loaded_from(table | own, "bracket")
        with pytest.raises(MissionInputError, match=words):
            fly(other, tmp_path / "run", given, report=False)
        assert not (tmp_path / "run").exists()
    other = loaded_from(table | {"asset": own["belief"]}, "bracket")  # the truth may be another
    asset_source(resolve_scenario(other, given)).check()
