"""Checks of SSP files: the step that they make, and what FMUs are called."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fmu_asset.client.experiment import default_experiment
from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.structure import Component, ComponentSetting, SystemStructure
from fmu_asset.coupling.system import system_description
from fmu_asset.coupling.wiring import Wiring
from fmu_asset.errors import CouplingError
from fmu_asset.ssp.check import check_ssp, join_ssp
from fmu_asset.ssp.reader import read_ssp
from tests.command_line import refused
from tests.fmu_asset.making import archive_of, members

SIREN = (
    '<ssd:SystemStructureDescription version="1.0" name="alarm" '
    'xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon" '
    'xmlns:ssd="http://ssp-standard.org/SSP1/SystemStructureDescription">'
    '<ssd:System name="top"><ssd:Elements>'
    '<ssd:Component name="siren" type="application/x-fmu-sharedlibrary" '
    'source="resources/horn.fmu"/>'
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
def pack_alarm(foreign_fmu: Any, tmp_path: Path) -> Callable[..., Path]:
    """Pack a system of one siren, or of another FMU in its place.

    The siren itself declares no step; `system` and `experiment` are annotations.
    """

    def pack(fmu: Path | None = None, *, system: str = "", experiment: str = "") -> Path:
        horn = fmu or foreign_fmu("siren2")
        description = SIREN.format(system=system, experiment=experiment)
        contents = {
            "SystemStructure.ssd": description,
            "resources/horn.fmu": horn.read_bytes(),
        }
        return archive_of(tmp_path / "alarm.ssp", contents)

    return pack


# ---------------------------------------------------------------------- the step


def test_a_check_makes_the_step_that_a_simulation_takes(pack_alarm):
    """A 500th of the time to the end, if nothing declares a step."""
    check = check_ssp(pack_alarm())

    assert (check.problems, check.step) == ((), 0.02)


def test_a_check_makes_the_step_that_an_fmu_declares(foreign_fmu, pack_alarm):
    """An FMU that takes 10 ms only, and refuses the step of 1 s."""
    check = check_ssp(pack_alarm(foreign_fmu("fixed2")))

    assert (check.problems, check.step) == ((), 0.01)


@pytest.mark.parametrize(
    ("place", "annotation", "step"),
    [("experiment", BASE_STEP.format("0.5"), 0.5), ("system", MASTER_STEP, 0.25)],
)
def test_a_declared_base_step_is_the_step(pack_alarm, tmp_path, place, annotation, step):
    file = pack_alarm(**{place: annotation})

    description = system_description(join_ssp(read_ssp(file, tmp_path / "fmus")))

    assert default_experiment(description).binding.step_size == step
    assert check_ssp(file).step == step


def test_a_negative_base_step_is_refused(pack_alarm):
    (sentence,) = check_ssp(pack_alarm(experiment=BASE_STEP.format("-1"))).problems

    assert "baseStepSize must be a positive number of seconds, but '-1' was given" in sentence


def test_the_stop_time_of_a_system_is_told_to_its_fmus(foreign_fmu, pack_alarm):
    siren = foreign_fmu("siren2", "WANTS_STOP_TIME=10.0")

    assert check_ssp(pack_alarm(siren)).problems == ()


# ---------------------------------------------------------------------- what FMUs are called


def test_a_failing_fmu_is_named_as_in_the_file(foreign_fmu, pack_alarm):
    """Never by the folder that it was extracted to."""
    crashing = foreign_fmu("hostile2", "SEGFAULT", "AFTER=0")

    (sentence,) = check_ssp(pack_alarm(crashing)).problems

    assert "component siren: resources/horn.fmu in " in sentence
    assert "uav-twin-fmu-" not in sentence


@pytest.mark.parametrize("step", [0, 37])
def test_a_simulation_names_the_step_of_a_crash_and_what_was_refused(foreign_fmu, pack_alarm, step):
    system = pack_alarm(foreign_fmu("hostile2", "SEGFAULT", f"AFTER={step}"))

    sentence = refused("ssp", "simulate", system, "--step-size", "0.01", "--stop-time", "1")

    assert f"component siren: resources/horn.fmu in {system}, step {step} from t = " in sentence
    assert "SIGSEGV" in sentence
    assert "The sandbox refused " in sentence


def test_an_fmu_for_another_platform_is_named_as_in_the_file(ours, pack_alarm, tmp_path):
    contents = {
        name: content
        for name, content in members(ours("python")).items()
        if not name.startswith("binaries/linux64")
    }
    elsewhere = archive_of(tmp_path / "elsewhere.fmu", contents)

    (sentence,) = check_ssp(pack_alarm(elsewhere)).problems

    expected = r"resources/horn\.fmu in \S+/alarm\.ssp has no binary for this platform"
    assert re.match(expected, sentence)


# ---------------------------------------------------------------------- enumerations


def test_an_enumeration_in_a_system_is_set_by_name(pack_alarm, tmp_path):
    wiring = join_ssp(read_ssp(pack_alarm(), tmp_path / "fmus"))
    experiment = default_experiment(system_description(wiring), values={"siren.loudness": "loud"})

    with CoupledAsset(
        wiring, experiment.binding, isolated=False, parameters=experiment.parameters
    ) as asset:
        (loudness, *_) = asset.step().values

    assert loudness == 10.0


def test_a_value_that_an_enumeration_of_a_system_lacks_is_refused(foreign_fmu):
    siren = Component("siren", foreign_fmu("siren2"), {"loudness": ComponentSetting(2)})

    with pytest.raises(CouplingError, match="it is an enumeration of quiet = 1, loud = 3"):
        Wiring(SystemStructure("one", (siren,)))
