"""The model of a wing design as what the twin believes, with its field, without an FMU."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.result import CalibrationResult
from fe.cache import reduced_model, wing_fields
from fe.design import WingDesign, load_design
from fe.fields import write_wing_vtu
from fe.reduced import ReducedModel
from fmu_asset.patch_file import load_patch
from reporting.files import atomic_write_bytes, write_error
from reporting.progress import Progress
from reporting.provenance import hash_file
from twin_master.asset_source import (
    CALIBRATION_COPY,
    DESIGN_COPY,
    MODEL_PATCH_COPY,
    Origin,
    check_wing_scenario,
    wing_asset,
)
from twin_master.assets import Asset
from twin_master.errors import MissionInputError
from twin_master.graphical_model import GraphicalModel
from twin_master.parameter import ParameterDraws, draw_parameter
from twin_master.patches import check_model_patch, model_observation_table
from twin_master.scenario import Scenario

Float = NDArray[np.float64]


class DesignSource:
    """The reduced model of a design file, or of the design inside a calibration file.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    design : Path or None
        Wing design; that of the calibration if absent.
    calibration : Path or None
        Calibration file of the wing.
    """

    def __init__(self, scenario: Scenario, design: Path | None, calibration: Path | None = None) -> None:
        self._scenario = scenario
        model_patch = None if scenario.asset.model_patch is None else Path(scenario.asset.model_patch)
        self._given = {
            DESIGN_COPY: design,
            CALIBRATION_COPY: calibration,
            MODEL_PATCH_COPY: model_patch,
        }
        self._patch: Path | None = None
        self._design: WingDesign | None = None
        self._wing: ReducedModel | None = None
        self._mean = 1.0
        self._name = ""

    @property
    def origin(self) -> Origin:
        """The reduced model, twice; it has the name of its design once prepared."""
        model = f"reduced model of the design {self._name}".rstrip()
        if self._given[MODEL_PATCH_COPY] is not None:
            model = f"{model}, with effects"
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
        CalibrationRecordError
            The calibration file is damaged or of another kind, or has no samples of the parameter.
        MissingObservationModelError
            The scenario's states, controls, parameter or sensors are not those of the design's model.
        """
        self.files()
        calibration = read_calibration(self._given[CALIBRATION_COPY], self._scenario)
        design = read_design(self._given[DESIGN_COPY], calibration, tailored=self._given[DESIGN_COPY] is None)
        if design is None:
            raise MissionInputError("there is neither a wing design nor a calibration file.")
        gauges = len(design.gauges.positions)
        check_wing_scenario(self._scenario, gauges)
        patch = self._given[MODEL_PATCH_COPY]
        if patch is not None:
            check_model_patch(load_patch(patch), gauges, str(patch))

    def files(self) -> dict[str, bytes]:
        """Return design and calibration as they are given.

        Raises
        ------
        MissionInputError
            It cannot be read.
        """
        return {name: read_content(path) for name, path in self._given.items() if path is not None}

    def prepare(self, folder: Path, progress: Progress) -> dict[str, str]:
        """Copy what is given into the run folder and reduce the design; return the hashes.

        Raises
        ------
        MissionInputError, InvalidDesignError
            The design cannot be read, or is wrong.
        """
        copies = {name: folder / name for name, path in self._given.items() if path is not None}
        for name, copy in copies.items():
            if not copy.exists():
                atomic_write_bytes(copy, self.files()[name])
        hashes = {}
        if MODEL_PATCH_COPY in copies:
            self._patch = copies[MODEL_PATCH_COPY]
            hashes["model_patch"] = hash_file(self._patch)
        if CALIBRATION_COPY in copies:
            hashes["calibration"] = hash_file(copies[CALIBRATION_COPY])
        calibration = read_calibration(copies.get(CALIBRATION_COPY), self._scenario)
        self._design = read_design(copies.get(DESIGN_COPY), calibration, tailored=DESIGN_COPY not in copies)
        if self._design is None:
            raise MissionInputError("there is neither a wing design nor a calibration file.")
        self._name = self._design.name
        self._wing = reduced_model(self._design, progress=progress)
        return {**hashes, "design": self._wing.design_hash}

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of e."""
        draws = draw_parameter(self._scenario.calibration, seed, self._model)
        self._mean = draws.mean
        return draws

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the strains (E, S, U, G)."""
        return model_observation_table(self._model, self._scenario, draws, model, self._patch, self._design)

    def open(self) -> Asset:
        """Return the model as an asset."""
        return wing_asset(self._model, self._scenario)

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write displacement and strain of the wing as VTU, at the mean of the calibration."""
        if self._design is None:
            return False
        return write_design_field(path, self._scenario, self._design, self._mean, state, control)


def read_calibration(path: Path | None, scenario: Scenario) -> CalibrationResult | None:
    """Return the calibration file, if there is one, with samples of the scenario's parameter.

    Raises
    ------
    CalibrationRecordError
        It is damaged or of another kind, or has no samples of the parameter.
    """
    if path is None:
        return None
    calibration = CalibrationResult.load(path)
    calibration.draws_of(scenario.calibration.parameter)
    return calibration


def read_design(
    path: Path | None, calibration: CalibrationResult | None, *, tailored: bool
) -> WingDesign | None:
    """Return the design of a calibration, if it is to be tailored, or else that of a file."""
    if tailored and calibration is not None:
        return calibration.design
    return None if path is None else load_design(path)


def write_design_field(
    path: Path,
    scenario: Scenario,
    design: WingDesign,
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
    fields = wing_fields(design)
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
