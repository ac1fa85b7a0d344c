"""Names on rigs of five kinds where no hypothesis is exact: `python -m benchmarks.open_rigs DIR`.

A driven cart that nothing holds, a damper in a test machine (motion in, force out), a servo (a closed loop),
a mass on a support that moves (by displacement or acceleration), and stores of first order (two tanks, a
heated block). Each is simulated by equations written out here and a general integrator, not by what is
judged. A campaign hides one effect of the catalogue in 10 to 50 times the noise of what calibration, zeros
and constants of inputs leave of it, and beside it what no hypothesis knows, 3 to 10 % of that: by turns a
random force, a small body (a small store) on a spring of its own, and a weak law of a square and a sine. The
last sixth of the campaigns hides that alone, at two to six times the noise. `--variant` adds leading blanks,
a jitter of the stamps of 2 %, gaps, an offset of the drive or all of them to the same campaigns. A line for
each campaign, then the counts; verdicts go to DIR/VARIANT.json.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from benchmarks.open_rigs.campaigns import KINDS, drawn, write
from benchmarks.remainder_naming import scored
from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.library import library
from discrepancy.errors import DiscrepancyError
from discrepancy.workflow import investigate

VARIANTS = ("plain", "blanks", "jitter", "gaps", "offset", "all")


def judge(out: Path, seed: int, number: int, variant: str) -> dict[str, Any]:
    """Make a campaign, name what it lacks and return truth and verdict."""
    bench, truth, facts = drawn(number, seed)
    folder = out / variant / f"case-{number:02d}"
    shutil.rmtree(folder, ignore_errors=True)
    write(folder, bench, truth, variant, (seed, number))
    facts |= {"number": number, "variant": variant, "size": truth.size, "amount": truth.amount}
    began = time.process_time()
    try:
        found = investigate(read_campaign(folder), folder / "model.toml", library(), thorough=False)
    except DiscrepancyError as error:
        return facts | {"kind": "error", "sentence": str(error), "outcome": "error", "seconds": 0.0}
    row = scored(found.verdict, facts["identifiers"]) | {"family": found.verdict.family}
    row["outcome"] = outcome_of(row, facts)
    return facts | row | {"seconds": time.process_time() - began}


def outcome_of(row: Mapping[str, Any], facts: Mapping[str, Any]) -> str:
    """Return the outcome; where a law is left alone its family is right, as of what a catalogue lacks."""
    if facts["identifiers"] or facts["left"] != "law" or row["outcome"] != "wrong":
        return str(row["outcome"])
    lost = "outflow" if facts["rig"] in ("stores", "heated") else "cubic_stiffness"
    (family,) = (item.family for item in library() if item.identifier == lost)
    return "family" if row["family"] == family else "wrong"


def main() -> None:
    """Make the campaigns, name, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=30)
    parser.add_argument("--only", type=int, nargs="*", help="numbers of campaigns, instead of the first ones")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--variant", choices=VARIANTS, default="plain")
    given = parser.parse_args()
    rows = []
    with threadpool_limits(1):
        for number in given.only or range(given.count):
            row = judge(given.out, given.seed, number, given.variant)
            rows.append(row)
            print(
                f"{number:2d} {row['rig']:14s} {', '.join(row['identifiers']) or 'nothing':20s} gap "
                f"{row['gap']:5.1f} {row['left']:5s} {row['remainder']:5.2f}  {row['outcome']:14s} "
                f"{row['seconds']:4.0f} s  {row['sentence']}", flush=True,
            )  # fmt: skip
            (given.out / f"{given.variant}.json").write_text(json.dumps(rows, indent=1) + "\n", "utf-8")
    for kind in KINDS:
        for hidden in (True, False):
            ours = [
                row for row in rows if KINDS[row["number"] % 5] == kind and bool(row["identifiers"]) is hidden
            ]
            if ours:
                print(
                    kind,
                    "an effect hidden:" if hidden else "none hidden:",
                    dict(Counter(row["outcome"] for row in ours)),
                )


if __name__ == "__main__":
    main()
