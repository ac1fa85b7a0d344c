"""A wing: its design, or that inside a calibration file, packed as the asset or believed as a model.

It is a structure whose mesh follows from its design, and can carry effects.
"""

from collections.abc import Callable, Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from fe.runtime.state import wing_input_names
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
    asked_table,
)
from twin_master.assets.fmu_source import FMU_COPY, FmuSection
from twin_master.assets.parameter import (
    OWN_OF_WING,
    ParameterDraws,
    check_calibration,
)
from twin_master.assets.reduced_model import NamedStructure, ReducedModelSource
from twin_master.assets.structure_source import StructureFmuSource
from twin_master.errors import MissionInputError, said
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.kinds import CALIBRATED_DESIGN_NAME, BeliefSection
from twin_master.scenario.mission import CALIBRATION_COPY
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    from calibration.result.record import Calibration
    from fe.runtime.patch_arrays import PatchArrays
    from fe.runtime.reduced import ReducedModel
    from fmu_asset.packing.patch_file import PatchFile

DESIGN_COPY, FLOWN_DESIGN_COPY = "asset/design.toml", "asset/flown_design.toml"


class DesignSection(FmuSection):
    """The FMU that is packed of a wing design."""

    kind: Literal["design", "calibration"] = "design"
    design: str
    patch: str | None = None
    """A patch file: missing effects that the FMU carries, switched on from the start unless `parameters` says
    otherwise. The twin does not know of them."""
    packed: Literal["python", "compiled"] = "python"
    """What evaluates the FMU: Python, or C compiled here, which carries no patch."""

    copy_paths: ClassVar[Mapping[str, str]] = {
        "binding": BINDING_COPY,
        "design": FLOWN_DESIGN_COPY,
        "patch": PATCH_COPY,
    }

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

    copy_paths: ClassVar[Mapping[str, str]] = {"design": DESIGN_COPY, "patch": MODEL_PATCH_COPY}

    def source(self, scenario: Scenario, flown: AssetSource) -> "DesignSource":
        """Return the model of the wing."""
        return DesignSource(scenario, section=self)


class CalibrationBelief(DesignBelief):
    """The reduced model of the design inside the calibration file."""

    kind: Literal["calibration"] = "calibration"
    design: Literal["calibration"] = "calibration"


class _Wing(NamedStructure):
    """A wing by its design, or by the design of a calibration."""

    section: DesignSection | DesignBelief
    effects: ClassVar = "effects"
    advice: ClassVar = {
        "calibration": OWN_OF_WING,
        **dict.fromkeys(("parameter", "state"), "set `belief.kind` to `asset` to ask what is flown itself"),
    }

    @cached_property
    def calibration(self) -> "Calibration | None":
        """The calibration that the wing is tailored to; None for a design of its own.

        Raises
        ------
        MissionInputError, CalibrationRecordError
            There is no calibration file, or it is damaged.
        """
        if self.section.design != CALIBRATED_DESIGN_NAME:
            return None
        from calibration.result.file import load_calibration

        if CALIBRATION_COPY not in self.places:
            raise MissionInputError("the design of a calibration is asked for, and there is no such file.")
        return load_calibration(self.path(CALIBRATION_COPY))

    @cached_property
    def wing_design(self) -> WingDesign:
        """The design that is given, or that of the calibration file."""
        if self.calibration is not None:
            return self.calibration.wing_design
        return load_design(self.path(self.section.copies()["design"]))

    @cached_property
    def design(self) -> StructureDesign:
        """By name what can be chosen of it, commanded and read."""
        return wing_structure(self.wing_design.regions, len(self.wing_design.gauges.positions))

    @property
    def where(self) -> str:
        """What has these names, in words."""
        return f"the design {self.wing_design.name}"

    @property
    def words(self) -> str:
        """The FMU or model of the design with its name."""
        return super().words + ("" if self.patch_path is None else f", with {self.effects}")

    @property
    def hash(self) -> str:
        """SHA-256 of its design."""
        return self.wing_design.hash

    @property
    def parameter_names(self) -> list[str]:
        """What may be calibrated: strains tell nothing of the masses."""
        return [part.name for part in self.design.parameter]

    def reduced(self, progress: Progress) -> "ReducedModel":
        """Return the reduced model, from the cache if it is there."""
        from fe.reduction.model_cache import reduced_model

        return reduced_model(self.wing_design, progress=progress)

    def check_model(self) -> None:
        """Look at what the reduced model is made of: a design that can be read is right."""

    @property
    def patch_path(self) -> Path | None:
        """The patch file, if there is one."""
        copy = self.section.copies()["patch"]
        return self.path(copy) if copy in self.places else None

    @cached_property
    def patch(self) -> "PatchFile | None":
        """The patch, if there is one, with outputs in the place of channels.

        Raises
        ------
        PatchFileError, MissionInputError
            It is none, the wing cannot carry it, or an effect depends on time or on what happened before and
            is believed, for which a model has no time.
        """
        from fe.runtime.patch import (
            LoadPlace,
            LocalStiffnessLoss,
            PointMass,
            PortForce,
            SensorDrift,
        )
        from fe.runtime.wing_rows import OVERHANG
        from fmu_asset.packing.patch_file import load_patch

        if self.patch_path is None:
            return None
        wing, believed = self.wing_design, isinstance(self.section, DesignBelief)
        span, patch = wing.planform.semi_span, load_patch(self.patch_path)
        for effect in patch.effects:
            for item in effect.patch:
                first, length, beyond = 0.0, 0.0, (1.0 + OVERHANG) * span
                if isinstance(item, LocalStiffnessLoss):
                    first, length, beyond = item.start, item.length, span
                elif isinstance(item, PointMass):
                    first = item.station
                elif isinstance(item, LoadPlace):
                    first = span - wing.tip_load.distance_from_tip + item.along_span
                if first > beyond or first + length < 0.0:
                    of = {"effect": effect, "kind": item.kind, "place": first, "span": span}
                    raise MissionInputError(said("assets.place", where=self.patch_path, **of))
                drifts = isinstance(item, SensorDrift) and item.exponent != 0.0
                if believed and (drifts or (isinstance(item, PortForce) and item.hysteretic)):
                    what = "time" if drifts else "the loads before"
                    raise MissionInputError(said("assets.remembers", effect=effect, what=what))
        return patch.for_gauges(len(wing.gauges.positions), str(self.patch_path))

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write displacement and strain under a state and a control as VTU; return whether there is a field.

        Young's modulus is that of the true wing where the scenario tells it, else the mean of the
        calibration.

        Raises
        ------
        FileNotWrittenError
            The disk is full or the folder cannot be written.
        """
        from fe.reduction.model_cache import wing_fields, write_wing_vtu

        name, asset = "young_modulus_factor", self._scenario.asset
        if not {*state, *control} <= {*wing_input_names(self.wing_design.regions)}:
            return False
        wing = wing_fields(self.wing_design)
        e = asset.true_parameters.get(name, self._means.get(name, 1.0))
        values = {name: e, "tip_force": asset.constant_load.get("tip_force", 0.0), **control}
        write_wing_vtu(path, wing, wing.vector(values, state))
        return True


class WingFmuSource(_Wing, StructureFmuSource):
    """The FMU that is packed of a wing design, with hidden effects where a patch gives some.

    The first reduction of a design takes about twenty seconds; after that it comes from the cache.
    """

    label = "FMU of the reduced model"
    effects = "hidden effects"
    section: DesignSection

    def binding(self) -> Binding:
        """Return the binding with an input for each damage region of the design."""
        return super().binding().with_regions(self.wing_design.regions)

    def _check_calibration(self, binding: Binding) -> tuple[str, ...]:
        from fmu_asset.packing.structure_fmu import check_form
        from fmu_asset.slaves.effects import effect_rows

        check_form(self.section.packed, patched=self.patch_path is not None)
        given = [] if self.patch is None else self.patch.plain
        effects = tuple(row.name for row in effect_rows(given, 0, {}))
        known_names, where = (*binding.parameter, *effects), f"the binding {binding.name}"
        check_calibration(self._scenario.calibration, known_names, where, advice=OWN_OF_WING)
        return effects

    def _pack(self, progress: Progress) -> None:
        from fmu_asset.packing.structure_fmu import pack_wing

        options = {}
        if self.calibration is not None:
            from calibration.result.file import tailoring  # takes a second to load

            options = tailoring(self.calibration)
        pack_wing(
            self.wing_design, self.path(FMU_COPY), kind=self.section.packed, patch=self.patch, activate=True,
            replace=True, progress=progress, **options,
        )  # fmt: skip


class DesignSource(_Wing, ReducedModelSource):
    """The reduced model of a wing design as what is believed, with effects where a patch gives some."""

    section: DesignBelief

    def check_model(self) -> None:
        """Refuse effects that the twin cannot believe."""
        role = self._scenario.observation.role
        if self.patch is not None and role != "strain":
            raise MissionInputError(said("assets.patched_role", role=role))

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the strains (E, S, U, G)."""
        return self._strains(draws, model, self.patch)

    def structural_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float | None:
        """Return the strains of the structure itself (E, S, U, G); None where no effect is of its gauges."""
        patch = self.patch
        kept = None if patch is None else patch.of_structure
        return None if kept == patch else self._strains(draws, model, kept)

    def _strains(self, draws: ParameterDraws, model: GraphicalModel, patch: "PatchFile | None") -> Float:
        """Return the strains (E, S, U, G) that the twin predicts with the effects of a patch.

        Raises
        ------
        PatchFileError, MissionInputError
            The model cannot carry the patch.
        """
        if patch is None or not patch.effects:
            return super().observation_table(draws, model)
        from fmu_asset.packing.structure_fmu import needed_patch_arrays
        from fmu_asset.slaves.contents import UnacceptableValuesError

        scenario, where = self._scenario, str(self.patch_path)
        ask = strains_with_effects(self.wing, patch, needed_patch_arrays(self.wing_design, patch))
        force = scenario.asset.constant_load.get("tip_force", 0.0)
        before, states = f"the twin's model cannot carry {where}: ", model.states.coordinates
        with MissionInputError.instead_of(UnacceptableValuesError, before=before):
            draw = (partial(ask, e, force) for e in draws.values.tolist())
            return np.array([asked_table(scenario, states, asked) for asked in draw])


def strains_with_effects(
    wing: "ReducedModel", patch: "PatchFile", arrays: "PatchArrays | None"
) -> Callable[[float, float, Mapping[str, float], Mapping[str, float]], Float]:
    """Return what gives the strains (G,) of a wing with the effects of a patch, all of them switched on.

    It is asked with the factor of Young's modulus, the tip force [N], the control, and the losses by region.
    """
    from fmu_asset.slaves.behaviour import StructureBehaviour
    from fmu_asset.slaves.effects import SwitchableEffects, effect_rows, switch_name
    from fmu_asset.slaves.table import structure_table

    effects = patch.plain
    rows, roles = structure_table(wing, {})
    behaviour = StructureBehaviour(wing, rows, roles, SwitchableEffects(effects, len(wing.gauges), arrays))
    on = {switch_name(effect): 1.0 for effect in effects}
    behaviour.tune({row.name: float(row.start or 0.0) for row in effect_rows(effects, 0, on)}, 0.0)
    nominal = {row.name: row.start or 0.0 for row in rows}
    inputs = [row.name for row in rows if row.causality == "input"]

    def ask(e: float, force: float, control: Mapping[str, float], health: Mapping[str, float]) -> Float:
        losses = {f"health.{name}": loss for name, loss in health.items()}
        given = {**nominal, "tip_force": force, **control, **losses}
        start = {**nominal, "young_modulus_factor": e}
        return np.array(behaviour.start(start, 0.0, [given[name] for name in inputs])[: len(wing.gauges)])

    return ask
