"""An asset whose twin believes an observation library."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fmu_asset.binding import load_binding
from reporting.files import atomic_write_bytes
from reporting.progress import Progress
from twin_master.asset_source import OBSERVATIONS_COPY, AssetSource, Origin
from twin_master.assets import Asset
from twin_master.errors import InvalidObservationLibraryError
from twin_master.graphical_model import GraphicalModel
from twin_master.observation_library import ObservationLibrary, load_observation_library
from twin_master.parameter import ParameterDraws
from twin_master.scenario import Scenario
from twin_master.twin import build_graphical_model

Float = NDArray[np.float64]


class LibrarySource:
    """The asset of another source, and predicted observations from an observation library.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    asset : AssetSource
        What is flown, with the draws of its parameter.
    binding : Path
        Its binding.
    library : Path
        The observation library.
    """

    def __init__(self, scenario: Scenario, asset: AssetSource, binding: Path, library: Path) -> None:
        self._scenario = scenario
        self._asset = asset
        self._binding = binding
        self._path = library
        self._library: ObservationLibrary | None = None
        self._other_fmu: bool | None = False

    @property
    def origin(self) -> Origin:
        """The asset, and the library; they differ if the library was sampled from another FMU."""
        other = {True: " of another FMU", False: " of it", None: ""}[self._other_fmu]
        return Origin(self._asset.origin.asset, f"observation library{other}", differ=self._other_fmu is True)

    def check(self) -> None:
        """Check the asset, and that the library has what the scenario asks for.

        Raises
        ------
        InvalidObservationLibraryError
            The library is missing or damaged, or lacks something.
        """
        self._asset.check()
        self._read()

    def files(self) -> dict[str, bytes]:
        """Return the files of the asset, and the library."""
        try:
            content = self._path.read_bytes()
        except OSError as error:
            raise InvalidObservationLibraryError(
                f"the observation library {self._path} cannot be read: {error.strerror or error}."
            ) from error
        return {**self._asset.files(), OBSERVATIONS_COPY: content}

    def prepare(self, folder: Path, progress: Progress) -> dict[str, str]:
        """Prepare the asset and copy the library; return the hashes of both."""
        hashes = self._asset.prepare(folder, progress)
        copy = folder / OBSERVATIONS_COPY
        if not copy.exists():
            atomic_write_bytes(copy, self._path.read_bytes())
        self._path = copy
        library = self._read()
        flown = hashes.get("fmu")  # several FMUs have several
        self._other_fmu = None if flown is None else library.fmu_hash != flown
        return {**hashes, "observation_library": hashlib.sha256(copy.read_bytes()).hexdigest()}

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of the parameter, from the calibration of the scenario."""
        draws = self._asset.draws(seed)
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
        """Return the asset at its start."""
        return self._asset.open()

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write the field of the asset."""
        return self._asset.write_field(path, state, control)

    def _places(self, library: ObservationLibrary, model: GraphicalModel) -> tuple[list[int], list[int]]:
        rows = library.rows_of(self._scenario.state_names, model.states.coordinates)
        controls = [library.control_of(control.name, control.values) for control in self._scenario.control]
        return rows, controls

    def _read(self) -> ObservationLibrary:
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
            ("was sampled under the load", _shown(library.load), _shown(scenario.asset.load)),
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
