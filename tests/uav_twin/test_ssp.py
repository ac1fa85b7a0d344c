"""`uav-twin ssp` and `run x.ssp` as a user calls them."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fmu_asset.client.binding import load_binding
from tests.command_line import refused, said
from tests.fmu_asset.making import edited, needs_compiler

END = "</ssm:ParameterMapping>"


@pytest.fixture(scope="module")
def system(heat_exchanger: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The heat exchanger as an SSP file."""
    place = tmp_path_factory.mktemp("system") / "x.ssp"
    assert "x.ssp: " in said("ssp", "export", heat_exchanger / "fouling.toml", "--out", place)
    return place


def mapped(*entries: tuple[str, str]) -> tuple[str, str]:
    """What adds entries, sources and targets, to the mapping of parameters."""
    texts = (
        f'<ssm:MappingEntry source="{source}" target="heat_exchanger.{target}" />'
        for source, target in entries
    )
    return END, "".join(texts) + END


IN_STEPS_OF_A_SECOND = ("--stop-time", "3", "--step-size", "1", "--in-process")


def test_the_step_of_a_system_of_one_fmu_is_that_of_its_binding(system, heat_exchanger, tmp_path):
    printed = said("ssp", "simulate", system, "--stop-time", "7200", "--out", tmp_path / "x.csv")
    binding_file = heat_exchanger / "binding.toml"
    step_size = load_binding(binding_file).step_size
    assert f"every {step_size:g} s." in printed
    assert step_size != 7200 / 500


def outlet_temperature(conductance: float, mass_flow: float) -> float:
    """Return the temperature at the outlet of the heat exchanger in closed form, in degrees Celsius."""
    heat_capacity = 4186.0
    return 20.0 + 60.0 * -np.expm1(-conductance / (heat_capacity * mass_flow))


def test_a_system_is_checked(system):
    text = said("ssp", "check", system)
    assert "no problem found; 7 connections, 2 parameters" in text
    assert "evaluated in the order heat_exchanger (HeatExchanger)" in text


def test_a_system_is_simulated_and_drawn_as_it_lies_there(system, tmp_path):
    table, picture = tmp_path / "x.csv", tmp_path / "x.svg"
    words = ("ssp", "simulate", system, *IN_STEPS_OF_A_SECOND, "--out", table, "--plot", picture)
    printed = said(*words)
    rows = np.genfromtxt(table, delimiter=",", names=True)
    assert "3 steps to t = 3 s, every 1 s." in printed
    assert picture.read_text(encoding="utf-8").startswith("<?xml")
    np.testing.assert_allclose(rows["time"], [0.0, 1.0, 2.0, 3.0])
    assert rows["outlet"][-1] == pytest.approx(outlet_temperature(6100.0, 1.0), rel=1e-14)


@pytest.mark.parametrize("name", ["conductance", "heat_exchanger.conductance"])
def test_parameters_of_a_system_are_set(system, tmp_path, name):
    out = tmp_path / "x.nc"
    parameters = ("--set", "mass_flow=0.5", "--set", f"{name}=5000")
    said("ssp", "simulate", system, *IN_STEPS_OF_A_SECOND, *parameters, "--out", out)
    with xr.open_dataset(out, engine="h5netcdf") as data:
        outlet = float(data["observation"].sel(observation_name="outlet")[-1])
        assert data.attrs["fmu"] == "x.ssp"
    assert outlet == pytest.approx(outlet_temperature(5000.0, 0.5), rel=1e-14)


@pytest.mark.parametrize(
    ("option", "value", "sentence"),
    [
        ("--set", "heat_exchanger.outlet=1", "no parameter or input"),
        ("--interpolation", "linear", "asks for linear interpolation of inputs, but no component"),
    ],
)
def test_what_a_system_cannot_do_is_refused(system, option, value, sentence):
    assert sentence in refused("ssp", "simulate", system, *IN_STEPS_OF_A_SECOND, option, value)


def test_a_system_is_flown(heat_exchanger, system, tmp_path):
    out = tmp_path / "run"
    options = ("--out", out, "--in-process", "--no-report", "-q")
    said("run", system, "--scenario", heat_exchanger / "fouling.toml", *options)
    assert (out / "asset" / "system.ssp").read_bytes() == system.read_bytes()
    assert (out / "csv" / "observed.csv").is_file()


@pytest.fixture
def system_with_unused_entry(system: Path, tmp_path: Path) -> Path:
    """The system with an entry of its mapping whose target nothing takes."""
    return edited(system, tmp_path / "more.ssp", mapped(("conductance", "baffle")))


@pytest.fixture
def system_with_misspelt_entry(system: Path, tmp_path: Path) -> Path:
    """The system with a misspelt target, and another one that another entry gives as well."""
    entries = mapped(("conductance", "conductanse"), ("cold", "wall_temperature"))
    return edited(system, tmp_path / "misspelt.ssp", entries)


MEANT = (
    "sets parameters that nothing takes: heat_exchanger.conductanse "
    "(did you mean 'heat_exchanger.conductance'?)"
)


@pytest.mark.parametrize("words", [("check",), ("simulate", "--stop-time", "1", "--in-process")])
def test_what_nothing_takes_is_a_warning(system_with_unused_entry, words):
    file = system_with_unused_entry
    subcommand, *options = words
    printed = " ".join(said("ssp", subcommand, file, *options).split())
    warning = f"{file} sets parameters that nothing takes: heat_exchanger.baffle; correct"
    assert f"warning: {warning}" in printed


def test_what_nothing_takes_is_listed_as_data(system_with_unused_entry):
    record = json.loads(said("ssp", "check", system_with_unused_entry, "--json"))
    assert record["unused"] == ["heat_exchanger.baffle"]


def test_a_misspelt_parameter_is_a_warning_with_the_nearest_one(system_with_misspelt_entry):
    file = system_with_misspelt_entry
    assert f"warning: {file} {MEANT}" in " ".join(said("ssp", "check", file).split())


def test_a_system_with_a_misspelt_parameter_is_not_flown(
    system_with_misspelt_entry, heat_exchanger, tmp_path
):
    file, out = system_with_misspelt_entry, tmp_path / "run"
    options = ("--scenario", heat_exchanger / "fouling.toml", "--out", out, "-q")
    assert f"{file} {MEANT}" in refused("run", file, *options)
    assert not out.exists()


def test_the_words_of_ssp_2_are_read(system, tmp_path):
    """The numbers of FMI 3, metadata and the version; what 1.0 has no word for is refused."""
    meta = '<ssc:MetaData kind="general" type="text/plain" source="note.txt" />'
    words = ('version="1.0" name=', 'version="2.0" name='), ("</ssd:SystemS", f"{meta}</ssd:SystemS")
    numbers = ("ssc:Real", "ssc:Float64"), ("ssv:Real", "ssv:Float64")
    newer = edited(system, tmp_path / "newer.ssp", *words, *numbers)
    tables = [tmp_path / "0.csv", tmp_path / "1.csv"]
    for file, table in zip((system, newer), tables, strict=True):
        said("ssp", "simulate", file, "--out", table, "--step-size", "0.25", "--in-process")
    assert tables[0].read_bytes() == tables[1].read_bytes()
    for what, by, sentence in (
        ("<ssc:Float64 />", '<ssc:Float64 /><ssd:Dimension size="2" />', "has an array"),
        ("<ssc:Float64 />", "<ssc:Clock />", "has a clock"),
        ('kind="parameter"', 'kind="structuralParameter"', "a connector of the kind structuralParameter"),
        (' source="resources/heat_exchanger.fmu"', "", "'heat_exchanger' without a source"),
    ):
        bad = edited(newer, tmp_path / "bad.ssp", (what, by))
        assert sentence in refused("ssp", "simulate", bad)


@pytest.mark.slow
@pytest.mark.xdist_group("wing")
def test_the_wing_of_a_design(tmp_path):
    said("ssp", "export", "uav_wing", "--out", tmp_path / "wing.ssp")
    assert "evaluated in the order uav_wing (uav_wing)" in said("ssp", "check", tmp_path / "wing.ssp")


def members_of_component(system: Path, component: str) -> set[str]:
    """Return the first folders and files inside the FMU of a component of an SSP file."""
    with zipfile.ZipFile(system) as archive:
        content = archive.read(f"resources/{component}.fmu")
    with zipfile.ZipFile(io.BytesIO(content)) as fmu:
        return {name.partition("/")[0] for name in fmu.namelist()} | {*fmu.namelist()}


def has_python(system: Path, component: str) -> bool:
    """Return whether there is Python inside the FMU of a component."""
    return any(name.endswith(".py") for name in members_of_component(system, component))


@pytest.mark.slow
@pytest.mark.xdist_group("wing")
def test_the_fmu_of_a_design_is_exported_with_python_unless_the_user_says_otherwise(tmp_path):
    said("ssp", "export", "three_fmus", "--out", tmp_path / "as_said.ssp")
    assert has_python(tmp_path / "as_said.ssp", "wing")


@pytest.mark.slow
@pytest.mark.xdist_group("wing")
@needs_compiler
def test_a_design_is_exported_compiled_as_the_user_says(tmp_path):
    """A compiled FMU has no Python inside, and other components stay as they are."""
    said("ssp", "export", "uav_wing", "--kind", "compiled", "--out", tmp_path / "wing.ssp")
    said("ssp", "export", "three_fmus", "--kind", "compiled", "--out", tmp_path / "three.ssp")
    assert not has_python(tmp_path / "wing.ssp", "uav_wing")
    parts = [has_python(tmp_path / "three.ssp", component) for component in ("wing", "gauges")]
    assert parts == [False, True]
    assert "no problem found" in said("ssp", "check", tmp_path / "three.ssp")
