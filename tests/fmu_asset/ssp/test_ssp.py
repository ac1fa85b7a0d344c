"""SSP files: what we write validates, is read by fmpy and by us, and flies the same; others' are applied."""

import itertools
import re
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy.ssp.simulation import simulate_ssp
from fmpy.ssp.ssd import read_ssd
from hypothesis import given, settings
from hypothesis import strategies as st

from fmu_asset.archive.declared import UnitInfo
from fmu_asset.client.experiment import default_experiment
from fmu_asset.client.session import FmiAsset
from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.structure import (
    Component,
    ComponentSetting,
    Connection,
    Connector,
    Endpoint,
    SystemStructure,
    expand_connection,
)
from fmu_asset.coupling.system import system_description
from fmu_asset.coupling.wiring import Wiring
from fmu_asset.errors import CouplingError, SspError
from fmu_asset.ssp.check import check_ssp, join_ssp, left_out_sentence
from fmu_asset.ssp.reader import read_ssp
from fmu_asset.ssp.writer import write_ssp
from tests.fmu_asset.client.kinds import BINDINGS
from tests.fmu_asset.coupling.reference import PARTS, of_ours
from tests.fmu_asset.making import archive_of, bound, members, tables, watch
from tests.fmu_asset.ours import OurFmus

HERE = Path(__file__).parent
CASES = tables(__file__, "cases")
NAMES = ("damage", "wing", "gauges")
NOISE = {Endpoint("gauges", "noise"): "noise"}
BINDING = BINDINGS["three_sent"]


@pytest.fixture(scope="module")
def fmus(ours: OurFmus) -> dict[str, Path]:
    return {name: ours(PARTS[name]) for name in NAMES}


@pytest.fixture(scope="module")
def structure(ours: OurFmus) -> SystemStructure:
    return of_ours(ours, CASES["ours"], "three")


@pytest.fixture(scope="module")
def ssp(structure: SystemStructure, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("ssp") / "three.ssp"
    return write_ssp(Wiring(structure), path, parameter_names=NOISE, stop_time=9.0)


def fly(wiring: Wiring, **options: Any) -> np.ndarray:
    with CoupledAsset(wiring, BINDING, isolated=False, **options) as asset:
        return np.array([asset.step({"load_factor": 3.0}).values for _ in range(9)])


def test_what_is_written_is_read_back(structure, ssp, tmp_path) -> None:
    theirs = join_ssp(read_ssp(ssp, tmp_path))
    assert theirs.structure.name == "three"
    assert [c.name for c in theirs.structure.components] == list(NAMES)
    for mine, other in zip(structure.components, theirs.structure.components, strict=True):
        assert mine.fmu.read_bytes() == other.fmu.read_bytes()
    np.testing.assert_array_equal(fly(Wiring(structure)), fly(theirs))
    again = write_ssp(theirs, tmp_path / "again.ssp", parameter_names=NOISE, stop_time=9.0)
    assert again.read_bytes() == ssp.read_bytes()
    assert check_ssp(ssp).problems == ()
    written = write_ssp(theirs, again, parameter_names=NOISE, stop_time=9.0, replace=True)
    assert written.read_bytes() == ssp.read_bytes()


def test_fmpy_reads_and_simulates_it_as_our_jacobi_does(ssp, structure) -> None:
    """Fmpy validates SSD, SSV and SSM by the schemas that it ships.

    It exchanges all values after a step, from zero at the start: in three steps that is forgotten.
    """
    system_read = read_ssd(str(ssp)).system
    assert [component.name for component in system_read.elements] == list(NAMES)
    assert len(system_read.connections) == len(structure.connections)
    (binding,) = system_read.parameterBindings
    parameters = binding.parameterValues[0]
    values = {p.name: p.value for p in parameters.parameters}
    assert float(values["noise"]) == pytest.approx(120e-6, rel=1e-15)
    assert values["wing.response"] == "quasi_static"
    targets = {entry.source: entry.target for entry in binding.parameterMapping[0].mappingEntries}
    assert targets["noise"] == "gauges.noise"
    with zipfile.ZipFile(ssp) as archive:
        assert archive.namelist()[0] == "SystemStructure.ssd"
    for parameter in parameters.parameters:
        parameter.name = targets[parameter.name]
    # It passes the name of an enumeration's item on as if it were a number; the start value is the same item.
    parameters.parameters = [p for p in parameters.parameters if p.type != "Enumeration"]
    theirs = simulate_ssp(
        str(ssp),
        stop_time=9.0,
        step_size=1.0,
        parameter_set=parameters,
        input={"load_factor": lambda _: 3.0},
    )
    ours = fly(Wiring(structure), algorithm="jacobi")
    readings = np.array([theirs[f"reading[{gauge}]"] for gauge in range(1, 25)]).T
    np.testing.assert_array_equal(readings[3:], ours[3:])
    assert np.abs(ours[4:]).min() > 0.0


numbers = st.floats(-1e6, 1e6).filter(lambda value: value == 0.0 or abs(value) > 1e-9)


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.tuples(numbers, numbers, st.booleans(), st.booleans()), min_size=4, max_size=4),
    st.integers(1, 9),
    st.floats(0.0, 1.0),
    st.integers(0, 2**31 - 1),
)
def test_any_connection_and_value_survives(
    fmus, tmp_path_factory, drawn, substeps, level, seed
) -> None:
    ends = [("damage.z1", "gauges.strain[1]"), ("damage.z2", "gauges.strain[2]"),
            ("gauges.reading[7]", "damage.load_factor"), ("damage.z1", "out")]  # fmt: skip
    keys = "factor", "offset", "convert_units", "delayed"
    connections = tuple(
        replace(expand_connection(*pair, NAMES)[0], **dict(zip(keys, values, strict=True)))
        for pair, values in zip(ends, drawn, strict=True)
    )
    given_values = {"level": ComponentSetting(level, "1"), "seed": ComponentSetting(seed)}
    components = (
        Component("damage", fmus["damage"], given_values, substeps),
        Component("gauges", fmus["gauges"]),
    )
    percent = UnitInfo("%", (0,) * 8, 0.01, 0.0, ())
    before = SystemStructure(
        "drawn", components, (Connector("out", "output", "%"),), connections, (percent,)
    )
    folder = tmp_path_factory.mktemp("drawn")
    path = write_ssp(Wiring(before), folder / "x.ssp")
    read_ssd(str(path))  # what SSP has no word for is still valid for others
    after = read_ssp(path, folder / "fmus")
    assert after.connections == before.connections
    assert after.connectors == before.connectors
    seen = [(c.name, c.settings, c.substeps) for c in after.components]
    assert seen == [(c.name, c.settings, c.substeps) for c in components]


# ---------------------------------------------------------------------- files of other makers

FILES = {
    name: (HERE / "theirs" / name).read_text("utf-8")
    for name in ("SystemStructure.ssd", "top.ssv", "top.ssm")
}
Pack = Callable[..., Path]


@pytest.fixture
def theirs(fmus: dict[str, Path], tmp_path: Path) -> Pack:
    """Return what packs an SSP file by hand; a change is made where its text stands first."""

    def pack(*changes: tuple[str, str], without: str = "", **more: str | bytes) -> Path:
        texts = dict(FILES)
        for old, new in changes:
            name = next(name for name, text in texts.items() if old in text)
            texts[name] = texts[name].replace(old, new, 1)
        contents: dict[str, str | bytes] = {
            "SystemStructure.ssd": texts.pop("SystemStructure.ssd"),
            **{f"resources/{name}": text for name, text in texts.items()},
            "resources/wing.fmu": fmus["wing"].read_bytes(),
            "resources/damage growth.fmu": fmus["damage"].read_bytes(),
        }
        contents |= more
        contents.pop(without, None)
        return archive_of(tmp_path / "theirs.ssp", contents)

    return pack


@pytest.fixture
def joined(theirs: Pack, tmp_path: Path) -> Callable[..., Wiring]:
    """Return what packs such a file, reads and joins it."""
    number = itertools.count()
    return lambda *changes, **more: join_ssp(
        read_ssp(theirs(*changes, **more), tmp_path / f"fmus{next(number)}")
    )


def conversions(wiring: Wiring, end: str) -> dict[str, tuple[float, float]]:
    return {str(port.end): port.conversion for port in wiring.ends[end]}


def test_nested_systems_parameters_and_mappings(theirs, joined) -> None:
    wiring = joined()
    assert [c.name for c in wiring.structure.components] == ["structure.wing", "damage"]
    # The outer system's set goes before the component's; a value is converted in unit, then scaled.
    for name, settings_of in CASES["settings"].items():
        assert wiring.settings[name] == pytest.approx(settings_of)
    ((target, feed),) = wiring.feeds.items()
    assert (str(feed.end), str(target)) == ("damage.z1", "structure.wing.health.z1")
    assert (feed.conversion, feed.delayed) == ((0.5, 0.0), False)
    inner = 'startConnector="z" endElement="wing" endConnector="health.z1"'
    late = joined((f"{inner}/>", f"{inner}>{CASES['delayed']}</ssd:Connection>"))
    assert [feed.delayed for feed in late.feeds.values()] == [True]
    assert conversions(wiring, "loss") == {"damage.z1": pytest.approx((100.0, 0.0))}
    n = {"structure.wing.load_factor": (1.0, 0.0), "damage.load_factor": (0.5, 0.25)}
    assert conversions(wiring, "n") == n
    with CoupledAsset(wiring, BINDINGS["theirs"], isolated=False) as asset:
        tip, loss, z = asset.step({"n": 2.0}).values
        assert (loss, z) == (pytest.approx(0.4), pytest.approx(40.0))
        asset.reset({"e": 1.0})
        assert asset.step({"n": 2.0}).values[0] < tip
    check = check_ssp(theirs())
    assert check.problems == ()
    assert [name for name, _ in check.components] == ["damage", "structure.wing"]


BARE = {
    name: re.sub(r"ss[mvc]:|xmlns:\w+=\"[^\"]+\"", "", FILES[name])
    for name in ("top.ssv", "top.ssm")
}
# SSP 1.0, section 5.3: the kinds of the connectors say where a value goes, not the ends of the connection.
TURNED = re.sub(
    r"(start|end)(?=Element=|Connector=)",
    lambda match: {"start": "end", "end": "start"}[match[1]],
    FILES["SystemStructure.ssd"],
)
MEAN_THE_SAME: dict[str, tuple[Any, dict[str, str]]] = {
    "start and end exchanged": ((), {"SystemStructure.ssd": TURNED}),
    "a set without namespace": ((), {"resources/top.ssv": BARE["top.ssv"]}),
    "a mapping without namespace": ((), {"resources/top.ssm": BARE["top.ssm"]}),
    **{row["case"]: (row["changes"], {}) for row in CASES["same"]},
}


@pytest.mark.parametrize("case", MEAN_THE_SAME)
def test_what_means_the_same_is_read_alike(joined, case) -> None:
    assert FILES["SystemStructure.ssd"] != TURNED
    changes, more = MEAN_THE_SAME[case]
    plain, read = joined(), joined(*changes, **more)
    assert read.structure.connections == plain.structure.connections
    assert read.settings == plain.settings


def further(*parameters: tuple[str, str]) -> tuple[str, str]:
    """Return the change that gives the system a second parameter binding, with another `%` than its first."""
    more = "".join(
        f'<ssv:Parameter name="{name}">{value}</ssv:Parameter>' for name, value in parameters
    )
    return "</ssd:ParameterBindings>\n  <ssd:Elements>", CASES["more"] % more


def test_values_go_where_the_standard_says(joined, tmp_path) -> None:
    """SSP 1.0, 5.2.3 and 6: later bindings of a level go before earlier ones; a set defines its units."""
    wiring = joined(further(("damage.initial.z1", '<ssv:Real value="3" unit="%"/>')))
    assert wiring.settings["damage"]["initial.z1"] == pytest.approx(3 * 0.1)
    assert wiring.settings["damage"]["initial.z2"] == pytest.approx(0.04)
    assert wiring.ends["loss"][0].conversion == (pytest.approx(100.0), 0.0)
    # 5.3.2.1, allowed connections: a parameter of the system goes to an input.
    ends = joined(('name="n" kind="input"', 'name="n" kind="parameter"')).ends["n"]
    assert {str(port.end) for port in ends} == {"structure.wing.load_factor", "damage.load_factor"}
    # GTransformationChoice: target = factor * source + offset, the source in the target's unit.
    scaled = '><ssc:LinearTransformation factor="0.5" offset="0.1"/></ssm:MappingEntry>'
    mapped = joined(('target="damage.initial.z1"/>', f'target="damage.initial.z1"{scaled}'))
    assert mapped.settings["damage"]["initial.z1"] == pytest.approx(0.5 * 0.4 + 0.1)
    # SSP 2.0, 6.2: a mapping may serve several sets.
    less = joined(('source="chance"', 'source="luck"'))
    assert {*less.left_out} == {"damage.seed"}
    assert "damage.seed (its set lacks the value)" in left_out_sentence(less, tmp_path)


def test_fmus_of_other_versions_are_joined(foreign_fmu, tmp_path) -> None:
    """A counter of FMI 3 (UInt16) drives a lag of FMI 1 that starts elsewhere: as the lag alone does it."""
    contents = {
        "SystemStructure.ssd": (HERE / "theirs" / "mixed.ssd").read_bytes(),
        "resources/counter.fmu": foreign_fmu("array3").read_bytes(),
        "resources/lag.fmu": foreign_fmu("lag1").read_bytes(),
    }
    wiring = join_ssp(read_ssp(archive_of(tmp_path / "mixed.ssp", contents), tmp_path / "fmus"))
    with CoupledAsset(wiring, watch("lag.Out1", step_size=0.1), isolated=False) as asset:
        values = [asset.step().values[0] for _ in range(4)]
    alone = BINDINGS["lag1"].with_header(step_size=0.1, decimation=1)
    with FmiAsset(foreign_fmu("lag1"), alone, isolated=False) as lag:
        assert [lag.step({"speed": float(n)}).values[0] for n in range(1, 5)] == values
    assert values[-1] > 0.0
    array = Connection(Endpoint("counter", "y"), Endpoint("lag", "In1 (rad/s)"))
    words = r"counter\.y cannot be the source .* of the type Float64, and an output of a single"
    with pytest.raises(CouplingError, match=words):
        Wiring(replace(wiring.structure, connections=(array,)))


def test_start_values_of_outputs_are_set(foreign_fmu) -> None:
    """SSP 1.0, 5.2.3: what a parameter binding can set is everything that starts with a given value."""
    ball = Component(
        "ball", foreign_fmu("ball2"), {"h": ComponentSetting(3.0), "v": ComponentSetting(-1.0)}
    )
    binding = bound(0.1, {"h": (["ball.h", "ball.v"], ["m", "m/s"])})
    with CoupledAsset(SystemStructure("one", (ball,)), binding, isolated=False) as asset:
        asset.reset()
        assert asset.observe().values.tolist() == [3.0, -1.0]
        assert asset.step().values[0] == pytest.approx(3.0 - 0.1 - 0.5 * 9.81 * 0.01, abs=1e-4)


LONG = {
    "old": 'name="z1" kind="output"',
    "new": f'name="z1" kind="{"o" * 5000}"',
    "sentence": r"^.{,700}$",
}


@pytest.mark.parametrize("case", [*CASES["refused"], LONG], ids=lambda case: case["sentence"][:40])
def test_what_is_wrong_is_said_in_one_sentence(theirs, case) -> None:
    (sentence,) = check_ssp(theirs((case["old"], case["new"]))).problems
    assert re.search(case["sentence"], sentence), sentence
    assert "\n" not in sentence


def test_archives_that_are_unsafe_or_damaged(theirs, tmp_path) -> None:
    """Checked as those of FMUs are."""
    (sentence,) = check_ssp(theirs(**{"resources/wing.fmu": "no FMU"})).problems
    assert re.match(r"resources/wing\.fmu in \S+/theirs\.ssp is not a sound FMU archive", sentence)
    good, damaged = theirs().read_bytes(), tmp_path / "damaged.ssp"
    # Half of the file ends with one of its FMUs, which is an archive as well.
    damaged.write_bytes(good[: len(good) // 2])
    for path, words in (
        (lambda: theirs(**{"../outside.txt": "x"}), "extracted outside its folder"),
        (lambda: theirs(without="SystemStructure.ssd"), "so it is no SSP file"),
        (lambda: damaged, "not a sound SSP archive|so it is no SSP file"),
    ):
        with pytest.raises(SspError, match=words):
            read_ssp(path(), tmp_path / "fmus")
    assert not (tmp_path / "fmus").exists()
    assert not (tmp_path.parent / "outside.txt").exists()


def test_an_algebraic_loop_is_reported(theirs) -> None:
    """A wing that is loaded by its own tip: sound as a file, and said."""
    change = (
        '<ssd:Connection startConnector="load" endElement="wing" endConnector="load_factor"/>',
        '<ssd:Connection startElement="wing" startConnector="tip_displacement" endElement="wing" '
        'endConnector="load_factor" suppressUnitConversion="true"/>',
    )
    check = check_ssp(theirs(change))
    assert check.problems == ()
    assert (
        "algebraic loop (structure.wing.tip_displacement -> structure.wing.load_factor"
        in check.loops[0]
    )


# ---------------------------------------------------------------------- the step, and what FMUs are called

SIREN = (
    '<ssd:SystemStructureDescription version="1.0" name="alarm" '
    'xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon" '
    'xmlns:ssd="http://ssp-standard.org/SSP1/SystemStructureDescription">'
    '<ssd:System name="top"><ssd:Elements>'
    '<ssd:Component name="siren" type="application/x-fmu-sharedlibrary" source="resources/horn.fmu"/>'
    "</ssd:Elements>{system}</ssd:System>"
    '<ssd:DefaultExperiment startTime="0" stopTime="10">{experiment}</ssd:DefaultExperiment>'
    "</ssd:SystemStructureDescription>"
)
ANNOTATED = '<ssd:Annotations><ssc:Annotation type="x">{}</ssc:Annotation></ssd:Annotations>'
BASE_STEP = ANNOTATED.format(
    '<osp:Algorithm xmlns:osp="http://opensimulationplatform.com/SSP/OSPAnnotations">'
    '<osp:FixedStepAlgorithm baseStepSize="{}"/></osp:Algorithm>'
)
MASTER_STEP = ANNOTATED.format(
    '<oms:SimulationInformation xmlns:oms="https://raw.githubusercontent.com/OpenModelica">'
    '<oms:FixedStepMaster description="oms-ma" stepSize="0.25"/></oms:SimulationInformation>'
)


@pytest.fixture
def alarm(foreign_fmu: Any, tmp_path: Path) -> Pack:
    """Return what packs a system of one siren, which itself declares no step."""

    def pack(fmu: Path | None = None, *, system: str = "", experiment: str = "") -> Path:
        horn = fmu or foreign_fmu("siren2")
        description = SIREN.format(system=system, experiment=experiment)
        contents = {"SystemStructure.ssd": description, "resources/horn.fmu": horn.read_bytes()}
        return archive_of(tmp_path / "alarm.ssp", contents)

    return pack


def test_a_check_makes_the_step_that_a_simulation_takes(alarm) -> None:
    """A 500th of the time to the end, where nothing declares a step."""
    check = check_ssp(alarm())
    assert (check.problems, check.step) == ((), 0.02)


def test_a_check_makes_the_step_that_an_fmu_declares(foreign_fmu, alarm) -> None:
    """An FMU that takes 10 ms only, and refuses the step of 1 s."""
    check = check_ssp(alarm(foreign_fmu("fixed2")))
    assert (check.problems, check.step) == ((), 0.01)


@pytest.mark.parametrize(
    ("place", "annotation", "step"),
    [("experiment", BASE_STEP.format("0.5"), 0.5), ("system", MASTER_STEP, 0.25)],
)
def test_a_declared_base_step_is_the_step(alarm, tmp_path, place, annotation, step) -> None:
    file = alarm(**{place: annotation})
    described = system_description(join_ssp(read_ssp(file, tmp_path / "fmus")))
    assert default_experiment(described).binding.step_size == step
    assert check_ssp(file).step == step


def test_a_base_step_that_is_none_is_refused(alarm) -> None:
    (sentence,) = check_ssp(alarm(experiment=BASE_STEP.format("-1"))).problems
    assert "baseStepSize must be a positive number of seconds, and '-1' came" in sentence


def test_a_failing_fmu_is_named_as_in_the_file(foreign_fmu, alarm) -> None:
    """Never by the folder that it was extracted to."""
    (sentence,) = check_ssp(alarm(foreign_fmu("hostile2", "SEGFAULT", "AFTER=0"))).problems
    assert "component siren: resources/horn.fmu in " in sentence
    assert "uav-twin-fmu-" not in sentence


def test_an_fmu_for_another_platform_is_named_as_in_the_file(fmus, alarm, tmp_path) -> None:
    contents = {
        n: c for n, c in members(fmus["wing"]).items() if not n.startswith("binaries/linux64")
    }
    (sentence,) = check_ssp(alarm(archive_of(tmp_path / "elsewhere.fmu", contents))).problems
    assert re.match(
        r"resources/horn\.fmu in \S+/alarm\.ssp has no binary for this platform", sentence
    )


def test_the_stop_time_of_a_system_is_told_to_its_fmus(foreign_fmu, alarm) -> None:
    assert check_ssp(alarm(foreign_fmu("siren2", "WANTS_STOP_TIME=10.0"))).problems == ()


def test_an_enumeration_in_a_system_is_set_by_name(alarm, tmp_path) -> None:
    wiring = join_ssp(read_ssp(alarm(), tmp_path / "fmus"))
    experiment = default_experiment(system_description(wiring), values={"siren.loudness": "loud"})
    with CoupledAsset(
        wiring, experiment.binding, isolated=False, parameters=experiment.parameters
    ) as asset:
        assert asset.step().values[0] == 10.0


def test_a_value_that_an_enumeration_of_a_system_lacks_is_refused(foreign_fmu) -> None:
    siren = Component("siren", foreign_fmu("siren2"), {"loudness": ComponentSetting(2)})
    with pytest.raises(CouplingError, match="it is an enumeration of quiet = 1, loud = 3"):
        Wiring(SystemStructure("one", (siren,)))
