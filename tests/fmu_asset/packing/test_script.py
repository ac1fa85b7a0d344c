"""Model scripts packed as FMUs: alike to the byte, valid, with units; and what cannot be packed."""

from __future__ import annotations

from pathlib import Path

import pytest
from fmpy.validation import validate_fmu

from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.door.binding import parse_binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import BindingError, FmuBuildError, FmuInputError
from fmu_asset.packing.script import build_script_fmu, script_fmu
from scenarios import asset_scripts, binding_files

PUMP = asset_scripts()["gear_pump"]


@pytest.fixture(scope="module")
def pump(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_script_fmu(PUMP, tmp_path_factory.mktemp("pump") / "pump.fmu").path


def test_equal_scripts_give_equal_bytes_and_others_another_guid(pump: Path, tmp_path: Path) -> None:
    assert script_fmu(PUMP)[0] == pump.read_bytes()
    other = tmp_path / "gear_pump.py"
    other.write_text(PUMP.read_text(encoding="utf-8").replace("AMBIENT = 40.0", "AMBIENT = 41.0"))
    changed = build_script_fmu(other, tmp_path / "other.fmu")
    assert read_fmu(changed.path).guid != read_fmu(pump).guid
    assert not list(tmp_path.glob("__pycache__"))


def test_the_model_description_is_valid_and_has_units_and_ranges(pump: Path) -> None:
    assert validate_fmu(str(pump)) == []
    description = read_fmu(pump)
    variables = {variable.name: variable for variable in description.variables}
    assert {name: variables[name].unit for name in ("flow", "torque", "temperature", "speed", "wear")} == {
        "flow": "L/min", "torque": "N.m", "temperature": "degC", "speed": "1/min", "wear": "1",
    }  # fmt: skip
    assert (variables["wear"].minimum, variables["wear"].maximum) == (0.0, 1.0)


def test_units_of_a_list_are_converted_each_on_its_own(pump: Path) -> None:
    table = {
        "binding": {"name": "si", "step_size": 1.0},
        "control": {"speed": {"variable": "speed", "unit": "1/s"}},
        "observation": {
            "all": {"variables": ["temperature", "filter_pressure", "flow"], "unit": ["K", "Pa", "L/min"]}
        },
    }
    with FmiAsset(pump, binding_files()["gear_pump"]) as asset:
        flow, _, temperature, drop = asset.step({"speed": 1500.0}).values
    with FmiAsset(pump, parse_binding(table)) as asset:
        assert asset.step({"speed": 25.0}).values == pytest.approx([temperature + 273.15, 1e5 * drop, flow])
    table["observation"]["all"]["unit"] = ["K", "Pa"]  # type: ignore[index]
    with pytest.raises(BindingError, match=r"one for each of the 3 variables, and 2 came"):
        parse_binding(table)


def test_out_of_range_and_no_steady_operation_are_refused(pump: Path) -> None:
    with FmiAsset(pump, binding_files()["gear_pump"]) as asset:
        with pytest.raises(FmuInputError, match=r"wear = 1\.5 lies outside"):
            asset.step(health={"wear": 1.5})
        with pytest.raises(Exception, match="cannot hold the oil below 120 C"):
            asset.step({"speed": 2500.0, "pressure": 210.0}, {"wear": 1.0})
        assert asset.step({"speed": 1500.0, "pressure": 150.0}, {"wear": 0.0}).values[0] == pytest.approx(
            23.03, abs=0.01
        )


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("gear-pump.py", "", "name is an identifier"),
        ("missing.py", None, "cannot be read"),
        ("empty.py", "x = 1", "must define one subclass of pythonfmu's Fmi2Slave, and it defines none"),
        ("broken.py", "import nowhere_to_be_found", "cannot be run: ModuleNotFoundError"),
        ("units.py", "unit", "gives u in furlong, which its unit_table does not have"),
        ("table.py", "table", "has v, which the model does not register"),
        ("raising.py", "raise", "cannot be instantiated: ValueError"),
    ],
)
def test_what_cannot_be_packed_is_said_in_one_sentence(
    tmp_path: Path, name: str, text: str | None, words: str
) -> None:
    model = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Real
class Model(Fmi2Slave):
    unit_table = {"m": {"m": 1}}
    variable_table = {TABLE}
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.u = 0.0
        self.register_variable(Real("u", causality=Fmi2Causality.input))
        EXTRA
    def do_step(self, current_time, step_size):
        return True
"""
    tables = {
        "unit": '"u": ("input", "furlong", None, None, None, "")',
        "table": '"v": ("input", "m", None, None, None, "")',
        "raise": "",
    }
    if text in tables:
        extra = "raise ValueError('no')" if text == "raise" else "pass"
        text = model.replace("TABLE", tables[text]).replace("EXTRA", extra)
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(FmuBuildError, match=words):
        build_script_fmu(tmp_path / name, tmp_path / "x.fmu")
    assert not (tmp_path / "x.fmu").exists()


def test_an_existing_file_is_kept(pump: Path) -> None:
    with pytest.raises(FmuBuildError, match="exists"):
        build_script_fmu(PUMP, pump)
