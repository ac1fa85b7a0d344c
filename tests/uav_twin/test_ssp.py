"""`uav-twin ssp` and `uav-twin run x.ssp` as a user calls them."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from tests.command_line import call, refused, said

HERE = Path(__file__).parents[1] / "twin_master" / "assets" / "heat_exchanger"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("ssp")
    for path in HERE.iterdir():
        if path.is_file():
            shutil.copy(path, place)
    subprocess.run(
        [sys.executable, "-m", "pythonfmu", "build", "-f", "HeatExchanger.py"],
        cwd=place, check=True, capture_output=True,
    )  # fmt: skip
    return place


def test_export_check_and_run(monkeypatch: pytest.MonkeyPatch, folder: Path, tmp_path: Path) -> None:
    monkeypatch.setattr("twin_master.workflow._report", lambda folder: (folder / "report.html").touch())
    scenario, ssp, out = str(folder / "fouling.toml"), str(tmp_path / "x.ssp"), str(tmp_path / "run")
    assert "x.ssp: " in said("ssp", "export", scenario, "--out", ssp)
    text = said("ssp", "check", ssp)
    assert "no problem found; 8 connections, 2 parameters" in text
    assert "evaluated in the order heat_exchanger (HeatExchanger)" in text
    assert "exists: choose another --out or give --replace" in refused(
        "ssp", "export", scenario, "--out", ssp
    )
    said("run", ssp, "--scenario", scenario, "--out", out, "--in-process", "-q")
    assert (Path(out) / "asset" / "system.ssp").read_bytes() == Path(ssp).read_bytes()
    assert (Path(out) / "csv" / "observed.csv").is_file()


def test_bad_calls_are_one_sentence(folder: Path, tmp_path: Path) -> None:
    scenario = str(folder / "fouling.toml")
    bad = tmp_path / "bad.ssp"
    bad.write_bytes(b"nothing")
    out = str(tmp_path / "x.ssp")
    for arguments, code, words in (
        (("ssp", "check", str(tmp_path / "none.ssp")), 1, "There is no SSP file"),
        (("ssp", "check", str(bad)), 1, "not a sound SSP archive"),
        (("ssp", "export", "no_scenario", "--out", out), 1, "There is no scenario `no_scenario`"),
        (("ssp", "export", scenario, "--out", str(tmp_path / "x.zip")), 1, "must have the suffix .ssp"),
        (("run", str(bad), "--scenario", scenario, "--out", out + "d"), 1, "not a sound SSP archive"),
        (("ssp", "simulate", str(tmp_path / "none.ssp")), 1, "There is no SSP file"),
        (("ssp", "simulate", str(bad), "--out", "x.txt"), 1, "x.txt must end in .csv or .nc"),
        (("ssp", "simulate", str(bad), "--set", "a"), 1, "--set a is not understood"),
        (("run", str(bad)), 2, "name a scenario as well"),
        (("run", scenario, "--scenario", scenario), 2, "belongs to an SSP file"),
    ):
        error = refused(*arguments, code=code)
        assert words in " ".join(error.split())
        if code == 1:
            assert len(error.strip().splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["bad.ssp"]


@pytest.fixture(scope="module")
def system(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The heat exchanger as an SSP file."""
    place = tmp_path_factory.mktemp("system") / "x.ssp"
    with pytest.MonkeyPatch.context() as patch:
        assert call(patch, "ssp", "export", str(folder / "fouling.toml"), "--out", str(place)) == 0
    return place


def changed(system: Path, target: Path, **pairs: str) -> Path:
    """Write a system with texts of its XML files replaced."""
    with zipfile.ZipFile(system) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            if not name.endswith(".fmu"):
                for before, after in pairs.items():
                    content = content.replace(before.encode(), after.encode())
            new.writestr(name, content)
    return target


def test_a_system_is_simulated_as_it_lies_there(system: Path, tmp_path: Path) -> None:
    """Against the closed form of the heat exchanger: what the file says, and what is set instead."""
    table, picture = tmp_path / "x.csv", tmp_path / "x.svg"
    simulate = ["ssp", "simulate", str(system), "--stop-time", "3", "--step-size", "1", "--in-process"]
    assert "3 steps to t = 3 s, every 1 s." in said(*simulate, "--out", str(table), "--plot", str(picture))
    assert picture.read_text(encoding="utf-8").startswith("<?xml")
    rows = np.genfromtxt(table, delimiter=",", names=True)
    np.testing.assert_allclose(rows["time"], [0.0, 1.0, 2.0, 3.0])
    assert rows["outlet"][-1] == pytest.approx(20.0 + 60.0 * -np.expm1(-6100.0 / 4186.0), rel=1e-14)
    for number, name in enumerate(("conductance", "heat_exchanger.conductance")):
        again = tmp_path / f"{number}.nc"
        values = ["--set", "mass_flow=0.5", "--set", f"{name}=5000"]
        said(*simulate, *values, "--out", str(again))
        with xr.open_dataset(again, engine="h5netcdf") as data:
            outlet = float(data["observation"].sel(observation_name="outlet")[-1])
            assert data.attrs["fmu"] == "x.ssp"
        assert outlet == pytest.approx(20.0 + 60.0 * -np.expm1(-5000.0 / (4186.0 * 0.5)), rel=1e-14)
    assert "no parameter or input" in refused(*simulate, "--set", "heat_exchanger.outlet=1")
    assert "asks for linear interpolation of inputs, but no component" in refused(
        *simulate, "--interpolation", "linear"
    )


def test_what_nothing_takes_is_a_warning(system: Path, tmp_path: Path) -> None:
    end = "</ssm:ParameterMapping>"
    more = f'<ssm:MappingEntry source="conductance" target="heat_exchanger.baffle" />{end}'
    file = str(changed(system, tmp_path / "more.ssp", **{end: more}))
    for command in (("check", file), ("simulate", file, "--stop-time", "1", "--in-process")):
        told = " ".join(said("ssp", *command).split())
        assert f"warning: {file} sets parameters that nothing takes: heat_exchanger.baffle; correct" in told
    assert json.loads(said("ssp", "check", file, "--json"))["unused"] == ["heat_exchanger.baffle"]


def test_a_misspelt_parameter_is_not_flown(folder: Path, system: Path, tmp_path: Path) -> None:
    """The nearest name is said; what another entry gives is not missed."""
    end = "</ssm:ParameterMapping>"
    more = "".join(
        f'<ssm:MappingEntry source="{source}" target="heat_exchanger.{target}" />'
        for source, target in (("conductance", "conductanse"), ("cold", "wall_temperature"))
    )
    file = changed(system, tmp_path / "misspelt.ssp", **{end: more + end})
    named = (
        f"{file} sets parameters that nothing takes: "
        "heat_exchanger.conductanse (did you mean 'heat_exchanger.conductance'?)"
    )
    assert f"warning: {named}" in " ".join(said("ssp", "check", str(file)).split())
    out = tmp_path / "run"
    scenario = str(folder / "fouling.toml")
    error = refused("run", str(file), "--scenario", scenario, "--out", str(out), "-q")
    assert named in " ".join(error.split())
    assert len(error.strip().splitlines()) == 1
    assert not out.exists()


def test_the_words_of_ssp_2_are_read(system: Path, tmp_path: Path) -> None:
    """The numbers of FMI 3, metadata and the version; what 1.0 has no word for is refused."""
    meta = '<ssc:MetaData kind="general" type="text/plain" source="note.txt" />'
    words = {
        'version="1.0" name=': 'version="2.0" name=',
        "ssc:Real": "ssc:Float64",
        "ssv:Real": "ssv:Float64",
        "</ssd:SystemStructureDescription>": f"{meta}</ssd:SystemStructureDescription>",
    }
    newer = changed(system, tmp_path / "newer.ssp", **words)
    tables = []
    for number, file in enumerate((system, newer)):
        tables.append(tmp_path / f"{number}.csv")
        arguments = ["--out", str(tables[-1]), "--step-size", "0.25", "--in-process"]
        said("ssp", "simulate", str(file), *arguments)
    assert tables[0].read_bytes() == tables[1].read_bytes()
    for what, by, sentence in (
        ("<ssc:Float64 />", '<ssc:Float64 /><ssd:Dimension size="2" />', "has an array"),
        ("<ssc:Float64 />", "<ssc:Clock />", "has a clock"),
        ('kind="parameter"', 'kind="structuralParameter"', "a connector of the kind structuralParameter"),
        (' source="resources/heat_exchanger.fmu"', "", "'heat_exchanger' without a source"),
    ):
        bad = changed(newer, tmp_path / "bad.ssp", **{what: by})
        error = refused("ssp", "simulate", str(bad))
        assert sentence in error
        assert len(error.strip().splitlines()) == 1


def test_a_strain_library_cannot_be_exported(folder: Path, library_file: Path, tmp_path: Path) -> None:
    from scenarios import scenario_files

    text = scenario_files()["level_turns"].read_text(encoding="utf-8")
    flown, after = text.index("[asset]"), text.index("[calibration]")
    library = f'[asset]\nkind = "strain_library"\nfile = "{library_file}"\n\n[belief]\nkind = "asset"\n\n'
    text = text[:flown] + library + text[after:]
    path = tmp_path / "library.toml"
    path.write_text(text, encoding="utf-8")
    assert "only FMUs can be exported" in refused(
        "ssp", "export", str(path), "--out", str(tmp_path / "x.ssp")
    )


@pytest.mark.slow
@pytest.mark.xdist_group("wing")
def test_the_wing_of_a_design(tmp_path: Path) -> None:
    ssp = str(tmp_path / "wing.ssp")
    said("ssp", "export", "uav_wing", "--out", ssp)
    assert "evaluated in the order uav_wing (uav_wing)" in said("ssp", "check", ssp)
