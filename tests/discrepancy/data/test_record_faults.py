"""Records that no sensor made, and single wrong readings; what records say of parameters and inputs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from discrepancy.campaign.noise import pre_trigger_record
from discrepancy.campaign.records import Channel, Hold, NoiseRecord, Quantity, RecordedInput, Start, TrialKind
from discrepancy.campaign.sampling import quantum_of
from discrepancy.checks.fault import FaultKind, slip_between
from discrepancy.checks.held import held_spans
from discrepancy.checks.model_check import check_against_model, prior_left, unobservable
from discrepancy.checks.outliers import mark_outliers, sample_outliers, wrong_ends
from discrepancy.checks.quality import check_data, clipped_run, moves
from tests.discrepancy.rigs import asked, campaign, model_of
from tests.refusals import Inputs

INPUTS = Inputs(__file__)
MODEL = model_of(INPUTS.text("mass_on_a_spring.toml"))
TIME = 0.005 * np.arange(1600)


def campaign_of(ring=None, rest=None, digit=1e-6, trials=2):
    """Return rings of x and y [mm] and a rest as files would have them; both may be changed in place."""
    generator = np.random.default_rng(5)
    still = 0.02 * generator.standard_normal((800, 2))
    if rest:
        rest(still)
    made = []
    for number in range(trials):
        # a tenth stiffer than the model has it: records in phase with it would say less
        motion = (20.0 + number) * np.exp(-0.2 * TIME) * np.cos(np.sqrt(440.0) * TIME + number)
        values = np.column_stack((motion, -0.5 * motion)) + 0.02 * generator.standard_normal((1600, 2))
        if ring:
            ring(values)
        given = {"values": np.round(values / digit) * digit * 1e-3, "begins": Start.UNKNOWN}
        given |= {"name": f"ring {number}", "channels": ("x", "y"), "file": f"{number}.csv"}
        made.append(asked(TrialKind.DRIVEN, TIME, **given))
    noise = (pre_trigger_record(1e-3 * column, 0.005, "rest", "rest.csv") for column in still.T)
    channels = {
        name: Channel(name, Quantity.DISPLACEMENT, name, record, column=f"{name} [mm]", unit="mm")
        for name, record in zip("xy", noise, strict=True)
    }
    return campaign(*made, **channels)


def only(faults, kind):
    """Return the one fault of a campaign, which is of a kind; what is held or scaled belies its noise too."""
    (fault,) = (item for item in faults if item.kind is not FaultKind.NOISE_LABEL)
    assert fault.kind is kind, fault.sentence
    assert fault.sentence.count(". ") == 0
    return fault


def test_sound_rings_have_no_fault():
    """A motion that begins somehow tells its parameters, and none does not."""
    for digit in (1e-6, 0.5):
        campaign = campaign_of(digit=digit)
        assert [item for item in check_data(campaign) if item.kind is not FaultKind.NOISE_LABEL] == []
        assert check_against_model(campaign, MODEL) == ()

    def still(values):
        values[:] = 0.02 * np.random.default_rng(1).standard_normal(values.shape)

    fault = only(check_against_model(campaign_of(still), MODEL), FaultKind.UNOBSERVABLE)
    assert "'oil'" in fault.sentence


# ---------------------------------------------------------------- held


@pytest.mark.parametrize(
    ("digit", "start", "stop"),
    [(1e-6, 310, 410), (0.1, 310, 410), (1e-6, 777, 877), (0.1, 777, 877), (1e-6, 1000, 1600)],
)
def test_a_sensor_that_freezes_while_another_goes_on(digit, start, stop):
    def freeze(values):
        values[start:stop, 0] = values[start, 0]

    fault = only(check_data(campaign_of(freeze, digit=digit, trials=1)), FaultKind.FROZEN)
    assert (fault.channel, fault.trial, fault.fatal) == ("x", "ring 0", True)
    assert "'x [mm]' of 0.csv" in fault.sentence
    assert f"{TIME[start]:.6g} to {TIME[stop - 1]:.6g} s" in fault.sentence


def _backlash(motion, gap):
    seen = motion.copy()
    for k in range(1, len(seen)):
        seen[k] = min(max(seen[k - 1], motion[k] - gap), motion[k] + gap)
    return seen


def _sound(digit, pace, generator):
    """Return records that stand still at times, each for a reason of its own."""
    wave = np.sin(2.0 * np.pi * pace * TIME + 0.7)
    ring = np.exp(-0.5 * pace * TIME) * wave
    square = np.sign(wave)
    pause = np.interp(TIME, [0.0, 1.0, 1.0 + 1 / pace, 2.0 + 1 / pace, 2.0 + 2 / pace], [0, 0, 1, 1, 0])
    found = {
        "ring": ring,
        "noisy ring": ring + 0.5 * digit * generator.standard_normal(len(TIME)),
        "warming": 5.0 * (1.0 - np.exp(-TIME * pace)),
        "day": 3.0 * np.sin(0.3 * pace * TIME),
        "rest": 0.4 * digit * generator.standard_normal(len(TIME)),
        "square": square,
        "filtered square": lfilter([0.05], [1.0, -0.95], square),
        "telegraph": np.repeat(generator.choice([-1.0, 1.0], 40), 40),
        "stairs": np.repeat(generator.standard_normal(40), 40),
        "pauses": pause,
        "backlash": _backlash(wave, 0.3),
        "dead zone": np.sign(ring) * np.maximum(np.abs(ring) - 0.2, 0.0),
        "bursts": np.where(TIME % 4.0 < 1.0, wave, 0.0),
        "contact": np.maximum(wave - 0.9, 0.0),
    }
    return {name: np.round(values / digit) * digit for name, values in found.items()}


@pytest.mark.parametrize("digit", [1e-3, 0.02, 0.2])
@pytest.mark.parametrize("pace", [0.4, 1.3, 6.0])
def test_what_rests_is_not_frozen(digit, pace):
    """Where encoders show no noise, what the others do meanwhile tells a pause from a fault."""
    used = np.ones(len(TIME), dtype=bool)
    other = np.cos(5.0 * TIME)[:, np.newaxis]
    for name, values in _sound(digit, pace, np.random.default_rng(2)).items():
        assert held_spans(values, used, np.zeros((len(TIME), 0))) == [], name
        if name in ("ring", "warming", "day", "backlash", "dead zone"):
            assert held_spans(values, used, other) == [], name
    clock = np.interp(TIME, [0.0, 3.0, 4.0, 8.0], [0.0, 3.0, 3.0, 7.0])
    motion = clock + 0.1 * clock**2
    for beside, spans in ((np.round(motion, 2), []), (np.round(np.sin(3.0 * TIME), 3), [(600, 801)])):
        assert held_spans(np.round(motion, 3), used, beside[:, np.newaxis]) == spans


STEP = 2.0 * np.pi / 1024.0
"""Of an encoder of ten bits [rad]."""


def _swing_with_friction(interval=0.002, seconds=8.0):
    """Return angles [rad] of a pendulum under dry friction, which sticks for a moment where it turns."""
    steps_of_each, angle, speed = 10, 0.6, 0.0
    step, angles = interval / steps_of_each, []
    for _ in range(round(seconds / interval)):
        angles.append(angle)
        for _ in range(steps_of_each):
            pull = -40.0 * np.sin(angle) - 0.05 * speed
            if speed == 0.0 and abs(pull) <= 0.35:
                continue
            friction = 0.35 * np.sign(speed or pull)
            next_speed = speed + step * (pull - friction)
            speed = 0.0 if next_speed * speed < 0.0 else next_speed
            angle += step * speed
    return np.array(angles)


@pytest.mark.parametrize("noise", [0.0, STEP / 3.0, STEP])
def test_an_encoder_that_sticks_at_the_end_of_a_swing_is_not_held(noise):
    """Printed with six decimals: its steps differ by the last of them."""
    angles = np.round(np.round(_swing_with_friction() / STEP) * STEP, 6)
    other = np.cos(5.0 * np.arange(len(angles)))[:, np.newaxis]
    assert held_spans(angles, np.ones(len(angles), bool), other, noise) == []


@pytest.mark.parametrize("noise", [0.0, STEP / 3.0, STEP])
def test_encoder_steps_that_were_resampled_by_straight_lines_are_not_held(noise):
    time = np.arange(0.0, 4.0, 0.0013)
    steps = np.round(0.5 * np.exp(-0.3 * time) * np.cos(6.0 * time) / STEP) * STEP
    resampled = np.round(np.interp(np.arange(0.0, 3.99, 0.001), time, steps), 6)
    other = np.cos(5.0 * np.arange(len(resampled)))[:, np.newaxis]
    assert held_spans(resampled, np.ones(len(resampled), bool), other, noise) == []


def _logged_faster_than_updated(updates=400, samples_of_each=10):
    readings = np.sin(0.07 * np.arange(updates)) + 0.02 * np.random.default_rng(1).standard_normal(updates)
    return np.round(np.repeat(readings, samples_of_each), 4)


def test_a_sensor_that_is_slower_than_its_logger_is_neither_held_nor_clipped():
    values = _logged_faster_than_updated()
    assert held_spans(values, np.ones(len(values), bool), np.zeros((len(values), 0)), 0.02) == []
    assert clipped_run(values, values.max()) == 0


def test_a_sensor_that_is_slower_than_its_logger_can_be_held():
    values = _logged_faster_than_updated()
    values[1000:1100] = values[1000]
    assert held_spans(values, np.ones(len(values), bool), np.zeros((len(values), 0)), 0.02) == [(1000, 1100)]


@pytest.mark.parametrize(
    ("values", "quantum"),
    [
        ([0.0, 1.0, 2.0, 3.0, 3.0, 3.0], 1.0),
        (np.round(np.repeat(np.arange(20), 2) * STEP, 6), STEP),
        (np.round(np.arange(0, 60, 3) * STEP, 6), 3.0 * STEP),
        (np.zeros(9), 0.0),
    ],
)
def test_the_quantum_of_a_sensor_is_what_its_readings_repeat(values, quantum):
    assert quantum_of(np.array(values)) == pytest.approx(quantum, abs=2e-6)


@pytest.mark.parametrize("place", ["top", "channel", "trial"])
def test_a_campaign_accepts_readings_that_look_held(place):
    def freeze(values):
        values[310:410, 0] = values[310, 0]

    campaign = campaign_of(freeze, trials=1)
    fault = only(check_data(campaign), FaultKind.FROZEN)
    assert fault.sentence.endswith(
        """if the data are right, say accept = ["held"] in the [[trial]] 'ring 0' or the [[channel]] 'x'."""
    )
    if place == "top":
        campaign = replace(campaign, accept=("held",))
    if place == "channel":
        accepting = replace(campaign.channels["x"], accept=("held",))
        campaign = replace(campaign, channels={**campaign.channels, "x": accepting})
    if place == "trial":
        campaign = replace(campaign, trials=(replace(campaign.trials[0], accept=("held",)),))
    fault = only(check_data(campaign), FaultKind.FROZEN)
    assert (fault.accepted, fault.fatal) == (True, False)
    assert fault.sentence.startswith("Accepted by the campaign (held): The channel 'x' holds one value")


# ---------------------------------------------------------------- copied


@pytest.mark.parametrize(
    ("copy", "how", "digit"),
    [
        (lambda x: x.copy(), "digit for digit in", 0.05),
        (lambda x: -0.3937 * x, "times -0.3937 in", 1e-6),
        (lambda x: 2.0 * x + 3.0, "times 2 in", 0.05),
        (lambda x: np.roll(x, 7), "digit for digit, 7 samples later, in", 1e-6),
        (lambda x: 1.5 * np.roll(x, -40), "times 1.5, 40 samples earlier, in", 0.05),
    ],
)
def test_a_channel_that_is_another_one(copy, how, digit):
    def spoil(values):
        values[:, 0] = np.round(values[:, 0] / digit) * digit
        values[:, 1] = copy(values[:, 0])

    fault = only(check_data(campaign_of(spoil)), FaultKind.COPIED)
    assert fault.fatal
    assert f"The channel 'y' is the channel 'x' {how} the column 'y [mm]' of 0.csv" in fault.sentence
    assert "(the trial 'ring 0', 0 to 7.995 s), and so in 1 more of its trials" in fault.sentence


def test_what_moves_alike_is_no_copy():
    def without_noise(values):
        values[:, 0] = 20.0 * np.exp(-0.2 * TIME) * np.cos(21.0 * TIME)
        values[:, 1] = -0.5 * values[:, 0]

    def switched(values):
        values[:, 0] = np.sign(np.cos(21.0 * TIME))
        values[:, 1] = -0.5 * values[:, 0]

    def warmed(values):
        values[:, 0] = np.round(20.0 + TIME, 1)
        values[:, 1] = np.round(18.0 + 1.1 * TIME, 1)

    def stepped(values):
        values[:, 0] = values[:, 1] = np.sign(np.cos(21.0 * TIME))

    for change in (without_noise, switched, warmed, stepped):
        assert FaultKind.COPIED not in {item.kind for item in check_data(campaign_of(change))}

    def same(values):
        without_noise(values)
        values[:, 1] = values[:, 0]

    assert "digit for digit" in only(check_data(campaign_of(same)), FaultKind.COPIED).sentence


# ---------------------------------------------------------------- units


@pytest.mark.parametrize(
    ("scale", "quantity", "stated", "drive", "pair"), INPUTS.table("faults.toml")["slips"]
)
def test_a_factor_names_its_pair_of_units(scale, quantity, stated, drive, pair):
    assert str(slip_between(scale, Quantity(quantity), stated, drive=drive) or "").strip("(?)") == pair


# ---------------------------------------------------------------- at rest


def _record(samples):
    return NoiseRecord(float(np.std(samples)), len(samples) - 1.0, samples - samples.mean(), 0.005)


@pytest.mark.parametrize("seed", range(20))
def test_noise_of_any_colour_is_at_rest(seed):
    white = np.random.default_rng(seed).standard_normal(1300)
    mains = np.sin(2.0 * np.pi * 50.0 * 0.005 * np.arange(800) + 0.3)
    for samples in (
        white[500:],
        np.round(0.6 * white[500:]),
        lfilter([1.0], [1.0, -0.8], white)[500:],
        lfilter([1.0], [1.0, -1.6, 0.8], white)[500:],
        white[500:] + 2.0 * mains,
        np.random.default_rng(seed).standard_t(3, 800),
    ):
        assert moves(_record(samples)) is None
        assert moves(_record(samples), 3.2) is None


@pytest.mark.parametrize(
    ("motion", "what"),
    [
        (lambda t: 0.03 * np.cos(20.5 * t), "a line near the model's 3.18 Hz with"),
        (lambda t: 0.3 * np.exp(-2.0 * t) * np.cos(30.0 * t), "scatters "),
        (lambda t: 0.03 * t, "drifts by 0.000121 (SI) over its length, "),
    ],
)
def test_a_noise_record_that_moves_is_a_limit(motion, what):
    def move(values):
        values[:, 1] += motion(TIME[: len(values)])

    campaign = campaign_of(rest=move)
    faults = [
        item
        for item in (*check_data(campaign), *check_against_model(campaign, MODEL))
        if item.kind is FaultKind.MOVES_AT_REST
    ]
    assert {(item.channel, item.fatal) for item in faults} == {("y", False)}
    assert any("the column 'y [mm]' of rest.csv, " in item.sentence for item in faults)
    assert any(what in item.sentence for item in faults), [item.sentence for item in faults]


# ---------------------------------------------------------------- single readings


@pytest.mark.parametrize(
    ("share", "rate", "noise", "digit"), [(0.8, 50.0, 0.001, 0.0), (1.0, 17.0, 0.003, 4.0)]
)
def test_sound_samples_of_records_with_gaps_or_few_digits_stay(share, rate, noise, digit):
    rng, counts = np.random.default_rng(3), np.zeros(3, dtype=int)
    for _ in range(10):
        time = np.sort(rng.permutation(1000)[: int(1000 * share)]) / rate
        values = np.exp(-0.4 * time) * np.cos(2.0 * np.pi * time) + noise * rng.normal(size=len(time))
        values = np.round(values / (digit * noise)) * digit * noise if digit else values
        spoilt, places = values.copy(), np.arange(20, len(time) - 20, 120)
        spoilt[places] += 40.0 * noise * rng.choice([-1.0, 1.0], len(places))
        records = {"a": values, "b": spoilt}.items()
        trials = (
            asked(TrialKind.RINGDOWN, time, name=name, channels=("x",), values=column[:, None])
            for name, column in records
        )
        sound, other = mark_outliers(campaign(*trials, x=Channel("x", Quantity.DISPLACEMENT, "x"))).trials
        counts += (~sound.used).sum(), (~other.used[places]).sum(), len(places)
    assert counts[0] <= 1
    assert counts[1] >= 0.65 * counts[2]


def _ring_with_two_wrong_readings(noise):
    """Return a campaign of a smooth ring in which two readings are 1e-3 off, and what is left out of it."""
    time = np.arange(1000) * 0.002
    values = np.cos(30.0 * time) + 1e-6 * np.random.default_rng(4).normal(size=1000)
    values[[300, 700]] += 1e-3
    trial = asked(TrialKind.RINGDOWN, time, channels=("x",), values=values[:, None])
    return campaign(trial, x=Channel("x", Quantity.DISPLACEMENT, "x", noise and NoiseRecord(noise)))


@pytest.mark.parametrize(("noise", "left_out"), [(None, 2), (1e-4, 2), (2.1e-4, 0), (2e-3, 0)])
def test_an_outlier_is_also_beyond_five_deviations_of_the_stated_noise(noise, left_out):
    (trial,) = mark_outliers(_ring_with_two_wrong_readings(noise)).trials
    assert np.count_nonzero(~trial.used) == left_out


def test_outliers_that_a_campaign_accepts_stay():
    (trial,) = mark_outliers(replace(_ring_with_two_wrong_readings(None), accept=("outliers",))).trials
    assert trial.used.all()


@pytest.mark.parametrize(("noise", "found"), [(0.0, [(0, 0)]), (3.0, [])])
def test_a_wrong_end_is_also_beyond_the_stated_noise(noise, found):
    residual = np.random.default_rng(1).standard_normal((200, 1))
    residual[0] += 20.0
    wrong = wrong_ends(residual, residual < 1e5, np.array([noise]))
    assert [tuple(place) for place in np.argwhere(wrong).tolist()] == found


@pytest.mark.parametrize("noise", [1e-4, 1e-3, 1e-2])
def test_friction_impacts_and_steps_are_no_outliers(noise):
    rng = np.random.default_rng(6)
    time = np.arange(1000) * 0.002
    w, friction = 10 * np.pi, 0.05
    # Coulomb friction in closed form: half cosines about an alternating centre until it stops.
    half = np.floor(time * w / np.pi)
    amplitude = np.maximum(1.0 - friction - 2.0 * friction * half, 0.0)
    sign = np.where(half % 2 == 0, 1.0, -1.0)
    free = sign * friction + amplitude * np.cos(w * time)
    stop = np.argmax(amplitude == 0.0) if (amplitude == 0.0).any() else len(time)
    displacement = np.where(np.arange(1000) < stop, free, free[min(stop, 999) - 1])
    records = {
        "friction": displacement,
        "velocity under friction": -amplitude * np.sin(w * time),
        "impacts": np.abs(np.cos(w / 2 * time)) * np.exp(-time),
        "step": np.cos(w * time) + (time > 0.7),
        "release at the middle": np.where(time > 0.5, np.cos(w * (time - 0.5)) * np.exp(-(time - 0.5)), 1.0),
    }
    for name, record in records.items():
        flagged = [int(sample_outliers(record + noise * rng.normal(size=1000)).sum()) for _ in range(10)]
        assert sum(flagged) <= 3, name


def test_rows_of_static_trials():
    def levels(count, spoilt=None, name="t", curve=0.0, shift=0.0, by=1e-3):
        load = np.arange(count, dtype=float)
        values = (
            1e-3 * load + curve * load**2 + 5e-6 * np.random.default_rng(count).normal(size=count) + shift
        )
        if spoilt is not None:
            values[spoilt] += by
        given = {"channels": ("x",), "values": values[:, None], "force": load, "run": "A"}
        return asked(TrialKind.STATIC, np.zeros(count), name=name, **given)

    pair = (levels(6, name="a"), levels(6, name="b"))
    for trials, noise, left_out in (
        ((levels(10, 4),), 5e-6, [[4]]),
        ((levels(10),), 5e-6, [[]]),
        ((levels(10, 9, by=9e-5),), 5e-6, [[9]]),  # at the end, where a parabola follows it
        ((levels(10, curve=1e-4),), 5e-6, [[]]),
        ((levels(10, 4),), None, [[]]),
        ((levels(6, 3),), 5e-6, [[]]),  # six rows alone cannot tell
        ((*pair, levels(6, 3, "c")), 5e-6, [[], [], [3]]),
        # A trial that is off in many rows is not a matter of single readings.
        ((*pair, levels(6, 3, "c", shift=1e-3)), 5e-6, [[], [], []]),
    ):
        channel = Channel("x", Quantity.DISPLACEMENT, "x", noise and NoiseRecord(noise, 100.0))
        marked = mark_outliers(campaign(*trials, x=channel))
        assert [np.flatnonzero(~trial.used[:, 0]).tolist() for trial in marked.trials] == left_out


# ---------------------------------------------------------------- beside what a model predicts


def ends(*columns):
    residual = np.stack(columns, axis=1)
    return [(int(row), int(column)) for row, column in np.argwhere(wrong_ends(residual, residual < 1e5))]


@pytest.mark.parametrize("place", [0, 1, 2, 197, 198, 199])
def test_a_wrong_reading_is_found_at_the_ends(place):
    first, second = np.random.default_rng(1).standard_normal((2, 200))
    second[place] += 20.0
    assert ends(first, second) == [(place, 1)]
    # in several channels at once, or within the record, it is no single reading at an end
    first[place] += 20.0
    assert ends(first, second) == []
    second[100] += 20.0
    assert ends(second) == [(place, 0)]
    second[100:] *= 30.0 if place < 100 else 1.0  # the roughness at its own end counts
    second[:100] *= 30.0 if place > 100 else 1.0
    assert ends(second) == [(place, 0)]


@pytest.mark.parametrize("seed", range(10))
def test_what_a_wrong_model_leaves_has_no_wrong_ends(seed):
    """Noise, waves of fast modes that decay, spikes of contact, steps; a record too short to judge."""
    generator = np.random.default_rng(seed)
    time = np.arange(1000) / 200.0
    wave = sum(
        generator.uniform(10.0, 60.0) * np.exp(-0.02 * 2.0 * np.pi * f * time)
        * np.cos(2.0 * np.pi * f * time + generator.uniform(0.0, 6.0))
        for f in (5.6, 20.0, 35.0, 60.0)
    )  # fmt: skip
    spikes = np.where(np.arange(1000) % 18 == 4, 30.0 * np.exp(-time), 0.0)
    step = np.where(time > 0.01, 40.0, 0.0)
    for signal in (wave, spikes, step):
        assert ends(signal + generator.standard_normal(1000)) == []
    for _ in range(5):
        noise = generator.standard_normal((3, 600))
        assert ends(*noise) == []
        assert sample_outliers(noise[0]).sum() <= 1
        assert not sample_outliers(noise[0, :5]).any()
    assert not sample_outliers(np.zeros(50)).any()
    assert ends(np.array([30.0, 0.1, -0.2, 0.1, 0.0, 0.2, -0.1])) == []


# ---------------------------------------------------------------- parameters, and inputs between samples


CART_FILE = INPUTS.text("cart.toml")
CART = model_of(CART_FILE)


def of_cart(time, values, drive, hold=None, forced=False):
    """Return the campaign of a cart that begins at rest, its place [m] beside what its motor did [N]."""
    given = {"force": drive, "hold": hold}
    if not forced:
        given = {"inputs": (RecordedInput("motor", Quantity.FORCE, values=drive, hold=hold),)}
    kind, values = TrialKind.FORCED if forced else TrialKind.DRIVEN, values[:, None]
    push = asked(kind, time, channels=("x",), values=values, begins=Start.STILL, **given)
    return campaign(push, x=Channel("x", Quantity.DISPLACEMENT, "cart", NoiseRecord(5e-4)))


def pushed(scale=1.0):
    time = np.linspace(0.0, 2.0, 81)
    return of_cart(time, scale * 0.25 * time**2, np.ones(81))


def fatal(campaign):
    return [fault.kind for fault in check_against_model(campaign, CART) if fault.fatal]


def test_what_is_left_of_each_prior():
    """Beside least squares of x by the two parameters, by hand; a short push of a cart is no short record."""
    campaign = pushed()
    left = prior_left(campaign, CART)
    time = campaign.trials[0].time

    def x(mass, damping):
        tau = mass / damping
        return (time - tau * (1.0 - np.exp(-time / tau))) / damping

    step = 1e-5
    columns = np.stack((
        (x(2.0 * (1 + step), 0.5) - x(2.0 * (1 - step), 0.5)) / (2 * step) * 0.2,
        (x(2.0, 0.5 * (1 + step)) - x(2.0, 0.5 * (1 - step))) / (2 * step) * 0.01,
    ), axis=1) / 5e-4  # fmt: skip
    expected = np.sqrt(np.diag(np.linalg.inv(np.eye(2) + columns.T @ columns)))
    assert [left["mass_factor"], left["damping_factor"]] == pytest.approx(expected, rel=2e-3)
    assert left["mass_factor"] < 0.1
    assert not fatal(campaign)
    assert fatal(pushed(1000.0))  # mm for m, or kN for N
    for scale in (100.0, 9.81):  # no plausible slip
        assert not fatal(pushed(scale))
    slippery = model_of(CART_FILE.replace("damping = { matrix = 0.5 }", "damping = { matrix = 1e-5 }"))
    (found,) = unobservable(campaign, slippery)
    assert "do not tell the calibrated parameter 'damping_factor' (100%)" in found.sentence
    (fault,) = check_against_model(campaign, slippery)
    assert (fault.kind, fault.fatal) == (FaultKind.UNOBSERVABLE, False)


@pytest.mark.parametrize("hold", [None, Hold.LINEAR, Hold.SMOOTH])
@pytest.mark.parametrize("forced", [False, True])
@pytest.mark.parametrize("samples", [9, 200])
def test_it_is_asked_what_a_coarse_input_did_between_its_samples(samples, forced, hold):
    time = np.arange(12 * samples) / samples
    campaign = of_cart(time, 0.01 * time, np.sin(2.0 * np.pi * time), hold, forced)
    faults = check_against_model(campaign, CART)
    found = [fault for fault in faults if fault.kind is FaultKind.BETWEEN_SAMPLES]
    assert bool(found) is (samples == 9 and hold is None)
    loud = tuple(replace(trial, noise_factor=1e4) for trial in campaign.trials)
    loud = check_against_model(replace(campaign, trials=loud), CART)
    assert not any(fault.kind is FaultKind.BETWEEN_SAMPLES for fault in loud)
    name, where = ("force", "[[trial]]") if forced else ("motor", "[[input]]")
    for fault in found:
        assert f"straight lines and curves between the samples of {name!r}" in fault.sentence
        assert f'hold = "smooth", "zero_order" or "linear" in its {where}' in fault.sentence
