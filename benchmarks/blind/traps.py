"""Traps: campaigns that tempt to name what is not there."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind.changes import Changes, Fault
from benchmarks.blind.effects import DRAWS, Bench, Hidden, log_uniform, spread_cubic_stiffness
from benchmarks.blind.instruments import Measured, Signals
from benchmarks.blind.laws import FRICTION, Law
from benchmarks.blind.plan import CampaignPlan

FloatArray = NDArray[np.float64]
Spoil = Callable[[np.random.Generator, CampaignPlan, Measured], tuple[CampaignPlan, Measured]]

MODEST = ("nothing missing", "unexplained", "below detectability", "data error")


@dataclass(frozen=True)
class Trap:
    """A trap.

    Attributes
    ----------
    draw : callable
        (generator, bench) -> what is hidden.
    accepted : tuple of str
        Verdicts that are right besides naming exactly what is hidden.
    spoil : callable, optional
        What happens to the data afterwards.
    correlation, noise_factor : float
        Of the noise (`instruments.measure`).
    no_record : bool
        Whether the noise record is left out, so that only stated deviations are known.
    largest : float, optional
        Effects are made smaller until d^2 is at most this.
    free_phase : bool
        Whether lines have a phase of their own in each trial.
    rigs : tuple of str
        Where it can be set.
    """

    draw: Callable[[np.random.Generator, Bench], tuple[Hidden, ...]]
    accepted: tuple[str, ...]
    spoil: Spoil | None = None
    correlation: float = 0.0
    noise_factor: float = 1.0
    no_record: bool = False
    largest: float | None = None
    free_phase: bool = False
    rigs: tuple[str, ...] = ("wing", "lumped")


def _nothing(generator: np.random.Generator, bench: Bench) -> tuple[Hidden, ...]:
    return ()


def _small(generator: np.random.Generator, bench: Bench) -> tuple[Hidden, ...]:
    name = str(
        generator.choice(["coulomb_friction", "quadratic_damping", "cubic_stiffness", "mains_hum"])
    )
    return (scaled(DRAWS[name](generator, bench), 0.1),)


def scaled(effect: Hidden, factor: float) -> Hidden:
    """Return an effect of forces or lines with all its forces or amplitudes scaled."""
    changes = effect.changes
    laws = tuple(
        replace(law, numbers=(factor * law.numbers[0], *law.numbers[1:])) for law in changes.laws
    )
    faults = tuple(
        replace(fault, numbers=(fault.numbers[0], *(factor * n for n in fault.numbers[1:])))
        for fault in changes.faults
    )
    truth = {
        name: value if name.endswith("frequency") else factor * value
        for name, value in effect.truth.items()
    }
    smaller = replace(
        changes,
        laws=laws,
        faults=faults,
        drag=factor * changes.drag,
        spread_cubic=factor * changes.spread_cubic,
    )
    return replace(effect, changes=smaller, truth=truth)


def _hum(generator: np.random.Generator, bench: Bench) -> tuple[Hidden, ...]:
    effect = DRAWS["mains_hum"](generator, bench)
    fault = effect.changes.faults[0]
    _frequency, cosine, sine = fault.numbers
    size = float(np.hypot(cosine, sine)) / bench.noise[fault.channels[0]]
    return (scaled(effect, log_uniform(generator, 0.5, 3.0) / size),)


def with_free_phase(
    generator: np.random.Generator, plan: CampaignPlan, signals: Signals, changes: Changes
) -> Signals:
    """Draw a new phase of hum lines for each trial, since the mains do not wait for a trigger."""
    moved = {name: values.copy() for name, values in signals.items()}
    for fault in changes.faults:
        if fault.kind != "line":
            continue
        frequency, cosine, sine = fault.numbers
        for trial in plan.trials:
            if trial.kind != "ringdown":
                continue
            angle = 2.0 * np.pi * frequency * trial.rows
            turn = float(generator.uniform(0.0, 2.0 * np.pi))
            size = float(np.hypot(cosine, sine))
            change = size * np.cos(angle + turn) - cosine * np.cos(angle) - sine * np.sin(angle)
            for column, name in enumerate(trial.channels):
                if name in fault.channels:
                    moved[trial.name][:, column] += change
    return moved


def _cancelling(generator: np.random.Generator, bench: Bench) -> tuple[Hidden, ...]:
    """Hide a tip mass, which lowers f1, and a slow clock, which raises all frequencies as much."""
    ratio = float(generator.uniform(0.03, 0.05))
    mass = ratio * bench.modal_mass
    # f1 falls by half the mass ratio; a sample stamped t is taken later, so that the motion looks
    # faster.
    rate = 1.0 / np.sqrt(1.0 / (1.0 + ratio)) - 1.0
    station = bench.length - 0.05
    return (
        Hidden(
            "point_mass",
            Changes(mass=mass, mass_station=station),
            {"point_mass.mass": mass, "point_mass.station": station},
        ),
        Hidden(
            "clock_error",
            Changes(clock_rate=float(rate)),
            {"clock_error.rate": float(rate), "clock_error.zero": 0.0},
        ),
    )


def _gain_at_damage(generator: np.random.Generator, bench: Bench) -> tuple[Hidden, ...]:
    """Let a gauge beside a modelled defect show too much, as it would after damage there."""
    channel = str(generator.choice(["g16", "g17", "g18", "g20", "g21", "g22"]))
    gain = float(generator.uniform(0.03, 0.12))
    return (
        Hidden(
            "gauge_gain",
            Changes(faults=(Fault("gain", (channel,), (gain,)),)),
            {"gauge_gain.gain": gain},
            channel,
        ),
    )


def _friction_elsewhere(generator: np.random.Generator, bench: Bench) -> tuple[Hidden, ...]:
    """Hide dry friction on the moving end, where no joint is."""
    force = log_uniform(generator, 0.004, 0.03) * bench.free.force
    port = bench.free.port
    return (
        Hidden(
            "coulomb_friction",
            Changes(laws=(Law(port, FRICTION, (force, 0.0)),)),
            {"coulomb_friction.coefficient": force},
            port,
        ),
    )


def _spread_cubic(generator: np.random.Generator, bench: Bench) -> tuple[Hidden, ...]:
    return (spread_cubic_stiffness(generator, bench),)


# ---------------------------------------------------------------- spoiled data


def _on_trials(
    measured: Measured, plan: CampaignPlan, change: Callable[[str, str, FloatArray], FloatArray]
) -> Measured:
    values = {}
    for trial in plan.trials:
        columns = measured.values[trial.name].copy()
        for column, name in enumerate(trial.channels):
            columns[:, column] = change(trial.name, name, columns[:, column])
        values[trial.name] = columns
    return replace(measured, values=values)


def _outliers(
    generator: np.random.Generator, plan: CampaignPlan, measured: Measured
) -> tuple[CampaignPlan, Measured]:
    def change(trial: str, name: str, values: FloatArray) -> FloatArray:
        if len(values) < 100:
            return values
        hit = generator.random(len(values)) < 0.01
        size = plan.channels[name].noise * generator.uniform(10.0, 40.0, len(values))
        return np.asarray(values + hit * size * generator.choice([-1.0, 1.0], len(values)))

    return plan, _on_trials(measured, plan, change)


def _clipped(
    generator: np.random.Generator, plan: CampaignPlan, measured: Measured
) -> tuple[CampaignPlan, Measured]:
    channel = str(generator.choice(plan.dynamic_channels))
    largest = max(
        float(np.abs(measured.values[t.name][:, t.channels.index(channel)]).max())
        for t in plan.trials
        if t.kind == "ringdown"
    )
    limit = float(generator.uniform(0.55, 0.85)) * largest

    def change(trial: str, name: str, values: FloatArray) -> FloatArray:
        return np.clip(values, -limit, limit) if name == channel else values

    return plan, _on_trials(measured, plan, change)


def _swapped(
    generator: np.random.Generator, plan: CampaignPlan, measured: Measured
) -> tuple[CampaignPlan, Measured]:
    first, second = ("g02", "g10") if "g02" in plan.channels else ("s2", "s3")
    values = {}
    for trial in plan.trials:
        columns = measured.values[trial.name].copy()
        if first in trial.channels and second in trial.channels:
            a, b = trial.channels.index(first), trial.channels.index(second)
            columns[:, [a, b]] = columns[:, [b, a]]
        values[trial.name] = columns
    return plan, replace(measured, values=values)


def _wrong_unit(
    generator: np.random.Generator, plan: CampaignPlan, measured: Measured
) -> tuple[CampaignPlan, Measured]:
    """Let the file say strain where the numbers are microstrain, in one channel or in all."""
    strains = [name for name, channel in plan.channels.items() if channel.quantity == "strain"]
    hit = strains if bool(generator.integers(2)) else [str(generator.choice(strains))]
    channels = {
        name: replace(channel, unit="1") if name in hit else channel
        for name, channel in plan.channels.items()
    }
    return replace(plan, channels=channels), measured


def _too_small_label(
    generator: np.random.Generator, plan: CampaignPlan, measured: Measured
) -> tuple[CampaignPlan, Measured]:
    return plan, replace(measured, noise={})


TRAPS: dict[str, Trap] = {
    "wrong noise label": Trap(_nothing, MODEST, _too_small_label, noise_factor=2.0, no_record=True),
    "correlated noise": Trap(_nothing, MODEST, correlation=0.7),
    "below detectability": Trap(_small, MODEST, largest=4.0),
    "hum in the noise record": Trap(_hum, MODEST[1:], free_phase=True),
    "two effects that cancel in f1": Trap(_cancelling, ("unexplained",), rigs=("wing",)),
    "gain error at a damage site": Trap(_gain_at_damage, ("unexplained",), rigs=("wing",)),
    "known effect in an unexpected place": Trap(_friction_elsewhere, ("unexplained",)),
    "cubic springs spread over the wing": Trap(
        _spread_cubic, ("unexplained", "family"), rigs=("wing",)
    ),
    "outliers": Trap(_nothing, MODEST, _outliers),
    "clipped channel": Trap(_nothing, ("data error", "unexplained"), _clipped),
    "swapped channels": Trap(_nothing, ("data error", "unexplained"), _swapped),
    "microstrain for strain": Trap(_nothing, ("data error",), _wrong_unit),
}
"""Every trap by its name."""
