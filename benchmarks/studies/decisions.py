"""What policies and notices are worth to belief and decisions under faults of the gauges.

Shown in docs/how_to/compare_policies.md and docs/explanation/notices.md.

`python -m benchmarks.studies.decisions --flights 80` flies the mission of level_turns with a wing
whose gauges or skin are not as the model says, under several policies. All of them meet the same
damage, noise and faults. The table shows for each fault the rms error of z1 and z2 from the step of
the fault on, the steps flown at 3g with z1 truly at or above the limit, the steps at 2g below the
limit, which were needless, the changes of control, and the flights with an alarm.
"""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.studies.hidden_effects import LIMIT, beyond_the_limit
from benchmarks.studies.learning import SOFTENING, third_region
from fe.reduction.model_cache import reduced_model
from fe.wing.design import load_design
from reporting.arrays import Index
from twin_master.assets.asset_source import Asset, AssetReading
from twin_master.assets.reduced_model import ReducedModelSource
from twin_master.mission.flights import (
    Flights,
    TwinsSideBySide,
    fly_formation,
    fly_one_by_one,
)
from twin_master.mission.plant import Plant, Truth
from twin_master.mission.preparation import Knowledge, prepare_knowledge
from twin_master.mission.steps import Reading, Source
from twin_master.scenario.reading import load_scenario
from twin_master.scenario.schema import Scenario
from twin_master.scenario.tables import SensorFault

Float = NDArray[np.float64]

SCENARIO = "level_turns"
BEGINS = 10
"""First step with a fault, of those that do not exist from the start."""
LOAD_FACTOR_OF_SHARP_TURN = 3.0
MOST_STRAINED = 16
"""Index of gauge 17, whose strain is the largest."""
TOGETHER = 40
"""Flights that are flown side by side."""
POLICIES = ("paper", "hold 5", "risk 0.07", "risk 0.1, hold 3", "risk 0.02")
"""Policies of the study: that of the scenario, or names for `--policy` of `uav-twin run`."""
WITHOUT_NOTICES = "paper, without notices"


@dataclass(frozen=True)
class FlownStep:
    """A step of B flights, for a fault.

    Attributes
    ----------
    seeds : (B,) array
        The seeds of the flights.
    step : int
        The number of the step, from 0.
    is_sharp : (B,) array
        Whether it is flown at 3g.
    strain : (B, G) array
        The true strains.
    """

    seeds: Index
    step: int
    is_sharp: NDArray[np.bool_]
    strain: Float


GaugeFault = Callable[[FlownStep], Float]
"""Returns the strains (B, G) that gauges indicate in a step, without noise."""


def with_gains(count: int, gain: float, begins: int = BEGINS, at: str = "") -> GaugeFault:
    """Return a fault of gauges that are drawn for each flight.

    Parameters
    ----------
    count : int
        The number of faulty gauges.
    gain : float
        Their relative error.
    begins : int
        The first step with the fault.
    at : str
        The only control under which it shows, "2g" or "3g"; both if empty.
    """

    def strain_with_gains(step: FlownStep) -> Float:
        gauges = step.strain.shape[1]
        factor = np.ones_like(step.strain)
        for flight, seed in enumerate(step.seeds.tolist()):
            drawn = np.random.default_rng([seed, 2]).permutation(gauges)[:count]
            factor[flight, drawn] = 1.0 + gain
        shows = np.full(len(step.seeds), step.step >= begins)
        if at:
            shows &= step.is_sharp == (at == "3g")
        return np.where(shows[:, None], factor, 1.0) * step.strain

    return strain_with_gains


def with_gain_of_most_strained(step: FlownStep) -> Float:
    """Return the strains if gauge 17 shows a third too little."""
    is_faulty = (np.arange(step.strain.shape[1]) == MOST_STRAINED) & (step.step >= BEGINS)
    return np.where(is_faulty, 2.0 / 3.0, 1.0) * step.strain


def saturating(limit: float) -> GaugeFault:
    """Return the fault of gauges that saturate softly at a limit, from the start."""
    return lambda step: limit * np.tanh(step.strain / limit)


def softening_skin() -> GaugeFault:
    """Return the strains of a wing whose skin between the regions softens, a point a step."""
    factor_of_loss = third_region()
    begin, rate, limit = SOFTENING
    return lambda step: (
        factor_of_loss(min(rate * max(step.step - begin + 1, 0), limit)) * step.strain
    )


@dataclass(frozen=True)
class Fault:
    """A fault of the study: of gauges or skin, or one that a scenario can state.

    Attributes
    ----------
    gauge_fault : callable
        The strains that the gauges show, see `GaugeFault`.
    sensor_faults : tuple of SensorFault
        The faults that the scenario states.
    """

    gauge_fault: GaugeFault = field(default=lambda step: step.strain)
    sensor_faults: tuple[SensorFault, ...] = ()


def faults(gauges: int) -> dict[str, Fault]:
    """Return the faults of the study by name, for a number of gauges."""
    half = gauges // 2
    most_strained = MOST_STRAINED + 1

    def of_gauge_17(kind: str) -> Fault:
        fault = SensorFault(kind=kind, sensors=(most_strained,), first_step=BEGINS)  # type: ignore[arg-type]
        return Fault(sensor_faults=(fault,))

    return {
        "nothing": Fault(),
        "a gauge shows 20 % too little": Fault(with_gains(1, -0.2)),
        "a gauge shows 33 % too little": Fault(with_gains(1, -1.0 / 3.0)),
        "gauge 17, strained most, 33 % too little": Fault(with_gain_of_most_strained),
        "gauge 17 lost": of_gauge_17("dropout"),
        "gauge 17 stuck": of_gauge_17("stuck"),
        "half of the gauges show 33 % too little": Fault(with_gains(half, -0.33)),
        "the same at 3g alone, from the start": Fault(with_gains(half, -0.33, 0, "3g")),
        "the same at 3g alone": Fault(with_gains(half, -0.33, at="3g")),
        "the same at 2g alone": Fault(with_gains(half, -0.33, at="2g")),
        "all gauges show 10 % too little": Fault(with_gains(gauges, -0.1)),
        "all gauges saturate softly, 4000 tanh(x / 4000) microstrain": Fault(saturating(4e-3)),
        "all gauges saturate softly, 6000 tanh(x / 6000) microstrain": Fault(saturating(6e-3)),
        "all gauges saturate softly, 8000 tanh(x / 8000) microstrain": Fault(saturating(8e-3)),
        "skin between the regions softens, a point a step": Fault(softening_skin()),
    }


class FaultyAsset(Asset):
    """An asset of a single flight, whose gauges have a fault.

    Parameters
    ----------
    asset : Asset
        The asset without the fault.
    gauge_fault : callable
        The fault, see `GaugeFault`.
    seed : int
        The seed of the flight.
    """

    def __init__(self, asset: Asset, gauge_fault: GaugeFault, seed: int) -> None:
        self._asset = asset
        self._gauge_fault = gauge_fault
        self._seeds = np.array([seed])
        self._step = 0

    def step(self, control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        """Return the reading under control and health, as the gauges indicate it."""
        reading = self._asset.step(control, health)
        is_sharp = np.array([control["load_factor"] == LOAD_FACTOR_OF_SHARP_TURN])
        flown_step = FlownStep(self._seeds, self._step, is_sharp, reading.values[None])
        self._step += 1
        return replace(reading, values=self._gauge_fault(flown_step)[0])


class FaultyGauges(Source[TwinsSideBySide]):
    """The source of the readings of gauges with a fault."""

    def __init__(self, plant: Plant, gauge_fault: GaugeFault, seeds: Index, sharp: int):
        self._plant = plant
        self._gauge_fault = gauge_fault
        self._seeds = seeds
        self._sharp = sharp

    def read(self, twins: TwinsSideBySide) -> Reading | None:
        """Fly the next step of all twins; None once all missions are at their ends."""
        is_sharp = np.asarray(twins.proposed_control) == self._sharp
        step = twins.steps
        reading = self._plant.read(twins)
        if reading is None or reading.ground_truth is None:
            return None
        strain = reading.ground_truth.observation
        indicated_strain = self._gauge_fault(FlownStep(self._seeds, step, is_sharp, strain))
        return replace(reading, observed=reading.observed + (indicated_strain - strain))


@dataclass(frozen=True)
class FlightErrors:
    """Errors and decisions of a twin over its flights.

    Attributes
    ----------
    rms : (2,) array
        Rms error of z1 and z2 from step `BEGINS` on [percentage points].
    beyond : int
        Steps with z1 at or above the limit.
    sharp_beyond : int
        Those of them that are flown at 3g.
    below : int
        Steps with z1 below the limit.
    gentle_below : int
        Those of them after which 2g is flown, which was needless.
    changes : float
        Changes of control in a flight, on average.
    alarmed : int
        Flights with an alarm or a gauge that was left out.
    """

    rms: Float
    beyond: int
    sharp_beyond: int
    below: int
    gentle_below: int
    changes: float
    alarmed: int

    def row(self, fault: str, policy: str, flights: int) -> str:
        """Return the row of the table."""
        z1, z2 = self.rms
        return (
            f"| {fault} | {policy} | {z1:.1f}, {z2:.1f} "
            f"| {100 * self.sharp_beyond / self.beyond:.1f} % "
            f"| {100 * self.gentle_below / self.below:.1f} % "
            f"| {self.changes:.1f} | {self.alarmed} of {flights} |"
        )


def fly_with_fault(
    knowledge: Knowledge, asset: Asset, gauge_fault: GaugeFault, seeds: Index
) -> Flights:
    """Return the flights of all seeds with a fault of the gauges."""
    scenario = knowledge.scenario
    if scenario.learning is not None:  # twins that learn fly one by one
        truths = [knowledge.truth(seed) for seed in seeds.tolist()]
        return fly_one_by_one(
            knowledge,
            truths,
            lambda number, _previous: FaultyAsset(asset, gauge_fault, int(seeds[number])),
        )
    sharp = scenario.control_names.index("3g")
    formations = []
    for first in range(0, len(seeds), TOGETHER):
        seeds_of_formation = seeds[first : first + TOGETHER]
        truth = Truth.stack([knowledge.truth(seed) for seed in seeds_of_formation.tolist()])
        plant = knowledge.plant(truth, *([asset] * len(seeds_of_formation)))
        source = FaultyGauges(plant, gauge_fault, seeds_of_formation, sharp)
        formations.append(fly_formation(knowledge, plant, source))
    return Flights.concatenate(formations)


def errors_of(knowledge: Knowledge, flights: Flights) -> FlightErrors:
    """Return errors and decisions of the twins over their flights."""
    sharp = knowledge.scenario.control_names.index("3g")
    error = flights.filtered @ knowledge.model.states.coordinates - flights.state
    rms = 100.0 * np.sqrt(np.mean(error[:, BEGINS:] ** 2, axis=(0, 1)))
    beyond = sharp_beyond = below = gentle_below = 0
    for state, control in zip(flights.state, flights.control_index, strict=True):
        is_sharp = control == sharp
        sharp_beyond_of_flight, beyond_of_flight = beyond_the_limit(is_sharp, state[:, 0])
        sharp_beyond += sharp_beyond_of_flight
        beyond += beyond_of_flight
        is_below = (state[:, 0] < LIMIT)[:-1]
        below += int(is_below.sum())
        gentle_below += int((is_below & ~is_sharp[1:]).sum())
    changes = float(np.mean(np.sum(np.diff(flights.control_index, axis=1) != 0, axis=1)))
    is_alarmed = [
        any(notice.kind in ("alarm", "gauge_left_out") for _, notice in notices)
        for notices in flights.notices
    ]
    return FlightErrors(
        rms=rms,
        beyond=beyond,
        sharp_beyond=sharp_beyond,
        below=below,
        gentle_below=gentle_below,
        changes=changes,
        alarmed=sum(is_alarmed),
    )


def scenario_of(name: str, policy: str) -> Scenario:
    """Return a scenario of the study with a policy."""
    scenario = load_scenario(name).scenario
    if policy == WITHOUT_NOTICES:
        return scenario.model_copy(update={"notice": None})
    return scenario if policy == "paper" else scenario.with_policy(policy)


def main() -> int:
    """Print a row for each fault and each policy."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=80)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--scenario", default=SCENARIO, help="level_turns_learning: twins learn")
    parser.add_argument(
        "--saturation",
        type=float,
        default=0.0,
        help="prior probability that gauges saturate, which twins of level_turns_learning learn",
    )
    parser.add_argument("--only", help="numbers of faults from 0, with commas")
    parser.add_argument("--policies", help='with semicolons, such as "paper; risk 0.02, hold 3"')
    arguments = parser.parse_args()
    seeds = np.arange(arguments.first_seed, arguments.first_seed + arguments.flights)
    policies = [*POLICIES, WITHOUT_NOTICES]
    if arguments.policies:
        policies = [policy.strip() for policy in arguments.policies.split(";")]
    wing = reduced_model(load_design())
    named_faults = list(faults(load_scenario(SCENARIO).scenario.observation.count).items())
    if arguments.only is not None:
        named_faults = [named_faults[int(number)] for number in arguments.only.split(",")]
    print(
        "| what is wrong | policy | rms z1, z2 | 3g beyond the limit | needless 2g | changes "
        "| flights with a notice |\n|" + " --- |" * 7
    )
    for name, fault in named_faults:
        for policy in policies:
            scenario = scenario_of(arguments.scenario, policy)
            scenario = scenario.with_changes("truth", sensor_faults=fault.sensor_faults)
            if arguments.saturation:
                scenario = scenario.with_changes("learning", saturation=arguments.saturation)
            source = ReducedModelSource(scenario, wing)
            knowledge = prepare_knowledge(scenario, source, scenario.mission.seed)
            flights = fly_with_fault(knowledge, source.open(), fault.gauge_fault, seeds)
            print(errors_of(knowledge, flights).row(name, policy, len(seeds)), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
