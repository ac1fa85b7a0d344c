"""`uav-twin discrepancy effects`, `example`, `convert` and `apply`: the catalogue at work."""

import shlex
from pathlib import Path

from discrepancy.errors import CatalogueError
from reporting import terminal
from reporting.files import refuse_filled
from reporting.words import counted
from uav_twin import parts
from uav_twin.options import show as print_record
from uav_twin.sentences import said


def effects(*, show: str | None = None, add: list[Path] | None = None) -> None:
    """List the effects that can be named."""
    catalogue = parts.load_catalogue(add or ())
    if show is None:
        print_record("effects", effects=catalogue, formula=parts.formula)
    else:
        _show(parts.effect_by_identifier(show, catalogue))


def _show(effect: "parts.Effect") -> None:
    from rich.table import Table

    facts = Table(box=None, show_header=False)
    facts.add_column(no_wrap=True)
    facts.add_column(overflow="fold")
    for name, value in (
        ("id", effect.identifier),
        ("name", effect.name),
        ("family", effect.family),
        ("equation", parts.formula(effect.equation)),
        ("signature", parts.formula(effect.signature)),
        ("acts on", ", ".join(sorted(kind.value for kind in effect.acts_on))),
        ("confusable with", ", ".join(effect.confusable) or "nothing in general"),
        ("reference", effect.reference),
    ):
        facts.add_row(name, value)
    terminal.console().print(facts)
    print_record("effect", effect=effect, unit_text=parts.unit_text)


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
    print_record("example", out=out, campaign=campaign, hidden=hidden, given=words_of(out, model))


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
            values[name or names[position]] = float(number)
        except ValueError:
            example = {"identifier": identifier, "name": names[0]}
            raise CatalogueError(said("effects.numbers", text=text, **example)) from None
    return values


def convert(out: Path, *, data: Path, rig: str = "real_wing") -> None:
    """Write published measurements as a campaign; of other rigs than the wing with `model.toml` beside it."""
    campaign = parts.read_campaign(parts.write_rig_campaign(rig, data, out))
    print_record("convert", campaign=campaign, out=out, modelled=(out / "model.toml").exists())


def apply(
    verdict: Path, *, out: Path | None = None, member: str | None = None, replace: bool = False
) -> None:
    """Write the model with the effect that was found and the parameters beside it."""
    print_record("apply", done=parts.apply_verdict(verdict, out, member=member, replace=replace))
