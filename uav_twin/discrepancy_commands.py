"""`uav-twin discrepancy run`, `check` and `apply`: a verdict on a campaign, a patched model.

`check` says what a campaign can decide before anything is fitted. The commands that make campaigns
are in `discrepancy_import` and `discrepancy_campaigns`.
"""

import dataclasses
import shlex
from collections.abc import Mapping, Sequence
from functools import partial
from json import loads
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from discrepancy.errors import CampaignFileError, DiscrepancyError
from reporting import terminal
from reporting.formats.former_options import accepts_former_options
from reporting.progress import reporter, stage
from reporting.terminal import LARGEST_SEED, JsonOption, NoReportOption
from uav_twin.options import (
    CampaignArgument,
    EffectFilesOption,
    ModelOption,
    ReplaceOption,
    complete_model,
)

if TYPE_CHECKING:
    from discrepancy.campaign.records import Campaign
    from discrepancy.catalogue.entry import Effect
    from discrepancy.checks.fault import DataFault
    from discrepancy.document import Origin
    from discrepancy.judgement.separability import Separability
    from discrepancy.model_choice import ModelChoice
    from discrepancy.report.figures import ReportInput
    from discrepancy.self_calibration import SelfCalibration
    from discrepancy.verdict_so_far import SearchInProgress
    from discrepancy.workflow import Investigation


@accepts_former_options(from_step="--from-turn", to_step="--to-turn")
def run(
    campaign: Annotated[
        Path | None, typer.Argument(show_default=False, help="Folder with campaign.toml.")
    ] = None,
    *,
    from_run: Annotated[
        Path | None,
        typer.Option(
            "--from-run",
            help="Folder of a mission (uav-twin run): its flight, and by default its twin's model.",
        ),
    ] = None,
    from_step: Annotated[
        int | None,
        typer.Option("--from-step", min=0, help="First step of --from-run that is compared."),
    ] = None,
    to_step: Annotated[
        int | None,
        typer.Option("--to-step", min=0, help="Last step of --from-run that is compared."),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            show_default="the shipped wing",
            autocompletion=complete_model,
            help=(
                "A calibration.nc, a wing design, a structure, a lumped model or a description of "
                "an FMU (.toml), one of these with a patch (.json), or the name of a shipped "
                "lumped model."
            ),
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", show_default="verdicts/CAMPAIGN", help="Folder of the verdict."),
    ] = None,
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace the folder of an earlier verdict.")
    ] = False,
    seed: Annotated[
        int, typer.Option("--seed", min=0, max=LARGEST_SEED, help="Seed of all draws.")
    ] = 0,
    effects: EffectFilesOption = None,
    calibrate: Annotated[
        int | None,
        typer.Option(
            "--calibrate",
            metavar="N",
            min=1,
            max=10000,
            help="Try the workflow on N simulated campaigns of this geometry; takes minutes.",
        ),
    ] = None,
    no_report: NoReportOption = False,
    json: JsonOption = False,
) -> None:
    """Find out what the model lacks: verdict, report, patch, residuals.

    Example: `uav-twin discrepancy run measured --model single_mass_rig --out verdict`
    """
    from discrepancy.application import pack_beside_verdict
    from discrepancy.catalogue.library import load_catalogue
    from discrepancy.report.figures import ReportInput
    from discrepancy.verdict_folder import check_verdict_folder, write_verdict_folder
    from discrepancy.verdict_so_far import SearchInProgress
    from discrepancy.workflow import investigate

    use_one_thread()
    _refuse_unfit_sources(campaign, from_run, from_step, to_step)
    source = campaign or from_run
    assert source is not None
    folder = out if out is not None else Path("verdicts") / source.resolve().name
    check_verdict_folder(folder, replace_it=replace)
    catalogue = load_catalogue(effects or ())
    data, choice = _read_campaign_and_model(campaign, from_run, from_step, to_step, model)

    # Record where the verdict comes from
    options_of_command = {
        "from-step": from_step,
        "to-step": to_step,
        "model": model and choice.file,
        "seed": seed,
        "calibrate": calibrate,
    }
    command = _repeatable_command(source, effects or [], from_run is not None, options_of_command)
    origin = _origin_of_verdict(data, choice, effects or [], command, seed)

    # Search for the missing effect
    search_in_progress = SearchInProgress()
    with terminal.interruptible(lambda: _write_search_so_far(folder, search_in_progress, origin)):
        investigation = investigate(
            data, choice.model, catalogue, seed=seed, on_search=search_in_progress.remember_search
        )
    separability, self_calibration = _assess_campaign(
        investigation, choice, catalogue, calibrate, seed
    )

    # Write and print the verdict; only a wing, which has a design, can be packed as a patched FMU
    pack = None if choice.design is None else partial(pack_beside_verdict, choice)
    content = ReportInput(
        investigation, origin, separability, self_calibration, choice.design, pack=pack
    )
    with stage("Writing the verdict"):
        report_file = write_verdict_folder(
            folder, content, replace_it=replace, report=not no_report
        )
    _print_conclusion(content, folder, None if no_report else report_file, json=json)


def _origin_of_verdict(
    campaign: "Campaign", choice: "ModelChoice", effects: list[Path], command: str, seed: int
) -> "Origin":
    """Return the origin of a verdict: campaign, model and further effects, with their hashes.

    `command` repeats the investigation in any folder.
    """
    from discrepancy.document import Origin
    from reporting.files import hash_file
    from reporting.provenance import collect_provenance

    inputs = {"campaign": campaign.data_hash, "model": choice.source_hash}
    inputs |= {f"effects {path.name}": hash_file(path) for path in effects}
    return Origin(
        campaign=campaign.name,
        model=choice.model.name,
        data_hash=campaign.data_hash,
        model_hash=choice.source_hash,
        command=command,
        provenance=collect_provenance(seed, input_hashes=inputs),
        model_file=choice.file,
    )


def _refuse_unfit_sources(
    campaign: Path | None, from_run: Path | None, from_step: int | None, to_step: int | None
) -> None:
    """Raise an error unless one source of records is given, and steps only with a mission."""
    if (campaign is None) == (from_run is None):
        raise CampaignFileError(
            "Give either the folder of a campaign or --from-run with that of a mission."
        )
    if from_run is None and (from_step is not None or to_step is not None):
        raise CampaignFileError("--from-step and --to-step belong to --from-run.")
    if from_step is not None and to_step is not None and to_step < from_step:
        raise CampaignFileError(
            f"--to-step {to_step} lies before --from-step {from_step}: no step is left."
        )


def _assess_campaign(
    investigation: "Investigation",
    choice: "ModelChoice",
    catalogue: "Sequence[Effect]",
    calibrate: int | None,
    seed: int,
) -> tuple["Separability | None", "SelfCalibration | None"]:
    """Return what a campaign can decide, and how reliable the workflow is for it.

    The reliability is measured on `calibrate` simulated campaigns of the same geometry, and is None
    if that is None. Both are None if the records could not be compared with the model.
    """
    from discrepancy.judgement.separability import compute_separability
    from discrepancy.model_choice import ModelKind
    from discrepancy.self_calibration import self_calibrate

    if investigation.problem is None:
        return None, None
    tested_campaign = investigation.campaign
    with stage("What this campaign can decide"):
        separability = compute_separability(
            tested_campaign, choice.model, investigation.problem.setting, catalogue
        )
    if calibrate is None:
        return separability, None
    workers = 1 if choice.kind is ModelKind.FMU else 2  # an FMU already runs in its own process
    with stage("Testing the workflow on simulated campaigns", calibrate, "campaigns") as progress:
        self_calibration = self_calibrate(
            tested_campaign,
            choice.model,
            catalogue,
            calibrate,
            seed=seed,
            workers=workers,
            advance=progress.advance,
        )
    return separability, self_calibration


def _write_search_so_far(folder: Path, in_progress: "SearchInProgress", origin: "Origin") -> str:
    """Write the hypotheses that an interrupted search has fitted; return a message with the file.

    The message is empty if no hypothesis was fitted yet.
    """
    from discrepancy.verdict_so_far import write_so_far

    path = write_so_far(folder, in_progress.hypotheses(), origin)
    return "" if path is None else f"the hypotheses fitted until then are in {path}"


def _print_conclusion(
    content: "ReportInput", folder: Path, report: Path | None, *, json: bool
) -> None:
    """Print the verdict of an investigation, where it is stored, and the next command.

    If the data are faulty, the faults are printed to the error stream instead, and the command ends
    with exit code 1.
    """
    from discrepancy.application import has_applicable_effects
    from discrepancy.files.verdict import VERDICT_NAME
    from discrepancy.verdict import VerdictKind

    investigation = content.investigation
    verdict = investigation.verdict
    has_faulty_data = verdict.kind is VerdictKind.DATA_ERROR
    if json:
        locations = {"folder": str(folder), "report": None if report is None else str(report)}
        verdict_text = (folder / VERDICT_NAME).read_text(encoding="utf-8")
        terminal.print_json(locations | loads(verdict_text))
    if has_faulty_data:
        further_faults = [fault.sentence for fault in investigation.faults[1:]]
        for sentence in (verdict.sentence, *further_faults):
            typer.secho(sentence, fg="red", err=True)
    elif not json:
        _print_verdict(content, folder)
    if not json:
        terminal.say(f"Verdict: {folder}" if report is None else f"Report: {report}")
    if has_faulty_data:
        raise typer.Exit(1)
    if not json and has_applicable_effects(verdict, investigation.proof):
        terminal.say(f"Next: uav-twin discrepancy apply {shlex.quote(str(folder))}")


def _read_campaign_and_model(
    campaign: Path | None,
    from_run: Path | None,
    first_step: int | None,
    last_step: int | None,
    model: str | None,
) -> "tuple[Campaign, ModelChoice]":
    """Return the campaign, or that of a run's steps, and the model that it is compared with.

    By default, the model is that of the twin for a run, and the shipped wing for a campaign.
    """
    from discrepancy.campaign.reading import read_campaign
    from discrepancy.model_choice import choice_of_run, choose_model
    from discrepancy.sources.from_run import run_campaign
    from twin_master.watch.workflow import copy_of_run_until

    if from_run is None:
        assert campaign is not None
        return read_campaign(campaign), choose_model(model)
    with copy_of_run_until(from_run, first_step, last_step, reporter()) as folder:
        try:
            data = run_campaign(folder, first_step, last_step)
            if model is not None:
                return data, choose_model(model)
            return data, dataclasses.replace(choice_of_run(folder), file=str(from_run.resolve()))
        except DiscrepancyError as error:
            # A watch is read from a temporary copy: name the folder that the user knows
            raise type(error)(str(error).replace(str(folder), str(from_run))) from error


def use_one_thread() -> None:
    """Limit the linear algebra of this process to one thread, until the process ends.

    The matrices are small, so that several threads would only wait for each other, and rounding
    would depend on their number.
    """
    import scipy.linalg  # noqa: F401 - only libraries that are loaded already are limited
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)


def _repeatable_command(
    source: Path, effects: list[Path], from_run: bool, values: Mapping[str, str | int | None]
) -> str:
    """Return the command line that repeats the investigation from any working folder.

    `values` has further options without dashes; None stands for one that was not given.
    """
    words = ["uav-twin", "discrepancy", "run"]
    if from_run:
        words.append("--from-run")
    words.append(str(source.resolve()))
    for name, value in values.items():
        if value is not None:
            words += [f"--{name}", str(value)]
    for path in effects:
        words += ["--effects", str(path.resolve())]
    return shlex.join(words)


def _print_verdict(content: "ReportInput", folder: Path) -> None:
    """Print a verdict; intervals of parameters are read from its patch if there is one."""
    from discrepancy.files.verdict import PATCH_NAME, read_patch
    from discrepancy.report.printed import verdict_lines

    patch_file = folder / PATCH_NAME
    if patch_file.is_file():
        intervals = [effect.intervals for effect in read_patch(patch_file).effects]
        content = dataclasses.replace(content, intervals=intervals)
    terminal.say(f"Verdict: {content.investigation.verdict.kind.value}", bold=True)
    terminal.show(verdict_lines(content))


def check(
    campaign: CampaignArgument,
    *,
    model: ModelOption = None,
    effects: EffectFilesOption = None,
    json: JsonOption = False,
) -> None:
    """List the faults of the data, the effects that they can show, and those that they cannot tell apart.

    Example: `uav-twin discrepancy check measured --model single_mass_rig`
    """  # noqa: E501
    from discrepancy.campaign.reading import read_campaign
    from discrepancy.catalogue.entry import Setting
    from discrepancy.catalogue.library import load_catalogue
    from discrepancy.judgement.separability import compute_separability
    from discrepancy.model_choice import choose_model
    from discrepancy.report.printed import check_lines
    from discrepancy.workflow import check_and_prepare

    catalogue = load_catalogue(effects or ())
    chosen_model = choose_model(model).model
    prepared_campaign, faults = check_and_prepare(read_campaign(campaign), chosen_model)
    separability = None
    if not any(fault.fatal for fault in faults):
        with stage("What this campaign can decide"):
            setting = Setting(
                prepared_campaign, chosen_model, chosen_model.scales(prepared_campaign)
            )
            separability = compute_separability(prepared_campaign, chosen_model, setting, catalogue)
    if json:
        terminal.print_json(
            _check_record(prepared_campaign, chosen_model.name, faults, separability)
        )
    else:
        terminal.show(check_lines(prepared_campaign, chosen_model, catalogue, faults, separability))
    if separability is None:
        raise terminal.error_exit(
            "Correct the faults first: conclusions from these data would be wrong."
        )


def _check_record(
    data: "Campaign",
    model: str,
    faults: "Sequence[DataFault]",
    separability: "Separability | None",
) -> dict[str, Any]:
    """Return the faults of a campaign, and what it can decide, as plain data.

    `separability` is None if a fault is fatal. A magnitude that is detectable at no value is null.
    """
    detectability = () if separability is None else separability.detectability
    return {
        "campaign": data.name,
        "model": model,
        "trials": [{"name": trial.name, "held_out": trial.held_out} for trial in data.trials],
        "channels": list(data.channels),
        "passed": separability is not None,
        "faults": [dataclasses.asdict(fault) | {"fatal": fault.fatal} for fault in faults],
        "remarks": data.remarks,
        "effects": [
            {
                "effect": detectable.effect.identifier,
                "testable": not detectable.reason,
                "reason": detectable.reason,
                "place": detectable.place,
                "parameter": detectable.parameter,
                "detectable_from": detectable.detectable,
                "prior_median": detectable.typical,
                "unit": detectable.unit,
            }
            for detectable in detectability
        ],
        "confusion_groups": [] if separability is None else separability.groups,
    }


def apply(
    verdict: Annotated[
        Path,
        typer.Argument(show_default=False, help="Folder of a verdict, or its verdict.json."),
    ],
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            show_default="MODEL_patched",
            help="The file: .toml (a lumped model), .json (any model) or .fmu (a wing).",
        ),
    ] = None,
    member: Annotated[
        str | None,
        typer.Option(
            "--member",
            metavar="NAME",
            help="For the verdict group: the member to apply; the most probable by default.",
        ),
    ] = None,
    replace: ReplaceOption = False,
) -> None:
    """Write the model with the effect that was found and the parameters beside it.

    Example: `uav-twin discrepancy apply verdicts/measured --out patched.json`
    """
    from discrepancy.application import apply_verdict

    applied = apply_verdict(verdict, out, member=member, replace=replace)
    terminal.say(f"{applied.path}: {applied.sentence}")
    if applied.command:
        terminal.say(f"Next: {applied.command}")
