"""The files of a watch in addition to its journal: `run.nc`, tables, summary and report."""

from dataclasses import replace
from itertools import takewhile

from reporting.json_file import JsonObject, JsonRecord
from twin_master.assets.asset_source import AssetAndModel
from twin_master.feeds.intake import Counts
from twin_master.feeds.rejected import REJECTED_NAME
from twin_master.mission.journal import last_step, records_backwards
from twin_master.mission.replay import replay
from twin_master.network.estimator import Notice
from twin_master.store.mission_result import MissionResult
from twin_master.store.summary import SummaryGroup
from twin_master.store.writing import store_flight
from twin_master.watch.folder import WATCHED_ASSET, Watch

STORED_STEPS = 1_000
"""Default number of last steps in `run.nc` and in the report; the journal has all steps."""


def store_watch(
    watch: Watch, counts: Counts, *, last: int = STORED_STEPS, report: bool = True
) -> None:
    """Write `run.nc`, tables, summary and report of the last steps of a watch.

    Parameters
    ----------
    counts : Counts
        How many messages were received, late or refused.
    last : int
        The number of last steps that are stored.
    report : bool
        Whether to write the report.
    """
    step, _ = last_step(watch.journal_path)
    step_count = step + 1
    if not step_count:
        watch.progress.note("Nothing was observed: there is nothing to report.")
        return
    result = _last_steps(watch, step_count, last)
    attributes: JsonObject = {}
    if watch.teaching.adopted_models:
        model = watch.teaching.adopted_models[-1]
        attributes["model_patch"] = model["patch"]
        attributes["model_patch_from_step"] = model["from_step"]
    with watch.progress.stage("Storing"):
        store_flight(
            watch.folder,
            watch.config,
            result,
            AssetAndModel(WATCHED_ASSET, watch.source.origin.model),
            steps=step_count,
            figures=_summary_figures(watch, counts, step_count),
            attributes=attributes,
        )
    if report:
        from twin_master.report.page import write_report

        with watch.progress.stage("Writing the report"):
            write_report(watch.folder)


def _last_steps(watch: Watch, step_count: int, last: int) -> MissionResult:
    """Return the last steps of a watch, smoothed, as the result of a mission."""
    first = max(0, step_count - last)
    # The replay begins at a snapshot at or before the first step: earlier steps are removed
    history, _ = replay(watch.journal_path, watch.models, None, first_step=first)
    history = history.without_first(first - history.first_step)
    history = replace(history, notices=notices_since(watch, first))
    knowledge = watch.models[-1].knowledge
    return MissionResult(watch.scenario, knowledge, history, models=watch.models)


def notices_since(watch: Watch, first_step: int) -> list[tuple[int, Notice]]:
    """Return the notices of a watch from a step on, each sentence once, with its step.

    A notice before the first observation has the step 0.

    Parameters
    ----------
    first_step : int
        The first alarm of the watch is returned even if it lies before this step.
    """
    records: list[tuple[int, JsonObject]] = []
    first_alarm = watch.teaching.first_alarm
    if first_alarm is not None and first_alarm[0] < first_step:
        records.append(first_alarm)
    backwards = (line for line, _, _ in records_backwards(watch.journal_path))
    lines_since = list(takewhile(lambda line: _step_of(line) >= first_step, backwards))
    for line in reversed(lines_since):
        for notice in line.get("notices", []):
            records.append((_step_of(line), notice))
    notices: dict[str, tuple[int, Notice]] = {}
    for step, record in records:
        notice = Notice(**{**record, "sensors": tuple(record["sensors"])})
        notices.setdefault(notice.sentence, (step, notice))
    return list(notices.values())


def _step_of(line: JsonRecord) -> int:
    """Return the step of a line; 0 for the header and for a line before the first step."""
    return max(int(line.get("step", 0)), 0)


def _summary_figures(watch: Watch, counts: Counts, step_count: int) -> list[SummaryGroup]:
    """Return figures for the summary: the counts of messages, and the residuals of each patch.

    Those of a patch are the root mean square residuals without and with it.
    """
    template_fields = {"step": watch.scenario.mission.step_name, "file": REJECTED_NAME}
    message_counts = [
        step_count,
        counts.missing,
        counts.late,
        counts.duplicates,
        counts.rejected,
    ]
    figures = [SummaryGroup("watch", template_fields, message_counts)]
    for model in watch.teaching.adopted_models:
        residuals = [model["before"]["rms_residual"], model["after"]["rms_residual"]]
        patch_fields = template_fields | {"first": model["from_step"]}
        figures.append(SummaryGroup("patch", patch_fields, residuals))
    return figures
