"""`uav-twin discrepancy run`: from a campaign to a verdict, with report, patch and patched FMU."""

import dataclasses
import shlex
from functools import partial
from json import loads
from pathlib import Path
from typing import Any

import typer

from discrepancy.errors import CampaignFileError, DiscrepancyError
from reporting import terminal
from reporting.progress import reporter, stage
from uav_twin import parts
from uav_twin.options import show


def run(
    campaign: Path | None = None,
    *,
    from_run: Path | None = None,
    from_turn: int | None = None,
    to_turn: int | None = None,
    model: str | None = None,
    out: Path | None = None,
    replace: bool = False,
    seed: int = 0,
    effects: list[Path] | None = None,
    calibrate: int | None = None,
    no_report: bool = False,
    json: bool = False,
) -> None:
    """Find out what the model lacks: verdict, report, patch, residuals."""
    one_thread()
    if (campaign is None) == (from_run is None):
        raise CampaignFileError("Give either the folder of a campaign or --from-run with that of a mission.")
    if from_run is None and (from_turn is not None or to_turn is not None):
        raise CampaignFileError("--from-turn and --to-turn belong to --from-run.")
    if from_turn is not None and to_turn is not None and to_turn < from_turn:
        raise CampaignFileError(f"--to-turn {to_turn} lies before --from-turn {from_turn}: no turn is left.")
    source = campaign or from_run
    assert source is not None
    folder = out if out is not None else Path("verdicts") / source.resolve().name
    parts.check_verdict_folder(folder, replace_it=replace)
    catalogue = parts.load_catalogue(effects or ())
    data, choice = _compared(campaign, from_run, from_turn, to_turn, model)
    found = parts.investigate(data, choice.model, catalogue, seed=seed)
    able, tried = None, None
    if found.problem is not None:
        with stage("What this campaign can decide"):
            able = parts.separability(found.campaign, choice.model, found.problem.setting, catalogue)
        if calibrate is not None:
            workers = 1 if choice.kind is parts.ModelKind.FMU else 2  # an FMU is a process of its own
            with stage("Trying the workflow on simulated campaigns", calibrate, "campaigns") as shown:
                tried = parts.self_calibrate(
                    found.campaign, choice.model, catalogue, calibrate,
                    seed=seed, workers=workers, advance=shown.advance,
                )  # fmt: skip
    inputs = {"campaign": data.data_hash, "model": choice.source_hash}
    inputs |= {f"effects {path.name}": parts.hash_file(path) for path in effects or ()}
    options = {"from-turn": from_turn, "to-turn": to_turn, "model": model and choice.file, "seed": seed}
    origin = parts.Origin(
        data.name,
        choice.model.name,
        data.data_hash,
        choice.source_hash,
        _command(source, effects or [], from_run is not None, **options, calibrate=calibrate),
        parts.collect_provenance(seed, input_hashes=inputs),
        choice.file,
    )
    pack = None if choice.design is None else partial(parts.packed_beside, choice)
    content = parts.ReportInput(found, origin, able, tried, choice.design, pack=pack)
    with stage("Writing the verdict"):
        place = parts.write_verdict_folder(folder, content, replace_it=replace, report=not no_report)
    _conclude(content, folder, None if no_report else place, json=json)


def _conclude(content: "parts.ReportInput", folder: Path, report: Path | None, *, json: bool) -> None:
    """Print the conclusion; data at fault end the command with 1."""
    found = content.investigation
    fault = found.verdict.kind is parts.VerdictKind.DATA_ERROR
    if json:
        record = {"folder": str(folder), "report": None if report is None else str(report)}
        stored = (folder / parts.VERDICT_NAME).read_text(encoding="utf-8")
        terminal.print_json(record | loads(stored))
    if fault:
        for sentence in (found.verdict.sentence, *(fault.sentence for fault in found.faults[1:])):
            typer.secho(sentence, fg="red", err=True)
    elif not json:
        _show(content, folder)
    if not json:
        terminal.say(f"Verdict: {folder}" if report is None else f"Report: {report}")
    if fault:
        raise typer.Exit(1)
    if not json and parts.gives(found.verdict):
        terminal.say(f"Next: uav-twin discrepancy apply {shlex.quote(str(folder))}")


def _compared(
    campaign: Path | None, from_run: Path | None, first: int | None, last: int | None, model: str | None
) -> "tuple[parts.Campaign, parts.ModelChoice]":
    """Return what is measured, and what it is compared with."""
    if from_run is None:
        assert campaign is not None
        return parts.read_campaign(campaign), parts.choose_model(model)
    with parts.flown(from_run, first, last, reporter()) as folder:
        try:
            data = parts.run_campaign(folder, first, last)
            if model is not None:
                return data, parts.choose_model(model)
            return data, dataclasses.replace(parts.choice_of_run(folder), file=str(from_run.resolve()))
        except DiscrepancyError as error:  # a watch was read from a copy, which is nothing to its user
            raise type(error)(str(error).replace(str(folder), str(from_run))) from error


def one_thread() -> None:
    """Hold the linear algebra of this process to one thread, for good.

    Its matrices are small: more threads wait for each other, the longer the busier the machine is, and the
    last bits of a sum would follow their number.
    """
    import scipy.linalg  # noqa: F401 - a library that is not loaded yet cannot be held
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)


def _command(source: Path, effects: list[Path], from_run: bool, **options: Any) -> str:
    """Return the command that does the same in any folder: with absolute paths."""
    words = ["uav-twin", "discrepancy", "run", *["--from-run"] * from_run, str(source.resolve())]
    for name, value in options.items():
        words += [] if value is None else [f"--{name}", str(value)]
    for path in effects:
        words += ["--effects", str(path.resolve())]
    return shlex.join(words)


def _show(content: "parts.ReportInput", folder: Path) -> None:
    from discrepancy.report.text import WORDS

    if (patch_file := folder / parts.PATCH_NAME).is_file():
        intervals = [effect.intervals for effect in parts.read_patch(patch_file).effects]
        content = dataclasses.replace(content, intervals=intervals)
    terminal.say(f"Verdict: {content.investigation.verdict.kind.value}", bold=True)
    show("run", words=WORDS, **parts.said_on_page(content))
