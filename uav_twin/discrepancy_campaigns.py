"""`uav-twin discrepancy effects`, `example` and `convert`: the catalogue, and campaigns to try."""

import shlex
from math import isfinite, nan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from discrepancy.errors import CatalogueError
from reporting import terminal
from reporting.files import refuse_filled
from reporting.terminal import LARGEST_SEED
from reporting.words import comma_list, counted, in_one_line
from uav_twin.options import EffectFilesOption, ModelOption, complete_effect

if TYPE_CHECKING:
    from discrepancy.campaign.records import Campaign
    from discrepancy.catalogue.entry import Effect, EffectParameter, ShapeParameter
    from discrepancy.system.interface import Model
    from fe.runtime.patch import ModelPatch


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
    """List the effects that a verdict can name.

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

    The effect itself has a fixed exponent (`canonical`); the search varies it only to try other
    members of the family.
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
    arguments = shell_arguments(out, model)
    terminal.say(f"Wrote {out}: {campaign_size(campaign)}; hidden: {hidden}.")
    terminal.say(f"Next: uav-twin discrepancy check {arguments}")
    terminal.say(f"Then: uav-twin discrepancy run {arguments}")


def campaign_size(campaign: "Campaign") -> str:
    """Return the number of trials and channels of a campaign as a text."""
    trials = counted(len(campaign.trials), "trial")
    return f"{trials}, {counted(len(campaign.channels), 'channel')}"


def shell_arguments(campaign: Path, model: str | None) -> str:
    """Return a campaign and its model as arguments of a further command."""
    model_option = [] if model is None else ["--model", model]
    return shlex.join([str(campaign), *model_option])


def _patch_of_hidden_effect(text: str, model: "Model", campaign: "Campaign") -> "ModelPatch":
    """Return the patch of the effect that an option hides in an example.

    The option is ID[@PLACE][:NAME=VALUE,...] or ID[@PLACE]=VALUE,... Without a place, the effect
    acts at the first place it has; parameters without a value have that of `_usual_values`. A
    `CatalogueError` is raised if there is no such effect, place or parameter.
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

    A magnitude that may have either sign has the median zero, without effect; the value one
    standard deviation above it is returned instead.
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
    """Read the values of an effect's parameters from the option `text`; return them by name.

    Each of `numbers` is "VALUE", in the order of `names`, or "NAME=VALUE". A `CatalogueError` is
    raised if there are too many, if a name is unknown, or if a value is not a finite number.
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
