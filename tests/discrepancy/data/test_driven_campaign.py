"""Campaigns of driven trials: inputs with unit and hold, the begin of a trial, what is wrong with them."""

import numpy as np
import pytest

from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import Hold, Quantity, Start
from discrepancy.campaign.writing import write_campaign
from discrepancy.errors import CampaignFileError
from tests.discrepancy.data.test_campaign_file import same
from tests.refusals import Inputs


def test_inputs_come_out_in_si(tmp_path):
    """And come back as they were; a begin is written where it was said."""
    campaign = read_campaign(folder_of(tmp_path))
    first, second = campaign.trials
    heater, table, fan = first.inputs
    assert (heater.quantity, heater.hold, heater.offset_deviation) == (Quantity.HEAT, Hold.ZERO_ORDER, 10.0)
    assert heater.values[:2].tolist() == [1000.0, 2000.0]
    assert (table.hold, fan.hold) == (Hold.SMOOTH, None)
    assert table.values[3] == 3e-3
    assert first.force.tolist() == fan.values.tolist()
    assert fan.values[3] == 6e-3
    np.testing.assert_allclose(first.values[2], [22.0, np.pi])
    assert (first.begins, second.begins, second.inputs) == (Start.UNKNOWN, Start.SETTLED, ())
    said = " ".join(campaign.remarks)
    assert "The trial 'first' is begun in a state that is fitted." in said
    assert "The trial 'second' is taken to begin at rest under what acts at the first sample (assumed" in said
    settled = TOML.replace('"second.csv"', '"second.csv", begins = "settled"')
    for toml, count in ((TOML, 1), (settled, 2)):
        campaign = read_campaign(folder_of(tmp_path, toml))
        again = write_campaign(campaign, tmp_path / "again")
        assert same(read_campaign(again), campaign)
        assert (again / "campaign.toml").read_text("utf-8").count("\nbegins = ") == count
        assert campaign.trials[1].begin_assumed is (count == 1)


TOML = Inputs(__file__).text("heated_plate.toml")
HEAD = "time,heater,x,fan,plate,turned\n"
ROWS = [f"{0.1 * k + 0.01 * (k % 3):.3f},{1 + k},{k},{2 * k},{20 + k},{90 * k}" for k in range(10)]
FIRST = HEAD + "\n".join(ROWS)
SECOND = "time,plate,turned\n" + "\n".join(f"{k},{20 + k},{k}" for k in range(10))


def folder_of(path, toml=TOML):
    for name, text in (("campaign.toml", toml), ("first.csv", FIRST), ("second.csv", SECOND)):
        (path / name).write_text(text)
    return path


def test_a_forced_trial_says_what_it_assumes_of_its_begin(tmp_path):
    toml = TOML.split("input = ")[0] + '[[trial]]\nname = "pushed"\nkind = "forced"\nfile = "pushed.csv"\n'
    (tmp_path / "campaign.toml").write_text(toml)
    rows = [row.split(",") for row in ROWS]
    for first, said in (("0", False), ("3", True)):
        body = [f"{k}.0,{first if k == 0 else 1},{row[4]},{row[5]}" for k, row in enumerate(rows)]
        (tmp_path / "pushed.csv").write_text("time,force,plate,turned\n" + "\n".join(body))
        remarks = " ".join(read_campaign(tmp_path).remarks)
        assert ("is taken to begin at rest under what acts at the first sample" in remarks) is said


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('unit = "kW"', 'unit = "kN"',
         "the unit of 'heater': heat must have a unit such as W, mW or kW, and 'kN'"),
        ('column = "x"', 'column = "x", hold = "linear"', "'table' is a motion, which no drive makes"),
        ('column = "x"', 'column = "plate"', "more than one channel or input reads the column 'plate'"),
        ('column = "x"', 'column = "z1"', "the column 'z1' is reserved"),
        ('begins = "unknown"', 'begins = "sometime"', "begins"),
        ('kind = "driven"', 'kind = "flight"', "`begins` is for forced and driven ones"),
        ('name = "fan"', 'name = "heater"', "more than one input called 'heater'"),
    ],
)  # fmt: skip
def test_a_wrong_input_is_named_in_one_sentence(tmp_path, old, new, sentence):
    assert old in TOML
    with pytest.raises(CampaignFileError) as caught:
        read_campaign(folder_of(tmp_path, TOML.replace(old, new, 1)))
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_load_cell_of_driven_trials_may_be_called_force(tmp_path):
    angle = 'name = "turned", quantity = "angle", unit = "deg"'
    toml = TOML.replace(angle, 'name = "force", quantity = "force", unit = "kN"')
    folder_of(tmp_path, toml)
    for name, text in (("first.csv", FIRST), ("second.csv", SECOND)):
        (tmp_path / name).write_text(text.replace("turned", "force"))
    campaign = read_campaign(tmp_path)
    assert campaign.trials[0].values[2, 1] == 180e3
    write_campaign(campaign, tmp_path / "again")
    again = read_campaign(tmp_path / "again")
    np.testing.assert_array_equal(again.trials[0].values, campaign.trials[0].values)
    forced = toml.replace('name = "second", kind = "driven"', 'name = "second", kind = "forced"')
    (tmp_path / "campaign.toml").write_text(forced)
    with pytest.raises(CampaignFileError, match="the column 'force' holds an input of the trial"):
        read_campaign(tmp_path)
