"""The strain library of the authors of Kapteyn et al. 2021 as what is flown and what the twin believes."""

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from reporting.progress import Progress
from reporting.provenance import hash_file
from twin_master.assets.asset_source import AssetBelief, AssetSource, Source
from twin_master.assets.interface import Asset, AssetReading, StatelessAsset
from twin_master.assets.parameter import ParameterDraws
from twin_master.assets.strain_library import FILE_NAME, StrainLibrary, load_strain_library
from twin_master.errors import MissingObservationModelError, MissionInputError, check_names
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.asset import AssetSection, BeliefSection
from twin_master.scenario.schema import Scenario

Float = NDArray[np.float64]

REPOSITORY = "https://github.com/michaelkapteyn/UAV-Digital-Twin"
"""Where the authors of Kapteyn et al. 2021 published their strain library."""
LIBRARY_COPY = f"asset/{FILE_NAME}"
_TOLERANCE = 1e-9


class StrainLibrarySection(AssetSection):
    """A strain library in the authors' format."""

    kind: Literal["strain_library"] = "strain_library"
    file: str | None = None

    kept: ClassVar[Mapping[str, str]] = {"file": LIBRARY_COPY}

    def differs_from(self, belief: BeliefSection) -> bool:
        """Return whether the twin believes something else."""
        return not isinstance(belief, AssetBelief)

    def source(self, scenario: Scenario) -> "StrainLibrarySource":
        """Return the library, read.

        Raises
        ------
        MissionInputError
            No file is named.
        InvalidStrainLibraryError, MissingObservationModelError
            The library is missing, damaged or does not fit the scenario.
        """
        if self.file is None:
            raise MissionInputError(
                f"the scenario {scenario.mission.name} flies the strain library of the paper's authors, "
                f"which does not come with this program: clone their public repository UAV-Digital-Twin "
                f"({REPOSITORY}) and name its file {FILE_NAME} by `--strain-library FILE`, or as "
                f"`asset.file` in a copy of the scenario."
            )
        if self.differs_from(scenario.belief):
            check_load_factors(scenario)
        return _read(scenario, Path(self.file))


class StrainLibraryBelief(BeliefSection):
    """A strain library in the authors' format as the twin's model of an FMU."""

    kind: Literal["strain_library"] = "strain_library"
    file: str

    kept: ClassVar[Mapping[str, str]] = {"file": LIBRARY_COPY}

    @property
    def departs(self) -> bool:
        """An FMU is no strain library."""
        return True

    def source(self, scenario: Scenario, flown: AssetSource) -> "StrainLibrarySource":
        """Return the library, read.

        Raises
        ------
        MissionInputError
            A strain library flies.
        InvalidStrainLibraryError, MissingObservationModelError
            The library is missing, damaged or does not fit the scenario.
        """
        if not scenario.asset.is_fmu:
            raise MissionInputError(
                "a strain library flies, and the twin is to believe one: set `belief.kind` to `asset`."
            )
        check_load_factors(scenario)
        return _read(scenario, Path(self.file))


def _read(scenario: Scenario, path: Path) -> "StrainLibrarySource":
    return StrainLibrarySource(scenario, load_strain_library(path), hash_file(path), path)


class StrainLibrarySource(Source):
    """A strain library in the format of the authors of Kapteyn et al. 2021, as model and as asset."""

    label = "strain library"

    def __init__(
        self, scenario: Scenario, library: StrainLibrary, content_hash: str, path: Path | None = None
    ) -> None:
        super().__init__(scenario)
        self.places = {} if path is None else {LIBRARY_COPY: path}
        self._library, self._hash = library, content_hash
        self._control_index = self._find_controls()
        if scenario.observation.count != library.gauge_count or scenario.state_names != library.states.names:
            raise MissingObservationModelError(
                f"the strain library has {library.gauge_count} gauges and the states "
                f"{', '.join(library.states.names)}, and the scenario asks for {scenario.observation.count} "
                f"and {', '.join(scenario.state_names)}."
            )

    def _find_controls(self) -> list[int]:
        rows = [("control", self._scenario.control_names, self._library.controls)]
        check_names("the scenario has the", "the strain library", rows, MissingObservationModelError)
        return [self._library.controls.index(name) for name in self._scenario.control_names]

    def _make(self, progress: Progress) -> dict[str, str]:
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


def check_load_factors(scenario: Scenario) -> None:
    """Check that a control named as in the library, such as `3g`, is a turn at that load factor.

    Raises
    ------
    MissingObservationModelError
        It is another one: asset and model would fly different turns.
    """
    for control in scenario.control:
        named, given = control.name.removesuffix("g"), control.values.get("load_factor")
        try:
            expected = float(named)
        except ValueError:
            continue
        if given is not None and abs(given - expected) > _TOLERANCE:
            raise MissingObservationModelError(
                f"the strain library flies the control {control.name} at load factor {expected:g}, and the "
                f"scenario gives the model of the design {given:g}: set `load_factor` to {expected:g}."
            )
