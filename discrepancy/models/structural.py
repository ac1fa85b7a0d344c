"""A structure whose matrices are known as a model: under patches, at rest, in ring-downs and under forces."""

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.records import Campaign, Quantity, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.body import Body, Moving, Outputs, Solver
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
from fe.runtime.errors import FiniteElementError
from fe.runtime.motion import NO_LAWS, Laws, laws_of, static_solution
from fe.runtime.patch import (
    INTERNAL_FORCES,
    LOADS,
    SENSORS,
    STRUCTURE,
    LoadGain,
    LocalStiffnessLoss,
    ModelPatch,
    ModulusTemperature,
    PointMass,
    Primitive,
)

FloatArray = NDArray[np.float64]


class StructuralModel:
    """A structure by its matrices (`discrepancy.models.interface.Model`).

    Parameters
    ----------
    body : Body
        The structure.
    name : str
        For people.
    parameters : tuple of ModelParameter
        Calibrated parameters.
    """

    def __init__(self, body: Body, name: str, parameters: tuple[ModelParameter, ...]) -> None:
        self.body, self._name, self._parameters = body, name, parameters
        self._statics = Memory(2048)

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
        return self.body.output_quantity(output)

    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the model can carry a primitive."""
        return self.body.supports(primitive)

    def ports(self) -> tuple[str, ...]:
        """Names of the ports where internal forces can act on one motion."""
        return tuple(self.body.points)

    def stations(self) -> tuple[float, float] | None:
        """Return the least and largest station [m]; None where it has no length."""
        return None if self.body.length is None else (0.0, self.body.length)

    def scales(self, campaign: Campaign) -> Scales:
        """Return the natural scales under a campaign, by the structure without a patch."""
        values = np.array([campaign.parameters.get(p.name, (p.mean, 0.0))[0] for p in self._parameters])
        empty, healthy = ModelPatch(), (0.0,) * len(self.body.regions)
        static = self.body.stiffness(values, healthy, empty, 0.0)
        moved = self.body.moving(values, healthy, empty, 0.0, self.body.reference)
        tip = self.body.force_row(self.body.reference, values, empty)
        rows = self._point_rows(len(tip))
        first, shape = float(moved.system.angular_frequency[0]), moved.basis @ moved.system.shapes[:, 0]
        motions = {
            trial.name: np.abs(self._port_motion(trial, values, static, moved)).max(axis=0, initial=0.0)
            for trial in campaign.trials
        }
        fitted = [motions[trial.name] for trial in campaign.fitted if trial.is_dynamic]
        largest = np.max(list(motions.values()), axis=0, initial=0.0) * np.ones(len(rows))
        usual = np.max(fitted, axis=0) if fitted else largest
        at_rest = 1.0 / np.einsum("pn,np->p", rows, static.solve(rows.T))
        dynamic = [trial for trial in campaign.trials if trial.is_dynamic]
        spans = [
            trial.start + trial.time if trial.is_dynamic else trial.time
            for trial in campaign.trials
            if len(trial.time)
        ]
        duration = max(float(t.max()) for t in spans) - min(float(t.min()) for t in spans) if spans else 0.0
        ports = {
            port: PortScale(
                float(size) or float(most) or 1.0,
                first**2 / float(by) ** 2,
                first,
                float(still),
                float(most) or 1.0,
            )
            for port, size, by, still, most in zip(
                self.ports(), usual, rows @ shape, at_rest, largest, strict=True
            )
        }
        return Scales(
            length=self.body.length or 1.0,
            tip_stiffness=1.0 / float(tip @ static.solve(tip)),
            modal_mass=1.0 / float(tip @ shape) ** 2,
            angular_frequency=first,
            force=max((float(np.abs(t.force).max(initial=0.0)) for t in campaign.trials), default=0.0),
            load_factor=max(
                (float(np.abs(t.load_factor).max(initial=0.0)) for t in campaign.trials), default=0.0
            ),
            duration=max((float(t.time[-1] - t.time[0]) for t in dynamic), default=1.0),
            campaign_time=duration if duration > 0.0 else 1.0,
            ports=ports | self.body.spread(ports, shape),
        )

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
        for item in patch:
            if not (isinstance(item, SENSORS) or self.supports(type(item))):
                raise ModelError(f"{self.name} cannot carry the primitive {item.kind!r}.")
        if len(conditions.parameters) != len(self._parameters):
            raise ModelError(
                f"{self.name} has {len(self._parameters)} parameters, but {len(conditions.parameters)} came."
            )
        quantities = [quantity for _, quantity in outputs]
        try:
            losses = patch.of(LocalStiffnessLoss)
            blocks = [self.body.output_rows(outputs, n, losses) for n in range(3 if components else 1)]
            forces = patch.of(*INTERNAL_FORCES)
            laws = NO_LAWS
            if len(forces):
                laws = laws_of(self.body.internal_forces(forces), self.body.port_rows)
            if not trial.is_dynamic:
                return self._at_rest(trial, outputs, blocks, patch, conditions, laws)
            moved = self._moved(trial, conditions, patch, laws.ports)
            motion = self._motion(moved, trial, conditions, patch, laws, refinement)
            response = motion.response(blocks[0] @ moved.basis, quantities)
            if self.body.always(conditions.parameters) is not None:
                response.values[:] += self._always(trial, conditions, outputs, blocks[0])
            return Response(
                response.values, response.rates, *(motion.values(rows @ moved.basis) for rows in blocks[1:])
            )
        except FiniteElementError as cause:
            raise ModelError(str(cause)) from cause

    def _at_rest(
        self,
        trial: Trial,
        outputs: Outputs,
        blocks: list[FloatArray],
        patch: ModelPatch,
        conditions: Conditions,
        laws: Laws,
    ) -> Response:
        if any(quantity.is_rate for _, quantity in outputs):
            raise ModelError(
                f"The trial {trial.name!r} is at rest, but a channel measures velocity or acceleration."
            )
        structure = patch.of(*STRUCTURE)
        # where a mass has weight; other zeros are read with it in place
        flight = trial.kind is TrialKind.FLIGHT
        loads = patch.of(*LOADS, PointMass) if flight else patch.of(*LOADS)
        size, parameters = len(trial.time), conditions.parameters
        health = np.broadcast_to(self._losses(trial, conditions), (size, len(self.body.regions)))
        depends = any(isinstance(item, ModulusTemperature) for item in structure)
        temperature = trial.temperature if depends else np.zeros(size)
        acting = np.column_stack((health, temperature))
        amounts = _amounts(trial, loads)
        if self.body.always(parameters) is not None:
            amounts = np.column_stack((amounts, np.ones(size)))
        values = np.empty((size, len(blocks) * len(outputs)))
        place = None if flight else trial.load_place
        port_rows = laws.rows(self.body.port_rows, blocks[0].shape[1])
        memory: FloatArray | None = None
        before = np.zeros(len(laws))
        start = 0
        # rows of one structure that follow one another are solved together, in the order of the load path
        changes = np.flatnonzero(np.any(np.diff(acting, axis=0) != 0.0, axis=1)) + 1
        for end in (*changes.tolist(), size):
            *lost, warmer = acting[start]
            stiffness = self.body.stiffness(parameters, tuple(lost), structure, warmer)
            shown, at_ports, flexible, port_flexibility = self._statics.get(
                (stiffness, place, loads.primitives, outputs, len(blocks), laws.ports),
                lambda stiffness=stiffness: static_units(  # type: ignore[misc]
                    stiffness, self.body.units(trial, parameters, loads), blocks, port_rows
                ),
            )
            part = amounts[start:end] @ shown
            if len(laws):
                solution = static_solution(
                    laws,
                    amounts[start:end] @ at_ports,
                    port_flexibility,
                    memory=memory,
                    start=before @ at_ports if start else None,
                    kernel=compiled_kernel(),
                )
                memory = solution.memory
                part = part - solution.forces @ flexible
            values[start:end] = part
            before, start = amounts[end - 1], end
        seen, *components = np.split(values, len(blocks), axis=1)
        return Response(seen, None, *components)

    def _always(self, trial: Trial, conditions: Conditions, outputs: Outputs, rows: FloatArray) -> FloatArray:
        """Return what outputs (C,) show in a motion of the load that always acts."""
        losses, load = tuple(self._losses(trial, conditions)[0]), self.body.always(conditions.parameters)
        still = self.body.stiffness(conditions.parameters, losses, ModelPatch(), 0.0)
        shown = rows @ still.solve(np.zeros(rows.shape[1]) if load is None else load)
        return np.asarray(shown * np.array([not quantity.is_rate for _, quantity in outputs]))

    def _losses(self, trial: Trial, conditions: Conditions) -> FloatArray:
        """Return the losses (N, K) of the regions from those that the trial names."""
        regions, health = self.body.regions, conditions.health
        losses = np.zeros((len(health), len(regions)))
        for name, column in zip(trial.regions, health.T, strict=False):
            if name in regions:
                losses[:, regions.index(name)] = column
            elif np.any(column):
                raise ModelError(
                    f"The trial {trial.name!r} gives a loss of the damage region {name!r}, but "
                    f"{self.name} has {', '.join(regions)}."
                )
        return losses

    def _moved(
        self, trial: Trial, conditions: Conditions, patch: ModelPatch, ports: tuple[str, ...]
    ) -> Moving:
        losses, warm = tuple(self._losses(trial, conditions)[0]), float(trial.temperature[0])
        structure, place = patch.of(*STRUCTURE), trial.load_place
        return self.body.moving(conditions.parameters, losses, structure, warm, place, ports)

    def _motion(
        self,
        moved: Moving,
        trial: Trial,
        conditions: Conditions,
        patch: ModelPatch,
        laws: Laws = NO_LAWS,
        refinement: int = 1,
    ) -> Motion:
        """Return the motion in a dynamic trial."""
        basis, system = moved
        loads = patch.of(*LOADS) if trial.kind is TrialKind.FORCED else ModelPatch()
        row = self.body.force_row(trial.load_place, conditions.parameters, loads) @ basis
        if trial.kind is TrialKind.RINGDOWN:
            if trial.release is None:
                raise ModelError(f"The ring-down {trial.name!r} does not say how it was released.")
            return system.ringdown(
                row, trial.release, conditions.initial, trial.time, laws, clock=conditions.clock,
                refinement=refinement,
            )  # fmt: skip
        return system.forced(
            row, Course.of(trial.time, _amounts(trial, loads)[:, 0], trial.hold), trial.time, laws,
            clock=conditions.clock, refinement=refinement,
        )  # fmt: skip

    # ------------------------------------------------------------ ports

    def ported(
        self, trial: Trial, outputs: Outputs, parameters: FloatArray, patch: ModelPatch = NO_PATCH
    ) -> PortedSystem:
        """Return the system by which outputs see missing forces, in the modes of the prior means."""
        means = np.array([item.mean for item in self._parameters])
        of = (Conditions(values, health=trial.health[:1]) for values in (means, parameters))
        base, moved = (self._moved(trial, conditions, patch, self.body.missing) for conditions in of)
        rows = self.body.output_rows(outputs, 0, patch.of(LocalStiffnessLoss))
        # both bases hold nearly the same shapes of the whole structure
        shapes = np.linalg.lstsq(moved.basis, base.basis @ base.system.shapes, rcond=None)[0]
        return moved.system.ported(rows @ moved.basis, [item for _, item in outputs], np.asarray(shapes))

    def port_motion(
        self, trial: Trial, conditions: Conditions, patch: ModelPatch = NO_PATCH
    ) -> tuple[FloatArray, FloatArray]:
        """Return positions and speeds (N, P) of the ports in a dynamic trial, without laws."""
        moved = self._moved(trial, conditions, patch, self.body.missing)
        motion = self._motion(moved, trial, conditions, patch)
        rows = np.array(list(moved.system.ports.values()))
        return motion.values(rows), motion.velocity @ (rows @ moved.system.shapes).T

    def at_ports(self, forces: ModelPatch) -> ModelPatch:
        """Return forces as they act at the ports of `ported`."""
        return self.body.internal_forces(forces)

    def _point_rows(self, size: int) -> FloatArray:
        return np.array(list(self.body.points.values())).reshape(-1, size)

    def _port_motion(self, trial: Trial, values: FloatArray, static: Solver, moved: Moving) -> FloatArray:
        """Motion (N, P) of the ports in a trial by the structure without a patch."""
        empty = ModelPatch()
        row = self.body.force_row(trial.load_place, values, empty)
        rows = self._point_rows(len(row))
        if not trial.is_dynamic:
            amounts = _amounts(trial, empty)
            units = self.body.units(trial, values, empty)[: amounts.shape[1]]
            return np.asarray(amounts @ (rows @ static.solve(units.T)).T)
        if trial.kind is TrialKind.FORCED:
            motion = moved.system.forced(row @ moved.basis, Course.of_force(trial), trial.time, NO_LAWS)
            return motion.values(rows @ moved.basis)
        shape = static.solve(row)
        size = trial.release.displacement if trial.release is not None else 0.0
        return np.asarray(size / float(row @ shape) * (rows @ shape))[None]


def static_units(
    stiffness: Solver, units: FloatArray, blocks: list[FloatArray], port_rows: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return outputs (k, C) and motions (k, J) of ports of unit loads, and the same of unit port forces.

    Parameters
    ----------
    stiffness : Solver
        Of the structure.
    units : (k, n) ndarray
        Unit loads.
    blocks : list of (C, n) ndarray
        Rows of outputs.
    port_rows : (J, n) ndarray
        Rows of the ports.
    """
    answer = stiffness.solve(np.concatenate((units, port_rows)).T)
    shown = np.concatenate([rows @ answer for rows in blocks]).T
    moved = (port_rows @ answer).T
    count = len(units)
    return shown[:count], moved[:count], shown[count:], moved[count:]


def _amounts(trial: Trial, loads: ModelPatch) -> FloatArray:
    """Return the factors (N, k) of the unit loads of a trial: load factor and its square, or the force."""
    if trial.kind is TrialKind.FLIGHT:
        return np.column_stack((trial.load_factor, trial.load_factor**2))
    force = trial.force
    for item in loads:
        if isinstance(item, LoadGain):
            force = (1.0 + item.gain) * force + item.tare * (trial.force != 0.0)
    return np.asarray(force)[:, None]
