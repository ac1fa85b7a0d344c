"""SSP files: what we write validates, is read by fmpy and by us, and flies the same."""

import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy.ssp.simulation import simulate_ssp
from fmpy.ssp.ssd import read_ssd
from hypothesis import given, settings
from hypothesis import strategies as st

from fmu_asset.archive.declared import UnitInfo
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
from fmu_asset.coupling.wiring import Wiring
from fmu_asset.ssp.check import check_ssp, join_ssp
from fmu_asset.ssp.reader import read_ssp
from fmu_asset.ssp.writer import write_ssp
from tests.fmu_asset.client.kinds import BINDINGS
from tests.fmu_asset.coupling.reference import of_ours
from tests.fmu_asset.making import tables
from tests.fmu_asset.ours import OurFmus

NAMES = ("damage", "wing", "gauges")
PARAMETER_NAMES = {Endpoint("gauges", "noise"): "noise"}
STOP_TIME = 9.0


@pytest.fixture(scope="module")
def structure(ours: OurFmus) -> SystemStructure:
    """The wing with damage before it and gauges behind it."""
    return of_ours(ours, tables(__file__, "cases")["ours"], "three")


@pytest.fixture(scope="module")
def ssp(structure: SystemStructure, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file that is written of this system."""
    path = tmp_path_factory.mktemp("ssp") / "three.ssp"
    return write_ssp(Wiring(structure), path, parameter_names=PARAMETER_NAMES, stop_time=STOP_TIME)


def fly(wiring: Wiring, **options: Any) -> np.ndarray:
    """Return what nine steps at 3 g show."""
    with CoupledAsset(wiring, BINDINGS["three_sent"], isolated=False, **options) as asset:
        return np.array([asset.step({"load_factor": 3.0}).values for _ in range(9)])


# ---------------------------------------------------------------------- read by us


@pytest.fixture(scope="module")
def read_back(ssp: Path, tmp_path_factory: pytest.TempPathFactory) -> Wiring:
    """What we read of the file."""
    return join_ssp(read_ssp(ssp, tmp_path_factory.mktemp("read")))


def test_names_of_a_system_and_its_components_are_read_back(read_back):
    components = [component.name for component in read_back.structure.components]

    assert read_back.structure.name == "three"
    assert components == list(NAMES)


def test_fmus_are_read_back(structure, read_back):
    pairs = zip(structure.components, read_back.structure.components, strict=True)

    for written, read in pairs:
        assert read.fmu.read_bytes() == written.fmu.read_bytes(), written.name


def test_a_system_flies_the_same_after_it_was_read_back(structure, read_back):
    np.testing.assert_array_equal(fly(read_back), fly(Wiring(structure)))


def test_what_was_read_is_written_with_the_same_bytes(ssp, read_back, tmp_path):
    again = write_ssp(
        read_back,
        tmp_path / "again.ssp",
        parameter_names=PARAMETER_NAMES,
        stop_time=STOP_TIME,
    )

    assert again.read_bytes() == ssp.read_bytes()


def test_a_file_is_replaced_if_asked(ssp, read_back, tmp_path):
    path = tmp_path / "again.ssp"
    path.write_bytes(b"old")

    write_ssp(read_back, path, parameter_names=PARAMETER_NAMES, stop_time=STOP_TIME, replace=True)

    assert path.read_bytes() == ssp.read_bytes()


def test_a_written_file_has_no_problems(ssp):
    assert check_ssp(ssp).problems == ()


# ---------------------------------------------------------------------- read by fmpy


@pytest.fixture(scope="module")
def fmpy_system(ssp: Path):
    """What fmpy reads, which validates SSD, SSV and SSM by the schemas that it ships."""
    return read_ssd(str(ssp)).system


@dataclass(frozen=True)
class FmpyParameters:
    """The parameter set of a system as fmpy reads it, and the ends that its names are mapped to."""

    parameter_set: Any
    targets: dict[str, str]


@pytest.fixture
def fmpy_parameters(ssp: Path) -> FmpyParameters:
    (binding,) = read_ssd(str(ssp)).system.parameterBindings
    (mapping,) = binding.parameterMapping
    targets = {entry.source: entry.target for entry in mapping.mappingEntries}
    return FmpyParameters(binding.parameterValues[0], targets)


def test_the_description_is_the_first_member_of_the_file(ssp):
    with zipfile.ZipFile(ssp) as archive:
        assert archive.namelist()[0] == "SystemStructure.ssd"


def test_fmpy_reads_components_and_connections(structure, fmpy_system):
    assert [component.name for component in fmpy_system.elements] == list(NAMES)
    assert len(fmpy_system.connections) == len(structure.connections)


def test_fmpy_reads_parameters_and_their_mapping(fmpy_parameters):
    parameters = fmpy_parameters.parameter_set.parameters
    values = {parameter.name: parameter.value for parameter in parameters}

    assert float(values["noise"]) == pytest.approx(120e-6, rel=1e-15)
    assert values["wing.response"] == "quasi_static"
    assert fmpy_parameters.targets["noise"] == "gauges.noise"


def test_fmpy_simulates_a_system_as_our_jacobi_does(ssp, structure, fmpy_parameters):
    """Fmpy exchanges all values after a step, from zero at the start.

    In three steps that is forgotten.
    """
    parameter_set = fmpy_parameters.parameter_set
    for parameter in parameter_set.parameters:
        parameter.name = fmpy_parameters.targets[parameter.name]
    # Fmpy passes the name of an enumeration's item on as if it were a number; the start value is
    # the same item.
    parameter_set.parameters = [
        parameter for parameter in parameter_set.parameters if parameter.type != "Enumeration"
    ]

    result = simulate_ssp(
        str(ssp),
        stop_time=STOP_TIME,
        step_size=1.0,
        parameter_set=parameter_set,
        input={"load_factor": lambda _: 3.0},
    )

    readings = np.array([result[f"reading[{gauge}]"] for gauge in range(1, 25)]).T
    ours = fly(Wiring(structure), algorithm="jacobi")
    np.testing.assert_array_equal(readings[3:], ours[3:])
    assert np.abs(ours[4:]).min() > 0.0


# ---------------------------------------------------------------------- any connection and value

NUMBERS = st.floats(-1e6, 1e6).filter(lambda value: value == 0.0 or abs(value) > 1e-9)
ENDS = [
    ("damage.z1", "gauges.strain[1]"),
    ("damage.z2", "gauges.strain[2]"),
    ("gauges.reading[7]", "damage.load_factor"),
    ("damage.z1", "out"),
]
PERCENT = UnitInfo("%", (0,) * 8, 0.01, 0.0, ())


@st.composite
def draw_connections(draw: st.DrawFn) -> tuple[Connection, ...]:
    """Draw a connection of each pair of ends, with a transformation, a unit and a delay."""
    connections = []
    for source, target in ENDS:
        connection, *_ = expand_connection(source, target, NAMES)
        connections.append(
            replace(
                connection,
                factor=draw(NUMBERS),
                offset=draw(NUMBERS),
                convert_units=draw(st.booleans()),
                delayed=draw(st.booleans()),
            )
        )
    return tuple(connections)


@pytest.fixture(scope="module")
def write_and_read(ours: OurFmus, tmp_path_factory) -> Callable[..., Any]:
    """Write a system of damage and gauges, let fmpy validate it, and read it."""

    def write(
        connections: tuple[Connection, ...],
        settings_of_damage: dict[str, ComponentSetting],
        steps: int,
    ) -> tuple[SystemStructure, SystemStructure]:
        components = (
            Component("damage", ours("damage_growth"), settings_of_damage, steps),
            Component("gauges", ours("strain_gauges")),
        )
        connectors = (Connector("out", "output", "%"),)
        written = SystemStructure("drawn", components, connectors, connections, (PERCENT,))
        folder = tmp_path_factory.mktemp("drawn")
        path = write_ssp(Wiring(written), folder / "x.ssp")
        read_ssd(str(path))  # what SSP has no word for is still valid for others
        return written, read_ssp(path, folder / "fmus")

    return write


@settings(max_examples=25, deadline=None)
@given(draw_connections(), st.integers(1, 9), st.floats(0.0, 1.0), st.integers(0, 2**31 - 1))
def test_any_connection_and_value_survives(write_and_read, connections, steps, level, seed):
    values = {"level": ComponentSetting(level, "1"), "seed": ComponentSetting(seed)}

    written, read = write_and_read(connections, values, steps)

    assert read.connections == written.connections
    assert read.connectors == written.connectors
    assert facts_of_components(read) == facts_of_components(written)


def facts_of_components(system: SystemStructure) -> list[tuple[Any, ...]]:
    return [
        (component.name, component.settings, component.substeps) for component in system.components
    ]
