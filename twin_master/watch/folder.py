"""A watch: its folder, its loop over the steps, its journal, and the patches that it adopts."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from reporting.arrays import Float
from reporting.errors import FileNotWrittenError
from reporting.files import atomic_write_bytes, hash_record
from reporting.json_file import JsonObject, JsonRecord
from reporting.progress import Progress
from reporting.system.operating_system import call_on_end_signal
from twin_master.assets.asset_source import AssetSource, calibration_sentence
from twin_master.assets.resolution import believed_source
from twin_master.errors import MissionInputError
from twin_master.feeds.feed import Decision, DecisionSink, Feed
from twin_master.feeds.intake import KEPT_SNAPSHOT_STEPS, Counts, Intake
from twin_master.feeds.rejected import REJECTED_NAME
from twin_master.mission.decision_record import decision_from_line
from twin_master.mission.journal import (
    JOURNAL_NAME,
    KEPT_OF_SUSPICION,
    JournalFile,
    check_header,
    large_parts,
    records_backwards,
    short_record,
)
from twin_master.mission.knowledge_file import link_knowledge, save_knowledge
from twin_master.mission.preparation import prepare_knowledge
from twin_master.mission.recent_parts import RecentParts, is_whole_step
from twin_master.mission.replay import BelievedModel, replay
from twin_master.mission.steps import MissionStep, log_notices, operate
from twin_master.network.estimator import Notice, NoticeWording
from twin_master.network.twin import Twin
from twin_master.run_folder import (
    PICTURE,
    TEACHING,
    VERDICT,
    record_inputs,
    remove_half_written_files,
)
from twin_master.scenario.schema import Scenario
from twin_master.watch.patch_trial import (
    NO_STEPS,
    ComparedSteps,
    PatchOutcome,
    merge_patches,
    outcome_of_patch,
    patched_model,
)
from twin_master.watch.records import ModelRecord
from twin_master.watch.teaching import Teaching

WATCHED_ASSET = "watched asset"
_KEPT_AFTER_ALARM = (*KEPT_OF_SUSPICION, "log_evidence_none", "log_evidence_any_gauge")
"""The entries of a suspicion in the lines after an alarm: the search for its cause needs them."""
FLUSH_SECONDS = 1.0
"""Seconds between two flushes of the journal to the disk while a recording is watched.

After a power failure the recording is read again. The steps of a live watch are flushed one by one.
"""


class GivenPatch(NamedTuple):
    """A patch of the model that the user gives to the twin.

    Attributes
    ----------
    from_step : int
        The first step that is filtered with the patched model.
    """

    file: Path
    from_step: int


class Watch:
    """A watch of an asset, in a folder that this process has locked.

    Parameters
    ----------
    config : dict
        The content of its `config.json`.
    scenario : Scenario
        The scenario, whose paths are in the folder.
    sibling : Watch, optional
        A watch of the same scenario, with which model and plan are shared.

    Attributes
    ----------
    source : AssetSource
        The source of the model that the twin believes.
    inputs : mapping of str to str
        The SHA-256 hash of each input.
    journal_path : Path
        The path of the journal.
    models : list of BelievedModel
        The first model, and the adopted patched models in order.
    teaching : Teaching
        The state of teaching after the last line of the journal.
    journal : JournalFile
        The journal, from `begin` on.
    intake : Intake
        The intake of messages, from `begin` on.
    twin : Twin
        The twin, from `begin` on. It is replaced when a patched model is adopted.
    filtered : (states,) array or None
        The filtered probability of each state after the last step; None before the first step of
        this process.
    has_begun : bool
        Whether journal, intake and twin exist.
    last_step : MissionStep or None
        The last step of this process; None before the first one.
    is_quiet : bool
        Whether the operator was notified that no step comes any more.
    """

    journal: JournalFile
    intake: Intake
    twin: Twin
    filtered: Float | None
    has_begun: bool = False
    last_step: MissionStep | None = None
    is_quiet: bool

    def __init__(
        self,
        folder: Path,
        config: JsonObject,
        scenario: Scenario,
        progress: Progress,
        sibling: "Watch | None" = None,
    ) -> None:
        self.folder = folder
        self.scenario = scenario
        self.progress = progress
        remove_half_written_files(folder)
        if sibling is None:
            self.source: AssetSource = believed_source(scenario)
            self.inputs: Mapping[str, str] = self.source.prepare(folder, progress)
        else:
            self.source = sibling.source
            self.inputs = sibling.inputs
        self.config = record_inputs(folder, config, self.inputs)
        self.models: list[BelievedModel] = []
        self.models.append(self._prepare_model() if sibling is None else sibling.models[0])
        self.journal_path = folder / JOURNAL_NAME
        self._config_hash = hash_record(self.config)
        self.update_from_journal()

        # The knowledge of all models, for viewers. The file of a sibling is linked if neither watch
        # has adopted a patch.
        has_same_knowledge = sibling is not None and len(self.models) == len(sibling.models) == 1
        if sibling is not None and has_same_knowledge:
            link_knowledge(sibling.folder, folder)
        else:
            save_knowledge(folder, self.models[-1].knowledge)
        for number, model in enumerate(self.models[:-1]):
            save_knowledge(folder, model.knowledge, number)

    def _prepare_model(self) -> BelievedModel:
        """Calibrate and plan, and return the first model of the watch."""
        with self.progress.stage("Calibrating and planning"):
            knowledge = prepare_knowledge(self.scenario, self.source, self.scenario.mission.seed)
        remark = calibration_sentence(
            knowledge.draws.record or {}, WATCHED_ASSET, self.source.origin.model, self.inputs
        )
        if remark is not None:
            self.progress.note(remark)
        patch = getattr(self.scenario.belief, "patch", None)
        return BelievedModel(0, knowledge, Path(patch) if patch else None)

    def update_from_journal(self) -> None:
        """Read the state of teaching from the journal, and load adopted models that are missing."""
        check_header(self.journal_path, self._config_hash)
        notice = self.scenario.notice
        threshold = 1.0 if notice is None else notice.threshold  # without notices: of no effect
        self.teaching = Teaching(threshold)
        self.teaching.read_journal(self.journal_path)
        loaded_count = len(self.models) - 1  # the first model was not adopted
        for record in self.teaching.adopted_models[loaded_count:]:
            patch = self.folder / record["patch"]
            model = patched_model(self.scenario, patch, record["from_step"], self.progress)
            self.models.append(model)

    def run(
        self,
        feed: Feed,
        decide: DecisionSink,
        between_steps: Callable[[], None] | None = None,
        *,
        step_limit: int | None = None,
        patch: GivenPatch | None = None,
        unconfirmed: Decision | None = None,
    ) -> Counts:
        """Watch until the feed ends, or until SIGINT or SIGTERM.

        Parameters
        ----------
        decide : callable
            Called with each decision, once its step is in the journal.
        between_steps : callable, optional
            Called before the first step and after each; it may teach the twin.
        step_limit : int, optional
            The number of steps, with those of earlier processes, after which to end.
        patch : GivenPatch, optional
            A patch to adopt before the first step.
        unconfirmed : dict, optional
            The last decision, if a kill may have prevented its sending; it is sent first.

        Returns
        -------
        Counts
            How many messages were received, late or refused.
        """

        def send(decision: Decision) -> None:
            decide(decision)
            feed.send_decision(decision)

        with self.begin(feed, patch):
            self.intake.step_limit = step_limit
            self.intake.on_poll = lambda: self.report_silence(send)
            with call_on_end_signal(self.intake.request_end):
                if unconfirmed is not None:
                    send(unconfirmed)
                if between_steps is not None:
                    between_steps()
                for decision in self.decisions():
                    send(decision)
                    if between_steps is not None:
                        between_steps()
        return self.intake.counts

    @contextmanager
    def begin(self, feed: Feed, patch: GivenPatch | None = None) -> Iterator[None]:
        """Open the journal, and restore the twin and the intake to their state at its last line.

        The intake takes messages from the feed. At the end of this context the counts of the
        messages are written; after an exception they are not.

        Parameters
        ----------
        feed : Feed
            The messages to watch; `Intake.restore` says where reading resumes.
        patch : GivenPatch, optional
            A patch to adopt before the first step.
        """
        intake = Intake(self.scenario, feed, self.folder / REJECTED_NAME)
        intake.stops_at_refusals = True
        flush_seconds = FLUSH_SECONDS if feed.replayable else 0.0
        with JournalFile(self.folder, self._config_hash, flush_seconds) as self.journal:
            # adopted models first: `replay` computes the steps of the journal with them
            self.update_from_journal()
            history, last_line = replay(self.journal_path, self.models, self.scenario.watch.lag)
            self.twin = history.twin
            intake.restore(last_line.get("intake"))
            if last_line:
                step_name = self.scenario.mission.step_name
                self.progress.note(f"The watch continues at {step_name} {self.twin.steps}.")
            self.intake = intake
            self.filtered = None
            self.is_quiet = "quiet" in last_line
            self._time_of_last_step = time.monotonic()
            self._written_intake = intake.state()
            # now that all is restored, other threads may read it (metrics) and a patch be adopted
            self.has_begun = True
            if patch is not None:
                self._adopt_given(patch)
            yield
            # The counts of messages after the last line. If the disk is full, they are lost, but no
            # observation.
            if intake.state()["counts"] != self._written_intake["counts"]:
                with suppress(FileNotWrittenError):
                    self.write_event()

    def decisions(self) -> Iterator[JsonObject]:
        """Yield the decision of each step, once it is in the journal, until the feed ends.

        If the messages after a step are refused, its decision is repeated with a notice. If a
        patched model is adopted between two steps, the loop continues with the twin of this model.
        """
        while True:
            twin = self.twin
            for step in operate(twin, self.intake, log_notices):
                yield self.decision_of(self._write_step(step))
                if twin is not self.twin:  # a patched model was adopted meanwhile
                    break
            if self.intake.stream.has_refusals_to_report:
                decision = self._last_decision_with(
                    self.intake.stream.report_refusals(self.twin.steps)
                )
                self.write_event(notices=decision["notices"], refused=decision)
                yield decision
            elif twin is self.twin:
                return

    def decision_of(self, line: JsonRecord) -> JsonObject:
        """Return the decision in a line of the journal; empty if the line has none."""
        return decision_from_line(line, self.scenario, self.models[-1].knowledge.model)

    def _write_step(self, step: MissionStep) -> JsonObject:
        """Write a step into the journal, with the notices that were pending; return its line.

        If an earlier notice said that no steps arrive, a new one says that steps arrive again.
        """
        line = self.intake.journal_line(step, self.twin)
        notices = list(self.teaching.pending_notices)
        if self.is_quiet:
            when = NoticeWording.of(self.scenario).name_step(line["step"])
            silence = self.seconds_since_step
            sentence = f"{when}: observations arrive again, after {silence:.0f} s."
            notices.append(Notice("heard", sentence).as_record())
        if notices:
            line["notices"] = line.get("notices", []) + notices
        self._append_line(line)
        self.filtered = step.twin_step.filtered
        self.last_step = step
        self.is_quiet = False
        self._time_of_last_step = time.monotonic()
        return line

    def write_event(self, **fields: object) -> None:
        """Write an event that is not a step, such as a verdict, as a line into the journal.

        Parameters
        ----------
        **fields : object
            The entries of the line in addition to the last step, the next control and the intake.
        """
        line = {
            "step": self.twin.steps - 1,
            "next_control": self.twin.proposed_control,
            "intake": self.intake.state(),
        }
        self._append_line(line | fields)

    def _append_line(self, line: JsonRecord) -> None:
        """Add a line to the journal, and update the state of teaching with it.

        Most lines of steps are written without their large parts and without the state of teaching,
        which follows from the lines since the last one that has it.
        """
        teaching_state: JsonObject = {"begin": self.journal.size}
        is_step = "filtered" in line
        is_whole = not is_step or is_whole_step(line["step"])
        kept_of_suspicion = _KEPT_AFTER_ALARM if self.teaching.has_alarm else KEPT_OF_SUSPICION
        journal_line = short_record(line, is_whole=is_whole, kept_of_suspicion=kept_of_suspicion)
        if is_whole:
            teaching_state["teaching"] = self.teaching.as_record()
        if "settled" in line and (line["step"] + 1) % KEPT_SNAPSHOT_STEPS == 0:
            journal_line["settled"] = line["settled"]
        self.journal.append(journal_line | {"standing": teaching_state}, large_parts(line))
        self._written_intake = line["intake"]
        self.teaching.take_line(line)

    @property
    def seconds_since_step(self) -> float:
        """The time since the last step of this process, or since its beginning [s]."""
        return time.monotonic() - self._time_of_last_step

    def last_decision(self) -> JsonObject | None:
        """Return the last decision in the journal; None if there is none.

        The decision is marked with `told_again`, because it may have been sent before a kill.
        """
        recent = RecentParts(self.folder)
        for line, _, _ in records_backwards(self.journal_path, recent=recent):
            if "filtered" in line:
                return {**self.decision_of(line), "told_again": True}
        return None

    def report_silence(self, send: Callable[[JsonObject], None]) -> None:
        """Send the last decision again, with a notice that no step has come for too long.

        It is sent once, when `watch.quiet_after_seconds` have passed since the last step.
        """
        longest_silence = self.scenario.watch.quiet_after_seconds
        if longest_silence is None or self.is_quiet or self.seconds_since_step < longest_silence:
            return
        step_name = self.scenario.mission.step_name
        since = "and none before"
        if self.twin.steps:
            since = f"since {step_name} {self.twin.steps - 1}"
        sentence = (
            f"No {step_name} has come for {longest_silence:g} s, {since}: see whether logger and "
            "broker are there."
        )
        decision = self._last_decision_with(Notice("quiet", sentence))
        self.write_event(notices=decision["notices"], quiet=decision)
        self.is_quiet = True
        send(decision)

    def _last_decision_with(self, notice: Notice) -> JsonObject:
        """Return the last decision with one notice instead of its own.

        Without a decision, a record with the step -1 and without a control is returned.
        """
        decision = self.last_decision() or {"step": -1}
        return {**decision, "notices": [notice.as_record()]}

    def trial_of(
        self, patch: Path, from_step: int, compared: ComparedSteps = NO_STEPS
    ) -> Callable[..., PatchOutcome]:
        """Return a function that computes what a patch would change.

        It reads the journal up to its present end, so it may be called in a thread while the watch
        continues. Its only argument, `progress`, is optional.

        Parameters
        ----------
        patch : Path
            The file of the patch.
        from_step : int
            The first step that would be filtered with the patched model.
        compared : ComparedSteps
            The steps in which the evidence with and without the patch is compared.
        """
        models = tuple(self.models)
        earlier_models = [model for model in models if model.from_step <= from_step]
        return partial(
            outcome_of_patch,
            self.journal_path,
            self.journal.size,
            self.scenario,
            models,
            merge_patches(earlier_models[-1].patch, patch),
            from_step,
            compared,
        )

    def _adopt_given(self, patch: GivenPatch) -> None:
        """Adopt a patch that the user gives, from a step that was watched, or from the next one."""
        steps = self.twin.steps
        if not steps or not 0 <= patch.from_step <= steps:
            raise MissionInputError(
                f"--from-step must be one of the {steps} steps watched so far, or the next one."
            )
        outcome = self.trial_of(patch.file, patch.from_step)(progress=self.progress)
        self.adopt(outcome, None, self._copy_verdict_of(patch.file))

    def _copy_verdict_of(self, patch: Path) -> str:
        """Copy the verdict beside a given patch for viewers, with its drawing of the missing force.

        Return the folder of the copy, relative to that of the watch; empty without a drawing.
        """
        verdict = patch.with_name(VERDICT)
        drawing = patch.parent / PICTURE
        if not verdict.is_file() or not drawing.is_file():
            return ""
        relative_folder = f"{TEACHING}/given_{len(self.models)}"
        for path in (verdict, drawing):
            copy = self.folder / relative_folder / path.relative_to(patch.parent)
            atomic_write_bytes(copy, path.read_bytes())
        return relative_folder

    def adopt(
        self, outcome: PatchOutcome, notice: JsonObject | None, verdict_folder: str = ""
    ) -> None:
        """Adopt a patched model: filter the steps again with it, and continue with its twin.

        Parameters
        ----------
        notice : dict or None
            The notice to the operator, in the form of the journal.
        verdict_folder : str
            The folder of the verdict, relative to that of the watch, if the user gave the patch.
        """
        patch = f"asset/model_patch_{len(self.models)}.json"
        from_step = outcome.model.from_step
        atomic_write_bytes(self.folder / patch, outcome.patch)

        # Filter the steps again with the patched model
        history, _ = replay(
            self.journal_path, self.models, self.scenario.watch.lag, question=outcome.model
        )
        self.twin = history.twin
        alarms = []
        for step, new_notice in history.notices:
            if step >= from_step and new_notice.kind == "alarm":
                alarms.append(dict(vars(new_notice)))
        self.models.append(replace(outcome.model, patch=self.folder / patch))
        record: ModelRecord = {
            "patch": patch,
            "from_step": from_step,
            "alarms": alarms,
            "before": outcome.record["before"],
            "after": outcome.record["after"],
            "policy_change": outcome.record["policy_change"],
        }
        if notice is not None:
            record["notice"] = notice
        if verdict_folder:
            record["verdict"] = verdict_folder

        # Save the knowledge before the line: viewers that read the line load both models, because
        # they show earlier steps with the former one
        former_number = len(self.models) - 2
        save_knowledge(self.folder, self.models[former_number].knowledge, former_number)
        save_knowledge(self.folder, outcome.model.knowledge)
        self.write_event(model=record)
        self._show_adoption(record)

    def _show_adoption(self, model: ModelRecord) -> None:
        """Notify the operator how well the patched model fits, compared with the former one."""
        comparisons = []
        for name, value in model["before"].items():
            if value is not None:
                after = model["after"][name]
                comparisons.append(
                    f"{name.replace('_', ' ')} {value:.4g} before, {after:.4g} after"
                )
        step_name = self.scenario.mission.step_name
        self.progress.note(
            f"The patched model is believed from {step_name} {model['from_step']} on: "
            f"{', '.join(comparisons)}. {model['policy_change']}".rstrip()
        )
