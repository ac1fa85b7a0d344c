"""From matrices that CalculiX stored to an FMU, a calibration and a twin: a stiffened skin of shells."""

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from fmpy.validation import validate_fmu

from calibration.result.file import load_calibration
from fe.reduction.reduced_basis import measured_errors
from reporting.toml_file import parse_toml
from tests.calculix_decks import needs_calculix, solved, stiffened_skin, write_structure
from tests.command_line import refused, said
from tests.refusals import Inputs
from twin_master.scenario.reading import LoadedScenario, parse_scenario
from twin_master.workflow import fly as new_run
from uav_twin import assemble_structure, reduced_structure

DECK = stiffened_skin()
CORNER = DECK.node[300.0, 0.0, 0.0]
GAUGES = {"patch": ((50.0, 50.0), (150.0, 50.0)), "skin": ((50.0, 150.0), (150.0, 150.0))}
LENGTH = 100.0  # mm


def ends(name: str) -> list[int]:
    """Nodes of a gauge."""
    return [DECK.node[x, y, 0.0] for x, y in GAUGES[name]]


TABLES = (
    "".join(
        f'[[gauge]]\nname = "{name}"\nnodes = {ends(name)}\ndirection = [1, 0, 0]\nlength = {LENGTH}\n'
        for name in GAUGES
    )
    + f"""[[load]]
name = "push"
control = "push"
node = {CORNER}
force = [0, 0.5, 1]
[[displacement]]
name = "corner"
node = {CORNER}
direction = [0, 0, 1]
[damping]
alpha = 2.0
beta = 1e-5
"""
)
INPUTS = Inputs(__file__)
MISSION = INPUTS.text("skin_mission.toml")
CAMPAIGN = INPUTS.text("skin_campaign.toml")


def calculix(folder: Path, e: float, loss: float) -> tuple[dict[str, float], float]:
    """Strains of the gauges and deflection of the corner [mm] under 1 N, by CalculiX."""
    deck = stiffened_skin(skin=e, patch=e * (1.0 - loss))
    (found,) = solved(deck, folder, [(CORNER, (0.0, 0.5, 1.0))])
    strain = {}
    for name in GAUGES:
        first, last = ends(name)
        strain[name] = float(found[last][0] - found[first][0]) / LENGTH
    return strain, float(found[CORNER][2])


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The structure file beside the matrices that CalculiX stored."""
    return write_structure(tmp_path_factory.mktemp("skin"), stiffened_skin, TABLES)


@needs_calculix
def test_the_reduced_model_is_calculixs_within_its_bound(file, tmp_path):
    model = reduced_structure(file)
    for e, loss in ((1.0, 0.0), (1.05, 0.55)):
        strain, corner = calculix(tmp_path, e, loss)
        found = model.static_response({"e": e, "z1": loss, "push": 1.0})
        printed = 1e-6 * abs(corner) / LENGTH  # seven digits of each displacement
        np.testing.assert_allclose(
            found.strain, [*strain.values()], rtol=0.0, atol=found.strain_error_bound + printed
        )
        bound = 1e3 * found.displacement_error_bound
        assert 1e3 * found.displacement[0] == pytest.approx(corner, abs=bound + 1e-6 * abs(corner))
    errors = measured_errors(assemble_structure(file), model, 6)
    assert errors.broken == 0
    assert errors.frequency < 1e-4


@needs_calculix
def test_every_command_takes_it(file, tmp_path):
    """Info, reduce and fmu as of a mesh; FMPy finds nothing; what needs a mesh says so."""
    info = said("structure", "info", file, "--modes", "2")
    assert "725 free" in info
    assert "whole.sti, whole.mas, whole.dof" in info
    said("structure", "reduce", file, "--states", "2")
    for kind in ("python", "compiled"):
        target = tmp_path / f"{kind}.fmu"
        said("structure", "fmu", file, "--out", target, "--kind", kind)
        assert validate_fmu(str(target)) == []
    said("fmu", "build", "--design", file, "--out", tmp_path / "b.fmu")
    for words in (("verify", file), ("field", file, "--out", tmp_path / "field.vtu")):
        assert "is a structure from matrices: without a mesh" in refused("structure", *words)


@needs_calculix
def test_a_campaign_tells_its_parameter_and_that_nothing_is_missing(file, tmp_path):
    """What CalculiX answers with 0.96 times the modulus, read with noise."""
    strain, corner = calculix(tmp_path, 0.96, 0.0)
    random = np.random.default_rng(7)
    lines = [
        f"{force},{1e6 * strain['patch'] * force + 0.5 * random.standard_normal()!r},"
        f"{corner * force + 0.02 * random.standard_normal()!r}"
        for force in range(100, 1001, 100)
    ]
    lab = tmp_path / "lab"
    lab.mkdir()
    (lab / "pushes.csv").write_text("\n".join(["force,patch,corner", *lines]) + "\n", encoding="utf-8")
    (lab / "campaign.toml").write_text(CAMPAIGN, encoding="utf-8")
    rig = tmp_path / "rig.toml"
    said("structure", "fmu", file, "--out", tmp_path / "s.fmu", "--rig", rig)
    words = ("--model", rig, "--asset", "skin 1", "--out", tmp_path / "out", "--no-report")
    said("calibrate", "campaign", lab, *words)
    found = load_calibration(tmp_path / "out" / "calibration.nc")
    assert abs(found.mean("e") - 0.96) < 3.0 * found.standard_deviation("e") < 0.01
    told = said(
        "discrepancy", "run", lab, "--model", file, "--out", tmp_path / "verdict", "--no-report", "--json"
    )
    assert json.loads(told)["verdict"]["kind"] == "nothing missing"


@needs_calculix
def test_a_twin_finds_the_patch_that_calculix_weakened(file, tmp_path):
    """The strains flown are CalculiX' with that patch."""
    table = parse_toml(MISSION, "mission", ValueError)
    scenario = LoadedScenario(parse_scenario(table, "mission"), file.with_name("mission.toml"), "0" * 64)
    folder = new_run(scenario, tmp_path / "run", report=False).folder
    with xr.open_datatree(folder / "run.nc", engine="h5netcdf") as tree:
        tree.load()
    truth = tree["truth"]
    assert truth["state"].values[-1] == pytest.approx([0.4])
    strain, _ = calculix(tmp_path / "calculix", 1.03, 0.4)
    wanted = float(tree["observed"]["push"][-1]) * np.array([*strain.values()])
    np.testing.assert_allclose(truth["strain"].values[-1], wanted, rtol=0.0, atol=1e-3 * np.abs(wanted).max())
    assert tree["filtered"]["mean"].values[-1] == pytest.approx([0.4], abs=0.1)
    copies = {path.name for path in (folder / "asset" / "flown").iterdir()}
    assert {"whole.sti", "whole.mas", "whole.dof", "patch_half.sti", "skin_half.sti"} <= copies
    assert not (folder / "structure.vtu").exists()
