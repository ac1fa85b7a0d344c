"""Accuracy of begin and end of temporary forces: `python -m benchmarks.force_events DIR`.

Rigs of three kinds by equations written out here and a general integrator: a heated block, two
tanks, a mass on a spring. In each record something acts for a while, once or twice: a brief power
or flow, a leak in proportion to what is stored, a push, dry friction, or nothing; `always` is
friction throughout. The model knows masses, stores and losses to 3 to 10 %. Counted are begins and
ends within 1 % of the record, 90 % intervals that hold the truth, events that are missed, and those
that were not there.
"""

import argparse
import shutil
import time as clock
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.open_rigs.campaigns import table
from benchmarks.open_rigs.rigs import HEATED, STORES, Course, FloatArray, entry, port, solved
from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.entry import Setting
from discrepancy.fits.problem import Problem
from discrepancy.missing_force.events import events
from discrepancy.missing_force.naming import ForceSearch
from discrepancy.model_choice import load_model
from discrepancy.workflow import checked

MASS = "mass = 2.0\nstiffness = 200.0\ndamping = { matrix = 1.2 }\n" + (
    entry("input", name="drive", vector=1.0, quantity="force")
    + entry("output", name="x", vector=1.0)
    + port("slide")
)
KINDS = ("power", "leak", "tank", "push", "friction", "always", "nothing")
NOISES = (0.3, 1.0, 3.0)
"""Noise over that of a usual sensor."""


@dataclass(frozen=True)
class Case:
    """A campaign's folder, when events begin and end, and how long its record is [s]."""

    folder: Path
    windows: tuple[tuple[float, float], ...]
    length: float


def drawn(folder: Path, kind: str, seed: Sequence[int]) -> Case:
    """Write a campaign of a kind and its model; return what is hidden in it."""
    generator = np.random.default_rng(seed)
    count = int(generator.choice([300, 600, 1200]))
    noise = float(generator.choice(NOISES))
    factor = 1.0 + generator.uniform(-0.05, 0.05, 3)
    slow = kind in ("power", "leak", "tank")
    step = 5.0 if slow else 0.02
    length = step * (count - 1)
    windows = []
    for k in range(int(generator.integers(1, 3))):
        begin = length * (0.5 * k + generator.uniform(0.08, 0.3))
        windows.append((begin, begin + length * generator.uniform(0.03, 0.15)))
    if kind in ("always", "nothing"):
        windows = []
    time = step * np.arange(count, dtype=np.float64)
    sizes = np.exp(generator.uniform(np.log(0.15), np.log(1.0), 2))
    levels = (
        generator.uniform(0.3, 1.4, count // 10 + 1)
        if slow
        else generator.uniform(-1.0, 1.0, count)
    )
    hold = 10 if slow else 5
    moments = [float(t) for t in time[hold::hold]]
    breaks = sorted({*moments, *(t for window in windows for t in window)})

    def drive(t: float) -> float:
        return float(levels[np.searchsorted(moments, t, "right")])

    def during(t: float) -> float:
        return float(
            sum(
                size for size, (begin, end) in zip(sizes, windows, strict=False) if begin <= t < end
            )
        )

    def heated(t: float, y: FloatArray) -> list[float]:
        hidden = 60.0 * during(t) if kind != "leak" else -1.5 * during(t) * y[0]
        return [(80.0 * drive(t) + hidden - 2.0 * factor[1] * y[0]) / (400.0 * factor[0])]

    def tanks(t: float, y: FloatArray) -> list[float]:
        over = 0.02 * factor[0] * y[0]
        return [0.016 * drive(t) - over, over - 0.025 * factor[1] * y[1] - 0.02 * during(t) * y[1]]

    def moved(t: float, y: FloatArray) -> list[float]:
        hidden = 4.0 * during(t) if kind == "push" else 0.0
        if kind in ("friction", "always"):
            rubs = sizes[0] if kind == "always" else during(t)
            hidden = -1.5 * rubs * np.tanh(y[1] / 1e-3)
        force = 12.0 * drive(t) + hidden - 200.0 * factor[1] * y[0] - 1.2 * factor[2] * y[1]
        return [y[1], force / (2.0 * factor[0])]

    slope = tanks if kind == "tank" else heated if slow else moved
    if kind == "nothing":
        slope = (heated, tanks, moved)[int(generator.integers(3))]
        if slope is not moved:
            time = 250.0 * time
            breaks = [250.0 * t for t in moments]
            length = 250.0 * length
            moments = breaks
    course = Course(lambda t, order: drive(t), lambda t: 0.0, tuple(breaks))
    states = solved(slope, [0.0, 0.0][: 1 if slope is heated else 2], course, time)
    model, channels, unit, size, parameters = {
        "heated": (
            HEATED,
            {"block": ("temperature", "K", 0.02)},
            "heat W",
            80.0,
            {"capacity": ("capacity", 0.05), "loss": ("conductance", 0.1)},
        ),
        "tanks": (
            STORES,
            {"upper": ("level", "m", 1e-3), "lower": ("level", "m", 1e-3)},
            "flow m3/s",
            0.016,
            {"upper outlet": ("upper outlet", 0.05), "lower outlet": ("lower outlet", 0.05)},
        ),
        "moved": (
            MASS,
            {"x": ("displacement", "m", 2e-4)},
            "force N",
            12.0,
            {"mass": ("mass", 0.03), "spring": ("stiffness", 0.03), "damper": ("damping", 0.1)},
        ),
    }[slope.__name__]
    deviations = noise * np.array([item[2] for item in channels.values()])
    names = list(channels)
    readings = states[:, : len(names)] + deviations * generator.standard_normal((count, len(names)))
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    rest = deviations * generator.standard_normal((400, len(names)))
    table(folder / "rest.csv", ["time", *names], np.column_stack((time[1] * np.arange(400), rest)))
    held = size * np.array([drive(float(t)) for t in time])
    table(folder / "1.csv", ["time", "drive", *names], np.column_stack((time, held, readings)))
    text = f'format = 1\nname = "{kind}"\n\n[noise]\nfile = "rest.csv"\n'
    for name, (quantity, of, _) in channels.items():
        text += entry("channel", name=name, quantity=quantity, unit=of, output=name)
    quantity, of = unit.split()
    text += entry("input", name="drive", quantity=quantity, unit=of, hold="zero_order")
    text += entry("trial", name="record", kind="driven", file="1.csv", begins="still")
    (folder / "campaign.toml").write_text(text, "utf-8")
    known = "".join(
        entry("parameter", name=name, terms=terms, deviation=deviation, low=0.4, high=2.5)
        for name, (terms, deviation) in parameters.items()
    )
    (folder / "model.toml").write_text(f'format = 1\nname = "{kind}"\n{model}{known}', "utf-8")
    return Case(folder, tuple(windows), length)


def problem_of(case: Case) -> Problem:
    """Return a case with its model, all of its records fitted."""
    model = load_model(case.folder / "model.toml")
    campaign, _ = checked(read_campaign(case.folder), model, hold_out=False)
    return Problem(campaign, model, Setting(campaign, model, model.scales(campaign)))


def found_in(case: Case) -> FloatArray:
    """Return medians and ends of the 90 % intervals (C, 3) of all changes of a record [s]."""
    search = ForceSearch(problem_of(case))
    one = search.rough(max(search.at, key=lambda name: search.at[name].log_evidence))
    ((port, process),) = one.processes.items()
    return events(one.view, port, process).moments(0)


def counted(case: Case, found: FloatArray) -> Counter[str]:
    """Return how many moments there are, are close, are held, were missed and are not there."""
    truth = [moment for window in case.windows for moment in window]
    counts = Counter(moments=len(truth), others=max(0, len(found) - len(truth)))
    for true in truth:
        if not len(found):
            counts["missed"] += 1
            continue
        value, low, high = min(found, key=lambda item: abs(item[0] - true))
        counts["close"] += abs(value - true) <= 0.01 * case.length
        counts["held"] += low <= true <= high
    return counts


def main() -> None:
    """Make the records, look for events, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    print(
        f"{'what acts':10s} {'moments':>8s} {'close':>6s} {'held':>6s} "
        f"{'missed':>7s} {'others':>7s}"
    )
    for number, kind in enumerate(KINDS):
        counts: Counter[str] = Counter()
        began = clock.process_time()
        for k in range(arguments.count):
            with threadpool_limits(1):
                case = drawn(arguments.out / f"{kind}-{k}", kind, (arguments.seed, k, number))
                counts += counted(case, found_in(case))
        row = [counts[name] for name in ("moments", "close", "held", "missed", "others")]
        took = (clock.process_time() - began) / arguments.count
        print(
            f"{kind:10s} {row[0]:8d} {row[1]:6d} {row[2]:6d} {row[3]:7d} {row[4]:7d}  {took:.1f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
