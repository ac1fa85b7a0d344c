"""`uav-twin discrepancy import`, `example`, `convert` and `effects`: what a search begins with."""

import re
import shlex
import sys
from collections.abc import Sequence
from math import isfinite, nan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from discrepancy.errors import CatalogueError
from reporting import terminal
from reporting.command_options import LARGEST_SEED
from reporting.files import refuse_filled
from reporting.words import comma_list, counted, in_one_line
from uav_twin.completion import complete_effect, complete_model
from uav_twin.import_dialogue import ImportCommand, ImportDialogue
from uav_twin.options import EffectFilesOption, ModelOption

if TYPE_CHECKING:
    from discrepancy.campaign.importing import LaboratoryImport
    from discrepancy.campaign.records import Campaign
    from discrepancy.catalogue.entry import Effect, EffectParameter, ShapeParameter
    from discrepancy.system.interface import Model
    from fe.runtime.patch import ModelPatch


def import_files(
    files: Annotated[
        list[Path],
        typer.Argument(show_default=False, help="CSV, FILE.xlsx, FILE.xlsx#SHEET or FILE.mat."),
    ],
    *,
    out: Annotated[
        Path | None,
        typer.Option("--out", show_default="as the first file", help="The folder."),
    ] = None,
    column: Annotated[
        list[str] | None,
        typer.Option(
            "--column",
            metavar="HEAD=WHAT",
            help="The model's output that a column measures; time, force, temperature or "
            "load_factor; input:NAME; or - to leave it out. May be given several "
            "times.",
        ),
    ] = None,
    unit: Annotated[
        list[str] | None,
        typer.Option(
            "--unit",
            metavar="HEAD=UNIT",
            help="Unit of a column whose head does not state it. May be given several times.",
        ),
    ] = None,
    quantity: Annotated[
        list[str] | None,
        typer.Option(
            "--quantity",
            metavar="HEAD=QUANTITY",
            help=(
                "Quantity of a column whose unit belongs to several, such as V, % and 1. May be "
                "given several times."
            ),
        ),
    ] = None,
    scale: Annotated[
        list[str] | None,
        typer.Option(
            "--scale",
            metavar="HEAD=SCALE",
            help=(
                "Factor from the cells to the measured quantity, such as 200 N/V; a plain number "
                "multiplies them. May be given several times."
            ),
        ),
    ] = None,
    zero: Annotated[
        list[str] | None,
        typer.Option(
            "--zero",
            metavar="[HEAD=]DEVIATION",
            show_default="1%",
            help="How well a zero is known: 0.1mm, 1% of the largest reading, exact or "
            "free. May be given several times.",
        ),
    ] = None,
    gain: Annotated[
        list[str] | None,
        typer.Option(
            "--gain",
            metavar="[HEAD=]DEVIATION",
            show_default="2%",
            help="How well a gain is known: 2%, exact or free. May be given several times.",
        ),
    ] = None,
    hold: Annotated[
        list[str] | None,
        typer.Option(
            "--hold",
            metavar="[HEAD=]HOLD",
            show_default="linear",
            help="What a load does between samples: zero_order, linear or smooth. May be "
            "given several times.",
        ),
    ] = None,
    kind: Annotated[
        list[str] | None,
        typer.Option(
            "--kind",
            metavar="[FILE=]KIND",
            help=(
                "Kind of the trial: static, ringdown, forced, driven or flight; noise for samples "
                "at rest. May be given several times."
            ),
        ),
    ] = None,
    release: Annotated[
        list[str] | None,
        typer.Option(
            "--release",
            metavar="[FILE=]SIZE",
            help="Displacement at which the release point was held, such as 15.5mm. May be given "
            "several times.",
        ),
    ] = None,
    load_place: Annotated[
        list[str] | None,
        typer.Option(
            "--load-place",
            metavar="[FILE=]PLACE",
            show_default="tip_load",
            help="Where a force acts. May be given several times.",
        ),
    ] = None,
    decimal: Annotated[
        list[str] | None,
        typer.Option(
            "--decimal",
            metavar="[FILE=]MARK",
            help=(
                "Decimal sign, a point or a comma, if 1,234 can mean two numbers. May be given "
                "several times."
            ),
        ),
    ] = None,
    interval: Annotated[
        list[str] | None,
        typer.Option(
            "--interval",
            metavar="[FILE=]SECONDS",
            help="Seconds between rows, if no column is a time. May be given several times.",
        ),
    ] = None,
    begins: Annotated[
        list[str] | None,
        typer.Option(
            "--begins",
            metavar="[FILE=]START",
            show_default="settled",
            help="How a forced or driven trial begins: settled, still or unknown. May be "
            "given several times.",
        ),
    ] = None,
    held_out: Annotated[
        list[str] | None,
        typer.Option(
            "--held-out",
            metavar="FILE[=no]",
            help=(
                "A file that is held out for the proof; =no takes it into the fit. May be given "
                "several times."
            ),
        ),
    ] = None,
    reference_temperature: Annotated[
        str | None,
        typer.Option(
            "--reference-temperature",
            metavar="DEGC",
            help="Temperature at which the model's parameters hold, if a column is a temperature.",
        ),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            autocompletion=complete_model,
            help="The same as for `discrepancy run`: columns may have the names of its outputs.",
        ),
    ] = None,
    ask_nothing: Annotated[
        bool,
        typer.Option(
            "--ask-nothing",
            help="Take the defaults without questions, as if there were no terminal.",
        ),
    ] = False,
) -> None:
    """Make a campaign from the files of a laboratory: show how they are read, and ask for missing information.

    Example: `uav-twin discrepancy import pull.csv --kind static --column F=force --out measured`
    """  # noqa: E501
    from discrepancy.campaign.writing import write_campaign

    folder = out or Path(files[0].stem)
    refuse_filled(folder)
    options = {
        "column": column,
        "unit": unit,
        "quantity": quantity,
        "scale": scale,
        "zero": zero,
        "gain": gain,
        "hold": hold,
        "kind": kind,
        "release": release,
        "load-place": load_place,
        "decimal": decimal,
        "interval": interval,
        "begins": begins,
        "held-out": [_held_out_answer(text) for text in held_out or ()],
    }
    # The options are answers to questions about columns and files
    answers = {name: _answers_by_subject(texts or ()) for name, texts in options.items()}
    if reference_temperature is not None:
        answers["reference-temperature"] = {"": reference_temperature}
    understanding = _understand_files(files, answers, model)
    _print_understanding(understanding)
    # Without a terminal, a question that is still open is an error of `campaign`
    is_interactive = not ask_nothing and sys.stdin.isatty() and sys.stdout.isatty()
    if is_interactive:
        understanding = _ask_and_confirm(ImportCommand(files, out, model), understanding, folder)
    campaign = understanding.campaign(folder.resolve().name)
    write_campaign(campaign, folder, si=True, units=understanding.units(), left_out_as_empty=True)
    terminal.say(f"Wrote {folder}: {_campaign_size(campaign)}.")
    if understanding.assumed:
        terminal.say(
            f"{understanding.assumed} Where you know better, give --zero and --gain, or correct "
            f"offset_deviation and gain_deviation in {folder / 'campaign.toml'}."
        )
    terminal.say(f"Next: uav-twin discrepancy check {_shell_arguments(folder, model)}")


def _ask_and_confirm(
    command: ImportCommand, understanding: "LaboratoryImport", folder: Path
) -> "LaboratoryImport":
    """Ask what is open, and whether to write the folder; return the import with the answers.

    Raises
    ------
    CampaignFileError, CampaignDataError
        If no campaign can be made with the answers.
    typer.Exit
        If the user stops the dialogue, or wants nothing to be written.
    """
    dialogue = ImportDialogue(command, understanding)
    has_asked = dialogue.ask_all()
    if has_asked:
        _print_understanding(dialogue.understanding)
    dialogue.understanding.campaign(folder.resolve().name)  # wrong files are told before
    if has_asked:
        dialogue.print_repetition()
    if not dialogue.confirm(f"Write {folder}?"):
        terminal.say("Nothing was written.")
        raise typer.Exit(1)
    return dialogue.understanding


def _campaign_size(campaign: "Campaign") -> str:
    """Return how many trials and channels a campaign has, as a text."""
    trials = counted(len(campaign.trials), "trial")
    return f"{trials}, {counted(len(campaign.channels), 'channel')}"


def _held_out_answer(text: str) -> str:
    """Return FILE=yes or FILE=no for the text of `--held-out`, which may be FILE alone."""
    return text if text.endswith(("=yes", "=no")) else f"{text}=yes"


def _answers_by_subject(texts: Sequence[str]) -> dict[str, str]:
    """Return the values of an option by subject.

    Parameters
    ----------
    texts : sequence of str
        The texts of the option, each SUBJECT=VALUE or VALUE. The subject is a column or a file; it
        is the empty text for a value that holds for all of them.
    """
    answers = {}
    for text in texts:
        subject, _, value = text.rpartition("=")
        answers[subject] = value
    return answers


def _understand_files(
    files: list[Path], answers: dict[str, dict[str, str]], model: str | None
) -> "LaboratoryImport":
    """Read a laboratory's files, and return their import with the answers of the user.

    Parameters
    ----------
    files : list of Path
        The files.
    answers : dict of str to (dict of str to str)
        The values of the options, by the name of the option and then by its subject, which is a
        column or a file.
    model : str or None
        The name or the file of a model. Columns with the name of an output of the model are
        understood as measurements of this output. The model is loaded only after the files were
        read, so that their mistakes are found first.
    """
    from discrepancy.campaign.importing import LaboratoryImport
    from discrepancy.campaign.sheet import read_sheet
    from discrepancy.model_choice import choose_model

    sheets = [read_sheet(file) for file in files]
    understanding = LaboratoryImport(sheets, answers)
    if model is None:
        return understanding
    chosen_model = choose_model(model).model
    return LaboratoryImport(
        understanding.sheets,
        answers,
        chosen_model.output_quantity,
        chosen_model.outputs_with_quantities,
    )


_DECIMAL_MARKS = {".": "points", ",": "commas"}
"""The word for each decimal mark in the printed table."""


def _print_understanding(understanding: "LaboratoryImport") -> None:
    """Print how each file and each column is understood.

    The row of a column has an example: its first cell that is not zero, or its last cell, and the
    value of this cell in SI units.
    """
    for sheet in understanding.sheets:
        kind = understanding.kinds[sheet.name] or "?"
        decimal_mark = _DECIMAL_MARKS.get(understanding.decimals[sheet.name], "?")
        terminal.say(f"{sheet.name}: {kind}; {sheet.remark}; decimal {decimal_mark}")
    for sentence in understanding.clock_sentences:
        terminal.say(sentence)
    rows = []
    for column in understanding.columns:
        sheet = column.sheet
        cells = sheet.columns[sheet.heads.index(column.head)]
        # The decimal mark may be unknown, so that cells are texts: not zero means a digit 1 to 9
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
    if rows:
        headings = ("file", "column", "unit", "is", "quantity", "a cell", "in SI")
        terminal.print_table(headings, rows)


def effects(
    *,
    show: Annotated[
        str | None,
        typer.Option(
            "--show",
            metavar="ID",
            autocompletion=complete_effect,
            help="Everything about one effect.",
        ),
    ] = None,
    add: EffectFilesOption = None,
) -> None:
    """List the effects that can be named.

    Example: `uav-twin discrepancy effects --show coulomb_friction`
    """
    from discrepancy.catalogue.library import effect_by_identifier, load_catalogue
    from discrepancy.report.text import formula

    catalogue = load_catalogue(add or ())
    if show is not None:
        _print_effect(effect_by_identifier(show, catalogue))
        return
    rows = []
    for effect in catalogue:
        cells = (effect.identifier, effect.name, effect.family, formula(effect.equation))
        rows.append([in_one_line(cell) for cell in cells])
    terminal.print_table(("id", "name", "family", "equation"), rows)
    terminal.say(f"{counted(len(rows), 'effect')}; --show ID prints everything about one of them.")


def _print_effect(effect: "Effect") -> None:
    """Print the facts about an effect, and the parameters and exponents of its law."""
    from discrepancy.report.text import formula

    facts = (
        ("name", effect.name),
        ("family", effect.family),
        ("equation", formula(effect.equation)),
        ("signature", formula(effect.signature)),
        ("acts on", ", ".join(sorted(kind.value for kind in effect.acts_on))),
        ("confusable with", ", ".join(effect.confusable) or "nothing in general"),
        ("reference", effect.reference),
    )
    terminal.print_table(("id", effect.identifier), facts)
    rows = [_parameter_row(parameter) for parameter in effect.parameters]
    rows += [_exponent_row(exponent) for exponent in effect.shape]
    if rows:
        headings = ("parameter", "symbol", "prior (90 %)", "unit", "meaning")
        terminal.print_table(headings, rows)


def _parameter_row(parameter: "EffectParameter") -> tuple[str, ...]:
    """Return the cells of a parameter of an effect: name, symbol, prior, unit, meaning."""
    from discrepancy.report.text import unit_text

    prior = parameter.prior
    prior_text = f"{prior.low:g} to {prior.high:g}, {prior.shape.replace('_', '-')}"
    return (
        parameter.name,
        parameter.symbol,
        prior_text,
        unit_text(parameter.unit),
        in_one_line(parameter.description),
    )


def _exponent_row(exponent: "ShapeParameter") -> tuple[str, ...]:
    """Return the cells of an exponent of an effect's law.

    The effect itself has a fixed exponent (`canonical`); it is a free parameter only if the search
    tries other members of the family of the effect.
    """
    prior = exponent.prior
    prior_text = f"{exponent.canonical:g}; freed: {prior.low:g} to {prior.high:g}"
    description = in_one_line(exponent.description)
    return (exponent.name, exponent.symbol, prior_text, "", description)


def example(
    kind: Annotated[
        str,
        typer.Argument(
            show_default=False, help="static, ringdown, flight, laboratory or complete."
        ),
    ],
    out: Annotated[Path, typer.Argument(show_default=False, help="The folder to write.")],
    *,
    model: ModelOption = None,
    seed: Annotated[
        int,
        typer.Option(
            "--seed",
            min=0,
            max=LARGEST_SEED,
            help="Seed of noise, zeros, gains and releases.",
        ),
    ] = 0,
    effect: Annotated[
        list[str] | None,
        typer.Option(
            "--effect",
            metavar="ID[@PLACE][:NAME=VALUE,...]",
            autocompletion=complete_effect,
            help="Hide an effect; values of its parameters in the catalogue's order, else their "
            "prior medians. May be given several times.",
        ),
    ] = None,
) -> None:
    """Write a simulated campaign, with an effect hidden in it if asked for.

    Example: `uav-twin discrepancy example ringdown measured --effect coulomb_friction`
    """
    from discrepancy.model_choice import choose_model
    from discrepancy.sources.examples import example_campaign, usual_plan, write_example
    from fe.runtime.patch import ModelPatch

    refuse_filled(out, "folder")
    chosen_model = choose_model(model).model
    plan = usual_plan(chosen_model)
    patch = ModelPatch()
    if effect:
        plain_campaign = example_campaign(chosen_model, kind, seed, plan)  # type: ignore[arg-type]  # it checks
        for text in effect:
            patch = patch + _patch_of_hidden_effect(text, chosen_model, plain_campaign)
    campaign = write_example(chosen_model, out, kind, seed, plan, patch)  # type: ignore[arg-type]
    hidden = ", ".join(effect) if effect else "nothing"
    arguments = _shell_arguments(out, model)
    terminal.say(f"Wrote {out}: {_campaign_size(campaign)}; hidden: {hidden}.")
    terminal.say(f"Next: uav-twin discrepancy check {arguments}")
    terminal.say(f"Then: uav-twin discrepancy run {arguments}")


def _shell_arguments(campaign: Path, model: str | None) -> str:
    """Return a campaign and its model as the arguments of a further command."""
    model_option = [] if model is None else ["--model", model]
    return shlex.join([str(campaign), *model_option])


def _patch_of_hidden_effect(text: str, model: "Model", campaign: "Campaign") -> "ModelPatch":
    """Return the patch of an effect that is hidden in an example.

    Parameters
    ----------
    text : str
        The option: ID[@PLACE][:NAME=VALUE,...] or ID[@PLACE]=VALUE,... Parameters without a value
        have the one of `_usual_values`. Without a place the effect acts at its first place.
    model : Model
        The model of the example.
    campaign : Campaign
        The example without the effect.

    Raises
    ------
    CatalogueError
        If there is no such effect, place or parameter.
    """
    from discrepancy.catalogue.entry import Setting
    from discrepancy.catalogue.library import effect_by_identifier, load_catalogue

    # ID@PLACE stands before the colon; without a colon, before the first equals sign
    has_names = ":" in text
    effect_and_place, _, numbers = text.partition(":" if has_names else "=")
    identifier, at_sign, place = effect_and_place.partition("@")
    effect = effect_by_identifier(identifier, load_catalogue())
    setting = Setting(campaign, model, model.scales(campaign))
    reason = effect.unavailable(setting)
    if reason is not None:
        raise CatalogueError(f"{identifier} cannot be hidden in this example: {reason}")
    places = effect.places(setting)
    if at_sign and place not in places:
        known_places = ", ".join(repr(name) for name in places)
        raise CatalogueError(
            f"{identifier} cannot act at {place!r} here; its places are {known_places}."
        )
    values = _usual_values(effect)
    if numbers or has_names:
        values |= _parameter_values(text, identifier, numbers.split(","), list(values))
    return effect.patch(setting, values, place if at_sign else places[0])


def _usual_values(effect: "Effect") -> dict[str, float]:
    """Return a typical value of each parameter of an effect: the median of its prior.

    A magnitude that may have either sign has the median zero, with which the effect would be
    absent. It gets the value one standard deviation above the median instead.
    """
    values = {}
    for parameter in effect.parameters:
        median_value = parameter.prior.value(0.0)
        if parameter.magnitude and median_value == 0.0:
            values[parameter.name] = parameter.prior.value(1.0)
        else:
            values[parameter.name] = median_value
    return values


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
        The names of the parameters.

    Raises
    ------
    CatalogueError
        If there are too many values, a name is unknown, or a value is not a finite number.
    """
    if len(numbers) > len(names):
        raise CatalogueError(
            f"{identifier} has {counted(len(names), 'parameter')} ({comma_list(names)}), but "
            f"{counted(len(numbers), 'value')} were given."
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
        values[name or names[position]] = value  # a value without a name belongs to its position
    return values


def convert(
    out: Annotated[
        Path,
        typer.Argument(show_default=False, help="Folder to write the campaign to."),
    ],
    *,
    data: Annotated[
        Path,
        typer.Option("--data", show_default=False, help="The folder of the published data."),
    ],
    rig: Annotated[
        str,
        typer.Option("--rig", help="real_wing, falling_phone, two_tanks or pendulum."),
    ] = "real_wing",
) -> None:
    """Write published measurements as a campaign; of other rigs than the wing with `model.toml` beside it.

    Example: `uav-twin discrepancy convert measured --data published --rig two_tanks`
    """  # noqa: E501
    from discrepancy.campaign.reading import read_campaign
    from discrepancy.sources.measured_rigs import write_rig_campaign

    campaign = read_campaign(write_rig_campaign(rig, data, out))
    model_file = out / "model.toml"
    model_text = f", its model in {model_file}" if model_file.exists() else ""
    terminal.say(f"{campaign.name}: {counted(len(campaign.trials), 'trial')} in {out}{model_text}")
