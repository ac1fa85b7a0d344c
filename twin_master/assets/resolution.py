"""A scenario with the overrides of the command line, and the sources of its asset and model."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Literal, TypeAlias

from pydantic import ConfigDict, Field

from reporting.formats.toml_file import read_toml, validate
from reporting.words import comma_list
from twin_master.assets.asset_source import NO_ASSET, AssetSource, PairedSource, WatchedSource
from twin_master.assets.parameter import NO_CALIBRATED_DESIGN, is_of_parameters
from twin_master.assets.strain_library_source import FILE_NAME
from twin_master.errors import MissionInputError
from twin_master.network.transition import (
    BYTES_OF_NUMBER,
    TRANSITION_COPIES,
    check_fits,
    transition_bytes,
)
from twin_master.scenario.kinds import CALIBRATED_DESIGN_NAME, AssetSection
from twin_master.scenario.reading import LoadedScenario, parse_scenario
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import Section, Table


@dataclass(frozen=True)
class Overrides:
    """Settings of the command line that override the scenario file.

    Attributes
    ----------
    seed : int or None
        The seed of the run.
    fmu, binding : Path or None
        The FMU to fly, and its binding.
    strain_library : Path or None
        The strain library that replaces an FMU, as asset and as model; or the file of the strain
        library that the scenario flies.
    library : Path or None
        The observation library to believe.
    learnt : Path or None
        The file of `uav-twin fleet learn`, whose results the twin assumes.
    learnt_group : str or None
        The group whose results are used, if the file has it.
    in_process : bool
        Whether the FMU flies in this process instead of a worker.
    calibration : Path or None
        The calibration file, instead of what the scenario states of its calibration.
    ssp : Path or None
        The SSP file to fly instead of the scenario's asset.
    no_notices : bool
        Whether the twin gives no notices and alarms, even if the scenario asks for them.
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
    no_notices: bool = False


OverridesOrMapping: TypeAlias = Overrides | Mapping[str, object]
"""Overrides, or a mapping from their names to their values."""


def as_overrides(overrides: OverridesOrMapping | None) -> Overrides:
    """Return overrides of a scenario, such as another FMU, as a checked record.

    Parameters
    ----------
    overrides : Overrides or mapping, optional
        A record, or a mapping from its fields to values; a path may be a text.

    Raises
    ------
    MissionInputError
        If a key is not a field of `Overrides`, or a value has the wrong type.
    """
    if isinstance(overrides, Overrides):
        return overrides
    where = "what differs from the scenario"
    return validate(Overrides, dict(overrides or {}), where, MissionInputError, what="`Overrides`")


def resolve_scenario(
    loaded_scenario: LoadedScenario, overrides: OverridesOrMapping | None = None
) -> Scenario:
    """Return the scenario with the overrides and with absolute paths.

    A relative path in a scenario file is relative to the folder of that file.

    Parameters
    ----------
    overrides : Overrides or mapping, optional
        The values that replace those of the scenario.

    Raises
    ------
    MissionInputError
        If the overrides contradict each other, or the scenario.
    ScenarioError
        If the scenario with the overrides has an unknown or missing key, or a wrong value.
    """
    overrides = as_overrides(overrides)
    folder = loaded_scenario.path.resolve().parent
    table = loaded_scenario.scenario.with_paths_from(folder).to_dict()
    _override_asset(table, overrides)
    if overrides.library:
        design = table["belief"].get("design")
        file = str(overrides.library.resolve())
        table["belief"] = {"kind": "library", "file": file, "design": design}
    if overrides.calibration:
        table["calibration"]["source"] = "file"
        table["calibration"]["file"] = str(overrides.calibration.resolve())
    # A calibration of a wing contains the calibrated design, which replaces those of the scenario.
    calibration_file = table["calibration"]["file"]
    if calibration_file and not is_of_parameters(calibration_file):
        _use_calibrated_design(table)
    elif any(
        design_table.get("design") == CALIBRATED_DESIGN_NAME
        for design_table in _design_tables(table)
    ):
        raise MissionInputError(NO_CALIBRATED_DESIGN)
    source = str(loaded_scenario.path)
    if overrides.learnt:
        apply_learnt(table, overrides.learnt, overrides.learnt_group)
        source += f" with {overrides.learnt}"
    if overrides.seed is not None:
        table["mission"]["seed"] = overrides.seed
    if overrides.no_notices:
        table["notice"] = False
    return parse_scenario(table, source)


def _override_asset(table: Table, overrides: Overrides) -> None:
    """Replace the asset of a scenario's table, in place, if the overrides name another.

    The keys of the scenario's asset are kept if the kind of the new asset has them.
    """
    former_asset = table["asset"]
    library = overrides.strain_library
    files_by_kind = {"ssp": overrides.ssp, "fmu": overrides.fmu, "strain_library": library}
    given_files = {kind: file for kind, file in files_by_kind.items() if file}
    _check_asset_overrides(former_asset, overrides, len(given_files))
    for kind, file in given_files.items():  # there is one at most
        keys_of_kind = AssetSection.kinds()[kind].model_fields
        asset = {
            key: value for key, value in former_asset.items() if key in keys_of_kind and value != ""
        }
        if kind == "strain_library" and file.is_dir():
            file = file / FILE_NAME
        table["asset"] = asset | {"kind": kind, "file": str(file.resolve())}
    if library and former_asset["kind"] != "strain_library":
        table["belief"] = {"kind": "asset"}
    if overrides.binding:
        table["asset"]["binding"] = str(overrides.binding.resolve())
    if overrides.in_process and "isolated" in table["asset"]:
        table["asset"]["isolated"] = False


def _check_asset_overrides(asset: Table, overrides: Overrides, file_count: int) -> None:
    """Refuse overrides that contradict each other or the table of the asset.

    `file_count` is the number of overrides that replace the asset: an FMU, an SSP file, and a
    strain library.
    """
    if file_count > 1:
        raise MissionInputError(
            "only one asset can fly: give only one of an SSP file, --fmu and --strain-library."
        )
    if overrides.strain_library and (overrides.binding or overrides.library):
        raise MissionInputError(
            "--strain-library replaces both asset and model: give it without --binding and "
            "--library."
        )
    if overrides.fmu and asset["kind"] in ("coupled", "ssp"):
        raise MissionInputError(
            "--fmu replaces one FMU, but the scenario couples several: change its components."
        )
    if file_count and asset.get("patch"):
        raise MissionInputError(
            "`asset.patch` belongs to an FMU that is packed from a design, but another asset "
            "flies: leave `asset.patch` out."
        )


def _design_tables(table: Table) -> list[Table]:
    """Return the tables of a scenario that may name a design."""
    return [table["asset"], table["belief"], *table["asset"].get("component", ())]


def _use_calibrated_design(table: Table) -> None:
    """Let a scenario's table, in place, name the calibrated design instead of designs of its own.

    Replaced are the design of the asset, the design that the twin believes, and the designs of
    components that equal the believed one.
    """
    asset = table["asset"]
    belief = table["belief"]
    if asset["kind"] == "strain_library" and belief["kind"] == "asset":
        raise MissionInputError(
            "a strain library brings its own samples of its parameter: fly it without a "
            "calibration file."
        )
    believed_design = belief.get("design")
    for design_table in _design_tables(table):
        design = design_table.get("design")
        if design and (design_table is asset or design == believed_design):
            design_table["design"] = CALIBRATED_DESIGN_NAME
            if design_table.get("kind") == "design":
                design_table["kind"] = "calibration"


_PREDICTION_COPIES = 8
"""Copies of the predictions in memory: the table, the checked one, the one ordered for the
likelihood, and those sorted for quantiles."""
_HISTORY_COPIES = 4
"""Copies of the beliefs: before and after the observation, its logarithm, and the smoothed one."""


def memory_of_scenario(scenario: Scenario) -> dict[str, float]:
    """Return how much memory the arrays of a scenario's twin need, approximately.

    Returns
    -------
    dict of str to float
        The size of each group of arrays [bytes], by a description for the message: transitions,
        predictions and beliefs.
    """
    state_count = prod(len(factor.levels) for factor in scenario.state)
    control_count = len(scenario.control)
    sensor_count = scenario.observation.count
    draw_count = scenario.calibration.draw_count
    steps = scenario.mission.steps
    steps_ahead = scenario.mission.prediction_steps

    transitions = f"{len(scenario.state)} state factors under {control_count} controls"
    transition_sizes = [
        transition_bytes(len(factor.levels), control_count) for factor in scenario.state
    ]
    predictions = f"{draw_count} draws of {sensor_count} sensors in {state_count} states"
    prediction_size = BYTES_OF_NUMBER * draw_count * state_count * control_count * sensor_count
    step_size = BYTES_OF_NUMBER * (state_count + sensor_count)
    return {
        f"the transitions of {transitions}": TRANSITION_COPIES * sum(transition_sizes),
        predictions: _PREDICTION_COPIES * prediction_size,
        f"the beliefs of {steps} steps and {steps_ahead} ahead": (
            _HISTORY_COPIES * step_size * (steps + steps_ahead)
        ),
    }


def check_scenario_fits(scenario: Scenario) -> None:
    """Check that the twin of a scenario fits in memory, before anything of it is built.

    Raises
    ------
    InvalidModelError
        If it does not fit.
    """
    check_fits(memory_of_scenario(scenario), "take fewer levels, state factors, draws or steps")


def asset_source(scenario: Scenario) -> AssetSource:
    """Return the source of a scenario's asset and of the twin's predictions.

    Parameters
    ----------
    scenario : Scenario
        A scenario as `resolve_scenario` returns it.

    Raises
    ------
    MissionInputError
        If the scenario has no asset; if its strain library is not named, is missing or damaged, or
        does not fit; or if the believed model does not go with the asset.
    InvalidModelError
        If the twin of the scenario does not fit in memory.
    """
    check_scenario_fits(scenario)
    flown_source: AssetSource = scenario.asset.source(scenario)
    believed_source: AssetSource = scenario.belief.source(scenario, flown_source)
    if believed_source is flown_source:  # `belief.kind` is `asset`
        return flown_source
    if isinstance(flown_source, WatchedSource):
        raise MissionInputError(NO_ASSET)
    return PairedSource(flown_source, believed_source, differ=scenario.models_differ)


def believed_source(scenario: Scenario) -> AssetSource:
    """Return the source of the predictions of a scenario's twin.

    Parameters
    ----------
    scenario : Scenario
        A scenario as `resolve_scenario` returns it; it may lack an asset.

    Raises
    ------
    MissionInputError
        If the believed model does not go with the asset.
    InvalidModelError
        If the twin of the scenario does not fit in memory.
    """
    check_scenario_fits(scenario)
    source: AssetSource = scenario.belief.source(scenario, scenario.asset.source(scenario))
    return source


class LearntFile(Section):
    """What replaces tables of a scenario: for a new asset, and for groups of assets."""

    format: Literal[1]
    """Version of the format."""
    source: Table = Field(default_factory=dict)
    """The fleet from which it was learnt."""
    transition: Table | None = None
    """Keys of the table `transition` of a scenario: probabilities to worsen."""
    observation: Table | None = None
    """Keys of the table `observation` of a scenario: noise of the sensors."""
    calibration: Table | None = None
    """Keys of the table `calibration` of a scenario: the distribution of the parameter over the
    assets, with which a new one begins."""
    group: dict[str, dict[str, Table]] = Field(default_factory=dict)
    """The tables of each group of assets, by its name."""

    def tables_of_group(self, group: str | None) -> dict[str, Table]:
        """Return the tables of a group; if the file lacks the group, those of a new asset."""
        if group in self.group:
            return self.group[group]
        tables = {
            "transition": self.transition,
            "observation": self.observation,
            "calibration": self.calibration,
        }
        return {name: table for name, table in tables.items() if table is not None}


def apply_learnt(table: Table, path: Path, group: str | None = None) -> None:
    """Replace assumptions in a scenario's table, in place, by what was learnt from a fleet.

    These are the transitions, the sensor noise and the distribution of the parameter. The ground
    truth of the scenario stays the same.

    Parameters
    ----------
    table : dict
        The table of a scenario, in SI; it is changed.
    group : str, optional
        The group of assets. If the file does not have the group, the tables for a new asset are
        used.

    Raises
    ------
    MissionInputError
        If the file cannot be read or has other tables, or its controls or parameter are not those
        of the scenario.
    """
    content = read_toml(path, MissionInputError, what="file of what was learnt")
    learnt_file = validate(
        LearntFile, content, str(path), MissionInputError, what="a file of what was learnt"
    )
    learnt = learnt_file.tables_of_group(group)
    if learnt.get("transition"):
        learnt_controls = learnt["transition"].get("probability", {})
        controls = sorted(control["name"] for control in table["control"])
        kind = table["transition"]["kind"]
        if sorted(learnt_controls) != controls or kind != "independent_worsening":
            raise MissionInputError(
                f"{path} has probabilities for {comma_list(learnt_controls)}, but the scenario has "
                f"the controls {comma_list(controls)} and transitions of the kind {kind}."
            )
        truth = table["truth"]
        if truth["kind"] == "random_growth" and not truth["probability"]:
            # Without probabilities of its own the truth has those of the twin. It keeps the ones
            # that the scenario states, although the twin now assumes the learnt ones.
            truth["probability"] = table["transition"]["probability"]
    if learnt.get("calibration"):
        learnt_parameter = learnt["calibration"].get("parameter")
        calibration = table["calibration"]
        if learnt_parameter != calibration["parameter"]:
            raise MissionInputError(
                f"{path} has learnt {learnt_parameter}, and the parameter of the scenario is "
                f"{calibration['parameter']}."
            )
        kept_keys = {"draws": calibration["draws"], "file": calibration["file"]}
        table["calibration"] = {**kept_keys, "source": "normal"}
    for name, learnt_table in learnt.items():
        table[name] |= learnt_table  # its keys replace those of the scenario
