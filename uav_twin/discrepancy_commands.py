"""`uav-twin discrepancy`: from a campaign to a verdict, with report, patch and patched FMU.

`check` says what a campaign can decide before anything is fitted, `import` makes one of a laboratory's files,
and the catalogue is at work in `effects`, `example`, `convert` and `apply`.
"""

import dataclasses
import re
import shlex
import sys
from collections.abc import Sequence
from functools import partial
from json import loads
from math import isfinite, nan
from pathlib import Path
from typing import Any

import typer

from discrepancy.errors import CampaignFileError, CatalogueError, DiscrepancyError
from reporting import terminal
from reporting.files import refuse_filled
from reporting.progress import reporter, stage
from reporting.words import counted
from uav_twin import options, parts
from uav_twin.options import said


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
    inputs = {"campaign": data.data_hash, "model": choice.source_hash}
    inputs |= {f"effects {path.name}": parts.hash_file(path) for path in effects or ()}
    asked = {"from-turn": from_turn, "to-turn": to_turn, "model": model and choice.file, "seed": seed}
    origin = parts.Origin(
        data.name,
        choice.model.name,
        data.data_hash,
        choice.source_hash,
        _command(source, effects or [], from_run is not None, **asked, calibrate=calibrate),
        parts.collect_provenance(seed, input_hashes=inputs),
        choice.file,
    )
    in_progress = parts.SearchInProgress()
    with terminal.interruptible(lambda: _keep_so_far(folder, in_progress, origin)):
        found = parts.investigate(data, choice.model, catalogue, seed=seed, on_search=in_progress.begin)
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
    pack = None if choice.design is None else partial(parts.packed_beside, choice)
    content = parts.ReportInput(found, origin, able, tried, choice.design, pack=pack)
    with stage("Writing the verdict"):
        place = parts.write_verdict_folder(folder, content, replace_it=replace, report=not no_report)
    _conclude(content, folder, None if no_report else place, json=json)


def _keep_so_far(folder: Path, in_progress: "parts.SearchInProgress", origin: "parts.Origin") -> str:
    """Write what an interrupted search has found, and say where; empty where it has found nothing yet."""
    path = parts.write_so_far(folder, in_progress.hypotheses(), origin)
    return "" if path is None else f"the hypotheses fitted until then are in {path}"


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
        _show_verdict(content, folder)
    if not json:
        terminal.say(f"Verdict: {folder}" if report is None else f"Report: {report}")
    if fault:
        raise typer.Exit(1)
    if not json and parts.gives(found.verdict, found.proof):
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


def _command(source: Path, effects: list[Path], from_run: bool, **given: Any) -> str:
    """Return the command that does the same in any folder: with absolute paths."""
    words = ["uav-twin", "discrepancy", "run", *["--from-run"] * from_run, str(source.resolve())]
    for name, value in given.items():
        words += [] if value is None else [f"--{name}", str(value)]
    for path in effects:
        words += ["--effects", str(path.resolve())]
    return shlex.join(words)


def _show_verdict(content: "parts.ReportInput", folder: Path) -> None:
    from discrepancy.report.text import WORDS

    if (patch_file := folder / parts.PATCH_NAME).is_file():
        intervals = [effect.intervals for effect in parts.read_patch(patch_file).effects]
        content = dataclasses.replace(content, intervals=intervals)
    terminal.say(f"Verdict: {content.investigation.verdict.kind.value}", bold=True)
    options.show("run", words=WORDS, **parts.said_on_page(content))


def check(
    campaign: Path, *, model: str | None = None, effects: list[Path] | None = None, json: bool = False
) -> None:
    """Say what is wrong with the data, which effects they can show, and which they cannot tell apart."""
    data, catalogue = parts.read_campaign(campaign), parts.load_catalogue(effects or ())
    chosen = parts.choose_model(model).model
    data, faults = parts.checked(data, chosen)
    able = None
    if not any(fault.fatal for fault in faults):
        with stage("What this campaign can decide"):
            setting = parts.Setting(data, chosen, chosen.scales(data))
            able = parts.separability(data, chosen, setting, catalogue)
    if json:
        terminal.print_json(_record(data, chosen.name, faults, able))
    else:
        from discrepancy.report.text import WORDS

        of_able = (parts.seen_of, parts.neighbours, parts.group_lines, parts.needs)
        given: dict[str, Any] = {item.__name__: item for item in of_able}
        given |= {"data": data, "model": chosen, "faults": faults, "catalogue": catalogue}
        options.show("check", words=WORDS, able=able, **given)
    if able is None:
        raise terminal.error_exit("Mend the faults first: conclusions from these data would be wrong.")


def _record(
    data: "parts.Campaign", model: str, faults: "Sequence[parts.DataFault]", able: "parts.Separability | None"
) -> dict[str, Any]:
    """Return faults and what the campaign can decide as plain data; a size that is never seen is null."""
    return {
        "campaign": data.name,
        "model": model,
        "trials": [{"name": trial.name, "held_out": trial.held_out} for trial in data.trials],
        "channels": list(data.channels),
        "passed": able is not None,
        "faults": [dataclasses.asdict(fault) | {"fatal": fault.fatal} for fault in faults],
        "remarks": data.remarks,
        "effects": [] if able is None else [
            {"effect": item.effect.identifier, "testable": not item.reason, "reason": item.reason,
             "place": item.place, "parameter": item.parameter, "detectable_from": item.detectable,
             "prior_median": item.typical, "unit": item.unit}
            for item in able.detectability
        ],
        "confusion_groups": [] if able is None else able.groups,
    }  # fmt: skip


def import_files(
    files: list[Path],
    *,
    out: Path | None = None,
    column: list[str] | None = None,
    unit: list[str] | None = None,
    quantity: list[str] | None = None,
    scale: list[str] | None = None,
    zero: list[str] | None = None,
    gain: list[str] | None = None,
    hold: list[str] | None = None,
    kind: list[str] | None = None,
    release: list[str] | None = None,
    load_place: list[str] | None = None,
    decimal: list[str] | None = None,
    interval: list[str] | None = None,
    begins: list[str] | None = None,
    held_out: list[str] | None = None,
    reference_temperature: str | None = None,
    model: str | None = None,
) -> None:
    """Make a campaign of a laboratory's files: show how they are understood, and ask what they do not say."""
    folder = out or Path(files[0].stem)
    refuse_filled(folder)
    of_columns = (column, unit, quantity, scale, zero, gain, hold)
    kept_for_proof = [f"{name}=yes" for name in held_out or ()]
    of_files = (kind, release, load_place, decimal, interval, begins, kept_for_proof)
    answers = {
        option: {about: value for about, _, value in (item.rpartition("=") for item in said or ())}
        for option, said in zip((*parts.OF_COLUMNS, *parts.OF_FILES), (*of_columns, *of_files), strict=True)
    }
    if reference_temperature is not None:
        answers["reference-temperature"] = {"": reference_temperature}
    found = parts.LaboratoryImport([*map(parts.read_sheet, files)], answers)
    if model is not None:
        known = parts.choose_model(model).model.output_quantity
        found = parts.LaboratoryImport(found.sheets, answers, known)
    _show_understood(found)
    asked = sys.stdin.isatty() and sys.stdout.isatty()
    if asked and (found.questions or found.assumptions):
        while found.questions or found.assumptions:
            found = _asked(found)
        _show_understood(found)
    campaign = found.campaign(folder.resolve().name)
    if asked and not typer.confirm(f"Write {folder}?", default=True):
        terminal.say("Nothing was written.")
        raise typer.Exit(1)
    parts.write_campaign(campaign, folder, si=True, units=found.units(), left_out_as_empty=True)
    assumed = []
    if found.assumed:
        remedy = "give --zero and --gain, or correct offset_deviation and gain_deviation"
        assumed = [f"{found.assumed} Where you know better, {remedy} in {folder / 'campaign.toml'}."]
    given = words_of(folder, model)
    options.show("import", folder=folder, campaign=campaign, given=given, assumed=assumed)


def _asked(found: "parts.LaboratoryImport") -> "parts.LaboratoryImport":
    """Return what is understood with one answer more; one that does not fit is told, and changes nothing.

    What must be said comes first, then what has a default, which an empty line takes.
    """
    default = None
    if found.questions:
        (option, expected), (about, *_) = next(iter(found.questions.items()))
    else:
        (option, expected), defaults = next(iter(found.assumptions.items()))
        about, default = next(iter(defaults.items()))
    question = f"{about}, {option} ({expected})" if about else f"{option} ({expected})"
    said: str = typer.prompt(question, default=default)
    try:
        return found.with_answer(option, about, said.strip())
    except CampaignFileError as error:
        typer.secho(str(error), fg="red", err=True)
        return found


def _show_understood(found: "parts.LaboratoryImport") -> None:
    rows = []
    for item in found.columns:
        cells = item.sheet.columns[item.sheet.heads.index(item.head)]
        told = next((row for row, cell in enumerate(cells) if re.search("[1-9]", cell)), -1)
        si = item.in_si(found.decimals[item.sheet.name])[told]
        value = f"{float(si):.6g} {item.si}" if si else ""
        known = (item.unit or "?", item.role or "?", item.quantity or "")
        rows.append((item.sheet.name, item.head, *known, cells[told], value))
    options.show("understood", found=found, rows=rows)


def effects(*, show: str | None = None, add: list[Path] | None = None) -> None:
    """List the effects that can be named."""
    catalogue = parts.load_catalogue(add or ())
    if show is None:
        options.show("effects", effects=catalogue, formula=parts.formula)
    else:
        _show_effect(parts.effect_by_identifier(show, catalogue))


def _show_effect(effect: "parts.Effect") -> None:
    facts = (
        ("name", effect.name),
        ("family", effect.family),
        ("equation", parts.formula(effect.equation)),
        ("signature", parts.formula(effect.signature)),
        ("acts on", ", ".join(sorted(kind.value for kind in effect.acts_on))),
        ("confusable with", ", ".join(effect.confusable) or "nothing in general"),
        ("reference", effect.reference),
    )
    terminal.print_table(("id", effect.identifier), facts)
    options.show("effect", effect=effect, unit_text=parts.unit_text)


def example(
    kind: str, out: Path, *, model: str | None = None, seed: int = 0, effect: list[str] | None = None
) -> None:
    """Write a simulated campaign, with an effect hidden in it if asked for."""
    refuse_filled(out, "folder")
    chosen = parts.choose_model(model).model
    plan, patch = parts.plan_of(chosen), parts.ModelPatch()
    if effect:
        bare = parts.example_campaign(chosen, kind, seed, plan)  # type: ignore[arg-type]  # said by itself
        for text in effect:
            patch = patch + _hidden(text, chosen, bare)
    campaign = parts.write_example(chosen, out, kind, seed, plan, patch)  # type: ignore[arg-type]
    hidden = ", ".join(effect) if effect else "nothing"
    options.show("example", out=out, campaign=campaign, hidden=hidden, given=words_of(out, model))


def words_of(campaign: Path, model: str | None) -> str:
    """Return a campaign and its model as a further command takes them."""
    return shlex.join([str(campaign), *([] if model is None else ["--model", model])])


def _hidden(text: str, model: "parts.Model", campaign: "parts.Campaign") -> "parts.ModelPatch":
    """Return the patch of ID[@PLACE][:NAME=VALUE,...] or ID[@PLACE]=VALUE,..; raises `CatalogueError`."""
    head, named, numbers = text.partition(":")
    if not named:
        head, _, numbers = text.partition("=")
    identifier, at, place = head.partition("@")
    found = parts.effect_by_identifier(identifier, parts.load_catalogue())
    setting = parts.Setting(campaign, model, model.scales(campaign))
    reason = found.unavailable(setting)
    if reason is not None:
        raise CatalogueError(f"{identifier} cannot be hidden in this example: {reason}")
    places = found.places(setting)
    if at and place not in places:
        known = ", ".join(repr(name) for name in places)
        raise CatalogueError(f"{identifier} cannot act at {place!r} here; its places are {known}.")
    values = {item.name: item.prior.value(0.0) for item in found.parameters}
    for item in found.parameters:
        if item.magnitude and values[item.name] == 0.0:
            values[item.name] = item.prior.value(1.0)  # the median of a signed size would hide nothing
    if numbers or named:
        values |= _values(text, identifier, numbers.split(","), list(values))
    return found.patch(setting, values, place if at else places[0])


def _values(text: str, identifier: str, given: list[str], names: list[str]) -> dict[str, float]:
    """Return the values that are given, "VALUE" in the order of `names` or "NAME=VALUE"."""
    if len(given) > len(names):
        both = {"has": counted(len(names), "parameter"), "came": counted(len(given), "value")}
        raise CatalogueError(said("effects.count", identifier=identifier, names=names, **both))
    values = {}
    for position, part in enumerate(given):
        name, equals, number = part.rpartition("=")
        if equals and name not in names:
            raise CatalogueError(f"{identifier} has no parameter {name!r}; it has {', '.join(names)}.")
        try:
            value = values[name or names[position]] = float(number)
        except ValueError:
            value = nan
        if not isfinite(value):
            raise CatalogueError(said("effects.numbers", text=text, identifier=identifier, name=names[0]))
    return values


def convert(out: Path, *, data: Path, rig: str = "real_wing") -> None:
    """Write published measurements as a campaign; of other rigs than the wing with `model.toml` beside it."""
    campaign = parts.read_campaign(parts.write_rig_campaign(rig, data, out))
    options.show("convert", campaign=campaign, out=out, modelled=(out / "model.toml").exists())


def apply(
    verdict: Path, *, out: Path | None = None, member: str | None = None, replace: bool = False
) -> None:
    """Write the model with the effect that was found and the parameters beside it."""
    options.show("apply", done=parts.apply_verdict(verdict, out, member=member, replace=replace))
