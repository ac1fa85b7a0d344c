"""`uav-twin ssp` and `uav-twin run x.ssp` as a user calls them."""

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from tests.command_line import refused, said

END = "</ssm:ParameterMapping>"


@pytest.fixture(scope="module")
def scenario(heat_exchanger: Path) -> Path:
    return heat_exchanger / "fouling.toml"


@pytest.fixture(scope="module")
def system(scenario: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The heat exchanger as an SSP file."""
    place = tmp_path_factory.mktemp("system") / "x.ssp"
    assert "x.ssp: " in said("ssp", "export", scenario, "--out", place)
    return place


def changed(system: Path, target: Path, **pairs: str) -> Path:
    """Write a system with texts of its XML files replaced."""
    with zipfile.ZipFile(system) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            for before, after in pairs.items() if not name.endswith(".fmu") else ():
                content = content.replace(before.encode(), after.encode())
            new.writestr(name, content)
    return target


def mapped(*entries: tuple[str, str]) -> dict[str, str]:
    """What adds entries, sources and targets, to the mapping of parameters."""
    texts = (f'<ssm:MappingEntry source="{one}" target="heat_exchanger.{other}" />' for one, other in entries)
    return {END: "".join(texts) + END}


def test_export_check_and_run(monkeypatch, scenario, system, tmp_path):
    monkeypatch.setattr("twin_master.workflow._report", lambda folder: (folder / "report.html").touch())
    text, out = said("ssp", "check", system), tmp_path / "run"
    assert "no problem found; 8 connections, 2 parameters" in text
    assert "evaluated in the order heat_exchanger (HeatExchanger)" in text
    exists = "exists: choose another --out or give --replace"
    assert exists in refused("ssp", "export", scenario, "--out", system)
    said("run", system, "--scenario", scenario, "--out", out, "--in-process", "-q")
    assert (out / "asset" / "system.ssp").read_bytes() == system.read_bytes()
    assert (out / "csv" / "observed.csv").is_file()


def test_a_system_is_simulated_as_it_lies_there(system, tmp_path):
    """Against the closed form of the heat exchanger: what the file says, and what is set instead."""
    table, picture = tmp_path / "x.csv", tmp_path / "x.svg"
    simulate = ("ssp", "simulate", system, "--stop-time", "3", "--step-size", "1", "--in-process")
    assert "3 steps to t = 3 s, every 1 s." in said(*simulate, "--out", table, "--plot", picture)
    assert picture.read_text(encoding="utf-8").startswith("<?xml")
    rows = np.genfromtxt(table, delimiter=",", names=True)
    np.testing.assert_allclose(rows["time"], [0.0, 1.0, 2.0, 3.0])
    assert rows["outlet"][-1] == pytest.approx(20.0 + 60.0 * -np.expm1(-6100.0 / 4186.0), rel=1e-14)
    for number, name in enumerate(("conductance", "heat_exchanger.conductance")):
        again = tmp_path / f"{number}.nc"
        said(*simulate, "--set", "mass_flow=0.5", "--set", f"{name}=5000", "--out", again)
        with xr.open_dataset(again, engine="h5netcdf") as data:
            outlet = float(data["observation"].sel(observation_name="outlet")[-1])
            assert data.attrs["fmu"] == "x.ssp"
        assert outlet == pytest.approx(20.0 + 60.0 * -np.expm1(-5000.0 / (4186.0 * 0.5)), rel=1e-14)
    assert "no parameter or input" in refused(*simulate, "--set", "heat_exchanger.outlet=1")
    asked = "asks for linear interpolation of inputs, but no component"
    assert asked in refused(*simulate, "--interpolation", "linear")


def test_what_nothing_takes_is_a_warning_and_not_flown(scenario, system, tmp_path):
    """The nearest name is said; what another entry gives is not missed."""
    file = changed(system, tmp_path / "more.ssp", **mapped(("conductance", "baffle")))
    named = f"{file} sets parameters that nothing takes: heat_exchanger.baffle; correct"
    for words in (("check", file), ("simulate", file, "--stop-time", "1", "--in-process")):
        assert f"warning: {named}" in " ".join(said("ssp", *words).split())
    assert json.loads(said("ssp", "check", file, "--json"))["unused"] == ["heat_exchanger.baffle"]
    more = mapped(("conductance", "conductanse"), ("cold", "wall_temperature"))
    file = changed(system, tmp_path / "misspelt.ssp", **more)
    meant = "heat_exchanger.conductanse (did you mean 'heat_exchanger.conductance'?)"
    named = f"{file} sets parameters that nothing takes: {meant}"
    assert f"warning: {named}" in " ".join(said("ssp", "check", file).split())
    out = tmp_path / "run"
    assert named in refused("run", file, "--scenario", scenario, "--out", out, "-q")
    assert not out.exists()


def test_the_words_of_ssp_2_are_read(system, tmp_path):
    """The numbers of FMI 3, metadata and the version; what 1.0 has no word for is refused."""
    meta, end = (
        '<ssc:MetaData kind="general" type="text/plain" source="note.txt" />',
        "</ssd:SystemStructureDescription>",
    )
    words = {
        'version="1.0" name=': 'version="2.0" name=',
        "ssc:Real": "ssc:Float64",
        "ssv:Real": "ssv:Float64",
        end: f"{meta}{end}",
    }
    newer, tables = changed(system, tmp_path / "newer.ssp", **words), [tmp_path / "0.csv", tmp_path / "1.csv"]
    for file, table in zip((system, newer), tables, strict=True):
        said("ssp", "simulate", file, "--out", table, "--step-size", "0.25", "--in-process")
    assert tables[0].read_bytes() == tables[1].read_bytes()
    for what, by, sentence in (
        ("<ssc:Float64 />", '<ssc:Float64 /><ssd:Dimension size="2" />', "has an array"),
        ("<ssc:Float64 />", "<ssc:Clock />", "has a clock"),
        ('kind="parameter"', 'kind="structuralParameter"', "a connector of the kind structuralParameter"),
        (' source="resources/heat_exchanger.fmu"', "", "'heat_exchanger' without a source"),
    ):
        bad = changed(newer, tmp_path / "bad.ssp", **{what: by})
        assert sentence in refused("ssp", "simulate", bad)


@pytest.mark.slow
@pytest.mark.xdist_group("wing")
def test_the_wing_of_a_design(tmp_path):
    said("ssp", "export", "uav_wing", "--out", tmp_path / "wing.ssp")
    assert "evaluated in the order uav_wing (uav_wing)" in said("ssp", "check", tmp_path / "wing.ssp")
