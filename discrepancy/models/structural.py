"""A structure whose matrices are known as a model: under patches, at rest, in ring-downs and under forces."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar, NamedTuple, Protocol

import numpy as np

from discrepancy.campaign.records import Campaign, FloatArray, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.acting import Acting, Course
from discrepancy.models.interface import (
    NO_PATCH,
    Conditions,
    Model,
    ModelParameter,
    Outputs,
    Place,
    PortedSystem,
    PortScale,
    Response,
    Scales,
    campaign_sizes,
)
from discrepancy.models.linear_system import solved
from discrepancy.models.memory import Memory
from discrepancy.models.questions import (
    LoadChange,
    check_no_inputs,
    check_parameters,
    check_plain,
    prior_mean,
    release_of,
)
from discrepancy.models.second_order import Motion, SecondOrderSystem
from fe.runtime.errors import FiniteElementError
from fe.runtime.motion import NO_LAWS, Laws, laws_of
from fe.runtime.patch import (
    INTERNAL_FORCES,
    LOADS,
    SENSORS,
    STRUCTURE,
    LocalStiffnessLoss,
    ModelPatch,
    ModulusTemperature,
    PointMass,
)
from fe.runtime.state import Losses


class State(NamedTuple):
    """What a structure's matrices depend on: parameters, losses of regions, a patch, a temperature [K]."""

    parameters: FloatArray
    losses: Losses
    structure: ModelPatch = NO_PATCH
    warmer: float = 0.0


class Moving(NamedTuple):
    """A structure in a basis (n, k) of its first modes and some static shapes, in which it moves."""

    basis: FloatArray
    system: SecondOrderSystem


class Solver(Protocol):
    """The stiffness (n, n) of a structure in one state."""

    def solve(self, loads: FloatArray) -> FloatArray:
        """Return K^-1 loads, (n,) or (n, k)."""


class StructuralModel(Model):
    """A structure by its matrices (`discrepancy.models.interface.Model`), in n coordinates of its own.

    Parameters
    ----------
    name : str
        For people.
    parameters : tuple of ModelParameter
        Calibrated parameters.

    Attributes
    ----------
    regions : tuple of str
        Damage regions.
    points : mapping of str to (n,) ndarray
        Rows of the ports whose laws act on one motion.
    port_rows : mapping of str to (n,) ndarray
        Rows of all ports where laws act.
    missing : tuple of str
        Further ports of `port_rows` where missing forces are looked for.
    length : float or None
        Largest station [m], if it has any.
    reference : str
        Place whose stiffness and modal mass are the natural ones.
    """

    regions: tuple[str, ...]
    points: Mapping[str, FloatArray]
    port_rows: Mapping[str, FloatArray]
    missing: tuple[str, ...] = ()
    length: float | None = None
    reference: str
    shows_ports: ClassVar[bool] = True

    def __init__(self, name: str, parameters: tuple[ModelParameter, ...]) -> None:
        self.name, self.parameters = name, parameters
        self._statics = Memory(2048)

    # ------------------------------------------------------------ what each structure says

    @abstractmethod
    def output_rows(self, outputs: Outputs, component: int, losses: ModelPatch) -> FloatArray:
        """Return the rows (C, n) of outputs; `component` 1 and 2: transverse and shear strain."""

    @abstractmethod
    def force_row(self, place: Place, parameters: FloatArray, loads: ModelPatch) -> FloatArray:
        """Return the load (n,) of 1 N at a place, as load primitives have it."""

    @abstractmethod
    def lift(self, trial: Trial, parameters: FloatArray, loads: ModelPatch) -> FloatArray:
        """Return the loads (2, n) of a load factor and of its square in a flight, as load primitives do."""

    @abstractmethod
    def stiffness(self, state: State) -> Solver:
        """Return the stiffness in a state."""

    @abstractmethod
    def moving(self, state: State, place: Place, ports: tuple[str, ...] = ()) -> Moving:
        """Return the structure as it moves when let go, or pushed, at a place, with forces at `ports`."""

    def always(self, parameters: FloatArray) -> FloatArray | None:
        """Return the load (n,) that acts in every motion, too; None: all loads are recorded."""
        return None

    def spread(self, ports: Mapping[str, PortScale], shape: FloatArray) -> dict[str, PortScale]:
        """Return the scales of forces that are spread over the structure, by the first mode (n,)."""
        return {}

    # ------------------------------------------------------------ what it is

    def ports(self) -> tuple[str, ...]:
        """Names of the ports where internal forces can act on one motion."""
        return tuple(self.points)

    def stations(self) -> tuple[float, float] | None:
        """Return the least and largest station [m]; None where it has no length."""
        return None if self.length is None else (0.0, self.length)

    def scales(self, campaign: Campaign) -> Scales:
        """Return the natural scales under a campaign, by the structure without a patch."""
        values = prior_mean(campaign, self.declared)
        healthy = State(values, (0.0,) * len(self.regions))
        static, moved = self.stiffness(healthy), self.moving(healthy, self.reference)
        tip = self.force_row(self.reference, values, NO_PATCH)
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
        columns = (column.tolist() for column in (usual, rows @ shape, at_rest, largest))
        ports = {
            port: PortScale(size or most or 1.0, first**2 / by**2, first, still, most or 1.0)
            for port, size, by, still, most in zip(self.ports(), *columns, strict=True)
        }
        return Scales(
            length=self.length or 1.0,
            tip_stiffness=1.0 / float(tip @ static.solve(tip)),
            modal_mass=1.0 / float(tip @ shape) ** 2,
            angular_frequency=first,
            **campaign_sizes(campaign),
            ports=ports | self.spread(ports, shape),
        )

    # ------------------------------------------------------------ response

    def _respond(self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions) -> Response:
        """Return the response of a trial.

        The force of a trial is (1 + gain) times the recorded one, plus the tare where it is not zero. In a
        dynamic trial the structure is that at its first temperature.
        """
        check_plain(trial, self.name)
        check_no_inputs(trial, self.name)
        check_parameters(self.name, self.parameters, conditions.parameters)
        for item in patch:
            if not (isinstance(item, SENSORS) or self.supports(type(item))):
                raise ModelError(f"{self.name} cannot carry the primitive {item.kind!r}.")
        try:
            losses, forces = patch.of(LocalStiffnessLoss), patch.of(*INTERNAL_FORCES)
            blocks = [self.output_rows(outputs, n, losses) for n in range(3 if conditions.components else 1)]
            laws = laws_of(self.at_ports(forces), self.port_rows) if len(forces) else NO_LAWS
            if not trial.is_dynamic:
                return self._at_rest(trial, outputs, blocks, patch, conditions, laws)
            moved = self._moved(trial, conditions, patch, laws.ports)
            motion = self._motion(moved, trial, conditions, patch, laws)
            response = motion.response(blocks[0] @ moved.basis, [quantity for _, quantity in outputs])
            if (always := self.always(conditions.parameters)) is not None:
                still = self.stiffness(State(conditions.parameters, self._losses(trial, conditions)[0]))
                shown = blocks[0] @ still.solve(always)
                response.values[:] += shown * [not quantity.is_rate for _, quantity in outputs]
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
        # where a mass has weight; other zeros are read with it in place
        flight = trial.kind is TrialKind.FLIGHT
        loads = patch.of(*LOADS, PointMass) if flight else patch.of(*LOADS)
        parameters, structure = conditions.parameters, patch.of(*STRUCTURE)
        amounts, always = _amounts(trial, loads), self.always(parameters)
        if always is not None:
            amounts = np.column_stack((amounts, np.ones(len(amounts))))
        losses = self._losses(trial, conditions)
        losses = losses * len(amounts) if len(losses) == 1 else losses
        depends = len(patch.of(ModulusTemperature))
        warmer = trial.temperature.tolist() if depends else [0.0] * len(amounts)
        states = [State(parameters, lost, structure, warm) for lost, warm in zip(losses, warmer, strict=True)]
        values = np.empty((len(amounts), len(blocks) * len(outputs)))
        port_rows = laws.rows(self.port_rows, blocks[0].shape[1])
        place = None if flight else trial.load_place
        memory: FloatArray | None = None
        before, start = np.zeros(len(laws)), 0
        # rows of one structure that follow one another are solved together, in the order of the load path
        changes = [row for row in range(1, len(states)) if states[row][1:] != states[row - 1][1:]]
        for end in (*changes, len(states)):
            stiffness = self.stiffness(states[start])
            shown, at_ports, flexible, port_flexibility = self._statics.get(
                (stiffness, place, loads.primitives, outputs, len(blocks), laws.ports),
                lambda stiffness=stiffness: static_units(  # type: ignore[misc]
                    stiffness, self._units(trial, parameters, loads, always), blocks, port_rows
                ),
            )
            values[start:end] = amounts[start:end] @ shown
            if len(laws):
                loaded_from = before @ at_ports if start else None
                linear = amounts[start:end] @ at_ports
                solution = solved(laws, linear, port_flexibility, memory, loaded_from)
                memory = solution.memory
                values[start:end] -= solution.forces @ flexible
            before, start = amounts[end - 1], end
        seen, *components = np.split(values, len(blocks), axis=1)
        return Response(seen, None, *components)

    def _units(
        self, trial: Trial, parameters: FloatArray, loads: ModelPatch, always: FloatArray | None = None
    ) -> FloatArray:
        """Return the unit loads (k, n) of a trial at rest, what always acts last."""
        if trial.kind is TrialKind.FLIGHT:
            units = self.lift(trial, parameters, loads)
        else:
            units = self.force_row(trial.load_place, parameters, loads)[None]
        return units if always is None else np.vstack((units, always))

    def _losses(self, trial: Trial, conditions: Conditions) -> list[Losses]:
        """Return the losses of the regions in each row from those that the trial names."""
        losses = np.zeros((len(conditions.health), len(self.regions)))
        for name, column in zip(trial.regions, conditions.health.T, strict=False):
            if name in self.regions:
                losses[:, self.regions.index(name)] = column
            elif np.any(column):
                raise ModelError(
                    f"The trial {trial.name!r} gives a loss of the damage region {name!r}, but "
                    f"{self.name} has {', '.join(self.regions)}."
                )
        return [tuple(row) for row in losses.tolist()]

    def _moved(
        self, trial: Trial, conditions: Conditions, patch: ModelPatch, ports: tuple[str, ...]
    ) -> Moving:
        losses, warmer = self._losses(trial, conditions)[0], float(trial.temperature[0])
        state = State(conditions.parameters, losses, patch.of(*STRUCTURE), warmer)
        return self.moving(state, trial.load_place, ports)

    def _motion(
        self,
        moved: Moving,
        trial: Trial,
        conditions: Conditions,
        patch: ModelPatch,
        laws: Laws = NO_LAWS,
    ) -> Motion:
        """Return the motion in a dynamic trial."""
        basis, system = moved
        loads = patch.of(*LOADS) if trial.kind is TrialKind.FORCED else NO_PATCH
        row = self.force_row(trial.load_place, conditions.parameters, loads) @ basis
        acting = Acting(trial.time, np.zeros(len(row)), clock=conditions.clock)
        if trial.kind is TrialKind.RINGDOWN:
            acting = replace(acting, release=(row, release_of(trial)), initial=conditions.initial)
        else:
            course = Course.of(trial.time, _amounts(trial, loads)[:, 0], trial.hold)
            acting = replace(acting, loads=[(row, course)])
        return system.motion(acting, laws, conditions.refinement)

    # ------------------------------------------------------------ ports

    def _ported(self, trial: Trial, outputs: Outputs, parameters: FloatArray) -> PortedSystem:
        """Return the system by which outputs see missing forces, in the modes of the prior means."""
        patch, means = self.patch, np.array([item.mean for item in self.declared])
        of = (Conditions(values, health=trial.health[:1]) for values in (means, parameters))
        base, moved = (self._moved(trial, conditions, patch, self.missing) for conditions in of)
        rows = self.output_rows(outputs, 0, patch.of(LocalStiffnessLoss))
        # both bases hold nearly the same shapes of the whole structure
        shapes = np.linalg.lstsq(moved.basis, base.basis @ base.system.shapes, rcond=None)[0]
        return moved.system.ported(rows @ moved.basis, [item for _, item in outputs], np.asarray(shapes))

    def port_motion(self, trial: Trial, conditions: Conditions) -> tuple[FloatArray, FloatArray]:
        """Return positions and speeds (N, P) of the ports in a dynamic trial, without laws."""
        moved = self._moved(trial, conditions, self.patch, self.missing)
        motion = self._motion(moved, trial, conditions, self.patch)
        rows = np.array(list(moved.system.ports.values()))
        return motion.values(rows), motion.velocity @ (rows @ moved.system.shapes).T

    def _point_rows(self, size: int) -> FloatArray:
        return np.array(list(self.points.values())).reshape(-1, size)

    def _port_motion(self, trial: Trial, values: FloatArray, static: Solver, moved: Moving) -> FloatArray:
        """Motion (N, P) of the ports in a trial by the structure without a patch."""
        row = self.force_row(trial.load_place, values, NO_PATCH)
        rows = self._point_rows(len(row))
        if not trial.is_dynamic:
            unit = rows @ static.solve(self._units(trial, values, NO_PATCH).T)
            return np.asarray(_amounts(trial, NO_PATCH) @ unit.T)
        if trial.kind is TrialKind.FORCED:
            motion = self._motion(moved, trial, Conditions(values), NO_PATCH)
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
    moved, count = (port_rows @ answer).T, len(units)
    return shown[:count], moved[:count], shown[count:], moved[count:]


def _amounts(trial: Trial, loads: ModelPatch) -> FloatArray:
    """Return the factors (N, k) of the unit loads of a trial: load factor and its square, or the force."""
    if trial.kind is TrialKind.FLIGHT:
        return np.column_stack((trial.load_factor, trial.load_factor**2))
    return LoadChange.of(loads).changed(trial.force, trial.force)[:, None]
