"""Temperatures of a laboratory's tables in kelvin, degrees Celsius and degrees Fahrenheit."""

import numpy as np
import pytest

from discrepancy.campaign.importing import LaboratoryImport
from discrepancy.campaign.records import Quantity
from discrepancy.campaign.sheet import read_sheet
from discrepancy.errors import CampaignFileError
from tests.refusals import Inputs, refused

CELSIUS = np.array([-40.0, 0.0, 20.0, 21.5, 100.0, 37.0, 25.0, 30.0, 35.0])
READINGS = {
    "K": ["233.15", "273.15", "293.15", "294.65", "373.15", "310.15", "298.15", "303.15", "308.15"],
    "degF": ["-40", "32", "68", "70.7", "212", "98.6", "77", "86", "95"],
    "degC": ["-40", "0", "20", "21.5", "100", "37", "25", "30", "35"],
}
"""The same temperatures in each unit, exactly."""


def imported(folder, head, readings, **answers):
    """Return the import of a driven trial with a temperature and a displacement."""
    lines = [f"{row},{cell},{row}.5" for row, cell in enumerate(READINGS[readings])]
    (folder / "lab.csv").write_text("\n".join([f"t [s],{head},w [mm]", *lines]), "utf-8")
    roles = {"T": "temperature", "w": "displacement"} | answers.pop("column", {})
    stated = {"kind": {"": "driven"}, "column": roles, "reference-temperature": {"": "20"}}
    quantity_of = answers.pop("quantity_of", None)
    return LaboratoryImport([read_sheet(folder / "lab.csv")], stated | answers, quantity_of)


@pytest.mark.parametrize(
    ("head", "unit"),
    [
        ("T [K]", "K"), ("T [Kelvin]", "K"), ("T (deg K)", "K"),
        ("T [degF]", "degF"), ("T [°F]", "degF"), ("T (Deg F)", "degF"), ("T [F]", "degF"),
        ("T [degC]", "degC"), ("T [C]", "degC"),
    ],
)  # fmt: skip
def test_a_temperature_becomes_degrees_celsius(tmp_path, head, unit):
    campaign = imported(tmp_path, head, unit).campaign("warm")

    np.testing.assert_allclose(campaign.trials[0].temperature, CELSIUS - 20.0, rtol=0.0, atol=1e-12)


def test_no_digit_of_a_temperature_is_lost(tmp_path):
    understood = imported(tmp_path, "T [°F]", "degF")

    (column,) = (column for column in understood.columns if column.role == "temperature")
    assert [float(cell) for cell in column.cells_in_si(".")] == CELSIUS.tolist()


@pytest.mark.parametrize(("letter", "unit"), [("F", "degF"), ("C", "degC")])
def test_a_letter_is_degrees_where_the_column_is_stated_to_be_a_temperature(tmp_path, letter, unit):
    campaign = imported(tmp_path, "T", unit, unit={"T": letter}).campaign("warm")

    np.testing.assert_allclose(campaign.trials[0].temperature, CELSIUS - 20.0, rtol=0.0, atol=1e-12)


def test_a_letter_beside_another_name_stays_what_it_is(tmp_path):
    (tmp_path / "lab.csv").write_text("t [s],q [C]\n0,1\n1,2\n", "utf-8")

    assert read_sheet(tmp_path / "lab.csv").units == ("s", "C")


def test_an_output_in_degrees_fahrenheit_becomes_degrees_celsius(tmp_path):
    outputs = {"plate": Quantity.TEMPERATURE, "displacement": Quantity.DISPLACEMENT}
    understood = imported(
        tmp_path,
        "T [degF]",
        "degF",
        column={"T": "plate"},
        quantity_of=outputs.get,
        zero={"T": "0.9degF"},
    )

    campaign = understood.campaign("warm")

    plate = campaign.channels["T"]
    assert (plate.unit, plate.offset_deviation) == ("degC", pytest.approx(0.5, rel=1e-12))
    np.testing.assert_allclose(campaign.trials[0].values[:, 0], CELSIUS, rtol=0.0, atol=1e-12)
    assert understood.units()["T"] == "degC"


def test_a_scale_leads_to_the_unit_of_the_readings(tmp_path):
    understood = imported(tmp_path, "T [V]", "degF", scale={"T": "2 degF/V"})

    temperature = understood.campaign("warm").trials[0].temperature

    in_fahrenheit = 2.0 * np.array([float(cell) for cell in READINGS["degF"]])
    np.testing.assert_allclose(temperature + 20.0, (in_fahrenheit - 32.0) / 1.8, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("answer", ["20", "20degC", "20 °C", "293.15K", "293.15 kelvin", "68degF", "68 F"])
def test_the_reference_temperature_may_have_a_unit(tmp_path, answer):
    understood = imported(tmp_path, "T [K]", "K", **{"reference-temperature": {"": answer}})

    assert understood.reference_temperature == 20.0


@pytest.mark.parametrize("answer", ["warm", "20mm", "nan"])
def test_a_reference_that_is_no_temperature_is_refused(tmp_path, answer):
    with refused(CampaignFileError, "--reference-temperature must be a temperature such as 20, 293.15K"):
        imported(tmp_path, "T [K]", "K", **{"reference-temperature": {"": answer}})


def test_a_campaign_written_by_hand_is_refused_in_fahrenheit():
    from discrepancy.campaign.schema import parse_campaign

    content = Inputs(__file__).table("heated/campaign.toml")
    for channel in content["channel"]:
        if channel["quantity"] == "temperature":
            channel["unit"] = "°F"

    with refused(CampaignFileError, "is °F: convert its readings to degC or K"):
        parse_campaign(content, "campaign.toml")
