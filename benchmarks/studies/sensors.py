"""Eight gauges of 24, chosen by information, by pivoted QR and at random; docs/how_to/planning.md.

`python -m benchmarks.studies.sensors --missions 300` flies `growing_damage` with eight of the
wing's gauges; the others are lost from the first step on. The table shows for each choice the rms
error of z1 and z2 in points, and the share of missions that leave the sharp turn before the damage
asks for it. Pivoted QR of the readings in all states is how PySensors places sensors.
"""

import argparse

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from fe.reduction.model_cache import reduced_model
from fe.wing.design import load_design
from twin_master.assets.reduced_model import ReducedModelSource
from twin_master.fleet.members import Member
from twin_master.fleet.storage.store import stored_variables
from twin_master.mission.flights import fly_side_by_side
from twin_master.mission.preparation import Knowledge, prepare_knowledge
from twin_master.mission.sensor_design import choose_sensors, draw_readings
from twin_master.scenario.reading import load_scenario
from twin_master.scenario.tables import SensorFault

COUNT = 8
RANDOM = 5


def flown(chosen: tuple[int, ...], missions: int) -> tuple[NDArray[np.float64], float]:
    """Return rms errors of the factors [points] and the share of early fallbacks."""
    scenario = load_scenario("growing_damage").scenario
    lost = tuple(number + 1 for number in range(scenario.observation.count) if number not in chosen)
    faults = (SensorFault(kind="dropout", sensors=lost, first_step=0),) if lost else ()
    truth = scenario.truth.model_copy(update={"sensor_faults": faults})
    scenario = scenario.model_copy(update={"truth": truth, "notice": None})
    source = ReducedModelSource(scenario, reduced_model(load_design()))
    knowledge = prepare_knowledge(scenario, source, 3)
    truths = [knowledge.truth(seed) for seed in range(missions)]
    flights = fly_side_by_side(knowledge, truths, [source.open()] * missions)
    mean = knowledge.model.states.mean(flights.filtered)
    members = [Member(seed, str(seed), seed, {}) for seed in range(missions)]
    early = stored_variables(knowledge, flights, members)["early"]
    return 100.0 * np.sqrt(((mean - flights.state) ** 2).mean(axis=(0, 1))), float(
        np.mean(early > 0)
    )


def choices(knowledge: Knowledge) -> dict[str, tuple[int, ...]]:
    """Return the gauges of each way to choose, from 0."""
    mean_readings = knowledge.sensor_model.mean
    table = (mean_readings - mean_readings.mean(axis=0)).reshape(-1, mean_readings.shape[-1])
    rng = np.random.default_rng(1)
    gauges = {
        "by information": choose_sensors(draw_readings(knowledge), range(24), COUNT).sensors,
        "pivoted QR": tuple(qr(table, pivoting=True, mode="r")[1][:COUNT].tolist()),
    }
    for number in range(RANDOM):
        gauges[f"random {number + 1}"] = tuple(sorted(rng.permutation(24)[:COUNT].tolist()))
    return gauges


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--missions", type=int, default=300)
    missions = parser.parse_args().missions
    scenario = load_scenario("growing_damage").scenario
    knowledge = prepare_knowledge(
        scenario, ReducedModelSource(scenario, reduced_model(load_design())), 3
    )
    for name, chosen in {"all": tuple(range(24)), **choices(knowledge)}.items():
        error, early = flown(chosen, missions)
        gauges = ", ".join(str(number + 1) for number in chosen)
        print(
            f"{name}: rms {error[0]:.2f} and {error[1]:.2f} points, "
            f"early {100 * early:.1f} %; {gauges}"
        )


if __name__ == "__main__":
    main()
