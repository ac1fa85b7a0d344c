"""A watch: its folder, begun or taken up again, its loop, and what it leaves."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Any

from reporting.arrays import Float
from reporting.errors import FileNotWrittenError
from reporting.files import atomic_write_bytes, hash_record
from reporting.progress import Progress
from twin_master.assets.asset_source import AssetSource, FlownAndBelieved, calibration_sentence
from twin_master.assets.resolution import believed_source
from twin_master.errors import MissionInputError, said
from twin_master.mission.decision_record import decision_from_line
from twin_master.mission.journal import (
    JOURNAL_NAME,
    JournalFile,
    check_header,
    last_step,
    records_backwards,
)
from twin_master.mission.loop import operate
from twin_master.mission.preparation import link_knowledge, prepare_knowledge, save_knowledge
from twin_master.mission.replay import BelievedModel, replay
from twin_master.mission.steps import MissionStep
from twin_master.network.estimator import Notice
from twin_master.network.twin import Twin
from twin_master.run_folder import PICTURE, TEACHING, VERDICT, record_inputs, remove_half_written_files
from twin_master.scenario.schema import Scenario
from twin_master.store.mission_result import MissionResult
from twin_master.store.summary import FigureGroup
from twin_master.store.writing import store_flight
from twin_master.watch.intake import REJECTED_NAME, Counts, Feed, Intake, listening
from twin_master.watch.teaching import Outcome, Teaching, both_patches, judged, patched_model

WATCHED = "watched asset"
STORED_STEPS = 1_000
"""The last steps that `run.nc` and the report show if not told otherwise; the journal has all of them."""
FLUSH_SECONDS = 1.0
"""Of a recorded file, which is read again after a power failure; live steps are flushed one by one."""
Patched = tuple[Path, int]
"""A patch of the twin's model, and the step from which on it is believed."""


class Watch:
    """A watch whose folder this process holds.

    Parameters
    ----------
    folder : Path
        Of the watch.
    config : dict
        Its `config.json`.
    scenario : Scenario
        Located in the folder.
    progress : Progress
        Shows stages and notes.
    like : Watch, optional
        A watch of the same scenario, whose model and plan this one shares.

    Attributes
    ----------
    journal, intake, twin
        From `begun` on; another twin where it was taught.
    filtered : (S,) or None
        What was believed after the last step; None before the first one of this process.
    is_quiet : bool
        Whether the operator was told that no step comes any more.
    """

    journal: JournalFile
    intake: Intake
    twin: Twin
    filtered: Float | None
    is_quiet: bool

    def __init__(
        self, folder: Path, config: dict[str, Any], scenario: Scenario, progress: Progress,
        like: "Watch | None" = None,
    ) -> None:  # fmt: skip
        self.folder, self.scenario, self._progress = folder, scenario, progress
        remove_half_written_files(folder)
        self._source: AssetSource = believed_source(scenario) if like is None else like._source
        prepared = self._source.prepare(folder, progress) if like is None else like._inputs
        self._inputs: Mapping[str, str] = prepared
        self._config = record_inputs(folder, config, self._inputs)
        self.models: list[BelievedModel] = [self._prepared() if like is None else like.models[0]]
        self._path = folder / JOURNAL_NAME
        self._hash = hash_record(self._config)
        self._take_up()
        if like is not None and len(self.models) == len(like.models) == 1:
            link_knowledge(like.folder, folder)
        else:
            save_knowledge(folder, self.models[-1].knowledge)
        for number, model in enumerate(self.models[:-1]):
            save_knowledge(folder, model.knowledge, number)

    def _prepared(self) -> BelievedModel:
        """Calibrate and plan."""
        with self._progress.stage("Calibrating and planning"):
            knowledge = prepare_knowledge(self.scenario, self._source, self.scenario.mission.seed)
        origin = self._source.origin.model
        told = calibration_sentence(knowledge.draws.record or {}, WATCHED, origin, self._inputs)
        if told is not None:
            self._progress.note(told)
        own = getattr(self.scenario.belief, "patch", None)
        return BelievedModel(0, knowledge, Path(own) if own else None)

    def _take_up(self) -> None:
        """Take in the journal, and believe the patches that were adopted, as far as that is not done yet."""
        check_header(self._path, self._hash)
        notice = self.scenario.notice
        self.teaching = Teaching(1.0 if notice is None else notice.threshold)
        self.teaching.read(self._path)
        for model in self.teaching.adopted[len(self.models) - 1 :]:
            first, file = model["from_step"], self.folder / model["patch"]
            self.models.append(patched_model(self.scenario, file, first, self._progress))

    def run(
        self, feed: Feed, decide: Callable[[Mapping[str, Any]], object],
        between: Callable[[], None] = lambda: None, *, steps: int | None = None,
        patched: Patched | None = None, untold: Mapping[str, Any] | None = None,
    ) -> Counts:  # fmt: skip
        """Watch until the feed ends, or SIGINT or SIGTERM ask for it between two steps.

        Parameters
        ----------
        feed : Feed
            Of the observations.
        decide : callable
            Told each decision, once its step is written down.
        between : callable, optional
            Called before the first step and behind each; it may teach the twin.
        steps : int, optional
            Steps in all after which to end.
        patched : Patched, optional
            To believe from a step on.
        untold : dict, optional
            The last decision, to be told again first.
        """

        def tell(decision: Mapping[str, Any]) -> None:
            decide(decision)
            feed.decide(decision)

        with self.begun(feed, patched):
            self.intake.steps, self.intake.look = steps, lambda: self.quiet(tell)
            with listening(self.intake.ask):
                if untold is not None:
                    tell(untold)
                between()
                for decision in self.decisions():
                    tell(decision)
                    between()
        return self.intake.counts

    @contextmanager
    def begun(self, feed: Feed, patched: Patched | None = None) -> Iterator[None]:
        """Open the journal, and take up the twin as it stands after it; see `run`."""
        intake = Intake(self.scenario, feed, self.folder / REJECTED_NAME)
        intake.stops_at_refusals = True
        seconds = FLUSH_SECONDS if feed.replayable else 0.0
        with JournalFile(self.folder, self._hash, seconds) as self.journal:
            self._take_up()
            found, last = replay(self._path, self.models, self.scenario.watch.lag)
            intake.restore(last.get("intake"))
            if last:
                self._progress.note(
                    f"The watch goes on at {self.scenario.mission.step_name} {found.twin.steps}."
                )
            self.intake, self.twin, self.filtered = intake, found.twin, None
            self.is_quiet, self._heard = "quiet" in last, time.monotonic()
            self._told = intake.state()
            if patched is not None:
                self._patch(*patched)
            yield
            if self.intake.state()["counts"] != self._told["counts"]:  # of messages behind the last step
                with suppress(FileNotWrittenError):  # which is no loss of what was observed
                    self.write()

    def decisions(self) -> Iterator[dict[str, Any]]:
        """Yield what the operator is told of each step, once it is written down, until no more comes.

        Also the last decision again, with a notice, where the messages behind it are refused.
        """
        while True:
            twin = self.twin
            for step in operate(twin, self.intake):
                yield self.decision_of(self._kept(step))
                if twin is not self.twin:  # it was taught meanwhile: another one goes on
                    break
            if self.intake.stream.refusals_are_untold:
                yield self._refusals()
            elif twin is self.twin:
                return

    def decision_of(self, line: Mapping[str, Any]) -> dict[str, Any]:
        """Return what the operator is told with a line of the journal; nothing where it tells no decision."""
        return decision_from_line(line, self.scenario, self.models[-1].knowledge.model)

    def _kept(self, step: MissionStep) -> dict[str, Any]:
        """Write down a reading and what became of it; return the line."""
        record, told = self.intake.line(step, self.twin), self.teaching.untold
        if self.is_quiet:
            when = f"{self.scenario.mission.step_name.capitalize()} {record['step']}"
            sentence = f"{when}: observations come again, after {self.silence:.0f} s."
            told = [*told, Notice("heard", sentence).as_record()]
        if told:
            record["notices"] = record.get("notices", []) + told
        self._append(record)
        self.filtered, self.is_quiet, self._heard = step.twin_step.filtered, False, time.monotonic()
        return record

    def write(self, **record: Any) -> None:
        """Write down something else than a step."""
        state = {"next_control": self.twin.proposed_control, "intake": self.intake.state()}
        self._append({"step": self.twin.steps - 1, **state, **record})

    def _append(self, record: Mapping[str, Any]) -> None:
        """Add a line to the journal, and take it in."""
        standing = {"begin": self.journal.size, "teaching": vars(self.teaching)}
        self.journal.append({**record, "standing": standing})
        self._told = record["intake"]
        self.teaching.take(record)

    @property
    def silence(self) -> float:
        """How long no step has come [s]."""
        return time.monotonic() - self._heard

    def last_decision(self) -> dict[str, Any] | None:
        """Return the last decision in the journal; None without any.

        A kill may have left it untold, and nobody knows: it has `told_again`.
        """
        lines = (line for line, *_ in records_backwards(self._path) if "filtered" in line)
        last = next(lines, None)
        return None if last is None else {**self.decision_of(last), "told_again": True}

    def quiet(self, decide: Callable[[dict[str, Any]], None]) -> None:
        """Tell the last decision with the notice that it grows old, once no step has come for too long."""
        longest, step = self.scenario.watch.quiet_after_seconds, self.scenario.mission.step_name
        if longest is None or self.is_quiet or self.silence < longest:
            return
        since = f"since {step} {self.twin.steps - 1}" if self.twin.steps else "and none before"
        sentence = f"No {step} has come for {longest:g} s, {since}: see whether logger and broker are there."
        decision = self._last_decision_with(Notice("quiet", sentence))
        self.write(notices=decision["notices"], quiet=decision)
        self.is_quiet = True
        decide(decision)

    def _refusals(self) -> dict[str, Any]:
        """Write down that messages are refused; return the last decision with the notice that says so."""
        decision = self._last_decision_with(self.intake.stream.refusals(self.twin.steps))
        self.write(notices=decision["notices"], refused=decision)
        return decision

    def _last_decision_with(self, notice: Notice) -> dict[str, Any]:
        """Return the last decision, or what stands for it before the first one, with a notice alone."""
        return {**(self.last_decision() or {"step": -1}), "notices": [notice.as_record()]}

    def trial(self, file: Path, from_step: int, compared: tuple[int, int] = (0, 0)) -> Callable[..., Outcome]:
        """Return what tells what comes of a patch from a step on, after all lines of the journal so far."""
        models = tuple(self.models)
        believed = [model for model in models if model.from_step <= from_step][-1]
        patch = both_patches(believed.patch, file)
        return partial(
            judged, self._path, self.journal.size, self.scenario, models, patch, from_step, compared
        )

    def _patch(self, file: Path, first: int) -> None:
        """Believe a patch that is given from a step on."""
        steps = self.twin.steps
        if not steps or not 0 <= first <= steps:
            raise MissionInputError(said("watch.from_step", steps=steps))
        outcome = self.trial(file, first)(progress=self._progress)
        # The missing force that its verdict shows is kept for viewers.
        kept, shown = f"{TEACHING}/given_{len(self.models)}", [file.with_name(VERDICT), file.parent / PICTURE]
        found = all(path.is_file() for path in shown)
        for path in shown if found else ():
            place = self.folder / kept / path.relative_to(file.parent)
            atomic_write_bytes(place, path.read_bytes())
        self.adopt(outcome, None, kept * found)

    def adopt(self, outcome: Outcome, notice: Mapping[str, Any] | None, verdict: str = "") -> None:
        """Believe a patched model: with its twin it is gone on."""
        name, first = f"asset/model_patch_{len(self.models)}.json", outcome.model.from_step
        atomic_write_bytes(self.folder / name, outcome.patch)
        again, _ = replay(self._path, self.models, self.scenario.watch.lag, question=outcome.model)
        alarms = [n for step, n in again.notices if step >= first and n.kind == "alarm"]
        self.twin = again.twin
        self.models.append(replace(outcome.model, patch=self.folder / name))
        model: dict[str, Any] = {
            "patch": name, "from_step": first, "alarms": [vars(alarm) for alarm in alarms], **outcome.record,
            **({} if notice is None else {"notice": dict(notice)}),
            **({"verdict": verdict} if verdict else {}),
        }  # fmt: skip
        # Before viewers read the line; they show earlier steps as they were told.
        save_knowledge(self.folder, self.models[-2].knowledge, len(self.models) - 2)
        save_knowledge(self.folder, outcome.model.knowledge)
        self.write(model=model)
        gaps = [
            f"{name.replace('_', ' ')} {value:.4g} before, {model['after'][name]:.4g} after"
            for name, value in model["before"].items()
            if value is not None
        ]
        since = f"The patched model is believed from {self.scenario.mission.step_name} {first} on"
        self._progress.note(f"{since}: {', '.join(gaps)}. {model['policy_change']}".rstrip())

    def store(self, counts: Counts, *, last: int = STORED_STEPS, report: bool = True) -> None:
        """Write `run.nc`, tables, summary and report of the last steps."""
        steps = last_step(self._path)[0] + 1
        if not steps:
            self._progress.note("Nothing was observed: there is nothing to report.")
            return
        result, attributes = self.result(steps, last), {}
        for model in self.teaching.adopted[-1:]:
            attributes = {"model_patch": model["patch"], "model_patch_from_step": model["from_step"]}
        origin = FlownAndBelieved(WATCHED, self._source.origin.model)
        with self._progress.stage("Storing"):
            store_flight(
                self.folder, self._config, result, origin, steps=steps,
                figures=self._figures(counts, steps), attributes=attributes,
            )  # fmt: skip
        if report:
            from twin_master.report.page import write_report

            with self._progress.stage("Writing the report"):
                write_report(self.folder)

    def result(self, steps: int, last: int) -> MissionResult:
        """Return the last of so many steps, as a mission."""
        first = max(0, steps - last)
        found, _ = replay(self._path, self.models, None, first_step=first)
        flight = replace(found.without_first(first - found.first_step), notices=self.told(first))
        return MissionResult(self.scenario, self.models[-1].knowledge, flight, models=self.models)

    def told(self, first: int) -> list[tuple[int, Notice]]:
        """Return what the operator was told in the steps from `first` on, each sentence once.

        What was told before the first step counts to it. The first alarm is told whenever it was raised.
        """
        early, told = self.teaching.first_alarm, dict[str, tuple[int, Notice]]()
        lines = takewhile(lambda line: max(line[0].get("step", 0), 0) >= first, records_backwards(self._path))
        found = [early] if early is not None and early[0] < first else []
        for record in reversed([record for record, *_ in lines if "notices" in record]):
            found += [(max(record["step"], 0), notice) for notice in record["notices"]]
        for step, notice in found:
            known = Notice(**{**notice, "sensors": tuple(notice["sensors"])})
            told.setdefault(known.sentence, (step, known))
        return [*told.values()]

    def _figures(self, counts: Counts, steps: int) -> list[FigureGroup]:
        """Return what the summary tells of a watch."""
        step = {"step": self.scenario.mission.step_name, "file": REJECTED_NAME}
        came = [steps, counts.missing, counts.late, counts.duplicates, counts.rejected]
        told = [FigureGroup("watch", step, came)]
        for model in self.teaching.adopted:
            gaps = [model["before"]["rms_residual"], model["after"]["rms_residual"]]
            told.append(FigureGroup("patch", step | {"first": model["from_step"]}, gaps))
        return told
