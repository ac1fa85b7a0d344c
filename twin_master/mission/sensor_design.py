"""Which sensors tell most: the information that their readings are expected to give about the state.

The information of a set of sensors is the mean, over readings that are drawn in states that are all alike
probable, of the logarithm of the posterior probability of the true state over the prior one. What moves all
sensors together (a place between levels, the calibrated parameter) is accounted for as that. A structure may
have candidates beside the gauges that its file declares.
"""

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.special import logsumexp

from fe.runtime.errors import InvalidDesignError
from fe.structure.design import Gauge, Gauged, MeshDesign, load_structure, parse_structure
from fe.structure.gauges import evenly_placed_rosettes, gauge_rows
from fe.structure.mesh import StructureMesh
from fe.structure.mesh_file import read_mesh
from reporting.arrays import Float, Index
from reporting.files import write_members
from reporting.toml_file import read_toml, validate
from twin_master.assets.asset_source import read_files
from twin_master.assets.structure_source import MODEL_COPY, StructureBelief
from twin_master.errors import MissionInputError, said
from twin_master.mission.preparation import Knowledge
from twin_master.scenario.schema import Scenario
from twin_master.seeds import generator

SAMPLES = 300
"""Readings that are drawn for each control, about: as many in each state, or one in each of so many."""
_GAIN = 1e-9
"""Bits that an exchange of two sensors gains at least."""


@dataclass(frozen=True)
class Readings:
    """Readings that were drawn under one control, as sums over sensors need them.

    Attributes
    ----------
    state : (N,)
        In which each was drawn.
    residual : (N, S, G)
        From what each state shows, in standard deviations.
    moved : (S, G, F)
        What moves all sensors together, likewise.
    log_scale : (S, G)
        Logarithm of the standard deviations.
    """

    state: Index
    residual: Float
    moved: Float
    log_scale: Float

    @cached_property
    def _of_each(self) -> tuple[Float, Float, Float]:
        """Squares (G, N, S), shares along what moves all (G, S, N, F), and products of these (G, S, F, F)."""
        residual, moved = self.residual.transpose(2, 0, 1), self.moved.transpose(1, 0, 2)
        along = residual.swapaxes(1, 2)[..., None] * moved[:, :, None]
        return residual**2, along, moved[..., None] * moved[..., None, :]

    def information(self, sensors: Sequence[int]) -> float:
        """Return the expected information of a set of sensors about the state [bit]."""
        chosen = list(sensors)
        squared, along, together = (each[chosen].sum(axis=0) for each in self._of_each)
        together = together + np.eye(along.shape[-1])
        squared -= np.sum(np.matmul(along, np.linalg.inv(together)) * along, axis=-1).T
        log_density = -0.5 * (squared + np.linalg.slogdet(together)[1])
        log_density -= self.log_scale[:, chosen].sum(axis=1)
        true = log_density[np.arange(len(self.state)), self.state]
        mean = logsumexp(log_density, axis=1) - np.log(log_density.shape[1])
        return float((true - mean).mean() / np.log(2.0))


def drawn_readings(knowledge: Knowledge) -> tuple[Readings, ...]:
    """Return readings that are drawn under each control that is no action."""
    sensors, states = knowledge.sensor_model, knowledge.model.states.size
    draws = generator(knowledge.scenario.mission.seed, "planning")
    spread = sensors.value_per_draw - sensors.mean
    found = []
    for control in range(len(knowledge.scenario.control) - len(knowledge.scenario.action)):
        deviation = sensors.independent_standard_deviation[:, control]
        some = np.arange(states) if states <= SAMPLES else draws.permutation(states)[:SAMPLES]
        state = np.tile(some, round(SAMPLES / len(some)))
        shown = sensors.draw_observations(state, control, draws)[:, : sensors.sensor_count]
        # The draws move all sensors along one direction, as far as they depend on the parameter linearly.
        root = np.sqrt(sensors.draw_weight)[:, None, None] * spread[:, :, control]
        _, size, direction = np.linalg.svd(root.swapaxes(0, 1), full_matrices=False)
        along = size[:, :1, None] * direction[:, :1]
        moved = np.concatenate((sensors.interval[:, control], along.swapaxes(1, 2)), axis=-1)
        residual = (shown[:, None] - sensors.mean[:, control]) / deviation
        found.append(Readings(state, residual, moved / deviation[..., None], np.log(deviation)))
    return tuple(found)


@dataclass(frozen=True)
class SensorDesign:
    """A choice of sensors.

    Attributes
    ----------
    sensors : tuple of int
        From 0, the one that tells most first.
    information : tuple of float
        Of the first, the first two, ... of them [bit].
    of_all : float
        Of all candidates [bit].
    """

    sensors: tuple[int, ...]
    information: tuple[float, ...]
    of_all: float


def chosen_sensors(readings: Sequence[Readings], candidates: Sequence[int], count: int) -> SensorDesign:
    """Choose the sensors that tell most: one after the other, then exchanged as long as that tells more.

    Parameters
    ----------
    readings : sequence of Readings
        Of each control; their information is averaged.
    candidates : sequence of int
        Sensors to choose from, from 0.
    count : int
        Of sensors to choose.

    Raises
    ------
    MissionInputError
        There are fewer candidates.
    """
    if not 1 <= count <= len(candidates):
        raise MissionInputError(said("mission.sensors", most=len(candidates), count=count))

    def information(sensors: Sequence[int]) -> float:
        return float(np.mean([under.information(sensors) for under in readings]))

    def best_of(sets: list[list[int]]) -> tuple[float, list[int]]:
        return max(((information(some), some) for some in sets), key=lambda pair: pair[0])

    def grown(pool: Sequence[int], size: int) -> list[int]:
        found: list[int] = []
        while len(found) < size:
            found = best_of([[*found, other] for other in pool if other not in found])[1]
        return found

    chosen = grown(candidates, count)
    told = information(chosen)
    while len(candidates) > count:
        others = [other for other in candidates if other not in chosen]
        exchanged = [
            [*chosen[:place], other, *chosen[place + 1 :]] for place in range(count) for other in others
        ]
        better, found = best_of(exchanged)
        if better <= told + _GAIN:
            break
        told, chosen = better, found
    ordered = grown(chosen, count)
    return SensorDesign(
        tuple(ordered),
        tuple(information(ordered[: place + 1]) for place in range(count)),
        information(list(candidates)),
    )


def separations(
    knowledge: Knowledge, readings: Sequence[Readings], sensors: Sequence[int]
) -> dict[tuple[str, int], float]:
    """Return how far each level of a state is from the next one, by a set of sensors.

    In standard deviations of what they show, under the control that tells most, with the other states at
    their lowest levels; by the name of the state and the number of the lower level, from 0.
    """
    states, mean, chosen = knowledge.model.states, knowledge.sensor_model.mean, list(sensors)
    index = np.arange(states.size).reshape(states.shape)
    found = {}
    for axis, factor in enumerate(states.factors):
        line = np.moveaxis(index, axis, 0).reshape(len(factor.levels), -1)[:, 0]
        for level, (low, high) in enumerate(itertools.pairwise(line)):
            apart = []
            for control, under in enumerate(readings):
                scale, moved = np.exp(-under.log_scale[low, chosen]), under.moved[low, chosen]
                shift = (mean[high, control, chosen] - mean[low, control, chosen]) * scale
                cover = np.eye(len(chosen)) + moved @ moved.T
                apart.append(float(shift @ np.linalg.solve(cover, shift)))
            found[factor.name, level] = max(apart) ** 0.5
    return found


def with_candidates(scenario: Scenario, candidates: str, folder: Path) -> Scenario:
    """Return a scenario whose structure has more gauges, which are sensors.

    In their order they stand behind the gauges that the file had and before those of its rosettes.

    Parameters
    ----------
    scenario : Scenario
        Its paths absolute.
    candidates : str
        At most how many rosettes are spread over the surface, or a TOML file with tables `gauge` and
        `rosette` as a structure file has them.
    folder : Path
        Where the structure file with the gauges is put.

    Raises
    ------
    MissionInputError
        What is believed is no structure from a mesh, the sensors are no strain gauges that are all alike, no
        place is asked for, or the structure file has its gauges in a list.
    InvalidDesignError
        The candidates are wrong; the sentence names the place.
    """
    observation, belief = scenario.observation, scenario.belief
    alike = (observation.standard_deviation, observation.model_error, scenario.rewards.error_scale)
    if any(isinstance(one, tuple) for one in alike) or observation.role != "strain":
        raise MissionInputError("--candidates needs strain gauges of one standard deviation and error scale.")
    own = isinstance(belief, StructureBelief) and load_structure(belief.all_files()[MODEL_COPY])
    if not isinstance(belief, StructureBelief) or not isinstance(own, MeshDesign):
        raise MissionInputError("--candidates needs a structure from a mesh as what is believed.")
    if candidates.isdecimal() and not int(candidates):
        raise MissionInputError("--candidates needs at least one place.")
    write_members(folder, read_files(belief.all_files()))
    file = folder / MODEL_COPY
    source = Path(belief.all_files()[MODEL_COPY]).parent / own.mesh  # this one stays
    mesh = read_mesh(source, own.unit, own.length_unit)
    gauges = _gauges(candidates, mesh)
    with file.open("a", encoding="utf-8") as text:
        for gauge in gauges:
            rows = (f"{key} = {json.dumps(value)}\n" for key, value in gauge.model_dump().items())
            text.write("".join(("\n[[gauge]]\n", *rows)))
    before, names = ([part.name for part in design.gauge] for design in (own, _joined(file, candidates)))
    try:
        gauge_rows(mesh, gauges)
    except InvalidDesignError as error:
        raise InvalidDesignError(f"--candidates {candidates}: {error}") from error
    known = dict(zip(before, observation.titles or before, strict=True))
    chosen, titles = scenario.rewards.health_sensors, tuple(known.get(name, name) for name in names)
    limited = range(1, len(before) + 1) if chosen == "all" else chosen
    health = tuple(names.index(before[number - 1]) + 1 for number in limited)
    return scenario.model_copy(
        update={
            "belief": belief.model_copy(update={"structure": str(file)}),
            "observation": observation.model_copy(update={"count": len(names), "titles": titles}),
            "rewards": scenario.rewards.model_copy(update={"health_sensors": health}),
            "learning": None,
            "notice": None,
        }
    )


def _joined(file: Path, candidates: str) -> MeshDesign:
    """Return the structure with the gauges; its file is a copy, so that what is wrong names the option."""
    try:
        content = read_toml(file, InvalidDesignError)
    except InvalidDesignError as error:  # it could be read before
        raise MissionInputError(said("assets.candidates")) from error
    design = parse_structure(content, f"--candidates {candidates}")
    assert isinstance(design, MeshDesign)
    return design


def _gauges(candidates: str, mesh: StructureMesh) -> tuple[Gauge, ...]:
    if candidates.isdecimal():
        spread = evenly_placed_rosettes(mesh, int(candidates))
        return tuple(gauge for one in spread for gauge in one.gauges())
    content = read_toml(candidates, InvalidDesignError)
    found = validate(Gauged, content, candidates, InvalidDesignError, what="a file of gauges").gauge
    if not found:
        raise InvalidDesignError(f"{candidates}: a table [[gauge]] or [[rosette]] is expected.")
    return found
