"""`uav-twin discrepancy import`, `example`, `convert` and `effects`: what a search begins with."""

import re
import shlex
import sys
from collections.abc import Sequence
from math import isfinite, nan
from pathlib import Path

import typer

from discrepancy.errors import CampaignFileError, CatalogueError
from reporting import terminal
from reporting.files import refuse_filled
from reporting.words import comma_list, counted
from uav_twin import options, parts


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
    """Make a campaign of a laboratory's files: show how they are understood, and ask what they do not say."""  # noqa: E501
    folder = out or Path(files[0].stem)
    refuse_filled(folder)
    column_options = (column, unit, quantity, scale, zero, gain, hold)
    held_out_option = [f"{name}=yes" for name in held_out or ()]
    file_options = (kind, release, load_place, decimal, interval, begins, held_out_option)
    names = (*parts.OF_COLUMNS, *parts.OF_FILES)
    answers = {
        name: _answers_by_subject(texts or ())
        for name, texts in zip(names, (*column_options, *file_options), strict=True)
    }
    if reference_temperature is not None:
        answers["reference-temperature"] = {"": reference_temperature}
    sheets = [parts.read_sheet(file) for file in files]
    understanding = parts.LaboratoryImport(sheets, answers)
    if model is not None:
        quantity_of_output = parts.choose_model(model).model.output_quantity
        understanding = parts.LaboratoryImport(understanding.sheets, answers, quantity_of_output)
    _show_understanding(understanding)
    is_interactive = sys.stdin.isatty() and sys.stdout.isatty()
    if is_interactive and (understanding.questions or understanding.assumptions):
        while understanding.questions or understanding.assumptions:
            understanding = _with_answer_of_user(understanding)
        _show_understanding(understanding)
    campaign = understanding.campaign(folder.resolve().name)
    if is_interactive and not typer.confirm(f"Write {folder}?", default=True):
        terminal.say("Nothing was written.")
        raise typer.Exit(1)
    parts.write_campaign(
        campaign, folder, si=True, units=understanding.units(), left_out_as_empty=True
    )
    assumptions = []
    if understanding.assumed:
        assumptions.append(
            f"{understanding.assumed} Where you know better, give --zero and --gain, or correct "
            f"offset_deviation and gain_deviation in {folder / 'campaign.toml'}."
        )
    arguments = arguments_of(folder, model)
    options.show("import", folder=folder, campaign=campaign, given=arguments, assumed=assumptions)


def _answers_by_subject(texts: Sequence[str]) -> dict[str, str]:
    """Return the values of an option, SUBJECT=VALUE or VALUE, by subject: a column or a file."""
    answers = {}
    for text in texts:
        subject, _, value = text.rpartition("=")
        answers[subject] = value
    return answers


def _with_answer_of_user(understanding: "parts.LaboratoryImport") -> "parts.LaboratoryImport":
    """Ask the user one question, and return the understanding with the answer.

    Questions that must be answered come first, then those with a default, which an empty line
    takes. An answer that does not fit is refused, and changes nothing.
    """
    default = None
    if understanding.questions:
        (option, expected), (subject, *_) = next(iter(understanding.questions.items()))
    else:
        (option, expected), defaults = next(iter(understanding.assumptions.items()))
        subject, default = next(iter(defaults.items()))
    question = f"{option} ({expected})"
    if subject:
        question = f"{subject}, {question}"
    answer: str = typer.prompt(question, default=default)
    try:
        return understanding.with_answer(option, subject, answer.strip())
    except CampaignFileError as error:
        typer.secho(str(error), fg="red", err=True)
        return understanding


def _show_understanding(understanding: "parts.LaboratoryImport") -> None:
    """Print how the columns of files are understood, each with a value that is not zero."""
    rows = []
    for column in understanding.columns:
        sheet = column.sheet
        cells = sheet.columns[sheet.heads.index(column.head)]
        nonzero_rows = [row for row, cell in enumerate(cells) if re.search("[1-9]", cell)]
        row = nonzero_rows[0] if nonzero_rows else -1
        si_value = column.cells_in_si(understanding.decimals[sheet.name])[row]
        rows.append(
            (
                sheet.name,
                column.head,
                column.unit or "?",
                column.role or "?",
                column.quantity or "",
                cells[row],
                f"{float(si_value):.6g} {column.si}" if si_value else "",
            )
        )
    options.show("understood", found=understanding, rows=rows)


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
    kind: str,
    out: Path,
    *,
    model: str | None = None,
    seed: int = 0,
    effect: list[str] | None = None,
) -> None:
    """Write a simulated campaign, with an effect hidden in it if asked for."""
    refuse_filled(out, "folder")
    chosen = parts.choose_model(model).model
    plan = parts.usual_plan(chosen)
    patch = parts.ModelPatch()
    if effect:
        plain = parts.example_campaign(chosen, kind, seed, plan)  # type: ignore[arg-type]  # it checks
        for text in effect:
            patch = patch + _hidden_effect(text, chosen, plain)
    campaign = parts.write_example(chosen, out, kind, seed, plan, patch)  # type: ignore[arg-type]
    hidden = ", ".join(effect) if effect else "nothing"
    options.show(
        "example", out=out, campaign=campaign, hidden=hidden, given=arguments_of(out, model)
    )


def arguments_of(campaign: Path, model: str | None) -> str:
    """Return a campaign and its model as the arguments of a further command."""
    model_option = [] if model is None else ["--model", model]
    return shlex.join([str(campaign), *model_option])


def _hidden_effect(
    text: str, model: "parts.Model", campaign: "parts.Campaign"
) -> "parts.ModelPatch":
    """Return the patch of an effect that is hidden in an example.

    Parameters
    ----------
    text : str
        ID[@PLACE][:NAME=VALUE,...] or ID[@PLACE]=VALUE,...; parameters without a value have the
        median of their prior.
    model : Model
        The model of the example.
    campaign : Campaign
        The example without the effect.

    Raises
    ------
    CatalogueError
        If there is no such effect, place or parameter.
    """
    has_names = ":" in text
    head, _, numbers = text.partition(":" if has_names else "=")
    identifier, at, place = head.partition("@")
    effect = parts.effect_by_identifier(identifier, parts.load_catalogue())
    setting = parts.Setting(campaign, model, model.scales(campaign))
    reason = effect.unavailable(setting)
    if reason is not None:
        raise CatalogueError(f"{identifier} cannot be hidden in this example: {reason}")
    places = effect.places(setting)
    if at and place not in places:
        known = ", ".join(repr(name) for name in places)
        raise CatalogueError(f"{identifier} cannot act at {place!r} here; its places are {known}.")
    values = {}
    for parameter in effect.parameters:
        value = parameter.prior.value(0.0)
        if parameter.magnitude and value == 0.0:
            # the median of a magnitude of either sign would hide nothing
            value = parameter.prior.value(1.0)
        values[parameter.name] = value
    if numbers or has_names:
        values |= _parameter_values(text, identifier, numbers.split(","), list(values))
    return effect.patch(setting, values, place if at else places[0])


def _parameter_values(
    text: str, identifier: str, numbers: list[str], names: list[str]
) -> dict[str, float]:
    """Return the values of an effect's parameters by name.

    Parameters
    ----------
    text : str
        The option as the user wrote it.
    identifier : str
        The effect.
    numbers : list of str
        "VALUE" in the order of the names, or "NAME=VALUE".
    names : list of str
        Names of the parameters.

    Raises
    ------
    CatalogueError
        If there are too many values, a name is unknown, or a value is not a finite number.
    """
    if len(numbers) > len(names):
        raise CatalogueError(
            f"{identifier} has {counted(len(names), 'parameter')} ({comma_list(names)}), but "
            f"{counted(len(numbers), 'value')} came."
        )
    values = {}
    for position, number_text in enumerate(numbers):
        name, equals, number = number_text.rpartition("=")
        if equals and name not in names:
            raise CatalogueError(
                f"{identifier} has no parameter {name!r}; it has {', '.join(names)}."
            )
        try:
            value = float(number)
        except ValueError:
            value = nan
        if not isfinite(value):
            raise CatalogueError(
                f"{text!r} must end with numbers, such as {identifier}:{names[0]}=0.1."
            )
        values[name or names[position]] = value
    return values


def convert(out: Path, *, data: Path, rig: str = "real_wing") -> None:
    """Write published measurements as a campaign; of other rigs than the wing with `model.toml` beside it."""  # noqa: E501
    campaign = parts.read_campaign(parts.write_rig_campaign(rig, data, out))
    options.show("convert", campaign=campaign, out=out, modelled=(out / "model.toml").exists())
