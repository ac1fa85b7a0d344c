"""Apply verdicts and search again: `python -m benchmarks.applied_again DIR [--only N ...]`.

Ten campaigns each hide one effect of the catalogue and nothing else. Seven are made on the open
rigs by the equations and the general integrator of `benchmarks.open_rigs`, three are examples of
the shipped lumped models. Of each campaign the first search gives a verdict, `apply_verdict` writes
the model with what was found, and the second search compares the same records with that model. It
should find that nothing is missing, and the calibrated parameters of both searches should agree
within one standard deviation. A line for each campaign, then the count; all figures go to
DIR/applied_again.json.
"""

import argparse
import json
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.open_rigs.campaigns import drawn, write
from discrepancy.application import apply_verdict
from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import Campaign
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import library
from discrepancy.document import Origin
from discrepancy.errors import DiscrepancyError
from discrepancy.model_choice import ModelChoice, choose_model
from discrepancy.report.figures import ReportInput
from discrepancy.sources.examples import ExampleKind, example_campaign, usual_plan, write_example
from discrepancy.verdict import CalibratedParameter, VerdictKind
from discrepancy.verdict_folder import write_verdict_folder
from discrepancy.workflow import Investigation, investigate
from reporting.provenance import collect_provenance

OPEN_RIG_CAMPAIGNS = 7
"""Number of campaigns on open rigs; the examples follow them."""
NAMED = (VerdictKind.NAMED, VerdictKind.NAMED_IN_PART)
"""Verdicts whose effects are applied."""


@dataclass(frozen=True)
class HiddenExample:
    """An example of a shipped model that hides an effect.

    Attributes
    ----------
    model : str
        Name of the model.
    kind : str
        Kind of the campaign.
    effect, place : str
        Identifier of the effect, and its place.
    values : dict of str to float
        Values of its parameters.
    """

    model: str
    kind: ExampleKind
    effect: str
    place: str
    values: dict[str, float]


EXAMPLES = (
    HiddenExample(
        "single_mass_rig",
        "ringdown",
        "quadratic_damping",
        "slide",
        {"equivalent_damping_ratio": 0.01},
    ),
    HiddenExample(
        "single_mass_rig", "laboratory", "coulomb_friction", "slide", {"friction_ratio": 0.01}
    ),
    HiddenExample(
        "three_mass_chain", "ringdown", "coulomb_friction", "joint", {"friction_ratio": 0.004}
    ),
)


@dataclass(frozen=True)
class HiddenCase:
    """A campaign on disk, its model, and the effect that it hides.

    Attributes
    ----------
    folder : Path
        Folder of the campaign.
    model : str
        File or name of the model that lacks the effect.
    rig, effect : str
        The rig, and the identifier of the hidden effect.
    """

    folder: Path
    model: str
    rig: str
    effect: str


def write_case(out: Path, number: int, seed: int) -> HiddenCase:
    """Write the campaign of a number, and return where it is and what it hides.

    Parameters
    ----------
    out : Path
        Folder of all campaigns.
    number : int
        Number of the campaign: those on open rigs first, then the examples.
    seed : int
        Seed of the set of campaigns.
    """
    folder = out / f"case_{number:02d}"
    shutil.rmtree(folder, ignore_errors=True)
    if number < OPEN_RIG_CAMPAIGNS:
        bench, truth, facts = drawn(number, seed)
        alone = replace(truth, disturbance="", amount=0.0)
        write(folder / "campaign", bench, alone, "plain", (seed, number))
        model = folder / "campaign" / "model.toml"
        return HiddenCase(folder / "campaign", str(model), facts["rig"], facts["identifiers"][0])
    example = EXAMPLES[number - OPEN_RIG_CAMPAIGNS]
    model_of_example = choose_model(example.model).model
    plan = usual_plan(model_of_example)
    bare = example_campaign(model_of_example, example.kind, seed, plan)
    setting = Setting(bare, model_of_example, model_of_example.scales(bare))
    (effect,) = (entry for entry in library() if entry.identifier == example.effect)
    patch = effect.patch(setting, example.values, example.place)
    write_example(model_of_example, folder / "campaign", example.kind, seed, plan, patch)
    return HiddenCase(folder / "campaign", example.model, example.model, example.effect)


def search_and_write(
    campaign: Campaign, campaign_folder: Path, choice: ModelChoice, folder: Path
) -> Investigation:
    """Investigate a campaign with a model, write the folder of the verdict, and return the results.

    Parameters
    ----------
    campaign : Campaign
        The campaign.
    campaign_folder : Path
        The folder that it was read from.
    choice : ModelChoice
        The model.
    folder : Path
        The folder of the verdict.
    """
    investigation = investigate(campaign, choice.model, library(), thorough=False)
    origin = Origin(
        campaign=campaign.name,
        model=choice.model.name,
        data_hash=campaign.data_hash,
        model_hash=choice.source_hash,
        command=f"uav-twin discrepancy run {campaign_folder} --model {choice.file} --seed 0",
        provenance=collect_provenance(0),
        model_file=choice.file,
    )
    write_verdict_folder(folder, ReportInput(investigation, origin), report=False, replace_it=True)
    return investigation


def largest_shift(
    first: tuple[CalibratedParameter, ...], second: tuple[CalibratedParameter, ...]
) -> float:
    """Return the largest change of a calibrated parameter, in deviations of its first value."""
    shifts = [
        abs(after.mean - before.mean) / before.deviation
        for before, after in zip(first, second, strict=True)
        if before.deviation > 0.0
    ]
    return float(max(shifts, default=0.0))


def judge(out: Path, number: int, seed: int) -> dict[str, Any]:
    """Search, apply and search again, and return the figures of both verdicts."""
    case = write_case(out, number, seed)
    campaign = read_campaign(case.folder)
    row: dict[str, Any] = {"number": number, "rig": case.rig, "hidden": case.effect}
    began = time.process_time()
    first = search_and_write(
        campaign, case.folder, choose_model(case.model), case.folder.parent / "verdict"
    )
    row |= {
        "first": first.verdict.kind.value,
        "effects": sorted(effect.identifier for effect in first.verdict.effects),
        "first_sentence": first.verdict.sentence,
        "first_seconds": time.process_time() - began,
    }
    if first.verdict.kind not in NAMED:
        return row
    try:
        applied = apply_verdict(
            case.folder.parent / "verdict", case.folder.parent / "patched.json", replace=True
        )
    except DiscrepancyError as error:
        return row | {"second": "not applied", "second_sentence": str(error)}
    began = time.process_time()
    second = search_and_write(
        campaign, case.folder, choose_model(applied.path), case.folder.parent / "verdict_again"
    )
    samples = 1.0 if second.problem is None else float(np.sum(second.problem.sample_counts))
    chi_square = float("nan") if second.search is None else second.search.no_effect.chi_square
    return row | {
        "second": second.verdict.kind.value,
        "second_effects": sorted(effect.identifier for effect in second.verdict.effects),
        "second_sentence": second.verdict.sentence,
        "chi_square_per_sample": chi_square / samples,
        "shift": largest_shift(first.verdict.parameters, second.verdict.parameters),
        "second_seconds": time.process_time() - began,
    }


def is_confirmed(row: dict[str, Any]) -> bool:
    """Return whether the second search found nothing missing, with the parameters of the first."""
    nothing = row.get("second") == VerdictKind.NOTHING_MISSING.value
    return nothing and row["shift"] <= 1.0


def described(row: dict[str, Any]) -> str:
    """Return the figures of a campaign as a line."""
    line = (
        f"{row['number']:2d} {row['rig']:15s} {row['hidden']:22s} {row['first']:14s} "
        f"{'+'.join(row['effects']):24s} {row['first_seconds']:4.0f} s"
    )
    if "second_seconds" not in row:
        return f"{line}  {row.get('second_sentence', row['first_sentence'])}"
    return (
        f"{line} -> {row['second']:16s} chi2 {row['chi_square_per_sample']:6.3f} "
        f"shift {row['shift']:5.2f} {row['second_seconds']:4.0f} s"
    )


def numbers_to_judge(arguments: argparse.Namespace) -> Iterator[int]:
    """Yield the numbers of the campaigns that the command line asks for."""
    yield from arguments.only or range(OPEN_RIG_CAMPAIGNS + len(EXAMPLES))


def main() -> None:
    """Judge all campaigns, print a line for each and the count."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", type=int, nargs="*", help="numbers of campaigns, instead of all")
    parser.add_argument("--seed", type=int, default=7)
    arguments = parser.parse_args()
    rows = []
    with threadpool_limits(1):
        for number in numbers_to_judge(arguments):
            row = judge(arguments.out, number, arguments.seed)
            rows.append(row)
            print(described(row), flush=True)
            file = arguments.out / "applied_again.json"
            file.write_text(json.dumps(rows, indent=1) + "\n", "utf-8")
    named = [row for row in rows if row["first"] in {kind.value for kind in NAMED}]
    confirmed = sum(is_confirmed(row) for row in named)
    print(f"nothing missing, and parameters within a deviation: {confirmed} of {len(named)} named")


if __name__ == "__main__":
    main()
