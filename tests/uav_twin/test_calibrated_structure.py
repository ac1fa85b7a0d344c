"""From a structure file to a twin with calibrated parameters: model file, campaign, calibration, mission."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from calibration.result.file import load_calibration
from fe.full.factorisation import Factorisation
from fe.structure.operators import load_and_assemble
from fmu_asset.archive.fmu_file import packed_design_hash
from reporting.progress import SilentProgress
from scenarios import structure_files
from tests.command_line import said
from tests.twin_master.runs import loaded_from, table_of
from twin_master.assets.resolution import Overrides, asset_source, resolve_scenario
from twin_master.errors import MissionInputError
from twin_master.network.twin import build_graphical_model
from twin_master.scenario.reading import LoadedScenario
from twin_master.watch.opening import begun_watch
from twin_master.workflow import fly as new_run

TRUTH = {"e": 0.96}


def write_campaign(folder: Path, structure: Path) -> None:
    """Write what the full model shows at eight load factors, with noise."""
    folder.mkdir()
    full = load_and_assemble(structure)
    solution = Factorisation(full.stiffness(TRUTH, {})).solve(full.load("weight", 1.0))
    shown = np.append(1e6 * (full.gauge_output @ solution), 1e3 * (full.displacement_output @ solution))
    factors, noise = np.linspace(0.5, 4.0, 8), np.array([4.0] * 4 + [0.005])
    rows = np.outer(factors, shown) + noise * np.random.default_rng(4).standard_normal((8, 5))
    names = ("heel", "arm", "tip", "back", "sag")
    lines = [",".join(map(repr, [n, *row])) for n, row in zip(factors.tolist(), rows.tolist(), strict=True)]
    (folder / "loads.csv").write_text(f"load_factor,{','.join(names)}\n" + "\n".join(lines))
    text = 'format = 1\nname = "loads"\n[parameters.pump]\nmean = 2.5\ndeviation = 0.01\n'
    for name, deviation in zip(names, noise.tolist(), strict=True):
        quantity, unit = ("displacement", "mm") if name == "sag" else ("strain", "microstrain")
        text += f'[[channel]]\nname = "{name}"\noutput = "{name}"\nquantity = "{quantity}"\nunit = "{unit}"\n'
        text += f"noise = {{ standard_deviation = {deviation} }}\n"
    (folder / "campaign.toml").write_text(
        text + '[[trial]]\nname = "loads"\nkind = "flight"\nfile = "loads.csv"\n'
    )


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The calibration file of a bracket whose modulus is 0.96 times the nominal one."""
    folder = tmp_path_factory.mktemp("bracket")
    source = structure_files()["bracket"]
    for file in (source, source.with_suffix(".inp")):
        shutil.copy(file, folder)
    write_campaign(folder / "lab", folder / source.name)
    model, out = folder / "model.toml", folder / "out"
    said("structure", "fmu", folder / source.name, "--rig", model)
    words = ("--model", model, "--asset", "bracket 7", "--out", out, "--no-report")
    said("calibrate", "campaign", folder / "lab", *words)
    return out / "calibration.nc"


def mission(**calibration: object) -> LoadedScenario:
    """The shipped mission in six shifts, of an asset whose parameters are not named."""
    table = table_of("bracket")
    table["mission"] |= {"steps": 6, "prediction_steps": 2}
    table["asset"] = {"kind": "structure", "structure": "bracket", "isolated": False}
    table["truth"]["gains"] = []
    table["calibration"] |= calibration
    return loaded_from(table, "bracket")


def test_the_campaign_tells_the_modulus_and_not_the_mass(calibrated):
    found = load_calibration(calibrated)
    assert abs(found.mean("e") - TRUTH["e"]) < 3.0 * found.standard_deviation("e") < 0.03
    assert found.explained is True
    assert any("does not tell pump" in sentence for sentence in found.findings)


def test_the_twin_flies_with_it(calibrated, tmp_path):
    """Its draws are those of the file; what flies stands at the means; the mass follows the modulus."""
    found = load_calibration(calibrated)
    said: list[str] = []
    folder = new_run(
        mission(), tmp_path / "run", Overrides(calibration=calibrated), progress=_Noted(said)
    ).folder
    wanted_words = f"Calibrated was the model {found.model}; flown is the FMU of the structure bracket, and"
    assert found.design_hash == packed_design_hash(calibrated.parents[1] / "bracket.fmu")
    believed = f"The twin believes the design that was calibrated, {found.design_hash[:12]}."
    assert any(note.startswith(wanted_words) and note.endswith(believed) for note in said)
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert wanted_words in page
    assert believed in page
    with xr.open_datatree(folder / "run.nc", engine="h5netcdf") as tree:
        tree.load()
    draws = tree["calibration"]["draw_value"].values
    assert set(draws) <= set(found.draws_of("e"))
    np.testing.assert_allclose(draws.mean(), found.mean("e"), atol=0.1 * found.standard_deviation("e"))
    assert (folder / "asset/calibration.nc").read_bytes() == calibrated.read_bytes()
    full = load_and_assemble(structure_files()["bracket"])
    solution = Factorisation(full.stiffness({"e": found.mean("e")}, {})).solve(full.load("weight", 1.0))
    wanted = float(tree["observed"]["load_factor"][0]) * (full.gauge_output @ solution)
    np.testing.assert_allclose(tree["truth"]["strain"].values[0], wanted, rtol=5e-4)

    said.clear()
    own = resolve_scenario(mission(), Overrides(calibration=calibrated))
    with begun_watch(own, mission().file, tmp_path / "watch", _Noted(said)):
        pass
    assert any("flown is the watched asset" in note and note.endswith(believed) for note in said)

    scenario = resolve_scenario(mission(draws=3), Overrides(calibration=calibrated))
    source = asset_source(scenario)
    source.prepare(tmp_path, SilentProgress())
    drawn = source.draws(scenario.mission.seed)
    assert dict(drawn.others).keys() == {"pump"}
    table = source.observation_table(drawn, build_graphical_model(scenario))
    row = {"e": float(drawn.values[1])}
    solution = Factorisation(full.stiffness(row, {})).solve(full.load("weight", 1.0))
    ratio = table[1, 0, 0] / (1.5 * (full.gauge_output @ solution))
    arm = (drawn.others["pump"][1] - 2.5) / 2.5  # the pump bends the bracket with nearly all of the load
    np.testing.assert_allclose(ratio, 1.0 + arm, rtol=1e-3)


class _Noted(SilentProgress):
    """Keeps what is said."""

    def __init__(self, said: list[str]) -> None:
        self._said = said

    def note(self, message: str) -> None:
        self._said.append(message)


def test_what_the_calibration_does_not_fit_is_refused(calibrated, tmp_path):
    with pytest.raises(Exception, match="has no samples of `pomp`; it has e, pump"):
        new_run(mission(parameter="pomp"), tmp_path / "run", Overrides(calibration=calibrated), report=False)
    source = structure_files()["bracket"]
    shutil.copy(source.with_suffix(".inp"), tmp_path)
    text, table = source.read_text(encoding="utf-8"), mission().scenario.to_dict()
    for tables, change, words in (
        (
            ("asset", "belief"),
            ("free = true", ""),
            "parameter pump, which the structure bracket does not know",
        ),
        (("belief",), ("density = ", "density = 1"), "bracket, which the twin believes, has the design"),
    ):
        (tmp_path / "other.toml").write_text(text.replace(*change), encoding="utf-8")
        own = {name: table[name] | {"structure": str(tmp_path / "other.toml")} for name in tables}
        other = loaded_from(table | own, "bracket")
        with pytest.raises(MissionInputError, match=words):
            new_run(other, tmp_path / "run", Overrides(calibration=calibrated), report=False)
        assert not (tmp_path / "run").exists()
    own = {"asset": table["asset"] | {"structure": str(tmp_path / "other.toml")}}  # the truth may be another
    other = loaded_from(table | own, "bracket")
    asset_source(resolve_scenario(other, Overrides(calibration=calibrated))).check()
