"""Values of parameter sets that are no numbers: texts, and items of enumerations by their names."""

from collections.abc import Callable
from pathlib import Path

import pytest

from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.structure import Component, ComponentSetting, SystemStructure
from fmu_asset.coupling.wiring import Wiring
from fmu_asset.errors import CouplingError
from fmu_asset.ssp.check import check_ssp, join_ssp
from fmu_asset.ssp.reader import read_ssp
from fmu_asset.ssp.writer import write_ssp
from tests.fmu_asset.making import archive_of, watch

SYSTEM = """<?xml version="1.0" encoding="UTF-8"?>
<ssd:SystemStructureDescription version="1.0" name="alarm"
  xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon"
  xmlns:ssd="http://ssp-standard.org/SSP1/SystemStructureDescription"
  xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues"
  xmlns:ssm="http://ssp-standard.org/SSP1/SystemStructureParameterMapping">
<ssd:System name="top">
  <ssd:ParameterBindings><ssd:ParameterBinding{binding}</ssd:ParameterBinding></ssd:ParameterBindings>
  <ssd:Elements><ssd:Component name="siren" source="resources/siren.fmu"><ssd:Connectors>
    <ssd:Connector name="label" kind="parameter"><ssc:String/></ssd:Connector>
    <ssd:Connector name="y" kind="output"><ssc:Real/></ssd:Connector>
  </ssd:Connectors></ssd:Component></ssd:Elements>
</ssd:System></ssd:SystemStructureDescription>
"""
SET = """<ssv:ParameterSet version="1.0" name="values"
  xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues">
<ssv:Parameters>{parameters}</ssv:Parameters></ssv:ParameterSet>"""
IN_THE_FILE = "><ssd:ParameterValues>{set}</ssd:ParameterValues>"
BESIDE = ' source="resources/values.ssv">'
MAPPED = (
    BESIDE + '<ssd:ParameterMapping><ssm:ParameterMapping version="1.0">'
    '<ssm:MappingEntry source="name" target="siren.label"/>'
    '<ssm:MappingEntry source="horn" target="siren.loudness"/>'
    "</ssm:ParameterMapping></ssd:ParameterMapping>"
)
Pack = Callable[..., Path]


@pytest.fixture
def alarm(foreign_fmu, tmp_path: Path) -> Pack:
    """Pack a siren with a parameter set: its model, the binding, and value elements by name."""

    def pack(model: str, binding: str, parameters: dict[str, str]) -> Path:
        rows = (
            f'<ssv:Parameter name="{name}">{value}</ssv:Parameter>'
            for name, value in parameters.items()
        )
        values = SET.format(parameters="".join(rows))
        contents = {
            "SystemStructure.ssd": SYSTEM.format(binding=binding.format(set=values)),
            "resources/values.ssv": values,
            "resources/siren.fmu": foreign_fmu(model).read_bytes(),
        }
        return archive_of(tmp_path / "alarm.ssp", contents)

    return pack


def heard(wiring: Wiring) -> float:
    """Return the sound of a siren after a step.

    It is 10 if loud and 1 if quiet, plus the length of its label.
    """
    with CoupledAsset(wiring, watch("siren.y", step_size=0.1), isolated=False) as asset:
        return float(asset.step().values[0])


NUMBER_LIKE_TEXT = "1,25 é"
WAYS_OF_VALUES = {
    "in the file": (IN_THE_FILE, "siren.label", "siren.loudness"),
    "in a file of its own": (BESIDE, "siren.label", "siren.loudness"),
    "by a mapping": (MAPPED, "name", "horn"),
}
"""The binding, and the names of text and item in it."""


@pytest.fixture(params=WAYS_OF_VALUES)
def alarm_with_text(request, alarm) -> Path:
    """A file that sets a text, which looks like a number, and an item of an enumeration."""
    binding, text_name, item_name = WAYS_OF_VALUES[request.param]
    parameters = {
        text_name: f'<ssv:String value="{NUMBER_LIKE_TEXT}"/>',
        item_name: '<ssv:Enumeration value="loud"/>',
    }
    return alarm("siren2", binding, parameters)


def join_file(path: Path, folder: Path) -> Wiring:
    """Read a file, extract its FMUs into a folder, and join them."""
    return join_ssp(read_ssp(path, folder))


def test_a_text_and_an_item_are_read(alarm_with_text, tmp_path):
    wiring = join_file(alarm_with_text, tmp_path / "fmus")

    assert wiring.settings["siren"] == {"label": NUMBER_LIKE_TEXT, "loudness": 3.0}
    assert wiring.left_out == []


def test_a_text_and_an_item_are_set_on_the_fmu(alarm_with_text, tmp_path):
    wiring = join_file(alarm_with_text, tmp_path / "fmus")

    assert heard(wiring) == 10.0 + len(NUMBER_LIKE_TEXT.encode())


def test_a_text_and_an_item_are_checked(alarm_with_text):
    check = check_ssp(alarm_with_text)

    assert (check.problems, check.parameters) == ((), 2)


def test_a_text_and_an_item_are_written_as_they_were_read(alarm_with_text, tmp_path):
    wiring = join_file(alarm_with_text, tmp_path / "fmus")

    again = join_file(write_ssp(wiring, tmp_path / "again.ssp"), tmp_path / "more")

    assert again.settings == wiring.settings
    assert heard(again) == heard(wiring)


@pytest.mark.parametrize("model", ["siren1", "siren3"])
def test_an_fmu_of_another_version_takes_a_text(alarm, model, tmp_path):
    without_text = alarm(model, BESIDE, {"siren.broken": '<ssv:Real value="0"/>'})
    sound_without_text = heard(join_file(without_text, tmp_path / "without"))
    with_text = alarm(model, BESIDE, {"siren.label": '<ssv:String value="horn"/>'})

    sound = heard(join_file(with_text, tmp_path / "with"))

    assert sound == sound_without_text + len("horn")


@pytest.fixture
def open_siren(foreign_fmu) -> Callable[[str], CoupledAsset]:
    """A function that opens a system of one siren with a text."""

    def open_with(text: str) -> CoupledAsset:
        siren = Component("siren", foreign_fmu("siren2"), {"label": ComponentSetting(text)})
        binding = watch("siren.y", step_size=0.1)
        return CoupledAsset(SystemStructure("s", (siren,)), binding, isolated=False)

    return open_with


@pytest.mark.parametrize("text", ["horn", "whistle"])
def test_a_text_stays_after_a_reset(open_siren, text):
    with open_siren(text) as asset:
        asset.step()
        asset.reset({})

        (sound,) = asset.step().values

    assert sound == 1.0 + len(text)


def test_a_system_with_another_text_is_another_system(open_siren):
    """So that no state of one is taken by the other."""
    with open_siren("horn") as first, open_siren("whistle") as second:
        assert first.description.sha256 != second.description.sha256


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("label", '<ssv:Real value="3"/>', r"to 3\.0: it is of the type String, and takes a text"),
        (
            "label",
            '<ssv:Binary value="0a"/>',
            r"to b'\\n': it is of the type String, and takes a text",
        ),
        ("broken", '<ssv:String value="no"/>', r"to 'no': .* takes a number"),
        ("broken", '<ssv:Binary value="0a"/>', r"to b'\\n': .* takes a number"),
        ("loudness", '<ssv:Enumeration value="shrill"/>', r"to 'shrill': .*quiet.*loud"),
    ],
)
def test_a_value_of_another_type_is_refused(alarm, name, value, sentence, tmp_path) -> None:
    path = alarm("siren2", BESIDE, {f"siren.{name}": value})
    with pytest.raises(CouplingError, match=rf"siren\.{name} cannot be set {sentence}"):
        join_ssp(read_ssp(path, tmp_path / "fmus"))
