"""What is noticed, against sums over every course of events, an exact mean, and faults that are put in."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import norm
from scipy.stats import t as student

from tests.twin_master.network.decision_oracles import trajectories
from tests.twin_master.runs import changed_scenario, estimates_of
from twin_master.errors import ImpossibleObservation, InvalidModelError, InvalidObservationError
from twin_master.gauges import hypothesis_weights
from twin_master.gauges.hypothesis_weights import HypothesisWeights
from twin_master.learning.learning_filter import LearningFilter
from twin_master.mission.journal import encode_line, step_record
from twin_master.mission.preparation import Knowledge
from twin_master.mission.steps import MissionStep, Reading
from twin_master.network.estimator import NoticeWording
from twin_master.network.graphical_model import worsening_table
from twin_master.network.twin import TwinStep
from twin_master.scenario.tables import Learning, Noticing
from uav_twin import ExactFilter, GaussianSensorModel, GraphicalModel, Twin, WatchfulEstimator, prepare_twin

Float = NDArray[np.float64]

SETTINGS = Noticing()
GAINS = SETTINGS.gauge_gain * np.array([-2.5, -1.0, 1.0, 2.5])
DRAWS = np.array([1.0, 2.0])


def small(gauges: int = 3) -> tuple[GraphicalModel, GaussianSensorModel]:
    model = GraphicalModel.from_tables({"z": [0, 1, 2]}, {"u": {"z": worsening_table(3, 0.2)}})
    value = np.random.default_rng(1).normal(10.0, 3.0, size=(2, 3, 1, gauges))
    return model, GaussianSensorModel(value, 1.0)


def watchful(gauges: int = 3, given: Noticing = SETTINGS) -> WatchfulEstimator:
    model, sensors = small(gauges)
    return WatchfulEstimator(ExactFilter(model, sensors), sensors, DRAWS, given)


def drawn(random: np.random.Generator, steps: int, gauges: int = 3) -> Float:
    """Return observations of the model itself, with noise scales drawn from their prior."""
    model, sensors = small(gauges)
    half = 0.5 * SETTINGS.noise_degrees
    scale = np.sqrt(half / random.gamma(half, size=gauges))
    draw, state, rows = random.integers(2), 0, []
    for _ in range(steps):
        rows.append(sensors.value_per_draw[draw, state, 0] + scale * random.normal(size=gauges))
        state = random.choice(3, p=model.transition.matrix[0, state])
    return np.array(rows)


class LooseGauge:
    """Twelve steps in which a gauge shows too much from step 6 on, of an asset where nobody looks for causes.

    They are filtered by the model alone, and by the estimator that gives notice.
    """

    def __init__(self) -> None:
        model, sensors = small()
        self.filter = ExactFilter(model, sensors)
        self.observed = drawn(np.random.default_rng(3), 12)
        self.observed[6:, 1] *= 1.4
        words = NoticeWording(names=("root", "spar", "tip"), command="")
        watching = WatchfulEstimator(self.filter, sensors, DRAWS, words=words)
        self.alone = estimates_of(self.filter, self.observed)
        self.watched = estimates_of(watching, self.observed)
        self.carried = [estimate.carried for estimate in self.watched]
        self.last = self.watched[-1]


@pytest.fixture(scope="module")
def loose_gauge() -> LooseGauge:
    return LooseGauge()


def test_the_filter_goes_on_as_if_it_were_alone(loose_gauge):
    """The evidence is the model's."""
    for alone, watched in zip(loose_gauge.alone, loose_gauge.watched, strict=True):
        filtered = (estimate.carried.arrays["log_filtered"] for estimate in (watched, alone))
        np.testing.assert_array_equal(*filtered)
        assert watched.log_evidence == alone.log_evidence


def test_the_belief_is_that_of_all_hypotheses_that_believe_in_a_state(loose_gauge):
    """Hypotheses that are left out are improbable."""
    for estimate in loose_gauge.watched:
        left_out = 1.0 - sum(hypothesis.probability for hypothesis in estimate.hypotheses)
        mixture = np.zeros(3)
        for hypothesis in estimate.hypotheses:
            if hypothesis.belief is not None:
                mixture += hypothesis.probability * hypothesis.belief
        assert -1e-12 < left_out < 0.03
        np.testing.assert_allclose(mixture / mixture.sum(), estimate.filtered, atol=2.0 * left_out + 1e-6)


def test_the_belief_is_that_of_the_filter_until_a_gauge_comes_loose(loose_gauge):
    for alone, watched in zip(loose_gauge.alone[:6], loose_gauge.watched[:6], strict=True):
        np.testing.assert_allclose(watched.filtered, alone.filtered, atol=0.03)
    difference = loose_gauge.last.filtered - loose_gauge.alone[-1].filtered
    assert np.abs(difference).max() > 0.1


def test_the_loose_gauge_is_the_probable_hypothesis(loose_gauge):
    probability = {hypothesis.name: hypothesis.probability for hypothesis in loose_gauge.last.hypotheses}
    assert probability["gauge 2 (spar) off"] > 0.9
    assert loose_gauge.last.suspicion.gauge_off > 0.9


def test_an_alarm_names_the_gauge_and_the_step_from_which_on_it_is_off(loose_gauge):
    notices = [notice for estimate in loose_gauge.watched for notice in estimate.notices]
    (alarm,) = (notice for notice in notices if notice.kind == "alarm")
    cause = (
        ": gauge 2 (spar) shows too much, or the asset near it differs from the model, for example "
        f"because it has softened, since about step {alarm.since}"
    )
    assert (alarm.sensors, abs(alarm.since - 6) <= 1) == ((2,), True)
    assert cause in alarm.sentence
    assert alarm.sentence.endswith("alarm from 100)")


def test_the_last_smoothed_belief_is_the_filtered_one(loose_gauge):
    smoothed = watchful().smoothed(loose_gauge.carried)
    np.testing.assert_allclose(smoothed[-1], loose_gauge.last.filtered, atol=1e-6)
    np.testing.assert_allclose(smoothed.sum(axis=1), 1.0)
    assert watchful().smoothed([]).shape == (0, 3)


def test_the_smoothed_belief_has_at_least_what_the_model_believes(loose_gauge):
    smoothed = watchful().smoothed(loose_gauge.carried)
    probability_of_model = loose_gauge.carried[-1].arrays["notice/right"]
    by_model = loose_gauge.filter.smoothed(loose_gauge.carried)
    assert np.all(smoothed >= probability_of_model * by_model - 1e-12)


def test_a_model_that_takes_the_place_of_another_begins_without_suspicion(loose_gauge):
    model, sensors = small()
    taught = GaussianSensorModel(sensors.value_per_draw * [[[[1.0, 1.4, 1.0]]]], 1.0)
    estimator = WatchfulEstimator(ExactFilter(model, taught), taught, DRAWS)
    estimate = estimator.step(loose_gauge.carried[-1], loose_gauge.observed[-1], 0, 12)
    assert max(estimate.suspicion.none_of_these, estimate.suspicion.gauge_off) < 0.05
    assert not estimate.notices


def switching_chain(hazard: float) -> np.ndarray:
    """Return the transitions (7, 7) of the hypotheses: no fault, after a fault, drift, four gains.

    A fault begins with the hazard, and it ends; after it only a drift begins.
    """
    ends = hypothesis_weights.END_PROBABILITY
    chain = np.zeros((7, 7))
    chain[0, 0] = 1.0 - hazard
    chain[0, 2] = 0.5 * hazard
    chain[0, 3:] = 0.125 * hazard
    chain[1, 0] = ends
    chain[1, 2] = 0.5 * hazard
    chain[1, 1] = 1.0 - ends - 0.5 * hazard
    chain[2:, 1] = ends
    chain[2:, 2:] += (1.0 - ends) * np.eye(5)
    return chain


def test_shares_of_hypotheses_switch_as_their_chain_says():
    hazard = 0.03
    shares_at_begin = 0.5 * np.concatenate([[0.0, 0.0, 1.0], np.full(4, 0.25)])
    log_shares_at_begin = np.log(shares_at_begin + 1e-300)
    weights = HypothesisWeights.initial(0.01, log_shares_at_begin, 0, 1)
    expected = np.exp(weights.current)
    np.testing.assert_allclose(expected, [0.99, 0.0, 0.005, *[0.00125] * 4], atol=1e-15)
    chain = switching_chain(hazard)
    for _ in range(40):
        expected_ended = hypothesis_weights.END_PROBABILITY * expected[2:]
        expected = expected @ chain
        ended = weights.advance(np.log(hazard), log_shares_at_begin)
        np.testing.assert_allclose(np.exp(weights.current), expected, rtol=1e-3)
        np.testing.assert_allclose(ended / ended.sum(), expected_ended / expected_ended.sum(), rtol=1e-3)
    assert np.exp(weights.current).sum() == pytest.approx(1.0, abs=1e-12)


def two_controls() -> tuple[HypothesisWeights, Float]:
    """Return weights under the second of two controls with a fault that is nearly sure, and its priors."""
    begins = np.log(0.5 * np.concatenate([[0.0, 0.0, 1.0], np.full(4, 0.25)]) + 1e-300)
    weights = HypothesisWeights.initial(0.5, begins, 1, 2)
    weights.update(np.array([0.0, 0.0, 12.0, 0.0, 0.0, 0.0, 0.0]))
    return weights, begins


def test_a_change_of_control_neither_makes_nor_mends_a_fault():
    weights, _ = two_controls()
    before = weights.free_gains_probability
    weights.change_control(1, 0)
    assert weights.free_gains_probability == pytest.approx(before, abs=1e-12)
    assert np.exp(weights.hidden[0]) == pytest.approx(hypothesis_weights.SHOWS_ELSEWHERE * before, abs=1e-12)


def test_a_fault_does_not_fade_under_a_control_that_cannot_show_it():
    weights, begins = two_controls()
    weights.change_control(1, 0)
    right_now = np.array([0.0, 0.0, -3.0, -3.0, -3.0, -3.0, -3.0])  # what shows predicts worse
    for _ in range(200):
        weights.advance(np.log(1e-4), begins)
        weights.update(right_now)
    assert weights.free_gains_probability > 0.9
    weights.change_control(0, 1)
    assert np.exp(weights.current[hypothesis_weights.FREE_GAINS]) > 0.9


def test_a_fault_that_showed_under_a_control_is_mended_by_that_control():
    weights, begins = two_controls()
    weights.change_control(1, 0)
    for log_ratio in (5.0, -5.0):  # it shows there for a while, then no more
        for _ in range(20):
            weights.advance(np.log(1e-4), begins)
            weights.update(np.array([0.0, 0.0, log_ratio, 0.0, 0.0, 0.0, 0.0]))
    assert weights.free_gains_probability < 0.01


def test_evidence_is_the_sum_over_states_draws_gains_and_first_steps(monkeypatch):
    """Where the noise is known and gains are not learnt, against the sum over every course of events."""
    monkeypatch.setattr("twin_master.gauges.fault_filter._GAIN_DEVIATIONS", (0.0,) * 4)
    step_count = 4
    observation = drawn(np.random.default_rng(8), step_count)
    observation[2, 1] = np.nan  # one gauge is lost
    observation[1] = np.nan  # a whole step is lost
    settings = Noticing(noise_degrees=1e9, onset_steps=3.0)
    suspicion = estimates_of(watchful(given=settings), observation)[-1].suspicion
    model, sensors = small()
    survival = 0.5 / (1.0 + np.arange(step_count) / 3.0)
    # that the fault begins at each of these steps, or at none of them
    begin_probability = np.concatenate([[0.5], -np.diff(survival), [survival[-1]]])

    def evidence(gauge: int, gain: float, begin: int) -> float:
        expected = sensors.value_per_draw[:, :, 0].repeat(step_count, axis=1).reshape(2, 3, step_count, 3)
        expected[:, :, begin:, gauge] *= 1.0 + gain
        log_density = np.nansum(norm.logpdf(observation, expected), axis=-1).swapaxes(1, 2)  # (E, T, S)
        total = 0.0
        for density_of_draw in log_density:
            *_, (_, joint) = trajectories(model, [0] * step_count, density_of_draw)
            total += float(joint.sum())
        return 0.5 * total

    for gauge in range(3):
        by_begin = [
            np.mean([evidence(gauge, gain, begin) for gain in GAINS]) for begin in range(step_count + 1)
        ]
        expected = np.log(begin_probability @ by_begin / evidence(gauge, 0.0, 0))
        assert suspicion.log_evidence_gauge[gauge] == pytest.approx(expected, abs=1e-5)


def test_the_first_evidence_is_a_ratio_of_two_sums():
    sensors = small()[1]
    row = sensors.value_per_draw[0, 0, 0] * [1.0, 1.3, 1.0]
    found = estimates_of(watchful(), row[None])[0].suspicion
    sums = np.zeros(2)
    for value in sensors.value_per_draw[:, 0, 0]:  # the first state is certain
        spread = np.sqrt(1.0 + (SETTINGS.all_gain * value) ** 2)
        wide, narrow = (student.pdf(row, SETTINGS.noise_degrees, value, scale) for scale in (spread, 1.0))
        sums += [np.prod(0.5 * wide + 0.5 * narrow), narrow.prod()]
    assert found.log_evidence_none == pytest.approx(np.log(0.5 * sums[0] / sums[1] + 0.5), abs=1e-6)
    for gauge in range(3):
        sums = np.zeros(2)
        for value in sensors.value_per_draw[:, 0, 0]:
            narrow = student.pdf(row, SETTINGS.noise_degrees, value)
            reach = SETTINGS.gauge_gain * np.array([1.0, 0.5, 0.5, 1.0])  # within which a gain is learnt
            spread = np.sqrt(1.0 + (reach * value[gauge]) ** 2)
            off = student.pdf(row[gauge], SETTINGS.noise_degrees, (1.0 + GAINS) * value[gauge], spread).mean()
            sums += [off * np.delete(narrow, gauge).prod(), narrow.prod()]
        expected = np.log(0.5 * sums[0] / sums[1] + 0.5)
        assert found.log_evidence_gauge[gauge] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("steps", [1, 7])
def test_the_mean_of_tomorrows_e_values_is_todays_under_the_predictions_of_the_model(steps):
    """What Ville's inequality needs, by quadrature over the next observation, after any past."""
    estimator = watchful(1)
    seen = drawn(np.random.default_rng(steps), steps, 1)
    seen[-1] += 4.0  # a past that looks like a fault
    today = estimates_of(estimator, seen)[-1]
    model, sensors = small(1)
    kept = today.carried.arrays
    belief = kept["notice/model"] @ model.transition.matrix[0]
    value = sensors.value_per_draw[:, :, 0, 0]
    degrees = SETTINGS.noise_degrees + float(kept["notice/count"][0])
    scale = np.sqrt((SETTINGS.noise_degrees + kept["notice/model_squares"][0]) / degrees)
    grid = np.linspace(-40.0, 60.0, 801)
    density = np.einsum("es,esn->n", belief, student.pdf(grid, degrees, value[..., None], scale))
    wide = WatchfulEstimator(ExactFilter(model, sensors), sensors, DRAWS, Noticing(absurd_deviations=1e3))
    tomorrow = [wide.step(today.carried, np.array([x]), 0, steps).suspicion for x in grid]
    for name in ("log_evidence_none", "log_evidence_any_gauge"):
        values = np.exp([getattr(suspicion, name) for suspicion in tomorrow])
        mean = np.trapezoid(density * values, grid)
        assert mean == pytest.approx(np.exp(getattr(today.suspicion, name)), rel=1e-4)


def twins() -> dict[str, Twin]:
    """Return twins of two gauges that do not learn, learn, and give notice beside either."""
    model, sensors = small(2)
    priors = Learning(noise_degrees=10.0, gauge_gain=0.1, gauge_offset=1.0)
    learning = LearningFilter(model, sensors, priors, ("e", DRAWS))
    inner = {"exact": ExactFilter(model, sensors), "learning": learning}
    own = inner | {f"watchful {name}": WatchfulEstimator(e, sensors, DRAWS) for name, e in inner.items()}
    return {name: Twin(name, model, sensors, np.ones((3, 1)), estimator=e) for name, e in own.items()}


EXTREME = st.floats(allow_infinity=False) | st.sampled_from([5e-324, 1e30, -1e154, 1e308, np.nan])


@settings(max_examples=10, deadline=None)
@given(rows=st.lists(st.tuples(EXTREME, EXTREME), min_size=1, max_size=6), late=st.integers(0, 6))
def test_any_finite_numbers_are_weighed_or_refused_and_the_twin_goes_on(rows, late):
    ordinary = drawn(np.random.default_rng(2), 4, 2)
    for twin in twins().values():
        for number, row in enumerate([ordinary[0], *rows, *ordinary[1:]]):
            before = twin.save_state()
            try:
                step = twin.revise(0, row) if number and number == late else twin.step(row)
            except (ImpossibleObservation, InvalidObservationError):
                assert twin.save_state() == before
                step = twin.step(np.full(2, np.nan))
            assert step.filtered.sum() == pytest.approx(1.0)
            if step.suspicion is not None:
                assert 0.0 <= step.suspicion.none_of_these + step.suspicion.gauge_off <= 1.0 + 1e-12
            record = MissionStep(Reading(np.full(2, np.nan)), step)
            encode_line(step_record(record))  # which holds no NaN and no infinity


ABSURD_STEPS = range(1, 4)


class AbsurdGauge:
    """A twin to which gauge 3 shows absurd values in three steps, and a twin that never had them.

    The reading of step 5 comes late.
    """

    def __init__(self) -> None:
        model, sensors = small()
        self.twin, self.twin_without = (
            Twin("t", model, sensors, np.ones((3, 1)), estimator=watchful(), lag=8) for _ in range(2)
        )
        observed = drawn(np.random.default_rng(5), 10)
        self.late = observed[5].copy()
        self.late[1] = 1e9
        observed[5] = np.nan
        without, absurd = observed.copy(), observed.copy()
        without[1:4, 2] = np.nan
        absurd[1:4, 2] = [1e9, np.nan, 1e16]
        self.steps = [self.twin.step(row, 0) for row in absurd]
        self.steps_without = [self.twin_without.step(row, 0) for row in without]


@pytest.fixture
def absurd_gauge() -> AbsurdGauge:
    return AbsurdGauge()


def test_an_absurd_gauge_is_left_out_and_told_once(absurd_gauge):
    notices = [
        (step, notice.kind, notice.sensors)
        for step, estimate in enumerate(absurd_gauge.steps)
        for notice in estimate.notices
    ]
    left_out = [bool(step.suspicion.left_out[2]) for step in absurd_gauge.steps]
    assert left_out == [step in ABSURD_STEPS for step in range(10)]
    assert notices == [(1, "gauge_left_out", (3,)), (4, "gauge_back", (3,))]


def test_a_twin_believes_what_one_believes_that_never_had_the_absurd_reading(absurd_gauge):
    for step, step_without in zip(absurd_gauge.steps, absurd_gauge.steps_without, strict=True):
        np.testing.assert_allclose(step.filtered, step_without.filtered, rtol=1e-9)


def test_an_absurd_gauge_is_left_out_with_a_word_also_where_it_comes_late(absurd_gauge):
    revised = absurd_gauge.twin.revise(5, absurd_gauge.late)
    notices = [(notice.kind, notice.sensors) for notice in revised.notices]
    assert revised.step == 9
    assert notices == [("gauge_left_out", (2,)), ("gauge_back", (2,))]
    assert "Step 5: gauge 2 shows 1e+09" in revised.notices[0].sentence


def test_too_many_states_are_refused_in_a_sentence(monkeypatch):
    monkeypatch.setattr("twin_master.gauges.fault_filter._MOST_BELIEF_NUMBERS", 71)
    with pytest.raises(InvalidModelError, match=r"3 states and 2 draws for each of 12 faults .* leave out"):
        watchful()


FEW = {"calibration": {"draws": 20}}


def at_levels(name: str, between: bool) -> Knowledge:
    return prepare_twin(changed_scenario(name, FEW | {"observation": {"between_levels": between}}))


@pytest.mark.parametrize(("between", "flights_with_alarm"), [(True, 0), (False, 6)])
def test_damage_between_two_levels_raises_no_alarm(between, flights_with_alarm):
    """Six flights of the panel with a stiffener that grows soft between two levels, and nothing else."""
    panel = at_levels("stiffened_panel", between)
    sensors = panel.sensor_model
    level_counts = panel.model.states.shape
    at_full_pressure = sensors.mean[:, 1].reshape(*level_counts, -1)[:, 0, 0]  # (levels, sensors)
    loss_in_levels = np.minimum(0.25 + 0.01 * np.arange(30), 0.4) / 0.25
    levels = np.arange(level_counts[0])
    strain = np.column_stack([np.interp(loss_in_levels, levels, column) for column in at_full_pressure.T])
    estimator = WatchfulEstimator(panel.twin().estimator, sensors, panel.draws.values)

    def has_alarm(flight: int) -> bool:
        noise = sensors.standard_deviation * np.random.default_rng(flight).normal(size=strain.shape)
        estimates = estimates_of(estimator, strain + noise, [1] * 30)
        return any(notice.kind == "alarm" for estimate in estimates for notice in estimate.notices)

    assert [has_alarm(flight) for flight in range(6)].count(True) == flights_with_alarm


class TwoFaults:
    """Ninety steps in which damage grows, and two faults of gauges come and are mended.

    Gauge 17 is loose from step 12 to 45, every second gauge is off from step 60 to 79. One twin is watched,
    that is, it gives notice; the other one filters alone.
    """

    def __init__(self, between: bool) -> None:
        wing = at_levels("paper_level_turns", between)
        scenario = wing.scenario.model_copy(update={"notice": Noticing()})
        self.knowledge = replace(wing, scenario=scenario)
        self.truth = np.repeat([0.0, 0.2, 0.4, 0.6], [10, 10, 10, 60])
        self.watched: list[TwinStep] = []
        self.alone: list[TwinStep] = []
        twins = ((self.knowledge.twin(lag=1), self.watched), (wing.twin(lag=1), self.alone))
        random = np.random.default_rng(4)
        levels = self.knowledge.model.states.coordinates
        for step, loss in enumerate(self.truth):
            (state,) = np.flatnonzero(np.isclose(levels[:, 0], loss) & (levels[:, 1] == 0.0))
            gain = np.where(self.is_off(step), 0.67, 1.0)
            noise = 150e-6 * random.normal(size=24)
            for twin, course in twins:
                control = course[-1].next_control if step else 1
                row = self.knowledge.sensor_model.mean[state, control] * gain + noise
                course.append(twin.step(row, control))
        self.notices = [notice for step in self.watched for notice in step.notices]

    def is_off(self, step: int) -> NDArray[np.bool_]:
        """Return which gauges are off in a step."""
        gauges = np.arange(24)
        is_loose = (gauges == 16) & (12 <= step < 46)
        return is_loose | (gauges % 2 == 0) & (60 <= step < 80)

    def mean_loss(self, course: list[TwinStep]) -> Float:
        """Return the believed loss of the first region in each step."""
        levels = self.knowledge.model.states.coordinates[:, 0]
        return np.array([step.filtered @ levels for step in course])


@pytest.fixture(scope="module", params=[False, True], ids=["levels", "between levels"])
def two_faults(request: pytest.FixtureRequest) -> TwoFaults:
    return TwoFaults(request.param)


def test_a_watched_twin_believes_what_holds_now(two_faults):
    error = np.abs(two_faults.mean_loss(two_faults.watched) - two_faults.truth)
    assert error[np.r_[14:20, 25:30, 35:90]].max() < 0.12
    assert {step.next_control for step in two_faults.watched[32:]} == {0}


def test_a_filter_alone_believes_the_loose_gauge_and_flies_on(two_faults):
    """It wears the wing."""
    assert two_faults.mean_loss(two_faults.alone)[40:46].max() < 0.25
    assert {step.next_control for step in two_faults.alone[32:46]} == {1}


def test_the_hypothesis_that_holds_now_decides(two_faults):
    deciding = [step.suspicion.decided_by for step in two_faults.watched]
    phases = [(0, 11), (14, 45), (50, 60), (73, 79), (84, 90)]
    by_phase = [{*deciding[begin:end]} for begin, end in phases]
    assert by_phase == [{"model"}, {"gauge 17 off"}, {"model"}, {"none of these"}, {"model"}]


def test_without_a_believed_state_the_safest_control_is_decided_on(two_faults):
    """By the probability that no hypothesis is true."""
    for step in two_faults.watched:
        none = step.suspicion.none_of_these
        by_state = step.filtered @ two_faults.knowledge.plan.policy
        expected = (1.0 - none) * by_state + none * np.array([1.0, 0.0])
        assert step.suspicion.hypotheses["none of these"] == pytest.approx(none, abs=1e-12)
        np.testing.assert_allclose(step.decision_probability, expected, atol=1e-12)


def test_predictions_have_the_safest_control_as_probably_as_no_state_is_believed(two_faults):
    for step in two_faults.watched:
        prediction = step.prediction
        assert np.all(prediction.control_probability[:, 0] >= step.suspicion.none_of_these - 1e-12)
        of_joint = prediction.joint.sum(axis=1)
        np.testing.assert_allclose(of_joint, prediction.control_probability, atol=1e-12)


def test_each_fault_has_an_alarm(two_faults):
    """Gauge 17 is among the gauges that are off in the second fault, too."""
    alarms = [notice for notice in two_faults.notices if notice.kind == "alarm"]
    assert [alarm.sensors[0] for alarm in alarms] == [17, 17]
    assert "least gauges 17 and " in alarms[1].sentence


def test_a_notice_says_what_belief_and_decision_follow(two_faults):
    sentences = [notice.sentence for notice in two_faults.notices if notice.kind == "hypothesis"]
    asset = "Or the asset near it differs from the model, for example because it has softened: these data"
    assert "gauge 17 off: belief and decision follow the other gauges (probability" in sentences[0]
    assert asset in sentences[0]
    assert "the model explains the gauges again (probability" in sentences[1]


def test_a_notice_says_that_no_state_is_believed_and_the_control_is_the_safest(two_faults):
    sentences = [notice.sentence for notice in two_faults.notices if notice.kind == "hypothesis"]
    assert (
        "no state explains the gauges: no state is believed, and the twin proposes the safest control"
        in sentences[-2]
    )


def test_the_safest_control_is_the_one_with_the_least_load_or_the_one_that_is_named():
    wing = prepare_twin(changed_scenario("paper_level_turns", FEW))
    planner = wing.scenario.planner.model_copy(update={"safest": "3g"})
    named = replace(wing, scenario=wing.scenario.model_copy(update={"planner": planner}))
    assert wing.scenario.control_names[wing.safest_control] == "2g"
    assert named.scenario.control_names[named.safest_control] == "3g"


@pytest.fixture(scope="module")
def wrong_from_the_start() -> list[TwinStep]:
    """Six steps of a twin whose gauges are all wrong from the start; nothing is named as the safest."""
    model, sensors = small()
    twin = Twin("t", model, sensors, np.ones((3, 1)), estimator=watchful())
    return [twin.step(row) for row in drawn(np.random.default_rng(1), 6) * [0.5, 1.5, 2.0]]


def test_an_alarm_from_the_start_says_so_and_names_the_command(wrong_from_the_start):
    notices = [notice for step in wrong_from_the_start for notice in step.notices]
    alarm = next(notice for notice in notices if notice.kind == "alarm")
    command = "uav-twin discrepancy run --from-run DIR"
    assert ", from the start " in alarm.sentence
    assert alarm.sentence.endswith(f"alarm from 100); to find the cause: {command}")


def test_the_policy_decides_where_nothing_is_safest(wrong_from_the_start):
    last = wrong_from_the_start[-1]
    assert last.suspicion.none_of_these > 0.5
    np.testing.assert_allclose(last.decision_probability, [1.0])


@pytest.fixture(scope="module")
def level_turns() -> Knowledge:
    wing = at_levels("paper_level_turns", between=False)
    return replace(wing, scenario=wing.scenario.model_copy(update={"notice": Noticing()}))


@pytest.mark.parametrize("seed", range(20))
def test_control_does_not_chatter_where_a_fault_shows_in_sharp_steps_alone(level_turns, seed):
    """Half of the gauges show a third too little at 3g, and what they should at 2g; nothing is damaged."""
    twin, random, control, controls = level_turns.twin(lag=1), np.random.default_rng(seed), 1, []
    wrong = random.permutation(24) < 12
    for _ in range(50):
        gain = np.where(wrong, 0.67, 1.0) if control == 1 else 1.0
        row = level_turns.sensor_model.mean[0, control] * gain + 150e-6 * random.normal(size=24)
        found = twin.step(row, control)
        controls.append(control)
        control = found.next_control
    assert np.count_nonzero(np.diff(controls)) <= 3
    assert found.suspicion.none_of_these > 0.5
