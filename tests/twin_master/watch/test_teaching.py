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
from reporting.figures import new_figure, to_svg
from tests.twin_master.runs import check_same, figures_of, journal, patch_record, written
from tests.twin_master.watch.conftest import ran, viewed, wait_until, watchful, write_csv
from twin_master.errors import MissionInputError
from twin_master.mission.decision_record import decision_line
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.mission.preparation import load_knowledge, save_knowledge
from twin_master.mission.replay import replay
from twin_master.network.inference import known_control
from twin_master.store.writing import open_run
from twin_master.viewer.flight_page import FlightPage, Request
from twin_master.watch.csv_feed import CsvFeed
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


def test_what_is_named_is_tried_adopted_and_the_same_after_kills(base, mission, loose, tmp_path):
    (tmp_path / "whole").mkdir()
    watch = watchful(base, tmp_path / "whole" / "watch")
    decisions = list[dict[str, Any]]()
    watch.run(CsvFeed(loose, watch.scenario), decisions.append, tutor(watch, tmp_path, "named", -0.3).teach)
    records = journal(watch.folder)
    (verdict,) = [record["verdict"] for record in records if "verdict" in record]
    (model,) = [record["model"] for record in records if "model" in record]
    alarm = next(d for d in decisions for n in d["notices"] if n["kind"] == "alarm")
    assert verdict["to_step"] == alarm["step"] + 10
    assert 12 <= verdict["from_step"] <= 18
    assert model["from_step"] == verdict["from_step"]
    (adopted,) = [record["step"] for record in records if "model" in record]
    steps = {record["step"]: record["log_evidence"] for record in records if "filtered" in record}
    evidence = [steps[step] for step in range(model["from_step"], adopted + 1)]
    assert model["before"]["log_evidence"] == pytest.approx(sum(evidence))
    assert model["before"]["rms_residual"] > 1.4 > 1.3 > model["after"]["rms_residual"]
    said = [notice["sentence"] for d in decisions for notice in d["notices"]]
    searched = [sentence for sentence in said if "belief and decision follow" not in sentence]
    assert "named. It is so. The patch is tried" in searched[1]
    assert "is believed from step" in searched[2]
    assert len(searched) == 3
    asked = decisions[verdict["to_step"]]  # before anything is taught the gauge is known to be off
    assert asked["decided_by"] == "gauge 5 off"
    assert asked["hypotheses"]["gauge 5 off"] > 0.9
    assert [
        notice.sentence for _, notice in notices_since(watch, 0)
    ] == said  # in the report too, though filtered anew
    assert (
        notices_since(watch, asked["step"])[0] == notices_since(watch, 0)[0]
    )  # the first alarm also in that of the last steps
    # Once it is taught, the twin knows the wing as one that had seen no loose gauge.
    last = records[-1]["filtered"]
    assert np.abs(np.array(last) - mission.filtered[-1]).max() < 0.2
    assert viewed(watch.folder).drawings == []  # steps show no motion, and no force in it
    # Stopped within the trial, and after the adoption: the same journal.
    stopped = watchful(base, tmp_path / "stopped")
    asked = verdict["to_step"]
    for end in (asked + 5, asked + 15, None):
        teach = tutor(stopped, tmp_path, "named", -0.3).teach
        stopped.run(CsvFeed(loose, stopped.scenario), str, teach, step_limit=end)
        again = watchful(stopped, tmp_path / f"{end}")
        check_same(again.folder, stopped.folder, JOURNAL_NAME)
        stopped = again
    check_same(stopped.folder, watch.folder, JOURNAL_NAME)


def test_a_patch_is_believed_from_a_stated_step_on_and_its_missing_force_shown(noticing, recorded, tmp_path):
    folder = tmp_path / "verdict"  # as `discrepancy run` leaves one
    (folder / "figures").mkdir(parents=True)
    (folder / "figures" / "missing_force.svg").write_bytes(to_svg(new_figure(2.0)))
    (folder / "verdict.json").write_text(json.dumps({"verdict": {"sentence": "It is so."}}))
    of_gauge(folder, "patch.json", -0.3)
    ran(noticing, CsvFeed(recorded, noticing.scenario), 20)
    flight = viewed(noticing.folder)
    before, number = flight.beliefs_in(flight.records_of_steps(0, 5)).expected.mean, flight.number
    assert flight.drawings == []  # steps are no motion
    with pytest.raises(MissionInputError, match="--from-step names one of the 20 steps"):
        noticing.run(CsvFeed(recorded, noticing.scenario), str, patch=GivenPatch(folder / "patch.json", 21))
    given = GivenPatch(folder / "patch.json", 15)
    counts = noticing.run(CsvFeed(recorded, noticing.scenario), str, step_limit=25, patch=given)
    store_watch(noticing, counts, report=False)
    run = open_run(noticing.folder)
    assert (run.attrs["model_patch"], run.attrs["model_patch_from_step"]) == ("asset/model_patch_1.json", 15)
    figures, residual = figures_of(noticing.folder), run["filtered"]["residual"].values
    assert figures["gap_after_patch_15"] == pytest.approx(np.sqrt(np.nanmean(residual[15:20] ** 2)))
    assert "gap_before_patch_15" in figures
    before_both = noticing.trial_of(folder / "patch.json", 10)().record["before"]["rms_residual"]
    assert before_both == pytest.approx(np.sqrt(np.nanmean(residual[10:] ** 2)))
    believed, controls = run["filtered"]["probability"].values, run["observed"]["control_index"].values
    for part, model in zip((slice(15), slice(15, None)), noticing.models, strict=True):
        expected, _ = model.knowledge.sensor_model.moments(known_control(believed[part], controls[part], 2))
        np.testing.assert_allclose(run["filtered"]["quantity_mean"].values[part], expected, rtol=1e-12)
    shutil.rmtree(folder)
    while flight.update():
        pass
    assert flight.number > number  # what a view has told is void
    seen = flight.records_of_steps(0, 25)
    shown = flight.beliefs_in(seen)
    np.testing.assert_array_equal(shown.expected.mean[:5], before)  # as it was told
    controls = [step["control_index"] for step in seen]
    for part, model in zip((slice(20), slice(20, None)), noticing.models, strict=True):
        joint = known_control(shown.probability[part], controls[part], 2)
        expected, _ = model.knowledge.sensor_model.moments(joint)
        np.testing.assert_allclose(shown.expected.mean[part], expected, rtol=1e-12)
    np.testing.assert_array_equal(viewed(noticing.folder).beliefs_in(seen).expected.mean, shown.expected.mean)
    (picture,) = flight.drawings
    teller = FlightPage(flight)
    assert b"<svg" in picture.path.read_bytes()
    asked = Request(number=1, flight=-1, first=0, end=0, step=18, shown=-1, count=-1)
    assert json.loads(str(teller.answer(asked)))["picture"] is None  # as was known at the time
    shown = json.loads(str(teller.answer(asked.model_copy(update={"step": 19}))))["picture"]
    assert shown["said"] == "It is so."
    (picture.path.parent.parent / "verdict.json").write_text("{}")
    assert viewed(noticing.folder).drawings == []


def test_a_wrong_name_is_not_adopted_and_a_family_is_told(base, loose, tmp_path):
    for kind, gain, sentence in (
        ("named", 0.3, "and is not adopted."),
        ("named", -0.002, "nats of evidence, but 3 are needed: it is not adopted."),
        ("family", -0.3, "--model-patch DIR/teaching/steps_"),
        (None, 0.0, "the search ended without a verdict: Nothing can be said."),
    ):
        watch = watchful(base, tmp_path / f"{kind}{gain}")
        watch.run(
            CsvFeed(loose, watch.scenario), str, tutor(watch, tmp_path, kind, gain).teach, step_limit=40
        )
        records = journal(watch.folder)
        assert not any("model" in record for record in records)
        notices = [n["sentence"] for record in records for n in record.get("notices", [])]
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
    teach = Tutor(watch, search, wait=True)
    watch.run(CsvFeed(saturated, watch.scenario), str, teach.teach, step_limit=30)
    records = journal(watch.folder)
    trial = next(n["sentence"] for r in records for n in r.get("notices", []) if n["kind"] == "trial")
    assert not any("model" in record for record in records)
    assert "and is not adopted from its name alone, because many gauges raised the alarm" in trial
    assert "uav-twin watch --resume --out DIR --model-patch DIR/teaching/steps_0_to_" in trial
    assert " gained -" not in trial


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
    health = {"mean": None, "standard_deviation": None, "unit": "1"}
    assert (decisions[-1]["state_believed"], decisions[-1]["health"]) == (False, {"z1": health, "z2": health})
    assert "no state is believed; next 2g" in decision_line(watch.scenario, decisions[-1])
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


def test_live_steps_wait_neither_for_the_search_nor_for_the_patched_model(
    noticing, mission, loose, tmp_path, monkeypatch
):
    """It is built beside them, and believed behind the step that the journal says, to the bit."""
    monkeypatch.setattr("uav_twin.cause_search.NICENESS", 0)
    gate = tmp_path / "gate"
    live = tutor(noticing, tmp_path, "group", -0.3, str(gate), wait=False)

    def decide(decision: Any) -> None:
        if decision["step"] == 32:  # the steps before were decided while the search went on
            gate.touch()
            wait_until(lambda: [*(noticing.folder / "teaching").glob("steps*/verdict.json")])
        if decision["step"] == 45:  # and those behind the trial while the model was built
            wait_until(lambda: live.outcome is not None and live.outcome.done())

    noticing.run(CsvFeed(loose, noticing.scenario), decide, live.teach)
    model = next(record for record in journal(noticing.folder) if "model" in record)
    verdict = next(record["verdict"] for record in journal(noticing.folder) if "verdict" in record)
    assert (verdict["step"], model["step"]) == (32, 45)
    assert verdict["to_step"] < 32
    assert model["model"]["from_step"] < 20
    assert model["model"]["notice"]["sentence"].endswith("these data cannot tell which of them is true.")
    observed = mission.observed.copy()
    observed[15:, 4] *= 0.7
    twin, patched = (one.knowledge.twin() for one in noticing.models)
    for step, (row, control) in enumerate(zip(observed, mission.control_index.tolist(), strict=True)):
        if step == model["model"]["from_step"]:
            patched.restore_state(twin.save_state())
            twin = patched
        believed = twin.step(row, control).filtered.tolist()
    assert journal(noticing.folder)[-1]["filtered"] == believed
    again = watchful(noticing, tmp_path / "again")
    twins = [
        replay(one.journal_path, one.models, one.scenario.watch.lag)[0].twin for one in (again, noticing)
    ]
    assert twins[0].save_state() == twins[1].save_state()


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
    told = {"suspicion": {"log_evidence_none": evidence}, "filtered": [1.0]}
    return {"step": number, "notices": list(alarms), **told}


def test_an_alarm_must_hold_and_is_asked_again_with_twice_the_steps():
    teaching = Teaching(100.0)
    alarm = {"kind": "alarm", "sentence": "a", "since": 3}
    for number in range(12):
        teaching.take_line(step(number, 10.0, *([alarm] if number == 5 else [])))
    for number in (12, 13, 14, 15):
        teaching.take_line(step(number, math.log(100.0) - 0.1))
    assert teaching.steps_to_search is None  # it did not hold ten steps after the alarm
    teaching.take_line(step(16, math.log(100.0)))
    assert teaching.steps_to_search == (3, 16)
    told = {"kind": "verdict", "sentence": "v"}
    teaching.take_line({"step": 16, "verdict": {"to_step": 16, "step": 16, "tried": False, "notice": told}})
    assert teaching.steps_to_search is None
    assert teaching.pending_notices == [told]
    for number in range(17, 40):
        teaching.take_line(step(number, 10.0))
        assert (teaching.steps_to_search is not None) == (number >= 27)
    assert teaching.steps_to_search == (3, 27)
    assert teaching.pending_notices == []
    teaching.take_line({"step": 40, "model": {"from_step": 8, "notice": told, "alarms": [alarm]}})
    assert (teaching.steps_to_search, teaching.pending_notices) == (None, [told, alarm])
    for number in range(41, 60):
        teaching.take_line(step(number, 10.0))
    assert teaching.steps_to_search == (8, 49)  # the alarm of the new model, and not before it was believed


def test_a_second_patch_stands_beside_the_first(tmp_path):
    first, second = (of_gauge(tmp_path, channel, -0.1, channel) for channel in ("g5", "g7"))
    both = json.loads(merge_patches(first, second))
    assert [effect["primitives"][0]["channel"] for effect in both["effects"]] == ["g5", "g7"]
    assert both["channels"] == {"g5": "strain[5]", "g7": "strain[7]"}
    assert merge_patches(None, second) == second.read_bytes()
