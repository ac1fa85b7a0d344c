"""A wing: its design, or the design inside a calibration file, packed as the asset or believed as a model."""

from collections.abc import Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from fe.wing.design import WingDesign, load_design, wing_structure
from fmu_asset.door.binding import Binding
from reporting.arrays import Float
from reporting.progress import Progress
from reporting.provenance import hash_file
from twin_master.assets.asset_source import (
    BINDING_COPY,
    FLOWN_DESIGN_HASH,
    MODEL_PATCH_COPY,
    PATCH_COPY,
    AssetSource,
    asked_table,
)
from twin_master.assets.fmu_source import FmuSection, FmuSource
from twin_master.assets.parameter import OWN_OF_WING, ParameterDraws, check_calibration, read_calibration
from twin_master.assets.reduced_model import ReducedModelSource
from twin_master.errors import MissingObservationModelError, MissionInputError
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.asset import CALIBRATED_DESIGN_NAME, BeliefSection
from twin_master.scenario.schema import CALIBRATION_COPY, Scenario

if TYPE_CHECKING:
    from calibration.result.record import Calibration
    from fmu_asset.packing.patch_file import PatchFile


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
        return DesignSource(scenario, section=self)


class CalibrationBelief(DesignBelief):
    """The reduced model of the design inside the calibration file."""

    kind: Literal["calibration"] = "calibration"
    design: Literal["calibration"] = "calibration"


class _Wing(AssetSource):
    """A wing that a scenario names: its files where they are given, or their copies once kept."""

    section: DesignSection | DesignBelief
    effects: ClassVar = "effects"
    """What a patch adds, in words."""

    @property
    def words(self) -> str:
        """The model of the design."""
        with_effects = "" if self.patch_path is None else f", with {self.effects}"
        return f"{self.label} of the design {self.design.name}{with_effects}"

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
    def design(self) -> WingDesign:
        """The design.

        Raises
        ------
        MissionInputError, InvalidDesignError, CalibrationRecordError
            There is none, or it is wrong.
        """
        if self.calibration is not None:
            return self.calibration.wing_design
        return load_design(self.path(self.section.copies()["design"]))

    @property
    def patch_path(self) -> Path | None:
        """The patch file, if there is one."""
        copy = self.section.copies()["patch"]
        return self.path(copy) if copy in self.places else None

    @property
    def patch(self) -> "PatchFile | None":
        """The patch, if there is one."""
        from fmu_asset.packing.patch_file import load_patch

        return None if self.patch_path is None else load_patch(self.patch_path)

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
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

        name, asset = "young_modulus_factor", self._scenario.asset
        if {*state} != {*self.design.regions} or {*control} != {"load_factor"}:
            return False
        wing = wing_fields(self.design)
        e = asset.true_parameters.get(name, self._means.get(name, 1.0))
        values = {**control, name: e, "tip_force": asset.constant_load.get("tip_force", 0.0)}
        write_wing_vtu(path, wing, wing.vector(values, state))
        return True


class WingFmuSource(_Wing, FmuSource):
    """The FMU that is packed of a wing design."""

    label = "FMU of the reduced model"
    effects = "hidden effects"
    section: DesignSection

    def binding(self) -> Binding:
        """Return the binding with the damage regions of the design."""
        return super().binding().with_regions(self.design.regions)

    def _check_calibration(self, binding: Binding) -> tuple[str, ...]:
        from fmu_asset.packing.structure_fmu import check_form
        from fmu_asset.slaves.effects import effect_rows

        patch, effects = self.patch, tuple[str, ...]()
        check_form(self.section.packed, patched=patch is not None)
        if patch is not None:
            known = patch.for_gauges(len(self.design.gauges.positions), str(self.patch_path))
            effects = tuple(row.name for row in effect_rows(known.plain, 0, {}))
        known_names, where = (*binding.parameter, *effects), f"the binding {binding.name}"
        check_calibration(self._scenario.calibration, known_names, where, advice=OWN_OF_WING)
        return effects

    def _fitted(self, binding: Binding, folder: Path) -> Binding:
        return binding

    def _make(self, progress: Progress) -> dict[str, str]:
        """Reduce the design and pack the FMU."""
        from fe.reduction.model_cache import reduced_model
        from fmu_asset.packing.wing_packing import pack_wing

        self.model, options = reduced_model(self.design, progress=progress), {}
        if self.calibration is not None:
            from calibration.result.plain import tailoring  # takes a second to load

            options = tailoring(self.calibration)
        with progress.stage("Packing the FMU"):
            pack_wing(
                self.design, self.fmu_path(), kind=self.section.packed, patch=self.patch, activate=True,
                replace=True, progress=progress, **options,
            )  # fmt: skip
        return {FLOWN_DESIGN_HASH: self.model.design_hash, "fmu": hash_file(self.fmu_path())}


class DesignSource(_Wing, ReducedModelSource):
    """The reduced model of a design file, or of the design inside a calibration file, as what is believed."""

    label = "reduced model"
    section: DesignBelief

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
        scenario = self._scenario
        calibration = scenario.calibration
        read_calibration(calibration)
        self.files()
        design, patch = self.design, self.patch
        gauges = len(design.gauges.positions)
        ranges = {part.name: part.range for part in wing_structure(design.regions, 0).parameter}
        check_calibration(
            calibration, ranges, f"the reduced model of the design {design.name}", ranges=ranges,
            design_hash=design.hash, advice=OWN_OF_WING,
        )  # fmt: skip
        for what, came, wanted in (
            ("states", scenario.state_names, design.regions),
            ("control inputs", scenario.control[0].values, ("load_factor",)),
            ("calibrated parameter", (calibration.parameter,), ("young_modulus_factor",)),
            ("sensor count", (str(scenario.observation.count),), (str(gauges),)),
        ):
            if {*came} != {*wanted}:
                raise MissingObservationModelError(
                    f"the design's model predicts observations for the {what} {', '.join(sorted(wanted))}, "
                    f"and the scenario has {', '.join(sorted(came))}: set `belief.kind` to `asset` to ask "
                    "what is flown itself."
                )
        if patch is not None:
            check_model_patch(patch, gauges, str(self.patch_path))

    def _make(self, progress: Progress) -> dict[str, str]:
        from fe.reduction.model_cache import reduced_model

        self.model = reduced_model(self.design, progress=progress)
        return super()._make(progress)

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
        from fmu_asset.packing.wing_packing import arrays_for
        from fmu_asset.slaves.base import UnacceptableValuesError
        from fmu_asset.slaves.behaviour import StructureBehaviour
        from fmu_asset.slaves.effects import Effects, effect_rows, switch_of
        from fmu_asset.slaves.table import structure_table

        wing, scenario, where = self.wing, self._scenario, str(self.patch_path)
        check_model_patch(patch, wing.gauge_count, where)
        effects = patch.for_gauges(wing.gauge_count).plain
        rows, roles = structure_table(wing, {})
        acting = Effects(effects, wing.gauge_count, arrays_for(self.design, patch))
        behaviour = StructureBehaviour(wing, rows, roles, acting)
        on = {switch_of(effect): 1.0 for effect in effects}
        behaviour.tune({row.name: float(row.start or 0.0) for row in effect_rows(effects, 0, on)}, 0.0)
        nominal = {row.name: row.start or 0.0 for row in rows}
        inputs = [row.name for row in rows if row.causality == "input"]
        force = scenario.asset.constant_load.get("tip_force", 0.0)

        def ask(e: float, control: Mapping[str, float], health: Mapping[str, float]) -> Float:
            losses = {f"health.{name}": loss for name, loss in health.items()}
            given = {**control, **losses, "tip_force": force}
            start = {**nominal, "young_modulus_factor": e}
            shown = behaviour.start(start, 0.0, [given[name] for name in inputs])
            return np.array(shown[: wing.gauge_count])

        states, controls = model.states.coordinates, [control.values for control in scenario.control]
        try:
            return np.array(
                [
                    asked_table(scenario.state_names, states, controls, partial(ask, e))
                    for e in draws.values.tolist()
                ]
            )
        except UnacceptableValuesError as error:
            raise MissionInputError(f"the twin's model cannot carry {where}: {error}") from error


def check_model_patch(patch: "PatchFile", gauge_count: int, where: str = "The patch") -> None:
    """Check that a model without time can carry the effects of a patch.

    Raises
    ------
    MissionInputError
        An effect depends on time or on what happened before.
    PatchFileError
        The wing cannot carry an effect.
    """
    from fe.runtime.patch import PortForce, SensorDrift

    for effect in patch.for_gauges(gauge_count, where).effects:
        for item in effect.patch:
            drifts = isinstance(item, SensorDrift) and item.exponent != 0.0
            if drifts or (isinstance(item, PortForce) and item.hysteretic):
                raise MissionInputError(
                    f"the effect {effect.id!r} depends on {'time' if drifts else 'the loads before'}, and "
                    "the twin predicts the readings of each state and control once for the whole mission: "
                    "leave it out of `belief.patch`."
                )
