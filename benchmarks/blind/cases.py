"""One case: what is drawn, measured, written to the campaign folder and sealed."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind import traps
from benchmarks.blind.changes import Changes
from benchmarks.blind.detectability import Reference, reference
from benchmarks.blind.effects import DRAWS, LUMPED, Bench, Hidden, Scale
from benchmarks.blind.instruments import (
    Chance,
    Measured,
    Rig,
    Signals,
    draw_chance,
    measure,
    true_signals,
)
from benchmarks.blind.lumped_rig import SPRINGS, LumpedRig, lumped_campaign
from benchmarks.blind.plan import CampaignPlan
from benchmarks.blind.wing_basis import REGION_LINES, WingBasisStore
from benchmarks.blind.wing_campaign import wing_campaign
from benchmarks.blind.wing_rig import LOAD_POINT, WingRig
from fe.wing.mesh_lines import span_lines

FloatArray = NDArray[np.float64]

DETECTABLE = 50.0
"""Least d^2 of an effect that is to be found."""
ATTEMPTS = 40
KINDS = ("catalogue", "null", "outside", "pair", "trap")
NOT_TOGETHER = (
    frozenset({"coulomb_friction", "structural_damping"}),
    frozenset({"joint_micro_slip", "bouc_wen_hysteresis"}),
    frozenset({"gauge_gain", "gauge_misalignment"}),
)
"""Pairs that are not drawn, because no campaign can distinguish the two from one effect."""


@dataclass(frozen=True)
class Order:
    """A case to make: its name, kind, rig, identifiers (or the trap's name), and the seed."""

    name: str
    kind: str
    rig: str
    identifiers: tuple[str, ...]
    seed: int
    trap: str = ""


@dataclass(frozen=True)
class Case:
    """A made case.

    Attributes
    ----------
    order : Order
        What it was to be.
    plan : CampaignPlan
        The campaign as its file describes it.
    measured : Measured
        What the instruments showed.
    truth : dict
        What is sealed.
    """

    order: Order
    plan: CampaignPlan
    measured: Measured
    truth: dict[str, Any] = field(repr=False)


class Workbench:
    """A rig with its campaign plan and its scales."""

    def __init__(
        self, rig: Rig, plan: CampaignPlan, make_bench: Callable[[Workbench], Bench]
    ) -> None:
        self.rig = rig
        self.plan = plan
        self._make_bench = make_bench

    @cached_property
    def mean(self) -> Chance:
        """The nominal rig with nominal releases."""
        return Chance(
            {name: mean for name, (mean, _) in self.plan.priors.items()},
            {trial.name: trial.release for trial in self.plan.trials},
        )

    @cached_property
    def nominal(self) -> Signals:
        """What it shows."""
        return true_signals(self.rig, self.plan, self.mean, Changes())

    @cached_property
    def bench(self) -> Bench:
        """What effects must know."""
        return self._make_bench(self)

    @property
    def effects(self) -> tuple[str, ...]:
        """Identifiers of what it can hide."""
        return LUMPED if self.rig.name == "lumped" else tuple(DRAWS)

    def ranges(self) -> dict[str, float]:
        """Largest reading of each channel of the nominal rig [unit]."""
        largest = dict.fromkeys(self.plan.channels, 0.0)
        for trial in self.plan.trials:
            for column, name in enumerate(trial.channels):
                size = float(np.abs(self.nominal[trial.name][:, column]).max())
                largest[name] = max(largest[name], size)
        return largest


def _common(work: Workbench, joint: Scale, free: Scale, frequencies: FloatArray) -> dict[str, Any]:
    plan = work.plan
    static = [trial for trial in plan.trials if trial.kind == "static"]
    rings = [trial for trial in plan.trials if trial.kind == "ringdown"]
    channels = plan.channels.values()
    return {
        "rig": work.rig.name,
        "joint": joint,
        "free": free,
        "gauges": tuple(c.name for c in channels if c.quantity == "strain"),
        "dynamic": plan.dynamic_channels,
        "dynamic_range": work.ranges(),
        "noise": {c.name: c.noise for c in channels},
        "scale": {c.name: c.scale for c in channels},
        "release": max(abs(trial.release) for trial in rings),
        "displacements": tuple(c.name for c in channels if c.quantity == "displacement"),
        "runs": tuple(dict.fromkeys(trial.run for trial in static)),
        "force": max(float(np.abs(trial.rows).max()) for trial in static),
        "record": max(float(trial.rows[-1]) for trial in rings),
        "duration": plan.duration,
        "frequencies": frequencies,
    }


def _wing_bench(work: Workbench) -> Bench:
    rig = work.rig
    assert isinstance(rig, WingRig)
    structure = rig.structure(work.mean.parameters, Changes())
    bend = structure.solve(structure.ports["tip"])
    compliance = float(structure.ports["tip"] @ bend)
    release = max(abs(trial.release) for trial in work.plan.trials)
    turn = release * float(structure.ports["root"] @ bend) / compliance
    spring = rig.store.basis().flap_spring
    w = structure.angular_frequency
    motion = rig.equivalents(structure)
    flight, _ = rig.respond(
        structure, Changes(), next(trial for trial in work.plan.trials if trial.kind == "flight")
    )
    lines = span_lines(rig.design)
    places = tuple((float(lines[a]), float(lines[b])) for a, b in REGION_LINES)
    return Bench(
        **_common(
            work,
            Scale("root", spring, turn, float(w[0])),
            Scale("tip", 1.0 / compliance, release, float(w[0])),
            w / (2.0 * np.pi),
        ),
        compliance=compliance,
        largest=float(np.abs(flight[:, LOAD_POINT - 3]).max()),
        length=rig.design.planform.semi_span,
        modal_mass=1.0 / motion["tip"] ** 2,
        region_places=places,
        line_shares=rig.area_shares(),
        line_motion=rig.line_motion(structure),
        port_motion=motion,
    )


def _lumped_bench(work: Workbench) -> Bench:
    structure = work.rig.structure(work.mean.parameters, Changes())
    end = structure.ports["end"]
    bend = structure.solve(end)
    compliance = float(end @ bend)
    release = max(abs(trial.release) for trial in work.plan.trials)
    w = structure.angular_frequency
    return Bench(
        **_common(
            work,
            Scale(
                "joint",
                SPRINGS[0],
                release * float(structure.ports["joint"] @ bend) / compliance,
                float(w[0]),
            ),
            Scale("end", 1.0 / compliance, release, float(w[0])),
            w / (2.0 * np.pi),
        ),
        compliance=compliance,
        largest=release,
    )


@cache
def workbench(rig: str, folder: Path | None = None) -> Workbench:
    """Return the workbench of a rig; the projection of the full wing is cached in `folder`."""
    if rig == "lumped":
        return Workbench(LumpedRig(), lumped_campaign(), _lumped_bench)
    wing = WingRig(WingBasisStore(folder))
    return Workbench(wing, wing_campaign(wing.design), _wing_bench)


def make_case(order: Order, folder: Path | None = None) -> Case:
    """Draw and measure a case; equal orders give equal cases.

    Raises
    ------
    RuntimeError
        If no detectable size of an effect was found.
    """
    work = workbench(order.rig, folder)
    generator = np.random.default_rng([order.seed, 20211])
    chance = draw_chance(generator, work.plan)
    nominal = reference(work.rig, work.plan, chance)
    if order.kind == "trap":
        return _trap(order, work, generator, chance, nominal)
    for _ in range(ATTEMPTS):
        hidden, changes, distances = _drawn(order.identifiers, work, generator, nominal)
        signals = finite_signals(work, chance, changes) if hidden else nominal.nominal
        if signals is not None:
            break
    else:  # together they may take more stiffness from a joint than it has
        raise RuntimeError(f"{order.identifiers} cannot act together in {ATTEMPTS} attempts")
    measured = measure(generator, work.plan, signals, changes)
    return Case(order, work.plan, measured, _truth(order, hidden, distances, chance))


def finite_signals(work: Workbench, chance: Chance, changes: Changes) -> Signals | None:
    """Return readings without noise; None if the motion diverges or there is no equilibrium."""
    try:
        with np.errstate(invalid="ignore", over="ignore"):
            signals = true_signals(work.rig, work.plan, chance, changes)
    except np.linalg.LinAlgError:
        return None
    finite = all(bool(np.isfinite(values).all()) for values in signals.values())
    return signals if finite else None


def _drawn(
    identifiers: tuple[str, ...], work: Workbench, generator: np.random.Generator, known: Reference
) -> tuple[list[Hidden], Changes, list[float]]:
    hidden = []
    distances = []
    changes = Changes()
    for identifier in identifiers:
        for _ in range(ATTEMPTS):
            effect = DRAWS[identifier](generator, work.bench)
            signals = finite_signals(work, known.chance, effect.changes)
            if signals is None:
                continue
            distance = known.distance(signals)
            if distance >= DETECTABLE:
                break
        else:
            raise RuntimeError(f"no detectable {identifier} was drawn in {ATTEMPTS} attempts")
        hidden.append(effect)
        distances.append(distance)
        changes = changes.with_other(effect.changes)
    return hidden, changes, distances


def _truth(
    order: Order, hidden: list[Hidden], distances: list[float], chance: Chance, **more: Any
) -> dict[str, Any]:
    return {
        "case": order.name,
        "kind": order.kind,
        "rig": order.rig,
        "seed": order.seed,
        "identifiers": sorted(effect.identifier for effect in hidden),
        "places": {effect.identifier: effect.place for effect in hidden},
        "truth": {name: value for effect in hidden for name, value in effect.truth.items()},
        "d2": {e.identifier: d for e, d in zip(hidden, distances, strict=True)},
        "parameters": dict(chance.parameters),
        "accepted": [],
        **more,
    }


def _trap(
    order: Order, work: Workbench, generator: np.random.Generator, chance: Chance, known: Reference
) -> Case:
    trap = traps.TRAPS[order.trap]
    drawn: Sequence[Hidden] = trap.draw(generator, work.bench)
    changes = Changes()
    for effect in drawn:
        changes = changes.with_other(effect.changes)
    distances = []
    if trap.largest is not None:
        # Make the effect smaller until it hides below the noise.
        for _ in range(60):
            distance = known.distance(true_signals(work.rig, work.plan, chance, changes))
            if distance <= trap.largest:
                break
            factor = min(0.7, 0.9 * float(np.sqrt(trap.largest / distance)))
            drawn = [traps.scaled(effect, factor) for effect in drawn]
            changes = drawn[0].changes
    for effect in drawn:
        distances.append(known.distance(true_signals(work.rig, work.plan, chance, effect.changes)))
    signals = true_signals(work.rig, work.plan, chance, changes)
    if trap.free_phase:
        signals = traps.with_free_phase(generator, work.plan, signals, changes)
    measured = measure(
        generator,
        work.plan,
        signals,
        changes,
        correlation=trap.correlation,
        noise_factor=trap.noise_factor,
    )
    plan = work.plan
    if trap.spoil is not None:
        plan, measured = trap.spoil(generator, plan, measured)
    truth = _truth(
        order,
        list(drawn),
        distances,
        chance,
        trap=order.trap,
        accepted=list(trap.accepted),
        no_record=trap.no_record,
    )
    return Case(order, plan, measured, truth)


def orders(
    count_per_effect: int,
    nulls: int,
    pairs: int,
    outside: int,
    trap_count: int,
    seed: int,
    kinds: tuple[str, ...] = KINDS,
    rigs: tuple[str, ...] = ("wing", "lumped"),
) -> list[Order]:
    """Return the cases to make, in an order and with names that tell nothing.

    Parameters
    ----------
    count_per_effect : int
        In-catalogue cases of each effect; effects that the lumped rig can hide are on it every
        other time.
    nulls, pairs : int
        Cases with nothing and with two effects.
    outside : int
        Cases of each effect that is left out of the catalogue of whoever names.
    trap_count : int
        Cases of each trap.
    seed : int
        Of everything.
    kinds : tuple of str
        Which of `KINDS`.
    rigs : tuple of str
        Which rigs; with one, effects that it cannot hide are left out.
    """
    generator = np.random.default_rng([seed, 77])
    wanted: list[tuple[str, str, tuple[str, ...], str]] = []
    for kind, count in (("catalogue", count_per_effect), ("outside", outside)):
        for number, (identifier, _) in enumerate(itertools.product(DRAWS, range(count))):
            rig = "lumped" if identifier in LUMPED and number % 2 else "wing"
            wanted.append((kind, rig, (identifier,), ""))
    for number in range(nulls):
        wanted.append(("null", "lumped" if number % 2 else "wing", (), ""))
    for number in range(pairs):
        rig = "lumped" if number % 2 else "wing"
        names = LUMPED if rig == "lumped" else tuple(DRAWS)
        while True:
            pair = tuple(sorted(str(name) for name in generator.choice(names, 2, replace=False)))
            if frozenset(pair) not in NOT_TOGETHER:
                break
        wanted.append(("pair", rig, pair, ""))
    for name, trap in traps.TRAPS.items():
        for number in range(trap_count):
            rig = trap.rigs[number % len(trap.rigs)]
            wanted.append(("trap", rig, (), name))
    wanted = [order for order in wanted if order[0] in kinds and order[1] in rigs]
    shuffled = [wanted[k] for k in generator.permutation(len(wanted))]
    return [
        Order(f"case-{number:04d}", kind, rig, names, seed * 100003 + number, trap)
        for number, (kind, rig, names, trap) in enumerate(shuffled, start=1)
    ]
