"""Binding files: the schema, patterns, units, ranges; and a drafted one can be flown as it is."""

import dataclasses
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fmu_asset.archive.declared import FmuDescription, UnitInfo, VariableInfo
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.client.binding import Binding, load_binding, parse_binding
from fmu_asset.client.binding_remarks import undeclared_units_sentence, unset_inputs_sentence
from fmu_asset.client.blocks import Blocks
from fmu_asset.client.draft import bindable, draft_binding
from fmu_asset.client.experiment import default_experiment
from fmu_asset.client.instance_host import worker_limits
from fmu_asset.client.session import FmiAsset
from fmu_asset.client.units import Conversion, contradictions, conversion, same_dimension
from fmu_asset.errors import BindingError, FmuInputError
from fmu_asset.worker.client import WorkerLimits
from reporting import units
from reporting.units import SiConversion, conversion_of, exact_conversion
from tests.fmu_asset.client.kinds import WING_BINDING
from tests.fmu_asset.making import MODELS, changed, tables
from tests.refusals import refused

HERE = Path(__file__).parent
GOOD_FILE = (HERE / "good.toml").read_text("utf-8")
REFUSED = tables(__file__)["refused"]
UNITS = tables(__file__, "unit_texts")


def parse_draft(fmu: Any, **options: Any) -> Binding:
    """Return the binding that is drafted for an FMU."""
    return parse_binding(tomllib.loads(draft_binding(fmu, **options)))


def make_variable(
    name: str, causality: str, description: str = "", unit: str | None = None
) -> VariableInfo:
    return VariableInfo(name, 0, causality=causality, description=description, unit=unit, start="0")


def make_description(*variables: VariableInfo) -> FmuDescription:
    return FmuDescription(Path("x.fmu"), model_name="x", variables=variables)


# ---------------------------------------------------------------------- files


@pytest.mark.parametrize("case", REFUSED, ids=lambda case: case["sentence"])
def test_a_bad_file_is_one_sentence(tmp_path, case):
    assert case["old"] in GOOD_FILE
    path = tmp_path / "binding.toml"
    path.write_text(GOOD_FILE.replace(case["old"], case["new"]), encoding="utf-8")

    with refused(BindingError, case["sentence"]) as caught:
        load_binding(path)

    assert "binding.toml" in str(caught.value)


BAD_FILE = """
[binding]
name = "room"
step_size = 60.0
stop_tim = 3.0
[control.power]
variable = "heater"
[load.outside]
variable = "ambient"
unit = 3
"""

UNFIT = """
[binding]
name = "room"
step_size = 60.0
[control.power]
variable = "heatr"
unit = "W"
[load.outside]
variable = "ambient_t"
unit = "m"
[observation.room]
variables = ["nothing", "nobody"]
unit = "degC"
"""


def test_all_faults_of_a_file_are_told_at_once(tmp_path):
    path = tmp_path / "room.toml"
    path.write_text(BAD_FILE, encoding="utf-8")

    with pytest.raises(BindingError) as caught:
        load_binding(path)

    sentence = str(caught.value)
    assert sentence.startswith(f"{path}: ")
    for fault in (
        "'binding.stop_tim' is not a key of a binding; the nearest is `stop_time`",
        "'control.power.unit' is missing",
        "load.outside.unit: ",
    ):
        assert sentence.count(fault) == 1


def test_faults_beside_the_schema_are_told_at_once_with_the_file(tmp_path):
    path = tmp_path / "twice.toml"
    twice = '[load.m]\nvariable = "n"\nunit = "1"\n'
    text = GOOD_FILE[: GOOD_FILE.index("[observation.strain]")] + twice
    path.write_text(text, encoding="utf-8")

    with pytest.raises(BindingError) as caught:
        load_binding(path)

    assert str(caught.value) == (
        f"In {path}, there is no [observation.<name>] table; say what is measured; the FMU "
        "variable 'n' is set by both control.n and load.m; keep one."
    )


def test_all_entries_that_do_not_fit_the_fmu_are_told_at_once_with_the_file(foreign_fmu, tmp_path):
    path = tmp_path / "room.toml"
    path.write_text(UNFIT, encoding="utf-8")

    with refused(BindingError, "3 entries of the binding room") as caught:
        FmiAsset(foreign_fmu("room2"), path)

    message = str(caught.value)
    assert message.count(str(path)) == 1
    assert message.startswith(f"3 entries of the binding room ({path}) do not fit the FMU. ")
    for entry in ("control.power names 'heatr'", "load.outside", "observation.room"):
        assert message.count(f". {entry}") == 1 or message.count(f"? {entry}") == 1


def test_all_quantities_of_ports_that_do_not_fit_the_fmu_are_told_at_once(foreign_fmu, tmp_path):
    port = """
[port.wall]
force = { variables = "pull", unit = "N" }
displacement = { variables = "shift", unit = "mm" }
"""
    path = tmp_path / "room.toml"
    path.write_text(UNFIT + port, encoding="utf-8")

    with refused(BindingError, "5 entries of the binding room") as caught:
        FmiAsset(foreign_fmu("room2"), path)

    assert "port.wall.force names 'pull'" in str(caught.value)
    assert "port.wall.displacement names 'shift'" in str(caught.value)


def test_inputs_that_nobody_sets_are_named_with_their_start_values(room):
    draft = parse_draft(room)
    assert unset_inputs_sentence(room, draft) == ""

    without_load = draft.model_copy(update={"load": {}})
    sentence = unset_inputs_sentence(room, without_load)

    assert "1 input stays at its start value, because nobody sets it: " in sentence
    given_names = {"control": draft.control, "health": draft.health}
    assert sentence == unset_inputs_sentence(room, draft, given_names)


@pytest.mark.parametrize(("unit", "is_named"), [("degC", True), ("mm", True), ("K", False)])
def test_a_variable_without_a_unit_is_named_if_the_binding_has_none_of_si(room, unit, is_named):
    without_units = replace(room, variables=tuple(replace(v, unit=None) for v in room.variables))
    draft = parse_draft(without_units)
    (name, vector) = next(iter(draft.observation.items()))
    in_unit = draft.observation | {name: vector.model_copy(update={"unit": unit})}
    sentence = undeclared_units_sentence(
        without_units, draft.model_copy(update={"observation": in_unit})
    )
    assert (f"{vector.variables[0]} ({unit})" in sentence) == is_named
    assert (sentence != "") == is_named


def test_a_variable_with_a_unit_is_not_doubted(room):
    assert undeclared_units_sentence(room, parse_draft(room)) == ""


LIMITED = changed(WING_BINDING, limits={"step_time": 3.0, "memory": 500.0})


def test_limits_come_from_the_binding():
    limits = worker_limits(LIMITED, None, None, None)

    assert limits == WorkerLimits(step_time=3.0, memory=500.0)


def test_limits_of_the_caller_come_first():
    limits = worker_limits(LIMITED, 1.0, 2.0, None)

    assert limits == WorkerLimits(step_time=1.0, load_time=2.0, memory=500.0)


@pytest.mark.parametrize("memory", [0.0, -1.0, float("nan"), float("inf")])
def test_an_impossible_limit_is_refused(memory):
    with pytest.raises(
        FmuInputError, match=r"the limits of the worker: memory: .*, but .* was given"
    ):
        worker_limits(LIMITED, None, None, memory)


# ---------------------------------------------------------------------- meanings of units

BASE_SYMBOLS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


def exponents_of(**exponents: int) -> tuple[int, ...]:
    """Return the exponents of all base units, given those that are not zero."""
    return tuple(exponents.get(symbol, 0) for symbol in BASE_SYMBOLS)


KELVIN = exponents_of(K=1)
NEWTON = exponents_of(kg=1, m=1, s=-2)


@pytest.mark.parametrize("unit", UNITS["unit"], ids=lambda unit: unit["text"])
def test_unit_texts_mean_what_is_defined(unit):
    meaning = conversion_of(unit["text"])

    factor = pytest.approx(unit["factor"] / unit.get("divisor", 1.0), rel=1e-12)
    assert meaning == SiConversion(exponents_of(**unit["of"]), factor, unit.get("offset", 0.0))


@pytest.mark.parametrize("unit", units._COMMON_UNITS)
def test_units_that_pint_is_not_asked_for_mean_what_it_says(unit):
    exponents, factor, offset = exact_conversion(unit)

    assert conversion_of(unit) == SiConversion(exponents, float(factor), float(offset))


@pytest.mark.parametrize("text", [*UNITS["nothing"], "(" * 3000 + "m" + ")" * 3000], ids=repr)
def test_other_texts_mean_nothing(text):
    assert conversion_of(text) is None


@pytest.mark.parametrize(
    ("first", "second", "is_same"),
    [("kN", "lbf", True), ("N", "m", False), ("blorp", "m", None)],
)
def test_dimensions_are_compared_if_both_are_known(first, second, is_same):
    assert same_dimension(first, second) is is_same


SOUND_UNITS = {
    "usual": UnitInfo("kN", NEWTON, 1e3, 0.0, ()),
    "unknown": UnitInfo("blorp", exponents_of(m=3), 0.035, 0.0, ()),
    "without exponents": UnitInfo("K", None, 1, 0, ()),
    # Radians come and go in FMUs, and nobody means anything by it.
    "without its radians": UnitInfo("rad/s", exponents_of(s=-1), 1.0, 0.0, ()),
}


@pytest.mark.parametrize("name", SOUND_UNITS)
def test_a_sound_unit_contradicts_nothing(name):
    assert contradictions([SOUND_UNITS[name]]) == []


def test_a_unit_with_an_unusual_factor_contradicts_its_name():
    (sentence,) = contradictions([UnitInfo("kN", NEWTON, 1.0, 0.0, ())])

    assert "usual are 1000" in sentence
    assert "another dimension" not in sentence


def test_a_unit_of_another_dimension_contradicts_its_name():
    (sentence,) = contradictions([UnitInfo("m", exponents_of(kg=1), 1.0, 0.0, ())])

    assert "another dimension" in sentence
    assert "usual are 1000" not in sentence


# ---------------------------------------------------------------------- conversions

DEFINED_UNITS = (
    UnitInfo("1", exponents_of(), 1.0, 0.0, (("microstrain", 1e6, 0.0),)),
    UnitInfo("K", KELVIN, 1.0, 0.0, (("degC", 1.0, -273.15),)),
    UnitInfo("degF", KELVIN, 5 / 9, 459.67 * 5 / 9, ()),
)
"""Units that an FMU defines."""


def convert(unit: str, fmu_unit: str | None) -> Conversion:
    """Return the conversion of a unit of a binding into one of an FMU."""
    variable = make_variable("v", "input", unit=fmu_unit)
    return conversion(unit, variable, DEFINED_UNITS, where="here")


@pytest.mark.parametrize(("unit", "fmu_unit", "value", "fmu_value"), UNITS["converted"])
def test_units_convert_both_ways(unit, fmu_unit, value, fmu_value):
    scale = convert(unit, fmu_unit or None)

    assert scale.to_fmu(value) == pytest.approx(fmu_value, rel=1e-12)
    assert scale.from_fmu(fmu_value) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(("unit", "fmu_unit", "value", "fmu_value"), UNITS["converted"])
def test_conversions_follow_one_another(unit, fmu_unit, value, fmu_value):
    scale = convert(unit, fmu_unit or None)
    other = Conversion(2.0, 0.5)

    scaled_first = scale.then(other).to_fmu(value)
    scaled_last = other.then(scale).to_fmu(value)

    assert scaled_first == pytest.approx(2.0 * fmu_value + 0.5, rel=1e-12)
    assert scaled_last == pytest.approx(scale.to_fmu(2.0 * value + 0.5), rel=1e-12)


@pytest.mark.parametrize(("unit", "fmu_unit"), UNITS["unfit"])
def test_units_that_do_not_fit_are_refused(unit, fmu_unit):
    sentence = rf"here is in '{unit}', but the FMU has 'v' in '{fmu_unit}'"

    with pytest.raises(BindingError, match=sentence):
        convert(unit, fmu_unit)


# ---------------------------------------------------------------------- drafts


@pytest.mark.parametrize("model", MODELS)
def test_a_draft_flies(foreign_fmu, model, tmp_path):
    path = foreign_fmu(model)
    file = tmp_path / "binding.toml"
    file.write_text(draft_binding(read_fmu(path)), encoding="utf-8")

    with FmiAsset(path, file) as asset:
        assert asset.step().values.size >= 1


@pytest.fixture(scope="module")
def wing_draft(fmu) -> Binding:
    return parse_draft(read_fmu(fmu))


def test_inputs_and_strains_of_the_wing_are_drafted_as_they_are_bound(wing_draft):
    assert wing_draft.control == WING_BINDING.control
    assert wing_draft.health == WING_BINDING.health
    assert wing_draft.observation["strain"] == WING_BINDING.observation["strain"]


def test_a_port_of_the_wing_is_drafted(wing_draft):
    tip = wing_draft.port["tip"]

    assert tip.force.variables == ("tip_force",)
    assert tip.quantities["displacement"].variables == ("tip_displacement",)


def test_records_and_parameters_of_the_wing_are_drafted(wing_draft):
    assert "frequency[6]" in wing_draft.record.variables
    assert wing_draft.parameter["damping_alpha"].unit == "1/s"


@pytest.mark.parametrize("size", [0.0, -1.0, float("nan"), float("inf")])
@pytest.mark.parametrize("make", [draft_binding, default_experiment])
def test_an_impossible_step_size_is_refused(fmu, make, size):
    with pytest.raises(BindingError, match="must be a positive number of seconds"):
        make(read_fmu(fmu), step_size=size)


@pytest.fixture(scope="module")
def room(foreign_fmu) -> FmuDescription:
    return read_fmu(foreign_fmu("room2"))


def test_roles_units_and_step_size_come_from_the_description(room):
    draft = parse_draft(room)

    assert draft.step_size == 60.0
    assert draft.load["ambient_t"].unit == "K"
    assert draft.control["heater_u_1_p"].unit == "W"


def test_a_draft_says_what_cannot_be_bound_and_what_a_range_is(room):
    text = draft_binding(room)

    assert "# Not bindable (texts, clocks, binaries): title" in text
    assert "# 0 to 5000; start 0.0" in text


def test_a_step_size_that_the_fmu_does_not_say_is_to_be_chosen(foreign_fmu):
    lag = read_fmu(foreign_fmu("lag1"))

    assert "the FMU does not say one, choose it" in draft_binding(lag)
    assert parse_draft(lag, step_size=0.3).step_size == 0.3


def test_a_draft_says_that_a_step_size_is_fixed(foreign_fmu):
    fixed = read_fmu(foreign_fmu("fixed2"))

    assert "takes this step size only" in draft_binding(fixed)


UNICODE = st.characters(codec="utf-8")


@settings(max_examples=40)
@example(["{0..0}"], "", "input")
@given(
    st.lists(st.text(UNICODE, min_size=1), min_size=1, max_size=6, unique=True),
    st.text(UNICODE),
    st.sampled_from(["input", "output", "parameter", "local"]),
)
def test_any_name_survives_the_draft(names, text, causality):
    """Quotes, brackets, line ends and the like in names, descriptions and units."""
    variables = [make_variable("y", "output")]
    variables += [make_variable(name, causality, text) for name in names if name != "y"]
    description = make_description(*variables)

    draft = parse_draft(description)

    bound = {*Blocks(description, draft).binding.observation_variables}
    bound |= {*draft.record.variables}
    for role in (draft.control, draft.health, draft.load, draft.parameter):
        bound |= {end.variable for end in role.values()}
    # A name that looks like a pattern, such as "{0..0}", cannot be bound.
    bindable_names = {variable.name for variable in variables if bindable(variable)}
    assert causality == "local" or bound == bindable_names


@given(st.integers(0, 20), st.integers(1, 20), st.sampled_from(["s[{}]", "s{}", "a.b_{}.c", "{}"]))
def test_numbered_outputs_are_one_observation(first, count, form):
    names = [form.format(number) for number in range(first, first + count)]
    outputs = [make_variable(name, "output", unit="m") for name in names]

    draft = parse_draft(make_description(*outputs))

    assert draft.observation_variables == tuple(names)
    assert len(draft.observation) == 1


ARRAY = dataclasses.replace(make_variable("s1", "output"), shape=(3,))


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (make_variable("s1", "output", unit="m"), make_variable("s2", "output", unit="K")),
        (ARRAY, make_variable("s2", "output")),
        (make_variable("s01", "output"), make_variable("s2", "output")),
    ],
    ids=["units", "shapes", "numbers of digits"],
)
def test_outputs_that_differ_are_two_observations(first, second):
    assert len(parse_draft(make_description(first, second)).observation) == 2


def test_an_fmu_without_outputs_cannot_be_drafted():
    without_output = make_description(make_variable("u", "input"))

    with pytest.raises(BindingError, match="no number that could be observed"):
        draft_binding(without_output)
