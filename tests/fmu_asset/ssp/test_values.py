"""Values of parameter sets that are no numbers: texts, and items of enumerations by their names."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
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
    """Return what packs a siren with a parameter set: `alarm("siren2", binding, name=value element)`."""

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
    """Return the sound of a siren after a step: 10 if loud, 1 if quiet, plus the length of its label."""
    with CoupledAsset(wiring, watch("siren.y", step_size=0.1), isolated=False) as asset:
        return float(asset.step().values[0])


@pytest.mark.parametrize(
    ("binding", "text_name", "item_name"),
    [
        (IN_THE_FILE, "siren.label", "siren.loudness"),
        (BESIDE, "siren.label", "siren.loudness"),
        (MAPPED, "name", "horn"),
    ],
    ids=["in the file", "in a file of its own", "by a mapping"],
)
def test_a_text_and_an_item_are_set_on_the_fmu(
    alarm, binding, text_name, item_name, tmp_path
) -> None:
    """Also a text that looks like a number; both are written as they were read."""
    parameters = {
        text_name: '<ssv:String value="1,25 é"/>',
        item_name: '<ssv:Enumeration value="loud"/>',
    }
    path = alarm("siren2", binding, parameters)
    wiring = join_ssp(read_ssp(path, tmp_path / "fmus"))
    assert wiring.settings["siren"] == {"label": "1,25 é", "loudness": 3.0}
    assert wiring.left_out == []
    assert heard(wiring) == 10.0 + len("1,25 é".encode())
    check = check_ssp(path)
    assert (check.problems, check.parameters) == ((), 2)
    again = join_ssp(read_ssp(write_ssp(wiring, tmp_path / "again.ssp"), tmp_path / "more"))
    assert again.settings == wiring.settings
    assert heard(again) == heard(wiring)


@pytest.mark.parametrize("model", ["siren1", "siren3"])
def test_an_fmu_of_another_version_takes_a_text(alarm, model, tmp_path) -> None:
    plain = alarm(model, BESIDE, {"siren.broken": '<ssv:Real value="0"/>'}).rename(
        tmp_path / "plain.ssp"
    )
    path = alarm(model, BESIDE, {"siren.label": '<ssv:String value="horn"/>'})
    sounds = [heard(join_ssp(read_ssp(each, tmp_path / each.stem))) for each in (path, plain)]
    assert sounds[0] == sounds[1] + len("horn")


def test_a_text_stays_after_a_reset_and_another_one_is_another_system(foreign_fmu) -> None:
    """Where the same system has another text, no state of it is taken."""
    siren = Component("siren", foreign_fmu("siren2"), {"label": ComponentSetting("horn")})
    other = replace(siren, settings={"label": ComponentSetting("whistle")})
    binding = watch("siren.y", step_size=0.1)
    first, second = (
        CoupledAsset(SystemStructure("s", (c,)), binding, isolated=False) for c in (siren, other)
    )
    with first, second:
        sounds = []
        for asset in (first, second):
            asset.step()
            asset.reset({})
            sounds.append(asset.step().values[0])
        np.testing.assert_array_equal(sounds, [1.0 + len("horn"), 1.0 + len("whistle")])
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
