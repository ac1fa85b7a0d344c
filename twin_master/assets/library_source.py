"""An observation library, sampled from an FMU beforehand, as what the twin believes."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from reporting.progress import Progress
from reporting.provenance import hash_file
from twin_master.assets.asset_source import AssetSource, FlownAndBelieved, keep_files
from twin_master.assets.design_source import DESIGN_COPY, DesignBelief, DesignSource
from twin_master.assets.fmu_source import FMU_COPY, FmuSection
from twin_master.assets.interface import Asset
from twin_master.assets.parameter import ParameterDraws
from twin_master.errors import InvalidObservationLibraryError, MissionInputError
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.asset import BeliefSection
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    from twin_master.assets.observation_library import ObservationLibrary

Float = NDArray[np.float64]


OBSERVATIONS_COPY = "asset/observation_library.nc"


class LibraryBelief(BeliefSection):
    """An observation library, as `uav-twin library sample` writes it."""

    kind: Literal["library"] = "library"
    file: str
    design: str | None = None
    """The wing whose stiffness curve the calibration takes, and whose field is drawn, where there is one."""

    def copies(self) -> Mapping[str, str]:
        """Return where the copies of library and design stand in a run folder."""
        return {"file": OBSERVATIONS_COPY, "design": DESIGN_COPY}

    def source(self, scenario: Scenario, flown: AssetSource) -> "LibrarySource":
        """Return the library.

        Raises
        ------
        MissionInputError
            What flies is no FMU.
        """
        if not isinstance(scenario.asset, FmuSection):
            raise MissionInputError(
                "an observation library was sampled from an FMU, and the kind of the asset is "
                f"`{scenario.asset.kind}`: set `belief.kind` to `asset` or `design`."
            )
        model: AssetSource = flown
        if self.design is not None:
            model = DesignSource(scenario, DesignBelief(design=self.design))
        return LibrarySource(scenario, model, scenario.asset.binding_path, Path(self.file))


class LibrarySource:
    """Predicted observations from an observation library.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    model : AssetSource
        Gives the draws of the parameter and the field: what is flown, or the model of a design.
    binding : Path
        Binding of what is flown.
    library : Path
        The observation library.
    """

    def __init__(self, scenario: Scenario, model: AssetSource, binding: Path, library: Path) -> None:
        self._scenario = scenario
        self._model = model
        self._binding = binding
        self._path = library
        self._library: ObservationLibrary | None = None
        self._other_fmu: bool | None = False

    @property
    def origin(self) -> FlownAndBelieved:
        """The library, twice; it differs from the asset if it was sampled from another FMU."""
        other = {True: " of another FMU", False: " of it", None: ""}[self._other_fmu]
        words = f"observation library{other}"
        return FlownAndBelieved(words, words, differ=self._other_fmu is True)

    def check(self) -> None:
        """Check that the library has what the scenario asks for.

        Raises
        ------
        InvalidObservationLibraryError
            The library is missing or damaged, or lacks something.
        """
        self._read()

    def files(self) -> dict[str, bytes]:
        """Return the library, and the design if one is named."""
        try:
            content = self._path.read_bytes()
        except OSError as error:
            raise InvalidObservationLibraryError(
                f"the observation library {self._path} cannot be read: {error.strerror or error}."
            ) from error
        design = self._model.files() if isinstance(self._model, DesignSource) else {}
        return {**design, OBSERVATIONS_COPY: content}

    def prepare(self, folder: Path, progress: Progress) -> dict[str, str]:
        """Copy the library, and prepare the design if one is named; return the hashes.

        What is flown is prepared before.
        """
        keep_files(folder, self.files())
        hashes = self._model.prepare(folder, progress) if isinstance(self._model, DesignSource) else {}
        self._path, fmu = folder / OBSERVATIONS_COPY, folder / FMU_COPY
        library = self._read()
        self._other_fmu = library.fmu_hash != hash_file(fmu) if fmu.exists() else None  # several have several
        return {**hashes, "observation_library": hash_file(self._path)}

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of the parameter, from the calibration of the scenario."""
        draws = self._model.draws(seed)
        library = self._library or self._read()
        if not library.parameter or library.holds_draws(draws.values):
            return draws
        return replace(
            draws, source=f"{draws.source}; the observation library is interpolated between its own"
        )

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the observations (E, S, U, G) in the order of the scenario's states and controls.

        Raises
        ------
        InvalidObservationLibraryError
            The library lacks a state, control or range of the parameter.
        """
        library = self._library or self._read()
        rows, controls = self._places(library, model)
        return library.at_draws(draws.name, draws.values)[:, rows][:, :, controls]

    def open(self) -> Asset:
        """Return what gives the draws and the field as an asset; a library is flown by nobody."""
        return self._model.open()

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write the field of the model."""
        return self._model.write_field(path, state, control)

    def _places(self, library: "ObservationLibrary", model: GraphicalModel) -> tuple[list[int], list[int]]:
        rows = library.rows_of(self._scenario.state_names, model.states.coordinates)
        controls = [library.control_of(control.name, control.values) for control in self._scenario.control]
        return rows, controls

    def _read(self) -> "ObservationLibrary":
        from fmu_asset.door.binding import load_binding
        from twin_master.assets.observation_library import load_observation_library
        from twin_master.network.twin import build_graphical_model

        library = load_observation_library(self._path)
        scenario = self._scenario
        section, vector = (
            scenario.observation,
            load_binding(self._binding).observation.get(scenario.observation.role),
        )
        flown = () if vector is None else vector.variables
        for what, has, wanted in (
            ("observes", (library.role,), (section.role,)),
            ("has the sensors", library.sensors, flown),
            ("has them in", library.sensor_units, section.sensor_units),
            (
                "has the states in",
                tuple(
                    sorted(
                        f"{n}: {u}" for n, u in zip(library.states.names, library.state_units, strict=True)
                    )
                ),
                tuple(sorted(f"{factor.name}: {factor.unit}" for factor in scenario.state)),
            ),
            ("was sampled under the load", _shown(library.load), _shown(scenario.asset.constant_load)),
        ):
            if has != wanted:
                raise InvalidObservationLibraryError(
                    f"the observation library {self._path.name} {what} {', '.join(has) or 'none'}, and the "
                    f"scenario with its binding asks for {', '.join(wanted) or 'none'}: sample one for this "
                    "scenario."
                )
        if not library.parameter or library.parameter == scenario.calibration.parameter:
            self._places(library, build_graphical_model(scenario))
        else:
            library.at_draws(scenario.calibration.parameter, np.zeros(2))  # says what is wrong
        self._library = library
        return library


def _shown(values: Mapping[str, float]) -> tuple[str, ...]:
    return tuple(f"{name} = {value:g}" for name, value in sorted(values.items()))
