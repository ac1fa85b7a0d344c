"""Structures as a user has them: commands; from matrices of CalculiX and a campaign to FMU and twin."""

import json
import shutil
from pathlib import Path
from typing import Any

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
from twin_master.network.graphical_model import build_graphical_model
from twin_master.scenario.reading import LoadedScenario, parse_scenario
from twin_master.watch.workflow import begin_watch
from uav_twin import fly, load_calibration, open_run, structure_files

INPUTS = Inputs(__file__)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "bar.inp").write_text(INPUTS.text("bar.inp"))
    (tmp_path / "bar.toml").write_text(INPUTS.text("bar.toml"))
    return tmp_path / "bar.toml"


@pytest.fixture(scope="module")
def bar(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the command says as data of a bar under 20 MPa."""
    folder = tmp_path_factory.mktemp("bar")
    for name in ("bar.inp", "bar.toml"):
        (folder / name).write_text(INPUTS.text(name))
    words = ("structure", "info", folder / "bar.toml", "--modes", "2", "--quiet", "--json")
    record: dict[str, Any] = json.loads(said(*words))
    return record


def test_info_gives_mass_and_centre_of_gravity(bar):
    assert bar["mass"] == pytest.approx(7800 * 0.1 * 0.01**2)
    assert bar["centre_of_gravity"] == pytest.approx([50, 5, 5])


def test_info_counts_unknowns_and_modes(bar):
    assert (bar["unknowns"], bar["held"], bar["loose_nodes"]) == (12, 12, [9])
    assert len(bar["frequencies"]) == 2


def test_info_gives_strains_and_outputs_of_loads(bar):
    """The bar has 100 microstrain and is 0.01 mm longer."""
    (load,) = bar["loads"]
    assert load["strain"]["top"] == pytest.approx(1e-4, rel=1e-9)
    assert load["output"]["end"] == pytest.approx(1e-5, rel=1e-9)


def test_a_structure_without_mass_has_no_modes(file):
    file.write_text(INPUTS.text("bar.toml", ("density = 7800", "density = 0")))
    assert "No modes: nothing has mass." in said("structure", "info", file, "--modes", "3")


def test_a_set_that_the_mesh_does_not_have_is_refused_with_those_that_it_has(file):
    file.write_text(INPUTS.text("bar.toml", ('"ROOT"', '"WALL"')))
    sentence = refused("structure", "info", file)
    assert "no set of nodes or faces named 'WALL'; there are ROOT, END." in sentence


CALCULIX_IS_THERE = pytest.mark.skipif(calculix_program() is None, reason="CalculiX (ccx) is not installed")


@CALCULIX_IS_THERE
def test_verify_compares_with_calculix(file, tmp_path):
    out = tmp_path / "jobs"
    text = said("structure", "verify", file, "--modes", "2", "--out", out)
    assert (text.count("kept"), text.count("BROKEN")) == (4, 0)
    assert (out / "static.inp").is_file()
    assert "is not an empty folder" in refused("structure", "verify", file, "--out", out)


@CALCULIX_IS_THERE
def test_verify_prints_its_verdict_as_data(file):
    record = json.loads(said("structure", "verify", file, "--modes", "2", "--json", "--quiet"))
    assert record["passed"] is True


@CALCULIX_IS_THERE
def test_verify_names_the_checks_that_broke_their_limit(file, monkeypatch):
    monkeypatch.setattr("uav_twin.structure.FREQUENCY_LIMIT", 0.0)
    done = command("structure", "verify", file, "--modes", "2")
    assert done.returncode == 1
    assert "BROKEN" in done.stdout
    assert done.stderr.strip().endswith("1 of 4 checks exceeded their limits: 2 modes, frequencies.")


class ReducedBeam:
    """A beam that the command reduces and compares in four states, in a cache of its own."""

    def __init__(self, file: Path, folder: Path) -> None:
        self.file = file
        self.cache = folder / "cache"
        self.record = json.loads(self.reduce("--json", "--states", "4", "--quiet"))
        (self.model,) = (self.cache / "uav-twin").glob("structure-*.npz")

    def reduce(self, *options: str) -> str:
        """Return what the command prints of the reduction."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("XDG_CACHE_HOME", str(self.cache))
            return said("structure", "reduce", self.file, *options)


@pytest.fixture(scope="module")
def reduced_beam(write_beam, tmp_path_factory) -> ReducedBeam:
    folder = tmp_path_factory.mktemp("reduced")
    return ReducedBeam(write_beam(folder), folder)


def test_a_reduction_says_its_ranges(reduced_beam):
    assert reduced_beam.record["ranges"]["z1"] == [0.0, 0.8]


def test_the_errors_of_a_reduction_lie_within_its_bound(reduced_beam):
    """The bound is nearly the one asked for, and tells the error within a few times."""
    errors = reduced_beam.record["errors"]
    largest_error = max(errors["strain"], errors["displacement"])
    assert largest_error < errors["bound"] < min(1e-3, 15 * errors["strain"])
    assert (errors["broken"], errors["states"]) == (0, 4)
    assert errors["frequency"] < 2e-5


def test_a_second_reduction_finds_the_model_in_the_cache(reduced_beam):
    time_before = reduced_beam.model.stat().st_mtime_ns
    assert "load_factor" in reduced_beam.reduce("--states", "0")
    assert reduced_beam.model.stat().st_mtime_ns == time_before


def test_a_loss_of_more_than_all_is_refused(write_beam, tmp_path):
    file = write_beam(tmp_path, {'name = "z1",': 'name = "z1", largest_loss = 2,'})
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
def test_info_takes_matrices(matrices):
    text = said("structure", "info", matrices, "--modes", "2")
    assert "725 free" in text
    assert "whole.sti, whole.mas, whole.dof" in text


@needs_calculix
def test_reduce_takes_matrices(matrices):
    said("structure", "reduce", matrices, "--states", "2")


@needs_calculix
@pytest.mark.parametrize("kind", ["python", "compiled"])
def test_matrices_become_an_fmu_in_which_fmpy_finds_nothing(matrices, tmp_path, kind):
    target = tmp_path / f"{kind}.fmu"
    said("structure", "fmu", matrices, "--out", target, "--kind", kind)
    assert validate_fmu(str(target)) == []


@needs_calculix
def test_both_commands_build_the_same_fmu_of_matrices(matrices, tmp_path):
    said("structure", "fmu", matrices, "--out", tmp_path / "a.fmu", "--kind", "python")
    said("fmu", "build", "--design", matrices, "--out", tmp_path / "b.fmu")
    assert (tmp_path / "b.fmu").read_bytes() == (tmp_path / "a.fmu").read_bytes()


@needs_calculix
def test_a_command_that_needs_a_mesh_refuses_matrices(matrices, tmp_path):
    for words in (("verify", matrices), ("field", matrices, "--out", tmp_path / "field.vtu")):
        assert "is a structure from matrices: without a mesh" in refused("structure", *words)


LOSS = 0.4
"""Loss of stiffness of the patch in the mission."""


@pytest.fixture(scope="module")
def skin_run(matrices: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the mission of the skin from matrices."""
    scenario = parse_scenario(INPUTS.table("skin_mission.toml"), "mission")
    loaded = LoadedScenario(scenario, matrices.with_name("mission.toml"), "0" * 64)
    return fly(loaded, tmp_path_factory.mktemp("skin_run") / "run", report=False).folder


@needs_calculix
def test_a_twin_finds_the_patch_that_calculix_weakened(skin_run):
    tree = open_run(skin_run)
    assert tree["truth"]["state"].values[-1] == pytest.approx([LOSS])
    assert tree["filtered"]["mean"].values[-1] == pytest.approx([LOSS], abs=0.1)


@needs_calculix
def test_the_strains_flown_are_those_of_calculix_with_the_weakened_patch(skin_run, tmp_path):
    tree = open_run(skin_run)
    deck = stiffened_skin(skin=1.03, patch=1.03 * (1.0 - LOSS))
    unit_force = [(CORNER, (0.0, 0.5, 1.0))]
    (displacement,) = solved(deck, tmp_path / "calculix", unit_force)
    strain_by_newton = np.array(
        [float(displacement[last][0] - displacement[first][0]) / 100.0 for first, last in (PATCH, OTHER)]
    )
    expected = float(tree["observed"]["push"][-1]) * strain_by_newton
    strain = tree["truth"]["strain"].values[-1]
    np.testing.assert_allclose(strain, expected, rtol=0.0, atol=1e-3 * np.abs(expected).max())


@needs_calculix
def test_a_run_keeps_the_matrices_that_it_flew(skin_run):
    copies = {path.name for path in (skin_run / "asset" / "flown").iterdir()}
    assert {"whole.sti", "whole.mas", "whole.dof", "patch_half.sti", "skin_half.sti"} <= copies
    assert not (skin_run / "structure.vtu").exists()


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


class CalibratedMission:
    """A bracket that is calibrated, and a mission with the file of its calibration."""

    def __init__(self, file: Path, folder: Path) -> None:
        self.file = file
        self.calibration = load_calibration(file)
        self.options = Overrides(calibration=file)
        with pytest.MonkeyPatch.context() as patch:
            self.notes = noted(patch)
            self.folder = fly(mission(), folder / "run", self.options, report=False).folder
        self.tree = open_run(self.folder)
        self.full = load_and_assemble(structure_files()["bracket"])
        hash_begin = self.calibration.design_hash[:12]
        self.believed = f"The twin believes the design that was calibrated, {hash_begin}."

    def strains_by_load_factor(self, young_modulus_factor: float) -> np.ndarray:
        """Return the strains that the full model shows under a load factor of 1."""
        stiffness = self.full.stiffness({"e": young_modulus_factor}, {})
        solution = Factorisation(stiffness).solve(self.full.load("weight", 1.0))
        return np.asarray(self.full.gauge_output @ solution)


@pytest.fixture(scope="module")
def calibrated_mission(calibrated: Path, tmp_path_factory: pytest.TempPathFactory) -> CalibratedMission:
    return CalibratedMission(calibrated, tmp_path_factory.mktemp("calibrated"))


def test_a_campaign_tells_the_modulus_and_not_the_mass(calibrated_mission):
    """The mass of the pump follows the modulus."""
    calibration = calibrated_mission.calibration
    error = abs(calibration.mean("e") - TRUTH["e"])
    assert error < 3.0 * calibration.standard_deviation("e") < 0.03
    assert calibration.explained is True
    assert any("does not determine pump" in sentence for sentence in calibration.findings)


def test_a_mission_says_what_was_calibrated_what_flies_and_what_is_believed(calibrated_mission):
    calibration, file = calibrated_mission.calibration, calibrated_mission.file
    beginning = (
        f"The calibrated model was {calibration.model}; the asset is the FMU of the structure bracket, and"
    )
    end = calibrated_mission.believed
    assert calibration.design_hash == packed_design_hash(file.parents[1] / "bracket.fmu")
    assert any(note.startswith(beginning) and note.endswith(end) for note in calibrated_mission.notes)


def test_a_mission_draws_from_its_calibration(calibrated_mission):
    calibration = calibrated_mission.calibration
    draws = calibrated_mission.tree["calibration"]["draw_value"].values
    tolerance = 0.1 * calibration.standard_deviation("e")
    copy = calibrated_mission.folder / "asset/calibration.nc"
    assert set(draws) <= set(calibration.draws_of("e"))
    np.testing.assert_allclose(draws.mean(), calibration.mean("e"), atol=tolerance)
    assert copy.read_bytes() == calibrated_mission.file.read_bytes()


def test_what_flies_stands_at_the_means_of_the_calibration(calibrated_mission):
    tree = calibrated_mission.tree
    strains = calibrated_mission.strains_by_load_factor(calibrated_mission.calibration.mean("e"))
    expected = float(tree["observed"]["load_factor"][0]) * strains
    np.testing.assert_allclose(tree["truth"]["strain"].values[0], expected, rtol=5e-4)


def test_a_watch_says_what_is_believed(calibrated_mission, tmp_path, monkeypatch):
    notes = noted(monkeypatch)
    scenario = resolve_scenario(mission(), calibrated_mission.options)
    with begin_watch(scenario, mission().file, tmp_path / "watch", SilentProgress()):
        pass
    believed = calibrated_mission.believed
    assert any("the asset is the watched asset" in note and note.endswith(believed) for note in notes)


def test_the_mass_that_was_calibrated_beside_the_modulus_follows_its_draws(calibrated_mission, tmp_path):
    """The pump bends the bracket with nearly all of the load."""
    scenario = mission(draws=3).scenario
    source = prepared(mission(draws=3), tmp_path, calibrated_mission.options)
    draws = source.draws(scenario.mission.seed)
    table = source.observation_table(draws, build_graphical_model(scenario))
    strains = calibrated_mission.strains_by_load_factor(float(draws.values[1]))
    ratio = table[1, 0, 0] / (1.5 * strains)
    relative_mass = (draws.others["pump"][1] - 2.5) / 2.5
    assert dict(draws.others).keys() == {"pump"}
    np.testing.assert_allclose(ratio, 1.0 + relative_mass, rtol=1e-3)


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
