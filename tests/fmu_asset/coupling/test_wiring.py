"""What cannot be joined is said in one sentence; units and types of connections."""

from dataclasses import replace
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


UNJOINED: list[tuple[list[tuple[str, str]], str]] = [
    ([("damage.z3", "wing.health.z1")], r"'damage' \(damage_growth.fmu\) has no variable 'z3'\."),
    ([("damage.z1", "wing.helth.z1")], r"no variable 'helth.z1'; did you mean 'health.z1'"),
    ([("pull", "wing.load_factor")], "no connector 'pull'; it has push, seen, percent"),
    ([("seen", "wing.load_factor")], "connector 'seen' of the system is of the kind output"),
    ([("push", "seen")], "joins two connectors of the system"),
    ([("wing.load_factor", "damage.load_factor")], "factor cannot be the source.*declared as input"),
    ([("damage.z1", "wing.strain[1]")], r"wing.strain\[1\] cannot be the target.*declared as output"),
    ([("push", "wing.young_modulus_factor")], "as parameter.*a single number is needed as input"),
    (
        [("damage.z1", "wing.health.z1"), ("damage.z2", "wing.health.z1")],
        "wing.health.z1 has two sources, damage.z1 and damage.z2",
    ),
    ([("gauges.received[1]", "wing.load_factor")], "type Boolean and cannot feed.*of the type Real"),
    ([("wing.tip_displacement", "wing.load_factor")], "in 'm' and wing.load_factor in '1'.*no conversion"),
    ([("damage.status", "wing.load_factor")], "of the type Enumeration and cannot feed.*Real"),
]
UNSET: list[tuple[str, dict[str, Setting], str]] = [
    ("damage", {"rate.z9": Setting(1.0)}, "no variable 'rate.z9'"),
    ("damage", {"z1": Setting(1.0)}, "damage.z1 cannot be set: it is declared as output"),
    ("damage", {"seed": Setting(1.5)}, "damage.seed cannot be set to 1.5: it is of the type Integer"),
    ("damage", {"seed": Setting(True)}, "cannot be set to True"),
    ("damage", {"level": Setting(float("nan"))}, "cannot be set to nan"),
    ("damage", {"period": Setting(1.0, "m")}, "is given in 'm', but it is in 's'"),
    ("wing", {"response": Setting("quick")}, "with the items quasi_static, transient"),
    ("wing", {"mass.servo": Setting("heavy")}, "a number is needed"),
]


def test_what_does_not_fit_is_one_sentence(base, tmp_path) -> None:
    first = base.components[0]
    refused: list[tuple[dict[str, Any], type[Exception], str]] = [
        *(({"connections": tuple(link(*pair) for pair in ends)}, CouplingError, w) for ends, w in UNJOINED),
        *(
            ({"components": (replace(base.component(name), settings=given),)}, CouplingError, words)
            for name, given, words in UNSET
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


UNBOUND: list[tuple[str, tuple[str, str], str]] = [
    ("control", ("pull", "1"), "'pull', which is not a variable of the system base"),
    ("control", ("percent", "1"), "of causality input, but 'percent' is declared as output"),
    ("control", ("wing.health.z1", "1"), "is declared as an input that is fed by a connection already"),
    ("control", ("wing.strain[1]", "1"), "declared as output"),
    ("control", ("push", "m"), "control.x is in 'm', but the FMU has 'push' in '1'"),
    ("observation", ("seen", "1"), "'seen' is declared as connected to nothing"),
    ("observation", ("wing.load_factor", "1"), "declared as input"),
    ("observation", ("percent", "s"), "and there is no conversion"),
    ("parameter", ("push", "1"), "of causality parameter, but 'push' is declared as input"),
    ("parameter", ("wing.load_factor", "1"), "parameter, but 'wing.load_factor' is declared as input"),
    ("monitor", ("wing.load", "1"), "which is not a variable of the system base; did you mean"),
]


def test_bindings_that_do_not_fit(base) -> None:
    ends = ("push", "wing.load_factor"), ("damage.z1", "wing.health.z1"), ("damage.z1", "percent")
    wiring = Wiring(replace(base, connections=tuple(link(*pair) for pair in ends)))
    observed = {"y": ("damage.z1", "1")}
    for role, end, words in UNBOUND:
        given = (
            {"observation": {"x": end}}
            if role == "observation"
            else {"observation": observed, role: {"x": end}}
        )
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
