"""A watch that is taught: it asks for the cause, tries what is named, and adopts what explains more."""

import json
import math
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fe.runtime.patch import ModelPatch, SensorGain, SensorSaturation
from reporting.pages.figures import new_figure, to_svg
from tests.twin_master.runs import belief_in_journal, check_same, figures_of, journal, patch_record, written
from tests.twin_master.watch.conftest import ran, viewed, wait_until, watchful, write_csv
from twin_master.errors import MissionInputError
from twin_master.feeds.csv_feed import CsvFeed
from twin_master.mission.decision_record import decision_line
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.mission.knowledge_file import load_knowledge, save_knowledge
from twin_master.mission.replay import replay
from twin_master.network.inference import known_control
from twin_master.store.writing import open_run
from twin_master.viewer.flight_page import FlightPage, Request
from twin_master.watch.folder import GivenPatch, Watch
from twin_master.watch.patch_trial import (
    PatchOutcome,
    describe_policy_change,
    merge_patches,
    patched_model,
)
from twin_master.watch.result import notices_since, store_watch
from twin_master.watch.teaching import Teaching
from twin_master.watch.tutor import Tutor
from twin_master.watch.verdicts import TRIED, read_verdict, trial_sentence
from uav_twin.cause_search import DiscrepancySearch

pytestmark = pytest.mark.xdist_group("teaching")  # one worker makes the wing and its watches

# A search that knows its answer: it waits for a gate, and leaves what `discrepancy run` leaves.
ANSWER = """
import json, pathlib, sys, time
words, (answer, gate) = sys.argv[3:], sys.argv[1:3]
out = pathlib.Path(words[words.index("--out") + 1])
while gate != "-" and not pathlib.Path(gate).exists():
    time.sleep(0.01)
kind, patch = json.loads(pathlib.Path(answer).read_text())
if kind is None:
    sys.exit("Nothing can be said.")
place = out.with_name("." + out.name)
place.mkdir()
gates = [{"name": "absolute fit", "passed": True, "reason": "It leaves only noise."}]
verdict = {"kind": kind, "sentence": "It is so.", "gates": gates, "effects": []}
(place / "verdict.json").write_text(json.dumps({"verdict": verdict}))
(place / "patch.json").write_text(json.dumps(patch))
place.rename(out)
"""


def of_gauge(folder: Path, name: str, gain: float, channel: str = "g5") -> Path:
    """Write a patch in which a gauge shows too much by a share."""
    return written(folder, json.dumps(patch_record(SensorGain(channel, gain), channel=channel)), name=name)


def tutor(
    watch: Watch, place: Path, kind: str | None, gain: float, gate: str = "-", wait: bool = True
) -> Tutor:
    answer, script = place / f"{kind}_{gain}.json", place / "answer.py"
    answer.write_text(json.dumps([kind, patch_record(SensorGain("g5", gain))]))
    script.write_text(ANSWER)
    search = DiscrepancySearch(command=(sys.executable, str(script), str(answer), gate))
    return Tutor(watch, search, wait=wait)


class TaughtWatch:
    """A watch that sees a gauge come loose; a search names it, and its patch is tried and adopted."""

    def __init__(self, base: Watch, recording: Path, folder: Path) -> None:
        self.recording = recording
        self.watch = watchful(base, folder / "watch")
        self.decisions = list[dict[str, Any]]()
        feed = CsvFeed(recording, self.watch.scenario)
        self.watch.run(feed, self.decisions.append, tutor(self.watch, folder, "named", -0.3).teach)
        self.records = journal(self.watch.folder)
        (self.verdict,) = [record["verdict"] for record in self.records if "verdict" in record]
        (self.adoption,) = [record for record in self.records if "model" in record]
        self.model = self.adoption["model"]
        notices = [notice for decision in self.decisions for notice in decision["notices"]]
        self.sentences = [notice["sentence"] for notice in notices]


@pytest.fixture(scope="module")
def taught_watch(base: Watch, loose: Path, tmp_path_factory: pytest.TempPathFactory) -> TaughtWatch:
    return TaughtWatch(base, loose, tmp_path_factory.mktemp("taught"))


def test_the_cause_is_searched_in_the_steps_around_the_alarm(taught_watch):
    verdict = taught_watch.verdict
    alarm_step = next(
        decision["step"]
        for decision in taught_watch.decisions
        for notice in decision["notices"]
        if notice["kind"] == "alarm"
    )
    assert verdict["to_step"] == alarm_step + 10
    assert 12 <= verdict["from_step"] <= 18
    assert taught_watch.model["from_step"] == verdict["from_step"]


def test_an_adopted_patch_explains_more_than_the_model_before_it(taught_watch):
    model = taught_watch.model
    evidence = {
        record["step"]: record["log_evidence"] for record in taught_watch.records if "filtered" in record
    }
    steps = range(model["from_step"], taught_watch.adoption["step"] + 1)
    assert model["before"]["log_evidence"] == pytest.approx(sum(evidence[step] for step in steps))
    assert model["before"]["rms_residual"] > 1.4 > 1.3 > model["after"]["rms_residual"]


def test_alarm_trial_and_adoption_are_told(taught_watch):
    other_notices = ("belief and decision follow", "apart best")
    searching = [
        sentence
        for sentence in taught_watch.sentences
        if not any(words in sentence for words in other_notices)
    ]
    _, trial, adoption = searching
    assert "named. It is so. The patch is tried" in trial
    assert "is believed from step" in adoption


def test_before_anything_is_taught_the_loose_gauge_is_known_to_be_off(taught_watch):
    decision = taught_watch.decisions[taught_watch.verdict["to_step"]]
    assert decision["decided_by"] == "gauge 5 off"
    assert decision["hypotheses"]["gauge 5 off"] > 0.9


def test_the_report_has_the_notices_that_were_told_though_steps_are_filtered_anew(taught_watch):
    notices = notices_since(taught_watch.watch, 0)
    assert [notice.sentence for _, notice in notices] == taught_watch.sentences


def test_the_report_of_the_last_steps_has_the_first_alarm_too(taught_watch):
    watch, step = taught_watch.watch, taught_watch.verdict["to_step"]
    assert notices_since(watch, step)[0] == notices_since(watch, 0)[0]


def test_once_it_is_taught_a_twin_knows_the_wing_as_if_no_gauge_had_come_loose(taught_watch, mission):
    last_belief = np.array(taught_watch.records[-1]["filtered"])
    assert np.abs(last_belief - mission.filtered[-1]).max() < 0.2


def test_a_view_of_steps_draws_no_missing_force(taught_watch):
    """Steps show no motion, and no force in it."""
    assert viewed(taught_watch.watch.folder).drawings == []


def test_a_watch_that_was_stopped_within_the_trial_and_after_the_adoption_is_the_same(
    taught_watch, base, tmp_path
):
    stopped = watchful(base, tmp_path / "stopped")
    to_step = taught_watch.verdict["to_step"]
    for end in (to_step + 5, to_step + 15, None):
        teach = tutor(stopped, tmp_path, "named", -0.3).teach
        stopped.run(CsvFeed(taught_watch.recording, stopped.scenario), str, teach, step_limit=end)
        again = watchful(stopped, tmp_path / f"{end}")
        check_same(again.folder, stopped.folder, JOURNAL_NAME)
        stopped = again
    check_same(stopped.folder, taught_watch.watch.folder, JOURNAL_NAME)


def verdict_with_picture(folder: Path) -> Path:
    """Write a verdict with a patch and the picture of a missing force, as `discrepancy run` leaves it."""
    (folder / "figures").mkdir(parents=True)
    (folder / "figures" / "missing_force.svg").write_bytes(to_svg(new_figure(2.0)))
    (folder / "verdict.json").write_text(json.dumps({"verdict": {"sentence": "It is so."}}))
    of_gauge(folder, "patch.json", -0.3)
    return folder


class PatchedWatch:
    """A watch of 25 steps that believes a given patch from step 15 on; it is given behind step 20.

    It is viewed before and after. The folder of the patch is removed in between.
    """

    def __init__(self, base: Watch, recording: Path, folder: Path) -> None:
        self.watch = watchful(base, folder / "watch")
        feed = CsvFeed(recording, self.watch.scenario)
        verdict = verdict_with_picture(folder / "verdict")
        ran(self.watch, feed, 20)
        self.flight = viewed(self.watch.folder)
        first_steps = self.flight.records_of_steps(0, 5)
        self.first_means_before = self.flight.beliefs_in(first_steps).expected.mean
        self.number_before = self.flight.number
        self.drawings_before = [*self.flight.drawings]
        with pytest.raises(MissionInputError, match="--from-step must be one of the 20 steps"):
            self.watch.run(feed, str, patch=GivenPatch(verdict / "patch.json", 21))
        given = GivenPatch(verdict / "patch.json", 15)
        counts = self.watch.run(feed, str, step_limit=25, patch=given)
        store_watch(self.watch, counts, report=False)
        self.trial_from_step_10 = self.watch.trial_of(verdict / "patch.json", 10)().record
        shutil.rmtree(verdict)
        while self.flight.update():
            pass
        self.run = open_run(self.watch.folder)
        self.figures = figures_of(self.watch.folder)
        self.residual = self.run["filtered"]["residual"].values
        self.steps = self.flight.records_of_steps(0, 25)
        self.shown = self.flight.beliefs_in(self.steps)

    def expected_means(self, probability: np.ndarray, controls: Any, first_patched: int) -> np.ndarray:
        """Return the means of the gauges by the models in force, of which the second one has the patch."""
        means = []
        for part, model in zip(
            (slice(first_patched), slice(first_patched, None)), self.watch.models, strict=True
        ):
            joint = known_control(probability[part], controls[part], 2)
            means.append(model.knowledge.sensor_model.moments(joint)[0])
        return np.concatenate(means)


@pytest.fixture(scope="module")
def patched_watch(base: Watch, recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> PatchedWatch:
    return PatchedWatch(base, recorded, tmp_path_factory.mktemp("patched"))


def root_mean_square(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def test_the_store_names_the_patch_and_the_step_from_which_on_it_is_believed(patched_watch):
    attributes = patched_watch.run.attrs
    assert attributes["model_patch"] == "asset/model_patch_1.json"
    assert attributes["model_patch_from_step"] == 15


def test_figures_have_the_residual_before_and_after_a_patch(patched_watch):
    after = root_mean_square(patched_watch.residual[15:20])
    assert patched_watch.figures["gap_after_patch_15"] == pytest.approx(after)
    assert "gap_before_patch_15" in patched_watch.figures


def test_a_further_trial_compares_with_the_model_in_force(patched_watch):
    before = patched_watch.trial_from_step_10["before"]["rms_residual"]
    assert before == pytest.approx(root_mean_square(patched_watch.residual[10:]))


def test_a_patch_is_believed_from_a_stated_step_on(patched_watch):
    run = patched_watch.run
    probability = run["filtered"]["probability"].values
    controls = run["observed"]["control_index"].values
    expected = patched_watch.expected_means(probability, controls, 15)
    np.testing.assert_allclose(run["filtered"]["quantity_mean"].values, expected, rtol=1e-12)


def test_a_view_tells_its_steps_anew_when_a_patch_is_given(patched_watch):
    assert patched_watch.flight.number > patched_watch.number_before


def test_a_view_shows_steps_as_they_were_told(patched_watch):
    """Those before the patch was given, behind step 19, have the model without it."""
    shown = patched_watch.shown
    controls = [step["control_index"] for step in patched_watch.steps]
    expected = patched_watch.expected_means(shown.probability, controls, 20)
    np.testing.assert_array_equal(shown.expected.mean[:5], patched_watch.first_means_before)
    np.testing.assert_allclose(shown.expected.mean, expected, rtol=1e-12)


def test_a_new_view_shows_what_one_that_followed_shows(patched_watch):
    new_view = viewed(patched_watch.watch.folder).beliefs_in(patched_watch.steps)
    np.testing.assert_array_equal(new_view.expected.mean, patched_watch.shown.expected.mean)


def test_a_view_shows_the_missing_force_of_a_patch_once_it_was_given(patched_watch):
    page = FlightPage(patched_watch.flight)
    request = Request(number=1, flight=-1, first=0, end=0, step=18, shown=-1, count=-1)
    before = json.loads(str(page.answer(request)))
    after = json.loads(str(page.answer(request.model_copy(update={"step": 19}))))
    assert before["picture"] is None
    assert after["picture"]["said"] == "It is so."


def test_the_picture_of_a_patch_is_kept_beside_the_watch(patched_watch, tmp_path):
    """Steps alone have none, as they are no motion; a verdict that says nothing has none either."""
    folder = shutil.copytree(patched_watch.watch.folder, tmp_path / "watch")
    (picture,) = viewed(folder).drawings
    verdict = picture.path.parent.parent / "verdict.json"
    assert patched_watch.drawings_before == []
    assert b"<svg" in picture.path.read_bytes()
    verdict.write_text("{}")
    assert viewed(folder).drawings == []


@pytest.mark.parametrize(
    ("kind", "gain", "sentence"),
    [
        ("named", 0.3, "are needed: it is not adopted."),
        ("named", -0.002, "nats of evidence, but 3 are needed: it is not adopted."),
        ("family", -0.3, "--model-patch DIR/teaching/steps_"),
        (None, 0.0, "the search ended without a verdict: Nothing can be said."),
    ],
)
def test_a_wrong_name_is_not_adopted_and_a_family_is_told(base, loose, tmp_path, kind, gain, sentence):
    watch = watchful(base, tmp_path / "watch")
    teach = tutor(watch, tmp_path, kind, gain).teach
    watch.run(CsvFeed(loose, watch.scenario), str, teach, step_limit=40)
    records = journal(watch.folder)
    notices = [notice["sentence"] for record in records for notice in record.get("notices", [])]
    assert not any("model" in record for record in records)
    assert any(sentence in text for text in notices)
    assert sum("searched for the cause" in text for text in notices) == 2


def verdict_folder(folder: Path, gates: list[dict[str, Any]]) -> Path:
    """Write what a search leaves that has named something."""
    folder.mkdir()
    verdict = {"kind": "named", "sentence": "A mass is missing.", "gates": gates}
    (folder / "verdict.json").write_text(json.dumps({"verdict": verdict}))
    of_gauge(folder, "patch.json", 0.1)
    return folder


@pytest.mark.parametrize(
    ("name", "passed", "caveat"),
    [
        ("absolute fit", False, "It leaves three noises."),
        ("absolute fit", None, "It was not tested whether the residuals are noise."),
        ("shape", True, "It was not tested whether the residuals are noise."),
        ("held-out trials", False, "It leaves three noises."),
    ],
)
def test_a_name_without_an_absolute_fit_is_not_tried_and_the_notice_says_why(tmp_path, name, passed, caveat):
    gates = [{"name": name, "passed": passed, "reason": "It leaves three noises."}]
    verdict = read_verdict(verdict_folder(tmp_path / "verdict", gates), tmp_path / "log", 3, 13, "step")
    assert not verdict["tried"]
    sentence = verdict["notice"]["sentence"]
    assert f"named. A mass is missing. {caveat}" in sentence
    assert "To believe it none the less: uav-twin watch --resume" in sentence


@pytest.mark.parametrize(
    ("members", "tried"),
    [
        ([SensorSaturation("g17", 7e-3), SensorGain("g17", -0.12)], False),
        ([SensorGain("g17", -0.12), SensorGain("g18", -0.1)], True),
        ([SensorSaturation("g17", 7e-3), SensorSaturation("g18", 7e-3)], True),
    ],
)
def test_a_group_that_differs_at_other_loads_is_not_tried(tmp_path, members, tried):
    """Gauge 17 showed 12 % too little; saturation was the most probable of its group, and was adopted."""
    gates = [{"name": "absolute fit", "passed": True, "reason": "It leaves only noise."}]
    folder = verdict_folder(tmp_path / "verdict", gates)
    effects = [{"patch": ModelPatch((member,)).to_list()} for member in members]
    verdict = {"kind": "group", "sentence": "Either is missing.", "gates": gates, "effects": effects}
    (folder / "verdict.json").write_text(json.dumps({"verdict": verdict}))
    found = read_verdict(folder, tmp_path / "log", 3, 13, "step")
    assert found["tried"] is tried
    assert ("more steps at more than one load may" in found["notice"]["sentence"]) is not tried


@pytest.fixture(scope="module")
def saturated(mission, tmp_path_factory) -> Path:
    """The mission as gauges recorded it that all saturate softly, from the first step on."""
    observed = 4e-3 * np.tanh(mission.observed / 4e-3)
    return write_csv(tmp_path_factory.mktemp("saturated") / "saturated.csv", observed, mission.control_index)


def test_after_an_alarm_of_many_gauges_nothing_is_adopted_from_its_name_alone(base, saturated, tmp_path):
    """All gauges saturate; what is named, that all show too little, gains much and is as wrong."""
    script, answer = tmp_path / "answer.py", tmp_path / "answer.json"
    script.write_text(ANSWER)
    answer.write_text(json.dumps(["named", patch_record(SensorGain("*", -0.1, "strain"))]))
    watch = watchful(base, tmp_path / "watch")
    search = DiscrepancySearch(command=(sys.executable, str(script), str(answer), "-"))
    tutor = Tutor(watch, search, wait=True)
    watch.run(CsvFeed(saturated, watch.scenario), str, tutor.teach, step_limit=30)
    records = journal(watch.folder)
    notices = [notice for record in records for notice in record.get("notices", [])]
    trial = next(notice["sentence"] for notice in notices if notice["kind"] == "trial")
    assert not any("model" in record for record in records)
    check_sentence_of_unadopted_patch(trial)


def check_sentence_of_unadopted_patch(sentence: str) -> None:
    """Check that a trial says why the patch is not adopted, how it is believed all the same, and its gain."""
    reason = "and is not adopted from its name alone, because many gauges raised the alarm"
    assert reason in sentence
    assert "uav-twin watch --resume --out DIR --model-patch DIR/teaching/steps_0_to_" in sentence
    assert " gained -" not in sentence


@pytest.fixture(scope="module")
def unbelieved(base, saturated, tmp_path_factory) -> tuple[Watch, list[dict[str, Any]]]:
    """A watch that ends while no state explains the gauges, with its decisions."""
    watch, decisions = watchful(base, tmp_path_factory.mktemp("unbelieved") / "watch"), []
    counts = watch.run(CsvFeed(saturated, watch.scenario), decisions.append, step_limit=12)
    store_watch(watch, counts)
    assert decisions[-1]["none_of_these"] > 0.5 > decisions[0]["none_of_these"]
    return watch, decisions


def test_a_decision_tells_no_state_that_is_not_believed(unbelieved):
    watch, decisions = unbelieved
    last = decisions[-1]
    unknown = {"mean": None, "standard_deviation": None, "unit": "1"}
    assert (last["state_believed"], last["health"]) == (False, {"z1": unknown, "z2": unknown})
    assert "no state is believed; next 2g" in decision_line(watch.scenario, last)


def test_a_decision_tells_the_state_that_is_believed(unbelieved):
    _, decisions = unbelieved
    assert decisions[0]["state_believed"]
    assert decisions[0]["health"]["z1"]["mean"] >= 0.0


def test_report_and_summary_tell_no_state_that_is_not_believed(unbelieved):
    watch, _ = unbelieved
    page = (watch.folder / "report.html").read_text(encoding="utf-8")
    assert "At the end no state is believed: no state of the model explains the gauges" in page
    assert "At the end the twin puts" not in page
    figures = figures_of(watch.folder)
    assert {figures[key] for key in figures if key.startswith("last_")} == {None}


def test_the_page_that_follows_a_flight_shows_no_state_that_is_not_believed(unbelieved):
    watch, _ = unbelieved
    asked = Request(number=1, flight=-1, first=0, end=0, step=-1, shown=-1, count=-1)
    answer = json.loads(str(FlightPage(viewed(watch.folder)).answer(asked)))
    assert answer["past"]["state"][-1] == answer["ahead"]["state"][0] == [None, None]
    assert None not in answer["past"]["state"][0]


def test_a_verdict_is_told_also_with_the_step_that_ends_a_silence_and_is_no_decision(noticing, recorded):
    notice = {"kind": "verdict", "sentence": "It is so.", "sensors": []}
    with noticing.begin(CsvFeed(recorded, noticing.scenario)):
        noticing.write_event(verdict={"tried": False, "to_step": 0, "notice": notice})
        noticing.is_quiet = True
        kinds = [[told["kind"] for told in next(noticing.decisions())["notices"]] for _ in range(2)]
        noticing.write_event(verdict={"tried": False, "to_step": 1, "notice": notice})
        assert noticing.last_decision()["step"] == 1
    assert kinds == [["verdict", "heard"], []]


class LiveTeaching:
    """A live watch whose search goes on until step 32, and whose patched model is built until step 45."""

    def __init__(self, base: Watch, recording: Path, folder: Path) -> None:
        self.watch = watchful(base, folder / "watch")
        self.gate = folder / "gate"
        self.tutor = tutor(self.watch, folder, "group", -0.3, str(self.gate), wait=False)
        self.watch.run(CsvFeed(recording, self.watch.scenario), self.decide, self.tutor.teach)
        self.records = journal(self.watch.folder)
        self.adoption = next(record for record in self.records if "model" in record)
        self.model = self.adoption["model"]
        self.verdict = next(record["verdict"] for record in self.records if "verdict" in record)

    def decide(self, decision: Any) -> None:
        if decision["step"] == 32:
            self.gate.touch()
            wait_until(lambda: [*(self.watch.folder / "teaching").glob("steps*/verdict.json")])
        if decision["step"] == 45:
            wait_until(lambda: self.tutor.outcome is not None and self.tutor.outcome.done())


@pytest.fixture(scope="module")
def live_teaching(base: Watch, loose: Path, tmp_path_factory: pytest.TempPathFactory) -> LiveTeaching:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("uav_twin.cause_search.NICENESS", 0)
        return LiveTeaching(base, loose, tmp_path_factory.mktemp("live"))


def test_live_steps_wait_neither_for_the_search_nor_for_the_patched_model(live_teaching):
    assert (live_teaching.verdict["step"], live_teaching.adoption["step"]) == (32, 45)
    assert live_teaching.verdict["to_step"] < 32
    assert live_teaching.model["from_step"] < 20


def test_the_adoption_of_a_group_says_that_its_members_are_not_told_apart(live_teaching):
    sentence = live_teaching.model["notice"]["sentence"]
    assert sentence.endswith("these data cannot tell which of them is true.")


def test_a_model_that_was_built_beside_live_steps_is_believed_from_its_step_on_to_the_bit(
    live_teaching, mission
):
    observed = mission.observed.copy()
    observed[15:, 4] *= 0.7
    twin, patched = (model.knowledge.twin() for model in live_teaching.watch.models)
    for step, (row, control) in enumerate(zip(observed, mission.control_index.tolist(), strict=True)):
        if step == live_teaching.model["from_step"]:
            patched.restore_state(twin.save_state())
            twin = patched
        belief = twin.step(row, control).filtered
    assert live_teaching.records[-1]["filtered"] == belief_in_journal(belief)


def test_a_watch_with_a_model_that_was_built_beside_live_steps_is_taken_up(live_teaching, tmp_path):
    again = watchful(live_teaching.watch, tmp_path / "again")
    first, second = (
        replay(watch.journal_path, watch.models, watch.scenario.watch.lag)[0].twin
        for watch in (again, live_teaching.watch)
    )
    assert first.save_state() == second.save_state()


def test_a_policy_that_changes_is_told(base):
    known = base.models[0].knowledge
    states, sharp = known.model.states, known.scenario.control_names.index("3g")
    z1, z2 = states.coordinates.T
    assert describe_policy_change(known, known) == ""
    policy = np.eye(2)[np.where((z1 > 0.5) & (z2 > 0.1), 1 - sharp, sharp)]
    sentence = describe_policy_change(known, replace(known, policy=policy))
    assert sentence == (
        "With it another control is chosen in 2 of 25 states, first 3g in the place of 2g at z1 60 %, z2 0 %."
    )
    outcome = PatchOutcome(b"", None, 3.5, {"policy_change": sentence})  # type: ignore[arg-type]
    for kind in TRIED:
        assert trial_sentence({"kind": kind, "from_step": 3}, outcome, "step").endswith(f". {sentence}")


def test_a_gauge_taught_to_show_too_little_makes_no_wing_healthier(base, tmp_path):
    """Gauge 17 is strained most: were its readings the strain, 3g would be left at z1 80 % only."""
    file = of_gauge(tmp_path, "patch.json", -0.12, "g17")
    known, taught = base.models[0].knowledge, patched_model(base.scenario, file, 0).knowledge
    save_knowledge(tmp_path, taught)
    for read in (taught, load_knowledge(tmp_path, taught.scenario)):
        np.testing.assert_allclose(read.rewards.health_per_draw, known.rewards.health_per_draw, rtol=1e-9)
        np.testing.assert_array_equal(read.plan.policy, known.plan.policy)
        shown = read.sensor_model.value_per_draw / known.sensor_model.value_per_draw
        np.testing.assert_allclose(shown[..., [15, 16]], [[[[1.0, 0.88]]]] * np.ones_like(shown[..., :2]))
    observed = taught.sensor_model.mean[0, 0]
    rewards, _ = taught.rewards.expectation(known_control(taught.model.prior, 0, 2), observed)
    assert rewards[2] > -0.2  # readings are compared with readings


def test_gauges_taught_to_saturate_make_no_wing_healthier(base, tmp_path):
    """What is expected of the gauges saturates; health, rewards and policy go by the strain itself."""
    record = json.dumps(patch_record(SensorSaturation("*", 4e-3, "strain")))
    file = written(tmp_path, record, name="saturation.json")
    known, taught = base.models[0].knowledge, patched_model(base.scenario, file, 0).knowledge
    strains, shown = known.sensor_model.value_per_draw, taught.sensor_model.value_per_draw
    np.testing.assert_allclose(shown, 4e-3 * np.tanh(strains / 4e-3), rtol=1e-9)
    np.testing.assert_allclose(taught.rewards.health_per_draw, known.rewards.health_per_draw, rtol=1e-9)
    np.testing.assert_array_equal(taught.plan.policy, known.plan.policy)


def step(number: int, evidence: float = 0.0, *alarms: dict[str, Any]) -> dict[str, Any]:
    """Return the record of a step with the evidence that no hypothesis is true."""
    return {
        "step": number,
        "notices": list(alarms),
        "suspicion": {"log_evidence_none": evidence},
        "filtered": [1.0],
    }


ALARM = {"kind": "alarm", "sentence": "a", "since": 3}
VERDICT = {"kind": "verdict", "sentence": "v"}
HOLDING = 10.0
"""Evidence of a step in which an alarm holds."""


def take_steps(teaching: Teaching, first: int, end: int) -> None:
    for number in range(first, end):
        teaching.take_line(step(number, HOLDING))


@pytest.fixture
def alarmed() -> Teaching:
    """An alarm in step 5, and the ten steps after it; in the last four of them it does not hold."""
    teaching = Teaching(100.0)
    take_steps(teaching, 0, 5)
    teaching.take_line(step(5, HOLDING, ALARM))
    take_steps(teaching, 6, 12)
    for number in (12, 13, 14, 15):
        teaching.take_line(step(number, math.log(100.0) - 0.1))
    return teaching


@pytest.fixture
def searched(alarmed: Teaching) -> Teaching:
    """The alarm held again in step 16; the search for its cause ended with a verdict."""
    alarmed.take_line(step(16, math.log(100.0)))
    alarmed.take_line({"step": 16, "verdict": {"to_step": 16, "step": 16, "tried": False, "notice": VERDICT}})
    return alarmed


def test_an_alarm_must_hold_ten_steps_after_it(alarmed):
    assert alarmed.steps_to_search is None
    alarmed.take_line(step(16, math.log(100.0)))
    assert alarmed.steps_to_search == (3, 16)


def test_a_verdict_is_told_with_the_next_step(searched):
    assert searched.steps_to_search is None
    assert searched.pending_notices == [VERDICT]
    searched.take_line(step(17, HOLDING))
    assert searched.pending_notices == []


def test_the_cause_of_an_alarm_is_asked_again_with_twice_the_steps(searched):
    for number in range(17, 40):
        searched.take_line(step(number, HOLDING))
        assert (searched.steps_to_search is not None) == (number >= 27)
    assert searched.steps_to_search == (3, 27)


def test_the_alarm_of_a_new_model_is_asked_about_from_the_step_on_at_which_it_was_believed(searched):
    take_steps(searched, 17, 40)
    searched.take_line({"step": 40, "model": {"from_step": 8, "notice": VERDICT, "alarms": [ALARM]}})
    assert (searched.steps_to_search, searched.pending_notices) == (None, [VERDICT, ALARM])
    take_steps(searched, 41, 60)
    assert searched.steps_to_search == (8, 49)


def test_a_second_patch_stands_beside_the_first(tmp_path):
    first, second = (of_gauge(tmp_path, channel, -0.1, channel) for channel in ("g5", "g7"))
    both = json.loads(merge_patches(first, second))
    assert [effect["primitives"][0]["channel"] for effect in both["effects"]] == ["g5", "g7"]
    assert both["channels"] == {"g5": "strain[5]", "g7": "strain[7]"}
    assert merge_patches(None, second) == second.read_bytes()
