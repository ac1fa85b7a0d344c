"""What cannot be joined is said in one sentence; units and types of connections."""

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.structure import Component, Connection, Connector, Setting, SystemStructure
from fmu_asset.coupling.structure import expand_connection as expand
from fmu_asset.coupling.wiring import Wiring
from fmu_asset.errors import CouplingError, FmuFileError
from tests.fmu_asset.making import bound
from tests.fmu_asset.ours import OurFmus

FILES = {"damage": "damage_growth", "wing": "python", "gauges": "strain_gauges", "spring": "spring_mass"}


@pytest.fixture(scope="module")
def base(ours: OurFmus) -> SystemStructure:
    ends = Connector("push", "input"), Connector("seen", "output"), Connector("percent", "output", "%")
    return SystemStructure("base", tuple(Component(name, ours(file)) for name, file in FILES.items()), ends)


def link(source: str, target: str, **options: Any) -> Connection:
    return replace(expand(source, target, tuple(FILES))[0], **options)


REFUSED = tomllib.loads(Path(__file__).with_name("refused.toml").read_text("utf-8"))


def test_what_does_not_fit_is_one_sentence(base, tmp_path) -> None:
    first = base.components[0]
    refused: list[tuple[dict[str, Any], type[Exception], str]] = [
        *(
            ({"connections": tuple(link(*pair) for pair in ends)}, CouplingError, words)
            for ends, words in REFUSED["unjoined"]
        ),
        *(
            (
                {"components": (replace(base.component(name), settings={key: Setting(*value)}),)},
                CouplingError,
                w,
            )
            for name, key, value, w in REFUSED["unset"]
        ),
        ({"components": ()}, CouplingError, "has no component"),
        ({"components": (*base.components, first)}, CouplingError, "two components named 'damage'"),
        ({"components": (Component("a", tmp_path / "none.fmu"),)}, FmuFileError, r"no FMU .*none\.fmu"),
        ({"components": (replace(first, substeps=0),)}, CouplingError, "at least one step"),
    ]
    for changes, kind, words in refused:
        with pytest.raises(kind, match=words) as caught:
            Wiring(replace(base, **changes))
        assert "\n" not in str(caught.value)
    for source, target, sentence in (
        ("wnig.strain", "a.x", r"'wnig\.strain' begins with no component; the components are a, b"),
        ("a.x[{1..3}]", "b.y[{1..2}]", "joins 3 ends to 2"),
        ("a.x[{3..1}]", "b.y[{1..2}]", "is empty or longer"),
    ):
        with pytest.raises(CouplingError, match=sentence):
            expand(source, target, ["a", "b"])


def test_units_and_types_are_converted(base) -> None:
    """The value of a connection is converted first, and transformed in the unit of the target."""
    seen = link("wing.tip_displacement", "seen", factor=2.0, offset=0.5)
    for options, conversion in (
        ({}, (100.0, 0.0)),
        ({"factor": 0.5, "offset": 0.1}, (50.0, 0.1)),
        ({"convert_units": False}, (1.0, 0.0)),
    ):
        joined = (link("damage.z1", "percent", **options), link("damage.z1", "wing.health.z1"), seen)
        wiring = Wiring(replace(base, connections=joined))
        assert wiring.ends["percent"][0].conversion == conversion
        assert next(iter(wiring.feeds.values())).conversion == (1.0, 0.0)
        assert (wiring.ends["seen"][0].conversion, wiring.units["seen"]) == ((2.0, 0.5), "m")
    given = {"mass.servo": Setting(150.0, "g"), "response": Setting("transient"), "health.z1": Setting(0.2)}
    wiring = Wiring(replace(base, components=(replace(base.component("wing"), settings=given),)))
    assert wiring.settings["wing"] == {"mass.servo": pytest.approx(0.15), "response": 2.0, "health.z1": 0.2}
    # An enumeration and an integer feed each other.
    joined = Wiring(replace(base, connections=(link("damage.status", "spring.misbehaviour"),)))
    assert next(iter(joined.feeds.values())).conversion == (1.0, 0.0)


def test_an_input_that_is_only_set_keeps_its_value(base) -> None:
    """A start value of an input that nothing feeds holds; without one it is the FMU's own."""
    wing, shown = base.component("wing"), []
    for given in ({"health.z1": Setting(0.4)}, {}):
        structure = replace(base, components=(replace(wing, settings=given),))
        binding = bound(1.0, {"tip": ("wing.tip_displacement", "mm")})
        with CoupledAsset(structure, binding, isolated=False) as asset:
            shown.append((asset.observe().values[0], asset.step().values[0]))
    assert shown[0][0] == shown[0][1]
    assert shown[0][1] > 1.05 * shown[1][1]


def test_bindings_that_do_not_fit(base) -> None:
    ends = ("push", "wing.load_factor"), ("damage.z1", "wing.health.z1"), ("damage.z1", "percent")
    wiring = Wiring(replace(base, connections=tuple(link(*pair) for pair in ends)))
    observed = {"y": ("damage.z1", "1")}
    for role, end, words in REFUSED["unbound"]:
        given = {"observation": observed} | {role: {"x": end}}
        with pytest.raises(ValueError, match=words):
            CoupledAsset(wiring, bound(1.0, **given))
    right = bound(1.0, observed, control={"x": ("push", "1")})
    with pytest.raises(ValueError, match="has no parameter 'q'"):
        CoupledAsset(wiring, right, parameters={"q": 1.0})
    with pytest.raises(ValueError, match="algorithm must be one of gauss_seidel, jacobi"):
        CoupledAsset(wiring, right, algorithm="newton")  # type: ignore[arg-type]
    with (
        CoupledAsset(wiring, right, isolated=False) as asset,
        pytest.raises(ValueError, match="has no control 'pull'; it has x"),
    ):
        asset.step({"pull": 1.0})
