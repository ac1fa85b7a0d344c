"""The strain library of the authors of Kapteyn et al. 2021 as what is flown and what the twin believes.

`UAVconfig.json`, read from their repository as it is, holds the strains of their finite element model for a
grid of damage states, two controls and thirty draws of Young's modulus. It serves as an observation model,
and as an asset whose state may lie between the levels of the grid.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from reporting.arrays import Float
from reporting.json_file import read_json
from twin_master.assets.asset_source import (
    LIBRARY_COPY,
    Asset,
    AssetReading,
    AssetSource,
    StatelessAsset,
)
from twin_master.assets.parameter import ParameterDraws
from twin_master.errors import (
    MissionInputError,
    check_names,
    said,
)
from twin_master.network.graphical_model import Factor, GraphicalModel, StateSpace
from twin_master.scenario.kinds import AssetSection, BeliefSection
from twin_master.scenario.schema import Scenario

FILE_NAME = "UAVconfig.json"
"""Name of the file in the authors' repository UAV-Digital-Twin."""
REPOSITORY = "https://github.com/michaelkapteyn/UAV-Digital-Twin"
"""Where the authors of Kapteyn et al. 2021 published their strain library."""
_TOLERANCE = 1e-9

REGION_NAMES = ("z1", "z2")
PERCENT, MICROSTRAIN = 1e-2, 1e-6


@dataclass(frozen=True)
class StrainLibrary:
    """Strains for every damage state, control and draw of Young's modulus.

    Attributes
    ----------
    states : StateSpace
        Stiffness loss of the regions z1 and z2, fractions.
    controls : tuple of str
        For example "2g", "3g".
    young_modulus_factor : (E,) dimensionless
        The draws e.
    strain_per_draw : (E, S, U, G) dimensionless
        Strain of each draw, joint state, control and gauge.
    strain : (S, U, G) dimensionless
        The entry "mean": the solution at e = 1.0073, not the average of the draws.
    """

    states: StateSpace
    controls: tuple[str, ...]
    young_modulus_factor: Float
    strain_per_draw: Float
    strain: Float

    @property
    def gauge_count(self) -> int:
        """Number G of gauges."""
        return int(self.strain.shape[-1])

    def strain_at(self, stiffness_loss: Sequence[float], control_index: int) -> Float:
        """Return the strain of a damage state between the levels, as an asset would have it.

        Multilinear in the stiffness losses, from the entry "mean".

        Parameters
        ----------
        stiffness_loss : (regions,)
            Fractions, inside the range of the levels.
        control_index : int
            Of `controls`.

        Returns
        -------
        (G,) dimensionless

        Raises
        ------
        MissionInputError
            The state lies outside the levels.
        """
        strain = self.strain[:, control_index].reshape(*self.states.shape, -1)
        for factor, value in zip(self.states.factors, stiffness_loss, strict=True):
            known = factor.levels
            if not known[0] <= value <= known[-1]:
                why = said("assets.covers", factor=factor, ends=(known[0], known[-1]), value=value)
                raise MissionInputError(why)
            weights = [np.interp(value, known, level) for level in np.eye(len(known))]
            strain = np.tensordot(weights, strain, axes=1)
        return strain


def load_strain_library(path: str | Path) -> StrainLibrary:
    """Read the authors' library.

    Parameters
    ----------
    path : str or Path
        The file `UAVconfig.json`, or the folder (such as a clone of their repository) that holds it.

    Raises
    ------
    MissionInputError
        If the file cannot be read, is no JSON, lacks an entry (it is named), or has values that are not in
        the published format.
    """
    path = Path(path)
    file = path / FILE_NAME if path.is_dir() else path
    content = read_json(file, MissionInputError, what="strain library")
    try:
        return _arranged(content)
    except KeyError as error:
        why = said("assets.lacks", file=file, error=error, file_name=FILE_NAME)
        raise MissionInputError(why) from error
    except (TypeError, ValueError, AttributeError, IndexError) as error:
        raise MissionInputError(said("assets.unread", file=file, error=error)) from error


def _arranged(content: Mapping[str, Any]) -> StrainLibrary:
    levels = content["states"]
    if len(levels) != len(REGION_NAMES):
        raise ValueError(said("assets.regions", regions=len(REGION_NAMES), came=len(levels)))
    controls = tuple(str(control) for control in content["controls"])
    observations = content["observations"]
    first = observations[str(levels[0][0])][str(levels[1][0])][controls[0]]
    draws = [key for key in first if key != "mean"]
    gauges = len(first["mean"])
    rows = []
    for draw, z1, z2, control in product(("mean", *draws), *levels, controls):
        row = observations[str(z1)][str(z2)][control][draw]
        if np.shape(row) != (gauges,) or not np.all(np.isfinite(np.asarray(row, dtype=np.float64))):
            raise ValueError(f"observations[{z1}][{z2}][{control}][{draw}] must hold {gauges} finite strains")
        rows.append(row)
    table = np.array(rows, dtype=np.float64).reshape(len(draws) + 1, -1, len(controls), gauges) * MICROSTRAIN
    table.setflags(write=False)
    factors = (
        Factor(name, tuple(float(level) * PERCENT for level in given))
        for name, given in zip(REGION_NAMES, levels, strict=True)
    )
    return StrainLibrary(
        states=StateSpace(tuple(factors)),
        controls=controls,
        young_modulus_factor=np.array([float(draw) for draw in draws]),
        strain_per_draw=table[1:],
        strain=table[0],
    )


class StrainLibrarySection(AssetSection):
    """A strain library in the authors' format."""

    kind: Literal["strain_library"] = "strain_library"
    has_unique_model: ClassVar = True
    file: str | None = None

    copy_paths: ClassVar[Mapping[str, str]] = {"file": LIBRARY_COPY}

    def source(self, scenario: Scenario) -> "StrainLibrarySource":
        """Return the library, read.

        Raises
        ------
        MissionInputError
            No file is named, or the library is missing, damaged or does not fit the scenario.
        """
        if self.file is None:
            where = REPOSITORY, FILE_NAME
            raise MissionInputError(said("assets.authors", scenario=scenario, where=where))
        return _read(scenario, Path(self.file))


class StrainLibraryBelief(BeliefSection):
    """A strain library in the authors' format as the twin's model of an FMU."""

    kind: Literal["strain_library"] = "strain_library"
    has_unique_model: ClassVar = True
    file: str

    copy_paths: ClassVar[Mapping[str, str]] = {"file": LIBRARY_COPY}

    def source(self, scenario: Scenario, flown: AssetSource) -> "StrainLibrarySource":
        """Return the library, read.

        Raises
        ------
        MissionInputError
            A strain library flies, or the library is missing, damaged or does not fit the scenario.
        """
        if not scenario.asset.is_fmu:
            raise MissionInputError(said("assets.believed"))
        return _read(scenario, Path(self.file))


class StrainLibrarySource(AssetSource):
    """A strain library in the format of the authors of Kapteyn et al. 2021, as model and as asset."""

    label = "strain library"

    def __init__(self, scenario: Scenario, library: StrainLibrary, path: Path | None = None) -> None:
        super().__init__(scenario)
        self.places = {} if path is None else {LIBRARY_COPY: path}
        self._library = library
        loads = {action.name: action.control for action in scenario.action}
        names = [loads.get(name, name) for name in scenario.control_names]
        check_names("the scenario has the", "the strain library", [("control", names, library.controls)])
        self._control_index = [library.controls.index(name) for name in names]
        if scenario.observation.count != library.gauge_count or scenario.state_names != library.states.names:
            raise MissionInputError(said("assets.gauges", library=library, scenario=scenario))

    def uncertain(self) -> tuple[str, int]:
        """Return that it has samples of its own, and how many."""
        return "the samples of the strain library", len(self._library.young_modulus_factor)

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
        names, values = (
            self._scenario.state_names,
            [control.values for control in self._scenario.control],
        )

        def observe(control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
            index = self._control_index[values.index(dict(control))]
            return AssetReading(self._library.strain_at([health[name] for name in names], index))

        return StatelessAsset(observe)


def _read(scenario: Scenario, path: Path) -> StrainLibrarySource:
    """Return the library of a file; beside another model, a control such as `3g` must be that load factor.

    Raises
    ------
    MissionInputError
        It is another one: asset and model would fly different turns.
    """
    for control in scenario.control if scenario.another_model else ():
        named, given = control.name.removesuffix("g"), control.values.get("load_factor")
        try:
            expected = float(named)
        except ValueError:
            continue
        if given is not None and abs(given - expected) > _TOLERANCE:
            factors = expected, given
            raise MissionInputError(said("assets.load_factor", control=control, factors=factors))
    return StrainLibrarySource(scenario, load_strain_library(path), path)
