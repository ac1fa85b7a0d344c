"""Binding files: the schema, patterns and units."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmu_asset.archive.declared import UnitInfo, VariableInfo
from fmu_asset.door.binding import Binding, expand, load_binding
from fmu_asset.door.placement import limits_of
from fmu_asset.door.session import FmiAsset
from fmu_asset.door.units import Conversion, conversion
from fmu_asset.errors import BindingError, FmuInputError
from fmu_asset.worker.client import WorkerLimits

GOOD = """
[binding]
name = "asset"
step_size = 1.0
[control.n]
variable = "n"
unit = "1"
[observation.strain]
variables = ["a", "strain[{9..11}]"]
unit = "1"
[observation.tip]
variables = "tip"
unit = "mm"
"""


def read(tmp_path: Path, text: str) -> Binding:
    path = tmp_path / "binding.toml"
    path.write_text(text, encoding="utf-8")
    return load_binding(path)


def test_shipped_binding(binding: Binding) -> None:
    assert binding.name == "uav_wing"
    assert list(binding.control) == ["load_factor"]
    assert list(binding.health) == ["z1", "z2"]
    assert binding.observation_variables == tuple(f"strain[{i}]" for i in range(1, 25))


def test_observations_keep_their_order(tmp_path: Path) -> None:
    binding = read(tmp_path, GOOD)
    assert binding.observation_variables == ("a", "strain[9]", "strain[10]", "strain[11]", "tip")
    assert binding.observation_slice("tip") == slice(4, 5)
    with pytest.raises(BindingError, match="no observation 'x'; it has strain, tip"):
        binding.observation_slice("x")


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("step_size", "step_sise", r"'binding\.step_sise' is not a key of a binding|'binding\.step_size'"),
        ("step_size = 1.0", "step_size = 0.0", r"binding\.step_size: "),
        ("step_size = 1.0", "step_size = nan", r"binding\.step_size: "),
        ("step_size = 1.0", 'step_size = "1"', r"binding\.step_size: "),
        ("step_size = 1.0", 'step_size = 1.0\nfmi_version = "4.0"', r"binding\.fmi_version: "),
        ("[control.n]", "[controll.n]", r"'controll' is not a key of a binding"),
        ('variable = "n"\n', "", r"'control\.n\.variable' is missing"),
        ('unit = "mm"', "", r"'observation\.tip\.unit' is missing"),
        ("{9..11}", "{11..9}", r"the range of .* is empty"),
        ("{9..11}", "{1..2}{1..2}", r"more than one range"),
        ('variable = "n"', "variable = 3", r"control\.n\.variable: "),
        ("[control.n]", "[control.n", r"not valid TOML"),
        ("step_size = 1.0", "step_size = 1.0\ndecimation = 0", r"binding\.decimation: "),
        ("step_size = 1.0", 'step_size = 1.0\nstate = "lost"', r"binding\.state: "),
        ("step_size = 1.0", 'step_size = 1.0\ninterface = "x"', r"binding\.interface: "),
        ('"n"', '"n"\nminimum = 2.0\nmaximum = 1.0', r"control\.n: minimum 2 is larger than maximum 1"),
        ("[control.n]", "[limits]\nmemory = 0.0\n[control.n]", r"limits\.memory: "),
        ("[control.n]", "[limits]\nspeed = 1.0\n[control.n]", r"'limits\.speed' is not a key of a binding"),
        ("[control.n]", "[record]\nvariables = [1]\n[control.n]", r"record\.variables\[1\]: "),
        ("[control.n]", '[load.m]\nvariable="n"\nunit="1"\n[control.n]', "set by both"),
    ],
)
def test_bad_files_are_one_sentence(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    assert old in GOOD
    with pytest.raises(BindingError, match=sentence) as caught:
        read(tmp_path, GOOD.replace(old, new))
    assert "\n" not in str(caught.value)
    assert "binding.toml" in str(caught.value)


def test_missing_or_unreadable_file(tmp_path: Path) -> None:
    with pytest.raises(BindingError, match="cannot be read: No such file"):
        load_binding(tmp_path / "none.toml")
    path = tmp_path / "x.toml"
    for content, sentence in (
        (b"\xff\xfe", "not text in UTF-8"),
        (b"x = " + 20_000 * b"[" + 20_000 * b"]", r"x\.toml"),
        (b'[binding]\nname = "a"\nstep_size = 1.0\n', r"no \[observation"),
    ):
        path.write_bytes(content)
        with pytest.raises(BindingError, match=sentence):
            load_binding(path)


@given(st.integers(0, 500), st.integers(0, 50))
def test_patterns_count(first: int, more: int) -> None:
    names = expand(f"x[{{{first}..{first + more}}}].y")
    assert names == tuple(f"x[{i}].y" for i in range(first, first + more + 1))


def variable(unit: str | None) -> VariableInfo:
    return VariableInfo("v", 0, causality="input", unit=unit)


SI = (0, 0, 0, 0, 0, 0, 0, 0)
KELVIN = (0, 0, 0, 0, 1, 0, 0, 0)
DEFINED = (
    UnitInfo("1", SI, 1.0, 0.0, (("microstrain", 1e6, 0.0),)),
    UnitInfo("K", KELVIN, 1.0, 0.0, (("degC", 1.0, -273.15),)),
    UnitInfo("degF", KELVIN, 5 / 9, 459.67 * 5 / 9, ()),
)


@pytest.mark.parametrize(
    ("unit", "of_fmu", "value", "in_fmu"),
    [
        ("microstrain", "1", 2500.0, 2.5e-3),
        ("percent", "1", 40.0, 0.4),
        ("degC", "K", 20.0, 293.15),
        ("degF", "K", 68.0, 293.15),
        ("mm", "m", 12.0, 0.012),
        ("anything", None, 3.0, 3.0),
    ],
)
def test_units_convert_both_ways(unit: str, of_fmu: str | None, value: float, in_fmu: float) -> None:
    scale = conversion(unit, variable(of_fmu), DEFINED, where="here")
    assert scale.to_fmu(value) == pytest.approx(in_fmu, rel=1e-12)
    assert scale.from_fmu(in_fmu) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(("unit", "of_fmu"), [("N", "1"), ("m", "K"), ("bushel", "1"), ("1", "bushel")])
def test_units_that_do_not_fit(unit: str, of_fmu: str) -> None:
    with pytest.raises(BindingError, match=rf"here is in '{unit}', but the FMU has 'v' in '{of_fmu}'"):
        conversion(unit, variable(of_fmu), DEFINED, where="here")


@given(st.floats(1e-6, 1e6), st.floats(-1e3, 1e3), st.floats(-1e6, 1e6))
def test_conversions_are_inverse(factor: float, offset: float, value: float) -> None:
    scale = Conversion(factor, offset)
    there_and_back = scale.from_fmu(scale.to_fmu(value))
    assert there_and_back == pytest.approx(value, rel=1e-9, abs=1e-9 * (1.0 + abs(offset) / factor))


def test_ranges_of_the_binding_narrow_those_of_the_fmu(fmu: Path, binding: Binding) -> None:
    def limited(**limits: float) -> Binding:
        load_factor = binding.control["load_factor"].model_copy(update=limits)
        return binding.model_copy(update={"control": {"load_factor": load_factor}})

    asset = FmiAsset(fmu, limited(minimum=1.0, maximum=3.0))
    assert asset.input_range("control", "load_factor") == (1.0, 3.0)
    with asset, pytest.raises(FmuInputError, match=r"control\.load_factor = 3\.5 lies outside .* 1 to 3"):
        asset.step({"load_factor": 3.5})
    with pytest.raises(BindingError, match=r"The range of control\.load_factor .* lies outside that of"):
        FmiAsset(fmu, limited(minimum=40.0))


def test_limits_come_from_the_caller_then_from_the_binding(binding: Binding) -> None:
    bound = binding.model_copy(update={"limits": WorkerLimits(step_time=3.0, memory=500.0)})
    assert limits_of(bound, None, None, None) == WorkerLimits(step_time=3.0, memory=500.0)
    assert limits_of(bound, 1.0, 2.0, None) == WorkerLimits(step_time=1.0, load_time=2.0, memory=500.0)
    for wrong in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(FmuInputError, match="memory_limit must be a positive number of MiB"):
            limits_of(bound, None, None, wrong)
