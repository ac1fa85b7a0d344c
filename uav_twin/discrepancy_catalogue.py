"""`uav-twin discrepancy effects` and `example`: the catalogue, and a campaign to try."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from discrepancy.errors import CatalogueError
from reporting import terminal
from reporting.files import refuse_filled
from reporting.words import counted
from uav_twin.options import told
from uav_twin.sentences import said

if TYPE_CHECKING:
    from discrepancy.campaign.records import Campaign
    from discrepancy.catalogue.entry import Effect
    from discrepancy.models.interface import Model
    from discrepancy.sources.examples import ExamplePlan
    from fe.runtime.patch import ModelPatch


@told("discrepancy effects")
def effects(*, show: str | None = None, add: list[Path] | None = None) -> None:
    """List the effects that can be named."""
    from discrepancy.catalogue.library import effect_by_identifier, load_catalogue
    from discrepancy.report.text import formula

    catalogue = load_catalogue(add or ())
    if show is not None:
        _show(effect_by_identifier(show, catalogue))
        return
    rows = [(effect.identifier, effect.name, effect.family, formula(effect.equation)) for effect in catalogue]
    terminal.print_table(("id", "name", "family", "equation"), rows)
    terminal.say(f"{counted(len(catalogue), 'effect')}; --show ID tells everything about one.")


def _show(effect: "Effect") -> None:
    from rich.table import Table

    from discrepancy.report.text import formula, unit_text

    facts = Table(box=None, show_header=False)
    facts.add_column(no_wrap=True)
    facts.add_column(overflow="fold")
    for name, value in (
        ("id", effect.identifier),
        ("name", effect.name),
        ("family", effect.family),
        ("equation", formula(effect.equation)),
        ("signature", formula(effect.signature)),
        ("acts on", ", ".join(sorted(kind.value for kind in effect.acts_on))),
        ("confusable with", ", ".join(effect.confusable) or "nothing in general"),
        ("reference", effect.reference),
    ):
        facts.add_row(name, value)
    terminal.console().print(facts)
    rows = []
    for item in effect.parameters:
        prior = f"{item.prior.low:g} to {item.prior.high:g}, {item.prior.shape.replace('_', '-')}"
        rows.append((item.name, item.symbol, prior, unit_text(item.unit), item.description))
    for shape in effect.shape:
        freed = f"{shape.canonical:g}; freed: {shape.prior.low:g} to {shape.prior.high:g}"
        rows.append((shape.name, shape.symbol, freed, "", shape.description))
    headings = ("parameter", "symbol", "prior (90 %)", "unit", "meaning")
    terminal.print_table(headings, rows)


@told("discrepancy example")
def example(
    kind: str, out: Path, *, model: str | None = None, seed: int = 0, effect: list[str] | None = None
) -> None:
    """Write a simulated campaign, with an effect hidden in it if asked for."""
    from discrepancy.model_choice import choose_model
    from discrepancy.sources.examples import plan_of, write_example
    from fe.runtime.patch import ModelPatch

    refuse_filled(out, "folder")
    choice = choose_model(model, terminal.progress())
    plan = plan_of(choice.model)
    patch = ModelPatch()
    if effect:
        bare = _bare(choice.model, kind, seed, plan)
        for text in effect:
            patch = patch + _hidden(text, choice.model, bare)
    campaign = write_example(choice.model, out, kind, seed, plan, patch)  # type: ignore[arg-type]
    hidden = ", ".join(effect) if effect else "nothing"
    named = "" if model is None else f" --model {shlex.quote(model)}"
    terminal.say(
        f"Wrote {out}: {counted(len(campaign.trials), 'trial')}, "
        f"{counted(len(campaign.channels), 'channel')}; hidden: {hidden}."
    )
    terminal.say(f"Next: uav-twin discrepancy check {shlex.quote(str(out))}{named}")
    terminal.say(f"Then: uav-twin discrepancy run {shlex.quote(str(out))}{named}")


def _bare(model: "Model", kind: str, seed: int, plan: "ExamplePlan") -> "Campaign":
    from discrepancy.sources.examples import example_campaign

    return example_campaign(model, kind, seed, plan)  # type: ignore[arg-type]


def _hidden(text: str, model: "Model", campaign: "Campaign") -> "ModelPatch":
    """Return the patch of ID[@PLACE][:NAME=VALUE,...] or ID[@PLACE]=VALUE,..; raises `CatalogueError`."""
    from discrepancy.catalogue.entry import Setting
    from discrepancy.catalogue.library import effect_by_identifier, load_catalogue

    head, named, numbers = text.partition(":")
    if not named:
        head, _, numbers = text.partition("=")
    identifier, at, place = head.partition("@")
    found = effect_by_identifier(identifier, load_catalogue())
    setting = Setting(campaign, model, model.scales(campaign))
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


def _values(text: str, identifier: str, parts: list[str], names: list[str]) -> dict[str, float]:
    """Return the values that `parts` give, "VALUE" in the order of `names` or "NAME=VALUE"."""
    if len(parts) > len(names):
        both = {"has": counted(len(names), "parameter"), "came": counted(len(parts), "value")}
        raise CatalogueError(said("effects.count", identifier=identifier, names=names, **both))
    values = {}
    for position, part in enumerate(parts):
        name, equals, number = part.rpartition("=")
        if equals and name not in names:
            raise CatalogueError(f"{identifier} has no parameter {name!r}; it has {', '.join(names)}.")
        try:
            values[name or names[position]] = float(number)
        except ValueError:
            example = {"identifier": identifier, "name": names[0]}
            raise CatalogueError(said("effects.numbers", text=text, **example)) from None
    return values


@told("discrepancy convert")
def convert(out: Path, *, data: Path, rig: str = "real_wing") -> None:
    """Write published measurements as a campaign; of other rigs than the wing with `model.toml` beside it."""
    from discrepancy.campaign.reading import read_campaign
    from discrepancy.sources.measured_rigs import THE_WING, write_rig_campaign, write_wing_campaign

    if rig != THE_WING:
        made = read_campaign(write_rig_campaign(rig, data, out))
        terminal.say(
            f"{made.name}: {counted(len(made.trials), 'trial')} in {out}, its model in {out / 'model.toml'}"
        )
        return
    campaign = write_wing_campaign(data, out)
    terminal.say(f"{campaign.name}: {counted(len(campaign.trials), 'trial')} in {out}")
