"""Names on rigs of five kinds where no hypothesis is exact: `python -m benchmarks.open_rigs DIR`.

A driven cart that nothing holds, a damper in a test machine (motion in, force out), a servo (a
closed loop), a mass on a support that moves (by displacement or acceleration), and stores of first
order (two tanks, a heated block). Each is simulated by equations written out here and a general
integrator, not by what is judged. A campaign hides one effect of the catalogue in 10 to 50 times
the noise of what calibration, zeros and constants of inputs leave of it, and beside it what no
hypothesis knows, 3 to 10 % of that: by turns a random force, a small body (a small store) on a
spring of its own, and a weak law of a square and a sine. Campaigns 25 to 29 hide that alone, at two
to six times the noise, and those from 30 on nothing at all. `--variant` makes the same campaigns
with leading blanks, a jitter of the stamps of 2 %, gaps, an offset of the drive or all of these,
with drives that are held between samples, or with noise of correlation 0.5. A line for each
campaign, then the counts, how often the port is right, and how often 90 % intervals hold what is
true; verdicts go to DIR/VARIANT.json.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from threadpoolctl import threadpool_limits

from benchmarks.blind_naming import estimates
from benchmarks.open_rigs.campaigns import drawn, write
from benchmarks.studies.remainder_naming import scored
from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.library import library
from discrepancy.errors import DiscrepancyError
from discrepancy.workflow import investigate

VARIANTS = ("plain", "blanks", "jitter", "gaps", "offset", "all", "held", "colour")


def judge(out: Path, seed: int, number: int, variant: str) -> dict[str, Any]:
    """Make a campaign, name what it lacks and return truth and verdict."""
    bench, truth, facts = drawn(number, seed)
    folder = out / variant / f"case-{number:02d}"
    shutil.rmtree(folder, ignore_errors=True)
    write(folder, bench, truth, variant, (seed, number))
    facts |= {"number": number, "variant": variant, "size": truth.size, "amount": truth.amount}
    began = time.process_time()
    try:
        investigation = investigate(
            read_campaign(folder), folder / "model.toml", library(), thorough=False
        )
    except DiscrepancyError as error:
        return facts | {"kind": "error", "sentence": str(error), "outcome": "error", "seconds": 0.0}
    row = scored(investigation.verdict, facts["identifiers"], investigation.proof) | {
        "family": investigation.verdict.family
    }
    row["outcome"] = outcome_of(row, facts)
    row["places"] = sorted({effect.place for effect in investigation.verdict.effects})
    right = row["outcome"] in ("named", "named in part") and not investigation.verdict.family
    row["estimates"] = estimates(investigation) if right else {}
    return facts | row | {"seconds": time.process_time() - began}


def outcome_of(row: Mapping[str, Any], facts: Mapping[str, Any]) -> str:
    """Return the outcome of a verdict; of a law outside the catalogue the family is right."""
    if facts["identifiers"] or facts["left"] != "law" or row["outcome"] != "wrong":
        return str(row["outcome"])
    lost = "outflow" if facts["rig"] in ("stores", "heated") else "cubic_stiffness"
    (family,) = (effect.family for effect in library() if effect.identifier == lost)
    return "family" if row["family"] == family else "wrong"


def main() -> None:
    """Make the campaigns, name, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=30)
    parser.add_argument(
        "--only", type=int, nargs="*", help="numbers of campaigns, instead of the first ones"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--variant", choices=VARIANTS, default="plain")
    arguments = parser.parse_args()
    rows = []
    with threadpool_limits(1):
        for number in arguments.only or range(arguments.count):
            row = judge(arguments.out, arguments.seed, number, arguments.variant)
            rows.append(row)
            print(
                f"{number:2d} {row['rig']:14s} "
                f"{', '.join(row['identifiers']) or 'nothing':20s} gap "
                f"{row['gap']:5.1f} {row['left']:5s} {row['remainder']:5.2f}  {row['outcome']:14s} "
                f"{row['seconds']:4.0f} s  {row['sentence']}",
                flush=True,
            )
            (arguments.out / f"{arguments.variant}.json").write_text(
                json.dumps(rows, indent=1) + "\n", "utf-8"
            )
    tell(rows)


def tell(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print how often a verdict, its port and its intervals are right."""
    for group in ("an effect", "a remainder alone", "nothing"):
        ours = [row for row in rows if group == hides(row)]
        if ours:
            print(f"{group} hidden:", dict(Counter(row["outcome"] for row in ours)))
    effects = [row for row in rows if row.get("places") and hides(row) == "an effect"]
    right = sum(row["place"] in row["places"] for row in effects)
    held = [
        low <= row["values"][key] <= high
        for row in effects
        for key, (low, _, high) in row["estimates"].items()
        if key in row["values"]
    ]
    print(
        f"port right: {right} of {len(effects)}; "
        f"90 % intervals that hold: {sum(held)} of {len(held)}"
    )
    print(f"seconds of processor, median: {median(row['seconds'] for row in rows):.0f}")


def hides(row: Mapping[str, Any]) -> str:
    """Return what a campaign hides."""
    return "an effect" if row["identifiers"] else "a remainder alone" if row["left"] else "nothing"


if __name__ == "__main__":
    main()
