"""Accuracy of the beginning and end of temporary forces: `python -m benchmarks.force_events DIR`.

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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.open_rigs.campaigns import table
from benchmarks.open_rigs.rigs import HEATED, STORES, FloatArray, entry, port, solved
from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.entry import Setting
from discrepancy.estimation.force_search import ForceSearch
from discrepancy.fits.problem import Problem
from discrepancy.missing_force.events import find_events
from discrepancy.model_choice import load_model
from discrepancy.workflow import check_and_prepare

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
    """A campaign on disk, with its true events.

    Attributes
    ----------
    folder : Path
        Folder of the campaign.
    windows : tuple of (float, float)
        Beginning and end of each event [s].
    length : float
        Duration of the record [s].
    """

    folder: Path
    windows: tuple[tuple[float, float], ...]
    length: float


@dataclass(frozen=True)
class EventRig:
    """A rig for records with events, as in its campaign and model file.

    Attributes
    ----------
    model : str
        Tables of the model file.
    channels : dict of str to (str, str, float)
        Quantity, unit and usual noise of each channel.
    input_quantity, input_unit : str
        Quantity and unit of the drive.
    amplitude : float
        Size of the drive [unit].
    parameters : dict of str to (str, float)
        Scaled terms and prior deviation of each parameter.
    states : int
        Number of states of its equations.
    """

    model: str
    channels: dict[str, tuple[str, str, float]]
    input_quantity: str
    input_unit: str
    amplitude: float
    parameters: dict[str, tuple[str, float]]
    states: int


RIGS = {
    "heated": EventRig(
        model=HEATED,
        channels={"block": ("temperature", "K", 0.02)},
        input_quantity="heat",
        input_unit="W",
        amplitude=80.0,
        parameters={"capacity": ("capacity", 0.05), "loss": ("conductance", 0.1)},
        states=1,
    ),
    "tanks": EventRig(
        model=STORES,
        channels={"upper": ("level", "m", 1e-3), "lower": ("level", "m", 1e-3)},
        input_quantity="flow",
        input_unit="m3/s",
        amplitude=0.016,
        parameters={"upper outlet": ("upper outlet", 0.05), "lower outlet": ("lower outlet", 0.05)},
        states=2,
    ),
    "mass": EventRig(
        model=MASS,
        channels={"x": ("displacement", "m", 2e-4)},
        input_quantity="force",
        input_unit="N",
        amplitude=12.0,
        parameters={
            "mass": ("mass", 0.03),
            "spring": ("stiffness", 0.03),
            "damper": ("damping", 0.1),
        },
        states=2,
    ),
}
RIG_OF_KIND = {"power": "heated", "leak": "heated", "tank": "tanks"}
"""Rig of each kind of event; the others act on the mass."""


@dataclass(frozen=True)
class Equations:
    """True equations of the rigs with an event.

    Attributes
    ----------
    kind : str
        Kind of the event.
    drive : callable
        time -> drive of unit size.
    event : callable
        time -> size of the event, 0 outside of its windows.
    constant : float
        Size of an effect that acts always.
    factors : (3,) array
        True parameters over nominal ones.
    """

    kind: str
    drive: Callable[[float], float]
    event: Callable[[float], float]
    constant: float
    factors: FloatArray

    def heated(self, t: float, y: FloatArray) -> list[float]:
        """Return the rate of the temperature of a heated block; events heat or leak."""
        size = self.event(t)
        hidden = 60.0 * size if self.kind != "leak" else -1.5 * size * y[0]
        power = 80.0 * self.drive(t) + hidden - 2.0 * self.factors[1] * y[0]
        return [power / (400.0 * self.factors[0])]

    def tanks(self, t: float, y: FloatArray) -> list[float]:
        """Return the rates of the levels of two tanks; events leak from the lower one."""
        upper_flow = 0.02 * self.factors[0] * y[0]
        lower_flow = 0.025 * self.factors[1] * y[1]
        leak = 0.02 * self.event(t) * y[1]
        return [0.016 * self.drive(t) - upper_flow, upper_flow - lower_flow - leak]

    def mass(self, t: float, y: FloatArray) -> list[float]:
        """Return velocity and acceleration of a mass; events push, or rub as friction does."""
        x, v = y
        hidden = 4.0 * self.event(t) if self.kind == "push" else 0.0
        if self.kind in ("friction", "always"):
            size = self.constant if self.kind == "always" else self.event(t)
            hidden = -1.5 * size * np.tanh(v / 1e-3)
        spring = 200.0 * self.factors[1] * x
        damper = 1.2 * self.factors[2] * v
        force = 12.0 * self.drive(t) + hidden - spring - damper
        return [v, force / (2.0 * self.factors[0])]


def drawn(folder: Path, kind: str, seed: Sequence[int]) -> Case:
    """Simulate a record with events of a kind and write its campaign and model.

    Parameters
    ----------
    folder : Path
        Folder to write to; replaced if it exists.
    kind : str
        One of `KINDS`.
    seed : sequence of int
        Seed of the record.
    """
    generator = np.random.default_rng(seed)
    count = int(generator.choice([300, 600, 1200]))
    noise = float(generator.choice(NOISES))
    factors = 1.0 + generator.uniform(-0.05, 0.05, 3)
    is_slow = kind in RIG_OF_KIND
    interval = 5.0 if is_slow else 0.02
    length = interval * (count - 1)
    time = interval * np.arange(count, dtype=np.float64)

    # Events
    windows = []
    for k in range(int(generator.integers(1, 3))):
        begin = length * (0.5 * k + generator.uniform(0.08, 0.3))
        windows.append((begin, begin + length * generator.uniform(0.03, 0.15)))
    if kind in ("always", "nothing"):
        windows = []
    sizes = np.exp(generator.uniform(np.log(0.15), np.log(1.0), 2))

    # Drive: held levels
    if is_slow:
        levels = generator.uniform(0.3, 1.4, count // 10 + 1)
    else:
        levels = generator.uniform(-1.0, 1.0, count)
    held_samples = 10 if is_slow else 5
    moments = [float(t) for t in time[held_samples::held_samples]]
    breaks = sorted({*moments, *(t for window in windows for t in window)})

    # A record without an event has any of the rigs; slow ones take 250 times as long
    name = RIG_OF_KIND.get(kind, "mass")
    if kind == "nothing":
        name = ("heated", "tanks", "mass")[int(generator.integers(3))]
        if name != "mass":
            time = 250.0 * time
            length = 250.0 * length
            moments = [250.0 * t for t in moments]
            breaks = moments

    def drive(t: float) -> float:
        return float(levels[np.searchsorted(moments, t, "right")])

    def event(t: float) -> float:
        active = [
            size for size, (begin, end) in zip(sizes, windows, strict=False) if begin <= t < end
        ]
        return float(sum(active))

    # Motion and readings
    rig = RIGS[name]
    equations = Equations(kind, drive, event, sizes[0], factors)
    slope = {"heated": equations.heated, "tanks": equations.tanks, "mass": equations.mass}[name]
    states = solved(slope, [0.0] * rig.states, tuple(breaks), time)
    deviations = noise * np.array([deviation for _, _, deviation in rig.channels.values()])
    channels = len(rig.channels)
    readings = states[:, :channels] + deviations * generator.standard_normal((count, channels))
    at_rest = deviations * generator.standard_normal((400, channels))
    values = rig.amplitude * np.array([drive(float(t)) for t in time])
    shutil.rmtree(folder, ignore_errors=True)
    write_record(folder, kind, rig, time, values, readings, at_rest)
    return Case(folder, tuple(windows), length)


def write_record(
    folder: Path,
    name: str,
    rig: EventRig,
    time: FloatArray,
    drive: FloatArray,
    readings: FloatArray,
    at_rest: FloatArray,
) -> None:
    """Write a campaign of one record, and its model.

    Parameters
    ----------
    folder : Path
        Folder to make.
    name : str
        Name of campaign and model.
    rig : EventRig
        The rig.
    time, drive : (n,) array
        Times [s], and drive [unit].
    readings : (n, C) array
        Readings of the channels.
    at_rest : (m, C) array
        Readings without motion, from which the noise is known.
    """
    folder.mkdir(parents=True)
    names = list(rig.channels)
    rest_time = time[1] * np.arange(len(at_rest))
    table(folder / "rest.csv", ["time", *names], np.column_stack((rest_time, at_rest)))
    table(folder / "1.csv", ["time", "drive", *names], np.column_stack((time, drive, readings)))
    text = f'format = 1\nname = "{name}"\n\n[noise]\nfile = "rest.csv"\n'
    for channel, (quantity, unit, _) in rig.channels.items():
        text += entry("channel", name=channel, quantity=quantity, unit=unit, output=channel)
    text += entry(
        "input",
        name="drive",
        quantity=rig.input_quantity,
        unit=rig.input_unit,
        hold="zero_order",
    )
    text += entry("trial", name="record", kind="driven", file="1.csv", begins="still")
    (folder / "campaign.toml").write_text(text, "utf-8")
    parameters = "".join(
        entry("parameter", name=parameter, terms=terms, deviation=deviation, low=0.4, high=2.5)
        for parameter, (terms, deviation) in rig.parameters.items()
    )
    (folder / "model.toml").write_text(
        f'format = 1\nname = "{name}"\n{rig.model}{parameters}', "utf-8"
    )


def problem_of(case: Case) -> Problem:
    """Return a case with its model, all of its records fitted."""
    model = load_model(case.folder / "model.toml")
    campaign, _ = check_and_prepare(read_campaign(case.folder), model, hold_out=False)
    return Problem(campaign, model, Setting(campaign, model, model.scales(campaign)))


def found_in(case: Case) -> FloatArray:
    """Return medians and ends of the 90 % intervals (C, 3) of all changes of a record [s]."""
    search = ForceSearch(problem_of(case))
    force = search.estimate_with_jumps(
        max(search.estimate_by_port, key=lambda name: search.estimate_by_port[name].log_evidence)
    )
    ((port, process),) = force.processes.items()
    return find_events(force.linearisation, port, process).change_times(0)


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
