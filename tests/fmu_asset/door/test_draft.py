"""A drafted binding can be flown as it is, and says what it guesses."""

from __future__ import annotations

import cProfile
import dataclasses
import itertools
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmu_asset.archive.declared import FmuDescription, VariableInfo
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.door.binding import parse_binding
from fmu_asset.door.draft import draft_binding
from fmu_asset.door.exchange import Exchange
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import BindingError

MODELS = ["lag1", "room2", "fixed2", "array3", "ball2", "decay1", "swing3", "hostile2"]


@pytest.mark.parametrize("model", MODELS)
def test_a_draft_flies(foreign_fmu: Any, model: str, tmp_path: Path) -> None:
    path = foreign_fmu(model)
    file = tmp_path / "binding.toml"
    file.write_text(draft_binding(read_fmu(path)), encoding="utf-8")
    with FmiAsset(path, file) as asset:
        assert asset.step().values.size >= 1


def test_the_wing_is_drafted_almost_as_it_is_bound(fmu: Path) -> None:
    drafted = parse_binding(tomllib.loads(draft_binding(read_fmu(fmu))))
    assert drafted.control["load_factor"].unit == "1"
    assert [item.variable for item in drafted.health.values()] == ["health.z1", "health.z2"]
    assert drafted.observation["strain"].variables == tuple(f"strain[{i}]" for i in range(1, 25))
    assert drafted.port["tip"].force.variables == ("tip_force",)
    assert drafted.port["tip"].quantities["displacement"].variables == ("tip_displacement",)
    assert "frequency[6]" in drafted.record.variables
    assert drafted.parameter["damping_alpha"].unit == "1/s"


def test_roles_units_and_step_size_come_from_the_description(foreign_fmu: Any) -> None:
    text = draft_binding(read_fmu(foreign_fmu("room2")))
    drafted = parse_binding(tomllib.loads(text))
    assert drafted.step_size == 60.0
    assert drafted.load["ambient_t"].unit == "K"
    assert drafted.control["heater_u_1_p"].unit == "W"
    assert "# Not bindable (texts, clocks, binaries): title" in text
    assert "# 0 to 5000; start 0.0" in text
    assert "the FMU does not say one, choose it" in draft_binding(read_fmu(foreign_fmu("lag1")))
    assert "takes this step size only" in draft_binding(read_fmu(foreign_fmu("fixed2")))
    chosen = draft_binding(read_fmu(foreign_fmu("lag1")), step_size=0.3)
    assert parse_binding(tomllib.loads(chosen)).step_size == 0.3


def description(*variables: VariableInfo) -> FmuDescription:
    return FmuDescription(Path("x.fmu"), model_name="x", variables=variables)


def variable(name: str, causality: str, about: str = "", unit: str | None = None) -> VariableInfo:
    return VariableInfo(name, 0, causality=causality, description=about, unit=unit, start="0")


def test_without_an_output_there_is_nothing_to_observe() -> None:
    with pytest.raises(BindingError, match="no number that could be observed"):
        draft_binding(description(variable("u", "input")))


@given(
    st.lists(st.text(st.characters(codec="utf-8"), min_size=1), min_size=1, max_size=6, unique=True),
    st.text(st.characters(codec="utf-8")),
    st.sampled_from(["input", "output", "parameter", "local"]),
)
def test_any_name_survives_the_draft(names: list[str], about: str, causality: str) -> None:
    """Quotes, brackets, line ends and the like in names, descriptions and units."""
    there = [variable("y", "output"), *(variable(name, causality, about) for name in names if name != "y")]
    fmu = description(*there)
    drafted = parse_binding(tomllib.loads(draft_binding(fmu)))
    bound = set(Exchange(fmu, drafted).binding.observation_variables) | {*drafted.record.variables}
    for role in ("control", "health", "load", "parameter"):
        bound |= {item.variable for item in getattr(drafted, role).values()}
    if causality != "local":
        assert bound == {item.name for item in there}


@given(st.integers(0, 20), st.integers(1, 20), st.sampled_from(["s[{}]", "s{}", "a.b_{}.c", "{}"]))
def test_numbered_outputs_are_one_observation(first: int, count: int, form: str) -> None:
    names = [form.format(number) for number in range(first, first + count)]
    fmu = description(*(variable(name, "output", unit="m") for name in names))
    drafted = parse_binding(tomllib.loads(draft_binding(fmu)))
    assert drafted.observation_variables == tuple(names)
    assert len(drafted.observation) == 1


def test_a_draft_takes_twice_as_long_for_twice_as_many_variables() -> None:
    """Names that differ in what a key cannot hold, such as those of another alphabet, as well."""
    counts = []
    for bits in (9, 10):
        names = ["".join(letters) for letters in itertools.product("äö", repeat=bits)]
        causalities = itertools.cycle(["input", "output", "parameter", "local"])
        there = description(*map(variable, names, causalities))
        profile = cProfile.Profile()
        profile.runcall(draft_binding, there)
        counts.append(sum(entry.callcount for entry in profile.getstats()))
    assert counts[1] < 2.2 * counts[0]


def test_other_units_are_another_observation() -> None:
    for first, second in (
        (variable("s1", "output", unit="m"), variable("s2", "output", unit="K")),
        (dataclasses.replace(variable("s1", "output"), shape=(3,)), variable("s2", "output")),
    ):
        drafted = parse_binding(tomllib.loads(draft_binding(description(first, second))))
        assert len(drafted.observation) == 2


@pytest.mark.parametrize("size", [0.0, -1.0, float("nan")])
def test_a_step_size_must_be_positive(fmu: Path, size: float) -> None:
    with pytest.raises(BindingError, match="must be a positive number of seconds"):
        draft_binding(read_fmu(fmu), step_size=size)
