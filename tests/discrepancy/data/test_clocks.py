"""Tables in which each channel has times of its own become one table, and no reading is invented."""

from itertools import zip_longest

import numpy as np
import pytest

from discrepancy.campaign.importing import LaboratoryImport
from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.sheet import read_sheet
from discrepancy.campaign.writing import write_campaign
from discrepancy.errors import CampaignDataError, CampaignFileError

FAST = [f"{k / 100:.2f}" for k in range(40)]
SLOW = [f"{k * 0.025:.3f}" for k in range(16)]
ROLES = {"acc1": "a", "acc2": "b", "w": "w"}


def readings(times, frequency=7.0):
    return [f"{np.sin(frequency * float(time)):.6f}" for time in times]


def table(folder, heads, *columns):
    """Write columns side by side, a shorter one with empty cells below."""
    rows = zip_longest(*columns, fillvalue="")
    text = "\n".join([",".join(heads), *(",".join(row) for row in rows)])
    (folder / "lab.csv").write_text(text + "\n", "utf-8")
    return read_sheet(folder / "lab.csv")


def understood(sheet, kind="driven", **answers):
    roles = {head: ROLES[head] for head in sheet.heads if head in ROLES}
    given = {"kind": {"": kind}, "column": roles, "zero": {"": "exact"}, "gain": {"": "exact"}}
    given["column"] |= answers.pop("column", {})
    return LaboratoryImport([sheet], given | answers)


def two_clocks(
    folder, first=FAST, second=SLOW, heads=("time1 [s]", "acc1 [m/s2]", "time2 [s]", "acc2 [m/s2]")
):
    return table(folder, heads, first, readings(first), second, readings(second))


@pytest.fixture
def imported_clocks(tmp_path):
    """The import of a table with two clocks, and its campaign."""
    laboratory = understood(two_clocks(tmp_path))
    return laboratory, laboratory.campaign("lab")


def test_a_trial_of_two_clocks_has_the_stamps_of_both(imported_clocks):
    (trial,) = imported_clocks[1].trials
    stamps = sorted({round(float(time), 3) for time in FAST + SLOW})
    np.testing.assert_allclose(trial.time, stamps, atol=1e-12)


@pytest.mark.parametrize(("channel", "times"), [(0, FAST), (1, SLOW)])
def test_each_reading_stays_at_its_own_time(imported_clocks, channel, times):
    (trial,) = imported_clocks[1].trials
    used = trial.used[:, channel]
    np.testing.assert_allclose(trial.time[used], [float(time) for time in times], atol=1e-12)
    assert [f"{value:.6f}" for value in trial.values[used, channel]] == readings(times)


def test_an_import_says_that_two_clocks_became_one(imported_clocks):
    laboratory, campaign = imported_clocks
    sentence = (
        "'acc1' by 'time1' and 'acc2' by 'time2': one clock has the 48 stamps of all, and a channel "
        "has no reading where its own clock has no stamp."
    )
    assert laboratory.clock_sentences == [f"lab.csv: {sentence}"]
    assert sentence in campaign.provenance[0]


def test_a_stamp_of_another_clock_is_written_as_an_empty_cell(imported_clocks, tmp_path):
    laboratory, campaign = imported_clocks
    folder = write_campaign(campaign, tmp_path / "lab", units=laboratory.units(), left_out_as_empty=True)
    assert (folder / "01_lab.csv").read_text("utf-8").splitlines()[4] == "0.025,,0.174108"


def test_a_stamp_of_another_clock_is_read_as_left_out(imported_clocks, tmp_path):
    laboratory, campaign = imported_clocks
    folder = write_campaign(campaign, tmp_path / "lab", units=laboratory.units(), left_out_as_empty=True)
    (trial,) = campaign.trials
    (again,) = read_campaign(folder).trials
    assert "left_out" not in (folder / "campaign.toml").read_text("utf-8")
    np.testing.assert_array_equal(again.used, trial.used)
    np.testing.assert_allclose(again.values[again.used], trial.values[trial.used], rtol=1e-14)


def test_equal_clocks_become_one_though_printed_otherwise(tmp_path):
    milliseconds = [f"{10 * k}" for k in range(40)]
    heads = ("Time [s]", "acc1 [m/s2]", "Time [ms]", "acc2 [m/s2]")
    found = understood(two_clocks(tmp_path, FAST, milliseconds, heads))
    (trial,) = found.campaign("lab").trials
    assert (len(trial.time), trial.used.all()) == (40, True)
    assert found.clock_sentences == [
        "lab.csv: 'acc1' by 'Time' and 'acc2' by 'Time 2': the clocks are equal and are merged into one."
    ]


@pytest.mark.parametrize(("first", "second"), [(SLOW, FAST), (FAST, SLOW), (FAST[:30], FAST)])
def test_the_longer_clock_may_stand_on_either_side(tmp_path, first, second):
    (trial,) = understood(two_clocks(tmp_path, first, second)).campaign("lab").trials
    assert trial.used.sum(axis=0).tolist() == [len(first), len(second)]


@pytest.mark.parametrize(
    "order",
    [(0, 1, 2, 3), (1, 3, 0, 2), (1, 0, 3, 2), (0, 2, 1, 3)],
    ids=["in pairs", "by the alphabet", "behind", "times in front"],
)
def test_names_or_places_say_which_clock_a_channel_has(tmp_path, order):
    heads = ("time1 [s]", "acc1 [m/s2]", "time2 [s]", "acc2 [m/s2]")
    columns = (FAST, readings(FAST), SLOW, readings(SLOW))
    sheet = table(tmp_path, [heads[k] for k in order], *(columns[k] for k in order))
    (trial,) = understood(sheet).campaign("lab").trials
    used = dict(zip(trial.channels, trial.used.sum(axis=0).tolist(), strict=True))
    assert used == {"acc1": 40, "acc2": 16}


@pytest.mark.parametrize(
    ("hold", "reference"),
    [
        ("linear", np.interp),
        ("zero_order", lambda t, own, values: values[np.searchsorted(own, t + 1e-9) - 1]),
    ],
)
def test_a_load_is_filled_in_by_its_hold_and_rows_without_it_are_left_out(tmp_path, hold, reference):
    heads = ("t1 [s]", "w [mm]", "t2 [s]", "pull [N]")
    loads = [f"{time}" for time in SLOW[1:12]]
    sheet = table(tmp_path, heads, FAST, readings(FAST), loads, readings(loads))
    found = understood(sheet, column={"pull": "input:pull"}, hold={"pull": hold})
    (trial,) = found.campaign("lab").trials
    own, values = np.array(loads, dtype=float), np.array(readings(loads), dtype=float)
    assert (trial.time[0], trial.time[-1]) == pytest.approx((own[0], own[-1]))
    np.testing.assert_allclose(trial.inputs[0].values, reference(trial.time, own, values), atol=1e-12)
    sentence = found.clock_sentences[0]
    assert f"loads are interpolated there: 'pull' ({hold.replace('_', ' ')})" in sentence
    assert sentence.endswith("stamps before or after their records are left out.")


def test_stamps_with_dates_keep_what_lies_between_the_clocks(tmp_path):
    first = [f"2026-02-01 10:00:{k:02d}" for k in range(20)]
    second = [f"2026-02-01 10:00:{k:02d}.5" for k in range(3, 15)]
    heads = ("stamp1", "acc1 [m/s2]", "stamp2", "acc2 [m/s2]")
    cells = [f"{k % 7}.5" for k in range(20)]
    (trial,) = understood(table(tmp_path, heads, first, cells, second, cells[:12])).campaign("lab").trials
    assert trial.time[trial.used[:, 1]].tolist() == [k + 0.5 for k in range(3, 15)]


def test_samples_at_rest_of_one_rate_stand_beside_each_other(tmp_path):
    late = [f"{k / 100 + 0.005:.3f}" for k in range(30)]
    rest = two_clocks(tmp_path, FAST, late)
    (tmp_path / "swing").mkdir()
    swing = two_clocks(tmp_path / "swing")
    (tmp_path / "swing/lab.csv").rename(tmp_path / "swing/swing.csv")
    swing = read_sheet(tmp_path / "swing/swing.csv")
    given = {"kind": {"lab.csv": "noise", "swing.csv": "driven"}, "column": {"acc1": "a", "acc2": "b"}}
    campaign = LaboratoryImport([rest, swing], given).campaign("lab")
    noise = [campaign.channels[name].noise for name in ("acc1", "acc2")]
    assert [(len(item.samples), round(item.interval, 9)) for item in noise] == [(40, 0.01), (30, 0.01)]
    other = two_clocks(tmp_path)
    with pytest.raises(
        CampaignFileError, match=r"every 0\.01 s by 'time1' and 0\.025 s by 'time2', and a campaign"
    ):
        LaboratoryImport([other, swing], given).campaign("lab")


def refusal(sheet, kind="driven", error=CampaignFileError, **answers):
    """Return the sentence with which the import of a sheet is refused."""
    with pytest.raises(error) as caught:
        understood(sheet, kind, **answers).campaign("lab")
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_static_trial_has_no_two_clocks(tmp_path):
    force = {"column": {"acc1": "force"}, "unit": {"acc1": "N"}}
    sentence = refusal(two_clocks(tmp_path), "static", **force)
    assert "and a row of a static trial is one state at rest" in sentence


def test_clocks_whose_names_and_places_contradict_each_other_are_refused(tmp_path):
    crossed = ("time1 [s]", "acc2 [m/s2]", "time2 [s]", "acc1 [m/s2]")
    sentence = refusal(two_clocks(tmp_path, heads=crossed))
    assert "names and places contradict each other" in sentence


def test_clocks_that_neither_names_nor_places_tell_apart_are_refused(tmp_path):
    heads = ("time a [s]", "time b [s]", "acc1 [m/s2]", "acc2 [m/s2]")
    beside = table(tmp_path, heads, FAST, FAST, readings(FAST), readings(FAST))
    assert "neither the names nor the places of the columns show it" in refusal(beside)


def test_a_clock_that_goes_back_is_refused(tmp_path):
    back = [*SLOW[:4], "0.01", *SLOW[5:]]
    sentence = refusal(two_clocks(tmp_path, second=back), error=CampaignDataError)
    assert "the time of the column 'time2' does not increase after sample 4" in sentence


LATE = [f"{9 + row / 100:.2f}" for row in range(12)]


def test_an_input_at_no_time_of_the_readings_is_refused(tmp_path):
    pull = {"column": {"acc2": "input:pull"}, "unit": {"acc2": "N"}}
    sentence = refusal(two_clocks(tmp_path, second=LATE), **pull)
    assert "no time at which both 'acc2' (linear) and 'acc1' are known" in sentence


def test_a_reading_without_a_time_is_refused_by_its_line(tmp_path):
    two_clocks(tmp_path, second=LATE)
    file = tmp_path / "lab.csv"
    lines = file.read_text("utf-8").splitlines()
    lines[5] = lines[5].replace(f",{LATE[4]},", ",,")
    file.write_text("\n".join(lines) + "\n", "utf-8")
    assert "lab.csv, line 6: 'acc2' has a reading, but 'time2' has no time" in refusal(read_sheet(file))


@pytest.mark.parametrize("cells", ["0,0.5", "10:00:00,11:00:00"])
def test_of_two_columns_of_times_without_a_common_name_the_clock_is_asked(tmp_path, cells):
    (tmp_path / "lab.csv").write_text(f"stamp [s],delay [s],w [mm]\n{cells},1\n", "utf-8")

    understood = LaboratoryImport([read_sheet(tmp_path / "lab.csv")], {"kind": {"": "driven"}})

    asked = [heads for (option, _), heads in understood.questions.items() if option == "column"]
    assert asked == [["stamp", "delay", "w"]]
