"""SSP files of other makers: nested systems, parameters, mappings, damaged archives."""

import itertools
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from fmu_asset.client.session import FmiAsset
from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.structure import (
    Component,
    ComponentSetting,
    Connection,
    Endpoint,
    SystemStructure,
)
from fmu_asset.coupling.wiring import Wiring
from fmu_asset.errors import CouplingError, SspError
from fmu_asset.ssp.check import check_ssp, join_ssp, left_out_sentence
from fmu_asset.ssp.reader import read_ssp
from tests.fmu_asset.client.kinds import BINDINGS
from tests.fmu_asset.making import archive_of, bound, tables, watch
from tests.fmu_asset.ours import OurFmus

HERE = Path(__file__).parent
CASES = tables(__file__, "cases")
FILES = {
    name: (HERE / "theirs" / name).read_text("utf-8")
    for name in ("SystemStructure.ssd", "top.ssv", "top.ssm")
}
Pack = Callable[..., Path]


@pytest.fixture
def pack(ours: OurFmus, tmp_path: Path) -> Pack:
    """Pack an SSP file by hand; a change is made where its text stands first."""
    wing = ours("python").read_bytes()
    damage = ours("damage_growth").read_bytes()

    def pack_file(*changes: tuple[str, str], without: str = "", **further: str | bytes) -> Path:
        texts = dict(FILES)
        for old, new in changes:
            name = next(name for name, text in texts.items() if old in text)
            texts[name] = texts[name].replace(old, new, 1)
        contents: dict[str, str | bytes] = {
            "SystemStructure.ssd": texts.pop("SystemStructure.ssd"),
            **{f"resources/{name}": text for name, text in texts.items()},
            "resources/wing.fmu": wing,
            "resources/damage growth.fmu": damage,
            **further,
        }
        contents.pop(without, None)
        return archive_of(tmp_path / "theirs.ssp", contents)

    return pack_file


@pytest.fixture
def join(pack: Pack, tmp_path: Path) -> Callable[..., Wiring]:
    """Pack such a file, read it and join its components."""
    number = itertools.count()

    def join_file(*changes: tuple[str, str], **further: str | bytes) -> Wiring:
        path = pack(*changes, **further)
        return join_ssp(read_ssp(path, tmp_path / f"fmus{next(number)}"))

    return join_file


def conversions_at(wiring: Wiring, connector: str) -> dict[str, tuple[float, float]]:
    """Return factor and offset of each end that a connector is joined with."""
    return {str(port.end): port.conversion for port in wiring.ends[connector]}


# ---------------------------------------------------------------------- nested systems


def test_components_of_nested_systems_are_named_by_their_system(join):
    components = [component.name for component in join().structure.components]

    assert components == ["structure.wing", "damage"]


@pytest.mark.parametrize("component", CASES["settings"])
def test_sets_of_the_outer_system_go_before_those_of_the_component(join, component):
    """A value is converted in unit, then scaled."""
    settings = join().settings[component]

    assert settings == pytest.approx(CASES["settings"][component])


def test_a_connection_through_the_border_of_a_system_is_one(join):
    ((target, feed),) = join().feeds.items()

    assert str(feed.end) == "damage.z1"
    assert str(target) == "structure.wing.health.z1"
    assert (feed.conversion, feed.delayed) == ((0.5, 0.0), False)


def test_a_connection_may_be_delayed(join):
    inner = 'startConnector="z" endElement="wing" endConnector="health.z1"'
    delayed = f"{inner}>{CASES['delayed']}</ssd:Connection>"

    wiring = join((f"{inner}/>", delayed))

    assert [feed.delayed for feed in wiring.feeds.values()] == [True]


def test_connectors_convert_units_and_transform(join):
    wiring = join()

    assert conversions_at(wiring, "loss") == {"damage.z1": pytest.approx((100.0, 0.0))}
    assert conversions_at(wiring, "n") == {
        "structure.wing.load_factor": (1.0, 0.0),
        "damage.load_factor": (0.5, 0.25),
    }


def test_a_nested_system_flies_with_its_parameters(join):
    with CoupledAsset(join(), BINDINGS["theirs"], isolated=False) as asset:
        tip, loss, z = asset.step({"n": 2.0}).values
        asset.reset({"e": 1.0})
        stiffer_tip, _, _ = asset.step({"n": 2.0}).values

    assert loss == pytest.approx(0.4)
    assert z == pytest.approx(40.0)
    assert stiffer_tip < tip


def test_a_sound_file_is_checked_with_all_of_its_components(pack):
    check = check_ssp(pack())

    assert check.problems == ()
    assert [name for name, _ in check.components] == ["damage", "structure.wing"]


# ---------------------------------------------------------------------- what means the same


def without_namespaces(text: str) -> str:
    return re.sub(r"ss[mvc]:|xmlns:\w+=\"[^\"]+\"", "", text)


def with_ends_exchanged(text: str) -> str:
    """Exchange start and end of all connections.

    SSP 1.0, section 5.3: the kinds of the connectors say where a value goes, not the ends of the
    connection.
    """
    other = {"start": "end", "end": "start"}
    return re.sub(r"(start|end)(?=Element=|Connector=)", lambda match: other[match[1]], text)


EXCHANGED = with_ends_exchanged(FILES["SystemStructure.ssd"])
SAME_FILES = {
    "start and end exchanged": {"SystemStructure.ssd": EXCHANGED},
    "a set without namespace": {"resources/top.ssv": without_namespaces(FILES["top.ssv"])},
    "a mapping without namespace": {"resources/top.ssm": without_namespaces(FILES["top.ssm"])},
}


def assert_same_system(wiring: Wiring, other: Wiring) -> None:
    assert wiring.structure.connections == other.structure.connections
    assert wiring.settings == other.settings


@pytest.mark.parametrize("case", SAME_FILES)
def test_files_that_mean_the_same_are_read_alike(join, case):
    assert_same_system(join(**SAME_FILES[case]), join())


@pytest.mark.parametrize("row", CASES["same"], ids=lambda row: row["case"])
def test_texts_that_mean_the_same_are_read_alike(join, row):
    assert_same_system(join(*row["changes"]), join())


def test_the_file_with_exchanged_ends_is_another_file():
    assert FILES["SystemStructure.ssd"] != EXCHANGED


# ---------------------------------------------------------------------- where values go


def further_binding(*parameters: tuple[str, str]) -> tuple[str, str]:
    """Return the change that gives the system a second parameter binding.

    It defines another `%` than the first one.
    """
    elements = [
        f'<ssv:Parameter name="{name}">{value}</ssv:Parameter>' for name, value in parameters
    ]
    end_of_bindings = "</ssd:ParameterBindings>\n  <ssd:Elements>"
    return end_of_bindings, CASES["more"] % "".join(elements)


def test_later_bindings_of_a_level_go_before_earlier_ones(join):
    """SSP 1.0, 5.2.3 and 6: a set defines its units."""
    wiring = join(further_binding(("damage.initial.z1", '<ssv:Real value="3" unit="%"/>')))

    assert wiring.settings["damage"]["initial.z1"] == pytest.approx(3 * 0.1)
    assert wiring.settings["damage"]["initial.z2"] == pytest.approx(0.04)
    assert wiring.ends["loss"][0].conversion == (pytest.approx(100.0), 0.0)


def test_a_parameter_of_the_system_goes_to_an_input(join):
    """SSP 1.0, 5.3.2.1, allowed connections."""
    wiring = join(('name="n" kind="input"', 'name="n" kind="parameter"'))

    ends = {str(port.end) for port in wiring.ends["n"]}
    assert ends == {"structure.wing.load_factor", "damage.load_factor"}


def test_a_mapping_transforms_a_value_in_the_unit_of_the_target(join):
    """GTransformationChoice: target = factor * source + offset, the source in the target's unit."""
    transformation = '><ssc:LinearTransformation factor="0.5" offset="0.1"/></ssm:MappingEntry>'

    wiring = join(('target="damage.initial.z1"/>', f'target="damage.initial.z1"{transformation}'))

    assert wiring.settings["damage"]["initial.z1"] == pytest.approx(0.5 * 0.4 + 0.1)


def test_a_mapping_may_name_values_that_its_set_lacks(join, tmp_path):
    """SSP 2.0, 6.2: a mapping may serve several sets."""
    wiring = join(('source="chance"', 'source="luck"'))

    assert {*wiring.left_out} == {"damage.seed"}
    assert "damage.seed (its parameter set has no such value)" in left_out_sentence(
        wiring, tmp_path
    )


def test_start_values_of_outputs_are_set(foreign_fmu):
    """SSP 1.0, 5.2.3: a parameter binding can set everything that starts with a given value."""
    settings = {"h": ComponentSetting(3.0), "v": ComponentSetting(-1.0)}
    ball = Component("ball", foreign_fmu("ball2"), settings)
    binding = bound(0.1, {"h": (["ball.h", "ball.v"], ["m", "m/s"])})

    with CoupledAsset(SystemStructure("one", (ball,)), binding, isolated=False) as asset:
        asset.reset()
        at_start = asset.observe().values.tolist()
        height, _ = asset.step().values

    assert at_start == [3.0, -1.0]
    assert height == pytest.approx(3.0 - 0.1 - 0.5 * 9.81 * 0.01, abs=1e-4)


# ---------------------------------------------------------------------- FMUs of other versions


@pytest.fixture
def mixed(foreign_fmu, tmp_path) -> Wiring:
    """A counter of FMI 3 (UInt16) that drives a lag of FMI 1, which starts elsewhere."""
    contents = {
        "SystemStructure.ssd": (HERE / "theirs" / "mixed.ssd").read_bytes(),
        "resources/counter.fmu": foreign_fmu("array3").read_bytes(),
        "resources/lag.fmu": foreign_fmu("lag1").read_bytes(),
    }
    file = archive_of(tmp_path / "mixed.ssp", contents)
    return join_ssp(read_ssp(file, tmp_path / "fmus"))


def test_fmus_of_other_versions_are_joined(foreign_fmu, mixed):
    """The lag does what it does alone, given the numbers of the counter."""
    with CoupledAsset(mixed, watch("lag.Out1", step_size=0.1), isolated=False) as asset:
        coupled_values = [asset.step().values[0] for _ in range(4)]

    binding = BINDINGS["lag1"].with_header(step_size=0.1, decimation=1)
    with FmiAsset(foreign_fmu("lag1"), binding, isolated=False) as lag:
        values_alone = [lag.step({"speed": float(n)}).values[0] for n in range(1, 5)]

    assert coupled_values == values_alone
    assert coupled_values[-1] > 0.0


def test_an_array_cannot_be_the_source_of_a_single_value(mixed):
    array = Connection(Endpoint("counter", "y"), Endpoint("lag", "In1 (rad/s)"))
    sentence = r"counter\.y cannot be the source .* of the type Float64, and an output of a single"

    with pytest.raises(CouplingError, match=sentence):
        Wiring(replace(mixed.structure, connections=(array,)))


# ---------------------------------------------------------------------- what is wrong

LONG_TEXT = {
    "old": 'name="z1" kind="output"',
    "new": f'name="z1" kind="{"o" * 5000}"',
    "sentence": r"^.{,700}$",
}


@pytest.mark.parametrize(
    "case", [*CASES["refused"], LONG_TEXT], ids=lambda case: case["sentence"][:40]
)
def test_what_is_wrong_is_said_in_one_sentence(pack, case):
    (sentence,) = check_ssp(pack((case["old"], case["new"]))).problems

    assert re.search(case["sentence"], sentence), sentence
    assert "\n" not in sentence


def test_a_damaged_fmu_in_a_file_is_named(pack):
    (sentence,) = check_ssp(pack(**{"resources/wing.fmu": "no FMU"})).problems

    expected = r"resources/wing\.fmu in \S+/theirs\.ssp is not a valid FMU archive"
    assert re.match(expected, sentence)


def test_a_member_outside_of_the_folder_is_refused(pack, tmp_path):
    file = pack(**{"../outside.txt": "x"})

    with pytest.raises(SspError, match="extracted outside its folder"):
        read_ssp(file, tmp_path / "fmus")

    assert not (tmp_path / "fmus").exists()
    assert not (tmp_path.parent / "outside.txt").exists()


def test_an_archive_without_a_description_is_refused(pack, tmp_path):
    file = pack(without="SystemStructure.ssd")

    with pytest.raises(SspError, match="so it is not an SSP file"):
        read_ssp(file, tmp_path / "fmus")

    assert not (tmp_path / "fmus").exists()


def test_half_of_a_file_is_refused(pack, tmp_path):
    """Half of the file ends with one of its FMUs, which is an archive as well."""
    content = pack().read_bytes()
    damaged = tmp_path / "damaged.ssp"
    damaged.write_bytes(content[: len(content) // 2])

    with pytest.raises(SspError, match=r"not a valid SSP archive|so it is not an SSP file"):
        read_ssp(damaged, tmp_path / "fmus")

    assert not (tmp_path / "fmus").exists()


def test_an_algebraic_loop_is_reported(pack):
    """A wing that is loaded by its own tip: sound as a file, and said."""
    load_from_outside = (
        '<ssd:Connection startConnector="load" endElement="wing" endConnector="load_factor"/>'
    )
    load_from_tip = (
        '<ssd:Connection startElement="wing" startConnector="tip_displacement" '
        'endElement="wing" endConnector="load_factor" suppressUnitConversion="true"/>'
    )

    check = check_ssp(pack((load_from_outside, load_from_tip)))

    loop = "algebraic loop (structure.wing.tip_displacement -> structure.wing.load_factor"
    assert check.problems == ()
    assert loop in check.loops[0]
