"""A wing: its design, or the design inside a calibration file, packed as the asset or believed as a model."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from reporting.progress import Progress
from reporting.provenance import hash_file
from twin_master.assets.asset_source import (
    BINDING_COPY,
    FLOWN_DESIGN_HASH,
    MODEL_PATCH_COPY,
    PATCH_COPY,
    AssetSource,
    Source,
)
from twin_master.assets.fmu_source import FmuSection, FmuSource
from twin_master.assets.parameter import OWN_OF_WING, ParameterDraws, check_calibration, read_calibration
from twin_master.assets.reduced_model import ReducedModelSource, check_wing_scenario
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


class DesignSection(FmuSection):
    """The FMU that is packed of a wing design."""

    kind: Literal["design", "calibration"] = "design"
    design: str
    patch: str | None = None
    """A patch file: missing effects that the FMU carries, switched on from the start unless `parameters` says
    otherwise. The twin does not know of them."""
    packed: Literal["python", "compiled"] = "python"
    """What evaluates the FMU: Python, or C compiled here, which carries no patch."""

    kept: ClassVar[Mapping[str, str]] = {
        "binding": BINDING_COPY,
        "design": FLOWN_DESIGN_COPY,
        "patch": PATCH_COPY,
    }

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

    kept: ClassVar[Mapping[str, str]] = {"design": DESIGN_COPY, "patch": MODEL_PATCH_COPY}

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
    source : Source
        Of whose files it is made.
    section : DesignSection or DesignBelief
        What names the wing.
    """

    def __init__(self, source: Source, section: DesignSection | DesignBelief) -> None:
        self._source, self._section = source, section
        self.name = ""

    @property
    def words(self) -> str:
        """The model of the design, which has its name once prepared."""
        return f"reduced model of the design {self.name}".rstrip()

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

        if CALIBRATION_COPY not in self._source.places:
            raise MissionInputError("the design of a calibration is asked for, and there is no such file.")
        return load_calibration(self._source.path(CALIBRATION_COPY))

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
        return load_design(self._source.path(self._section.copies()["design"]))

    def reduced(self, progress: Progress) -> "ReducedModel":
        """Reduce the design."""
        from fe.reduction.model_cache import reduced_model

        design = self.design()
        self.name = design.name
        return reduced_model(design, progress=progress)

    @property
    def patch_path(self) -> Path | None:
        """The patch file, if there is one."""
        copy = self._section.copies()["patch"]
        return self._source.path(copy) if copy in self._source.places else None

    def patch(self) -> "PatchFile | None":
        """Return the patch, if there is one."""
        from fmu_asset.packing.patch_file import load_patch

        return None if self.patch_path is None else load_patch(self.patch_path)

    def write_field(
        self,
        path: Path,
        scenario: Scenario,
        mean: float,
        state: Mapping[str, float],
        control: Mapping[str, float],
    ) -> bool:
        """Write displacement and strain under a state and a control as VTU; return whether there is a field.

        Young's modulus is that of the true wing where the scenario tells it, else the mean of the
        calibration.

        Raises
        ------
        FileNotWrittenError
            The disk is full or the folder cannot be written.
        """
        from fe.reduction.fields import write_wing_vtu
        from fe.reduction.model_cache import wing_fields

        design = self.design() if self.name else None
        if design is None or {*state} != {*design.regions} or {*control} != {"load_factor"}:
            return False
        wing = wing_fields(design)
        e = scenario.asset.true_parameters.get("young_modulus_factor", mean)
        force = scenario.asset.constant_load.get("tip_force", 0.0)
        values = {**control, "young_modulus_factor": e, "tip_force": force}
        write_wing_vtu(path, wing, wing.vector(values, state))
        return True


class WingFmuSource(FmuSource):
    """The FMU that is packed of a wing design."""

    def __init__(self, scenario: Scenario, section: DesignSection) -> None:
        super().__init__(scenario, section)
        self._of = _Wing(self, section)
        self._packed = section.packed
        self._mean = 1.0

    @property
    def words(self) -> str:
        """The FMU; it has the name of its design once prepared."""
        return f"FMU of the {self._of.words}{'' if self._of.patch_path is None else ', with hidden effects'}"

    def binding(self) -> "Binding":
        """Return the binding with the damage regions of the design."""
        return super().binding().with_regions(self._of.design().regions)

    def _effects(self) -> tuple[str, ...]:
        from fmu_asset.packing.structure_fmu import check_form
        from twin_master.assets.patches import effect_names

        check_form(self._packed, patched=self._of.patch_path is not None)
        if self._of.patch_path is None:
            return ()
        return effect_names(self._of.patch_path, len(self._of.design().gauges.positions))

    def _check_calibration(self, binding: "Binding", effects: tuple[str, ...]) -> None:
        known, where = (*binding.parameter, *effects), f"the binding {binding.name}"
        check_calibration(self._scenario.calibration, known, where, advice=OWN_OF_WING)

    def _fitted(self, binding: "Binding", folder: Path) -> "Binding":
        return binding

    def _make(self, progress: Progress) -> dict[str, str]:
        """Reduce the design and pack the FMU."""
        from fmu_asset.packing.wing_packing import pack_wing

        self.model, options = self._of.reduced(progress), {}
        calibration = self._of.calibration()
        if calibration is not None:
            from calibration.result.plain import tailoring  # takes a second to load

            options = tailoring(calibration)
        with progress.stage("Packing the FMU"):
            pack_wing(
                self._of.design(), self.fmu_path(), kind=self._packed, patch=self._of.patch(), activate=True,
                replace=True, progress=progress, **options,
            )  # fmt: skip
        return {FLOWN_DESIGN_HASH: self.model.design_hash, "fmu": hash_file(self.fmu_path())}

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of the calibrated parameter."""
        draws = super().draws(seed)
        self._mean = draws.mean
        return draws

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write displacement and strain of the wing as VTU."""
        return self._of.write_field(path, self._scenario, self._mean, state, control)


class DesignSource(ReducedModelSource):
    """The reduced model of a design file, or of the design inside a calibration file, as what is believed.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    section : DesignBelief
        What is believed.
    """

    def __init__(self, scenario: Scenario, section: DesignBelief) -> None:
        super().__init__(scenario, section=section)
        self._of = _Wing(self, section)

    @property
    def words(self) -> str:
        """The reduced model; it has the name of its design once prepared."""
        return f"{self._of.words}{'' if self._of.patch_path is None else ', with effects'}"

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
        from fe.wing.design import wing_structure
        from twin_master.assets.patches import check_model_patch

        calibration = self._scenario.calibration
        read_calibration(calibration)
        self.files()
        design = self._of.design()
        ranges = {part.name: part.range for part in wing_structure(design.regions, 0).parameter}
        check_calibration(
            calibration, ranges, f"the reduced model of the design {design.name}", ranges=ranges,
            design_hash=design.hash, advice=OWN_OF_WING,
        )  # fmt: skip
        gauges, patch = len(design.gauges.positions), self._of.patch()
        check_wing_scenario(self._scenario, design.regions, gauges)
        if patch is not None:
            check_model_patch(patch, gauges, str(self._of.patch_path))

    def _make(self, progress: Progress) -> dict[str, str]:
        self.model = self._of.reduced(progress)
        return super()._make(progress)

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the strains (E, S, U, G)."""
        return self._strains(draws, model, self._of.patch())

    def structural_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float | None:
        """Return the strains of the structure itself (E, S, U, G); None where no effect is of its gauges."""
        patch = self._of.patch()
        kept = None if patch is None else patch.of_structure
        return None if kept == patch else self._strains(draws, model, kept)

    def _strains(self, draws: ParameterDraws, model: GraphicalModel, patch: "PatchFile | None") -> Float:
        if patch is None or not patch.effects:
            return super().observation_table(draws, model)
        from twin_master.assets.patches import patched_observation_table

        where, design = str(self._of.patch_path), self._of.design()
        return patched_observation_table(self.wing, self._scenario, draws, model, patch, design, where)

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write displacement and strain of the wing as VTU."""
        mean = self._means.get("young_modulus_factor", 1.0)
        return self._of.write_field(path, self._scenario, mean, state, control)
