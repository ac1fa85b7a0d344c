"""Make sealed campaigns or score verdicts: `python -m benchmarks.blind generate|score --out DIR`.

DIR/campaigns/<case>/   campaign.toml, CSV files; model.toml where the structure is the lumped rig
DIR/leave_out.json      effects that whoever names must leave out of the catalogue, by case
DIR/sealed/<case>.json  the truth, not to be opened before the verdicts are in
DIR/verdicts/<case>.json  what was named (written by the naming side)
DIR/score.md            the score
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.progress import track

from benchmarks.blind.cases import KINDS, Order, make_case, orders, workbench
from benchmarks.blind.scoring import load_cases
from benchmarks.blind.tables import report
from benchmarks.blind.wing_basis import REGION_LINES
from benchmarks.blind.writing import write_case

SHOWN = 100  # columns


def _make(out: Path, cache: Path | None, order: Order) -> str:
    write_case(make_case(order, cache), out / "campaigns", out / "sealed")
    return order.name


def _build_region(cache: Path | None, region: int) -> int:
    work = workbench("wing", cache)
    work.rig.store.basis(region)  # type: ignore[attr-defined]
    return region


def generate(arguments: argparse.Namespace) -> int:
    console = Console()
    wanted = orders(
        arguments.count_per_effect,
        arguments.nulls,
        arguments.pairs,
        arguments.outside,
        arguments.traps,
        arguments.seed,
        tuple(arguments.kinds),
        tuple(arguments.rigs),
    )
    if arguments.effects:
        wanted = [order for order in wanted if set(order.identifiers) & set(arguments.effects)]
    arguments.out.mkdir(parents=True, exist_ok=True)
    leave_out = {order.name: list(order.identifiers) for order in wanted if order.kind == "outside"}
    (arguments.out / "leave_out.json").write_text(
        json.dumps(leave_out, indent=1) + "\n", encoding="utf-8"
    )
    begin = time.perf_counter()
    if any(order.rig == "wing" for order in wanted):
        _build_region(arguments.cache, -1)
    with ProcessPoolExecutor(arguments.jobs) as pool:
        if any(
            order.rig == "wing" and "local_stiffness_loss" in order.identifiers for order in wanted
        ):
            list(pool.map(partial(_build_region, arguments.cache), range(len(REGION_LINES))))
        prepared = time.perf_counter() - begin
        written = pool.map(partial(_make, arguments.out, arguments.cache), wanted, chunksize=2)
        for _ in track(written, description="campaigns", total=len(wanted), console=console):
            pass
    elapsed = time.perf_counter() - begin
    console.print(
        f"{len(wanted)} campaigns in {elapsed:.0f} s, {prepared:.0f} s of them to prepare the "
        f"wing, in {arguments.out}"
    )
    return 0


def score(arguments: argparse.Namespace) -> int:
    cases, missing = load_cases(arguments.out)
    if not cases:
        print(f"there are no verdicts in {arguments.out / 'verdicts'} for the cases in sealed/")
        return 2
    text = report(cases, missing)
    (arguments.out / "score.md").write_text(text, encoding="utf-8")
    print(text)
    return 0


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.blind", description=__doc__.splitlines()[0]
    )
    commands = parser.add_subparsers(dest="command", required=True)
    make = commands.add_parser("generate", help="make campaigns with hidden effects")
    make.add_argument("--out", type=Path, required=True, help="folder to write to")
    make.add_argument("--count-per-effect", type=int, default=8, help="cases of each effect")
    make.add_argument("--nulls", type=int, default=300, help="cases with nothing hidden")
    make.add_argument("--pairs", type=int, default=60, help="cases with two effects")
    make.add_argument(
        "--outside", type=int, default=3, help="cases of each effect that is left out"
    )
    make.add_argument("--traps", type=int, default=4, help="cases of each trap")
    make.add_argument("--seed", type=int, default=1)
    make.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    make.add_argument("--rigs", nargs="+", choices=("wing", "lumped"), default=["wing", "lumped"])
    make.add_argument(
        "--effects", nargs="+", default=[], help="make only campaigns that hide one of these"
    )
    make.add_argument("--jobs", type=int, default=2, help="processes")
    make.add_argument("--cache", type=Path, default=None, help="where the projected wing is kept")
    make.set_defaults(run=generate)
    rate = commands.add_parser("score", help="compare verdicts with the truth")
    rate.add_argument("--out", type=Path, required=True, help="folder of the campaigns")
    rate.set_defaults(run=score)
    chosen = parser.parse_args(arguments)
    return int(chosen.run(chosen))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
