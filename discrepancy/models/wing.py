"""The wing as a model: its reduced structure under patches, in static tests, flights and ring-downs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.wing.result import STATE
from calibration.wing.result_file import load_calibration
from discrepancy.campaign.records import Campaign, Quantity, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.compiled_motion import compiled_kernel
from discrepancy.models.input_course import Course
from discrepancy.models.interface import (
    Conditions,
    ModelParameter,
    PortScale,
    Response,
    Scales,
    check_no_inputs,
    check_plain,
)
from discrepancy.models.memory import Memory
from discrepancy.models.ported import NO_PATCH, PortedSystem
from discrepancy.models.second_order_motion import Motion
from discrepancy.models.wing_structure import MovingWing, Outputs, Stiffness, WingStructure
from fe.reduction.model_cache import patch_arrays
from fe.runtime.errors import FiniteElementError, InvalidPatchError, SolutionError
from fe.runtime.motion import NO_LAWS, Laws, laws_of, static_solution
from fe.runtime.patch import (
    INTERNAL_FORCES,
    LOADS,
    PRIMITIVES,
    STRUCTURE,
    LoadGain,
    LocalStiffnessLoss,
    ModelPatch,
    ModulusTemperature,
    PointMass,
    PortLoad,
    Primitive,
)
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.patched_wing import LOAD_PLACE, PORTS, PatchedWing
from fe.runtime.planform_forces import PLANFORM, STATION_PORTS
from fe.runtime.state import wing_names
from fe.wing.design import load_design
from reporting.progress import Progress

FloatArray = NDArray[np.float64]

SHIPPED_PRIOR = {
    "young_modulus_factor": (1.0073, 0.0103),
    "servo_mass": (0.1685, 0.0041),
    "pitot_mass": (0.1350, 0.0083),
    "damping_alpha": (1.03, 0.37),
    "damping_beta": (7.56e-4, 1.84e-4),
}
"""Mean and standard deviation of the calibrated state of the shipped wing (docs/calibration.md): e of the
paper, its masses, and the damping of the joint posterior, whose spread holds the measurement too."""
DAMPING_LIMITS = {"damping_alpha": (0.0, 20.0), "damping_beta": (0.0, 1e-2)}


class WingModel:
    """The wing (`discrepancy.models.interface.Model`).

    Parameters
    ----------
    arrays : PatchArrays
        The wing for patches.
    name : str
        For people.
    prior : mapping of str to (float, float)
        Mean and standard deviation of the calibrated parameters, by the names of
        `calibration.wing.result.STATE`.

    Notes
    -----
    Load places are "tip_load" or (y [m], chord fraction). Outputs are strain[k], tip_displacement,
    load_point_displacement and displacement[y, x].
    """

    def __init__(
        self, arrays: PatchArrays, name: str = "wing", prior: dict[str, tuple[float, float]] | None = None
    ) -> None:
        self.wing = PatchedWing(arrays)
        self._name = name
        prior = prior or SHIPPED_PRIOR
        box = dict(zip(wing_names(arrays.regions), arrays.validity_box.tolist(), strict=True))
        limits = {key: (low, high) for key, (low, high) in box.items()} | DAMPING_LIMITS
        self._parameters = tuple(
            ModelParameter(item.name, *prior[item.name], item.unit, *limits[item.name]) for item in STATE
        )
        self._structure = WingStructure(self.wing)
        self._statics = Memory(2048)

    @classmethod
    def shipped(cls, progress: Progress | None = None) -> "WingModel":
        """Return the shipped wing with the calibration that the documentation states."""
        return cls.of_design(None, progress)

    @classmethod
    def of_design(cls, path: Path | str | None, progress: Progress | None = None) -> "WingModel":
        """Return the wing of a design file, calibrated as the shipped wing is.

        Raises
        ------
        ModelError
            If it cannot be read, modelled or reduced.
        """
        try:
            design = load_design(path)
            return cls(patch_arrays(design, progress), design.name)
        except FiniteElementError as cause:
            raise ModelError(str(cause)) from cause

    @classmethod
    def of_calibration(cls, path: Path | str, progress: Progress | None = None) -> "WingModel":
        """Return the wing of a calibration, its posterior as prior.

        Raises
        ------
        ModelError
            If the calibration cannot be read, or its wing not be modelled.
        """
        try:
            result = load_calibration(Path(path))
            prior = {
                item.name: (float(np.mean(column)), float(np.std(column)))
                for item, column in zip(STATE, result.samples.T, strict=True)
            }
            return cls(patch_arrays(result.design, progress), result.asset, prior)
        except (FiniteElementError, CalibrationError, OSError) as cause:
            raise ModelError(f"The calibration {path} cannot be used: {cause}") from cause

    # ------------------------------------------------------------ what it is

    @property
    def name(self) -> str:
        """Name for people."""
        return self._name

    @property
    def parameters(self) -> tuple[ModelParameter, ...]:
        """Calibrated parameters."""
        return self._parameters

    def output_quantity(self, output: str) -> Quantity | None:
        """Return what an output is, or None if the model has no such output."""
        return self._structure.output_quantity(output)

    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the model can carry a primitive; it can carry all but forces by a formula in time."""
        return primitive in PRIMITIVES.values() and primitive is not PortLoad

    def ports(self) -> tuple[str, ...]:
        """Names of the ports where internal forces can act."""
        return PORTS

    def stations(self) -> tuple[float, float] | None:
        """Return the least and largest station [m]."""
        return 0.0, self.wing.span

    def scales(self, campaign: Campaign) -> Scales:
        """Return the natural scales under a campaign, by the unpatched wing."""
        values = np.array([campaign.parameters.get(p.name, (p.mean, 0.0))[0] for p in self._parameters])
        empty = ModelPatch()
        static = self._structure.stiffness(values, (), empty, 0.0)
        moved = self._structure.moving(values, (), empty, 0.0, LOAD_PLACE)
        tip = self.wing.arrays.load_tip
        first, shape = float(moved.system.angular_frequency[0]), moved.basis @ moved.system.shapes[:, 0]
        motions = {
            trial.name: np.abs(self._port_motion(trial, static, moved)).max(axis=0, initial=0.0)
            for trial in campaign.trials
        }
        fitted = [motions[trial.name] for trial in campaign.fitted if trial.is_dynamic]
        largest = np.max(list(motions.values()), axis=0, initial=0.0) * np.ones(len(PORTS))
        usual = np.max(fitted, axis=0) if fitted else largest
        port_rows = self._structure.point_rows
        at_rest = 1.0 / np.einsum("pn,np->p", port_rows, static.solve(port_rows.T))
        dynamic = [trial for trial in campaign.trials if trial.is_dynamic]
        begins = [
            trial.start if trial.is_dynamic else float(trial.time.min())
            for trial in campaign.trials
            if len(trial.time)
        ]
        ends = [
            trial.start + float(trial.time[-1]) if trial.is_dynamic else float(trial.time.max())
            for trial in campaign.trials
            if len(trial.time)
        ]
        duration = max(ends) - min(begins) if ends else 0.0
        by_first = port_rows @ shape
        ports = {
            port: PortScale(
                float(size) or float(most) or 1.0,
                first**2 / float(by) ** 2,
                first,
                float(still),
                float(most) or 1.0,
            )
            for port, size, by, still, most in zip(PORTS, usual, by_first, at_rest, largest, strict=True)
        }
        return Scales(
            length=self.wing.span,
            tip_stiffness=1.0 / float(tip @ static.solve(tip)),
            modal_mass=1.0 / float(tip @ shape) ** 2,
            angular_frequency=first,
            force=max((float(np.abs(t.force).max(initial=0.0)) for t in campaign.trials), default=0.0),
            load_factor=max(
                (float(np.abs(t.load_factor).max(initial=0.0)) for t in campaign.trials), default=0.0
            ),
            duration=max((float(t.time[-1] - t.time[0]) for t in dynamic), default=1.0),
            campaign_time=duration if duration > 0.0 else 1.0,
            ports=ports | {PLANFORM: self._planform_scale(ports["span"], shape)},
        )

    def _planform_scale(self, mean: PortScale, shape: FloatArray) -> PortScale:
        """Return the scales of a force over the planform, from those of its mean and the first mode."""
        share = self.wing.planform.share
        motion = np.array([self.wing.port_rows[port] @ shape for port in STATION_PORTS])
        ratio = motion / float(share @ motion)
        return replace(mean, spread=tuple(zip(share.tolist(), ratio.tolist(), strict=True)))

    # ------------------------------------------------------------ response

    def respond(
        self,
        trial: Trial,
        outputs: Outputs,
        patch: ModelPatch,
        conditions: Conditions,
        *,
        components: bool = False,
        refinement: int = 1,
    ) -> Response:
        """Return the response of a trial, see `Model.respond`.

        The force of a trial is (1 + gain) times the recorded one, plus the tare where it is not zero. In a
        dynamic trial the structure is that at its first temperature.
        """
        check_plain(trial, self.name)
        check_no_inputs(trial, self.name)
        if len(patch.of(PortLoad)):
            raise ModelError(f"{self.name} cannot carry the primitive {PortLoad.kind!r}.")
        if len(conditions.parameters) != len(self._parameters):
            raise ModelError(
                f"The wing has {len(self._parameters)} parameters, but {len(conditions.parameters)} came."
            )
        quantities = [quantity for _, quantity in outputs]
        try:
            rows = self._structure.output_rows(outputs, 0, patch.of(LocalStiffnessLoss))
            forces = patch.of(*INTERNAL_FORCES)
            laws = laws_of(self.wing.internal_forces(forces), self.wing.port_rows) if len(forces) else NO_LAWS
            if not trial.is_dynamic:
                return self._at_rest(trial, outputs, rows, patch, conditions, laws, components)
            moved = self._moved(trial, conditions, patch, laws.ports)
            motion = self._motion(moved, trial, conditions, patch, laws, refinement)
            response = motion.response(rows @ moved.basis, quantities)
            if not components:
                return response
            losses = patch.of(LocalStiffnessLoss)
            across, shear = (
                motion.values(self._structure.output_rows(outputs, number, losses) @ moved.basis)
                for number in (1, 2)
            )
            return Response(response.values, response.rates, across, shear)
        except (InvalidPatchError, SolutionError) as cause:
            raise ModelError(str(cause)) from cause

    def _at_rest(
        self,
        trial: Trial,
        outputs: Outputs,
        rows: FloatArray,
        patch: ModelPatch,
        conditions: Conditions,
        laws: Laws,
        components: bool,
    ) -> Response:
        if any(quantity.is_rate for _, quantity in outputs):
            raise ModelError(
                f"The trial {trial.name!r} is at rest, but a channel measures velocity or acceleration."
            )
        structure = patch.of(*STRUCTURE)
        flight = (
            trial.kind is TrialKind.FLIGHT
        )  # where a mass has weight; other zeros are read with it in place
        loads = patch.of(*LOADS, PointMass) if flight else patch.of(*LOADS)
        size = len(trial.time)
        health = np.broadcast_to(self._losses(conditions.health), (size, len(self.wing.arrays.regions)))
        depends = any(isinstance(item, ModulusTemperature) for item in structure)
        temperature = trial.temperature if depends else np.zeros(size)
        acting = np.column_stack((health, temperature))
        amounts = _amounts(trial, loads)
        blocks = [rows]
        if components:
            losses = patch.of(LocalStiffnessLoss)
            blocks += [self._structure.output_rows(outputs, number, losses) for number in (1, 2)]
        values = np.empty((size, len(blocks) * len(outputs)))
        place = None if flight else trial.load_place
        port_rows = laws.rows(self.wing.port_rows, self.wing.size)
        memory: FloatArray | None = None
        before = np.zeros(len(laws))
        start = 0
        # rows of one structure that follow one another are solved together, in the order of the load path
        changes = np.flatnonzero(np.any(np.diff(acting, axis=0) != 0.0, axis=1)) + 1
        for end in (*changes.tolist(), size):
            *lost, warmer = acting[start]
            key = self._structure.stiffness_key(conditions.parameters, tuple(lost), structure, warmer)
            stiffness = self._structure.stiffness(conditions.parameters, tuple(lost), structure, warmer)
            shown, at_ports, flexible, port_flexibility = self._statics.get(
                (key, place, loads.primitives, outputs, components, laws.ports),
                lambda stiffness=stiffness: self._structure.static_units(  # type: ignore[misc]
                    stiffness, place, loads, blocks, port_rows
                ),
            )
            part = amounts[start:end] @ shown
            if len(laws):
                linear = amounts[start:end] @ at_ports
                solution = static_solution(
                    laws,
                    linear,
                    port_flexibility,
                    memory=memory,
                    start=before @ at_ports if start else None,
                    kernel=compiled_kernel(),
                )
                memory = solution.memory
                part = part - solution.forces @ flexible
            values[start:end] = part
            before, start = amounts[end - 1], end
        count = len(outputs)
        if not components:
            return Response(values)
        return Response(values[:, :count], None, values[:, count : 2 * count], values[:, 2 * count :])

    def _losses(self, health: FloatArray) -> FloatArray:
        """Return the losses (N, K) of the wing's regions from those of a campaign, which may name fewer."""
        regions = self.wing.arrays.regions
        if np.any(health[:, len(regions) :]):
            raise ModelError(
                f"The campaign gives losses of {health.shape[1]} damage regions, but the wing has "
                f"{len(regions)}: {', '.join(regions)}."
            )
        losses = np.zeros((len(health), len(regions)))
        known = min(health.shape[1], len(regions))
        losses[:, :known] = health[:, :known]
        return losses

    def _moved(
        self, trial: Trial, conditions: Conditions, patch: ModelPatch, ports: tuple[str, ...]
    ) -> MovingWing:
        losses, warm = tuple(self._losses(conditions.health)[0]), float(trial.temperature[0])
        structure, place = patch.of(*STRUCTURE), trial.load_place
        return self._structure.moving(conditions.parameters, losses, structure, warm, place, ports)

    def _motion(
        self,
        moved: MovingWing,
        trial: Trial,
        conditions: Conditions,
        patch: ModelPatch,
        laws: Laws = NO_LAWS,
        refinement: int = 1,
    ) -> Motion:
        """Return the motion in a dynamic trial."""
        basis, system = moved
        if trial.kind is TrialKind.RINGDOWN:
            if trial.release is None:
                raise ModelError(f"The ring-down {trial.name!r} does not say how it was released.")
            return system.ringdown(
                self.wing.force_row(trial.load_place) @ basis, trial.release, conditions.initial, trial.time,
                laws, clock=conditions.clock, refinement=refinement,
            )  # fmt: skip
        loads = patch.of(*LOADS)
        return system.forced(
            self.wing.force_row(trial.load_place, loads) @ basis,
            Course.of(trial.time, _amounts(trial, loads)[:, 0], trial.hold), trial.time, laws,
            clock=conditions.clock, refinement=refinement,
        )  # fmt: skip

    # ------------------------------------------------------------ ports

    def ported(
        self, trial: Trial, outputs: Outputs, parameters: FloatArray, patch: ModelPatch = NO_PATCH
    ) -> PortedSystem:
        """Return the system by which outputs see missing forces, in the modes of the prior means."""
        means = np.array([item.mean for item in self._parameters])
        of = (Conditions(values, health=trial.health[:1]) for values in (means, parameters))
        base, moved = (self._moved(trial, conditions, patch, STATION_PORTS) for conditions in of)
        rows = self._structure.output_rows(outputs, 0, patch.of(LocalStiffnessLoss))
        # both bases hold nearly the same shapes of the whole wing
        shapes = np.linalg.lstsq(moved.basis, base.basis @ base.system.shapes, rcond=None)[0]
        return moved.system.ported(rows @ moved.basis, [item for _, item in outputs], np.asarray(shapes))

    def port_motion(
        self, trial: Trial, conditions: Conditions, patch: ModelPatch = NO_PATCH
    ) -> tuple[FloatArray, FloatArray]:
        """Return positions and speeds (N, P) of the ports in a dynamic trial, without laws."""
        moved = self._moved(trial, conditions, patch, STATION_PORTS)
        motion = self._motion(moved, trial, conditions, patch)
        rows = np.array(list(moved.system.ports.values()))
        return motion.values(rows), motion.velocity @ (rows @ moved.system.shapes).T

    def at_ports(self, forces: ModelPatch) -> ModelPatch:
        """Return forces as they act at the ports of `ported`."""
        return self.wing.internal_forces(forces)

    # ------------------------------------------------------------ parts

    def _port_motion(self, trial: Trial, static: Stiffness, moved: MovingWing) -> FloatArray:
        """Motion (N, 3) of the ports in a trial by the unpatched wing."""
        empty = ModelPatch()
        if not trial.is_dynamic:
            place = None if trial.kind is TrialKind.FLIGHT else trial.load_place
            port_rows = self._structure.point_rows
            units = self._structure.static_units(static, place, empty, [port_rows], port_rows)[1]
            return np.asarray(_amounts(trial, empty) @ units)
        row = self.wing.force_row(trial.load_place)
        if trial.kind is TrialKind.FORCED:
            motion = moved.system.forced(row @ moved.basis, Course.of_force(trial), trial.time, NO_LAWS)
            return motion.values(self._structure.point_rows @ moved.basis)
        shape = static.solve(row)
        size = trial.release.displacement if trial.release is not None else 0.0
        return np.asarray(size / float(row @ shape) * (self._structure.point_rows @ shape))[None]


def _amounts(trial: Trial, loads: ModelPatch) -> FloatArray:
    """Return the factors (N, k) of the unit loads of a trial."""
    if trial.kind is TrialKind.FLIGHT:
        return np.column_stack((trial.load_factor, trial.load_factor**2))
    force = trial.force
    for item in loads:
        if isinstance(item, LoadGain):
            force = (1.0 + item.gain) * force + item.tare * (trial.force != 0.0)
    return np.asarray(force)[:, None]
