"""A wing from its design or from a calibration file: packed as the asset, or believed as a model.

A wing is a structure whose mesh follows from its design, and it can carry effects.
"""

from collections.abc import Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal, NamedTuple, Protocol

import numpy as np

from fe.runtime.patch import LoadPlace, LocalStiffnessLoss, PointMass, PortForce, SensorDrift
from fe.runtime.state import wing_input_names
from fe.runtime.wing_rows import OVERHANG
from fe.structure.tables import StructureDesign
from fe.wing.design import WingDesign, load_design, wing_structure
from fmu_asset.client.binding import Binding
from reporting.arrays import Float
from reporting.progress import Progress
from twin_master.assets.asset_source import (
    BINDING_COPY,
    MODEL_PATCH_COPY,
    PATCH_COPY,
    AssetSource,
    table_of_observations,
)
from twin_master.assets.fmu_source import FMU_COPY, FmuSection
from twin_master.assets.parameter import (
    NO_CALIBRATED_DESIGN,
    WING_CALIBRATION,
    ParameterDraws,
    check_calibration,
)
from twin_master.assets.reduced_model import Advice, ReducedModelSource, StructureOfFile
from twin_master.assets.structure_source import StructureFmuSource
from twin_master.errors import MissionInputError
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.kinds import CALIBRATED_DESIGN_NAME, BeliefSection
from twin_master.scenario.mission import CALIBRATION_COPY
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    from calibration.result.file import Tailoring
    from calibration.result.record import Calibration
    from fe.runtime.patch import Primitive
    from fe.runtime.patch_arrays import PatchArrays
    from fe.runtime.reduced import ReducedModel
    from fmu_asset.packing.patch_file import PatchFile, PatchFileEffect

DESIGN_COPY = "asset/design.toml"
"""The design that the twin believes, inside a run folder."""
FLOWN_DESIGN_COPY = "asset/flown_design.toml"
"""The design that flies, inside a run folder."""
_ASK_ASSET = "set `belief.kind` to `asset` to ask what is flown itself"


class DesignSection(FmuSection):
    """The FMU that is packed from a wing design."""

    kind: Literal["design", "calibration"] = "design"
    design: str
    """A wing design, or the name of a shipped one."""
    patch: str | None = None
    """A patch file: missing effects that the FMU carries. They are switched on from the start
    unless `parameters` says otherwise. The twin does not know them."""
    packed: Literal["python", "compiled"] = "python"
    """What evaluates the FMU: Python, or C that is compiled on this machine and carries no
    patch."""

    copy_paths: ClassVar[Mapping[str, str]] = {
        "binding": BINDING_COPY,
        "design": FLOWN_DESIGN_COPY,
        "patch": PATCH_COPY,
    }

    def source(self, scenario: Scenario) -> "WingFmuSource":
        """Return the source of the FMU."""
        return WingFmuSource(scenario, self)


class CalibrationSection(DesignSection):
    """The FMU that is packed from the design and the figures of a calibration file."""

    kind: Literal["calibration"] = "calibration"
    design: Literal["calibration"] = "calibration"
    """The design that the calibration file holds."""


class DesignBelief(BeliefSection):
    """The reduced model of a wing design."""

    kind: Literal["design", "calibration"] = "design"
    design: str
    """A wing design, or the name of a shipped one."""
    patch: str | None = None
    """A patch file: effects that the model carries."""

    copy_paths: ClassVar[Mapping[str, str]] = {"design": DESIGN_COPY, "patch": MODEL_PATCH_COPY}

    def source(self, scenario: Scenario, flown_source: AssetSource) -> "DesignSource":
        """Return the source of the model."""
        return DesignSource(scenario, section=self)


class CalibrationBelief(DesignBelief):
    """The reduced model of the design inside a calibration file."""

    kind: Literal["calibration"] = "calibration"
    design: Literal["calibration"] = "calibration"
    """The design that the calibration file holds."""


class _WingSource(StructureOfFile):
    """The common part of a wing's FMU and of its reduced model: design, patch and their checks.

    The design comes from a design file or a calibration file.
    """

    section: DesignSection | DesignBelief
    effects_label: ClassVar = "effects"
    """The name of the patch's effects in the description."""
    advice: ClassVar = Advice(calibration=WING_CALIBRATION, parameter=_ASK_ASSET, state=_ASK_ASSET)

    @cached_property
    def calibration(self) -> "Calibration | None":
        """The calibration whose design the wing has; None if it has a design of its own.

        Raises
        ------
        MissionInputError, CalibrationRecordError
            If there is no calibration file, or it is damaged.
        """
        if self.section.design != CALIBRATED_DESIGN_NAME:
            return None
        from calibration.result.file import load_calibration

        if CALIBRATION_COPY not in self.file_paths:
            raise MissionInputError(NO_CALIBRATED_DESIGN)
        return load_calibration(self.path(CALIBRATION_COPY))

    @cached_property
    def wing_design(self) -> WingDesign:
        """The design of the wing."""
        if self.calibration is not None:
            return self.calibration.wing_design
        return load_design(self.path(self.section.copies()["design"]))

    @cached_property
    def design(self) -> StructureDesign:
        """The names of the wing's inputs and outputs."""
        gauge_count = len(self.wing_design.gauges.positions)
        return wing_structure(self.wing_design.regions, gauge_count)

    @property
    def full_name(self) -> str:
        """The design by its name, for messages."""
        return f"the design {self.wing_design.name}"

    @property
    def description(self) -> str:
        """The FMU or model with the name of the design, and whether it has effects."""
        effects = "" if self.patch_path is None else f", with {self.effects_label}"
        return super().description + effects

    @property
    def design_hash(self) -> str:
        """The SHA-256 of the design."""
        return self.wing_design.hash

    @property
    def parameter_names(self) -> list[str]:
        """The parameters that may be calibrated; masses are not, as strains do not show them."""
        return [parameter.name for parameter in self.design.parameter]

    def load_reduced_model(self, progress: Progress) -> "ReducedModel":
        """Return the reduced model of the wing, from the cache if the cache has it."""
        from fe.reduction.model_cache import reduced_model

        return reduced_model(self.wing_design, progress=progress)

    def check_model(self) -> None:
        """Check nothing: a wing design was checked when it was read."""

    @property
    def patch_path(self) -> Path | None:
        """The patch file; None if there is none."""
        copy = self.section.copies()["patch"]
        return self.path(copy) if copy in self.file_paths else None

    @cached_property
    def patch(self) -> "PatchFile | None":
        """The patch, with the names of outputs instead of channels; None if there is none.

        Raises
        ------
        PatchFileError, MissionInputError
            If the file is not a patch, the wing cannot carry it, or the twin is to believe an
            effect that depends on time or on the history of the load.
        """
        from fmu_asset.packing.patch_file import load_patch

        if self.patch_path is None:
            return None
        wing = self.wing_design
        patch = load_patch(self.patch_path)
        is_believed = isinstance(self.section, DesignBelief)
        for effect in patch.effects:
            for primitive in effect.patch:
                _check_location(effect, primitive, wing, self.patch_path)
                if is_believed:
                    _check_has_no_memory(effect, primitive)
        return patch.for_gauges(len(wing.gauges.positions), str(self.patch_path))

    def write_field(
        self, path: Path, state: Mapping[str, float], control: Mapping[str, float]
    ) -> bool:
        """Write the field of displacement and strain of the wing as a VTU file.

        Nothing is written if a state factor or a control input of the scenario is not an input of
        the wing. The factor on Young's modulus is that of the true wing if the scenario states it,
        and otherwise the mean of the distribution from which the twin drew it; 1 without a draw.

        Parameters
        ----------
        state : mapping of str to float
            The estimated value of each state factor, SI.
        control : mapping of str to float
            The value of each control input, SI.

        Returns
        -------
        bool
            Whether the file was written.

        Raises
        ------
        FileNotWrittenError
            If the disk is full or the folder cannot be written.
        """
        from fe.reduction.model_cache import wing_fields, write_wing_vtu

        # The estimated health and the controls must all be inputs of the wing.
        input_names = set(wing_input_names(self.wing_design.regions))
        if not {*state, *control} <= input_names:
            return False
        modulus_name = "young_modulus_factor"
        asset = self._scenario.asset
        mean_modulus_factor = self._drawn_means.get(modulus_name, 1.0)
        parameters_and_loads = {
            modulus_name: asset.true_parameters.get(modulus_name, mean_modulus_factor),
            "tip_force": asset.constant_load.get("tip_force", 0.0),
            **control,
        }
        wing = wing_fields(self.wing_design)
        write_wing_vtu(path, wing, wing.vector(parameters_and_loads, state))
        return True


class _SpanLocation(NamedTuple):
    """The location of a change of the model along the span of a wing.

    Attributes
    ----------
    start : float
        The distance of the change, or of its inner end, from the root [m].
    length : float
        The length of the change along the span [m]; 0 for a point.
    limit : float
        The largest distance from the root at which `start` may be [m].
    """

    start: float
    length: float
    limit: float


def _location_on_span(primitive: "Primitive", wing: WingDesign) -> _SpanLocation | None:
    """Return the location of a change of the model along the span; None if it has no single one."""
    span = wing.planform.semi_span
    # Masses and forces may lie beyond the tip, by the fraction OVERHANG of the span.
    farthest = (1.0 + OVERHANG) * span
    if isinstance(primitive, LocalStiffnessLoss):
        return _SpanLocation(primitive.start, primitive.length, span)
    if isinstance(primitive, PointMass):
        return _SpanLocation(primitive.station, 0.0, farthest)
    if isinstance(primitive, LoadPlace):
        load_point = span - wing.tip_load.distance_from_tip
        return _SpanLocation(load_point + primitive.along_span, 0.0, farthest)
    return None


def _check_location(
    effect: "PatchFileEffect", primitive: "Primitive", wing: WingDesign, patch_path: Path
) -> None:
    """Refuse a change of the model whose location is not on the wing."""
    location = _location_on_span(primitive, wing)
    if location is None:
        return
    ends_before_root = location.start + location.length < 0.0
    if location.start > location.limit or ends_before_root:
        raise MissionInputError(
            f"{patch_path}: the effect {effect.id!r} has a {primitive.kind} at "
            f"{location.start:g} m from the root, and the wing is "
            f"{wing.planform.semi_span:g} m long: give a place on the wing."
        )


def _check_has_no_memory(effect: "PatchFileEffect", primitive: "Primitive") -> None:
    """Refuse an effect that depends on time or on earlier loads.

    The twin predicts the readings of each state under each control once, for all times and any
    earlier loads.
    """
    dependence = ""
    if isinstance(primitive, SensorDrift) and primitive.exponent != 0.0:
        dependence = "time"
    elif isinstance(primitive, PortForce) and primitive.hysteretic:
        dependence = "the loads before"
    if dependence:
        raise MissionInputError(
            f"the effect {effect.id!r} depends on {dependence}, and the twin predicts the readings "
            "of each state and control once for the whole mission: leave it out of `belief.patch`."
        )


class WingFmuSource(_WingSource, StructureFmuSource):
    """The FMU that is packed from a wing design, with hidden effects if there is a patch.

    The first reduction of a design takes about twenty seconds; after that it comes from the cache.
    """

    label = "FMU of the reduced model"
    effects_label = "hidden effects"
    section: DesignSection

    def binding(self) -> Binding:
        """Return the binding with an input for each damage region of the design."""
        return super().binding().with_regions(self.wing_design.regions)

    def _effect_parameters(self) -> tuple[str, ...]:
        """Return the names of the parameters that switch the effects on and set their magnitude."""
        from fmu_asset.slaves.effects import effect_rows

        if self.patch is None:
            return ()
        return tuple(variable.name for variable in effect_rows(self.patch.plain, 0, {}))

    def _check_calibration(self, binding: Binding) -> None:
        """Refuse a kind of FMU that cannot be built, and a calibration with unknown parameters."""
        from fmu_asset.packing.structure_fmu import check_form

        check_form(self.section.packed, patched=self.patch_path is not None)
        check_calibration(
            self._scenario.calibration,
            (*binding.parameter, *self._effect_parameters()),
            f"the binding {binding.name}",
            advice=WING_CALIBRATION,
        )

    def _pack(self, progress: Progress) -> None:
        """Pack the wing as the FMU in the run folder, with calibrated values if there are any."""
        from fmu_asset.packing.structure_fmu import pack_wing

        options: Tailoring = {}
        if self.calibration is not None:
            from calibration.result.file import tailoring  # takes a second to load

            options = tailoring(self.calibration)
        pack_wing(
            self.wing_design,
            self.path(FMU_COPY),
            kind=self.section.packed,
            patch=self.patch,
            activate=True,
            replace=True,
            progress=progress,
            **options,
        )


class DesignSource(_WingSource, ReducedModelSource):
    """The reduced model of a wing design as the believed model, with the effects of a patch."""

    section: DesignBelief

    def check_model(self) -> None:
        """Refuse a patch unless strains are observed."""
        role = self._scenario.observation.role
        if self.patch is not None and role != "strain":
            raise MissionInputError(
                f"with `belief.patch` the twin predicts strains, but `{role}` is observed: leave "
                "out `belief.patch`."
            )

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the predicted strains (E, S, U, G) with all effects of the patch.

        The axes are the draw of the parameter, the state, the control and the gauge.
        """
        return self._strains_with_patch(draws, model, self.patch)

    def structural_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float | None:
        """Return the strains (E, S, U, G) of the structure, without the errors of its gauges.

        The axes are the draw, state, control and gauge. If the patch has no effects on gauges, the
        result is None: the predicted readings are then the strains of the structure.
        """
        if self.patch is None:
            return None
        structural_patch = self.patch.of_structure
        if structural_patch == self.patch:
            return None
        return self._strains_with_patch(draws, model, structural_patch)

    def _strains_with_patch(
        self, draws: ParameterDraws, model: GraphicalModel, patch: "PatchFile | None"
    ) -> Float:
        """Return the strains (E, S, U, G) of the reduced model with the effects of a patch added.

        They are predicted for E draws of the parameter, S states, U controls and G gauges.

        Raises
        ------
        PatchFileError, MissionInputError
            If the model cannot carry the patch.
        """
        if patch is None or not patch.effects:
            # the table of the parent class is that of the reduced model without effects
            return super().observation_table(draws, model)
        from fmu_asset.packing.structure_fmu import needed_patch_arrays
        from fmu_asset.slaves.contents import UnacceptableValuesError

        scenario = self._scenario
        patch_arrays = needed_patch_arrays(self.wing_design, patch)
        predictor = strain_predictor(self.prepared_model, patch, patch_arrays)
        tip_force = scenario.asset.constant_load.get("tip_force", 0.0)
        tables = []
        message_start = f"the twin's model cannot carry {self.patch_path}: "
        with MissionInputError.instead_of(UnacceptableValuesError, before=message_start):
            for young_modulus_factor in draws.values.tolist():
                strains_of_draw = partial(predictor, young_modulus_factor, tip_force)
                table = table_of_observations(scenario, model.states.coordinates, strains_of_draw)
                tables.append(table)
        return np.array(tables)


class StrainPredictor(Protocol):
    """A function that predicts the strains of a wing with effects."""

    def __call__(
        self,
        young_modulus_factor: float,
        tip_force: float,
        control: Mapping[str, float],
        health: Mapping[str, float],
        /,
    ) -> Float:
        """Return the strains (G,).

        Parameters
        ----------
        tip_force : float
            The force at the load point near the tip [N].
        control : mapping of str to float
            The value of each control input, SI.
        health : mapping of str to float
            The stiffness loss of each region, as a fraction.
        """


def strain_predictor(
    wing: "ReducedModel", patch: "PatchFile", patch_arrays: "PatchArrays | None"
) -> StrainPredictor:
    """Return a function that predicts the strains of a wing with all effects of a patch.

    Parameters
    ----------
    patch : PatchFile
        The primitive changes by which the effects act on the model.
    patch_arrays : PatchArrays, optional
        The wing in the basis for patches; None if the effects do not need it.
    """
    from fmu_asset.slaves.behaviour import StructureBehaviour
    from fmu_asset.slaves.effects import SwitchableEffects, effect_rows, switch_name
    from fmu_asset.slaves.table import structure_table

    # The prediction runs the behaviour that is packed into the FMU of a wing, so that model and
    # FMU agree.
    effects = patch.plain
    gauge_count = len(wing.gauges)
    variables, roles = structure_table(wing, {})
    switchable_effects = SwitchableEffects(effects, gauge_count, patch_arrays)
    behaviour = StructureBehaviour(wing, variables, roles, switchable_effects)
    # Switch all effects on, at the sizes that the patch states.
    switched_on = {switch_name(effect): 1.0 for effect in effects}
    effect_values = {}
    for variable in effect_rows(effects, 0, switched_on):
        effect_values[variable.name] = float(variable.start or 0.0)
    behaviour.tune(effect_values, 0.0)
    # A value that a prediction does not set stays at its start value.
    start_values = {variable.name: variable.start or 0.0 for variable in variables}
    input_names = [variable.name for variable in variables if variable.causality == "input"]

    def predict(
        young_modulus_factor: float,
        tip_force: float,
        control: Mapping[str, float],
        health: Mapping[str, float],
    ) -> Float:
        values = {**start_values, "tip_force": tip_force, **control}
        values |= {f"health.{region}": loss for region, loss in health.items()}
        inputs = [values[name] for name in input_names]
        parameters = {**start_values, "young_modulus_factor": young_modulus_factor}
        outputs = behaviour.start(parameters, 0.0, inputs)
        return np.array(outputs[:gauge_count])  # the strains are the first outputs

    return predict
