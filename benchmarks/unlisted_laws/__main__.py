"""Verdicts on laws that the catalogue lacks: `python -m benchmarks.unlisted_laws DIR --seed S`.

One mass of 2 kg on a spring of 800 N/m hides a law of each of ten kinds, of which the catalogue has
none (`kinds`). Five kinds are forces, two are stiffnesses that change in time, three are errors of
actuators or sensors. The rig is simulated by equations written out here and a general integrator,
not by what is judged. Each law changes the readings by 5 to 40 times the noise beyond what
calibration, releases and zeros can explain.

No name of the catalogue is right. A verdict with a name (named, named in part, family, group) has
the right dependence if one of its effects depends on the same variable as the law, also if others
stand beside it, and is a false name otherwise; `kinds` has the effects and the reasons. A line for
each campaign, then the counts; everything goes to DIR/seed-S.json.
"""

import argparse
import json
import math
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from benchmarks.unlisted_laws.campaigns import drawn, write
from benchmarks.unlisted_laws.kinds import KINDS, Kind
from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.force_curve import IDENTIFIERS
from discrepancy.catalogue.library import library
from discrepancy.errors import DiscrepancyError
from discrepancy.missing_force.port_force import missing_force
from discrepancy.verdict import NamedEffect, Verdict, VerdictKind, effect_label
from discrepancy.workflow import Investigation, investigate

NAMING = (
    VerdictKind.NAMED,
    VerdictKind.NAMED_IN_PART,
    VerdictKind.FAMILY,
    VerdictKind.GROUP,
)
"""Verdicts with a name."""
NEARLY_CERTAIN = 0.999
"""Probability above which false names are listed."""


def judge(out: Path, seed: int, name: str) -> dict[str, Any]:
    """Make the campaign of a kind, search what it lacks and return truth and verdict."""
    experiment = drawn(name, seed)
    folder = out / f"seed-{seed}" / name.replace(" ", "-")
    shutil.rmtree(folder, ignore_errors=True)
    write(folder, experiment, seed)
    facts = {"kind": name, "seed": seed, "gap": experiment.gap, "truth": asdict(experiment.truth)}
    began = time.process_time()
    try:
        investigation = investigate(
            read_campaign(folder), folder / "model.toml", library(), thorough=False
        )
    except DiscrepancyError as error:
        seconds = time.process_time() - began
        return facts | error_row(error) | {"seconds": seconds}
    seconds = time.process_time() - began
    followed = followed_variables(investigation)
    return (
        facts | verdict_row(experiment.kind, investigation.verdict, followed) | {"seconds": seconds}
    )


def followed_variables(investigation: Investigation) -> tuple[str, ...]:
    """Return the variables that the missing force follows, as a sentence without a name tells."""
    search = investigation.search.force_search if investigation.search else None
    missing = missing_force(search, search.best_port_estimate) if search else None
    return missing.at_port.ordered_by if missing else ()


def error_row(error: DiscrepancyError) -> dict[str, Any]:
    """Return what a search without a verdict contributes to the row of a campaign."""
    return {
        "verdict": "error",
        "effects": [],
        "right": [],
        "family": "",
        "probability": None,
        "follows": [],
        "outcome": "no name",
        "hypotheses": [],
        "sentence": str(error),
    }


def verdict_row(kind: Kind, verdict: Verdict, followed: tuple[str, ...]) -> dict[str, Any]:
    """Return a verdict on a campaign, the variables that the force follows, and its outcome."""
    effects = [
        effect_label(effect.identifier, effect.place, free_shape=bool(effect.shape))
        for effect in verdict.effects
    ]
    right = [
        label
        for label, effect in zip(effects, verdict.effects, strict=True)
        if has_right_dependence(kind, effect)
    ]
    hypotheses = [
        [list(hypothesis.labels), hypothesis.log_evidence] for hypothesis in verdict.hypotheses[:6]
    ]
    return {
        "verdict": verdict.kind.value,
        "effects": effects,
        "family": verdict.family,
        "probability": None if math.isnan(verdict.probability) else verdict.probability,
        "right": right,
        "follows": list(followed),
        "outcome": outcome_of(
            verdict.kind,
            is_right=bool(right),
            follows_right=bool(followed)
            and all(name.startswith(kind.variables) for name in followed),
        ),
        "hypotheses": hypotheses,
        "sentence": verdict.sentence,
    }


def has_right_dependence(kind: Kind, effect: NamedEffect) -> bool:
    """Return whether an effect of a verdict depends on the same variable as the law of a kind.

    An effect with a fitted shape stands for its family, and a curve for what it runs over.
    """
    for variable, identifier in IDENTIFIERS.items():
        if effect.identifier == identifier:
            return kind.variables == (variable,)
    if effect.shape:
        return effect.family in kind.families
    return effect_label(effect.identifier, effect.place) in kind.effects


def outcome_of(verdict: VerdictKind, *, is_right: bool, follows_right: bool) -> str:
    """Return "dependence" if that is right, "false name", or "no name".

    The dependence is right if that of one of the names is, or without a name, if the missing force
    is said to follow the right variable.
    """
    if verdict not in NAMING:
        return "dependence" if follows_right else "no name"
    return "dependence" if is_right else "false name"


def line_of(row: Mapping[str, Any]) -> str:
    """Return the line that is printed for a campaign."""
    probability = "-" if row["probability"] is None else f"{row['probability']:.5f}"
    explanation = ", ".join(row["effects"]) or f"follows {' and '.join(row['follows'])}"
    return (
        f"{row['kind']:19s} gap {row['gap']:4.1f}  {row['verdict']:14s} "
        f"{explanation:40s} P {probability:7s} "
        f"family {row['family'] or '-'}  {row['outcome'].upper():10s} "
        f"{row['seconds']:4.0f} s  {row['sentence']}"
    )


def print_counts(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print how many names are false, how many have the right dependence, and the false ones."""
    false_names = [row for row in rows if row["outcome"] == "false name"]
    right = [row for row in rows if row["outcome"] == "dependence"]
    with_others = sum(len(row["right"]) < len(row["effects"]) for row in right)
    without_name = sum(not row["effects"] for row in right)
    print(f"false names: {len(false_names)} of {len(rows)}")
    print(
        f"dependence right: {len(right)} of {len(rows)}, {with_others} with other names beside, "
        f"{without_name} without a name"
    )
    for row in false_names:
        if row["probability"] is not None and row["probability"] > NEARLY_CERTAIN:
            print(
                f"false and above {NEARLY_CERTAIN}: {row['kind']} as {', '.join(row['effects'])}, "
                f"{row['probability']:.6f}"
            )


def main() -> None:
    """Make the campaigns, search, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--only", type=int, nargs="*", help="numbers of kinds from 0, instead of all ten"
    )
    arguments = parser.parse_args()
    names = list(KINDS)
    rows = []
    with threadpool_limits(1):
        for number in arguments.only or range(len(names)):
            rows.append(judge(arguments.out, arguments.seed, names[number]))
            print(f"{number} {line_of(rows[-1])}", flush=True)
            (arguments.out / f"seed-{arguments.seed}.json").write_text(
                json.dumps(rows, indent=1) + "\n", "utf-8"
            )
    print_counts(rows)


if __name__ == "__main__":
    main()
