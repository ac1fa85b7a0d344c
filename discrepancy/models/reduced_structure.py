"""A structure from a mesh or matrices as a model, by its modes."""

from collections.abc import Mapping

import numpy as np
from scipy.linalg import inv

from calibration.result.record import ParameterPrior
from discrepancy.campaign.records import FloatArray, Quantity, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.acting import Acting, Shown, place_among, shown_rows
from discrepancy.models.interface import NO_PATCH, Memory, Outputs, Place
from discrepancy.models.second_order import SecondOrderSystem
from discrepancy.models.system_model import Case, State, SystemModel
from fe.runtime.patch import INTERNAL_FORCES, SENSORS, LoadGain, ModelPatch, Primitive
from fe.runtime.reduced import ReducedModel, ReducedState, dense_sum
from fe.runtime.state import Losses

LOAD_FACTOR = "load_factor"
"""Control that is the load factor of flights."""
DEVIATION = 0.25
"""Standard deviation of a parameter whose calibration is not known, as a share of its range."""
SAME = 1e-9
"""Difference of two rows, relative to the largest entry, that is rounding."""


class StructureModel(SystemModel):
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
        self.model, self.name, self.regions = model, model.name, model.regions
        self.parameters = tuple(
            ParameterPrior(name, unit, nominal[name], DEVIATION * (high - low), low, high)
            for names, unit in ((model.parameters, "1"), (model.masses, "kg"))
            for name in names
            for low, high in [model.validity[name]]
        )
        units = zip(model.controls, model.control_units, strict=True)
        self.forces = tuple(name for name, unit in units if unit == "N")
        if not self.forces and LOAD_FACTOR not in model.controls:
            raise ModelError(
                f"The structure {model.name} has no control in N and no load_factor, and a campaign needs a "
                'load that is recorded: give a [[control]] with unit = "N" and a [[load]] of 1 N tied to it, '
                "or a [[control]] load_factor."
            )
        if LOAD_FACTOR not in model.controls:
            self.kinds -= {TrialKind.FLIGHT}
        self.reference, self.load_places = (*self.forces, LOAD_FACTOR)[0], self.forces
        self.largest_force = 0.5 * min((model.validity[name][1] for name in self.forces), default=np.inf)
        _, outputs, accelerations = model.rows
        strains, displacements = np.split(outputs, [len(model.gauges)])
        named = (
            (model.gauges, Quantity.STRAIN, strains),
            (model.displacements, Quantity.DISPLACEMENT, displacements),
            (model.accelerations, Quantity.ACCELERATION, accelerations),
        )
        self.quantities = {name: quantity for names, quantity, _ in named for name in names}
        self._rows = {name: row for names, _, rows in named for name, row in zip(names, rows, strict=True)}
        self._systems = Memory()
        along = [self._load(self.prior_mean(), force) for force in self.forces]
        self.port_rows = {
            name: row
            for push in along
            for name, row in zip(model.displacements, displacements, strict=True)
            if np.abs(row - push).max() <= SAME * np.abs(push).max()
        }
        self.port_names = tuple(self.port_rows)

    def _vector(
        self, parameters: FloatArray, controls: Mapping[str, float], losses: Losses = ()
    ) -> FloatArray:
        names = (*self.model.parameters, *self.model.masses)
        return self.model.vector({**dict(zip(names, parameters.tolist(), strict=True)), **controls}, losses)

    def _load(self, parameters: FloatArray, control: str) -> FloatArray:
        """Return what one of a control adds to the load (n,)."""
        none = dict.fromkeys(self.model.controls, 0.0)
        first, second = (
            self.model.load_coefficients(self._vector(parameters, controls))
            for controls in (none, {**none, control: 1.0})
        )
        return np.asarray(self.model.rows[0] @ (second - first))

    def shown(self, case: Case, outputs: Outputs, acting: Acting | None, component: int = 0) -> list[Shown]:
        """Return what outputs show.

        Loads that always act shift what a motion shows.
        """
        found = shown_rows((self._rows[output] for output, _ in outputs), outputs)
        always = self._always(case.state.parameters)
        if acting is None or not always.any():
            return found
        still = self.system(case.state).flexibility(always)
        return [item._replace(constant=float(item.rows[0] @ still)) for item in found]

    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the structure can carry a primitive: sensors, laws at its ports, errors of its forces."""
        forces = primitive is LoadGain and bool(self.forces)
        return primitive in SENSORS or forces or (primitive in INTERNAL_FORCES and bool(self.port_names))

    def force_row(self, place: Place, state: State, change: ModelPatch = NO_PATCH) -> FloatArray:
        """Return the load (n,) of 1 N of a force, or, where there is none, of the load factor.

        Raises
        ------
        ModelError
            If there is no such force, or none is named of several.
        """
        return self._load(state.parameters, place_among(self.forces or (LOAD_FACTOR,), place, self.what))

    def lift(self, state: State, change: ModelPatch) -> FloatArray:
        """Return the loads (2, n) of the load factor and of its square, which is zero."""
        row = self._load(state.parameters, LOAD_FACTOR)
        return np.stack((row, np.zeros_like(row)))

    def _always(self, parameters: FloatArray) -> FloatArray:
        """Return the load (n,) of constant loads and of controls that no trial records."""
        recorded = {name: 0.0 for name in (*self.forces, LOAD_FACTOR) if name in self.model.controls}
        coefficients = self.model.load_coefficients(self._vector(parameters, recorded))
        return np.asarray(self.model.rows[0] @ coefficients)

    def constant(self, case: Case) -> FloatArray:
        """Return the load (n,) that always acts at rest; in motion it is in what is shown."""
        return self._always(case.state.parameters) * (not case.trial.is_dynamic)

    def system(self, state: State) -> SecondOrderSystem:
        """Return the structure at parameters and losses, in the coordinates of `ReducedModel.at`.

        Raises
        ------
        OutsideModelError
            If one lies outside the validity box of the reduced model.
        """
        parameters, losses, *_ = state
        key = parameters.tobytes(), losses
        return self._systems.get(key, lambda: self._made(self._vector(parameters, {}, losses)))

    def _made(self, vector: FloatArray) -> SecondOrderSystem:
        model, state = self.model, ReducedState(self.model, vector)
        size, moving = len(state.shapes), model.modal_stiffness.shape[1]
        theta = model.stiffness_coefficients(vector)
        mass, stiffness, compliance = np.zeros((3, size, size))
        cross = dense_sum(model.mass_coefficients(vector), model.cross_mass)
        mass[:moving, :moving], mass[:moving, moving:] = state.modes.mass, cross
        mass[moving:, :moving] = cross.T
        stiffness[:moving, :moving] = dense_sum(theta, model.modal_stiffness)
        compliance[moving:, moving:] = inv(dense_sum(theta, model.static_stiffness))
        alpha, beta = model.damping
        modes = 2.0 * np.pi * state.modes.frequency, np.ascontiguousarray(state.shapes), model.mode_count
        return SecondOrderSystem(
            mass, alpha * mass + beta * stiffness, stiffness, self.port_rows, model.mode_count, float(beta),
            known=modes, compliance=compliance,
        )  # fmt: skip
