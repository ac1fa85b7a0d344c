"""A structure from a mesh or matrices as a model: its reduced model, whose modes and statics are known."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.linalg import inv

from discrepancy.campaign.records import FloatArray, Quantity, Trial
from discrepancy.errors import ModelError
from discrepancy.models.interface import ModelParameter, Outputs, Place
from discrepancy.models.memory import Memory
from discrepancy.models.questions import check_outputs, place_among
from discrepancy.models.second_order import SecondOrderSystem
from discrepancy.models.structural import Moving, State, StructuralModel
from fe.runtime.patch import INTERNAL_FORCES, SENSORS, LoadGain, ModelPatch, Primitive
from fe.runtime.reduced import ReducedModel, ReducedState, dense_sum
from fe.runtime.state import Losses

LOAD_FACTOR = "load_factor"
"""Control that is the load factor of flights."""
DEVIATION = 0.25
"""Standard deviation of a parameter whose calibration is not known, as a share of its range."""
SAME = 1e-9
"""Difference of two rows, relative to the largest entry, that is rounding."""


@dataclass(frozen=True, eq=False)
class ReducedSystem(SecondOrderSystem):
    """A structure in motion in the coordinates of `ReducedModel.at`, those of its modal and static bases.

    Attributes
    ----------
    compliance : (n, n) ndarray
        K^-1, in the static basis.
    found : tuple of ndarray
        Angular frequencies (M,) [rad/s] and shapes (n, M), in the modal basis.
    """

    compliance: FloatArray = field(kw_only=True)
    found: tuple[FloatArray, FloatArray] = field(kw_only=True)

    @cached_property
    def _modes(self) -> tuple[FloatArray, FloatArray, int]:
        return *self.found, len(self.found[0])

    def flexibility(self, loads: FloatArray) -> FloatArray:
        """Return K^-1 loads, for loads (n,) or (n, k)."""
        return np.asarray(self.compliance @ loads)

    solve = flexibility


class StructureModel(StructuralModel):
    """A structure from a mesh or matrices; its parameters and free masses have `DEVIATION`.

    A control in N is a force, and where a load of it meets a displacement output along it there is a port,
    which has the name of that. Other controls are nominal but for the load factor, which is zero where none
    is recorded; constant loads always act.

    Parameters
    ----------
    model : ReducedModel
        The structure.

    Raises
    ------
    ModelError
        If no control is a force or a load factor.
    """

    def __init__(self, model: ReducedModel) -> None:
        nominal = dict(zip(model.chosen, model.nominal.tolist(), strict=True))
        parameters = tuple(
            ModelParameter(name, nominal[name], DEVIATION * (high - low), unit, low, high)
            for names, unit in ((model.parameters, "1"), (model.masses, "kg"))
            for name in names
            for low, high in [model.validity[name]]
        )
        super().__init__(model.name, parameters)
        self.model, self.regions = model, model.regions
        units = zip(model.controls, model.control_units.split(), strict=True)
        self.forces = tuple(name for name, unit in units if unit == "N")
        if not self.forces and LOAD_FACTOR not in model.controls:
            raise ModelError(
                f"The structure {model.name} has no control in N and no load_factor, and a campaign needs a "
                'load that is recorded: give a [[control]] with unit = "N" and a [[load]] of 1 N tied to it, '
                "or a [[control]] load_factor."
            )
        self.reference = (*self.forces, LOAD_FACTOR)[0]
        _, outputs, accelerations = model.rows
        strains, displacements = np.split(outputs, [len(model.gauges)])
        named = (
            (model.gauges, Quantity.STRAIN, strains),
            (model.displacements, Quantity.DISPLACEMENT, displacements),
            (model.accelerations, Quantity.ACCELERATION, accelerations),
        )
        self._outputs = {
            name: (quantity, row)
            for names, quantity, rows in named
            for name, row in zip(names, rows, strict=True)
        }
        self._systems = Memory()
        means = np.array([item.mean for item in parameters])
        along = [self._load(means, **{force: 1.0}) for force in self.forces]
        self.points = self.port_rows = {
            name: row
            for push in along
            for name, row in zip(model.displacements, displacements, strict=True)
            if np.abs(row - push).max() <= SAME * np.abs(push).max()
        }

    def _vector(self, parameters: FloatArray, losses: Losses) -> FloatArray:
        model, vector = self.model, self.model.nominal.copy()
        first = len(model.parameters)
        vector[:first] = parameters[:first]
        vector[first : first + len(losses)] = losses
        masses = first + len(model.regions)
        vector[masses : masses + len(model.masses)] = parameters[first:]
        return vector

    def _load(self, parameters: FloatArray, **controls: float) -> FloatArray:
        """Return what controls of given values add to the load (n,)."""
        model = self.model
        vector = self._vector(parameters, (0.0,) * len(model.regions))
        vector[len(vector) - len(model.controls) :] = 0.0
        without = model.load_coefficients(vector)
        for name, value in controls.items():
            vector[model.chosen.index(name)] = value
        return np.asarray(model.rows[0] @ (model.load_coefficients(vector) - without))

    def output_quantity(self, output: str) -> Quantity | None:
        """Return what an output is, or None if there is no such output."""
        return self._outputs[output][0] if output in self._outputs else None

    def output_rows(self, outputs: Outputs, component: int, losses: ModelPatch) -> FloatArray:
        """Return the rows (C, n) of outputs; strains across gauges and in shear are not known.

        Raises
        ------
        ModelError
            If there is no such output, or it is of another quantity.
        """
        if component:
            raise ModelError(f"{self.name} does not tell strains across its gauges.")
        known = (f"{name} ({quantity.value})" for name, (quantity, _) in self._outputs.items())
        check_outputs(self.name, self, outputs, known)
        size = len(self.model.rows[0])
        return np.array([self._outputs[output][1] for output, _ in outputs]).reshape(len(outputs), size)

    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the structure can carry a primitive: sensors, laws at its ports, errors of its forces."""
        forces = primitive is LoadGain and bool(self.forces)
        return primitive in SENSORS or forces or (primitive in INTERNAL_FORCES and bool(self.points))

    def force_row(self, place: Place, parameters: FloatArray, loads: ModelPatch) -> FloatArray:
        """Return the load (n,) of 1 N of a force, or, where there is none, of the load factor.

        Raises
        ------
        ModelError
            If there is no such force, or none is named of several.
        """
        place = place_among(self.forces or (self.reference,), place, self.name)
        return self._load(parameters, **{place: 1.0})

    def lift(self, trial: Trial, parameters: FloatArray, loads: ModelPatch) -> FloatArray:
        """Return the loads (2, n) of the load factor and of its square, which is zero."""
        if LOAD_FACTOR not in self.model.controls:
            raise ModelError(
                f"The trial {trial.name!r} is a flight, but {self.name} has no control {LOAD_FACTOR}."
            )
        row = self._load(parameters, **{LOAD_FACTOR: 1.0})
        return np.stack((row, np.zeros_like(row)))

    def always(self, parameters: FloatArray) -> FloatArray | None:
        """Return the load (n,) of constant loads and of controls that no trial records, if there is any."""
        model = self.model
        vector = self._vector(parameters, (0.0,) * len(model.regions))
        for name in (*self.forces, LOAD_FACTOR):
            if name in model.controls:
                vector[model.chosen.index(name)] = 0.0
        acting = model.load_coefficients(vector)
        return np.asarray(model.rows[0] @ acting) if acting.any() else None

    def stiffness(self, state: State) -> ReducedSystem:
        """Return the structure at parameters and losses.

        Raises
        ------
        OutsideModelError
            If one lies outside the validity box of the reduced model.
        """
        parameters, losses, *_ = state
        key = parameters.tobytes(), losses
        return self._systems.get(key, lambda: self._made(self._vector(parameters, losses)))

    def _made(self, vector: FloatArray) -> ReducedSystem:
        model, state = self.model, ReducedState(self.model, vector)
        moving, size = model.modal_stiffness.shape[1], len(state.shapes)

        def placed(part: FloatArray, begin: int) -> FloatArray:
            whole = np.zeros((size, size))
            whole[begin : begin + len(part), begin : begin + len(part)] = part
            return whole

        theta = model.stiffness_coefficients(vector)
        mass, stiffness = (
            placed(part, 0) for part in (state.modes.mass, dense_sum(theta, model.modal_stiffness))
        )
        alpha, beta = model.damping
        return ReducedSystem(
            mass, alpha * mass + beta * stiffness, stiffness, self.port_rows, model.mode_count, float(beta),
            compliance=placed(inv(dense_sum(theta, model.static_stiffness)), moving),
            found=(2.0 * np.pi * state.modes.frequency, np.ascontiguousarray(state.shapes)),
        )  # fmt: skip

    def moving(self, state: State, place: Place, ports: tuple[str, ...] = ()) -> Moving:
        """Return the structure as it moves, in its own coordinates; errors as of `stiffness`."""
        system = self.stiffness(state)
        return Moving(np.eye(len(system.mass)), system)
