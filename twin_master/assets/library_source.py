"""An observation library, sampled from an FMU beforehand, as what the twin believes."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from reporting.progress import Progress
from reporting.provenance import hash_file
from twin_master.assets.asset_source import AssetSource, FlownAndBelieved, Source
from twin_master.assets.design_source import DESIGN_COPY, DesignBelief, DesignSource
from twin_master.assets.fmu_source import FMU_COPY, FmuSection
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

    kept: ClassVar[Mapping[str, str]] = {"file": OBSERVATIONS_COPY, "design": DESIGN_COPY}

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
        return LibrarySource(scenario, self, model, scenario.asset.binding_path)


class LibrarySource(Source):
    """Predicted observations from an observation library.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    section : LibraryBelief
        What is believed.
    model : AssetSource
        Gives the draws of the parameter and the field: what is flown, or the model of a design.
    binding : Path
        Binding of what is flown.
    """

    def __init__(self, scenario: Scenario, section: LibraryBelief, model: AssetSource, binding: Path) -> None:
        super().__init__(scenario, section)
        self._model, self._binding = model, binding
        self._library: ObservationLibrary | None = None
        self._other_fmu: bool | None = False
        self.open = model.open  # a library is flown by nobody

    @property
    def words(self) -> str:
        """The library; it differs from the asset if it was sampled from another FMU."""
        other = {True: " of another FMU", False: " of it", None: ""}[self._other_fmu]
        return f"observation library{other}"

    @property
    def origin(self) -> FlownAndBelieved:
        """The library, twice."""
        return FlownAndBelieved(self.words, self.words, differ=self._other_fmu is True)

    def check(self) -> None:
        """Check that the library has what the scenario asks for.

        Raises
        ------
        InvalidObservationLibraryError
            The library is missing or damaged, or lacks something.
        """
        self._read()

    def files(self) -> dict[str, bytes]:
        """Return the library, and the design if one is named.

        Raises
        ------
        InvalidObservationLibraryError
            One cannot be read.
        """
        try:
            return super().files()
        except MissionInputError as error:
            raise InvalidObservationLibraryError(f"the observation library: {error}") from error

    def _make(self, progress: Progress) -> dict[str, str]:
        """Prepare the design if one is named; what is flown is prepared before."""
        assert self._folder is not None
        own = isinstance(self._model, DesignSource)
        hashes = self._model.prepare(self._folder, progress) if own else {}
        fmu = self._folder / FMU_COPY
        library = self._read()
        self._other_fmu = library.fmu_hash != hash_file(fmu) if fmu.exists() else None  # several have several
        return {**hashes, "observation_library": hash_file(self.path(OBSERVATIONS_COPY))}

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

        library = load_observation_library(self.path(OBSERVATIONS_COPY))
        scenario = self._scenario
        section = scenario.observation
        vector = load_binding(self._binding).observation.get(section.role)
        flown = () if vector is None else vector.variables
        units = zip(library.states.names, library.state_units, strict=True)
        for what, has, wanted in (
            ("observes", (library.role,), (section.role,)),
            ("has the sensors", library.sensors, flown),
            ("has them in", library.sensor_units, section.sensor_units),
            (
                "has the states in",
                tuple(sorted(f"{name}: {unit}" for name, unit in units)),
                tuple(sorted(f"{factor.name}: {factor.unit}" for factor in scenario.state)),
            ),
            ("was sampled under the load", _shown(library.load), _shown(scenario.asset.constant_load)),
        ):
            if has != wanted:
                raise InvalidObservationLibraryError(
                    f"the observation library {self.path(OBSERVATIONS_COPY).name} {what} "
                    f"{', '.join(has) or 'none'}, and the scenario with its binding asks for "
                    f"{', '.join(wanted) or 'none'}: sample one for this scenario."
                )
        if not library.parameter or library.parameter == scenario.calibration.parameter:
            self._places(library, build_graphical_model(scenario))
        else:
            library.at_draws(scenario.calibration.parameter, np.zeros(2))  # says what is wrong
        self._library = library
        return library


def _shown(values: Mapping[str, float]) -> tuple[str, ...]:
    return tuple(f"{name} = {value:g}" for name, value in sorted(values.items()))
