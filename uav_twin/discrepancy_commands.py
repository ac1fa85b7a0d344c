"""`uav-twin discrepancy run`, `check` and `apply`: a verdict on a campaign, a patched model.

`check` says what a campaign can decide before anything is fitted. The commands that make
campaigns are in `discrepancy_campaigns`.
"""

import dataclasses
import shlex
from collections.abc import Sequence
from functools import partial
from json import loads
from pathlib import Path
from typing import Any

import typer

from discrepancy.errors import CampaignFileError, DiscrepancyError
from reporting import terminal
from reporting.progress import reporter, stage
from uav_twin import options, parts


def run(
    campaign: Path | None = None,
    *,
    from_run: Path | None = None,
    from_step: int | None = None,
    to_step: int | None = None,
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
    _check_source(campaign, from_run, from_step, to_step)
    source = campaign or from_run
    assert source is not None
    folder = out if out is not None else Path("verdicts") / source.resolve().name
    parts.check_verdict_folder(folder, replace_it=replace)
    catalogue = parts.load_catalogue(effects or ())
    data, choice = _compared(campaign, from_run, from_step, to_step, model)
    inputs = {"campaign": data.data_hash, "model": choice.source_hash}
    inputs |= {f"effects {path.name}": parts.hash_file(path) for path in effects or ()}
    options_of_command = {
        "from-step": from_step,
        "to-step": to_step,
        "model": model and choice.file,
        "seed": seed,
    }
    origin = parts.Origin(
        data.name,
        choice.model.name,
        data.data_hash,
        choice.source_hash,
        _command(
            source, effects or [], from_run is not None, **options_of_command, calibrate=calibrate
        ),
        parts.collect_provenance(seed, input_hashes=inputs),
        choice.file,
    )
    in_progress = parts.SearchInProgress()
    with terminal.interruptible(lambda: _keep_so_far(folder, in_progress, origin)):
        investigation = parts.investigate(
            data, choice.model, catalogue, seed=seed, on_search=in_progress.remember_search
        )
    separability, self_calibration = _decidability(
        investigation, choice, catalogue, calibrate, seed
    )
    pack = None if choice.design is None else partial(parts.pack_beside_verdict, choice)
    content = parts.ReportInput(
        investigation, origin, separability, self_calibration, choice.design, pack=pack
    )
    with stage("Writing the verdict"):
        report_file = parts.write_verdict_folder(
            folder, content, replace_it=replace, report=not no_report
        )
    _conclude(content, folder, None if no_report else report_file, json=json)


def _check_source(
    campaign: Path | None, from_run: Path | None, from_step: int | None, to_step: int | None
) -> None:
    """Refuse both sources of records or none of them, and steps that are not those of a mission.

    Raises
    ------
    CampaignFileError
        If the options do not fit together; the sentence says which.
    """
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


def _decidability(
    investigation: "parts.Investigation",
    choice: "parts.ModelChoice",
    catalogue: "Sequence[parts.Effect]",
    calibrate: int | None,
    seed: int,
) -> tuple["parts.Separability | None", "parts.SelfCalibration | None"]:
    """Return what the campaign can decide, and how often the workflow is right on simulated ones.

    Both are None where the records could not be compared with the model; the second also where no
    number of simulated campaigns is given.
    """
    if investigation.problem is None:
        return None, None
    tested_campaign = investigation.campaign
    with stage("What this campaign can decide"):
        separability = parts.compute_separability(
            tested_campaign, choice.model, investigation.problem.setting, catalogue
        )
    if calibrate is None:
        return separability, None
    workers = 1 if choice.kind is parts.ModelKind.FMU else 2  # an FMU is its own process
    with stage("Trying the workflow on simulated campaigns", calibrate, "campaigns") as progress:
        self_calibration = parts.self_calibrate(
            tested_campaign,
            choice.model,
            catalogue,
            calibrate,
            seed=seed,
            workers=workers,
            advance=progress.advance,
        )
    return separability, self_calibration


def _keep_so_far(
    folder: Path, in_progress: "parts.SearchInProgress", origin: "parts.Origin"
) -> str:
    """Write the fits of an interrupted search, and return the sentence that says where.

    The sentence is empty if there are none yet.
    """
    path = parts.write_so_far(folder, in_progress.hypotheses(), origin)
    return "" if path is None else f"the hypotheses fitted until then are in {path}"


def _conclude(
    content: "parts.ReportInput", folder: Path, report: Path | None, *, json: bool
) -> None:
    """Print the conclusion of an investigation; faulty data end the command with exit code 1.

    Parameters
    ----------
    content : ReportInput
        The investigation.
    folder : Path
        The folder of its verdict.
    report : Path or None
        Its report, if one was written.
    json : bool
        Whether to print JSON.
    """
    investigation = content.investigation
    verdict = investigation.verdict
    has_faulty_data = verdict.kind is parts.VerdictKind.DATA_ERROR
    if json:
        record = {"folder": str(folder), "report": None if report is None else str(report)}
        stored = (folder / parts.VERDICT_NAME).read_text(encoding="utf-8")
        terminal.print_json(record | loads(stored))
    if has_faulty_data:
        further_faults = [fault.sentence for fault in investigation.faults[1:]]
        for sentence in (verdict.sentence, *further_faults):
            typer.secho(sentence, fg="red", err=True)
    elif not json:
        _show_verdict(content, folder)
    if not json:
        terminal.say(f"Verdict: {folder}" if report is None else f"Report: {report}")
    if has_faulty_data:
        raise typer.Exit(1)
    if not json and parts.has_applicable_effects(verdict, investigation.proof):
        terminal.say(f"Next: uav-twin discrepancy apply {shlex.quote(str(folder))}")


def _compared(
    campaign: Path | None,
    from_run: Path | None,
    first: int | None,
    last: int | None,
    model: str | None,
) -> "tuple[parts.Campaign, parts.ModelChoice]":
    """Return the campaign, and the model that it is compared with.

    Parameters
    ----------
    campaign, from_run : Path or None
        The folder of a campaign, or that of a mission's run.
    first, last : int or None
        The turns of the run.
    model : str or None
        The model; by default that of the twin of the run.
    """
    if from_run is None:
        assert campaign is not None
        return parts.read_campaign(campaign), parts.choose_model(model)
    with parts.flown(from_run, first, last, reporter()) as folder:
        try:
            data = parts.run_campaign(folder, first, last)
            if model is not None:
                return data, parts.choose_model(model)
            return data, dataclasses.replace(
                parts.choice_of_run(folder), file=str(from_run.resolve())
            )
        except DiscrepancyError as error:  # a watch is read from a copy that its user does not know
            raise type(error)(str(error).replace(str(folder), str(from_run))) from error


def one_thread() -> None:
    """Hold the linear algebra of this process to one thread, for good.

    Its matrices are small: several threads would wait for each other, and the last bits of a sum
    would depend on their number.
    """
    import scipy.linalg  # noqa: F401 - a library that is not loaded yet cannot be held
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)


def _command(source: Path, effects: list[Path], from_run: bool, **values: str | int | None) -> str:
    """Return the command that does the same in any folder, with absolute paths.

    Parameters
    ----------
    source : Path
        The folder of the campaign, or of the run.
    effects : list of Path
        Files of further effects.
    from_run : bool
        Whether the source is a run.
    **values : str, int or None
        Values of further options by name; None for an option that was not given.
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


def _show_verdict(content: "parts.ReportInput", folder: Path) -> None:
    """Print a verdict, with the intervals of its patch if there is one in the folder."""
    from discrepancy.report.text import WORDS

    patch_file = folder / parts.PATCH_NAME
    if patch_file.is_file():
        intervals = [effect.intervals for effect in parts.read_patch(patch_file).effects]
        content = dataclasses.replace(content, intervals=intervals)
    terminal.say(f"Verdict: {content.investigation.verdict.kind.value}", bold=True)
    options.show("run", words=WORDS, **parts.template_values(content))


def check(
    campaign: Path,
    *,
    model: str | None = None,
    effects: list[Path] | None = None,
    json: bool = False,
) -> None:
    """Say what is wrong with the data, which effects they can show, and which they cannot tell apart."""  # noqa: E501
    catalogue = parts.load_catalogue(effects or ())
    chosen = parts.choose_model(model).model
    data, faults = parts.check_and_prepare(parts.read_campaign(campaign), chosen)
    separability = None
    if not any(fault.fatal for fault in faults):
        with stage("What this campaign can decide"):
            setting = parts.Setting(data, chosen, chosen.scales(data))
            separability = parts.compute_separability(data, chosen, setting, catalogue)
    if json:
        terminal.print_json(_record(data, chosen.name, faults, separability))
    else:
        from discrepancy.report.text import WORDS

        options.show(
            "check",
            words=WORDS,
            able=separability,
            data=data,
            model=chosen,
            faults=faults,
            catalogue=catalogue,
            detectability_texts=parts.detectability_texts,
            confused_effects=parts.confused_effects,
            group_lines=parts.group_lines,
            campaign_needs=parts.campaign_needs,
        )
    if separability is None:
        raise terminal.error_exit(
            "Mend the faults first: conclusions from these data would be wrong."
        )


def _record(
    data: "parts.Campaign",
    model: str,
    faults: "Sequence[parts.DataFault]",
    separability: "parts.Separability | None",
) -> dict[str, Any]:
    """Return the faults of a campaign, and what it can decide, as plain data.

    Parameters
    ----------
    data : Campaign
        The campaign.
    model : str
        Name of the model.
    faults : sequence of DataFault
        Faults of the data.
    separability : Separability or None
        What the campaign can decide; None where faults leave nothing. A magnitude that is never
        seen is null.
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
    verdict: Path, *, out: Path | None = None, member: str | None = None, replace: bool = False
) -> None:
    """Write the model with the effect that was found and the parameters beside it."""
    options.show("apply", done=parts.apply_verdict(verdict, out, member=member, replace=replace))
