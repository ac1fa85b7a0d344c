"""What a fleet has learnt, as a file that a scenario is flown with: `learnt.toml`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from reporting.section import checked
from reporting.toml_file import read_toml
from twin_master.errors import MissionInputError
from twin_master.scenario.section import NotNegative, Number, PerSensor, Probability, Section

__all__ = ["LearntFile", "LearntTables", "apply_learnt", "load_learnt"]


class LearntTransition(Section):
    """Probabilities to worsen, as in a scenario."""

    probability: dict[str, Probability | dict[str, Probability]]


class LearntObservation(Section):
    """Noise of the sensors, as in a scenario."""

    standard_deviation: PerSensor


class LearntCalibration(Section):
    """Distribution of the parameter over the assets: what a new one begins with."""

    parameter: str
    mean: Number
    standard_deviation: NotNegative


class LearntTables(Section):
    """What takes the place of the tables of a scenario."""

    transition: LearntTransition | None = None
    observation: LearntObservation | None = None
    calibration: LearntCalibration | None = None


class LearntFile(LearntTables):
    """A whole file: what holds for a new asset, and for each group that it was learnt from."""

    format: Literal[1]
    source: dict[str, Any] = Field(default_factory=dict)
    group: dict[str, LearntTables] = Field(default_factory=dict)


def load_learnt(path: Path | str) -> LearntFile:
    """Read a file that `uav-twin fleet learn` wrote.

    Raises
    ------
    MissionInputError
        It cannot be read, or is none.
    """
    table = read_toml(path, MissionInputError, what="file of what was learnt")
    return checked(LearntFile, table, str(path), MissionInputError, what="a file of what was learnt")


def apply_learnt(table: dict[str, Any], path: Path, group: str | None = None) -> None:
    """Put what was learnt in the place of what the table of a scenario says.

    Parameters
    ----------
    table : dict
        Of a scenario, in SI; changed.
    path : Path
        Of the file.
    group : str, optional
        Its group: what was learnt of it where the file tells, else what holds for all.

    Raises
    ------
    MissionInputError
        The file is none, or is of other controls or another parameter.
    """
    found = load_learnt(path)
    learnt: LearntTables = found.group.get(group or "", found)
    if learnt.transition is not None:
        names = {entry["name"] for entry in table["control"]}
        if {*learnt.transition.probability} != names or table["transition"][
            "kind"
        ] != "independent_worsening":
            raise MissionInputError(
                f"{path} has probabilities for {', '.join(learnt.transition.probability)}, and the scenario "
                f"has the controls {', '.join(sorted(names))} and transitions of the kind "
                f"{table['transition']['kind']}."
            )
        table["transition"]["probability"] = dict(learnt.transition.probability)
    if learnt.observation is not None:
        table["observation"]["standard_deviation"] = learnt.observation.standard_deviation
    if learnt.calibration is not None:
        given: Mapping[str, Any] = table["calibration"]
        if learnt.calibration.parameter != given["parameter"]:
            raise MissionInputError(
                f"{path} has learnt {learnt.calibration.parameter}, and the parameter of the scenario is "
                f"{given['parameter']}."
            )
        kept = {key: given[key] for key in ("parameter", "draws")}
        table["calibration"] = {
            **kept,
            "source": "normal",
            "mean": learnt.calibration.mean,
            "standard_deviation": learnt.calibration.standard_deviation,
        }
