"""The strain library of the authors of Kapteyn et al. 2021, as an asset and as a model.

`UAVconfig.json`, read from their repository as it is, contains the strains of their finite element
model for a grid of damage states, two controls and thirty draws of Young's modulus. It serves as a
model of the observations, and as an asset whose state may lie between the levels of the grid.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from reporting.arrays import Float
from reporting.json_file import JsonRecord, read_json
from reporting.words import comma_list
from twin_master.assets.asset_source import (
    LIBRARY_COPY,
    Asset,
    AssetReading,
    AssetSource,
    StatelessAsset,
)
from twin_master.assets.parameter import ParameterDraws
from twin_master.errors import MissionInputError, check_names
from twin_master.network.graphical_model import (
    Factor,
    GraphicalModel,
    StateSpace,
    interpolation_weights,
)
from twin_master.scenario.kinds import AssetSection, BeliefSection
from twin_master.scenario.schema import Scenario

FILE_NAME = "UAVconfig.json"
"""Name of the file in the authors' repository UAV-Digital-Twin."""
REPOSITORY = "https://github.com/michaelkapteyn/UAV-Digital-Twin"
"""Where the authors of Kapteyn et al. 2021 published their strain library."""
_LOAD_FACTOR_TOLERANCE = 1e-9

REGION_NAMES = ("z1", "z2")
PERCENT = 1e-2
MICROSTRAIN = 1e-6
_MEAN_ENTRY = "mean"
"""Key of the strains at the mean of Young's modulus; the other keys are the draws."""


@dataclass(frozen=True)
class StrainLibrary:
    """Strains for every damage state, control and draw of Young's modulus.

    Attributes
    ----------
    states : StateSpace
        The stiffness losses of the regions z1 and z2, fractions.
    controls : tuple of str
        The names of the controls: "2g", "3g".
    young_modulus_factor : (E,) array
        The draws of the factor e on Young's modulus [1].
    strain_per_draw : (E, S, U, G) array
        The strain of each draw, joint state, control and gauge [1].
    strain : (S, U, G) array
        The entry "mean": the solution at e = 1.0073, not the average of the draws [1].
    """

    states: StateSpace
    controls: tuple[str, ...]
    young_modulus_factor: Float
    strain_per_draw: Float
    strain: Float

    @property
    def gauge_count(self) -> int:
        """The number G of gauges."""
        return int(self.strain.shape[-1])

    def strain_at(self, stiffness_loss: Sequence[float], control_index: int) -> Float:
        """Return the strain in a damage state that may lie between the levels.

        The strains of the entry "mean" are interpolated linearly in the loss of each region.

        Parameters
        ----------
        stiffness_loss : (F,) sequence of float
            The loss of each region as a fraction, inside the range of the levels.
        control_index : int
            The index of the control among `controls`.

        Returns
        -------
        (G,) array
            The strain of each gauge [1].

        Raises
        ------
        MissionInputError
            If the state lies outside the levels.
        """
        strain = self.strain[:, control_index].reshape(*self.states.shape, -1)
        # One axis for each region, then the gauges. Each pass sums over the first axis.
        for factor, loss in zip(self.states.factors, stiffness_loss, strict=True):
            levels = factor.levels
            if not levels[0] <= loss <= levels[-1]:
                raise MissionInputError(
                    f"the strain library covers {factor.name} from {levels[0]:g} to "
                    f"{levels[-1]:g}, but the state has {loss:g}."
                )
            weights = interpolation_weights(np.array(levels), loss)
            strain = np.tensordot(weights, strain, axes=1)
        return strain


def load_strain_library(path: str | Path) -> StrainLibrary:
    """Read the authors' strain library.

    Parameters
    ----------
    path : str or Path
        The file `UAVconfig.json`, or the folder that contains it, such as a clone of their
        repository.

    Raises
    ------
    MissionInputError
        If the file cannot be read, is not JSON, lacks an entry (which the message names), or is not
        in the published format.
    """
    path = Path(path)
    file = path / FILE_NAME if path.is_dir() else path
    content = read_json(file, MissionInputError, what="strain library")
    try:
        return _parse_library(content)
    except KeyError as error:
        raise MissionInputError(
            f"the strain library {file} lacks the entry {error}; is it the file {FILE_NAME} as "
            "published?"
        ) from error
    except (TypeError, ValueError, AttributeError, IndexError) as error:
        raise MissionInputError(
            f"the strain library {file} is not in the published format: {error}"
        ) from error


def _parse_library(content: JsonRecord) -> StrainLibrary:
    """Build the library from the content of the authors' file.

    Its entry `observations[z1][z2][control][draw]` has the strain of each gauge in microstrain; z1
    and z2 are losses in percent, and the draw is a factor on Young's modulus, or "mean".
    """
    levels_by_region = content["states"]
    if len(levels_by_region) != len(REGION_NAMES):
        raise ValueError(
            f"'states' must have the levels of {len(REGION_NAMES)} regions, but it has those of "
            f"{len(levels_by_region)}"
        )
    controls = tuple(str(control) for control in content["controls"])
    observations = content["observations"]
    first_z1, first_z2 = (str(levels[0]) for levels in levels_by_region)
    first_entry = observations[first_z1][first_z2][controls[0]]
    draws = [key for key in first_entry if key != _MEAN_ENTRY]
    gauge_count = len(first_entry[_MEAN_ENTRY])
    rows = []
    for draw, z1, z2, control in product((_MEAN_ENTRY, *draws), *levels_by_region, controls):
        row = observations[str(z1)][str(z2)][control][draw]
        has_gauges = np.shape(row) == (gauge_count,)
        if not has_gauges or not np.all(np.isfinite(np.asarray(row, dtype=np.float64))):
            raise ValueError(
                f"observations[{z1}][{z2}][{control}][{draw}] must hold {gauge_count} finite "
                "strains"
            )
        rows.append(row)
    # The axes are the draw ("mean" first), the joint state of both regions, control and gauge.
    shape = (len(draws) + 1, -1, len(controls), gauge_count)
    table = np.array(rows, dtype=np.float64).reshape(shape) * MICROSTRAIN
    table.setflags(write=False)
    factors = []
    for name, levels in zip(REGION_NAMES, levels_by_region, strict=True):
        factors.append(Factor(name, tuple(float(level) * PERCENT for level in levels)))
    return StrainLibrary(
        states=StateSpace(tuple(factors)),
        controls=controls,
        young_modulus_factor=np.array([float(draw) for draw in draws]),
        strain_per_draw=table[1:],
        strain=table[0],
    )


class StrainLibrarySection(AssetSection):
    """A strain library in the authors' format flies."""

    kind: Literal["strain_library"] = "strain_library"
    has_unique_model: ClassVar = True
    file: str | None = None
    """The strain library, `UAVconfig.json` of its authors."""

    copy_paths: ClassVar[Mapping[str, str]] = {"file": LIBRARY_COPY}

    def source(self, scenario: Scenario) -> "StrainLibrarySource":
        """Read the library and return its source.

        Raises
        ------
        MissionInputError
            If no file is named, or the library is missing, damaged or does not fit the scenario.
        """
        if self.file is None:
            raise MissionInputError(
                f"the scenario {scenario.mission.name} flies the strain library of the paper's "
                "authors, which does not come with this program: clone their public repository "
                f"UAV-Digital-Twin ({REPOSITORY}) and name its file {FILE_NAME} by "
                "`--strain-library FILE`, or as `asset.file` in a copy of the scenario."
            )
        return _source_of_file(scenario, Path(self.file))


class StrainLibraryBelief(BeliefSection):
    """A strain library in the authors' format is the twin's model of an FMU."""

    kind: Literal["strain_library"] = "strain_library"
    has_unique_model: ClassVar = True
    file: str
    """The strain library, `UAVconfig.json` of its authors."""

    copy_paths: ClassVar[Mapping[str, str]] = {"file": LIBRARY_COPY}

    def source(self, scenario: Scenario, flown_source: AssetSource) -> "StrainLibrarySource":
        """Read the library and return its source.

        Raises
        ------
        MissionInputError
            If a strain library flies, or the library is missing, damaged or does not fit the
            scenario.
        """
        if not scenario.asset.is_fmu:
            raise MissionInputError(
                "the asset is a strain library already: set `belief.kind` to `asset`, so that the "
                "twin believes it."
            )
        return _source_of_file(scenario, Path(self.file))


class StrainLibrarySource(AssetSource):
    """A strain library of the authors of Kapteyn et al. 2021, as model and as asset.

    Parameters
    ----------
    path : Path, optional
        The path of the library's file; a run folder gets a copy of it.
    """

    label = "strain library"

    def __init__(
        self, scenario: Scenario, library: StrainLibrary, path: Path | None = None
    ) -> None:
        super().__init__(scenario)
        self.file_paths = {} if path is None else {LIBRARY_COPY: path}
        self._library = library
        # An action flies under the loads of its control.
        control_of_action = {action.name: action.control for action in scenario.action}
        names = [control_of_action.get(name, name) for name in scenario.control_names]
        check_names(
            "the scenario has the", "the strain library", [("control", names, library.controls)]
        )
        self._control_indices = [library.controls.index(name) for name in names]
        has_same_gauges = scenario.observation.count == library.gauge_count
        if not has_same_gauges or scenario.state_names != library.states.names:
            raise MissionInputError(
                f"the strain library has {library.gauge_count} gauges and the states "
                f"{comma_list(library.states.names)}, but the scenario asks for "
                f"{scenario.observation.count} and {comma_list(scenario.state_names)}."
            )

    def draw_summary(self) -> tuple[str, int]:
        """Return the origin of the parameter's draws, in words, and their number."""
        return "the samples of the strain library", len(self._library.young_modulus_factor)

    def draws(self, seed: int) -> ParameterDraws:
        """Return the sampled values of the parameter."""
        values = self._library.young_modulus_factor
        return ParameterDraws(
            name=self._scenario.calibration.parameter,
            values=values,
            mean=float(values.mean()),
            standard_deviation=float(values.std(ddof=1)),
            source=f"the {len(values)} samples of the strain library",
        )

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the library's strains (E, S, U, G), by draw, state, control and gauge.

        Raises
        ------
        InvalidModelError
            If a level of the scenario is not a level of the library.
        """
        # The library may have more states and controls than the scenario, and in another order.
        library_states = self._library.states
        state_indices = [library_states.index(tuple(levels)) for levels in model.states.coordinates]
        strain_of_states = self._library.strain_per_draw[:, state_indices]
        return strain_of_states[:, :, self._control_indices]

    def open(self) -> Asset:
        """Return an asset with the noise-free strains at the mean of the parameter.

        The strains are interpolated between the damage levels of the library.
        """
        names = self._scenario.state_names
        control_values = [control.values for control in self._scenario.control]

        def observe(control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
            control_index = self._control_indices[control_values.index(dict(control))]
            losses = [health[name] for name in names]
            return AssetReading(self._library.strain_at(losses, control_index))

        return StatelessAsset(observe)


def _source_of_file(scenario: Scenario, path: Path) -> StrainLibrarySource:
    """Read a library from a file and return its source.

    If asset and believed model differ, the load factor of each control is checked: the library
    states it in the control's name, such as `3g`, and the scenario as an input.

    Raises
    ------
    MissionInputError
        If the two load factors of a control differ, so that asset and model would fly different
        turns; or if the library is missing, damaged or does not fit the scenario.
    """
    if scenario.models_differ:
        for control in scenario.control:
            try:
                library_load_factor = float(control.name.removesuffix("g"))
            except ValueError:
                continue  # the name of the control contains no load factor
            # An input that the scenario does not state cannot contradict the name.
            load_factor = control.values.get("load_factor", library_load_factor)
            if abs(load_factor - library_load_factor) > _LOAD_FACTOR_TOLERANCE:
                raise MissionInputError(
                    f"the strain library flies the control {control.name} at load factor "
                    f"{library_load_factor:g}, but the scenario gives the model of the design "
                    f"{load_factor:g}: set `load_factor` to {library_load_factor:g}."
                )
    return StrainLibrarySource(scenario, load_strain_library(path), path)
