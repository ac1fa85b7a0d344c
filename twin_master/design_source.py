"""The model of a wing design as what the twin believes, with its field, without an FMU."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fe.cache import reduced_model, wing_fields
from fe.design import load_design
from fe.fields import write_wing_vtu
from fe.reduced import ReducedModel
from reporting.files import atomic_write_bytes, write_error
from reporting.progress import Progress
from twin_master.asset_source import (
    DESIGN_COPY,
    Origin,
    check_wing_scenario,
    wing_asset,
    wing_observation_table,
)
from twin_master.assets import Asset
from twin_master.errors import MissionInputError
from twin_master.graphical_model import GraphicalModel
from twin_master.parameter import ParameterDraws, draw_parameter
from twin_master.scenario import Scenario

Float = NDArray[np.float64]


class DesignSource:
    """The reduced model of a design file.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    design : Path
        Wing design.
    """

    def __init__(self, scenario: Scenario, design: Path) -> None:
        self._scenario = scenario
        self._design = design
        self._copy: Path | None = None
        self._wing: ReducedModel | None = None
        self._mean = 1.0
        self._name = ""

    @property
    def origin(self) -> Origin:
        """The reduced model, twice; it has the name of its design once prepared."""
        model = f"reduced model of the design {self._name}".rstrip()
        return Origin(model, model)

    @property
    def _model(self) -> ReducedModel:
        if self._wing is None:
            raise MissionInputError("the model was not prepared: call `prepare` first.")
        return self._wing

    def check(self) -> None:
        """Read the design without building anything.

        Raises
        ------
        MissionInputError, InvalidDesignError
            The design cannot be read, or is wrong.
        MissingObservationModelError
            The scenario's states, controls, parameter or sensors are not those of the design's model.
        """
        self.files()
        check_wing_scenario(self._scenario, len(load_design(self._design).gauges.positions))

    def files(self) -> dict[str, bytes]:
        """Return the design as it is given.

        Raises
        ------
        MissionInputError
            It cannot be read.
        """
        return {DESIGN_COPY: read_content(self._design)}

    def prepare(self, folder: Path, progress: Progress) -> dict[str, str]:
        """Copy the design into the run folder and reduce it; return its hash.

        Raises
        ------
        MissionInputError, InvalidDesignError
            The design cannot be read, or is wrong.
        """
        self._copy = folder / DESIGN_COPY
        if not self._copy.exists():
            atomic_write_bytes(self._copy, read_content(self._design))
        design = load_design(self._copy)
        self._name = design.name
        self._wing = reduced_model(design, progress=progress)
        return {"design": self._wing.design_hash}

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of e."""
        draws = draw_parameter(self._scenario.calibration, seed, self._model)
        self._mean = draws.mean
        return draws

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the strains (E, S, U, G)."""
        return wing_observation_table(self._model, self._scenario, draws, model)

    def open(self) -> Asset:
        """Return the model as an asset."""
        return wing_asset(self._model, self._scenario)

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write displacement and strain of the wing as VTU, at the mean of the calibration."""
        if self._copy is None:
            return False
        return write_design_field(path, self._scenario, self._copy, self._mean, state, control)


def write_design_field(
    path: Path,
    scenario: Scenario,
    design: Path,
    young_modulus_factor: float,
    state: Mapping[str, float],
    control: Mapping[str, float],
) -> bool:
    """Write the field of a design under a state and a control as VTU; return whether it has one.

    Raises
    ------
    FileNotWrittenError
        The disk is full or the folder cannot be written.
    """
    if {*state} != {"z1", "z2"} or {*control} != {"load_factor"}:
        return False
    fields = wing_fields(load_design(design))
    try:
        write_wing_vtu(
            path,
            fields,
            young_modulus_factor=young_modulus_factor,
            stiffness_loss=(state["z1"], state["z2"]),
            load_factor=control["load_factor"],
            tip_force=scenario.asset.load.get("tip_force", 0.0),
        )
    except OSError as error:
        raise write_error(error, path) from error
    return True


def read_content(path: Path) -> bytes:
    """Return what a file holds.

    Raises
    ------
    MissionInputError
        It cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise MissionInputError(f"{path} cannot be read: {error.strerror or error}.") from error
