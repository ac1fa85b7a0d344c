"""Campaign folders: round trip, units, noise records, and one sentence for what is wrong."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from discrepancy import errors
from discrepancy.campaign.noise_records import pre_trigger_record, repeat_record, repeated_readings
from discrepancy.campaign.protocol import Event, Release
from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import Campaign, Channel, Hold, NoiseRecord, Quantity, Start, TrialKind
from discrepancy.campaign.sampling import is_even
from discrepancy.campaign.schema import INPUT_COLUMNS
from discrepancy.campaign.wild_readings import is_fill_value
from discrepancy.campaign.writing import write_campaign
from discrepancy.errors import CampaignFileError, DiscrepancyError
from tests.discrepancy.rigs import CAMPAIGNS, asked, campaign_folder, same
from tests.refusals import refused

PLAIN, HEATED = "plain", "heated"
TOML = "campaign.toml"


def test_missing_folders_and_bytes(tmp_path):
    table = tmp_path / "table.csv"
    table.touch()
    for place, words in (
        (table, "is a file: give the folder of a campaign"),
        (tmp_path / "nowhere", "There is no folder"),
        (tmp_path, "There is no campaign.toml in"),
    ):
        with refused(CampaignFileError, words):
            read_campaign(place)
    folder = campaign_folder(tmp_path / "a", PLAIN)
    for content, words in ((b"\xff", "is not text in UTF-8"), (b"\x00", "zero byte")):
        (folder / "turn.csv").write_bytes(b"load_factor,g17\n1," + content + b"\n")
        with refused(CampaignFileError, words):
            read_campaign(folder)
    (folder / "turn.csv").write_bytes("\ufeffload_factor,g17\r\n1,900\r\n".encode())  # as Excel writes it
    assert read_campaign(folder).trials[2].values.tolist() == [[9e-4]]


def release_with_stamps(folder, stamps):
    """Return the campaign whose release has these times, and that release."""
    rows = "".join(f"{stamp},{row % 7}\n" for row, stamp in enumerate(stamps))
    table = ("release.csv", "", f"time,w [mm]\n{rows}")
    campaign = read_campaign(campaign_folder(folder / "a", PLAIN, table))
    return campaign, campaign.trials[1]


def test_stamps_that_are_printed_with_few_decimals_are_even(tmp_path):
    _, release = release_with_stamps(tmp_path, [f"{row / 1613.0:.4f}" for row in range(300)])
    assert release.interval == pytest.approx(1.0 / 1613.0, rel=5e-5)
    assert np.ptp(np.diff(release.time)) < 1e-12


@pytest.mark.parametrize(
    ("stamps", "sentence"),
    [
        (["0.0195" if row == 10 else f"{row * 0.002:.3f}" for row in range(60)],
         "steps of 0.0015 to 0.0025 s, usually 0.002 s"),
        ([f"{row * 0.002:.3f}" for row in range(60) if row not in (19, 20)],
         "widest gap, 0.006 s, begins at 0.036 s"),
    ],
    ids=["jitter", "gap"],
)  # fmt: skip
def test_uneven_stamps_are_taken_as_they_come(tmp_path, stamps, sentence):
    campaign, release = release_with_stamps(tmp_path, stamps)
    np.testing.assert_array_equal(release.time, [float(stamp) for stamp in stamps])
    assert not is_even(release.time)
    assert any(sentence in remark for remark in campaign.remarks)


@pytest.fixture(scope="module")
def plain_folder(tmp_path_factory):
    return campaign_folder(tmp_path_factory.mktemp("plain") / "a", PLAIN)


@pytest.fixture(scope="module")
def plain(plain_folder):
    """The campaign of that folder."""
    return read_campaign(plain_folder)


@pytest.fixture(scope="module")
def up(plain):
    """Its static trial."""
    return plain.trials[0]


@pytest.fixture(scope="module")
def release(plain):
    return plain.trials[1]


@pytest.fixture(scope="module")
def turn(plain):
    """Its flight."""
    return plain.trials[2]


def test_a_channel_has_its_quantity_output_and_place(plain):
    gauge = plain.channels["g17"]
    assert (gauge.quantity, gauge.output) == (Quantity.STRAIN, "strain[17]")
    assert (gauge.station, gauge.chord) == (0.35, 0.3)


def test_a_channel_has_deviations_of_zero_and_gain_in_si(plain):
    gauge = plain.channels["g17"]
    assert (gauge.offset_deviation, gauge.gain_deviation) == (2e-6, 0.005)
    assert plain.channels["tip"].offset_deviation == math.inf


def test_noise_is_that_of_samples_before_the_trigger(plain):
    noise = plain.channels["g17"].noise
    assert (noise.source, noise.degrees_of_freedom) == ("pre-trigger", 39)
    assert noise.standard_deviation == pytest.approx(1.5e-6 * math.sqrt(40 / 39))
    assert noise.interval == pytest.approx(0.01)


def test_noise_is_that_which_is_stated(plain):
    noise = plain.channels["tip"].noise
    assert (noise.standard_deviation, noise.degrees_of_freedom) == (5e-5, 200.0)


def test_readings_are_in_si_and_an_empty_one_is_not_used(plain, up):
    assert up.values.tolist() == [[5e-7, 1e-4], [1.2025e-4, 7.3e-3], [1.2025e-4, 1.46e-2]]
    assert up.used.tolist() == [[True, True], [True, True], [False, True]]
    assert "1 of 3 readings of 'g17' in the trial 'tip load up' (row 3) is empty" in plain.remarks[0]


def test_a_static_trial_has_its_place_and_time(up):
    assert up.load_place == (1.0, 0.35)
    assert up.time.tolist() == [30.0] * 3


def test_health_has_its_regions_and_deviation(up, turn):
    assert up.regions == turn.regions == ("z1", "z2", "flange")
    assert (up.health.tolist(), up.health_deviation.tolist()) == ([[0.2, 0.0, 0.1]] * 3, [[0.05] * 3] * 3)
    assert turn.health.tolist() == [[0.0, 0.0, 0.0], [0.1, 0.2, 0.3]]


def test_temperatures_are_differences_from_the_reference(up, release, turn):
    assert up.temperature.tolist() == [0.0] * 3
    assert release.temperature[:1].tolist() == [3.5]
    assert turn.temperature.tolist() == [0.0, -1.5]


def test_a_release_has_its_displacement_and_interval(release):
    assert (release.channels, release.release) == (("tip",), Release(0.05))
    assert release.interval == pytest.approx(0.002, rel=1e-12)


def test_a_flight_has_its_load_factor_and_start(turn):
    assert turn.load_factor.tolist() == [1.0, 2.5]
    assert (turn.held_out, turn.start) == (True, 100.0)


def test_a_campaign_has_parameters_and_trials_to_fit(plain):
    assert plain.parameters == {"young_modulus_factor": (1.0073, 0.0103)}
    assert [trial.name for trial in plain.fitted] == ["tip load up", "release"]


def test_an_event_is_of_all_trials_that_are_samples_in_time(plain):
    (event,) = plain.events
    assert (event.trials, event.trial) == (("release",), None)


def test_a_campaign_is_read_the_same_from_what_is_written(plain, tmp_path):
    """What the reader remarked is not said twice."""
    again = read_campaign(write_campaign(plain, tmp_path / "b"))
    assert same(plain, again, 1e-9)
    assert sum("is empty and left out" in remark for remark in again.remarks) == 1
    assert len(set(again.remarks)) == len(again.remarks)


def test_the_hash_of_a_campaign_follows_every_file(plain, plain_folder, tmp_path):
    changed = campaign_folder(tmp_path / "a", PLAIN, ("noise.csv", "0.00,2.0", "0.00,2.1"))
    assert len(plain.data_hash) == 64
    assert read_campaign(plain_folder / TOML).data_hash == plain.data_hash
    assert read_campaign(changed).data_hash != plain.data_hash


@pytest.mark.parametrize(
    "table", ["force,g17\n2.0,1.03\n2.0,1.04\n", "time,force,g17\n0,2.0,1.03\n9,2.0,1.03\n"]
)
def test_rows_under_one_force_are_two_readings(tmp_path, table):
    """At one time or at two."""
    folder = campaign_folder(tmp_path / "a", PLAIN, ("tip_up.csv", "", table))
    assert len(read_campaign(folder).trials[0].force) == 2


def test_samples_at_rest_go_before_a_stated_deviation(tmp_path):
    stated = (TOML, "offset_deviation = 2.0", "noise = { standard_deviation = 9.0 }")
    campaign = read_campaign(campaign_folder(tmp_path / "a", PLAIN, stated))
    assert campaign.channels["g17"].noise.source == "pre-trigger"


def test_a_release_may_be_stated_without_a_unit(tmp_path):
    without_unit = (TOML, 'displacement = 50, unit = "mm"', 'displacement = 50, unit = "1"')
    release = read_campaign(campaign_folder(tmp_path / "b", PLAIN, without_unit)).trials[1].release
    assert (release.displacement, release.unit) == (50.0, "1")


def test_columns_of_no_channel_are_one_remark(tmp_path):
    text = (CAMPAIGNS.folder / PLAIN / "release.csv").read_text("utf-8")
    with_column = ("release.csv", "", text.replace("\n", ",1\n").replace("[mm],1", "[mm],g71"))
    tip_up = ("tip_up.csv", "", "force,g71,w [mm]\n0,0.5,0.1\n5,120.25,7.3\n")
    campaign = read_campaign(campaign_folder(tmp_path / "a", PLAIN, with_column, tip_up))
    (remark,) = (remark for remark in campaign.remarks if "'g71'" in remark)
    assert campaign.trials[0].channels == ("tip",)
    assert remark.startswith("tip_up.csv and 1 more: no channel reads the column 'g71'")


def test_a_channel_that_some_tables_lack_is_one_remark_with_its_trials(tmp_path):
    tip_up = ("tip_up.csv", "", "force,g17\n0,0.5\n5,120.25\n")
    campaign = read_campaign(campaign_folder(tmp_path / "a", PLAIN, tip_up))
    (remark,) = (remark for remark in campaign.remarks if "the channel 'tip'" in remark)
    assert remark.startswith("The trials 'tip load up', 'turn' have no column of the channel 'tip'")


def test_a_trial_that_states_its_channels_lacks_none(tmp_path):
    tip_up = ("tip_up.csv", "", "force,g17\n0,0.5\n5,120.25\n")
    stated = (TOML, 'file = "tip_up.csv"', 'file = "tip_up.csv"\nchannels = ["g17"]')
    campaign = read_campaign(campaign_folder(tmp_path / "a", PLAIN, tip_up, stated))
    (remark,) = (remark for remark in campaign.remarks if "the channel 'tip'" in remark)
    assert remark.startswith("The trial 'turn' has no column")


@pytest.fixture(scope="module")
def heated(tmp_path_factory):
    """A campaign with three inputs: a heater, a table and a fan."""
    return read_campaign(campaign_folder(tmp_path_factory.mktemp("heated") / "a", HEATED))


def test_an_input_that_one_driven_trial_lacks_is_a_remark(heated):
    (remark,) = (remark for remark in heated.remarks if "the input 'table'" in remark)
    assert remark.startswith("The trial 'second' has no column of the input 'table'")


def test_inputs_have_their_quantity_and_hold(heated):
    heater, table, fan = heated.trials[0].inputs
    assert (heater.quantity, heater.hold, heater.offset_deviation) == (Quantity.HEAT, Hold.ZERO_ORDER, 10.0)
    assert (table.hold, fan.hold) == (Hold.SMOOTH, None)


def test_inputs_come_out_in_si(heated):
    heater, table, fan = heated.trials[0].inputs
    assert heater.values[:2].tolist() == [1000.0, 2000.0]
    assert (table.values[3], fan.values[3]) == (3e-3, 6e-3)
    assert heated.trials[0].force.tolist() == fan.values.tolist()


def test_temperatures_and_angles_come_out_in_si(heated):
    np.testing.assert_allclose(heated.trials[0].values[2], [22.0, np.pi])


def test_trials_begin_as_they_say_or_settled(heated):
    first, second = heated.trials
    remarks = " ".join(heated.remarks)
    settled = "The trial 'second' is taken to begin at rest under the loads of the first sample (assumed"
    assert (first.begins, second.begins, second.inputs) == (Start.UNKNOWN, Start.SETTLED, ())
    assert "The trial 'first' is taken to begin in a state that is fitted." in remarks
    assert settled in remarks


SETTLED = (TOML, '"second.csv"', '"second.csv", begins = "settled"')
HELD = (TOML, 'column = "x"', 'column = "x", hold = "linear", reference = true')
KELVIN = (TOML, '"degC"', '"K"')
FORCE_CHANNEL = (
    ("first.csv", "turned", "force"),
    ("second.csv", "turned", "force"),
    (TOML, 'name = "turned", quantity = "angle", unit = "deg"',
     'name = "force", quantity = "force", unit = "kN"'),
)  # fmt: skip
"""A channel may be called force."""


@pytest.mark.parametrize("si", [True, False])
@pytest.mark.parametrize(
    ("changes", "beginnings"),
    [((), 1), ((SETTLED,), 2), ((HELD,), 1), ((KELVIN,), 1), (FORCE_CHANNEL, 1)],
    ids=["plain", "settled", "held", "kelvin", "force"],
)
def test_inputs_come_back_as_they_were(tmp_path, changes, beginnings, si):
    """A begin is written where it was said."""
    campaign = read_campaign(campaign_folder(tmp_path / "a", HEATED, *changes))
    folder = write_campaign(campaign, tmp_path / "again", si=si)
    again = read_campaign(folder)
    assert campaign.trials[1].begin_assumed is (beginnings == 1)
    assert same(again, campaign, 1e-9)
    assert (folder / TOML).read_text("utf-8").count("\nbegins = ") == beginnings


@pytest.mark.parametrize(("changes", "unit"), [((), "degC"), ((KELVIN,), "K")])
def test_the_unit_of_a_temperature_comes_back(tmp_path, changes, unit):
    campaign = read_campaign(campaign_folder(tmp_path / "a", HEATED, *changes))
    for si in (True, False):
        again = read_campaign(write_campaign(campaign, tmp_path / "again", si=si))
        assert again.channels["plate"].unit == unit


def test_a_channel_may_be_a_force(tmp_path):
    campaign = read_campaign(campaign_folder(tmp_path / "a", HEATED, *FORCE_CHANNEL))
    assert campaign.trials[0].values[2, 1] == 180e3


@pytest.mark.parametrize(("first_force", "is_assumed"), [(0, False), (3, True)])
def test_a_forced_trial_that_begins_under_a_force_is_taken_to_begin_at_rest(
    tmp_path, first_force, is_assumed
):
    forced = (TOML, 'name = "second", kind = "driven"', 'name = "second", kind = "forced"')
    rows = "".join(f"{row},{first_force if row == 0 else 1},{20 + row},{row}\n" for row in range(10))
    pushed = ("second.csv", "", f"time,force,plate,turned\n{rows}")
    remarks = " ".join(read_campaign(campaign_folder(tmp_path / "a", HEATED, forced, pushed)).remarks)
    assert ("'second' is taken to begin at rest under the loads" in remarks) is is_assumed


@pytest.fixture(scope="module")
def documented(tmp_path_factory):
    """The campaign of docs/reference/campaign.md, which shows how its tables begin; a record is longer."""
    folder = tmp_path_factory.mktemp("documented")
    page = Path(__file__).parents[3] / "docs" / "reference" / "campaign.md"
    text = page.read_text(encoding="utf-8")
    toml = re.search(r"```toml\n(.*?)```", text, re.DOTALL)
    tables = re.search(r"begin with\n\n```\n(.*?)```", text, re.DOTALL)
    (folder / "campaign.toml").write_text(toml.group(1), encoding="utf-8")
    record = "\n".join(f"{0.002 * row:.3f},{(-1) ** row}" for row in range(3, 50))
    for table in tables.group(1).split("\n\n"):
        name, columns, *_ = table.removeprefix("# ").splitlines()
        more = f"\n{record}" if columns == "time,g17" else ""
        (folder / name).write_text(f"{table.rstrip()}{more}\n", encoding="utf-8")
    return read_campaign(folder)


def test_the_documented_campaign_is_read(documented):
    assert [trial.kind.value for trial in documented.trials] == ["static", "ringdown", "flight"]
    assert documented.channels["g17"].noise.source == "pre-trigger"
    assert documented.remarks == ()


def test_the_documented_trials_are_read_in_si(documented):
    up, release, turns = documented.trials
    assert (up.values[1].tolist(), up.temperature.tolist()) == ([54.1e-6, 2.98e-3], [1.5] * 3)
    assert release.release.displacement == 0.015
    assert turns.health[2].tolist() == [0.2, 0.0]


# ---------------------------------------------------------------- round trip

ACCEPTING = (
    ("format = 1", 'format = 1\naccept = ["sign"]'),
    ('name = "tip"', 'name = "tip"\naccept = ["outliers", "held"]'),
    ('name = "release"', 'name = "release"\naccept = ["too short"]'),
)


def test_what_a_campaign_accepts_is_read_and_written(tmp_path):
    changes = [(TOML, old, new) for old, new in ACCEPTING]
    campaign = read_campaign(campaign_folder(tmp_path / "a", PLAIN, *changes))
    again = read_campaign(write_campaign(campaign, tmp_path / "b"))
    for item in (campaign, again):
        assert item.accepted_faults("tip", "release") == {"sign", "outliers", "held", "too short"}
        assert item.accepted_faults("g17") == {"sign"}


def test_a_word_that_is_no_fault_cannot_be_accepted(tmp_path):
    change = (TOML, 'name = "tip"', 'name = "tip"\naccept = ["frozen"]')
    with refused(
        CampaignFileError,
        "'frozen' is not a fault that can be accepted; those that can are clipped, dead, held",
    ):
        read_campaign(campaign_folder(tmp_path / "a", PLAIN, change))


def has_digits_of_a_fill_value(number: float) -> bool:
    """Return whether a number is 9999 or another fill value in some unit, which the reader leaves out."""
    digits, _ = f"{abs(number):.12e}".split("e")
    return is_fill_value(digits.replace(".", "").rstrip("0"))


finite = st.floats(-1e6, 1e6, allow_nan=False).filter(
    lambda x: x == 0.0 or (abs(x) > 1e-200 and not has_digits_of_a_fill_value(x))
)
positive = st.floats(1e-9, 1e6)
names = st.text(
    st.characters(codec="utf-8", exclude_categories=("Cc", "Cs", "Zl", "Zp", "Zs"), exclude_characters="#*"),
    min_size=1,
    max_size=8,
).filter(lambda text: text == text.strip() and text not in INPUT_COLUMNS)


@st.composite
def campaigns(draw):
    channel_names = draw(st.lists(names, min_size=1, max_size=3, unique=True))
    interval, rest = draw(st.floats(1e-5, 1.0)), finite.map(lambda x: 1e-6 * x)
    noise = (
        st.builds(NoiseRecord, positive, positive | st.just(math.inf))
        | st.builds(NoiseRecord, positive, positive, source=st.just("repeats"))
        | arrays(float, st.integers(4, 12), elements=rest, unique=True).map(
            lambda samples: pre_trigger_record(samples, interval, "c", "f")
        )
    )
    size, place = positive | st.sampled_from([0.0, math.inf]), st.none() | finite
    said = st.sampled_from(Quantity), names, noise, size, size, place, place
    channels = {name: draw(st.builds(Channel, st.just(name), *said)) for name in channel_names}
    trials = []
    for index in range(draw(st.integers(1, 3))):
        kind = draw(st.sampled_from(TrialKind))
        dynamic = kind not in (TrialKind.STATIC, TrialKind.FLIGHT)
        count = draw(st.integers(8, 20) if dynamic else st.integers(1, 5))
        # The first trial measures every channel: one that is measured nowhere is refused.
        chosen = draw(st.permutations(channel_names))[: None if index == 0 else draw(st.integers(1, 3))]
        start, shape = abs(draw(finite)), (count, len(chosen))
        column = arrays(float, count, elements=finite)
        time = draw(st.floats(1e-5, 1.0)) * np.arange(count) if dynamic else np.full(count, start)
        if count > 1 and not dynamic:  # the same row twice is refused
            time = np.sort(draw(arrays(float, count, elements=finite, unique=True)))
        given = {
            "values": arrays(float, shape, elements=finite), "used": arrays(bool, shape),
            "load_place": names | st.tuples(finite, finite), "run": st.just("") | names,
            "health": arrays(float, (count, 2), elements=st.floats(0.0, 1.0)), "held_out": st.booleans(),
        }  # fmt: skip
        given |= {"force": column} if kind in (TrialKind.STATIC, TrialKind.FORCED) else {}
        given |= {"load_factor": column} if kind is TrialKind.FLIGHT else {}
        given |= {"hold": st.sampled_from([None, *Hold])} if kind is TrialKind.FORCED else {}
        if kind is TrialKind.RINGDOWN:
            given["release"] = st.builds(
                Release, positive, positive, st.booleans(), st.integers(1, 5), positive
            )
        optional = {
            "temperature": arrays(float, count, elements=st.floats(1e-2, 1e3)), "noise_factor": positive,
            "health_deviation": arrays(float, (count, 2), elements=positive),
        }  # fmt: skip
        given = draw(st.fixed_dictionaries(given, optional=optional))
        name = f"{index} {draw(names)}"
        trials.append(asked(kind, time, name=name, channels=tuple(chosen), start=start, **given))
    text = st.text(st.characters(codec="utf-8", exclude_categories=("Cs",)), max_size=20)
    read = dict.fromkeys(name for trial in trials for name in trial.input_names)
    return Campaign(
        draw(text), channels, tuple(trials), draw(st.floats(-273.15, 1e3)),
        {draw(names): (draw(finite), draw(positive))}, "",
        tuple(draw(st.lists(text, max_size=2))), draw(st.sampled_from([{}, {"one": (*channels, *read)}])),
    )  # fmt: skip


@given(campaigns())
@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
def test_round_trip_keeps_everything(tmp_path_factory, campaign):
    folder = tmp_path_factory.mktemp("campaign")
    again = read_campaign(write_campaign(campaign, folder))
    # Only remarks of the reader itself may be new.
    assert again.remarks[: len(campaign.remarks)] == campaign.remarks
    assert same(replace(again, remarks=campaign.remarks), campaign, 1e-9)


def test_what_cannot_be_written_says_so(tmp_path):
    campaign = read_campaign(campaign_folder(tmp_path / "a", PLAIN))
    other = replace(
        campaign.channels["tip"], noise=NoiseRecord(1.0, 9.0, np.arange(-5.0, 6.0), 0.5, "pre-trigger")
    )
    with pytest.raises(CampaignFileError, match="the same sampling interval"):
        write_campaign(replace(campaign, channels={**campaign.channels, "tip": other}), tmp_path / "b")
    warmer = (replace(campaign.trials[0], temperature=np.ones_like(campaign.trials[0].temperature)),)
    with pytest.raises(CampaignFileError, match="reference_temperature"):
        write_campaign(replace(campaign, trials=warmer, reference_temperature=None), tmp_path / "b")
    lost = Event("hit", ("nowhere",), time=0.1)
    with pytest.raises(CampaignFileError, match="'nowhere'"):
        write_campaign(replace(campaign, events=(lost,)), tmp_path / "b")


# ---------------------------------------------------------------- noise from repeats


W = Channel("w", Quantity.DISPLACEMENT, "x")


def repeats(rows, used=None):
    """Return a static trial for each row of readings."""
    force, used = np.arange(float(rows.shape[1])), np.ones(rows.shape, dtype=bool) if used is None else used
    given = {"channels": ("w",), "force": force}
    return [
        asked(TrialKind.STATIC, 0.0 * force, name=str(k), values=row[:, None], used=mark[:, None], **given)
        for k, (row, mark) in enumerate(zip(rows, used, strict=True))
    ]


@pytest.fixture(scope="module")
def repeated():
    """Readings of three repeated trials about their rows; and their trials with one of another run.

    The noise of these trials is twice the record's, so that a reading counts half.
    """
    readings = np.random.default_rng(4).normal(size=(3, 4)) + np.array([0.0, 10.0, 20.0, 30.0])
    rows = repeats(np.vstack((readings, [100.0, 200.0, 300.0, 400.0])))
    *trials, other = (replace(row, noise_factor=2.0) for row in rows)
    residual = 0.5 * (readings - readings.mean(axis=0))
    return residual, (*trials, replace(other, run="B"))


def reread(folder, trials, zero=0.0):
    """Return a campaign of trials of one channel as it is read from what is written."""
    channels = {"w": replace(W, offset_deviation=zero)}
    return read_campaign(write_campaign(Campaign("r", channels, trials, None, {}, ""), folder / "r"))


@pytest.mark.parametrize(("zero", "freedom"), [(0.0, 8.0), (math.inf, 6.0)], ids=["known zero", "free zero"])
def test_noise_from_repeats_is_the_pooled_deviation(tmp_path, repeated, zero, freedom):
    """With a free zero per trial, rows and trials are taken out: a two-way layout without interaction."""
    residual, trials = repeated
    if zero:
        residual = residual - residual.mean(axis=1, keepdims=True)
    campaign = reread(tmp_path, trials, zero)
    record = campaign.channels["w"].noise
    assert (record.source, record.degrees_of_freedom) == ("repeats", freedom)
    assert record.standard_deviation == pytest.approx(np.sqrt(np.sum(residual**2) / freedom))
    assert f"taken from repeated trials ({freedom:g} degrees" in campaign.remarks[0]


def test_without_repeats_no_noise_is_known(tmp_path, repeated):
    """Another run is no repeat. The checks say so."""
    _, (first, *_, other) = repeated
    channels = {"w": W}
    written = write_campaign(Campaign("r", channels, (first, other), None, {}, ""), tmp_path / "alone")
    alone = read_campaign(written)
    assert (alone.channels["w"].noise, alone.remarks) == (None, ())


@pytest.fixture
def loading():
    """A static trial of three readings."""
    return asked(TrialKind.STATIC, np.zeros(3), channels=("w",), force=np.arange(3.0))


@pytest.mark.parametrize("name", ["force", "load_factor", "temperature", "health", "noise_factor"])
def test_a_trial_under_something_else_is_no_repeat(loading, name):
    changed = replace(loading, **{name: getattr(loading, name) + 1.0})
    assert [group for group, *_ in repeated_readings([loading, loading], "w")] == [[loading, loading]]
    assert not [*repeated_readings([loading, changed], "w")]


def test_a_trial_with_another_loss_of_a_further_region_is_no_repeat(loading):
    regions = ("z1", "z2", "web")
    sound, cracked = (replace(loading, regions=regions, health=np.full((3, 3), loss)) for loss in (0.0, 0.1))
    groups = [group for group, *_ in repeated_readings([loading, sound, cracked], "w")]
    assert groups == [[loading, sound]]


def test_a_reading_that_is_left_out_is_no_repeat():
    rows, used = np.random.default_rng(1).standard_normal((3, 6)), np.ones((3, 6), dtype=bool)
    used[1, 2] = False
    left_out = repeat_record(W, repeats(np.where(used, rows, 1e9), used))
    without = repeat_record(W, repeats(np.delete(rows, 2, axis=1)))
    assert left_out.standard_deviation == pytest.approx(without.standard_deviation)
    assert left_out.degrees_of_freedom == without.degrees_of_freedom


# ---------------------------------------------------------------- what is wrong


@pytest.mark.parametrize(
    ("base", "file", "old", "new", "error", "sentence"),
    [(base, *row) for base in (PLAIN, HEATED, "pump") for row in CAMPAIGNS.refused(base)],
)
def test_what_is_wrong_is_named_in_one_sentence(tmp_path, base, file, old, new, error, sentence):
    folder = campaign_folder(tmp_path / "a", base, (file, old, new))
    with refused(getattr(errors, error), sentence) as caught:
        read_campaign(folder)
    assert str(caught.value).endswith(".") or "not valid TOML" in sentence


PIECES = [b"nan", b"1e999", b"-", b",", b'"', b"\n", b"[", b"1_0", b"0x1", b"1e", b"=", b"\r"]


def damage(content, data):
    """Exchange up to three pieces of a file by others."""
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(content) - 1))
        piece = data.draw(st.binary(max_size=4) | st.sampled_from(PIECES))
        content[place : place + data.draw(st.integers(0, 6))] = piece


def trials_or_refusal(folder):
    """Return the trials of a folder and no sentence, or no trials and the sentence that refuses it."""
    try:
        return read_campaign(folder).trials, ""
    except DiscrepancyError as error:
        return (), str(error)


def check_trial(trial):
    """Check that a trial has a finite reading of each channel at each time, and a finite force."""
    assert trial.values.shape == trial.used.shape == (len(trial.time), len(trial.channels))
    assert np.isfinite(trial.values).all()
    assert np.isfinite(trial.force).all()


@given(st.sampled_from(sorted(path.name for path in (CAMPAIGNS.folder / PLAIN).iterdir())), st.data())
@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
def test_damaged_files_are_refused_or_read_but_never_crash(tmp_path_factory, file, data):
    folder = campaign_folder(tmp_path_factory.mktemp("hostile") / "a", PLAIN)
    content = bytearray((folder / file).read_bytes())
    damage(content, data)
    (folder / file).write_bytes(bytes(content))
    trials, sentence = trials_or_refusal(folder)
    assert trials or sentence.endswith(".")
    for trial in trials:
        check_trial(trial)


def test_a_cycle_of_a_coarse_gauge_that_reads_alike_up_and_down_is_read(tmp_path):
    """Its rows stand on two branches of the load; within a branch the same row is refused still."""
    cycle = "force,g17\n0,0.0\n1,0.5\n2,1.0\n1,0.5\n0,0.0\n1,0.5\n"
    folder = campaign_folder(tmp_path, "plain", ("tip_up.csv", "", cycle))
    np.testing.assert_allclose(read_campaign(folder).trials[0].force, [0.0, 1.0, 2.0, 1.0, 0.0, 1.0])
