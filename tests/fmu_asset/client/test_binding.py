"""Binding files: the schema, patterns, units, ranges; and a drafted one can be flown as it is."""

import dataclasses
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fmu_asset.archive.declared import FmuDescription, UnitInfo, VariableInfo
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.client.binding import Binding, load_binding, parse_binding
from fmu_asset.client.draft import draft_binding
from fmu_asset.client.exchange import Exchange
from fmu_asset.client.experiment import default_experiment
from fmu_asset.client.instance_host import worker_limits
from fmu_asset.client.session import FmiAsset
from fmu_asset.client.units import Conversion, contradictions, conversion, same_dimension
from fmu_asset.errors import BindingError, FmuInputError
from fmu_asset.worker.client import WorkerLimits
from reporting import units
from reporting.units import Meaning, exact_meaning, meaning_of
from tests.fmu_asset.client.kinds import WING_BINDING
from tests.fmu_asset.making import MODELS, changed, tables
from tests.refusals import refused

HERE = Path(__file__).parent
GOOD = (HERE / "good.toml").read_text("utf-8")
REFUSED = tables(__file__)["refused"]
UNITS = tables(__file__, "unit_texts")


def drafted(fmu: Any, **options: Any) -> Binding:
    return parse_binding(tomllib.loads(draft_binding(fmu, **options)))


# ---------------------------------------------------------------------- files


@pytest.mark.parametrize("case", REFUSED, ids=lambda case: case["sentence"])
def test_bad_files_are_one_sentence(tmp_path, case) -> None:
    assert case["old"] in GOOD
    path = tmp_path / "binding.toml"
    path.write_text(GOOD.replace(case["old"], case["new"]), encoding="utf-8")
    with refused(BindingError, case["sentence"]) as caught:
        load_binding(path)
    assert "binding.toml" in str(caught.value)


def test_limits_come_from_the_caller_then_from_the_binding() -> None:
    limited = changed(WING_BINDING, limits={"step_time": 3.0, "memory": 500.0})
    assert worker_limits(limited, None, None, None) == WorkerLimits(step_time=3.0, memory=500.0)
    assert worker_limits(limited, 1.0, 2.0, None) == WorkerLimits(step_time=1.0, load_time=2.0, memory=500.0)
    for wrong in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(FmuInputError, match=r"the limits of the worker: memory: .*, but .* came"):
            worker_limits(limited, None, None, wrong)


# ---------------------------------------------------------------------- units

SI = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


def si(**exponents: int) -> tuple[int, ...]:
    return tuple(exponents.get(symbol, 0) for symbol in SI)


KELVIN = si(K=1)
DEFINED = (
    UnitInfo("1", si(), 1.0, 0.0, (("microstrain", 1e6, 0.0),)),
    UnitInfo("K", KELVIN, 1.0, 0.0, (("degC", 1.0, -273.15),)),
    UnitInfo("degF", KELVIN, 5 / 9, 459.67 * 5 / 9, ()),
)


@pytest.mark.parametrize("unit", UNITS["unit"], ids=lambda unit: unit["text"])
def test_unit_texts_mean_what_is_defined(unit) -> None:
    factor = pytest.approx(unit["factor"] / unit.get("divisor", 1.0), rel=1e-12)
    assert meaning_of(unit["text"]) == Meaning(si(**unit["of"]), factor, unit.get("offset", 0.0))


def test_units_that_pint_is_not_asked_for_mean_what_it_says():
    for unit in units._COMMON_UNITS:
        exponents, factor, offset = exact_meaning(unit)
        assert meaning_of(unit) == Meaning(exponents, float(factor), float(offset)), unit


def test_other_texts_mean_nothing() -> None:
    for text in (*UNITS["nothing"], "(" * 3000 + "m" + ")" * 3000):
        assert meaning_of(text) is None, text


def test_dimensions_are_compared_and_contradictions_told() -> None:
    pairs = ("kN", "lbf"), ("N", "m"), ("blorp", "m")
    assert [same_dimension(*pair) for pair in pairs] == [True, False, None]
    sound = UnitInfo("kN", si(kg=1, m=1, s=-2), 1e3, 0.0, ())
    unusual, open_one = UnitInfo("blorp", si(m=3), 0.035, 0.0, ()), UnitInfo("K", None, 1, 0, ())
    # Radians come and go in FMUs, and nobody means anything by it.
    turning = UnitInfo("rad/s", si(s=-1), 1.0, 0.0, ())
    assert contradictions([sound, unusual, open_one, turning]) == []
    lying = UnitInfo("kN", si(kg=1, m=1, s=-2), 1.0, 0.0, ())
    told = contradictions([lying, UnitInfo("m", si(kg=1), 1.0, 0.0, ())])
    assert ["usual are 1000" in text for text in told] == [True, False]
    assert ["another dimension" in text for text in told] == [False, True]


@pytest.mark.parametrize(("unit", "of_fmu", "value", "in_fmu"), UNITS["converted"])
def test_units_convert_both_ways(unit, of_fmu, value, in_fmu) -> None:
    scale = conversion(unit, variable("v", "input", unit=of_fmu or None), DEFINED, where="here")
    assert scale.to_fmu(value) == pytest.approx(in_fmu, rel=1e-12)
    assert scale.from_fmu(in_fmu) == pytest.approx(value, rel=1e-12)
    other = Conversion(2.0, 0.5)
    assert scale.then(other).to_fmu(value) == pytest.approx(2.0 * in_fmu + 0.5, rel=1e-12)
    assert other.then(scale).to_fmu(value) == pytest.approx(scale.to_fmu(2.0 * value + 0.5), rel=1e-12)


@pytest.mark.parametrize(("unit", "of_fmu"), UNITS["unfit"])
def test_units_that_do_not_fit(unit, of_fmu) -> None:
    with pytest.raises(BindingError, match=rf"here is in '{unit}', but the FMU has 'v' in '{of_fmu}'"):
        conversion(unit, variable("v", "input", unit=of_fmu), DEFINED, where="here")


# ---------------------------------------------------------------------- drafts


@pytest.mark.parametrize("model", MODELS)
def test_a_draft_flies(foreign_fmu, model, tmp_path) -> None:
    path, file = foreign_fmu(model), tmp_path / "binding.toml"
    file.write_text(draft_binding(read_fmu(path)), encoding="utf-8")
    with FmiAsset(path, file) as asset:
        assert asset.step().values.size >= 1


def test_the_wing_is_drafted_almost_as_it_is_bound(fmu) -> None:
    wing = drafted(read_fmu(fmu))
    assert (wing.control, [*wing.health.values()]) == (WING_BINDING.control, [*WING_BINDING.health.values()])
    assert wing.observation["strain"] == WING_BINDING.observation["strain"]
    assert wing.port["tip"].force.variables == ("tip_force",)
    assert wing.port["tip"].quantities["displacement"].variables == ("tip_displacement",)
    assert "frequency[6]" in wing.record.variables
    assert wing.parameter["damping_alpha"].unit == "1/s"
    for size in (0.0, -1.0, float("nan"), float("inf")):
        for made in (draft_binding, default_experiment):
            with pytest.raises(BindingError, match="must be a positive number of seconds"):
                made(read_fmu(fmu), step_size=size)


def test_roles_units_and_step_size_come_from_the_description(foreign_fmu) -> None:
    room, lag, fixed = (read_fmu(foreign_fmu(model)) for model in ("room2", "lag1", "fixed2"))
    found, text = drafted(room), draft_binding(room)
    assert found.step_size == 60.0
    assert found.load["ambient_t"].unit == "K"
    assert found.control["heater_u_1_p"].unit == "W"
    assert "# Not bindable (texts, clocks, binaries): title" in text
    assert "# 0 to 5000; start 0.0" in text
    assert "the FMU does not say one, choose it" in draft_binding(lag)
    assert "takes this step size only" in draft_binding(fixed)
    assert drafted(lag, step_size=0.3).step_size == 0.3


def description(*variables: VariableInfo) -> FmuDescription:
    return FmuDescription(Path("x.fmu"), model_name="x", variables=variables)


def variable(name: str, causality: str, about: str = "", unit: str | None = None) -> VariableInfo:
    return VariableInfo(name, 0, causality=causality, description=about, unit=unit, start="0")


@settings(max_examples=40)
@given(
    st.lists(st.text(st.characters(codec="utf-8"), min_size=1), min_size=1, max_size=6, unique=True),
    st.text(st.characters(codec="utf-8")),
    st.sampled_from(["input", "output", "parameter", "local"]),
)
def test_any_name_survives_the_draft(names, about, causality) -> None:
    """Quotes, brackets, line ends and the like in names, descriptions and units."""
    there = [variable("y", "output"), *(variable(name, causality, about) for name in names if name != "y")]
    found = drafted(description(*there))
    names_of = set(Exchange(description(*there), found).binding.observation_variables)
    bound = names_of | {*found.record.variables}
    for role in ("control", "health", "load", "parameter"):
        bound |= {item.variable for item in getattr(found, role).values()}
    if causality != "local":
        assert bound == {item.name for item in there}


@given(st.integers(0, 20), st.integers(1, 20), st.sampled_from(["s[{}]", "s{}", "a.b_{}.c", "{}"]))
def test_numbered_outputs_are_one_observation(first, count, form) -> None:
    names = [form.format(number) for number in range(first, first + count)]
    found = drafted(description(*(variable(name, "output", unit="m") for name in names)))
    assert found.observation_variables == tuple(names)
    assert len(found.observation) == 1


def test_other_units_and_shapes_are_another_observation_and_none_is_none() -> None:
    metres, kelvins = variable("s1", "output", unit="m"), variable("s2", "output", unit="K")
    array = dataclasses.replace(variable("s1", "output"), shape=(3,))
    padded = variable("s01", "output"), variable("s2", "output")
    for first, second in ((metres, kelvins), (array, variable("s2", "output")), padded):
        assert len(drafted(description(first, second)).observation) == 2
    with pytest.raises(BindingError, match="no number that could be observed"):
        draft_binding(description(variable("u", "input")))
