"""`uav-twin discrepancy run`: from a campaign to a verdict, with report, patch and patched FMU."""

import dataclasses
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from discrepancy.errors import CampaignFileError, DiscrepancyError
from fmu_asset.errors import PatchFileError
from reporting import terminal
from uav_twin.options import show, told

if TYPE_CHECKING:
    from discrepancy.campaign.records import Campaign
    from discrepancy.document import Origin
    from discrepancy.model_choice import ModelChoice
    from discrepancy.report.figures import Pack, ReportInput
    from discrepancy.self_calibration import SelfCalibration
    from discrepancy.workflow import Investigation
    from reporting.progress import Progress


@told("discrepancy run")
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
    from discrepancy.catalogue.library import load_catalogue
    from discrepancy.judgement.separability import separability
    from discrepancy.report.figures import ReportInput
    from discrepancy.verdict_folder import check_folder, write_verdict_folder
    from discrepancy.workflow import investigate

    one_thread()
    if (campaign is None) == (from_run is None):
        raise CampaignFileError("Give either the folder of a campaign or --from-run with that of a mission.")
    if from_run is None and (from_turn is not None or to_turn is not None):
        raise CampaignFileError("--from-turn and --to-turn belong to --from-run.")
    if from_turn is not None and to_turn is not None and to_turn < from_turn:
        raise CampaignFileError(f"--to-turn {to_turn} lies before --from-turn {from_turn}: no turn is left.")
    source = campaign if from_run is None else from_run
    assert source is not None
    folder = out if out is not None else Path("verdicts") / source.resolve().name
    check_folder(folder, replace_it=replace)
    catalogue = load_catalogue(effects or ())
    progress = terminal.progress()
    data, choice = _compared(campaign, from_run, (from_turn, to_turn), model, progress)
    found = investigate(data, choice.model, catalogue, seed=seed, progress=progress)
    able, tried = None, None
    if found.problem is not None:
        with progress.stage("What this campaign can decide"):
            able = separability(found.campaign, choice.model, found.problem.setting, catalogue)
        if calibrate is not None:
            tried = _calibrated(found, choice, catalogue, calibrate, seed, progress)
    command = _command(
        source,
        effects or [],
        from_run is not None,
        from_turn=from_turn,
        to_turn=to_turn,
        model=None if model is None else choice.file,
        seed=seed,
        calibrate=calibrate,
    )
    pack = None if choice.design is None else _packing(choice, progress)
    origin = _origin(data, choice, command, seed, effects or [])
    content = ReportInput(found, origin, able, tried, choice.design, pack=pack)
    with progress.stage("Writing the verdict"):
        place = write_verdict_folder(folder, content, replace_it=replace, report=not no_report)
    if json:
        terminal.print_json(_record(folder, report=None if no_report else place))
    _conclude(content, folder, f"{'Verdict' if no_report else 'Report'}: {place}", silent=json)


def _conclude(content: "ReportInput", folder: Path, place: str, *, silent: bool) -> None:
    """Print the conclusion; data at fault end the command with 1."""
    from discrepancy.application import gives
    from discrepancy.verdict import VerdictKind

    found = content.investigation
    fault = found.verdict.kind is VerdictKind.DATA_ERROR
    if fault:
        for sentence in (found.verdict.sentence, *(fault.sentence for fault in found.faults[1:])):
            typer.secho(sentence, fg="red", err=True)
    elif not silent:
        _show(content, folder)
    if not silent:
        terminal.say(place)
    if fault:
        raise typer.Exit(1)
    if not silent and gives(found.verdict):
        terminal.say(f"Next: uav-twin discrepancy apply {shlex.quote(str(folder))}")


def _compared(
    campaign: Path | None, from_run: Path | None, turns: tuple[int | None, int | None], model: str | None,
    progress: "Progress",
) -> "tuple[Campaign, ModelChoice]":  # fmt: skip
    """Return what is measured, and what it is compared with."""
    from discrepancy.campaign.reading import read_campaign
    from discrepancy.model_choice import choice_of_run, choose_model
    from discrepancy.sources.from_run import run_campaign
    from twin_master.watch.opening import flown

    if from_run is None:
        assert campaign is not None
        return read_campaign(campaign), choose_model(model, progress)
    first, last = turns
    with flown(from_run, first, last, progress) as folder:
        try:
            data = run_campaign(folder, first, last)
            if model is not None:
                return data, choose_model(model, progress)
            return data, dataclasses.replace(choice_of_run(folder), file=str(from_run.resolve()))
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


def _origin(
    data: "Campaign", choice: "ModelChoice", command: str, seed: int, effects: list[Path]
) -> "Origin":
    from discrepancy.document import Origin
    from reporting.provenance import collect_provenance, hash_file

    inputs = {"campaign": data.data_hash, "model": choice.source_hash}
    inputs |= {f"effects {path.name}": hash_file(path) for path in effects}
    return Origin(
        data.name,
        choice.model.name,
        data.data_hash,
        choice.source_hash,
        command,
        collect_provenance(seed, input_hashes=inputs),
        choice.file,
    )


def _record(folder: Path, report: Path | None) -> dict[str, Any]:
    """Return the content of `verdict.json` with the places of folder and report."""
    import json

    from discrepancy.files.verdict import VERDICT_NAME

    record: dict[str, Any] = json.loads((folder / VERDICT_NAME).read_text(encoding="utf-8"))
    return {"folder": str(folder), "report": None if report is None else str(report)} | record


def _calibrated(
    found: "Investigation",
    choice: "ModelChoice",
    catalogue: tuple[object, ...],
    count: int,
    seed: int,
    progress: "Progress",
) -> "SelfCalibration":
    from discrepancy.model_choice import ModelKind
    from discrepancy.self_calibration import self_calibrate

    workers = 1 if choice.kind is ModelKind.FMU else 2  # an FMU is a process of its own
    with progress.stage("Trying the workflow on simulated campaigns", total=count, unit="campaigns") as stage:
        return self_calibrate(
            found.campaign, choice.model, catalogue, count, seed=seed, workers=workers, advance=stage.advance,  # type: ignore[arg-type]
        )  # fmt: skip


def _command(source: Path, effects: list[Path], from_run: bool, **options: int | str | None) -> str:
    """Return the command that does the same in any folder: with absolute paths."""
    words = ["uav-twin", "discrepancy", "run", *["--from-run"] * from_run, str(source.resolve())]
    for name, value in options.items():
        words += [] if value is None else [f"--{name.replace('_', '-')}", str(value)]
    for path in effects:
        words += ["--effects", str(path.resolve())]
    return shlex.join(words)


def _packing(choice: "ModelChoice", progress: "Progress") -> "Pack":
    """Return what makes the FMU of a wing that carries a patch, its effects off."""

    def pack(patch_file: Path, target: Path) -> str:
        from discrepancy.application import pack_patched
        from discrepancy.files.verdict import read_patch

        patch = read_patch(patch_file).upon(choice.built_in)
        try:
            switches = pack_patched(choice, patch, target, progress=progress)
        except PatchFileError as cause:
            return f"There is no patched FMU: {cause}"
        return f"{target.name} carries it, off until {', '.join(switches)} is set to 1."

    return pack


def _show(content: "ReportInput", folder: Path) -> None:
    from discrepancy.files.verdict import PATCH_NAME, read_patch
    from discrepancy.report.page import said_on_page
    from discrepancy.report.text import WORDS

    if (patch_file := folder / PATCH_NAME).is_file():
        intervals = [effect.intervals for effect in read_patch(patch_file).effects]
        content = dataclasses.replace(content, intervals=intervals)
    terminal.say(f"Verdict: {content.investigation.verdict.kind.value}", bold=True)
    show("run", words=WORDS, **said_on_page(content))
