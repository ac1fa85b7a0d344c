"""Campaign folders: round trip to the last bit, units, noise records, and one sentence for what is wrong."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from discrepancy import errors
from discrepancy.campaign.noise import pre_trigger_record, repeated
from discrepancy.campaign.protocol import Event, Release
from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import (
    Campaign,
    Channel,
    Hold,
    NoiseRecord,
    Quantity,
    RecordedInput,
    Trial,
    TrialKind,
)
from discrepancy.campaign.sampling import is_even
from discrepancy.campaign.schema import INPUT_COLUMNS
from discrepancy.campaign.writing import write_campaign
from discrepancy.errors import CampaignFileError, DiscrepancyError
from tests.refusals import Inputs


def test_missing_folders_and_bytes(tmp_path):
    for place, words in (
        (tmp_path / "nowhere", "There is no folder"),
        (tmp_path, "There is no campaign.toml in"),
    ):
        with pytest.raises(CampaignFileError, match=words):
            read_campaign(place)
    folder = folder_of(tmp_path)
    for content, words in ((b"\xff", "is not text in UTF-8"), (b"\x00", "zero byte")):
        (folder / "turn.csv").write_bytes(b"load_factor,g17\n1," + content + b"\n")
        with pytest.raises(CampaignFileError, match=words):
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
    campaign = read_campaign(folder_of(tmp_path, release=f"time,w [mm]\n{rows}"))
    time = campaign.trials[1].time
    if not said:
        assert campaign.trials[1].interval == pytest.approx(1.0 / 1613.0, rel=1e-3)
        assert np.ptp(np.diff(time)) < 1e-12
        return
    np.testing.assert_array_equal(time, [float(stamp) for stamp in stamps])
    assert not is_even(time)
    assert any(said in remark for remark in campaign.remarks)


INPUTS = Inputs(__file__)
TOML = INPUTS.text("campaign.toml")
TABLES = {
    "noise.csv": "time,g17\n" + "".join(f"{k * 0.01:.2f},{(-1) ** k * 1.5 + 0.5}\n" for k in range(40)),
    "tip_up.csv": "# by hand\nforce,g17,w [mm]\n0,0.5,0.1\n# pause\n5,120.25,7.3\n10,,14.6\n",
    "release.csv": "time,w [mm]\n" + "".join(f"{k * 0.002:.3f},{50 * math.cos(k / 10)}\n" for k in range(60)),
    "turn.csv": "time,load_factor,g17,temperature,z1,z2,health.flange\n100,1,900,20,0,0,0\n"
    "160,2.5,2250,18.5,0.1,0.2,0.3\n",
}


def folder_of(path, toml=TOML, **tables):
    path.mkdir(exist_ok=True)
    (path / "campaign.toml").write_text(toml, encoding="utf-8")
    for name, text in (TABLES | {f"{key}.csv": text for key, text in tables.items()}).items():
        (path / name).write_text(text, encoding="utf-8")
    return path


def test_everything_comes_out_in_si(tmp_path):
    campaign = read_campaign(folder_of(tmp_path))
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


def test_a_column_of_no_channel_is_one_remark(tmp_path):
    release = "time,w [mm],g71\n" + "".join(f"{line},1\n" for line in RELEASE.splitlines()[1:])
    tip_up = "force,g71,w [mm]\n0,0.5,0.1\n5,120.25,7.3\n"
    campaign = read_campaign(folder_of(tmp_path, tip_up=tip_up, release=release))
    assert campaign.trials[0].channels == ("tip",)
    (said,) = (remark for remark in campaign.remarks if "'g71'" in remark)
    assert said.startswith("tip_up.csv and 1 more: no channel has the column 'g71'")


def test_an_event_is_in_all_trials_that_are_samples_in_time(tmp_path):
    told = f'{TOML}[[event]]\nname = "knock"\ntime = 0.01\n'
    (event,) = read_campaign(folder_of(tmp_path, told)).events
    assert (event.trials, event.trial) == (("release",), None)
    with pytest.raises(CampaignFileError, match="'turn', which is flight and has no course in time"):
        read_campaign(folder_of(tmp_path, f'{told}trial = "turn"\n'))


def test_hash_follows_every_file(tmp_path):
    folder = folder_of(tmp_path)
    before = read_campaign(folder).data_hash
    assert read_campaign(folder / "campaign.toml").data_hash == before
    folder_of(tmp_path, noise=TABLES["noise.csv"].replace("0.00,2.0", "0.00,2.1"))
    assert read_campaign(folder).data_hash != before


# ---------------------------------------------------------------- round trip

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
    interval = draw(st.floats(1e-5, 1.0))
    channels = {}
    for name in channel_names:
        noise = draw(
            st.one_of(
                st.builds(NoiseRecord, positive, positive | st.just(math.inf)),
                st.builds(NoiseRecord, positive, positive, source=st.just("repeats")),
                arrays(float, st.integers(4, 12), elements=st.floats(-1.0, 1.0), unique=True).map(
                    lambda samples: pre_trigger_record(samples, interval, "c", "f")
                ),
            )
        )
        channels[name] = Channel(
            name, draw(st.sampled_from(Quantity)), draw(names), noise,
            draw(positive | st.sampled_from([0.0, math.inf])), draw(positive | st.sampled_from([0.0,
            math.inf])), draw(st.none() | finite), draw(st.none() | finite),
        )  # fmt: skip
    trials = []
    for index in range(draw(st.integers(1, 3))):
        kind = draw(st.sampled_from(TrialKind))
        dynamic = kind not in (TrialKind.STATIC, TrialKind.FLIGHT)
        count = draw(st.integers(8, 20)) if dynamic else draw(st.integers(1, 5))
        # The first trial measures every channel: one that is measured nowhere is refused.
        chosen = draw(st.permutations(channel_names))[: None if index == 0 else draw(st.integers(1, 3))]
        start = abs(draw(finite))
        column = arrays(float, count, elements=finite)
        zeros = np.zeros(count)
        if dynamic:
            time = draw(st.floats(1e-5, 1.0)) * np.arange(count)
        else:
            time = np.full(count, start)
            if count > 1:  # the same row twice is refused
                time = np.sort(draw(arrays(float, count, elements=finite, unique=True)))
        trials.append(
            Trial(
                name=f"{index} {draw(names)}", kind=kind, channels=tuple(chosen),
                values=draw(arrays(float, (count, len(chosen)), elements=finite)),
                used=draw(arrays(bool, (count, len(chosen)))),
                time=time,
                force=draw(column) if kind in (TrialKind.STATIC, TrialKind.FORCED) else zeros,
                load_factor=draw(column) if kind is TrialKind.FLIGHT else zeros,
                load_place=draw(names | st.tuples(finite, finite)),
                temperature=draw(st.just(zeros) | arrays(float, count, elements=st.floats(1e-2, 1e3))),
                start=start,
                run=draw(st.just("") | names),
                health=draw(arrays(float, (count, 2), elements=st.floats(0.0, 1.0))),
                health_deviation=draw(st.just(np.zeros((count, 2))) | arrays(float, (count, 2),
                elements=positive)), release=draw(st.builds(Release, positive, positive, st.booleans(),
                st.integers(1, 5), positive)) if kind is TrialKind.RINGDOWN
                else None,
                held_out=draw(st.booleans()),
                hold=draw(st.sampled_from([None, *Hold])) if kind is TrialKind.FORCED else None,
                noise_factor=draw(st.just(1.0) | positive),
            )
        )  # fmt: skip
    text = st.text(st.characters(codec="utf-8", exclude_categories=("Cs",)), max_size=20)
    read = dict.fromkeys(name for trial in trials for name in trial.input_names)
    return Campaign(
        draw(text), channels, tuple(trials), draw(st.floats(-273.15, 1e3)),
        {draw(names): (draw(finite), draw(positive))}, "",
        tuple(draw(st.lists(text, max_size=2))), draw(st.sampled_from([{}, {"one": (*channels, *read)}])),
    )  # fmt: skip


def same(one, other):
    if isinstance(one, np.ndarray):
        if not isinstance(other, np.ndarray) or (one.dtype, one.shape) != (other.dtype, other.shape):
            return False
        largest = 0.0 if one.dtype == bool else float(np.abs(one).max(initial=0.0))
        return np.allclose(one, other, rtol=1e-9, atol=1e-9 * largest)
    if isinstance(one, float) and isinstance(other, float):
        return one == other or math.isclose(one, other, rel_tol=1e-9)
    if isinstance(one, Campaign | Trial | Channel | NoiseRecord | RecordedInput):
        return all(
            same(getattr(one, item.name), getattr(other, item.name))
            for item in fields(one)
            if item.compare and item.name != "data_hash"
        )
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, dict) and isinstance(other, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    return one == other


@given(campaigns())
@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
def test_round_trip_keeps_everything(tmp_path_factory, campaign):
    folder = tmp_path_factory.mktemp("campaign")
    again = read_campaign(write_campaign(campaign, folder))
    # Only remarks of the reader itself may be new.
    assert again.remarks[: len(campaign.remarks)] == campaign.remarks
    assert same(replace(again, remarks=campaign.remarks), campaign)


def test_what_the_reader_remarked_is_not_said_twice(tmp_path):
    once = read_campaign(folder_of(tmp_path / "a"))
    twice = read_campaign(write_campaign(once, tmp_path / "b"))
    assert same(once, twice)
    assert len(once.remarks) == 1


def test_what_cannot_be_written_says_so(tmp_path):
    campaign = read_campaign(folder_of(tmp_path / "a"))
    with pytest.raises(CampaignFileError, match="no reference temperature"):
        write_campaign(replace(campaign, reference_temperature=None), tmp_path / "b")
    other = replace(
        campaign.channels["tip"], noise=NoiseRecord(1.0, 9.0, np.arange(-5.0, 6.0), 0.5, "pre-trigger")
    )
    with pytest.raises(CampaignFileError, match="one sampling interval"):
        write_campaign(replace(campaign, channels={**campaign.channels, "tip": other}), tmp_path / "b")
    lost = Event("hit", ("nowhere",), time=0.1)
    with pytest.raises(CampaignFileError, match="'nowhere'"):
        write_campaign(replace(campaign, events=(lost,)), tmp_path / "b")


def test_releases_and_events_that_are_none_are_refused_in_python_too(tmp_path):
    for make in (
        lambda: Release(0.0),
        lambda: Release(0.1, mode_count=0),
        lambda: Event("a b", time=0.0),
        lambda: Event("pi", time=0.0),
        lambda: Event("hit", time=1.0, until=1.0),
    ):
        with pytest.raises(CampaignFileError):
            make()
    plain = TOML.replace('displacement = 50, unit = "mm"', 'displacement = 50, unit = "1"')
    release = read_campaign(folder_of(tmp_path, plain)).trials[1].release
    assert (release.displacement, release.unit) == (50.0, "1")


def test_samples_at_rest_go_before_a_stated_deviation(tmp_path):
    stated = TOML.replace("offset_deviation = 2.0", "noise = { standard_deviation = 9.0 }")
    assert read_campaign(folder_of(tmp_path, stated)).channels["g17"].noise.source == "pre-trigger"
    for key in ("samples = [1.0]", "interval = 0.1", 'file = "noise.csv"'):
        with pytest.raises(CampaignFileError, match=f"{key.split()[0]}' is not a key"):
            read_campaign(folder_of(tmp_path, stated.replace("= 9.0", f"= 9.0, {key}")))
    assert not (tmp_path / "b").exists()


# ---------------------------------------------------------------- noise from repeats


def test_noise_from_repeats_is_the_pooled_deviation(tmp_path):
    rng = np.random.default_rng(4)
    readings = rng.normal(size=(3, 4)) + np.array([0.0, 10.0, 20.0, 30.0])
    trials = "".join(
        f'[[trial]]\nname = "{k}"\nkind = "static"\nfile = "{k}.csv"\nrun = "{"A" if k < 3 else "B"}"\n'
        for k in range(4)
    )
    toml = (
        'format = 1\nname = "r"\n[[channel]]\nname = "w"\nquantity = "displacement"\nunit = "m"\n'
        'output = "x"\n' + trials
    )
    tables = {
        str(k): "force,w\n" + "".join(f"{5 * n},{value!r}\n" for n, value in enumerate(row))
        for k, row in enumerate([*readings.tolist(), [100.0, 200.0, 300.0, 400.0]])
    }
    campaign = read_campaign(folder_of(tmp_path, toml, **tables))
    record = campaign.channels["w"].noise
    assert (record.source, record.degrees_of_freedom) == ("repeats", 8.0)  # the other run is no repeat
    assert record.standard_deviation == pytest.approx(np.sqrt(np.mean(np.var(readings, axis=0, ddof=1))))
    assert "taken from repeated trials (8 degrees" in campaign.remarks[0]
    # With a free zero per trial, rows and trials are taken out: a two-way layout without interaction.
    free = toml.replace('output = "x"', 'output = "x"\noffset_deviation = "free"')
    record = read_campaign(folder_of(tmp_path, free, **tables)).channels["w"].noise
    rest = readings - readings.mean(axis=0) - readings.mean(axis=1, keepdims=True) + readings.mean()
    assert record.degrees_of_freedom == 6.0
    assert record.standard_deviation == pytest.approx(np.sqrt(np.sum(rest**2) / 6))
    # Without repeats nothing is known, and the campaign says so.
    (tmp_path / "1.csv").write_text(tables["1"].replace("5,", "6,", 1))
    (tmp_path / "2.csv").write_text(tables["2"].replace("5,", "7,", 1))
    alone = read_campaign(tmp_path)
    assert alone.channels["w"].noise is None
    assert not alone.remarks  # the checks say it


@pytest.mark.parametrize("what", ["force", "load_factor", "temperature", "health", "noise_factor"])
def test_a_trial_under_something_else_is_no_repeat(what):
    trial = Trial.plain("a", TrialKind.STATIC, ("w",), np.zeros(3), force=np.arange(3.0))
    assert repeated([trial, trial], "w") == [[trial, trial]]
    assert not repeated([trial, replace(trial, **{what: getattr(trial, what) + 1.0})], "w")


# ---------------------------------------------------------------- what is wrong

RELEASE = TABLES["release.csv"]
WRONG_TABLES = [
    *INPUTS.refused("tables"),
    (
        "release",
        RELEASE.replace("0.020,", "0.018,"),
        "CampaignDataError",
        "does not increase after sample 10",
    ),
]


def check_sentence(text):
    assert text.endswith(".")
    assert "\n" not in text


@pytest.mark.parametrize(("old", "new", "sentence"), INPUTS.refused("campaign"))
def test_a_wrong_key_is_named_in_one_sentence(tmp_path, old, new, sentence):
    assert old in TOML
    with pytest.raises(CampaignFileError, match=sentence) as caught:
        read_campaign(folder_of(tmp_path, TOML.replace(old, new, 1)))
    if "not valid TOML" not in sentence:
        check_sentence(str(caught.value))


@pytest.mark.parametrize(("table", "text", "error", "sentence"), WRONG_TABLES)
def test_a_wrong_table_is_named_in_one_sentence(tmp_path, table, text, error, sentence):
    folder = folder_of(tmp_path, **{table: text})
    with pytest.raises(getattr(errors, error), match=sentence) as caught:
        read_campaign(folder)
    check_sentence(str(caught.value))


@given(st.sampled_from([*TABLES, "campaign.toml"]), st.data())
@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
def test_damaged_files_are_refused_or_read_but_never_crash(tmp_path_factory, file, data):
    folder = folder_of(tmp_path_factory.mktemp("hostile"))
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
    try:
        campaign = read_campaign(folder)
    except DiscrepancyError as error:
        check_sentence(str(error).splitlines()[-1])
        return
    for trial in campaign.trials:
        assert trial.values.shape == trial.used.shape == (len(trial.time), len(trial.channels))
        assert np.isfinite(trial.values).all()
        assert np.isfinite(trial.force).all()


def test_all_missing_and_all_unknown_keys_are_named_at_once(tmp_path):
    toml = (
        '[[channel]]\nname = "tip"\n[[channel]]\nunit = "mm"\noutput = "x"\nquantity = "displacement"\n'
        '[[trial]]\nkind = "ringdown"\n'
    )
    with pytest.raises(CampaignFileError) as caught:
        read_campaign(folder_of(tmp_path, toml))
    assert str(caught.value).endswith(
        "campaign.toml: 'format', 'name', 'channel[1].quantity', 'channel[1].output', 'channel[1].unit', "
        "'channel[2].name', 'trial[1].name', 'trial[1].file' and 'trial[1].release.displacement' are missing."
    )
    with pytest.raises(
        CampaignFileError, match=r"'channel\[1\].units' and 'trial\[1\].sort' are not keys of a campaign"
    ):
        read_campaign(folder_of(tmp_path, toml.replace('"tip"', '"tip"\nunits = "m"') + 'sort = "a"\n'))
