"""`uav-twin structure suspects`: what a planned measurement would tell apart."""

from typing import TYPE_CHECKING, Annotated

import typer

from reporting import terminal
from reporting.progress import stage
from reporting.terminal import JsonOption
from reporting.words import listing, number
from uav_twin.options import StructureArgument
from uav_twin.structure import find_structure

if TYPE_CHECKING:
    from discrepancy.judgement.separability import Detectability
    from discrepancy.planned_measurement import Plan


def suspects(
    file: StructureArgument,
    *,
    strain_noise: Annotated[
        float, typer.Option(min=1e-9, help="Standard deviation of a strain reading [microstrain].")
    ] = 1.0,
    displacement_noise: Annotated[
        float, typer.Option(min=1e-12, help="Standard deviation of a displacement reading [mm].")
    ] = 1e-3,
    acceleration_noise: Annotated[
        float, typer.Option(min=1e-12, help="Standard deviation of an acceleration [m/s2].")
    ] = 0.01,
    gain: Annotated[
        float, typer.Option(min=0.0, help="Standard deviation of a gain's error [%].")
    ] = 1.0,
    json: JsonOption = False,
) -> None:
    """Print which faults the planned gauges of a structure could tell apart.

    The faults are yielding supports, masses, losses of stiffness, displaced or turned loads, turned
    gauges and wrong gains, first under static loads alone and then with releases, too.

    Example: `uav-twin structure suspects arm.toml --strain-noise 2`
    """
    from discrepancy.campaign.records import Quantity
    from discrepancy.catalogue.library import library
    from discrepancy.planned_measurement import Precision, plans_of
    from discrepancy.system.structures import StructureModel
    from fe.reduction.model_cache import changeable_model

    noise = {
        Quantity.STRAIN: 1e-6 * strain_noise,
        Quantity.DISPLACEMENT: 1e-3 * displacement_noise,
        Quantity.ACCELERATION: acceleration_noise,
    }
    model = StructureModel(changeable_model(find_structure(file)))
    with stage("What the planned measurement can decide"):
        static, with_releases = plans_of(model, Precision(noise, 0.01 * gain), library())
    rows = _rows(static, with_releases)
    if json:
        terminal.print_json({"suspicions": rows})
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


def _rows(static: "Plan", with_releases: "Plan") -> list[dict[str, str]]:
    """Return a row for each suspicion: its place, the smallest visible size, and look-alikes.

    The first plan has static loads alone, the second one releases as well. The smallest size is
    that under static loads; a suspicion that these cannot show "needs a release".
    """
    rows = []
    for at_rest, released in zip(
        static.separability.detectability, with_releases.separability.detectability, strict=True
    ):
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
    from fe.runtime.patch import SupportCompliance

    patch = plan.least_change(detectability)
    if patch is None:
        return "never seen"
    (change, *_) = patch
    if isinstance(change, SupportCompliance):
        unit = "N/m" if change.motion in "xyz" else "N m/rad"
        return f"a spring of {_two_digits(1.0 / change.compliance)} {unit}"
    size = next(size for size in primitive_intervals(patch) if size.value != 0.0)
    if size.unit == "1":
        return f"{_two_digits(100.0 * size.value)} %"
    return f"{_two_digits(size.value)} {size.unit}"


def _two_digits(value: float) -> str:
    """Return a number with two digits."""
    return number(float(f"{value:.2g}"))
