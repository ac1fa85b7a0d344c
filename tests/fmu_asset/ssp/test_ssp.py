"""SSP files: what we write validates, is read by fmpy and by us, and flies the same; others' are applied."""

from __future__ import annotations

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
from fmu_asset.companions.build import companion_bytes
from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.structure import (
    Component,
    Connection,
    Connector,
    Endpoint,
    Setting,
    SystemStructure,
    expand_connection,
)
from fmu_asset.coupling.wiring import Wiring
from fmu_asset.door.binding import Binding, parse_binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import CouplingError, SspError
from fmu_asset.ssp.check import check_ssp, join_ssp, left_out_sentence
from fmu_asset.ssp.reader import read_ssp
from fmu_asset.ssp.writer import write_ssp
from reporting.files import atomic_write_bytes

NAMES = ("damage", "wing", "gauges")
CONNECTIONS = (
    ("load_factor", "damage.load_factor"),
    ("load_factor", "wing.load_factor"),
    ("damage.z1", "wing.health.z1"),
    ("damage.z2", "wing.health.z2"),
    ("wing.strain[{1..24}]", "gauges.strain[{1..24}]"),
    ("gauges.reading[{1..24}]", "reading[{1..24}]"),
    ("gauges.received[1]", "received"),
    ("damage.z1", "z1"),
)


@pytest.fixture(scope="module")
def fmus(tmp_path_factory: pytest.TempPathFactory, fmu: Path) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("parts")
    return {
        "damage": atomic_write_bytes(folder / "damage.fmu", companion_bytes("damage_growth")),
        "wing": fmu,
        "gauges": atomic_write_bytes(folder / "gauges.fmu", companion_bytes("strain_gauges")),
    }


@pytest.fixture(scope="module")
def structure(fmus: dict[str, Path]) -> SystemStructure:
    joined: list[Connection] = []
    for source, target in CONNECTIONS:
        joined += expand_connection(source, target, NAMES)
    connectors = dict.fromkeys(
        [Connector(c.source.variable, "input") for c in joined if not c.source.component]
        + [Connector(c.target.variable, "output") for c in joined if not c.target.component]
    )
    settings = {
        "damage": {
            "script[1].first": Setting(1.0),
            "script[1].last": Setting(3.0),
            "script[1].z1": Setting(0.1),
        },
        "wing": {"response": Setting("quasi_static"), "mass.servo": Setting(150.0, "g")},
        "gauges": {"noise": Setting(120.0, "microstrain"), "seed": Setting(9)},
    }
    components = tuple(Component(name, fmus[name], settings[name]) for name in NAMES)
    return SystemStructure("three", components, tuple(connectors), tuple(joined))


@pytest.fixture(scope="module")
def ssp(structure: SystemStructure, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("ssp") / "three.ssp"
    return write_ssp(
        Wiring(structure), path, parameter_names={Endpoint("gauges", "noise"): "noise"}, stop_time=9.0
    )


@pytest.fixture(scope="module")
def binding() -> Binding:
    return parse_binding(
        {
            "binding": {"name": "three", "step_size": 1.0},
            "control": {"load_factor": {"variable": "load_factor", "unit": "1"}},
            "observation": {"strain": {"variables": "reading[{1..24}]", "unit": "1"}},
            "monitor": {"z1": {"variable": "z1", "unit": "1"}},
        }
    )


def fly(wiring: Wiring, binding: Binding, **options: object) -> np.ndarray:
    with CoupledAsset(wiring, binding, isolated=False, **options) as asset:  # type: ignore[arg-type]
        return np.array([asset.step({"load_factor": 3.0}).values for _ in range(9)])


def test_what_is_written_is_read_back(
    structure: SystemStructure, ssp: Path, binding: Binding, tmp_path: Path
) -> None:
    read = read_ssp(ssp, tmp_path)
    ours, theirs = Wiring(structure), join_ssp(read)
    assert theirs.structure.name == "three"
    assert [c.name for c in theirs.structure.components] == list(NAMES)
    for mine, other in zip(structure.components, theirs.structure.components, strict=True):
        assert mine.fmu.read_bytes() == other.fmu.read_bytes()
    np.testing.assert_array_equal(fly(ours, binding), fly(theirs, binding))
    # Written again, it is the same file.
    names = {Endpoint("gauges", "noise"): "noise"}
    again = write_ssp(theirs, tmp_path / "again.ssp", parameter_names=names, stop_time=9.0)
    assert again.read_bytes() == ssp.read_bytes()
    assert check_ssp(ssp).problems == ()


def test_fmpy_reads_it(ssp: Path, structure: SystemStructure) -> None:
    """Fmpy validates SSD, SSV and SSM by the schemas that it ships."""
    description = read_ssd(str(ssp))
    assert [component.name for component in description.system.elements] == list(NAMES)
    assert len(description.system.connections) == len(structure.connections)
    (bound,) = description.system.parameterBindings
    values = {p.name: p.value for p in bound.parameterValues[0].parameters}
    assert float(values["noise"]) == pytest.approx(120e-6, rel=1e-15)
    targets = {entry.source: entry.target for entry in bound.parameterMapping[0].mappingEntries}
    assert targets["noise"] == "gauges.noise"
    assert values["wing.response"] == "quasi_static"
    with zipfile.ZipFile(ssp) as archive:
        assert archive.namelist()[0] == "SystemStructure.ssd"


def test_fmpy_simulates_it_as_our_jacobi_does(
    ssp: Path, structure: SystemStructure, binding: Binding
) -> None:
    """Fmpy exchanges all values after a step, from zero at the start: in three steps that is forgotten."""
    (bound,) = read_ssd(str(ssp)).system.parameterBindings
    parameters = bound.parameterValues[0]
    targets = {entry.source: entry.target for entry in bound.parameterMapping[0].mappingEntries}
    for parameter in parameters.parameters:
        parameter.name = targets[parameter.name]
    # It passes the name of an enumeration's item on as if it were a number; the start value is the same item.
    parameters.parameters = [p for p in parameters.parameters if p.type != "Enumeration"]
    theirs = simulate_ssp(
        str(ssp), stop_time=9.0, step_size=1.0, parameter_set=parameters, input={"load_factor": lambda _: 3.0}
    )
    ours = fly(Wiring(structure), binding, algorithm="jacobi")
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
    fmus: dict[str, Path],
    tmp_path_factory: pytest.TempPathFactory,
    drawn: list[tuple[float, float, bool, bool]],
    substeps: int,
    level: float,
    seed: int,
) -> None:
    ends = [("damage.z1", "gauges.strain[1]"), ("damage.z2", "gauges.strain[2]"),
            ("gauges.reading[7]", "damage.load_factor"), ("damage.z1", "out")]  # fmt: skip
    connections = tuple(
        replace(
            expand_connection(*pair, NAMES)[0],
            factor=factor, offset=offset, convert_units=convert, delayed=delayed,
        )
        for pair, (factor, offset, convert, delayed) in zip(ends, drawn, strict=True)
    )  # fmt: skip
    settings_ = {"level": Setting(level, "1"), "seed": Setting(seed)}
    components = (
        Component("damage", fmus["damage"], settings_, substeps),
        Component("gauges", fmus["gauges"]),
    )
    before = SystemStructure("drawn", components, (Connector("out", "output", "%"),), connections,
                             (UnitInfo("%", (0,) * 8, 0.01, 0.0, ()),))  # fmt: skip
    folder = tmp_path_factory.mktemp("drawn")
    path = write_ssp(Wiring(before), folder / "x.ssp")
    read_ssd(str(path))  # what SSP has no word for is still valid for others
    after = read_ssp(path, folder / "fmus")
    assert after.connections == before.connections
    assert after.connectors == before.connectors
    assert [(c.name, c.settings, c.substeps) for c in after.components] == [
        (c.name, c.settings, c.substeps) for c in components
    ]


def test_files_are_not_overwritten_unasked(structure: SystemStructure, tmp_path: Path) -> None:
    wiring = Wiring(structure)
    path = write_ssp(wiring, tmp_path / "x.ssp")
    before = path.read_bytes()
    with pytest.raises(SspError, match="exists: choose another --out"):
        write_ssp(wiring, path)
    with pytest.raises(SspError, match=r"suffix \.ssp"):
        write_ssp(wiring, tmp_path / "x.zip")
    assert write_ssp(wiring, path, replace=True).read_bytes() == before


# ---------------------------------------------------------------------- files of other makers

HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<ssd:SystemStructureDescription version="1.0" name="theirs"
  xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon"
  xmlns:ssd="http://ssp-standard.org/SSP1/SystemStructureDescription"
  xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues"
  xmlns:ssm="http://ssp-standard.org/SSP1/SystemStructureParameterMapping">
"""
NESTED = (
    HEAD
    + """
<ssd:System name="top">
  <ssd:Connectors>
    <ssd:Connector name="n" kind="input"><ssc:Real unit="1"/></ssd:Connector>
    <ssd:Connector name="loss" kind="output"><ssc:Real unit="%"/></ssd:Connector>
    <ssd:Connector name="tip" kind="output"/>
  </ssd:Connectors>
  <ssd:ParameterBindings>
    <ssd:ParameterBinding source="resources/top.ssv">
      <ssd:ParameterMapping source="resources/top.ssm"/>
    </ssd:ParameterBinding>
  </ssd:ParameterBindings>
  <ssd:Elements>
    <ssd:System name="structure">
      <ssd:Connectors>
        <ssd:Connector name="load" kind="input"/>
        <ssd:Connector name="tip" kind="output"/>
        <ssd:Connector name="z" kind="input"/>
      </ssd:Connectors>
      <ssd:Elements>
        <ssd:Component name="wing" type="application/x-fmu-sharedlibrary" source="resources/wing.fmu">
          <ssd:Connectors>
            <ssd:Connector name="load_factor" kind="input"><ssc:Real unit="1"/></ssd:Connector>
            <ssd:Connector name="health.z1" kind="input"><ssc:Real/></ssd:Connector>
            <ssd:Connector name="tip_displacement" kind="output"/>
          </ssd:Connectors>
          <ssd:ParameterBindings>
            <ssd:ParameterBinding>
              <ssd:ParameterValues>
                <ssv:ParameterSet version="1.0" name="inline">
                  <ssv:Parameters>
                    <ssv:Parameter name="young_modulus_factor"><ssv:Real value="0.9"/></ssv:Parameter>
                    <ssv:Parameter name="mass.servo"><ssv:Real value="0.2" unit="kg"/></ssv:Parameter>
                  </ssv:Parameters>
                  <ssv:Units><ssc:Unit name="kg"><ssc:BaseUnit kg="1"/></ssc:Unit></ssv:Units>
                </ssv:ParameterSet>
              </ssd:ParameterValues>
            </ssd:ParameterBinding>
          </ssd:ParameterBindings>
        </ssd:Component>
      </ssd:Elements>
      <ssd:Connections>
        <ssd:Connection startConnector="load" endElement="wing" endConnector="load_factor"/>
        <ssd:Connection startConnector="z" endElement="wing" endConnector="health.z1"/>
        <ssd:Connection startElement="wing" startConnector="tip_displacement" endConnector="tip"/>
      </ssd:Connections>
    </ssd:System>
    <ssd:Component name="damage" source="resources/damage%20growth.fmu" implementation="CoSimulation">
      <ssd:Connectors>
        <ssd:Connector name="load_factor" kind="input"/>
        <ssd:Connector name="z1" kind="output"/>
      </ssd:Connectors>
    </ssd:Component>
  </ssd:Elements>
  <ssd:Connections>
    <ssd:Connection startConnector="n" endElement="structure" endConnector="load"/>
    <ssd:Connection startConnector="n" endElement="damage" endConnector="load_factor">
      <ssc:LinearTransformation factor="0.5" offset="0.25"/>
    </ssd:Connection>
    <ssd:Connection startElement="damage" startConnector="z1" endElement="structure" endConnector="z">
      <ssc:LinearTransformation factor="0.5"/>
    </ssd:Connection>
    <ssd:Connection startElement="damage" startConnector="z1" endConnector="loss"/>
    <ssd:Connection startElement="structure" startConnector="tip" endConnector="tip"/>
  </ssd:Connections>
</ssd:System>
<ssd:Units>
  <ssc:Unit name="1"><ssc:BaseUnit/></ssc:Unit>
  <ssc:Unit name="%"><ssc:BaseUnit factor="0.01"/></ssc:Unit>
</ssd:Units>
</ssd:SystemStructureDescription>
"""
)
SET = """<?xml version="1.0" encoding="UTF-8"?>
<ssv:ParameterSet version="1.0" name="top"
  xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon"
  xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues">
  <ssv:Parameters>
    <ssv:Parameter name="stiffness"><ssv:Real value="96"/></ssv:Parameter>
    <ssv:Parameter name="begin"><ssv:Real value="40" unit="%"/></ssv:Parameter>
    <ssv:Parameter name="chance"><ssv:Integer value="17"/></ssv:Parameter>
    <ssv:Parameter name="unused"><ssv:Boolean value="true"/></ssv:Parameter>
  </ssv:Parameters>
  <ssv:Units><ssc:Unit name="%"><ssc:BaseUnit factor="0.01"/></ssc:Unit></ssv:Units>
</ssv:ParameterSet>
"""
MAPPING = """<?xml version="1.0" encoding="UTF-8"?>
<ssm:ParameterMapping version="1.0"
  xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon"
  xmlns:ssm="http://ssp-standard.org/SSP1/SystemStructureParameterMapping">
  <ssm:MappingEntry source="stiffness" target="structure.wing.young_modulus_factor">
    <ssc:LinearTransformation factor="0.01"/>
  </ssm:MappingEntry>
  <ssm:MappingEntry source="begin" target="damage.initial.z1"/>
  <ssm:MappingEntry source="begin" target="damage.initial.z2" suppressUnitConversion="true">
    <ssc:LinearTransformation factor="0.001"/>
  </ssm:MappingEntry>
  <ssm:MappingEntry source="chance" target="damage.seed"/>
</ssm:ParameterMapping>
"""

Pack = Callable[..., Path]


@pytest.fixture
def theirs(fmus: dict[str, Path], tmp_path: Path) -> Pack:
    """Return what packs an SSP file by hand; the system structure and the files can be changed."""

    def pack(
        change: tuple[str, str] | None = None,
        files: dict[str, str | bytes] | None = None,
        ssd: str = NESTED,
        without: str = "",
    ) -> Path:
        if change is not None:
            assert change[0] in ssd
            ssd = ssd.replace(*change, 1)
        members: dict[str, str | bytes] = {
            "SystemStructure.ssd": ssd,
            "resources/top.ssv": SET,
            "resources/top.ssm": MAPPING,
            "resources/wing.fmu": fmus["wing"].read_bytes(),
            "resources/damage growth.fmu": fmus["damage"].read_bytes(),
            **(files or {}),
        }
        members.pop(without, None)
        path = tmp_path / "theirs.ssp"
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in members.items():
                archive.writestr(name, content)
        return path

    return pack


def test_nested_systems_parameters_and_mappings(theirs: Pack, tmp_path: Path) -> None:
    wiring = join_ssp(read_ssp(theirs(), tmp_path / "fmus"))
    assert [c.name for c in wiring.structure.components] == ["structure.wing", "damage"]
    # The outer system's set goes before the component's; a value is converted in unit, then scaled.
    assert wiring.settings["structure.wing"] == {
        "young_modulus_factor": pytest.approx(0.96), "mass.servo": 0.2,
    }  # fmt: skip
    assert wiring.settings["damage"] == {
        "initial.z1": pytest.approx(0.4), "initial.z2": pytest.approx(0.04), "seed": 17.0,
    }  # fmt: skip
    ((target, feed),) = wiring.feeds.items()
    assert (str(feed.end), str(target)) == ("damage.z1", "structure.wing.health.z1")
    assert feed.conversion == (0.5, 0.0)
    assert wiring.ends["loss"][0].conversion == (pytest.approx(100.0), 0.0)
    assert {str(port.end): port.conversion for port in wiring.ends["n"]} == {
        "structure.wing.load_factor": (1.0, 0.0), "damage.load_factor": (0.5, 0.25),
    }  # fmt: skip
    binding = parse_binding(
        {
            "binding": {"name": "theirs", "step_size": 1.0},
            "control": {"n": {"variable": "n", "unit": "1"}},
            "observation": {
                "tip": {"variables": ["tip"], "unit": "mm"},
                "loss": {"variables": ["loss"], "unit": "1"},
                "z": {"variables": ["damage.z1"], "unit": "%"},
            },
            "parameter": {"e": {"variable": "structure.wing.young_modulus_factor", "unit": "1"}},
        }
    )
    with CoupledAsset(wiring, binding, isolated=False) as asset:
        tip, loss, z = asset.step({"n": 2.0}).values
        assert (loss, z) == (pytest.approx(0.4), pytest.approx(40.0))
        asset.reset({"e": 1.0})
        assert asset.step({"n": 2.0}).values[0] < tip
    check = check_ssp(theirs())
    assert check.problems == ()
    assert [name for name, _ in check.components] == ["damage", "structure.wing"]


def test_start_and_end_of_a_connection_are_not_its_direction(theirs: Pack, tmp_path: Path) -> None:
    """SSP 1.0, section 5.3: the kinds of the connectors say where a value goes."""
    turned = re.sub(
        r"(start|end)(?=Element=|Connector=)", lambda m: {"start": "end", "end": "start"}[m[1]], NESTED
    )
    assert turned != NESTED
    structures = [
        join_ssp(read_ssp(theirs(ssd=ssd), tmp_path / str(n))).structure
        for n, ssd in enumerate((NESTED, turned))
    ]
    assert structures[0].connections == structures[1].connections


@pytest.mark.parametrize(
    ("files", "ssd"),
    [
        ({"resources/top.ssv": re.sub(r"ssv:|ssc:|xmlns:\w+=\"[^\"]+\"", "", SET)}, NESTED),
        ({"resources/top.ssm": re.sub(r"ssm:|ssc:|xmlns:\w+=\"[^\"]+\"", "", MAPPING)}, NESTED),
        (
            {"resources/top.ssv": SET.replace('<ssv:Boolean value="true"/>', '<ssv:String value="x"/>')},
            NESTED,
        ),
        ({}, NESTED.replace("</ssd:ParameterValues>", "</ssd:ParameterValues><ssd:ParameterMapping/>")),
    ],
    ids=["a set without namespace", "a mapping without namespace", "an unused text", "an empty mapping"],
)
def test_what_other_tools_write_is_read(
    theirs: Pack, tmp_path: Path, files: dict[str, str | bytes], ssd: str
) -> None:
    read = join_ssp(read_ssp(theirs(files=files, ssd=ssd), tmp_path / "theirs"))
    assert read.settings == join_ssp(read_ssp(theirs(), tmp_path / "plain")).settings


BINDING = """<ssd:ParameterBinding><ssd:ParameterValues><ssv:ParameterSet version="1.0" name="more">
<ssv:Parameters>%s</ssv:Parameters>
<ssv:Units><ssc:Unit name="%%"><ssc:BaseUnit factor="0.1"/></ssc:Unit></ssv:Units>
</ssv:ParameterSet></ssd:ParameterValues></ssd:ParameterBinding></ssd:ParameterBindings>"""


def bound(*parameters: tuple[str, str]) -> tuple[str, str]:
    """Return the change that gives the system a second parameter binding, with another `%` than its first."""
    more = "".join(f'<ssv:Parameter name="{name}">{value}</ssv:Parameter>' for name, value in parameters)
    return "</ssd:ParameterBindings>\n  <ssd:Elements>", BINDING % more + "<ssd:Elements>"


def test_values_go_where_the_standard_says(theirs: Pack, tmp_path: Path) -> None:
    """SSP 1.0, 5.2.3 and 6: later bindings of a level go before earlier ones; a set defines its units."""
    change = bound(("damage.initial.z1", '<ssv:Real value="3" unit="%"/>'))
    wiring = join_ssp(read_ssp(theirs(change), tmp_path / "fmus"))
    assert wiring.settings["damage"]["initial.z1"] == pytest.approx(3 * 0.1)
    assert wiring.settings["damage"]["initial.z2"] == pytest.approx(0.04)
    assert wiring.ends["loss"][0].conversion == (pytest.approx(100.0), 0.0)
    # 5.3.2.1, allowed connections: a parameter of the system goes to an input.
    change = ('name="n" kind="input"', 'name="n" kind="parameter"')
    ends = join_ssp(read_ssp(theirs(change), tmp_path / "parameter")).ends["n"]
    assert {str(port.end) for port in ends} == {"structure.wing.load_factor", "damage.load_factor"}
    # GTransformationChoice: target = factor * source + offset, the source in the target's unit.
    mapping = MAPPING.replace(
        'target="damage.initial.z1"/>',
        'target="damage.initial.z1"><ssc:LinearTransformation factor="0.5" offset="0.1"/></ssm:MappingEntry>',
    )
    mapped = join_ssp(read_ssp(theirs(files={"resources/top.ssm": mapping}), tmp_path / "mapped"))
    assert mapped.settings["damage"]["initial.z1"] == pytest.approx(0.5 * 0.4 + 0.1)


def test_what_is_for_nothing_is_left_out_and_named(theirs: Pack, tmp_path: Path) -> None:
    """SSP 2.0, 6.2: a set may hold more than a system takes; a mapping may serve several sets."""
    before = join_ssp(read_ssp(theirs(), tmp_path / "fmus")).settings
    del before["damage"]["seed"]
    value = '<ssv:Real value="1"/>'
    change = bound(("rudder.seed", value), ("mass", value), ("damage.sed", value), ("structure.lod", value))
    mapping = MAPPING.replace('source="chance"', 'source="luck"')
    wiring = join_ssp(read_ssp(theirs(change, {"resources/top.ssm": mapping}), tmp_path / "fmus"))
    assert {*wiring.left_out} == {"damage.seed", "rudder.seed", "mass", "structure.lod", "damage.sed"}
    said = left_out_sentence(wiring, tmp_path)
    assert "damage.sed (did you mean 'damage.seed'?)" in said
    assert "damage.seed (its set lacks the value)" in said
    assert wiring.settings == before
    assert (
        write_ssp(wiring, tmp_path / "again.ssp").stat().st_size
    )  # what is for nothing is not written again


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (('<ssd:Connector name="health.z1" kind="input"><ssc:Real/>',
          '<ssd:Connector name="health.z1" kind="input"><ssc:Real unit=""/>'), "an empty unit"),
        (('name="tip_displacement" kind="output"/>',
          'name="tip_displacement" kind="output"><ssc:Real unit="metre"/></ssd:Connector>'), "another name"),
    ],
)  # fmt: skip
def test_units_that_say_the_same_are_the_same(
    theirs: Pack, tmp_path: Path, change: tuple[str, str], words: str
) -> None:
    metre = ("<ssd:Units>", '<ssd:Units><ssc:Unit name="metre"><ssc:BaseUnit m="1"/></ssc:Unit>')
    plain, read = (
        join_ssp(read_ssp(theirs(ssd=ssd.replace(*metre)), tmp_path / "fmus")).structure
        for ssd in (NESTED, NESTED.replace(*change))
    )
    assert read.connections == plain.connections, words


def test_fmus_of_other_versions_are_joined(foreign_fmu: Any, tmp_path: Path) -> None:
    """A counter of FMI 3 (UInt16) drives a lag of FMI 1 that starts elsewhere: as the lag alone does it."""
    ssd = (
        HEAD
        + """
<ssd:System name="top"><ssd:Elements>
  <ssd:Component name="counter" source="resources/counter.fmu"><ssd:Connectors>
    <ssd:Connector name="calls" kind="output"><ssc:Integer/></ssd:Connector>
  </ssd:Connectors></ssd:Component>
  <ssd:Component name="lag" source="resources/lag.fmu"><ssd:Connectors>
    <ssd:Connector name="In1 (rad/s)" kind="input"/>
  </ssd:Connectors></ssd:Component>
</ssd:Elements><ssd:Connections>
  <ssd:Connection startElement="counter" startConnector="calls" endElement="lag"
    endConnector="In1 (rad/s)"/>
</ssd:Connections></ssd:System></ssd:SystemStructureDescription>
"""
    )
    path = tmp_path / "mixed.ssp"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("SystemStructure.ssd", ssd)
        archive.write(foreign_fmu("array3"), "resources/counter.fmu")
        archive.write(foreign_fmu("lag1"), "resources/lag.fmu")
    wiring = join_ssp(read_ssp(path, tmp_path / "fmus"))
    header = {"name": "mixed", "step_size": 0.1}
    seen = {"seen": {"variables": "lag.Out1", "unit": "1"}}
    with CoupledAsset(
        wiring, parse_binding({"binding": header, "observation": seen}), isolated=False
    ) as asset:
        values = [asset.step().values[0] for _ in range(4)]
    alone = {"load": {"u": {"variable": "In1 (rad/s)", "unit": "rad/s"}},
             "observation": {"x": {"variables": "Out1", "unit": "1"}}}  # fmt: skip
    with FmiAsset(foreign_fmu("lag1"), parse_binding({"binding": header, **alone}), isolated=False) as lag:
        assert [lag.step(load={"u": float(n)}).values[0] for n in range(1, 5)] == values
    assert values[-1] > 0.0
    array = Connection(Endpoint("counter", "y"), Endpoint("lag", "In1 (rad/s)"))
    with pytest.raises(
        CouplingError,
        match=r"counter\.y cannot be the source .* of the type Float64, and an output of a single",
    ):
        Wiring(replace(wiring.structure, connections=(array,)))


@pytest.mark.parametrize(
    ("name", "words"),
    [("u", "it is an array"), ("ticked", "it changes with a clock"), ("blob", "it is of the type Binary")],
)
def test_what_is_no_single_number_is_not_set(foreign_fmu: Any, name: str, words: str) -> None:
    wrong = Component("a", foreign_fmu("array3"), {name: Setting(1.0)})
    with pytest.raises(CouplingError, match=rf"a\.{name} cannot be set: {words}; only single numbers"):
        Wiring(SystemStructure("one", (wrong,)))


def test_start_values_of_outputs_are_set(foreign_fmu: Any) -> None:
    """SSP 1.0, 5.2.3: what a parameter binding can set is everything that starts with a given value."""
    ball = Component("ball", foreign_fmu("ball2"), {"h": Setting(3.0), "v": Setting(-1.0)})
    seen = {"h": {"variables": ["ball.h", "ball.v"], "unit": ["m", "m/s"]}}
    binding = parse_binding({"binding": {"name": "ball", "step_size": 0.1}, "observation": seen})
    with CoupledAsset(SystemStructure("one", (ball,)), binding, isolated=False) as asset:
        asset.reset()
        assert asset.observe().values.tolist() == [3.0, -1.0]
        assert asset.step().values[0] == pytest.approx(3.0 - 0.1 - 0.5 * 9.81 * 0.01, abs=1e-4)
    wrong = Component("ball", foreign_fmu("ball2"), {"der(h)": Setting(3.0)})
    with pytest.raises(CouplingError, match=r"ball\.der\(h\) cannot be set: it is declared as local"):
        Wiring(SystemStructure("one", (wrong,)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (('endElement="structure" endConnector="load"', 'endElement="fuselage" endConnector="load"'),
         "names the element 'fuselage', which its system does not have"),
        (('endConnector="health.z1"', 'endConnector="health.z2"'),
         r"names the connector 'structure\.wing\.health\.z2', which is not declared"),
        (('startElement="damage" startConnector="z1" endConnector="loss"',
          'startElement="damage" startConnector="load_factor" endConnector="loss"'),
         r"joins 'damage\.load_factor' and 'loss', which both take a value"),
        (('startElement="structure" startConnector="tip" endConnector="tip"',
          'startElement="structure" startConnector="tip" endConnector="loss"'),
         "'loss' has two sources, 'damage.z1' and 'structure.tip'"),
        (("resources/wing.fmu", "resources/tail.fmu"),
         r"names the source 'resources/tail\.fmu', which is not in"),
        (("resources/wing.fmu", "../wing.fmu"), "lies outside the archive"),
        (("resources/wing.fmu", "%2e%2e/wing.fmu"), "lies outside the archive"),
        (("resources/wing.fmu", "/etc/wing.fmu"), "lies outside the archive"),
        (("resources/wing.fmu", "https://example.org/wing.fmu"), "lies outside the archive"),
        (('implementation="CoSimulation"', 'implementation="ModelExchange"'), "asks for model-exchange"),
        (('type="application/x-fmu-sharedlibrary"', 'type="application/x-ssp-package"'),
         "only FMUs are supported"),
        (('<ssd:ParameterBinding source="resources/top.ssv">',
          '<ssd:ParameterBinding source="resources/top.ssv" sourceBase="component">'),
         "lies inside a component, which is not supported"),
        (('<ssc:LinearTransformation factor="0.5" offset="0.25"/>',
          '<ssc:BooleanMappingTransformation><ssc:MapEntry source="true" target="false"/>'
          "</ssc:BooleanMappingTransformation>"),
         "has a BooleanMappingTransformation, not supported"),
        (('factor="0.5" offset="0.25"', 'factor="0.5" offset="NaN"'),
         "the offset of the connection .* must be a finite number, and NaN came"),
        (('<ssd:Component name="damage"', '<ssd:Component name="structure"'),
         "two elements named 'structure'"),
        (('name="z1" kind="output"', 'name="z1" kind="output" colour="red"'),
         r"not valid by the schema of SSP 1\.0 \(line \d+\).*colour"),
        (("</ssd:Units>", "</ssd:Unit>"), r"not well-formed XML \(.*line \d+, column \d+\)\.$"),
        (('name="z1" kind="output"', f'name="z1" kind="{"o" * 5000}"'), r"^.{,700}$"),
        (('version="1.0" name="theirs"', 'version="3.0" name="theirs"'), "not valid by the schema"),
        (('<ssd:Connector name="health.z1" kind="input"><ssc:Real/>',
          '<ssd:Connector name="health.z1" kind="input"><ssc:Integer/>'),
         r"structure\.wing\.health\.z1 is declared of the type Integer, but its FMU has it as Real"),
        (('name="tip_displacement" kind="output"/>', 'name="tip_displacement" kind="output">'
          '<ssc:Real unit="%"/></ssd:Connector>'), "declared in '%', but its FMU has it in 'm'"),
        (('<ssd:Connector name="loss" kind="output">',
          '<ssd:Connector name="loss" kind="calculatedParameter">'),
         "kind calculatedParameter"),
        (('value="0.2" unit="kg"', 'value="0.2" unit="%"'), "given in '%', but it is in 'kg'"),
        (('<ssd:Connector name="load" kind="input"/>',
          '<ssd:Connector name="load" kind="input"/><ssd:Connector name="load" kind="input"/>'),
         "is there twice"),
        (("</ssd:Connections>\n</ssd:System>\n<ssd:Units>",
          '</ssd:Connections><ssd:SignalDictionaries><ssd:SignalDictionary name="bus" source="resources/x"/>'
          "</ssd:SignalDictionaries>\n</ssd:System>\n<ssd:Units>"),
         "has signal dictionaries, not supported"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_structure_is_said(theirs: Pack, change: tuple[str, str], words: str) -> None:
    check = check_ssp(theirs(change))
    (sentence,) = check.problems
    assert re.search(words, sentence), sentence
    assert "\n" not in sentence


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("resources/wing.fmu", ("", "no FMU"), "resources/wing.fmu is not a sound FMU archive"),
        ("resources/top.ssm", ("damage.initial.z2", "damage.initial.z1"),
         "maps two parameters to 'damage.initial.z1'"),
        ("resources/top.ssm", ('target="damage.seed"', ""), "not valid by the schema"),
        ("resources/top.ssv", ('name="unused"', 'name="begin"'), "gives 'begin' twice"),
        ("resources/top.ssv", ('<ssv:Integer value="17"/>', '<ssv:String value="x"/>'),
         "damage.seed cannot be set to 'x': it is of the type Integer, and a number is needed"),
        ("resources/top.ssv", ('value="96"', 'value="many"'), "not valid by the schema"),
        ("resources/top.ssv", ('<ssv:Integer value="17"/>', '<ssv:Real value="17.5"/>'),
         "of the type Integer"),
        ("resources/top.ssv", ('<ssv:Integer value="17"/>', '<ssv:Real value="NaN"/>'),
         "must be a finite number, and NaN came"),
        ("resources/top.ssv", ('<ssv:Integer value="17"/>', '<ssv:Real value="INF"/>'),
         "must be a finite number"),
        ("resources/top.ssv", ("<ssv:ParameterSet", '<!DOCTYPE x [<!ENTITY e "x">]><ssv:ParameterSet'),
         "document type declaration"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_parameters_is_said(
    theirs: Pack, name: str, change: tuple[str, str], words: str
) -> None:
    text = {"resources/top.ssm": MAPPING, "resources/top.ssv": SET}.get(name, "")
    assert change[0] in text
    (sentence,) = check_ssp(theirs(files={name: text.replace(*change, 1)})).problems
    assert words in sentence


def test_archives_that_are_unsafe_or_damaged(theirs: Pack, tmp_path: Path) -> None:
    with pytest.raises(SspError, match="There is no SSP file"):
        check_ssp(tmp_path / "none.ssp")
    for options, words in (
        ({"files": {"../outside.txt": "x"}}, "extracted outside its folder"),
        ({"files": {"/etc/passwd": "x"}}, "extracted outside its folder"),
        ({"without": "SystemStructure.ssd"}, "so it is no SSP file"),
    ):
        with pytest.raises(SspError, match=words):
            read_ssp(theirs(**options), tmp_path / "fmus")
    good, kept = theirs().read_bytes(), tmp_path / "kept.ssp"
    for damaged in (b"no archive", good[: len(good) // 2]):
        kept.write_bytes(damaged)
        # Half of the file ends with one of its FMUs, which is an archive as well.
        with pytest.raises(SspError, match=r"not a sound SSP archive|so it is no SSP file"):
            read_ssp(kept, tmp_path / "fmus")
    place = len(good) // 2
    kept.write_bytes(good[:place] + bytes([good[place] ^ 1]) + good[place + 1 :])
    with pytest.raises(SspError, match=r"damaged|not a sound"):
        read_ssp(kept, tmp_path / "fmus")
    with zipfile.ZipFile(kept, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("SystemStructure.ssd", NESTED * 50)
    compressed = bytearray(kept.read_bytes())
    compressed[200:260] = bytes(60)
    kept.write_bytes(compressed)
    with pytest.raises(SspError, match="not a sound SSP archive"):
        read_ssp(kept, tmp_path / "fmus")
    assert not (tmp_path / "fmus").exists()
    assert not (tmp_path.parent / "outside.txt").exists()


def test_an_algebraic_loop_is_reported(theirs: Pack) -> None:
    """A wing that is loaded by its own tip: sound as a file, and said."""
    change = (
        '<ssd:Connection startConnector="load" endElement="wing" endConnector="load_factor"/>',
        '<ssd:Connection startElement="wing" startConnector="tip_displacement" endElement="wing" '
        'endConnector="load_factor" suppressUnitConversion="true"/>',
    )
    check = check_ssp(theirs(change))
    assert check.problems == ()
    assert "algebraic loop (structure.wing.tip_displacement -> structure.wing.load_factor" in check.loops[0]
