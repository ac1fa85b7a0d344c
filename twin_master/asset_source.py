"""Where an asset and the twin's predicted observations of it come from.

The workflow knows a source only by its protocol: FMU of a wing design, FMU of anything, strain library.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fe.reduced import ReducedModel
from fmu_asset.companions import COMPANION_NAMES
from reporting.progress import Progress
from twin_master.assets import Asset, AssetReading, StatelessAsset
from twin_master.errors import MissingObservationModelError
from twin_master.graphical_model import GraphicalModel
from twin_master.parameter import ParameterDraws, draw_parameter
from twin_master.scenario import Scenario
from twin_master.scenario_asset import ComponentSection
from twin_master.strain_library import FILE_NAME as LIBRARY_NAME
from twin_master.strain_library import StrainLibrary

Float = NDArray[np.float64]


ASSET_FOLDER = "asset"
"""Folder inside the run folder that holds copies of what is flown, so that a run can be resumed anywhere."""
BINDING_COPY = f"{ASSET_FOLDER}/binding.toml"
CALIBRATION_COPY = f"{ASSET_FOLDER}/calibration.nc"
DESIGN_COPY = f"{ASSET_FOLDER}/design.toml"
FMU_COPY = f"{ASSET_FOLDER}/asset.fmu"
LIBRARY_COPY = f"{ASSET_FOLDER}/{LIBRARY_NAME}"
MODEL_PATCH_COPY = f"{ASSET_FOLDER}/model_patch.json"
OBSERVATIONS_COPY = f"{ASSET_FOLDER}/observation_library.nc"
PATCH_COPY = f"{ASSET_FOLDER}/patch.json"
SSP_COPY = f"{ASSET_FOLDER}/system.ssp"
COMPONENT_FOLDER = f"{ASSET_FOLDER}/components"
SHIPPED_DESIGN_NAME = "uav_wing"
CALIBRATED_DESIGN_NAME = "calibration"
"""The tailored design inside the calibration file: with a file it takes the place of the scenario's."""


def component_copies(component: ComponentSection) -> dict[str, str]:
    """Return the files that a component names, without what is shipped: key, and path in the run folder."""
    copies = {}
    if component.fmu is not None and component.fmu not in COMPANION_NAMES:
        copies["fmu"] = f"{COMPONENT_FOLDER}/{component.name}.fmu"
    if component.design not in (None, SHIPPED_DESIGN_NAME, CALIBRATED_DESIGN_NAME):
        copies["design"] = f"{COMPONENT_FOLDER}/{component.name}.toml"
    return copies


@dataclass(frozen=True)
class Origin:
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


class AssetSource(Protocol):
    """Everything that a mission needs to know of its asset."""

    @property
    def origin(self) -> Origin:
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


def wing_observation_table(
    wing: ReducedModel, scenario: Scenario, draws: ParameterDraws, model: GraphicalModel
) -> Float:
    """Return the strains (E, S, U, G) of a wing for each draw of e, state and control: eqs. (13), (15).

    Raises
    ------
    MissingObservationModelError
        The scenario's states, controls or parameter are not those of a wing model.
    OutsideModelError
        A state, control or draw lies outside the model's validity.
    """
    check_wing_scenario(scenario, wing.gauge_count)
    load = scenario.asset.load.get("tip_force", 0.0)
    states = model.states.coordinates
    order = [scenario.state_names.index(name) for name in ("z1", "z2")]
    factors = np.array([control.values["load_factor"] for control in scenario.control])
    shape = (len(draws.values), len(states), len(factors))
    draw, state, control = (index.ravel() for index in np.indices(shape))
    strains = wing.static_strains(
        draws.values[draw], states[state][:, order], factors[control], np.full(draw.size, load)
    )
    return strains.reshape(*shape, wing.gauge_count)


def check_wing_scenario(scenario: Scenario, gauge_count: int) -> None:
    """Check that a scenario speaks of what a wing model has.

    Raises
    ------
    MissingObservationModelError
        It does not.
    """
    expected: dict[str, tuple[set[str] | set[int], set[str] | set[int]]] = {
        "states": (set(scenario.state_names), {"z1", "z2"}),
        "control inputs": (set(scenario.control[0].values), {"load_factor"}),
        "calibrated parameter": ({scenario.calibration.parameter}, {"young_modulus_factor"}),
        "sensor count": ({scenario.observation.count}, {gauge_count}),
    }
    advice = "set `asset.observation_model` to `asset` to use the asset itself"
    if scenario.asset.kind == "strain_library":
        advice = "leave out `asset.design` and `asset.observation_model` to use the library itself"
    for what, (came, wanted) in expected.items():
        if came != wanted:
            raise MissingObservationModelError(
                f"the design's model predicts observations for the {what} {_names(wanted)}, and the scenario "
                f"has {_names(came)}: {advice}."
            )


def _names(values: set[str] | set[int]) -> str:
    return ", ".join(sorted(str(value) for value in values))


def wing_asset(wing: ReducedModel, scenario: Scenario) -> StatelessAsset:
    """Return the reduced model itself as an asset, with the parameters of the scenario's true wing."""
    e = scenario.asset.parameters.get("young_modulus_factor", 1.0)
    force = scenario.asset.load.get("tip_force", 0.0)

    def observe(control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        response = wing.static_response(e, (health["z1"], health["z2"]), control["load_factor"], force)
        return AssetReading(response.strain, {"strain_error_bound": response.strain_error_bound})

    return StatelessAsset(observe)


class ReducedModelSource:
    """The reduced model of a wing, flown without an FMU."""

    def __init__(self, scenario: Scenario, wing: ReducedModel) -> None:
        self._scenario = scenario
        self._wing = wing

    @property
    def origin(self) -> Origin:
        """The reduced model, twice."""
        return Origin("reduced model of the wing", "reduced model of the wing")

    def check(self) -> None:
        """Accept what was read already."""

    def files(self) -> dict[str, bytes]:
        """Return none: the model is made from the design of the program."""
        return {}

    def prepare(self, folder: Path, progress: Progress) -> dict[str, str]:
        """Return the hash of the design."""
        return {"design": self._wing.design_hash}

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of e."""
        return draw_parameter(self._scenario.calibration, seed, self._wing)

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the strains (E, S, U, G)."""
        return wing_observation_table(self._wing, self._scenario, draws, model)

    def open(self) -> Asset:
        """Return the model as an asset."""
        return wing_asset(self._wing, self._scenario)

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write nothing: there is no mesh."""
        return False


class StrainLibrarySource:
    """A strain library in the format of the authors of Kapteyn et al. 2021, as model and as asset."""

    def __init__(
        self, scenario: Scenario, library: StrainLibrary, content_hash: str, path: Path | None = None
    ) -> None:
        self._path = path
        self._scenario = scenario
        self._library = library
        self._hash = content_hash
        self._control_index = self._find_controls()
        if scenario.observation.count != library.gauge_count or scenario.state_names != library.states.names:
            raise MissingObservationModelError(
                f"the strain library has {library.gauge_count} gauges and the states "
                f"{', '.join(library.states.names)}, and the scenario asks for {scenario.observation.count} "
                f"and {', '.join(scenario.state_names)}."
            )

    @property
    def origin(self) -> Origin:
        """The library, twice."""
        return Origin("strain library", "strain library")

    def _find_controls(self) -> list[int]:
        missing = [name for name in self._scenario.control_names if name not in self._library.controls]
        if missing:
            raise MissingObservationModelError(
                f"the strain library has the controls {', '.join(self._library.controls)}, and the scenario "
                f"asks for {', '.join(missing)}."
            )
        return [self._library.controls.index(name) for name in self._scenario.control_names]

    def check(self) -> None:
        """Accept what was read already."""

    def files(self) -> dict[str, bytes]:
        """Return the library."""
        return {} if self._path is None else {LIBRARY_COPY: self._path.read_bytes()}

    def prepare(self, folder: Path, progress: Progress) -> dict[str, str]:
        """Return the hash of the library."""
        return {"strain_library": self._hash}

    def draws(self, seed: int) -> ParameterDraws:
        """Return the library's own samples of its parameter."""
        values = self._library.young_modulus_factor
        return ParameterDraws(
            name=self._scenario.calibration.parameter,
            values=values,
            mean=float(values.mean()),
            standard_deviation=float(values.std(ddof=1)),
            source=f"the {len(values)} samples of the strain library",
        )

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the library's strains (E, S, U, G) in the order of the scenario's states and controls.

        Raises
        ------
        InvalidModelError
            A level of the scenario is none of the library.
        """
        rows = [self._library.states.index(tuple(state)) for state in model.states.coordinates]
        return self._library.strain_per_draw[:, rows][:, :, self._control_index]

    def open(self) -> Asset:
        """Return the library's solution at the mean parameter, interpolated between its damage levels."""
        names, values = self._scenario.state_names, [control.values for control in self._scenario.control]

        def observe(control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
            index = self._control_index[values.index(dict(control))]
            return AssetReading(self._library.strain_at([health[name] for name in names], index))

        return StatelessAsset(observe)

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write nothing: there is no mesh."""
        return False
