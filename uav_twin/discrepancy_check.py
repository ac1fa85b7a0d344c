"""`uav-twin discrepancy check`: what a campaign can decide, before anything is fitted."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from reporting import terminal
from uav_twin.options import show, told

if TYPE_CHECKING:
    from discrepancy.campaign.records import Campaign
    from discrepancy.checks.fault import DataFault
    from discrepancy.judgement.separability import Separability


@told("discrepancy check")
def check(
    campaign: Path, *, model: str | None = None, effects: list[Path] | None = None, json: bool = False
) -> None:
    """Say what is wrong with the data, which effects they can show, and which they cannot tell apart."""
    from discrepancy.campaign.reading import read_campaign
    from discrepancy.catalogue.entry import Setting
    from discrepancy.catalogue.library import load_catalogue
    from discrepancy.judgement.separability import separability
    from discrepancy.model_choice import choose_model
    from discrepancy.report.check_tables import group_lines, needs, neighbours, seen_of
    from discrepancy.report.text import WORDS
    from discrepancy.workflow import checked

    data = read_campaign(campaign)
    catalogue = load_catalogue(effects or ())
    progress = terminal.progress()
    choice = choose_model(model, progress)
    data, faults = checked(data, choice.model)
    able = None
    if not any(fault.fatal for fault in faults):
        with progress.stage("What this campaign can decide"):
            able = separability(
                data, choice.model, Setting(data, choice.model, choice.model.scales(data)), catalogue
            )
    if json:
        terminal.print_json(_record(data, choice.model.name, faults, able))
    else:
        of_able = {item.__name__: item for item in (seen_of, neighbours, group_lines, needs)}
        given = {"data": data, "model": choice.model, "faults": faults, "catalogue": catalogue}
        show("check", words=WORDS, able=able, **given, **of_able)
    if able is None:
        typer.secho("Mend the faults first: conclusions from these data would be wrong.", fg="red", err=True)
        raise typer.Exit(1)


def _record(
    data: "Campaign", model: str, faults: "Sequence[DataFault]", able: "Separability | None"
) -> dict[str, Any]:
    """Return faults and what the campaign can decide as plain data; a size that is never seen is null."""
    return {
        "campaign": data.name,
        "model": model,
        "trials": [{"name": trial.name, "held_out": trial.held_out} for trial in data.trials],
        "channels": list(data.channels),
        "passed": able is not None,
        "faults": [
            {"kind": fault.kind.value, "fatal": fault.fatal, "sentence": fault.sentence,
             "channel": fault.channel, "trial": fault.trial}
            for fault in faults
        ],
        "remarks": list(data.remarks),
        "effects": [] if able is None else [
            {"effect": item.effect.identifier, "testable": not item.reason, "reason": item.reason,
             "place": item.place, "parameter": item.parameter, "detectable_from": item.detectable,
             "prior_median": item.typical, "unit": item.unit}
            for item in able.detectability
        ],
        "confusion_groups": [] if able is None else [list(group) for group in able.groups],
    }  # fmt: skip
