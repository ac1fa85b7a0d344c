"""`uav-twin structure suspects`: what a planned measurement would tell apart."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from reporting import terminal
from reporting.progress import stage
from reporting.terminal import JsonOption
from reporting.words import capital, listing, number
from uav_twin.options import StructureArgument
from uav_twin.structure import find_structure

if TYPE_CHECKING:
    from discrepancy.judgement.separability import Detectability
    from discrepancy.planned_measurement import LookAlikes, Plan

LEAST_CERTAINTY = 0.75
"""Certainty from which a measurement is said to tell two suspicions apart."""


def suspects(
    file: StructureArgument,
    *,
    strain_noise: Annotated[
        float,
        typer.Option(min=1e-9, help="Standard deviation of strain readings, in microstrain."),
    ] = 1.0,
    displacement_noise: Annotated[
        float, typer.Option(min=1e-12, help="Standard deviation of displacement readings, in mm.")
    ] = 1e-3,
    acceleration_noise: Annotated[
        float, typer.Option(min=1e-12, help="Standard deviation of accelerations, in m/s2.")
    ] = 0.01,
    gain: Annotated[
        float, typer.Option(min=0.0, help="Standard deviation of gain errors, in %.")
    ] = 1.0,
    json: JsonOption = False,
) -> None:
    """Print which faults the planned gauges of a structure could tell apart.

    The faults are yielding supports and interfaces, masses, losses of stiffness, displaced or
    turned loads, turned gauges and wrong gains, first under static loads alone and then with
    releases, too. Of those that look alike it says which further measurement tells them apart.

    Example: `uav-twin structure suspects arm.toml --strain-noise 2`
    """
    from discrepancy.campaign.records import Quantity
    from discrepancy.catalogue.library import library
    from discrepancy.planned_measurement import (
        PlannedMeasurement,
        Precision,
        load_plannable_structure,
    )

    noise = {
        Quantity.STRAIN: 1e-6 * strain_noise,
        Quantity.DISPLACEMENT: 1e-3 * displacement_noise,
        Quantity.ACCELERATION: acceleration_noise,
    }
    model = load_plannable_structure(find_structure(file))
    with stage("What the planned measurement can decide"):
        measurement = PlannedMeasurement(model, Precision(noise, 0.01 * gain), library())
    with stage("Which measurement would decide more"):
        look_alikes = [
            measurement.look_alikes(confusion, plan) for confusion, plan in measurement.confusions
        ]
    rows = _rows(measurement.static, measurement.with_releases)
    if json:
        pairs = [_record_of_pair(pair) for pair in look_alikes]
        terminal.print_json({"suspicions": rows, "look_alikes": pairs})
        return
    terminal.print_table(
        (
            "suspicion",
            "most visible at",
            "least size by static loads",
            "looks like, by static loads",
            "looks like, with releases",
        ),
        [list(row.values()) for row in rows],
    )
    for pair in look_alikes:
        terminal.say(_sentence_on_pair(pair))
    if look_alikes:
        terminal.say(
            "In brackets: the probability that the right one of both is then the more probable "
            "one; 0.5 is a guess."
        )


def _record_of_pair(pair: "LookAlikes") -> dict[str, Any]:
    """Return the record of two suspicions that look alike, with what would tell them apart."""
    return {
        "suspicions": [term.effect.name for term in pair.terms],
        "places": [term.place for term in pair.terms],
        "measurements": [
            {
                "measurement": remedy.description,
                "certainty": remedy.worth.certainty,
                "information_nat": remedy.worth.information,
            }
            for remedy in pair.remedies
        ],
    }


def _sentence_on_pair(pair: "LookAlikes") -> str:
    """Return the sentence on two suspicions that look alike and what would tell them apart."""
    names = listing(f"{term.effect.name} ({term.place})" for term in pair.terms)
    texts = [
        f"{remedy.description} ({remedy.worth.certainty:.2f})"
        for remedy in pair.remedies
        if remedy.worth.certainty >= LEAST_CERTAINTY
    ]
    if not texts:
        best = pair.remedies[0]
        return (
            f"{capital(names)} look alike, and no single measurement here tells them apart: the "
            f"best is {best.description} ({best.worth.certainty:.2f})."
        )
    return f"{capital(names)} look alike; {listing(texts, joint='or')} tells them apart."


def _rows(static: "Plan", with_releases: "Plan") -> list[dict[str, str]]:
    """Return a row for each suspicion: its place, the smallest visible size, and look-alikes.

    The first plan has static loads alone, the second one releases as well. The smallest size is
    that under static loads; a suspicion that these cannot show "needs a release".
    """
    rows = []
    for at_rest, released in zip(
        static.separability.detectability, with_releases.separability.detectability, strict=True
    ):
        if at_rest.reason and released.reason:
            continue  # the structure has no place for it
        shown = released if at_rest.reason else at_rest
        rows.append(
            {
                "suspicion": shown.effect.name,
                "place": shown.place,
                "least_size": "needs a release" if at_rest.reason else _least_size(static, at_rest),
                "alike_static": "" if at_rest.reason else _look_alikes(static, at_rest),
                "alike_with_releases": _look_alikes(with_releases, released),
            }
        )
    return rows


def _look_alikes(plan: "Plan", detectability: "Detectability") -> str:
    """Return the suspicions that change the planned readings in the same way as this one."""
    from discrepancy.report.decidability_text import confused_effects

    names = {row.effect.identifier: row.effect.name for row in plan.separability.detectability}
    alike = confused_effects(plan.separability, detectability.effect.identifier)
    return listing([names[name] for name in alike]) or "nothing else"


def _least_size(plan: "Plan", detectability: "Detectability") -> str:
    """Return the smallest size of a suspicion that a plan shows, with its unit."""
    from discrepancy.files.verdict import primitive_intervals
    from fe.runtime.patch import InterfaceCompliance, SupportCompliance

    patch = plan.least_change(detectability)
    if patch is None:
        return "never seen"
    (change, *_) = patch
    if isinstance(change, SupportCompliance | InterfaceCompliance):
        unit = "N m/rad" if change.motion.startswith("r") else "N/m"
        return f"a spring of {_two_digits(1.0 / change.compliance)} {unit}"
    size = next(size for size in primitive_intervals(patch) if size.value != 0.0)
    if size.unit == "1":
        return f"{_two_digits(100.0 * size.value)} %"
    return f"{_two_digits(size.value)} {size.unit}"


def _two_digits(value: float) -> str:
    """Return a number with two digits."""
    return number(float(f"{value:.2g}"))
