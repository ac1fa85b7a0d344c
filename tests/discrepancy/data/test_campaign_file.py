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
from discrepancy.campaign.writing import write_campaign
from discrepancy.errors import CampaignFileError, DiscrepancyError
from tests.discrepancy.rigs import CAMPAIGNS, asked, campaign_folder, same
from tests.refusals import refused

PLAIN, HEATED = "plain", "heated"
TOML = "campaign.toml"


def test_missing_folders_and_bytes(tmp_path):
    for place, words in (
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


@pytest.mark.parametrize(
    ("stamps", "said"),
    [
        ([f"{k / 1613.0:.4f}" for k in range(300)], ""),  # printed with few decimals
        (["0.0195" if k == 10 else f"{k * 0.002:.3f}" for k in range(60)],
         "steps of 0.0015 to 0.0025 s, usually 0.002 s"),
        ([f"{k * 0.002:.3f}" for k in range(60) if k not in (19, 20)],
         "widest gap, 0.006 s, begins at 0.036 s"),
    ],
)  # fmt: skip
def test_uneven_stamps_are_taken_as_they_come(tmp_path, stamps, said):
    rows = "".join(f"{stamp},{k % 7}\n" for k, stamp in enumerate(stamps))
    campaign = read_campaign(
        campaign_folder(tmp_path / "a", PLAIN, ("release.csv", "", f"time,w [mm]\n{rows}"))
    )
    time = campaign.trials[1].time
    if not said:
        assert campaign.trials[1].interval == pytest.approx(1.0 / 1613.0, rel=5e-5)
        assert np.ptp(np.diff(time)) < 1e-12
        return
    np.testing.assert_array_equal(time, [float(stamp) for stamp in stamps])
    assert not is_even(time)
    assert any(said in remark for remark in campaign.remarks)


def test_everything_comes_out_in_si(tmp_path):
    """And is read the same again from what is written; the hash follows every file."""
    folder = campaign_folder(tmp_path / "a", PLAIN)
    campaign = read_campaign(folder)
    gauge, tip = campaign.channels["g17"], campaign.channels["tip"]
    assert (gauge.quantity, gauge.output, gauge.station, gauge.chord, gauge.gain_deviation) == (
        Quantity.STRAIN, "strain[17]", 0.35, 0.3, 0.005,
    )  # fmt: skip
    assert (gauge.offset_deviation, tip.offset_deviation) == (2e-6, math.inf)
    assert (gauge.noise.source, gauge.noise.degrees_of_freedom) == ("pre-trigger", 39)
    assert gauge.noise.standard_deviation == pytest.approx(1.5e-6 * math.sqrt(40 / 39))
    assert gauge.noise.interval == pytest.approx(0.01)
    assert (tip.noise.standard_deviation, tip.noise.degrees_of_freedom) == (5e-5, 200.0)
    up, release, turn = campaign.trials
    for found, wanted in (
        (up.values, [[5e-7, 1e-4], [1.2025e-4, 7.3e-3], [1.2025e-4, 1.46e-2]]),
        (up.used, [[True, True], [True, True], [False, True]]),
        (up.time, [30.0] * 3),
        (up.health, [[0.2, 0.0, 0.1]] * 3),
        (up.health_deviation, [[0.05] * 3] * 3),
        (up.temperature, [0.0] * 3),
        (release.temperature[:1], [3.5]),
        (turn.load_factor, [1.0, 2.5]),
        (turn.temperature, [0.0, -1.5]),
        (turn.health, [[0.0, 0.0, 0.0], [0.1, 0.2, 0.3]]),
    ):
        assert found.tolist() == wanted
    assert "1 of 3 readings of 'g17' in the trial 'tip load up' is empty" in campaign.remarks[0]
    assert up.load_place == (1.0, 0.35)
    assert up.regions == turn.regions == ("z1", "z2", "flange")
    assert (release.channels, release.release) == (("tip",), Release(0.05))
    assert release.interval == pytest.approx(0.002, rel=1e-12)
    assert (turn.held_out, turn.start) == (True, 100.0)
    assert campaign.parameters == {"young_modulus_factor": (1.0073, 0.0103)}
    assert len(campaign.data_hash) == 64
    assert [trial.name for trial in campaign.fitted] == ["tip load up", "release"]
    (event,) = campaign.events  # in all trials that are samples in time
    assert (event.trials, event.trial) == (("release",), None)
    again = read_campaign(write_campaign(campaign, tmp_path / "b"))
    assert same(campaign, again, 1e-9)
    assert len(again.remarks) == 1  # what the reader remarked is not said twice
    assert read_campaign(folder / TOML).data_hash == campaign.data_hash
    campaign_folder(folder, PLAIN, ("noise.csv", "0.00,2.0", "0.00,2.1"))
    assert read_campaign(folder).data_hash != campaign.data_hash


def test_what_tables_hold_besides(tmp_path):
    """Columns of no channel are one remark; rows under one force, at a time or at two, are two readings.

    Samples at rest go before a stated deviation.
    """
    for table in ("force,g17\n2.0,1.03\n2.0,1.04\n", "time,force,g17\n0,2.0,1.03\n9,2.0,1.03\n"):
        folder = campaign_folder(tmp_path / "a", PLAIN, ("tip_up.csv", "", table))
        assert len(read_campaign(folder).trials[0].force) == 2
    stated = (TOML, "offset_deviation = 2.0", "noise = { standard_deviation = 9.0 }")
    campaign = read_campaign(campaign_folder(tmp_path / "a", PLAIN, stated))
    assert campaign.channels["g17"].noise.source == "pre-trigger"
    plain = (TOML, 'displacement = 50, unit = "mm"', 'displacement = 50, unit = "1"')
    release = read_campaign(campaign_folder(tmp_path / "b", PLAIN, plain)).trials[1].release
    assert (release.displacement, release.unit) == (50.0, "1")
    release = (CAMPAIGNS.folder / PLAIN / "release.csv").read_text("utf-8")
    more = ("release.csv", "", release.replace("\n", ",1\n").replace("[mm],1", "[mm],g71"))
    tip_up = ("tip_up.csv", "", "force,g71,w [mm]\n0,0.5,0.1\n5,120.25,7.3\n")
    campaign = read_campaign(campaign_folder(tmp_path / "a", PLAIN, more, tip_up))
    assert campaign.trials[0].channels == ("tip",)
    (said,) = (remark for remark in campaign.remarks if "'g71'" in remark)
    assert said.startswith("tip_up.csv and 1 more: no channel has the column 'g71'")


def test_inputs_come_out_in_si(tmp_path):
    """And come back as they were; a begin is written where it was said."""
    campaign = read_campaign(campaign_folder(tmp_path / "a", HEATED))
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
    assert "The trial 'first' is taken to begin in a state that is fitted." in said
    assert "The trial 'second' is taken to begin at rest under the loads of the first sample (assumed" in said
    settled = (TOML, '"second.csv"', '"second.csv", begins = "settled"')
    held = (TOML, 'column = "x"', 'column = "x", hold = "linear", reference = true')
    kelvin = (TOML, '"degC"', '"K"')
    cell = 'name = "force", quantity = "force", unit = "kN"'  # a channel may be called so
    loads = [(f"{name}.csv", "turned", "force") for name in ("first", "second")]
    loads.append((TOML, 'name = "turned", quantity = "angle", unit = "deg"', cell))
    for changes, count in (((), 1), ((settled,), 2), ((held,), 1), ((kelvin,), 1), (loads, 1)):
        campaign = read_campaign(campaign_folder(tmp_path / "a", HEATED, *changes))
        assert campaign.trials[1].begin_assumed is (count == 1)
        for si in (True, False):
            again = write_campaign(campaign, tmp_path / "again", si=si)
            found = read_campaign(again)
            assert same(found, campaign, 1e-9)
            assert found.channels["plate"].unit == ("K" if kelvin in changes else "degC")
            assert (again / TOML).read_text("utf-8").count("\nbegins = ") == count
    assert campaign.trials[0].values[2, 1] == 180e3
    forced = (TOML, 'name = "second", kind = "driven"', 'name = "second", kind = "forced"')
    for first in (0, 3):
        rows = "".join(f"{k},{first if k == 0 else 1},{20 + k},{k}\n" for k in range(10))
        pushed = ("second.csv", "", f"time,force,plate,turned\n{rows}")
        remarks = " ".join(read_campaign(campaign_folder(tmp_path / "a", HEATED, forced, pushed)).remarks)
        assert ("'second' is taken to begin at rest under the loads" in remarks) is (first != 0)


def test_the_documented_campaign_is_read(tmp_path):
    """That of docs/reference/campaign.md, which shows how its tables begin; a record is longer."""
    text = (Path(__file__).parents[3] / "docs" / "reference" / "campaign.md").read_text(encoding="utf-8")
    toml = re.search(r"```toml\n(.*?)```", text, re.DOTALL)
    tables = re.search(r"begin with\n\n```\n(.*?)```", text, re.DOTALL)
    (tmp_path / "campaign.toml").write_text(toml.group(1), encoding="utf-8")
    record = "\n".join(f"{0.002 * k:.3f},{(-1) ** k}" for k in range(3, 50))
    for table in tables.group(1).split("\n\n"):
        name, columns, *_ = table.removeprefix("# ").splitlines()
        more = f"\n{record}" if columns == "time,g17" else ""
        (tmp_path / name).write_text(f"{table.rstrip()}{more}\n", encoding="utf-8")
    campaign = read_campaign(tmp_path)
    up, release, turns = campaign.trials
    assert [trial.kind.value for trial in campaign.trials] == ["static", "ringdown", "flight"]
    assert up.values[1].tolist() == [54.1e-6, 2.98e-3]
    assert up.temperature.tolist() == [1.5] * 3
    assert release.release.displacement == 0.015
    assert turns.health[2].tolist() == [0.2, 0.0]
    assert campaign.channels["g17"].noise.source == "pre-trigger"
    assert campaign.remarks == ()


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


finite = st.floats(-1e6, 1e6, allow_nan=False).filter(lambda x: x == 0.0 or abs(x) > 1e-200)
positive = st.floats(1e-9, 1e6)
names = st.text(
    st.characters(codec="utf-8", exclude_categories=("Cc", "Cs", "Zl", "Zp", "Zs"), exclude_characters="#*"),
    min_size=1,
    max_size=8,
).filter(lambda text: text == text.strip() and text not in INPUT_COLUMNS)


@st.composite
def campaigns(draw):
    channel_names = draw(st.lists(names, min_size=1, max_size=3, unique=True))
    interval, rest = draw(st.floats(1e-5, 1.0)), st.floats(-1.0, 1.0)
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
    with pytest.raises(CampaignFileError, match="one sampling interval"):
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


def test_noise_from_repeats_is_the_pooled_deviation(tmp_path):
    """With a free zero per trial, rows and trials are taken out: a two-way layout without interaction.

    Another run is not a repeat; a noise of twice the record's counts half.
    """
    readings = np.random.default_rng(4).normal(size=(3, 4)) + np.array([0.0, 10.0, 20.0, 30.0])
    rows = repeats(np.vstack((readings, [100.0, 200.0, 300.0, 400.0])))
    *trials, other = (replace(row, noise_factor=2.0) for row in rows)
    other = replace(other, run="B")
    rest = 0.5 * (readings - readings.mean(axis=0))
    for zero, freedom, left in ((0.0, 8.0, rest), (math.inf, 6.0, rest - rest.mean(axis=1, keepdims=True))):
        channels = {"w": replace(W, offset_deviation=zero)}
        campaign = Campaign("r", channels, (*trials, other), None, {}, "")
        campaign = read_campaign(write_campaign(campaign, tmp_path / str(freedom)))
        record = campaign.channels["w"].noise
        assert (record.source, record.degrees_of_freedom) == ("repeats", freedom)
        assert record.standard_deviation == pytest.approx(np.sqrt(np.sum(left**2) / freedom))
        assert f"taken from repeated trials ({freedom:g} degrees" in campaign.remarks[0]
    # Without repeats nothing is known; the checks say so.
    alone = replace(campaign, channels={"w": W}, trials=(trials[0], other), remarks=())
    alone = read_campaign(write_campaign(alone, tmp_path / "alone"))
    assert (alone.channels["w"].noise, alone.remarks) == (None, ())


def test_what_is_no_repeat():
    """A trial under something else, and a reading that is left out."""
    trial = asked(TrialKind.STATIC, np.zeros(3), channels=("w",), force=np.arange(3.0))
    assert [group for group, *_ in repeated_readings([trial, trial], "w")] == [[trial, trial]]
    for what in ("force", "load_factor", "temperature", "health", "noise_factor"):
        changed = replace(trial, **{what: getattr(trial, what) + 1.0})
        assert not [*repeated_readings([trial, changed], "w")], what
    cracked = [
        replace(trial, regions=("z1", "z2", "web"), health=np.full((3, 3), loss)) for loss in (0.0, 0.1)
    ]
    assert [group for group, *_ in repeated_readings([trial, *cracked], "w")] == [[trial, cracked[0]]]
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


@given(st.sampled_from(sorted(path.name for path in (CAMPAIGNS.folder / PLAIN).iterdir())), st.data())
@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
def test_damaged_files_are_refused_or_read_but_never_crash(tmp_path_factory, file, data):
    folder = campaign_folder(tmp_path_factory.mktemp("hostile") / "a", PLAIN)
    content = bytearray((folder / file).read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(content) - 1))
        piece = data.draw(
            st.binary(max_size=4)
            | st.sampled_from(
                [b"nan", b"1e999", b"-", b",", b'"', b"\n", b"[", b"1_0", b"0x1", b"1e", b"=", b"\r"]
            )
        )
        content[place : place + data.draw(st.integers(0, 6))] = piece
    (folder / file).write_bytes(bytes(content))
    trials, said = (), "."
    try:
        trials = read_campaign(folder).trials
    except DiscrepancyError as error:
        said = str(error)
    assert said.endswith(".")
    for trial in trials:
        assert trial.values.shape == trial.used.shape == (len(trial.time), len(trial.channels))
        assert np.isfinite(trial.values).all()
        assert np.isfinite(trial.force).all()


def test_a_cycle_of_a_coarse_gauge_that_reads_alike_up_and_down_is_read(tmp_path):
    """Its rows stand on two branches of the load; within a branch the same row is refused still."""
    cycle = "force,g17\n0,0.0\n1,0.5\n2,1.0\n1,0.5\n0,0.0\n1,0.5\n"
    folder = campaign_folder(tmp_path, "plain", ("tip_up.csv", "", cycle))
    np.testing.assert_allclose(read_campaign(folder).trials[0].force, [0.0, 1.0, 2.0, 1.0, 0.0, 1.0])
