"""`uav-twin discrepancy run`: from a campaign to a verdict, with report, patch and patched FMU."""

from __future__ import annotations

import shlex
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from discrepancy.model_choice import ModelChoice
    from discrepancy.self_calibration import SelfCalibration
    from discrepancy.verdict_folder import Pack
    from discrepancy.workflow import Investigation
    from reporting.progress import Progress

SHOWN_EXPERIMENTS = 3


def run(
    campaign: Annotated[
        Path | None, typer.Argument(help="Folder with campaign.toml.", show_default=False)
    ] = None,
    from_run: Annotated[
        Path | None,
        typer.Option(
            help="Folder of a mission (uav-twin run): its flight and its twin's model are compared."
        ),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            help="A calibration.nc, a wing design, a lumped model or a description of an FMU (.toml), or "
            "the name of a shipped "
            "lumped model.",
            show_default="the shipped wing",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the verdict.", show_default="verdicts/CAMPAIGN")
    ] = None,
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace the folder of an earlier verdict.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all draws.")] = 0,
    effects: Annotated[
        list[Path] | None, typer.Option(help="A TOML file of further effects; may be given several times.")
    ] = None,
    calibrate: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Try the workflow on N simulated campaigns of this geometry; takes minutes.",
        ),
    ] = None,
) -> None:
    """Find out what the model lacks: verdict, report, patch, residuals."""
    from rich.console import Console

    from discrepancy.campaign_file import read_campaign
    from discrepancy.catalogue.library import load_catalogue
    from discrepancy.document_file import Origin
    from discrepancy.errors import CampaignFileError
    from discrepancy.from_run import run_campaign
    from discrepancy.model_choice import choice_of_run, choose_model
    from discrepancy.separability import separability
    from discrepancy.verdict import VerdictKind
    from discrepancy.verdict_folder import VerdictContent, check_folder, write_verdict_folder
    from discrepancy.workflow import investigate
    from reporting.progress import RichProgress
    from reporting.provenance import collect_provenance

    if (campaign is None) == (from_run is None):
        raise CampaignFileError("Give either the folder of a campaign or --from-run with that of a mission.")
    if from_run is not None and model is not None:
        raise CampaignFileError("--from-run takes the model that the twin believed; leave --model out.")
    source = campaign if from_run is None else from_run
    assert source is not None
    folder = out if out is not None else Path("verdicts") / source.resolve().name
    check_folder(folder, replace_it=replace)
    data = read_campaign(source) if from_run is None else run_campaign(source)
    catalogue = load_catalogue(effects or ())
    progress = RichProgress()
    choice = choose_model(model, progress) if from_run is None else choice_of_run(from_run)
    found = investigate(data, choice.model, catalogue, seed=seed, progress=progress)
    able, tried = None, None
    if found.problem is not None:
        with progress.stage("What this campaign can decide"):
            able = separability(found.campaign, choice.model, found.problem.setting, catalogue)
        if calibrate is not None:
            tried = _calibrated(found, choice, catalogue, calibrate, seed, progress)
    origin = Origin(
        data.name,
        choice.model.name,
        data.data_hash,
        choice.source_hash,
        _command(source, model, seed, effects or [], calibrate, from_run=from_run is not None),
        collect_provenance(seed, input_hashes=_inputs(data.data_hash, choice, effects or [])),
    )
    pack = None if choice.design is None else _packing(choice, progress)
    content = VerdictContent(found, origin, able, tried, choice.design, pack)
    with progress.stage("Writing the report"):
        report = write_verdict_folder(folder, content, replace_it=replace)
    if found.verdict.kind is VerdictKind.DATA_ERROR:
        typer.secho(found.verdict.sentence, fg="red", err=True)
        for fault in found.faults[1:]:
            typer.secho(fault.sentence, fg="red", err=True)
        typer.echo(f"Report: {report}")
        raise typer.Exit(1)
    _show(found, tried, report, Console(highlight=False, markup=False))


def _calibrated(
    found: Investigation,
    choice: ModelChoice,
    catalogue: tuple[object, ...],
    count: int,
    seed: int,
    progress: Progress,
) -> SelfCalibration:
    from discrepancy.model_choice import ModelKind
    from discrepancy.self_calibration import self_calibrate

    workers = 1 if choice.kind is ModelKind.FMU else 2  # an FMU is a process of its own
    with progress.stage("Trying the workflow on simulated campaigns", total=count, unit="campaigns") as stage:
        return self_calibrate(
            found.campaign, choice.model, catalogue, count, seed=seed, workers=workers, advance=stage.advance,  # type: ignore[arg-type]
        )  # fmt: skip


def _command(
    source: Path, model: str | None, seed: int, effects: list[Path], calibrate: int | None, *, from_run: bool
) -> str:
    """Return the command without the folders of this machine."""
    words = ["uav-twin", "discrepancy", "run", *(["--from-run"] if from_run else []), source.resolve().name]
    if model is not None:
        words += ["--model", Path(model).name]
    words += ["--seed", str(seed)]
    for path in effects:
        words += ["--effects", path.name]
    if calibrate is not None:
        words += ["--calibrate", str(calibrate)]
    return shlex.join(words)


def _inputs(data_hash: str, choice: ModelChoice, effects: list[Path]) -> dict[str, str]:
    from reporting.provenance import hash_file

    found = {"campaign": data_hash, "model": choice.source_hash}
    return found | {f"effects {path.name}": hash_file(path) for path in effects}


def _packing(choice: ModelChoice, progress: Progress) -> Pack:
    """Return what makes the FMU of a wing that carries a patch, its effects off."""

    def pack(patch_file: Path, target: Path) -> str:
        from calibration.result import CalibrationResult
        from discrepancy.model_choice import ModelKind
        from fe.cache import reduced_model
        from fe.patch_cache import patch_arrays
        from fmu_asset.build import build_fmu
        from fmu_asset.errors import PatchFileError
        from fmu_asset.patch_file import load_patch
        from twin_master.calibrated_asset import pack_calibrated_wing

        try:
            patch = load_patch(patch_file)
            model = reduced_model(choice.design, progress=progress)
            arrays = patch_arrays(choice.design, progress) if patch.needs_arrays else None
            if choice.kind is ModelKind.CALIBRATION:
                assert choice.path is not None
                wing = CalibrationResult.load(choice.path)
                pack_calibrated_wing(model, wing, target, patch=patch, arrays=arrays)
            else:
                build_fmu(model, target, patch=patch, arrays=arrays)
        except PatchFileError as cause:
            return f"There is no patched FMU: {str(cause).replace(str(patch_file), patch_file.name)}"
        names = ", ".join(f"effect.{effect.id}.active" for effect in patch.effects)
        return f"{target.name} carries it, off until {names} is set to 1."

    return pack


# ---------------------------------------------------------------- summary


def _show(found: Investigation, tried: SelfCalibration | None, report: Path, console: Console) -> None:
    from discrepancy.patch_file import PATCH_NAME, read_patch
    from discrepancy.report.sizes import size_sentence
    from discrepancy.report.text import (
        estimate_text,
        headline,
        number,
        percent,
        probability_text,
        unit_text,
    )
    from discrepancy.verdict import VerdictKind
    from reporting.words import counted
    from uav_twin.console_table import console_table

    verdict, proof = found.verdict, found.proof
    console.print(f"Verdict: {verdict.kind.value}", style="bold")
    console.print(headline(verdict), soft_wrap=True)
    if (patch_file := report.parent / PATCH_NAME).is_file():
        stored = read_patch(patch_file)
        if sizes := size_sentence(found, stored.effects, stored.intervals):
            console.print(sizes, soft_wrap=True)
    if isfinite(verdict.probability) and verdict.kind is not VerdictKind.UNEXPLAINED:
        against = f", ln Bayes factor against nothing missing {verdict.log_bayes_factor:.1f}"
        none = verdict.kind is VerdictKind.NOTHING_MISSING
        console.print(f"Probability {probability_text(verdict.probability)}{'' if none else against}.")
    if verdict.effects:
        headings = ("effect", "place", "parameter", "value", "90 % interval", "unit")
        rows = [
            (
                effect.identifier, effect.place, item.name.replace("_", " "), *estimate_text(item),
                unit_text(item.unit),
            )
            for effect in verdict.effects
            for item in (*effect.parameters, *effect.shape)
        ]  # fmt: skip
        console.print(console_table(headings, rows, console.width))
    if proof is not None:
        first, second, where = proof.fitted_before, proof.fitted_after, "fitted trials (none is held out)"
        if proof.held_out_before is not None and proof.held_out_after is not None:
            first, second = proof.held_out_before, proof.held_out_after
            where = f"held-out trials ({', '.join(trial.name for trial in found.campaign.held_out)})"
        closed = f", {percent(proof.gap_closed)} % of the gap closed" if isfinite(proof.gap_closed) else ""
        why = f" {proof.gap_reason}" if proof.held_out_before is not None and proof.gap_reason else ""
        scores = (
            f"χ²/dof on {where}: {number(first.chi_square_per_dof)} before, "
            f"{number(second.chi_square_per_dof)} with the effect{closed}.{why}"
        )
        console.print(scores if isfinite(first.chi_square_per_dof) else proof.remaining, soft_wrap=True)
    for experiment in verdict.next_experiments[:SHOWN_EXPERIMENTS]:
        console.print(f"Next: {experiment.description} ({experiment.information:.2f} nat)", soft_wrap=True)
    for fault in found.faults:
        console.print(f"Data: {fault.sentence}", soft_wrap=True)
    said = {fault.sentence for fault in found.faults}
    for remark in verdict.remarks:
        if remark not in said:
            console.print(f"Note: {remark}", soft_wrap=True)
    if tried is not None:
        right, wrong = tried.share("right"), tried.share("wrong")
        false = tried.share("wrong", null=True)
        console.print(
            f"Simulated campaigns: {right.count} of {right.total} hidden effects named, {wrong.count} "
            f"wrongly; {counted(false.count, 'false name')} where nothing was hidden ({false.total})."
        )
    console.print(f"Report: {report}", soft_wrap=True)
