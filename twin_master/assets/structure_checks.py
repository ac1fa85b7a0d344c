"""Whether a scenario speaks of what a structure has, before anything is built."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from twin_master.assets.parameter import check_calibration
from twin_master.errors import MissingObservationModelError, MissionInputError, check_names
from twin_master.scenario.observation import ROLE
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    from fe.structure.tables import StructureDesign


def frequencies_observed(scenario: Scenario) -> int:
    """Return how many natural frequencies a scenario observes; raises `MissionInputError` for too many."""
    from fe.reduction.settings import ModalSettings

    if scenario.observation.role != "frequency":
        return 0
    count, most = scenario.observation.count, ModalSettings().mode_count
    if count > most:
        raise MissionInputError(f"a structure tells its first {most} frequencies, and {count} are observed.")
    return count


def check_observed(scenario: Scenario, design: "StructureDesign") -> None:
    """Refuse observations that a structure does not have; raises `MissingObservationModelError`.

    Titles that are its sensors in another order raise `MissionInputError`: they would name the wrong ones.
    """
    from fe.reduction.settings import ModalSettings

    where, role, modes = f"the structure {design.name}", scenario.observation.role, scenario.observation.modes
    names = {
        "strain": [part.name for part in design.gauge],
        "displacement": [part.name for part in design.displacement],
    }
    known = {name: len(sensors) for name, sensors in names.items()}
    known |= {"frequency": frequencies_observed(scenario) or 1}
    row, table = ("observation", [role], [name for name, count in known.items() if count]), role
    if modes is not None:
        known[ROLE] = scenario.observation.count
        there = [part.name for part in design.acceleration]
        row, table = ("accelerometer", [*modes.accelerometers], there), "acceleration"
        most = ModalSettings().mode_count
        if max(modes.places) >= most:
            raise MissingObservationModelError(
                f"a structure tells its first {most} modes, and mode {max(modes.places) + 1} is observed."
            )
    advice = f"give it in a table [[{table}]]"
    check_names("the scenario has the", where, [row], MissingObservationModelError, advice)
    if scenario.observation.count != known[role]:
        raise MissingObservationModelError(
            f"{where} has {known[role]} sensors of `{role}`, and the scenario expects "
            f"{scenario.observation.count}."
        )
    titles, own = [*scenario.observation.titles], names.get(role, [])
    if titles != own and sorted(titles) == sorted(own):
        raise MissionInputError(
            f"`observation.titles` are {', '.join(titles)}, and {where} has these sensors in the order "
            f"{', '.join(own)}: give the titles in that order."
        )


def check_parameter(scenario: Scenario, design: "StructureDesign", believed: Path | None) -> None:
    """Refuse a calibration that a structure cannot have; raises `MissionInputError`.

    `believed` is its file, where the twin believes it.
    """
    from fe.structure.design import structure_hash

    calibration = scenario.calibration
    if calibration.source == "static_test":
        raise MissionInputError(
            "the calibration source `static_test` is for wings: of a structure give `file`, or `normal` or "
            "`fixed` with `mean`."
        )
    known = [part.name for part in design.parameter]
    known += [part.name for part in design.mass if part.free]
    ranges = {part.name: part.range for part in (*design.parameter, *design.mass)}
    found = "" if believed is None else structure_hash(design, believed.parent)
    where = f"the structure {design.name}"
    check_calibration(calibration, known, where, ranges=ranges, design_hash=found)
    rows = [("parameter", [calibration.parameter], known)]
    check_names("the scenario calibrates the", where, rows, advice="give it in a table [[parameter]]")


def check_ranges(scenario: Scenario, design: "StructureDesign", parameters: Mapping[str, float]) -> None:
    """Refuse levels, controls and `parameters` outside the ranges of a structure; raises `MissionInputError`.

    A name that the structure does not have is passed over.
    """
    ranges = {part.name: part.range for part in (*design.parameter, *design.mass, *design.control)}
    ranges |= {part.name: (0.0, part.largest_loss) for part in design.damage}
    given = [(f"parameter {name}", name, value) for name, value in parameters.items()]
    given += [
        (f"level of {state.name}", state.name, level) for state in scenario.state for level in state.levels
    ]
    given += [
        (f"{name} of the control {control.name}", name, value)
        for control in scenario.control
        for name, value in control.values.items()
    ]
    for what, name, value in given:
        low, high = ranges.get(name, (value, value))
        if not low <= value <= high:
            raise MissionInputError(
                f"the {what} is {value:g}, but the structure {design.name} gives {name} the range {low:g} to "
                f"{high:g}; give a value inside, or widen the range in the structure file."
            )


def check_history(scenario: Scenario, design: "StructureDesign") -> None:
    """Refuse a scripted truth that leaves the ranges of the damage regions; raises `MissionInputError`."""
    last_step = scenario.mission.steps - 1
    largest = {part.name: part.largest_loss for part in design.damage}
    for state in scenario.state:  # each is a region: names were checked
        gains = np.zeros(last_step + 1)
        gains[0] = state.levels[int(np.argmax(state.prior))]
        for entry in scenario.truth.gains:
            if entry.state == state.name:
                end = entry.first_step if entry.last_step is None else entry.last_step
                gains[entry.first_step : end + 1] += entry.gain
        loss = np.cumsum(gains)
        outside = np.flatnonzero((loss < -1e-9) | (loss > largest[state.name] + 1e-9))
        if outside.size:
            raise MissionInputError(
                f"`truth.gains` bring {state.name} to {loss[outside[0]]:.6g} in {scenario.mission.step_name} "
                f"{outside[0]}, but the structure {design.name} gives it the range 0 to "
                f"{largest[state.name]:g}; give smaller gains, or another `largest_loss` in its file."
            )
