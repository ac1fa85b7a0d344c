"""What is flown: the scenario with the command line's overrides, and where its asset comes from."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, Literal

from pydantic import ConfigDict, Field

from reporting.toml_file import read_toml, validate
from twin_master.assets.asset_source import AssetSource, PairedSource
from twin_master.assets.parameter import is_of_parameters
from twin_master.assets.strain_library_source import FILE_NAME
from twin_master.errors import MissionInputError, said
from twin_master.network.transition import NUMBER, TRANSITION_COPIES, check_fits, transition_bytes
from twin_master.scenario.kinds import CALIBRATED_DESIGN_NAME, AssetSection
from twin_master.scenario.reading import LoadedScenario, parse_scenario
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import Section


@dataclass(frozen=True)
class Overrides:
    """What the command line says otherwise than the scenario file.

    Attributes
    ----------
    seed : int or None
        Seed of the run.
    fmu, binding : Path or None
        FMU to fly, and its binding.
    strain_library : Path or None
        Fly the library instead of an FMU, as asset and model; where the scenario flies a library anyway, the
        file of that library.
    library : Path or None
        Believe this observation library.
    learnt : Path or None
        Fly with what a fleet has learnt, the file of `uav-twin fleet learn`.
    learnt_group : str or None
        With what it has learnt of this group, where the file tells.
    in_process : bool
        Fly the FMU in this process instead of a worker.
    calibration : Path or None
        The calibration file, instead of what the scenario says of its calibration.
    ssp : Path or None
        SSP file to fly in the place of the scenario's asset.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    seed: int | None = None
    fmu: Path | None = None
    binding: Path | None = None
    strain_library: Path | None = None
    in_process: bool = False
    calibration: Path | None = None
    ssp: Path | None = None
    library: Path | None = None
    learnt: Path | None = None
    learnt_group: str | None = None


def given_overrides(given: Overrides | Mapping[str, Any] | None) -> Overrides:
    """Return overrides as a record; a mapping has the fields of `Overrides`, paths as texts too.

    Raises
    ------
    MissionInputError
        A key is no such field, or holds no such thing.
    """
    if isinstance(given, Overrides):
        return given
    where = "what differs from the scenario"
    return validate(Overrides, dict(given or {}), where, MissionInputError, what="`Overrides`")


def resolve_scenario(loaded: LoadedScenario, given: Overrides | Mapping[str, Any] | None = None) -> Scenario:
    """Return the scenario with the overrides, its paths absolute.

    Relative paths of a scenario file start at the folder of that file.

    Raises
    ------
    MissionInputError
        The overrides contradict each other, or the scenario.
    ScenarioError
        The scenario does not hold with them.
    """
    overrides = given_overrides(given)
    table = loaded.scenario.with_paths_from(loaded.path.resolve().parent).to_dict()
    _change_asset(table, overrides)
    if overrides.library:
        design = table["belief"].get("design")
        table["belief"] = {
            "kind": "library",
            "file": str(overrides.library.resolve()),
            "design": design,
        }
    if overrides.calibration:
        table["calibration"] |= {"source": "file", "file": str(overrides.calibration.resolve())}
    file = table["calibration"]["file"]
    if file and not is_of_parameters(file):
        _tailor(table)
    elif any(part.get("design") == CALIBRATED_DESIGN_NAME for part in _wings(table)):
        raise MissionInputError(said("assets.no_calibration"))
    if overrides.learnt:
        apply_learnt(table, overrides.learnt, overrides.learnt_group)
    if overrides.seed is not None:
        table["mission"]["seed"] = overrides.seed
    beside = f" with {overrides.learnt}" if overrides.learnt else ""
    return parse_scenario(table, f"{loaded.path}{beside}")


def _change_asset(table: dict[str, Any], overrides: Overrides) -> None:
    """Let something else fly; what is said of the asset stays, as far as the other kind knows it."""
    flown, library = table["asset"], overrides.strain_library
    others = {"ssp": overrides.ssp, "fmu": overrides.fmu, "strain_library": library}
    given = [(kind, file) for kind, file in others.items() if file]
    if len(given) > 1:
        raise MissionInputError("one asset flies: give one of an SSP file, --fmu and --strain-library.")
    if library and (overrides.binding or overrides.library):
        raise MissionInputError(said("assets.itself"))
    if overrides.fmu and flown["kind"] in ("coupled", "ssp"):
        raise MissionInputError(said("assets.several"))
    if given and flown.get("patch"):
        raise MissionInputError(said("assets.patch"))
    for kind, file in given:
        known = AssetSection.kinds()[kind].model_fields
        place = file / FILE_NAME if library and file.is_dir() else file
        kept = {key: value for key, value in flown.items() if key in known and value != ""}
        table["asset"] = kept | {"kind": kind, "file": str(place.resolve())}
    if library and flown["kind"] != "strain_library":
        table["belief"] = {"kind": "asset"}
    if overrides.binding:
        table["asset"]["binding"] = str(overrides.binding.resolve())
    if overrides.in_process and "isolated" in table["asset"]:
        table["asset"]["isolated"] = False


def _wings(table: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the tables that may name a design."""
    return [table["asset"], table["belief"], *table["asset"].get("component", ())]


def _tailor(table: dict[str, Any]) -> None:
    """Put the wing of the calibration file in the place of the designs that it describes."""
    asset, belief = table["asset"], table["belief"]
    if asset["kind"] == "strain_library" and belief["kind"] == "asset":
        raise MissionInputError(said("assets.own_samples"))
    believed = belief.get("design")
    for part in _wings(table):
        if part.get("design") and (part is asset or part["design"] == believed):
            part["design"] = CALIBRATED_DESIGN_NAME
            if part.get("kind") == "design":
                part["kind"] = "calibration"


_PREDICTION_COPIES = 8
"""The table, the checked copy, the copy ordered for the likelihood, and what the quantiles are taken from."""
_HISTORY_COPIES = 4
"""Belief before and after the observation, its logarithm, and the smoothed one."""


def scenario_bytes(scenario: Scenario) -> dict[str, float]:
    """Return what the twin of a scenario keeps in memory, in words with its numbers, and its size [bytes]."""
    states = prod(len(factor.levels) for factor in scenario.state)
    controls, sensors = len(scenario.control), scenario.observation.count
    steps, ahead = scenario.mission.steps, scenario.mission.prediction_steps
    draws = 1 if scenario.calibration.source == "fixed" else scenario.calibration.draws
    tables = sum(transition_bytes(len(factor.levels), controls) for factor in scenario.state)
    belief = NUMBER * (states + sensors)
    predictions = NUMBER * draws * states * controls * sensors
    return {
        f"the transitions of {len(scenario.state)} state factors under {controls} controls": TRANSITION_COPIES
        * tables,
        f"{draws} draws of {sensors} sensors in {states} states": _PREDICTION_COPIES * predictions,
        f"the beliefs of {steps} steps and {ahead} ahead": _HISTORY_COPIES * belief * (steps + ahead),
    }


def check_scenario_fits(scenario: Scenario) -> None:
    """Check that the twin of a scenario fits in memory, before anything of it is built.

    Raises
    ------
    InvalidModelError
        It does not.
    """
    check_fits(scenario_bytes(scenario), "take fewer levels, state factors, draws or steps")


def asset_source(scenario: Scenario) -> AssetSource:
    """Return what a resolved scenario flies and what its twin believes.

    Raises
    ------
    MissionInputError
        The scenario flies a strain library and names none, or one that is missing, damaged or does not fit;
        or the twin cannot believe what it is told to.
    InvalidModelError
        The twin of the scenario does not fit in memory.
    """
    check_scenario_fits(scenario)
    flown: AssetSource = scenario.asset.source(scenario)
    believed: AssetSource = scenario.belief.source(scenario, flown)
    if believed is flown:
        return flown
    return PairedSource(flown, believed, differ=scenario.another_model)


def believed_source(scenario: Scenario) -> AssetSource:
    """Return what the twin of a scenario believes; what flies is asked only where it is believed itself."""
    check_scenario_fits(scenario)
    source: AssetSource = scenario.belief.source(scenario, scenario.asset.source(scenario))
    return source


class LearntFile(Section):
    """What takes the place of tables of a scenario: for a new asset, and for groups of assets."""

    format: Literal[1]
    source: dict[str, Any] = Field(default_factory=dict)
    transition: dict[str, Any] | None = None
    observation: dict[str, Any] | None = None
    calibration: dict[str, Any] | None = None
    """Distribution of the parameter over the assets: what a new one begins with."""
    group: dict[str, dict[str, dict[str, Any]]] = Field(default_factory=dict)


def apply_learnt(table: dict[str, Any], path: Path, group: str | None = None) -> None:
    """Put what was learnt in the place of what the twin of a scenario assumes; the truth stays as it is.

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
    content = read_toml(path, MissionInputError, what="file of what was learnt")
    found = validate(LearntFile, content, str(path), MissionInputError, what="a file of what was learnt")
    learnt = found.group.get(
        group or "", found.model_dump(include={"transition", "observation", "calibration"})
    )
    truth, given = table["truth"], table["calibration"]
    if moves := learnt.get("transition"):
        own, names = (
            moves.get("probability", {}),
            sorted(entry["name"] for entry in table["control"]),
        )
        kind = table["transition"]["kind"]
        if sorted(own) != names or kind != "independent_worsening":
            both = {"own": own, "names": names}
            raise MissionInputError(said("assets.learnt_controls", path=path, **both, kind=kind))
        if truth["kind"] == "random_growth":
            truth["probability"] = truth["probability"] or table["transition"]["probability"]
    if drawn := learnt.get("calibration"):
        if drawn.get("parameter") != given["parameter"]:
            of = drawn.get("parameter"), given["parameter"]
            raise MissionInputError(said("assets.learnt_parameter", path=path, of=of))
        table["calibration"] = {"draws": given["draws"], "file": given["file"], "source": "normal"}
    for name, part in learnt.items():
        table[name] |= part or {}
