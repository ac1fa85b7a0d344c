"""Run every benchmark of this folder and print one table: `python -m benchmarks [name ...]`."""

from __future__ import annotations

import importlib
import pkgutil
import sys

from rich.console import Console
from rich.table import Table

import benchmarks
from benchmarks.measurement import Measurement


def main(names: list[str]) -> int:
    """Run the benchmarks whose module name contains one of `names` (all without names)."""
    console = Console()
    modules = [
        m.name for m in pkgutil.iter_modules(benchmarks.__path__) if m.name.startswith("bench_")
    ]
    chosen = [m for m in modules if not names or any(name in m for name in names)]
    if not chosen:
        console.print(f"no benchmark matches {', '.join(names)}; there are: {', '.join(modules)}")
        return 2
    table = Table(
        "benchmark",
        "measured",
        "target",
        "reached",
        "beside it",
        "ratio",
        title="uav-twin benchmarks",
    )
    missed = 0
    for module in sorted(chosen):
        with console.status(module):
            measurements: list[Measurement] = importlib.import_module(f"benchmarks.{module}").run()
        for m in measurements:
            ratio = "" if not m.reference_value else f"{m.value / m.reference_value:.3g}"
            reference = (
                ""
                if m.reference_value is None
                else f"{m.reference_name}: {m.reference_value:.3g} {m.unit}"
            )
            reached = {None: "", True: "yes", False: "NO"}[m.reached]
            missed += m.reached is False
            target = (
                ""
                if m.target is None
                else f"{'≥' if m.larger_is_better else '≤'} {m.target:g} {m.unit}"
            )
            table.add_row(m.name, f"{m.value:.3g} {m.unit}", target, reached, reference, ratio)
    console.print(table)
    console.print("every target is reached" if not missed else f"{missed} target(s) missed")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
