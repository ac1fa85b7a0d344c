"""A watch: its folder, begun or taken up again, its loop, and what it leaves."""

import base64
import json
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any

from reporting.files import atomic_write_bytes, atomic_write_text
from reporting.progress import Progress
from reporting.provenance import collect_provenance, hash_file, hash_record
from twin_master.assets.asset_source import AssetSource
from twin_master.assets.design_source import DesignBelief
from twin_master.assets.resolution import (
    Overrides,
    believed_source,
    located_scenario,
    portable_scenario,
    resolve_scenario,
)
from twin_master.errors import ImpossibleObservation, MissionInputError, NotResumableError
from twin_master.mission.journal import (
    JOURNAL_NAME,
    JournalFile,
    belief_record,
    open_journal,
    plain,
    read_records,
)
from twin_master.mission.kept_knowledge import keep_knowledge
from twin_master.mission.loop import Reading, operate
from twin_master.mission.preparation import prepare_knowledge
from twin_master.network.twin import Twin, TwinTurn
from twin_master.run_folder import (
    CONFIG_NAME,
    KIND,
    check_versions,
    create_run_folder,
    lock_run_folder,
    read_config,
    tidy,
    with_inputs,
)
from twin_master.scenario.reading import LoadedScenario, parse_scenario
from twin_master.scenario.schema import Scenario
from twin_master.store.learnt import learnt_record
from twin_master.store.mission_result import MissionResult
from twin_master.store.summary import Figure, control_changes, noticed, summarise
from twin_master.store.writing import store_mission, values_of, write_summary
from twin_master.watch.decision import decision_of, gap_of
from twin_master.watch.intake import REJECTED_NAME, Counts, Feed, Intake, RejectedFile
from twin_master.watch.replay import SNAPSHOT_TURNS, BelievedModel, Replayed, replay

STORED_TURNS = 1_000
"""The last turns that `run.nc` and the report show if not told otherwise; the journal has all of them."""
FLUSH_SECONDS = 1.0
"""Of a recorded file, which is read again after a power failure; live turns are flushed one by one."""


@dataclass(frozen=True)
class Patched:
    """A patch of the twin's model, and the turn from which on it is believed."""

    file: Path
    from_turn: int


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
    """

    def __init__(self, folder: Path, config: dict[str, Any], scenario: Scenario, progress: Progress) -> None:
        self.folder, self.scenario, self._progress = folder, scenario, progress
        tidy(folder)
        source = believed_source(scenario)
        self._source = source
        hashes = dict(source.prepare(folder, progress))
        self._config = with_inputs(folder, config, hashes)
        with progress.stage("Calibrating and planning"):
            knowledge = prepare_knowledge(scenario, source, scenario.mission.seed)
        self.models = [BelievedModel(0, knowledge)]
        self._path = folder / JOURNAL_NAME
        self._hash = hash_record(self._config)
        self._adopted: dict[str, Any] | None = None
        for record, _ in read_records(self._path, self._hash):
            if "model" in record:
                self._adopted = record["model"]
                self.models.append(
                    self._with_patch(folder / self._adopted["patch"], self._adopted["from_turn"])
                )
        keep_knowledge(folder, self.models[-1].knowledge)

    def _with_patch(self, file: Path, from_turn: int) -> BelievedModel:
        belief = self.scenario.belief
        if not isinstance(belief, DesignBelief):
            raise MissionInputError("only a twin that believes a design can be given a patch of its model.")
        scenario = self.scenario.model_copy(update={"belief": belief.model_copy(update={"patch": str(file)})})
        source: AssetSource = scenario.belief.source(scenario, None)
        source.check()
        with TemporaryDirectory(prefix="uav_twin_") as folder:
            source.prepare(Path(folder), self._progress)
            return BelievedModel(from_turn, prepare_knowledge(scenario, source, scenario.mission.seed))

    def run(
        self, feed: Feed, decide: Callable[[Mapping[str, Any]], None], *, turns: int | None = None,
        patched: Patched | None = None,
    ) -> Counts:  # fmt: skip
        """Watch until the feed ends, or SIGINT or SIGTERM ask for it between two turns.

        Parameters
        ----------
        feed : Feed
            Of the observations.
        decide : callable
            Told each decision, once its turn is written down.
        turns : int, optional
            Turns in all after which to end.
        patched : Patched, optional
            To believe from a turn on.
        """
        rejected = RejectedFile(self.folder / REJECTED_NAME)
        intake = Intake(self.scenario, feed, rejected)
        with open_journal(self.folder, self._hash, FLUSH_SECONDS if feed.replayable else 0.0) as journal:
            if patched is not None:
                self._adopt(journal, patched)
            found = self._replayed(None)
            twin = found.twin
            intake.restore(None if found.last is None else found.last["intake"])
            if found.last is not None:
                self._progress.note(f"The watch goes on at {self.scenario.mission.step_name} {twin.turns}.")
            keep = _Keeper(journal, intake, twin)
            source = _Stopping(intake, turns)
            with source.listening():
                for reading, turn, _ in operate(twin, source, keep):
                    decide(decision_of(self.scenario, self.models[-1].knowledge.model, twin, reading, turn))
        return intake.counts

    def _replayed(self, first_turn: int | None, *, lag: bool = True) -> Replayed:
        kept = self.scenario.watch.lag if lag else None
        return replay(self._path, self._hash, self.models, kept, first_turn=first_turn)

    def _adopt(self, journal: JournalFile, patched: Patched) -> None:
        """Believe a patched model from a turn on: it and those behind it are filtered again."""
        before = self._replayed(patched.from_turn)
        if not 0 <= patched.from_turn <= before.twin.turns or before.last is None:
            raise MissionInputError(
                f"--from-turn names one of the {before.twin.turns} turns watched so far, or the next one."
            )
        name = f"asset/model_patch_{len(self.models)}.json"
        candidate = self._with_patch(patched.file, patched.from_turn)
        atomic_write_bytes(self.folder / name, patched.file.read_bytes())
        first, believed = patched.from_turn, self.models[-1].knowledge.sensor_model
        self.models.append(candidate)
        after = self._replayed(patched.from_turn)
        model: dict[str, Any] = {
            "patch": name, "sha256": hash_file(self.folder / name), "from_turn": first,
            "before": gap_of(before.beliefs, first - before.first_turn, believed),
            "after": gap_of(after.beliefs, first - after.first_turn, candidate.knowledge.sensor_model),
        }  # fmt: skip
        journal.append(
            {
                "turn": after.twin.turns - 1,
                "next_control": after.twin.proposed_control,
                "intake": before.last["intake"],
                "model": model,
                "twin_state": base64.b64encode(after.twin.save_state()).decode("ascii"),
            }
        )
        self._adopted = model
        keep_knowledge(self.folder, candidate.knowledge)
        self._progress.note(
            f"The patched model is believed from {self.scenario.mission.step_name} {patched.from_turn} on: "
            + ", ".join(
                f"{what} {model['before'][key]:.4g} before, {model['after'][key]:.4g} after"
                for key, what in (("rms_residual", "rms residual"), ("log_evidence", "log evidence"))
                if model["before"][key] is not None
            )
            + "."
        )

    def store(self, counts: Counts, *, last: int = STORED_TURNS, report: bool = True) -> None:
        """Write `run.nc`, tables, summary and report of the last turns."""
        turns = self._replayed(None).twin.turns
        if not turns:
            self._progress.note("Nothing was observed: there is nothing to report.")
            return
        first = max(0, turns - last)
        found = self._replayed(first, lag=False)
        flight = found.beliefs.flight(found.twin, None, first_turn=found.first_turn)
        knowledge, mission = self.models[-1].knowledge, self.scenario.mission
        result = MissionResult(
            scenario=self.scenario, model=knowledge.model, sensor_model=knowledge.sensor_model,
            draws=knowledge.draws.values, rewards=knowledge.rewards, plan=knowledge.plan, truth=None,
            flight=flight.behind(first - found.first_turn),
        )  # fmt: skip
        provenance, origin = self._config["provenance"], self._source.origin
        attributes = {
            "title": mission.title or mission.name,
            "scenario": mission.name,
            "seed": mission.seed,
            "config_hash": self._hash,
            "versions": json.dumps(provenance["versions"], sort_keys=True),
            "source_hashes": json.dumps(provenance["source_hashes"], sort_keys=True),
            "input_hashes": json.dumps(self._config["inputs"], sort_keys=True),
            "observed_quantity": self.scenario.observation.role,
            "parameter": knowledge.draws.name,
            "parameter_source": knowledge.draws.source,
            "asset": WATCHED,
            "twin_model": origin.model,
        }
        if self._adopted is not None:
            attributes |= {
                "model_patch": self._adopted["patch"],
                "model_patch_from_step": self._adopted["from_turn"],
            }
        if knowledge.draws.record is not None:
            text = json.dumps(knowledge.draws.record, sort_keys=True, allow_nan=False)
            atomic_write_text(self.folder / "calibration.json", text + "\n")
        with self._progress.stage("Storing"):
            tree = store_mission(self.folder, result, attributes)
            figures = self._figures(counts, turns)
            figures += summarise(result, knowledge.draws, values_of(tree, "filtered", "reward_mean"))
            heading = {
                "scenario": mission.name, "title": mission.title, "seed": mission.seed, "steps": turns,
                "control": control_changes(
                    self.scenario.control_names, result.flight.control_index, mission.step_name
                ),
                "asset": WATCHED, "twin_model": origin.model, "asset_and_model_differ": False,
                **learnt_record(result.learnt), **noticed(result),
            }  # fmt: skip
            write_summary(self.folder, figures, heading)
        if report:
            from twin_master.report.page import write_report

            with self._progress.stage("Writing the report"):
                write_report(self.folder)

    def _figures(self, counts: Counts, turns: int) -> tuple[Figure, ...]:
        steps = f"{self.scenario.mission.step_name}s"
        figures = [
            Figure("turns", f"{steps} watched", turns),
            Figure("missing", f"{steps} predicted through, nothing was received", counts.missing),
            Figure("late", "messages put in their place late", counts.late),
            Figure("duplicates", "messages that said nothing new", counts.duplicates),
            Figure("rejected", f"messages refused ({REJECTED_NAME})", counts.rejected),
        ]
        for record, _ in read_records(self._path, self._hash):
            if "model" in record:
                model = record["model"]
                for when in ("before", "after"):
                    figures.append(
                        Figure(
                            f"gap_{when}_patch_{model['from_turn']}",
                            f"rms residual {when} the patch of {self.scenario.mission.step_name} "
                            f"{model['from_turn']}",
                            model[when]["rms_residual"],
                        )
                    )
        return tuple(figures)


WATCHED = "watched asset"


def begin_watch(
    loaded: LoadedScenario, folder: Path, overrides: Overrides, progress: Progress, *, replace_run: bool
) -> tuple[Watch, int]:
    """Make the folder of a watch; return it and the file descriptor that holds the folder.

    Raises
    ------
    RunFolderExistsError
        The folder exists.
    TwinMasterError, FiniteElementError, CalibrationError
        With one clear sentence.
    """
    resolved = resolve_scenario(loaded, overrides)
    source = believed_source(resolved)
    source.check()
    config = {
        "kind": KIND,
        "format": 1,
        "watched": True,
        "scenario": portable_scenario(resolved).to_dict(),
        "scenario_file": {"name": loaded.path.name, "sha256": loaded.content_hash},
        "provenance": collect_provenance(resolved.mission.seed).as_dict(),
    }
    lock = create_run_folder(folder, config, dict(source.files()), replace=replace_run)
    try:
        return Watch(folder, config, located_scenario(portable_scenario(resolved), folder), progress), lock
    except BaseException:
        os.close(lock)
        raise


def resume_watch(folder: Path, loaded: LoadedScenario | None, progress: Progress) -> tuple[Watch, int]:
    """Take up the watch in a folder; return it and the file descriptor that holds the folder.

    Raises
    ------
    NotResumableError
        The folder holds no watch, or one of another scenario or version.
    """
    config = read_config(folder)
    if not config.get("watched"):
        raise NotResumableError(
            f"{folder} holds a run, no watch: continue it with `uav-twin run --resume {folder}`."
        )
    file = config["scenario_file"]
    if loaded is not None and file.get("sha256") != loaded.content_hash:
        raise NotResumableError(f"{folder} watches another scenario ({file.get('name')}) than {loaded.path}.")
    scenario = parse_scenario(config["scenario"], str(folder / CONFIG_NAME))
    lock = lock_run_folder(folder)
    try:
        check_versions(folder, config, scenario.mission.seed)
        return Watch(folder, config, located_scenario(scenario, folder), progress), lock
    except NotResumableError as error:
        os.close(lock)
        error.add_note(
            "--replace would remove what was observed; another watch, in another folder, takes it in with "
            f"`--observations {folder}`."
        )
        raise
    except BaseException:
        os.close(lock)
        raise


class _Keeper:
    """Writes a turn down."""

    def __init__(self, journal: JournalFile, intake: Intake, twin: Twin) -> None:
        self._journal, self._intake, self._twin = journal, intake, twin

    def __call__(self, reading: Reading, turn: TwinTurn) -> None:
        at = self._intake.observation_turn
        record = {
            "turn": turn.turn,
            "observation_turn": at,
            "observed": plain(reading.observed),
            "control_index": self._twin.control_of(at),
            "next_control": turn.next_control,
            "intake": self._intake.state(),
        }
        if turn.turn % SNAPSHOT_TURNS == SNAPSHOT_TURNS - 1 and reading.revises is None:
            record["twin_state"] = base64.b64encode(self._twin.save_state()).decode("ascii")
        self._journal.append(record | belief_record(turn))


class _Stopping:
    """A source that ends when SIGINT or SIGTERM ask for it: between two turns, never within one."""

    def __init__(self, intake: Intake, turns: int | None) -> None:
        self._intake, self._turns = intake, turns
        self._asked = self._waiting = False

    def read(self, twin: Twin) -> Reading | None:
        """Return the next reading; None once the watch is to end."""
        if self._asked or (self._turns is not None and twin.turns >= self._turns):
            return None
        self._waiting = True
        try:
            return self._intake.read(twin)
        except _Asked:
            return None
        finally:
            self._waiting = False

    def impossible(self, reading: Reading, error: ImpossibleObservation) -> Reading:
        """Return what is assimilated in the place of an observation that no state allows."""
        return self._intake.impossible(reading, error)

    def _ask(self, _signal: int, _frame: FrameType | None) -> None:
        self._asked = True
        if self._waiting:
            raise _Asked

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Listen to the signals."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, self._ask) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


class _Asked(BaseException):
    """Somebody asked the watch to end while it waited."""
