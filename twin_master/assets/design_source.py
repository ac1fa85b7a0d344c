"""A wing: its design, or the design inside a calibration file, packed as the asset or believed as a model."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from reporting.progress import Progress
from reporting.provenance import hash_file
from twin_master.assets.asset_source import (
    FLOWN_DESIGN_HASH,
    AssetSource,
    FlownAndBelieved,
    keep_files,
    named_files,
    read_files,
)
from twin_master.assets.fmu_source import BINDING_COPY, FmuSection, FmuSource
from twin_master.assets.interface import Asset
from twin_master.assets.parameter import (
    OWN_OF_WING,
    ParameterDraws,
    check_calibration,
    draw_parameter,
    read_calibration,
)
from twin_master.errors import MissionInputError
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.asset import CALIBRATED_DESIGN_NAME, BeliefSection
from twin_master.scenario.schema import CALIBRATION_COPY, Scenario

if TYPE_CHECKING:
    from calibration.result.record import Calibration
    from fe.runtime.reduced import ReducedModel
    from fe.wing.design import WingDesign
    from fmu_asset.door.binding import Binding
    from fmu_asset.packing.patch_file import PatchFile

Float = NDArray[np.float64]

DESIGN_COPY = "asset/design.toml"
FLOWN_DESIGN_COPY = "asset/flown_design.toml"
MODEL_PATCH_COPY = "asset/model_patch.json"
PATCH_COPY = "asset/patch.json"


class DesignSection(FmuSection):
    """The FMU that is packed of a wing design."""

    kind: Literal["design", "calibration"] = "design"
    design: str
    patch: str | None = None
    """A patch file: missing effects that the FMU carries, switched on from the start unless `parameters` says
    otherwise. The twin does not know of them."""
    packed: Literal["python", "compiled"] = "python"
    """What evaluates the FMU: Python, or C compiled here, which carries no patch."""

    def copies(self) -> Mapping[str, str]:
        """Return where the copies of binding, design and patch stand in a run folder."""
        return {"binding": BINDING_COPY, "design": FLOWN_DESIGN_COPY, "patch": PATCH_COPY}

    def differs_from(self, belief: BeliefSection) -> bool:
        """Return whether the asset has hidden effects, or the twin believes in some."""
        return self.patch is not None or belief.departs

    def source(self, scenario: Scenario) -> "WingFmuSource":
        """Return the FMU of the wing."""
        return WingFmuSource(scenario, self)


class CalibrationSection(DesignSection):
    """The FMU that is packed of the design inside the calibration file, with its figures."""

    kind: Literal["calibration"] = "calibration"
    design: Literal["calibration"] = "calibration"


class DesignBelief(BeliefSection):
    """The reduced model of a wing design."""

    kind: Literal["design", "calibration"] = "design"
    design: str
    patch: str | None = None
    """A patch file: effects that the model carries."""

    def copies(self) -> Mapping[str, str]:
        """Return where the copies of design and patch stand in a run folder."""
        return {"design": DESIGN_COPY, "patch": MODEL_PATCH_COPY}

    @property
    def departs(self) -> bool:
        """Whether effects were added to the model."""
        return self.patch is not None

    def source(self, scenario: Scenario, flown: AssetSource) -> "DesignSource":
        """Return the model of the wing."""
        return DesignSource(scenario, self)


class CalibrationBelief(DesignBelief):
    """The reduced model of the design inside the calibration file."""

    kind: Literal["calibration"] = "calibration"
    design: Literal["calibration"] = "calibration"


class _Wing:
    """A wing that a scenario names: its files where they are given, or their copies once kept.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    section : DesignSection or DesignBelief
        What names the wing.
    """

    def __init__(self, scenario: Scenario, section: DesignSection | DesignBelief) -> None:
        self._section = section
        self.places = named_files(scenario, section)

    def keep(self, folder: Path) -> dict[str, str]:
        """Copy what is given into the run folder and use the copies from then on; return the hashes."""
        keep_files(folder, read_files(self.places))
        self.places = {copy: folder / copy for copy in self.places}
        hashed = {"calibration": CALIBRATION_COPY, "patch": PATCH_COPY, "model_patch": MODEL_PATCH_COPY}
        return {name: hash_file(folder / copy) for name, copy in hashed.items() if copy in self.places}

    def calibration(self) -> "Calibration | None":
        """Return the calibration that the wing is tailored to; None for a design of its own.

        Raises
        ------
        MissionInputError, CalibrationRecordError
            There is no calibration file, or it is damaged.
        """
        if self._section.design != CALIBRATED_DESIGN_NAME:
            return None
        from calibration.result.file import load_calibration

        if CALIBRATION_COPY not in self.places:
            raise MissionInputError("the design of a calibration is asked for, and there is no such file.")
        return load_calibration(self.places[CALIBRATION_COPY])

    def design(self) -> "WingDesign":
        """Return the design.

        Raises
        ------
        MissionInputError, InvalidDesignError, CalibrationRecordError
            There is none, or it is wrong.
        """
        from fe.wing.design import load_design

        calibration = self.calibration()
        if calibration is not None:
            return calibration.wing_design
        return load_design(self.places[self._section.copies()["design"]])

    @property
    def patch_path(self) -> Path | None:
        """The patch file, if there is one."""
        return self.places.get(self._section.copies()["patch"])


class WingFmuSource(FmuSource):
    """The FMU that is packed of a wing design."""

    def __init__(self, scenario: Scenario, section: DesignSection) -> None:
        super().__init__(scenario, section)
        self._of = _Wing(scenario, section)
        self._packed = section.packed
        self._design: WingDesign | None = None
        self._wing: ReducedModel | None = None
        self._mean = 1.0

    @property
    def origin(self) -> FlownAndBelieved:
        """The FMU, twice; it has the name of its design once prepared."""
        name = "" if self._design is None else self._design.name
        words = f"FMU of the {_model_of(name)}"
        words = f"{words}, with hidden effects" if self._of.patch_path is not None else words
        return FlownAndBelieved(words, words)

    @property
    def wing(self) -> "ReducedModel | None":
        """The reduced model that was packed, once prepared."""
        return self._wing

    def check(self) -> None:
        """Read what is given where it is, without building anything.

        Raises
        ------
        MissionInputError, InvalidDesignError, FmuError
            A file cannot be read or is wrong, or the binding does not fit the scenario.
        CalibrationRecordError
            The calibration file is damaged or of another kind, or has no samples of the parameter.
        """
        from fmu_asset.compiled.compiler import find_compiler
        from fmu_asset.door.binding import load_binding
        from fmu_asset.packing.structure_fmu import check_kind

        read_calibration(self._scenario.calibration)
        self.files()
        if self._packed == "compiled":
            find_compiler()  # before the wing is reduced, which can take minutes
            if self._of.patch_path is not None:
                check_kind(self._packed)
        design = self._of.design()
        gauges = len(design.gauges.positions)
        binding = load_binding(self._section.binding_path).with_regions(design.regions)
        effects: tuple[str, ...] = ()
        if self._of.patch_path is not None:
            from twin_master.assets.patches import effect_names

            effects = effect_names(self._of.patch_path, gauges)
        known, where = (*binding.parameter, *effects), f"the binding {binding.name}"
        check_calibration(self._scenario.calibration, known, where, advice=OWN_OF_WING)
        self._check_names(binding, effects)
        self._observed(binding)
        self._inner_roles(binding)

    def binding(self) -> "Binding":
        """Return the binding with the damage regions of the design, once prepared."""
        return super().binding().with_regions(self._of.design().regions)

    def _make(self, progress: Progress) -> dict[str, str]:
        """Reduce the design and pack the FMU."""
        from fe.reduction.model_cache import reduced_model
        from fmu_asset.packing.patch_file import load_patch
        from fmu_asset.packing.wing_packing import pack_wing

        hashes = self._of.keep(self._path(""))
        calibration, patch = self._of.calibration(), self._of.patch_path
        self._design = self._of.design()
        self._wing = reduced_model(self._design, progress=progress)
        tailored = None
        if calibration is not None:
            from calibration.result.plain import tailoring  # takes a second to load

            tailored = tailoring(calibration)
        with progress.stage("Packing the FMU"):
            pack_wing(
                self._design,
                self.fmu_path(),
                tailoring=tailored,
                kind=self._packed,
                patch=None if patch is None else load_patch(patch),
                activate=True,
                replace=True,
                progress=progress,
            )
        return {**hashes, FLOWN_DESIGN_HASH: self._wing.design_hash, "fmu": hash_file(self.fmu_path())}

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of the calibrated parameter."""
        draws = super().draws(seed)
        self._mean = draws.mean
        return draws

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write displacement and strain of the wing as VTU."""
        if self._design is None:
            return False
        return write_design_field(path, self._scenario, self._design, self._mean, state, control)


class DesignSource:
    """The reduced model of a design file, or of the design inside a calibration file, as what is believed.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    section : DesignBelief
        What is believed.
    """

    def __init__(self, scenario: Scenario, section: DesignBelief) -> None:
        self._scenario = scenario
        self._of = _Wing(scenario, section)
        self._design: WingDesign | None = None
        self._wing: ReducedModel | None = None
        self._mean = 1.0

    @property
    def origin(self) -> FlownAndBelieved:
        """The reduced model, twice; it has the name of its design once prepared."""
        model = _model_of("" if self._design is None else self._design.name)
        if self._of.patch_path is not None:
            model = f"{model}, with effects"
        return FlownAndBelieved(model, model)

    @property
    def wing(self) -> "ReducedModel":
        """The reduced model, once prepared."""
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
        from fe.reduction.settings import ReductionSettings
        from twin_master.assets.wing_model import check_wing_scenario

        read_calibration(self._scenario.calibration)
        self.files()
        design = self._of.design()
        where = f"the {_model_of(design.name)}"
        ranges = {"young_modulus_factor": ReductionSettings().young_modulus_factor}
        check_calibration(
            self._scenario.calibration,
            ranges,
            where,
            ranges=ranges,
            design_hash=design.hash,
            advice=OWN_OF_WING,
        )
        gauges = len(design.gauges.positions)
        check_wing_scenario(self._scenario, design.regions, gauges)
        if self._of.patch_path is not None:
            from fmu_asset.packing.patch_file import load_patch
            from twin_master.assets.patches import check_model_patch

            check_model_patch(load_patch(self._of.patch_path), gauges, str(self._of.patch_path))

    def files(self) -> dict[str, bytes]:
        """Return design, patch and calibration as they are given.

        Raises
        ------
        MissionInputError
            One cannot be read.
        """
        return read_files(self._of.places)

    def prepare(self, folder: Path, progress: Progress) -> dict[str, str]:
        """Copy what is given into the run folder and reduce the design; return the hashes.

        Raises
        ------
        MissionInputError, InvalidDesignError
            The design cannot be read, or is wrong.
        """
        from fe.reduction.model_cache import reduced_model

        hashes = self._of.keep(folder)
        self._design = self._of.design()
        self._wing = reduced_model(self._design, progress=progress)
        return {**hashes, "design": self._wing.design_hash}

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of e."""
        draws = draw_parameter(self._scenario.calibration, seed, self.wing)
        self._mean = draws.mean
        return draws

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the strains (E, S, U, G)."""
        return self._strains(draws, model, self._patch())

    def structural_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float | None:
        """Return the strains of the structure itself (E, S, U, G); None where no effect is of its gauges."""
        patch = self._patch()
        kept = None if patch is None else patch.of_structure
        return None if kept == patch else self._strains(draws, model, kept)

    def _patch(self) -> "PatchFile | None":
        from fmu_asset.packing.patch_file import load_patch

        return None if self._of.patch_path is None else load_patch(self._of.patch_path)

    def _strains(self, draws: ParameterDraws, model: GraphicalModel, patch: "PatchFile | None") -> Float:
        from twin_master.assets.patches import model_observation_table

        where, design = str(self._of.patch_path), self._of.design()
        return model_observation_table(self.wing, self._scenario, draws, model, patch, design, where)

    def open(self) -> Asset:
        """Return the model as an asset."""
        from twin_master.assets.wing_model import wing_asset

        return wing_asset(self.wing, self._scenario)

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write displacement and strain of the wing as VTU."""
        if self._design is None:
            return False
        return write_design_field(path, self._scenario, self._design, self._mean, state, control)


def _model_of(name: str) -> str:
    return f"reduced model of the design {name}".rstrip()


def write_design_field(
    path: Path,
    scenario: Scenario,
    design: "WingDesign",
    mean: float,
    state: Mapping[str, float],
    control: Mapping[str, float],
) -> bool:
    """Write the field of a design under a state and a control as VTU; return whether it has one.

    Young's modulus is that of the true wing where the scenario tells it, else the mean of the calibration.

    Raises
    ------
    FileNotWrittenError
        The disk is full or the folder cannot be written.
    """
    from fe.reduction.fields import write_wing_vtu
    from fe.reduction.model_cache import wing_fields
    from reporting.files import write_error

    if {*state} != {*design.regions} or {*control} != {"load_factor"}:
        return False
    try:
        wing = wing_fields(design)
        e = scenario.asset.true_parameters.get("young_modulus_factor", mean)
        force = scenario.asset.constant_load.get("tip_force", 0.0)
        values = {**control, "young_modulus_factor": e, "tip_force": force}
        write_wing_vtu(path, wing, wing.model.vector(values, state))
    except OSError as error:
        raise write_error(error, path) from error
    return True
