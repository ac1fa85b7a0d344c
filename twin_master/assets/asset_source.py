"""Where an asset and the twin's predicted observations of it come from.

A mission knows a source only by its protocol. What a user may name stands in the files beside this one whose
names end in `_source`: each holds the tables of its kinds and what is made of them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from reporting.files import atomic_write_bytes
from reporting.progress import Progress
from reporting.provenance import hash_file
from twin_master.assets.interface import Asset
from twin_master.assets.parameter import ParameterDraws, draw_parameter
from twin_master.errors import MissionInputError
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.asset import BeliefSection, FileSection
from twin_master.scenario.schema import CALIBRATION_COPY, Scenario

if TYPE_CHECKING:
    from fe.runtime.reduced import ReducedModel

Float = NDArray[np.float64]


@dataclass(frozen=True)
class FlownAndBelieved:
    """What is flown and what the twin believes, in words.

    Attributes
    ----------
    asset, model : str
        What is flown, and what predicts its observations.
    differ : bool
        Whether they are known to be different models.
    """

    asset: str
    model: str
    differ: bool = False


def calibrated_with(
    record: Mapping[str, Any], asset: str, believed: str, hashes: Mapping[str, str]
) -> str | None:
    """Return which model a campaign calibrated, which is flown, and whether the twin believes that one.

    Parameters
    ----------
    record : mapping
        Of the calibration, as a run folder keeps it.
    asset, believed : str
        What is flown and what the twin believes, in words.
    hashes : mapping of str to str
        Of what went into the run.

    Returns
    -------
    str or None
        None where nothing was calibrated from a campaign.
    """
    if "campaign" not in record:
        return None
    flown = f"flown and believed is the {asset}"
    if asset != believed:
        flown = f"flown is the {asset}, and the twin believes the {believed}"
    own = hashes.get("design", hashes.get(FLOWN_DESIGN_HASH))
    if own is not None and own == record.get("design_hash"):
        same = f"The twin believes the design that was calibrated, {own[:12]}."
    else:
        same = "The calibration file does not tell whether these are one and the same."
    return f"Calibrated was the model {record['model']}; {flown}. {same}"


class AssetSource(Protocol):
    """Everything that a mission needs to know of its asset.

    It may have `structural_table(draws, model)`, which returns like `observation_table` what is there at the
    sensors where its model knows that they do not show it, else None: limits are of the structure.
    What most sources have in common is `Source`.
    """

    @property
    def origin(self) -> FlownAndBelieved:
        """What is flown and what the twin believes, in words."""

    def check(self) -> None:
        """Look at what is given before anything is made; raise what is wrong with it."""

    def files(self) -> dict[str, bytes]:
        """Return the files to copy into the run folder, by their paths in it."""

    def prepare(self, folder: Path, progress: Progress) -> dict[str, str]:
        """Make ready what is flown, in the folder of the run; return the hashes of what went in."""

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of the uncertain parameter of the model."""

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the predicted observations (E, S, U, G)."""

    def open(self) -> Asset:
        """Return the asset at its start."""

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write the asset's field under an estimated state and a control; return whether it has one."""


def structural_table(source: AssetSource, draws: ParameterDraws, model: GraphicalModel) -> Float | None:
    """Return what is there at the sensors (E, S, U, G); None where they show it, see `AssetSource`."""
    own = getattr(source, "structural_table", None)
    found: Float | None = None if own is None else own(draws, model)
    return found


class Source:
    """What sources have in common: files that are kept in the run folder, and draws of a calibration.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    section : FileSection, optional
        The table that names the files.
    """

    label: ClassVar = "asset"
    """What is flown or believed, where that is always the same."""
    model: "ReducedModel | None" = None
    """The reduced model of what is flown or believed, once prepared, where there is one."""

    def __init__(self, scenario: Scenario, section: FileSection | None = None) -> None:
        self._scenario = scenario
        self._files = section
        self._folder: Path | None = None

    @cached_property
    def places(self) -> dict[str, Path]:
        """What the table names, and the calibration file, by the places of their copies in a run folder."""
        own = {} if self._files is None else self._files.all_files()
        return {**own, **self._scenario.calibration.all_files()}

    def path(self, copy: str) -> Path:
        """Return a file: its copy in the run folder, or where it is given before that.

        Raises
        ------
        MissionInputError
            It is made in the run folder, and there is none yet.
        """
        if self._folder is None and copy not in self.places:
            raise MissionInputError("the asset was not prepared: call `prepare` first.")
        return self.places[copy] if self._folder is None else self._folder / copy

    @property
    def words(self) -> str:
        """What is flown or believed."""
        return str(self.label)

    @property
    def origin(self) -> FlownAndBelieved:
        """The same twice."""
        return FlownAndBelieved(self.words, self.words)

    def check(self) -> None:
        """Accept what was read already."""

    def files(self) -> dict[str, bytes]:
        """Return what the files hold, by the places of their copies.

        Raises
        ------
        MissionInputError
            One cannot be read.
        """
        return read_files(self.places)

    def prepare(self, folder: Path, progress: Progress) -> dict[str, str]:
        """Copy what is given into the run folder and make what follows from it; return the hashes.

        Raises
        ------
        MissionInputError
            A file cannot be read.
        """
        keep_files(folder, self.files())
        self._folder = folder
        hashes = {name: hash_file(folder / copy) for name, copy in HASHED.items() if copy in self.places}
        return hashes | self._make(progress)

    def use(self, folder: Path) -> None:
        """Take what an earlier `prepare` left in a folder, without making it again."""
        self._folder = folder

    def _make(self, progress: Progress) -> dict[str, str]:
        """Make what follows from the copies; return its hashes."""
        return {}

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of the calibrated parameter."""
        return draw_parameter(self._scenario.calibration, seed, self.model)

    def structural_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float | None:
        """Return what is there at the sensors (E, S, U, G) where they do not show it, else None."""
        return None

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write nothing: there is no mesh."""
        return False


class AssetBelief(BeliefSection):
    """The twin asks what is flown itself what to expect: for assets without memory."""

    kind: Literal["asset"] = "asset"

    def source(self, scenario: Scenario, flown: AssetSource) -> AssetSource:
        """Return what is flown."""
        return flown


class PairedSource:
    """The asset of one source; everything that the twin knows from another.

    Parameters
    ----------
    asset : AssetSource
        What is flown.
    model : AssetSource
        Parameter draws, predicted observations and field.
    differ : bool
        Whether the two are known to be different models.
    """

    def __init__(self, asset: AssetSource, model: AssetSource, *, differ: bool = True) -> None:
        self._asset, self._model, self._differ = asset, model, differ

    @property
    def origin(self) -> FlownAndBelieved:
        """Asset of the one, model of the other."""
        asset, model = self._asset.origin, self._model.origin
        return FlownAndBelieved(asset.asset, model.model, differ=self._differ or asset.differ or model.differ)

    def check(self) -> None:
        """Check both."""
        self._asset.check()
        self._model.check()

    def files(self) -> dict[str, bytes]:
        """Return the files of both."""
        return {**self._asset.files(), **self._model.files()}

    def prepare(self, folder: Path, progress: Progress) -> dict[str, str]:
        """Prepare both; return the hashes of both."""
        hashes = {**self._asset.prepare(folder, progress), **self._model.prepare(folder, progress)}
        flown = hashes.get(FLOWN_DESIGN_HASH)
        self._differ = self._differ or (flown is not None and hashes.get("design", flown) != flown)
        return hashes

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of the parameter of the twin's model."""
        return self._model.draws(seed)

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the predictions (E, S, U, G) of the twin's model."""
        return self._model.observation_table(draws, model)

    def structural_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float | None:
        """Return what is there at the sensors by the twin's model; None where they show it."""
        return structural_table(self._model, draws, model)

    def open(self) -> Asset:
        """Return the asset at its start."""
        return self._asset.open()

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write the field of the twin's model."""
        return self._model.write_field(path, state, control)


FLOWN_DESIGN_HASH = "flown_design"
"""Under which a source that packs a wing tells the hash of its design; that of the model is `design`."""


BINDING_COPY = "asset/binding.toml"
PATCH_COPY = "asset/patch.json"
MODEL_PATCH_COPY = "asset/model_patch.json"
HASHED = {
    "binding": BINDING_COPY,
    "calibration": CALIBRATION_COPY,
    "patch": PATCH_COPY,
    "model_patch": MODEL_PATCH_COPY,
}
"""Files whose hashes a run tells, and where their copies stand in its folder."""


def read_files(files: Mapping[str, Path]) -> dict[str, bytes]:
    """Return what files hold, by the places of their copies in a run folder.

    Raises
    ------
    MissionInputError
        One cannot be read.
    """
    contents = {}
    for copy, path in files.items():
        try:
            contents[copy] = path.read_bytes()
        except OSError as error:
            raise MissionInputError(f"{path} cannot be read: {error.strerror or error}.") from error
    return contents


def keep_files(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Write the copies that are not in the run folder yet."""
    for name, content in contents.items():
        if not (folder / name).exists():
            atomic_write_bytes(folder / name, content)
