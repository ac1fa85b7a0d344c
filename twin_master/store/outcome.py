"""What came of a run: its folder, report, summary and timing."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reporting.errors import DamagedFileError
from reporting.json_file import read_json
from twin_master.assets.asset_source import FlownAndBelieved
from twin_master.errors import NotResumableError
from twin_master.run_folder import read_config
from twin_master.store.summary import Figure
from twin_master.store.writing import SUMMARY_NAME, TIMING_NAME, read_run

REPORT_NAME = "report.html"
"""In the run folder: the report."""


@dataclass(frozen=True)
class RunOutcome:
    """A finished run.

    Attributes
    ----------
    folder : Path
        The run folder.
    report : Path or None
        The report in it; None where none was asked for.
    figures : tuple of Figure
        The summary.
    timing : dict
        Content of `timing.json`.
    origin : FlownAndBelieved
        What was flown and what the twin believed, in words.
    step_name : str
        What a step is called.
    control : str
        When which control was left for which, in words.
    notices : tuple of str
        What the operator should know, a sentence each.
    """

    folder: Path
    report: Path | None
    figures: tuple[Figure, ...]
    timing: Mapping[str, Any]
    origin: FlownAndBelieved
    step_name: str
    control: str
    notices: tuple[str, ...] = ()


def read_outcome(folder: Path) -> RunOutcome:
    """Return what came of the run in a folder.

    Raises
    ------
    KeyError, TypeError, DamagedFileError, NotResumableError
        A result is missing or damaged.
    """
    report = folder / REPORT_NAME
    timing, summary = (read_json(folder / name, DamagedFileError) for name in (TIMING_NAME, SUMMARY_NAME))
    return RunOutcome(
        folder,
        report if report.is_file() else None,
        tuple(Figure(**figure) for figure in summary["figures"]),
        timing,
        FlownAndBelieved(
            str(summary["asset"]), str(summary["twin_model"]), bool(summary["asset_and_model_differ"])
        ),
        str(read_config(folder)["scenario"]["mission"]["step_name"]),
        str(summary["control"]),
        tuple(str(notice["sentence"]) for notice in summary.get("notices", ())),
    )


def finished_run(folder: Path) -> RunOutcome | None:
    """Return the outcome of a run that is finished; None where its results are missing or damaged."""
    try:
        read_run(folder)
        return read_outcome(folder)
    except (KeyError, TypeError, DamagedFileError, NotResumableError):
        return None
