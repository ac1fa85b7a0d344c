"""`uav-twin discrepancy check`: what a campaign can decide, before anything is fitted."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from reporting import terminal
from reporting.progress import stage
from uav_twin import parts
from uav_twin.options import refused, show


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
        show("check", words=WORDS, able=able, **given)
    if able is None:
        raise refused("Mend the faults first: conclusions from these data would be wrong.")


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
