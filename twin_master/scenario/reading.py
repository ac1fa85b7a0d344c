"""Reading scenario files, from TOML to a checked `Scenario`."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path

from reporting.choices import did_you_mean
from reporting.formats.former_names import with_present_names
from reporting.formats.toml_file import read_toml, validate
from reporting.words import brief
from scenarios import scenario_files
from twin_master.errors import ScenarioError
from twin_master.scenario.kinds import CALIBRATED_DESIGN_NAME
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import Table
from twin_master.scenario.tables import (
    GAINS_PER_SENSOR,
    MOST_DRAWS,
    MOST_NUMBERS_BY_DEFAULT,
    Noticing,
)

PRESENT_NAMES = {
    "notice.memory_turns": "memory_steps",
    "notice.onset_turns": "onset_steps",
    "planner.inspections_a_turn": "inspections_per_step",
    "watch.seconds_per_turn": "seconds_per_step",
}
"""The present name of each renamed key of a scenario, by its former path."""

_KEYS_OF_COUPLED_FMUS = ("component", "connection", "algorithm", "iterations", "tolerance")
_KEYS_OF_FMUS = ("binding", "isolated", "step_timeout", "parameters", "load", "seeds")


def from_format_1(table: Mapping[str, object]) -> Table:
    """Convert the table of a scenario from format 1 to format 2.

    In format 1 the table `asset` also named the model that the twin believes. In format 2 the
    table `belief` names it. A wrong value is converted unchanged; the schema refuses it later.

    Parameters
    ----------
    table : mapping
        The content of a scenario file of format 1.

    Returns
    -------
    dict
        The content in format 2; the given table is not changed.
    """
    former_asset = table.get("asset")
    if not isinstance(former_asset, Mapping):
        return {**table, "format": 2, "belief": {"kind": "asset"}}
    # An empty value means the same as a missing key.
    asset = {key: value for key, value in former_asset.items() if value not in (None, [], (), {})}
    # The twin believes a library or a design if the keys name one, and otherwise the asset itself.
    model = asset.get("observation_model")
    library = asset.get("library")
    design = asset.get("design")
    belief: Table = {"kind": "asset"}
    if library is not None or model == "library":
        belief = {"kind": "library", "file": library, "design": design}
    elif model == "design" or (model is None and design is not None):
        belief = _table_of_design(design)
    if "model_patch" in asset:
        belief["patch"] = asset["model_patch"]
    # These keys name the believed model, which is in `belief` now.
    for key in ("observation_model", "library", "model_patch"):
        asset.pop(key, None)
    return {**table, "format": 2, "asset": _asset_of_format_1(asset), "belief": belief}


def _asset_of_format_1(former_table: Mapping[str, object]) -> Table:
    """Convert the table `asset` from format 1 to format 2.

    The caller has removed the keys on the believed model, except `design`. In format 1 the kind
    `fmu` was also used for scripts and wing designs, and the kind `coupled` for SSP files. A table
    could have keys of other kinds, which had no effect; they are removed.
    """
    asset = dict(former_table)
    design = asset.pop("design", None)
    kind = asset.pop("kind", "fmu")
    packed_design: Table = {}
    if kind == "fmu" and "file" not in former_table:
        kind = "script" if "script" in former_table else "design"
        if kind == "design":
            packed_design = _table_of_design(design)
    elif kind == "coupled" and "file" in former_table:
        kind = "ssp"
    unused_keys: tuple[str, ...] = ()
    if kind not in ("coupled", "ssp"):
        unused_keys += _KEYS_OF_COUPLED_FMUS
    if kind == "strain_library":
        unused_keys += _KEYS_OF_FMUS
    for key in unused_keys:
        asset.pop(key, None)
    return {"kind": kind} | asset | packed_design


def _table_of_design(design: object) -> Table:
    """Return the table that names a wing design; the schema reports a missing name."""
    if design == CALIBRATED_DESIGN_NAME:
        return {"kind": "calibration"}
    if design is None:
        return {"kind": "design"}
    return {"kind": "design", "design": design}


@dataclass(frozen=True)
class LoadedScenario:
    """A scenario that was read from a file.

    Attributes
    ----------
    scenario : Scenario
        The scenario of the mission, checked.
    path : Path
        The path of the file.
    content_hash : str
        The SHA-256 of the file's content.
    remark : str
        A sentence for the user; empty if there is none.
    """

    scenario: Scenario
    path: Path
    content_hash: str
    remark: str = ""

    def __repr__(self) -> str:
        return brief(self, name=self.scenario.mission.name, file=self.path.name)

    @property
    def file(self) -> dict[str, str]:
        """The name and hash of the file, which the folders of its runs contain."""
        return {"name": self.path.name, "sha256": self.content_hash}


def find_scenario(name: str) -> Path:
    """Return the path of a scenario file.

    Parameters
    ----------
    name : str
        The name of a shipped scenario, or the path of a TOML file.

    Raises
    ------
    ScenarioError
        If the name is neither that of a shipped scenario nor the path of a file.
    """
    shipped = scenario_files()
    if name in shipped:
        return shipped[name]
    path = Path(name)
    if path.is_file():
        return path
    raise ScenarioError(
        f"There is no scenario `{name}`: give the path of a TOML file or one of "
        f"{', '.join(shipped)}.{did_you_mean(name, shipped)}"
    )


def load_scenario(scenario_or_file: LoadedScenario | str | Path) -> LoadedScenario:
    """Read and check a scenario file, and switch the alarms of its twin on by default.

    A file without the key `notice` gets the default table `notice`, unless `obstacle_to_notices`
    gives a reason against it, which then is the remark of the result. (The scenario of a past run,
    in `config.json`, is read by `parse_scenario` alone, which adds no such default.)

    Parameters
    ----------
    scenario_or_file : LoadedScenario, str or Path
        The name of a shipped scenario, or the path of a file. A `LoadedScenario` is returned
        unchanged.

    Returns
    -------
    LoadedScenario
        The scenario with its path, the hash of the file, and a remark for the user.

    Raises
    ------
    ScenarioError
        If there is no such scenario, the file cannot be read or is not TOML, or a key of it is
        unknown, missing or has a wrong value. The message names the file and the key.
    """
    if isinstance(scenario_or_file, LoadedScenario):
        return scenario_or_file
    path = find_scenario(str(scenario_or_file))
    table = read_toml(path, ScenarioError, what="scenario")
    content_hash = hashlib.sha256(path.read_bytes()).hexdigest()
    scenario = parse_scenario(table, str(path))
    if "notice" in table:
        return LoadedScenario(scenario, path, content_hash)
    obstacle = obstacle_to_notices(scenario)
    if obstacle:
        scenario = scenario.model_copy(update={"notice": None})
        remark = (
            f"This twin gives no notices: {obstacle}; write `notice = false` if this is intended."
        )
        return LoadedScenario(scenario, path, content_hash, remark)
    scenario = scenario.model_copy(update={"notice": Noticing()})
    return LoadedScenario(scenario, path, content_hash)


def obstacle_to_notices(scenario: Scenario) -> str:
    """Return the reason why a scenario gives no alarms by default; empty if it does give them."""
    observation = scenario.observation
    if observation.modes is not None:
        return "observations of modes have a covariance of their own"
    if scenario.inspection_readings:
        return "a scenario with inspections needs a table `[notice]` for them"
    if observation.average_over_draws == "inside":
        return (
            "the average over the draws is taken `inside`, so that each sensor has a parameter of "
            "its own"
        )
    # The belief about the sensors has one number for each joint state, draw of the parameter,
    # sensor and compared gain error; all of them are updated in each step.
    state_count = prod(len(factor.levels) for factor in scenario.state)
    draw_count = min(scenario.calibration.draw_count, MOST_DRAWS)
    belief_size = state_count * draw_count * observation.count * GAINS_PER_SENSOR
    if belief_size > MOST_NUMBERS_BY_DEFAULT:
        return (
            f"they take {belief_size:,} numbers a step, more than {MOST_NUMBERS_BY_DEFAULT:,} "
            "(a table `[notice]` allows them)"
        )
    return ""


def parse_scenario(table: Mapping[str, object], source: str) -> Scenario:
    """Check the content of a scenario file, and return it as a `Scenario`.

    Files of earlier versions are converted first: those of format 1, and those with former names
    of keys.

    Parameters
    ----------
    table : mapping
        The content of a TOML file, or the scenario in the `config.json` of a run.
    source : str
        The name of the file, with which an error message begins.

    Returns
    -------
    Scenario
        The scenario, in SI units.

    Raises
    ------
    ScenarioError
        If a key is unknown, missing or has a wrong value, or two keys contradict each other.
    """
    file_format = table.get("format")
    # In Python `True == 1`; the format `true` is not converted here, so that the schema refuses it.
    is_format_1 = file_format == 1 and file_format is not True
    # Only format 2 has the table `belief`. A file with it that says 1 has a wrong number, which the
    # schema refuses.
    if is_format_1 and "belief" not in table:
        table = from_format_1(table)
    table = with_present_names(table, PRESENT_NAMES, source, ScenarioError)
    table = _without_method(table)
    return validate(Scenario, table, source, ScenarioError, what="a scenario")


def _without_method(table: Mapping[str, object]) -> Mapping[str, object]:
    """Return a scenario without `calibration.method = "exact"`, a key of former versions.

    The static test is always evaluated exactly now. The schema refuses any other value of the key.
    """
    calibration = table.get("calibration")
    if not isinstance(calibration, Mapping) or calibration.get("method") != "exact":
        return table
    remaining_keys = {key: value for key, value in calibration.items() if key != "method"}
    return {**table, "calibration": remaining_keys}
