"""Reading scenario files: TOML in, a checked `Scenario` out, and one clear sentence for whatever is wrong."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

from reporting.choices import did_you_mean
from reporting.former_names import with_present_names
from reporting.toml_file import read_toml, validate
from reporting.words import brief
from scenarios import scenario_files
from twin_master.errors import ScenarioError, said
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import CALIBRATED_DESIGN_NAME
from twin_master.scenario.tables import GAINS, MOST_DRAWS, NUMBERS_BY_DEFAULT, Noticing

PRESENT_NAMES = {
    "notice.memory_turns": "memory_steps",
    "notice.onset_turns": "onset_steps",
    "planner.inspections_a_turn": "inspections_per_step",
    "watch.seconds_per_turn": "seconds_per_step",
}
"""The present name of each key of a scenario, by the location that it had before."""

_OF_SEVERAL = ("component", "connection", "algorithm", "iterations", "tolerance")
_OF_FMUS = ("binding", "isolated", "step_timeout", "parameters", "load", "seeds")


def from_format_1(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table of format 1 as one of format 2; what is wrong with it stays wrong."""
    given = table.get("asset")
    if not isinstance(given, Mapping):
        return {**table, "format": 2, "belief": {"kind": "asset"}}
    asset = {key: value for key, value in given.items() if value not in (None, [], (), {})}
    believed, library = asset.pop("observation_model", None), asset.pop("library", None)
    design, effects = asset.pop("design", None), asset.pop("model_patch", None)
    kind = asset.pop("kind", "fmu")
    flown: dict[str, Any] = {}
    if kind == "fmu":
        kind = "fmu" if "file" in asset else "script" if "script" in asset else "design"
        flown = _of_design(design) if kind == "design" else {}
    elif kind == "coupled" and "file" in asset:
        kind = "ssp"
    if kind not in ("coupled", "ssp"):
        asset = {key: value for key, value in asset.items() if key not in _OF_SEVERAL}
    if kind == "strain_library":
        asset = {key: value for key, value in asset.items() if key not in _OF_FMUS}
    belief: dict[str, Any] = {"kind": "asset"}
    if library is not None or believed == "library":
        belief = {"kind": "library", "file": library, "design": design}
    elif believed == "design" or (design is not None and believed is None):
        belief = _of_design(design)
    if effects is not None:
        belief["patch"] = effects
    return {**table, "format": 2, "asset": {"kind": kind} | asset | flown, "belief": belief}


def _of_design(design: object) -> dict[str, Any]:
    if design == CALIBRATED_DESIGN_NAME:
        return {"kind": "calibration"}
    return {"kind": "design"} | ({} if design is None else {"design": design})


@dataclass(frozen=True)
class LoadedScenario:
    """A scenario, its file, the SHA-256 of that file's content, and a remark for its user, if any."""

    scenario: Scenario
    path: Path
    content_hash: str
    remark: str = ""

    def __repr__(self) -> str:
        return brief(self, name=self.scenario.mission.name, file=self.path.name)

    @property
    def file(self) -> dict[str, str]:
        """Name and hash of the file, by which folders of the scenario are known."""
        return {"name": self.path.name, "sha256": self.content_hash}


def find_scenario(name: str) -> Path:
    """Return the file of a shipped scenario, or of a path to a TOML file.

    Raises
    ------
    ScenarioError
        Neither a shipped scenario nor a file has this name.
    """
    shipped = scenario_files()
    if name in shipped:
        return shipped[name]
    path = Path(name)
    if path.is_file():
        return path
    sentence = said("scenario.unknown", name=name, shipped=", ".join(shipped))
    raise ScenarioError(f"{sentence}{did_you_mean(name, shipped)}")


def load_scenario(given: LoadedScenario | str | Path) -> LoadedScenario:
    """Read and check a scenario by its shipped name or its path; one that was read stays as it is.

    Where the file says nothing of `notice` the twin gives notices, if it can. `config.json` of a run says
    what was flown: nothing is added to that.

    Raises
    ------
    ScenarioError
        There is no such scenario, or the file cannot be read, is not TOML, or breaks the schema; the sentence
        names file and key.
    """
    if isinstance(given, LoadedScenario):
        return given
    path = find_scenario(str(given))
    table = read_toml(path, ScenarioError, what="scenario")
    content_hash = hashlib.sha256(path.read_bytes()).hexdigest()
    scenario, remark = parse_scenario(table, str(path)), ""
    if "notice" not in table:
        reason = why_no_notices(scenario)
        scenario = scenario.model_copy(update={"notice": None if reason else Noticing()})
        remark = f"This twin gives no notices: {reason}; `notice = false` says that it is meant so."
    return LoadedScenario(scenario, path, content_hash, remark if scenario.notice is None else "")


def why_no_notices(scenario: Scenario) -> str:
    """Return why notices are not given by themselves, in words; empty where they are."""
    observation, calibration = scenario.observation, scenario.calibration
    if observation.modes is not None:
        return "observations of modes have a covariance of their own"
    if scenario.readings:
        return "a scenario with inspections asks for them by `[notice]`"
    if observation.average_over_draws == "inside":
        return "the average over the draws is taken `inside`, so that each sensor has a parameter of its own"
    draws = 1 if calibration.source == "fixed" else min(calibration.draws, MOST_DRAWS)
    numbers = prod(len(factor.levels) for factor in scenario.state) * draws * observation.count * GAINS
    if numbers > NUMBERS_BY_DEFAULT:
        return (
            f"they take {numbers:,} numbers a step, more than {NUMBERS_BY_DEFAULT:,} (`[notice]` takes them)"
        )
    return ""


def parse_scenario(table: Mapping[str, Any], source: str) -> Scenario:
    """Return the scenario that a table (of a TOML file, or of `config.json`) describes.

    Raises
    ------
    ScenarioError
        The table breaks the schema; `source` names it in the sentence.
    """
    if table.get("format") == 1 and table["format"] is not True and "belief" not in table:
        table = from_format_1(table)
    table = with_present_names(table, PRESENT_NAMES, source, ScenarioError)
    return validate(Scenario, table, source, ScenarioError, what="a scenario")
