"""An FMU with a binding: operating points at rest as a campaign, calibrated, flown."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from calibration.result.file import load_calibration, result_bytes
from fmu_asset.door.binding import load_binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.packing.contents import build_script_fmu
from scenarios import asset_scripts, binding_files
from tests.command_line import refused, said
from tests.refusals import Inputs
from tests.twin_master.runs import loaded_from, table_of
from twin_master.assets.resolution import Overrides, asset_source, resolve_scenario
from twin_master.errors import MissionInputError
from twin_master.workflow import fly as new_run

TRUTH = 1.04
NOISE = np.array([0.04, 0.05, 0.06, 0.015])
OUTPUTS = (
    ("flow", "flow", "l/min"), ("torque", "torque", "N m"), ("temperature", "temperature", "degC"),
    ("filter_pressure", "pressure", "bar"),
)  # fmt: skip
INPUTS = Inputs(__file__)
MODEL = INPUTS.text("pump.toml")
PARAMETER = INPUTS.text("pump_parameter.toml")
CAMPAIGN = INPUTS.text("pump_campaign.toml")


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the FMU, its model file and `lab`: nine operating points of a pump with thicker oil."""
    folder = tmp_path_factory.mktemp("pump")
    (folder / "lab").mkdir()
    build_script_fmu(asset_scripts()["gear_pump"], folder / "gear_pump.fmu")
    binding, random = load_binding(binding_files()["gear_pump"]), np.random.default_rng(7)
    rows = ["speed,load," + ",".join(f"{name}_seen" for name, _, _ in OUTPUTS)]
    with FmiAsset(folder / "gear_pump.fmu", binding, isolated=False) as pump:
        for speed in (1000.0, 1400.0, 1800.0):
            for pressure in (60.0, 120.0, 180.0):
                pump.reset({"viscosity_factor": TRUTH})
                shown = pump.step({"speed": speed, "pressure": pressure}).values
                noisy = shown + NOISE * random.standard_normal(4)
                rows.append(",".join(map(repr, [speed, pressure, *noisy.tolist()])))
    (folder / "lab/points.csv").write_text("\n".join(rows))
    model, campaign = MODEL, CAMPAIGN
    for (name, quantity, unit), noise in zip(OUTPUTS, NOISE.tolist(), strict=True):
        model += f'[[output]]\nname = "{name}"\nquantity = "{quantity}"\n'
        campaign += f'[[channel]]\nname = "{name}_seen"\nquantity = "{quantity}"\nunit = "{unit}"\n'
        campaign += f'output = "{name}"\nnoise = {{ standard_deviation = {noise} }}\n'
    (folder / "model.toml").write_text(model + PARAMETER)
    (folder / "lab/campaign.toml").write_text(campaign)
    return folder


def test_an_fmu_is_calibrated_at_operating_points_and_flown(bench, tmp_path):
    arguments = (bench / "lab", "--model", bench / "model.toml", "--out", tmp_path / "out", "--no-report")
    said("calibrate", "campaign", *arguments)
    file = tmp_path / "out/calibration.nc"
    found = load_calibration(file)
    assert found.explained is True
    deviation = found.standard_deviation("viscosity_factor")
    assert abs(found.mean("viscosity_factor") - TRUTH) < 3.0 * deviation < 0.012

    table = table_of("pump_wear")
    table["mission"] |= {"steps": 3, "prediction_steps": 2}
    table["state"][0] |= {"levels_percent": [0, 30], "prior": [1, 0]}
    table["state"][1] |= {"levels_percent": [0, 60], "prior": [1, 0]}
    table["calibration"] |= {"draws": 4}
    table["asset"] = {"kind": "script", "script": "gear_pump", "binding": "gear_pump", "isolated": False}
    table["truth"]["gains"] = []
    scenario = loaded_from(table, "pump_wear")
    folder = new_run(scenario, tmp_path / "run", Overrides(calibration=file), report=False).folder
    with xr.open_datatree(folder / "run.nc", engine="h5netcdf") as tree:
        tree.load()
    assert set(tree["calibration"]["draw_value"].values) <= set(found.draws_of("viscosity_factor"))
    binding = load_binding(binding_files()["gear_pump"])
    with FmiAsset(bench / "gear_pump.fmu", binding, isolated=False) as pump:
        pump.reset({"viscosity_factor": found.mean("viscosity_factor")})
        wanted = pump.step({"speed": 1800.0, "pressure": 180.0}).values
    np.testing.assert_allclose(tree["truth"]["operation"].values[0], wanted, rtol=1e-6)

    other = replace(found, priors=(replace(found.priors[0], high=9.0),), samples=found.samples + 0.25)
    (tmp_path / "other.nc").write_bytes(result_bytes(other))  # of a pump that takes thicker oil
    resolved = resolve_scenario(scenario, Overrides(calibration=tmp_path / "other.nc"))
    with pytest.raises(
        MissionInputError, match=r"range of 'viscosity_factor', 0\.8 to 1\.2.* calibration has"
    ):
        asset_source(resolved).check()


def test_what_an_fmu_does_not_have_is_one_sentence(bench):
    for old, new, words in (
        ('name = "pressure", quantity', 'name = "pressuer", quantity', "pressuer"),
        ("input = [", "input = [] # ", "does not have; it has none: name it in"),
        ('binding = "gear_pump"', 'binding = "no_binding"', "no_binding"),
        (PARAMETER, "", "has no parameter to calibrate"),
        ("high = 1.15", "high = 1.25", "= 1.25 lies outside the range of 'viscosity_factor', 0.8 to 1.2"),
        ("low = 0.85", "low = 0.75", "= 0.75 lies outside the range of 'viscosity_factor', 0.8 to 1.2"),
    ):
        model = bench / "wrong.toml"
        model.write_text((bench / "model.toml").read_text().replace(old, new))
        assert words in refused("calibrate", "campaign", bench / "lab", "--model", model, code=None)
    shutil.copytree(bench / "lab", bench / "far")
    (bench / "far/points.csv").write_text(
        (bench / "lab/points.csv").read_text().replace("1400.0,", "9400.0,", 1)
    )
    for lab, model, words in (
        ("far", bench / "model.toml", "The trial 'points', row 4 of its table"),
        ("far", bench / "model.toml", "lies outside the range of 'speed', 500 to 2500"),
        ("lab", bench / "gear_pump.fmu", "is an FMU: give a TOML file"),
        ("lab", "single_mass_rig", "does not have"),
    ):
        assert words in refused("calibrate", "campaign", bench / lab, "--model", model, code=None)
