"""Assets under control, and sources, which prepare assets or predict their observations.

An asset receives the control and its true health in each step, and returns its observation without
noise. An asset with damage and sensors of its own also returns its true state and the readings of
its sensors. The `Plant` steps the asset; the twin never has access to it.

A mission uses a source only through `AssetSource`. The files of this folder whose names end in
`_source` each contain the tables that a user writes for some kinds, and their sources.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar, Literal, NoReturn

import numpy as np

from fmu_asset.errors import FmuCallError
from reporting.arrays import Float
from reporting.files import hash_file, write_members
from reporting.json_file import JsonRecord
from reporting.progress import Progress
from reporting.text_file import read_bytes
from twin_master.assets.parameter import ParameterDraws, draw_parameter
from twin_master.errors import MissionInputError
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.kinds import AssetSection, BeliefSection, FileSection
from twin_master.scenario.mission import CALIBRATION_COPY
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    from fe.runtime.reduced import ReducedModel

BINDING_COPY = "asset/binding.toml"
PATCH_COPY = "asset/patch.json"
MODEL_PATCH_COPY = "asset/model_patch.json"
LIBRARY_COPY = "asset/UAVconfig.json"
OBSERVATIONS_COPY = "asset/observation_library.nc"
SSP_COPY = "asset/system.ssp"
HASHED_COPIES = {
    "binding": BINDING_COPY,
    "calibration": CALIBRATION_COPY,
    "patch": PATCH_COPY,
    "model_patch": MODEL_PATCH_COPY,
    "observation_library": OBSERVATIONS_COPY,
    "ssp": SSP_COPY,
    "strain_library": LIBRARY_COPY,
}
"""The copies of files in a run folder whose hashes the run records, by the names of the hashes."""
FLOWN_DESIGN_HASH = "flown_design"
"""Name of the hash of the wing design that flies; that of the believed design is `design`."""
NO_ASSET = (
    "this scenario has no `[asset]`: it is for a real asset, whose observations `uav-twin watch` "
    "reads, and its `belief` must be a model of its own."
)


@dataclass(frozen=True)
class AssetReading:
    """The result of one step of an asset.

    Attributes
    ----------
    values : (G,) array
        The observation without noise in its SI unit.
    monitors : dict of str to float
        Further quantities that the asset reports, such as a certified error bound.
    state : dict of str to float or None
        The true value of each state factor, SI, if the asset has damage of its own. It serves for
        scoring; the twin does not receive it.
    sensed : (G,) array or None
        The readings of the sensors, SI, if the asset has sensors of its own; NaN for a lost sensor.
    """

    values: Float
    monitors: Mapping[str, float] = field(default_factory=dict)
    state: Mapping[str, float] | None = None
    sensed: Float | None = None


class Asset:
    """An asset under control; unless a subclass changes that, it has no state."""

    units: Mapping[str, str] = MappingProxyType({})
    """Units of control inputs and monitors by name; those without an entry are dimensionless."""

    def step(self, control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        """Advance the asset by one step.

        Parameters
        ----------
        control : mapping of str to float
            The value of each control input, SI.
        health : mapping of str to float
            The true value of each state factor, SI.
        """
        raise NotImplementedError

    def save_state(self) -> bytes:
        """Return the state as bytes; empty if the asset has none."""
        return b""

    def restore_state(self, state: bytes) -> None:
        """Continue from a saved state, also one of another process."""

    def close(self) -> None:
        """Release the processes and files of the asset."""


class StatelessAsset(Asset):
    """An asset whose observation depends on the control and the health of the step alone.

    Parameters
    ----------
    observe : callable
        Returns the reading for the values of the control inputs and of the state factors.
    """

    def __init__(
        self, observe: Callable[[Mapping[str, float], Mapping[str, float]], AssetReading]
    ) -> None:
        self._observe = observe

    def step(self, control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        """Return the reading under control and health."""
        return self._observe(control, health)


Predict = Callable[[Mapping[str, float], Mapping[str, float]], Float]
"""Returns the observation (G,) for the values of the control inputs and of the state factors."""


def table_of_observations(scenario: Scenario, states: Float, predict: Predict) -> Float:
    """Predict the observations (S, U, G) in each joint state under each control, one by one.

    Parameters
    ----------
    scenario : Scenario
        The scenario, which names the F state factors and the U controls.
    states : (S, F) array
        The value of each state factor in each state.
    predict : callable
        Returns the observation (G,) for one control and one state, both by name.

    Returns
    -------
    (S, U, G) array
        The G observed values, by state and control.
    """
    observations_by_state = []
    for levels in states.tolist():
        health = dict(zip(scenario.state_names, levels, strict=True))
        observations_by_control = [predict(control.values, health) for control in scenario.control]
        observations_by_state.append(observations_by_control)
    return np.array(observations_by_state)


def noise_free_observations(scenario: Scenario, states: Float, asset: Asset) -> Float:
    """Return the noise-free observations (S, U, G) of an asset in all states under all controls.

    Parameters
    ----------
    states : (S, F) array
        The value of each state factor in each state.
    asset : Asset
        The asset. Each observation is one step from the state that the asset has now. On return,
        the asset is in the state after the last of these steps.

    Returns
    -------
    (S, U, G) array
        The G values by state and control; NaN if the FMU refuses a state under a control.
    """
    present_state = asset.save_state()

    def predict(control: Mapping[str, float], health: Mapping[str, float]) -> Float:
        # An asset with hidden effects may remember the steps of the other states.
        asset.restore_state(present_state)
        with suppress(FmuCallError):
            return asset.step(control, health).values
        return np.full(scenario.observation.count, np.nan)

    return table_of_observations(scenario, states, predict)


@dataclass(frozen=True)
class AssetAndModel:
    """The asset that flies and the model that the twin believes, in words.

    Attributes
    ----------
    asset : str
        The asset that flies, in words.
    model : str
        The model that predicts the observations of the twin, in words.
    differ : bool
        Whether they are known to be different models.
    """

    asset: str
    model: str
    differ: bool = False


def calibration_sentence(
    record: JsonRecord, asset: str, believed: str, hashes: Mapping[str, str]
) -> str | None:
    """Say which model was calibrated, and whether the twin believes the design of that model.

    Parameters
    ----------
    record : mapping
        The record of the calibration that a run folder contains.
    asset, believed : str
        The asset that flies and the model that the twin believes, in words.
    hashes : mapping of str to str
        The hashes of the inputs by their names, as `AssetSource.prepare` returns them. The believed
        design is `design`, and the design that flies is `FLOWN_DESIGN_HASH`; either may be absent.

    Returns
    -------
    str or None
        The sentences; None if the calibration does not come from a measurement campaign.
    """
    if "campaign" not in record:
        return None
    roles = f"asset and belief are the {asset}"
    if asset != believed:
        roles = f"the asset is the {asset}, and the twin believes the {believed}"
    calibrated_hash = record.get("design_hash")  # empty if the file does not say it
    # Without a believed design of its own, the twin believes the asset's.
    believed_hash = hashes.get("design", hashes.get(FLOWN_DESIGN_HASH))
    # A library that the twin believes may come from another design than that which flies.
    is_belief_certain = "design" in hashes or asset == believed
    if believed_hash is not None and believed_hash == calibrated_hash:
        comparison = f"The twin believes the design that was calibrated, {believed_hash[:12]}."
    elif believed_hash and calibrated_hash and is_belief_certain:
        comparison = (
            f"The twin believes the design {believed_hash[:12]}, which is not the one that was "
            f"calibrated, {calibrated_hash[:12]}."
        )
    else:
        comparison = "It is not known whether the twin believes the design that was calibrated."
    return f"The calibrated model was {record['model']}; {roles}. {comparison}"


class AssetSource:
    """Prepares the asset that flies, or predicts the observations that a twin expects, or both.

    This class copies files into the run folder, and draws the uncertain parameter from the
    calibration of the scenario.

    Parameters
    ----------
    section : FileSection, optional
        The table of the scenario that names the files.
    """

    label: ClassVar = "asset"
    """Name of the asset or model for messages, if it is the same for all sources of the class."""
    differ: bool = False
    """Whether the believed model is known to differ from the model that flies."""
    model: "ReducedModel | None" = None
    """The reduced model of the asset or of the belief, once it is prepared, if there is one."""

    def __init__(self, scenario: Scenario, section: FileSection | None = None) -> None:
        self._scenario = scenario
        self.section = section
        self._drawn_means: dict[str, float] = {}
        """Mean of the distribution from which each parameter was drawn."""
        self._folder: Path | None = None

    @cached_property
    def file_paths(self) -> dict[str, Path]:
        """The files of the table and of the calibration; keys are the paths of their copies."""
        section_files = {} if self.section is None else self.section.all_files()
        return {**section_files, **self._scenario.calibration.all_files()}

    def path(self, copy: str) -> Path:
        """Return the path of a file: its copy in the run folder, or its original before `prepare`.

        Parameters
        ----------
        copy : str
            The path of the copy inside a run folder.
        """
        return self.file_paths[copy] if self._folder is None else self._folder / copy

    @property
    def description(self) -> str:
        """A phrase for the asset or the believed model."""
        return str(self.label)

    @property
    def origin(self) -> AssetAndModel:
        """The asset and the believed model in words; here they are the same."""
        return AssetAndModel(self.description, self.description, self.differ)

    def draw_summary(self) -> tuple[str, int]:
        """Return the origin of the parameter's draws, in words, and their number."""
        calibration = self._scenario.calibration
        return calibration.source.replace("_", " "), calibration.draw_count

    def check(self) -> None:
        """Check the inputs before anything is built; raise an error for the first fault."""

    def files(self) -> dict[str, bytes]:
        """Return the contents of the files by the paths of their copies.

        Raises
        ------
        MissionInputError
            If a file cannot be read.
        """
        return read_files(self.file_paths)

    def prepare(self, folder: Path, progress: Progress) -> dict[str, str]:
        """Copy the files into a run folder, build the FMU or model, and return the hashes.

        Returns
        -------
        dict of str to str
            The SHA-256 of each copied file and of each FMU or design, by the name of the hash.

        Raises
        ------
        MissionInputError
            If a file cannot be read.
        """
        write_members(folder, self.files())
        self._folder = folder
        hashes = {}
        for name, copy in HASHED_COPIES.items():
            if copy in self.file_paths:
                hashes[name] = hash_file(folder / copy)
        return hashes | self._build(progress)

    def use_prepared_folder(self, folder: Path) -> None:
        """Use the files that an earlier `prepare` left in a run folder."""
        self._folder = folder

    def _build(self, progress: Progress) -> dict[str, str]:
        """Build the FMU or model from the copied files; return their hashes by name."""
        return {}

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of the calibrated parameter, and keep the mean of their distribution.

        The field of a design or structure is later written at this mean.
        """
        draws = draw_parameter(self._scenario.calibration, seed, self.model)
        self._drawn_means[draws.name] = draws.mean
        return draws

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the predicted observations.

        Parameters
        ----------
        draws : ParameterDraws
            The E draws of the parameter.

        Returns
        -------
        (E, S, U, G) array
            By draw, state, control and sensor, in the SI units of the sensors.
        """
        raise NotImplementedError

    def structural_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float | None:
        """Return the predicted values at the sensors without errors of the sensors themselves.

        The health limits apply to these values, not to the readings. The arguments are those of
        `observation_table`.

        Returns
        -------
        (E, S, U, G) array or None
            The values by draw, state, control and sensor; None if the sensors have no errors in the
            model, so that the values are those of `observation_table`.
        """
        return None

    def open(self) -> Asset:
        """Return the asset in its initial state."""
        raise NotImplementedError

    def write_field(
        self, path: Path, state: Mapping[str, float], control: Mapping[str, float]
    ) -> bool:
        """Write the field of displacement and strain, if the model of the source has a mesh.

        Parameters
        ----------
        state : mapping of str to float
            The estimated value of each state factor, SI.
        control : mapping of str to float
            The value of each control input, SI.

        Returns
        -------
        bool
            Whether the file was written.
        """
        return False


class AssetBelief(BeliefSection):
    """The twin predicts with the asset itself, which must have no memory."""

    kind: Literal["asset"] = "asset"

    def source(self, scenario: Scenario, flown_source: AssetSource) -> AssetSource:
        """Return the source of the asset."""
        return flown_source


class PairedSource(AssetSource):
    """The asset of one source, and the predictions of another.

    Parameters
    ----------
    asset : AssetSource
        The source of the asset.
    model : AssetSource
        The source of parameter draws, predicted observations and field.
    differ : bool
        Whether the two are known to be different models.
    """

    def __init__(self, asset: AssetSource, model: AssetSource, *, differ: bool = True) -> None:
        self._asset = asset
        self._believed = model
        self.differ = differ

    @property
    def origin(self) -> AssetAndModel:
        """The asset of the one source, and the believed model of the other."""
        asset = self._asset.origin
        model = self._believed.origin
        differ = self.differ or asset.differ or model.differ
        return AssetAndModel(asset.asset, model.model, differ)

    def check(self) -> None:
        """Check both sources."""
        self._asset.check()
        self._believed.check()

    def files(self) -> dict[str, bytes]:
        """Return the contents of the files of both sources by the paths of their copies."""
        return {**self._asset.files(), **self._believed.files()}

    def prepare(self, folder: Path, progress: Progress) -> dict[str, str]:
        """Prepare both sources in a run folder; return the hashes of both.

        The two models are marked as different if their designs have different hashes.
        """
        # The asset is first: an observation library is compared with the FMU of the asset.
        asset_hashes = self._asset.prepare(folder, progress)
        hashes = {**asset_hashes, **self._believed.prepare(folder, progress)}
        flown_hash = hashes.get(FLOWN_DESIGN_HASH)
        if flown_hash is not None and hashes.get("design", flown_hash) != flown_hash:
            self.differ = True
        return hashes

    def open(self) -> Asset:
        """Return the asset in its initial state."""
        return self._asset.open()

    def draw_summary(self) -> tuple[str, int]:
        """Return the origin of the believed model's draws, in words, and their number."""
        return self._believed.draw_summary()

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of the parameter of the believed model."""
        return self._believed.draws(seed)

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the believed model's observations (draws, states, controls, sensors)."""
        return self._believed.observation_table(draws, model)

    def structural_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float | None:
        """Return the believed model's values at sensors (draws, states, controls, sensors)."""
        return self._believed.structural_table(draws, model)

    def write_field(
        self, path: Path, state: Mapping[str, float], control: Mapping[str, float]
    ) -> bool:
        """Write the field of the believed model; return whether the file was written."""
        return self._believed.write_field(path, state, control)


class WatchedSection(AssetSection):
    """The asset of a scenario without `[asset]`: a real one, whose observations are received."""

    kind: Literal["watched"] = "watched"

    def source(self, scenario: Scenario) -> "WatchedSource":
        """Return a source that refuses to fly."""
        return WatchedSource()


class WatchedSource:
    """The source of a real asset; any use of it by a flight raises an error."""

    def __getattr__(self, name: str) -> NoReturn:
        if name.startswith("__"):  # Python looks for methods such as `__deepcopy__`
            raise AttributeError(name)
        raise MissionInputError(NO_ASSET)


def read_files(files: Mapping[str, Path]) -> dict[str, bytes]:
    """Read the files of which a run folder contains copies.

    Parameters
    ----------
    files : mapping of str to Path
        The files, by the paths that their copies get inside the run folder.

    Returns
    -------
    dict of str to bytes
        The contents of the files, by the same paths.

    Raises
    ------
    MissionInputError
        If a file cannot be read.
    """
    content_of_copy = {}
    for path_of_copy, path in files.items():
        content_of_copy[path_of_copy] = read_bytes(path, MissionInputError)
    return content_of_copy
