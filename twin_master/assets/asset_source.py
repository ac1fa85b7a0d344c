"""What flies: an asset under control; and a source, which prepares it, or what the twin expects of it.

An asset is told the control and its true health, and returns the noise-free observation; or it carries damage
and sensors of its own, and tells of them beside. It is driven by the `Plant`; the twin never meets it.

A mission knows a source only by `AssetSource`. What a user may name stands in the files of this folder whose
names end in `_source`: each holds the tables of its kinds and what is made of them.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NoReturn

import numpy as np

from fmu_asset.errors import FmuCallError
from reporting.arrays import Float
from reporting.files import hash_file, write_members
from reporting.progress import Progress
from reporting.text_file import read_bytes
from twin_master.assets.parameter import ParameterDraws, draw_parameter
from twin_master.errors import MissionInputError, said
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.kinds import AssetSection, BeliefSection, FileSection
from twin_master.scenario.mission import CALIBRATION_COPY
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    from fe.runtime.reduced import ReducedModel


@dataclass(frozen=True)
class AssetReading:
    """What an asset returns for one step.

    Attributes
    ----------
    values : (G,)
        Noise-free observation in its SI unit.
    monitors : dict of str to float
        Further figures that the asset reports of itself, such as a certified error bound.
    state : dict of str to float or None
        True value of each state factor, SI, where the asset carries damage of its own: for scoring, never for
        the twin.
    sensed : (G,) or None
        What its sensors say, SI, where it carries sensors of its own; NaN where one is lost.
    """

    values: Float
    monitors: Mapping[str, float] = field(default_factory=dict)
    state: Mapping[str, float] | None = None
    sensed: Float | None = None


class Asset:
    """An asset under control; one that inherits from this has no state unless it says so."""

    units: Mapping[str, str] = MappingProxyType({})
    """Units of control inputs and monitors by name; those that are missing are dimensionless."""

    def step(self, control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        """Fly one step with the given control inputs and true health (SI)."""
        raise NotImplementedError

    def save_state(self) -> bytes:
        """Return the state as bytes; empty if the asset has none."""
        return b""

    def restore_state(self, state: bytes) -> None:
        """Continue from a saved state, also in another process."""

    def close(self) -> None:
        """Let go of what the asset holds."""


class StatelessAsset(Asset):
    """An asset whose observation depends on nothing but the control and the health of the step.

    Parameters
    ----------
    observe
        Returns the reading for control inputs and health.
    """

    def __init__(self, observe: Callable[[Mapping[str, float], Mapping[str, float]], AssetReading]) -> None:
        self._observe = observe

    def step(self, control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        """Return the observation under the given control inputs and health."""
        return self._observe(control, health)


def asked_table(
    scenario: Scenario,
    states: Float,
    ask: Callable[[Mapping[str, float], Mapping[str, float]], Float],
) -> Float:
    """Ask what is shown under every control in every state (S, F), both by name: (S, U, G)."""
    rows = (dict(zip(scenario.state_names, levels, strict=True)) for levels in states.tolist())
    return np.array([[ask(control.values, health) for control in scenario.control] for health in rows])


def shown_without_noise(scenario: Scenario, states: Float, asset: Asset) -> Float:
    """Ask an asset as it is in all states (S, F) and controls: (S, U, G), NaN where it refuses."""
    start = asset.save_state()

    def ask(control: Mapping[str, float], health: Mapping[str, float]) -> Float:
        asset.restore_state(start)  # an asset with hidden effects may remember
        with suppress(FmuCallError):
            return asset.step(control, health).values
        return np.full(scenario.observation.count, np.nan)

    return asked_table(scenario, states, ask)


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


class AssetSource:
    """Everything that a mission needs to know of what is flown, or of what its twin believes.

    Most have in common that files are kept in the run folder, and that draws are those of a calibration.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    section : FileSection, optional
        The table that names the files.
    """

    label: ClassVar = "asset"
    """What is flown or believed, where that is always the same."""
    differ: bool = False
    """Whether what is believed is known to be another model than what is flown."""
    model: "ReducedModel | None" = None
    """The reduced model of what is flown or believed, once prepared, where there is one."""

    def __init__(self, scenario: Scenario, section: FileSection | None = None) -> None:
        self._scenario = scenario
        self.section = section
        self._means: dict[str, float] = {}
        self._folder: Path | None = None

    @cached_property
    def places(self) -> dict[str, Path]:
        """What the table names, and the calibration file, by the places of their copies in a run folder."""
        own = {} if self.section is None else self.section.all_files()
        return {**own, **self._scenario.calibration.all_files()}

    def path(self, copy: str) -> Path:
        """Return a file: its copy in the run folder, or where it is given before that."""
        return self.places[copy] if self._folder is None else self._folder / copy

    @property
    def words(self) -> str:
        """What is flown or believed."""
        return str(self.label)

    @property
    def origin(self) -> FlownAndBelieved:
        """The same twice."""
        return FlownAndBelieved(self.words, self.words, self.differ)

    def uncertain(self) -> tuple[str, int]:
        """Return where draws of the parameter come from, in words, and how many there are."""
        given = self._scenario.calibration
        return given.source.replace("_", " "), 1 if given.source == "fixed" else given.draws

    def check(self) -> None:
        """Look at what is given before anything is made; raise what is wrong with it."""

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
        write_members(folder, self.files())
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
        found = draw_parameter(self._scenario.calibration, seed, self.model)
        self._means[found.name] = found.mean
        return found

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the predicted observations (E, S, U, G)."""
        raise NotImplementedError

    def structural_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float | None:
        """Return what is there at the sensors (E, S, U, G), None where they show it: limits are of that."""
        return None

    def open(self) -> Asset:
        """Return the asset at its start."""
        raise NotImplementedError

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write the field under an estimated state and a control; return whether there is one."""
        return False


class AssetBelief(BeliefSection):
    """The twin asks what is flown itself what to expect: for assets without memory."""

    kind: Literal["asset"] = "asset"

    def source(self, scenario: Scenario, flown: AssetSource) -> AssetSource:
        """Return what is flown."""
        return flown


class PairedSource(AssetSource):
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
        self._asset, self._model, self.differ = asset, model, differ
        told = ("uncertain", "draws", "observation_table", "structural_table", "write_field")
        for name, source in {"open": asset, **dict.fromkeys(told, model)}.items():
            setattr(self, name, getattr(source, name))

    @property
    def origin(self) -> FlownAndBelieved:
        """Asset of the one, model of the other."""
        asset, model = self._asset.origin, self._model.origin
        return FlownAndBelieved(asset.asset, model.model, differ=self.differ or asset.differ or model.differ)

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
        self.differ = self.differ or (flown is not None and hashes.get("design", flown) != flown)
        return hashes


class WatchedSection(AssetSection):
    """A scenario without `[asset]`: it is watched, and not flown."""

    kind: Literal["watched"] = "watched"

    def source(self, scenario: Scenario) -> "WatchedSource":
        """Return what can be watched only."""
        return WatchedSource()


class WatchedSource:
    """What stands for a real asset; whatever a flight would ask of it ends in one sentence."""

    def __getattr__(self, name: str) -> NoReturn:
        if name.startswith("__"):
            raise AttributeError(name)
        raise MissionInputError(said("assets.no_asset"))


FLOWN_DESIGN_HASH = "flown_design"
"""Under which a source that packs a wing tells the hash of its design; that of the model is `design`."""


BINDING_COPY = "asset/binding.toml"
PATCH_COPY = "asset/patch.json"
MODEL_PATCH_COPY = "asset/model_patch.json"
LIBRARY_COPY = "asset/UAVconfig.json"
OBSERVATIONS_COPY = "asset/observation_library.nc"
SSP_COPY = "asset/system.ssp"
HASHED = {
    "binding": BINDING_COPY,
    "calibration": CALIBRATION_COPY,
    "patch": PATCH_COPY,
    "model_patch": MODEL_PATCH_COPY,
    "observation_library": OBSERVATIONS_COPY,
    "ssp": SSP_COPY,
    "strain_library": LIBRARY_COPY,
}
"""Files whose hashes a run tells, and where their copies stand in its folder."""


def read_files(files: Mapping[str, Path]) -> dict[str, bytes]:
    """Return what files hold, by the places of their copies in a run folder.

    Raises
    ------
    MissionInputError
        One cannot be read.
    """
    return {copy: read_bytes(path, MissionInputError) for copy, path in files.items()}
