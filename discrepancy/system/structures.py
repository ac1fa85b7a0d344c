"""A structure from a mesh or matrices as a model."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Protocol

import numpy as np

from discrepancy.campaign.records import Campaign, FloatArray, Quantity, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.system.excitation import Excitation, Load
from discrepancy.system.interface import NO_PATCH, MassPoint
from discrepancy.system.linear_system import LinearSystem, SolvedStructure
from discrepancy.system.load_change import choose_load_place
from discrepancy.system.output_equation import OutputEquation
from discrepancy.system.response import ACROSS, Conditions, Outputs, Place, Response
from discrepancy.system.scales import Scales
from discrepancy.system.structure_rows import (
    acts_along,
    displacements_of_places,
    strains_near_gauges,
    strains_of_possible_gauges,
)
from discrepancy.system.structure_unknowns import WithMeshErrors, mesh_errors_of, parameter_priors
from discrepancy.system.system_model import SystemModel
from discrepancy.system.system_state import PatchedTrial, SystemState
from discrepancy.system.time_history import RecordedHistory
from fe.runtime import patch as changes
from fe.runtime.changeable import KEPT_SUBSPACES, ChangeableModel
from fe.runtime.changed_structure import ChangedStructure, compliance_gains
from fe.runtime.patch import (
    INTERNAL_FORCES,
    SENSORS,
    ModelPatch,
    Primitive,
)
from fe.runtime.reduced import ReducedModel
from fe.runtime.state import Losses
from fe.structure.affine import PORT_PREFIX
from fe.structure.tables import INTERFACE_MOTIONS, MOTIONS

LOAD_FACTOR = "load_factor"
"""Control that is the load factor of flights."""
LARGEST_LOSS = 0.7
"""Largest loss of stiffness of a patch that is compared."""


class StructureWithMatrices(SolvedStructure, Protocol):
    """The interface of a reduced or a patched structure at one state.

    All matrices and rows are in n coordinates of the structure's own.
    """

    @property
    def mass(self) -> FloatArray:
        """The mass matrix (n, n) of the structure."""

    @property
    def stiffness(self) -> FloatArray:
        """The stiffness matrix (n, n) of the structure."""

    @property
    def mode_count(self) -> int:
        """The number of modes that have inertia."""

    @property
    def rigid_ports(self) -> frozenset[str]:
        """Ports without residual flexibility: these modes alone move them."""


class StructureModel(SystemModel):
    """A structure from a mesh or matrices, by its reduced model.

    The prior of its parameters and free masses is that of `parameter_priors`. A control
    with the unit N is a force. If its load acts along a displacement output, in either direction,
    there is a port with the name and the sign of that output; the ports of the file follow these.
    Other controls are nominal, except for the load factor, which is zero if a trial records none.
    Constant loads always act.

    Parameters
    ----------
    model : ReducedModel
        The structure. One from `fe.reduction.model_cache.changeable_model` has the ports of its
        file, and its supports may yield.

    Raises
    ------
    ModelError
        If no control is a force or a load factor, or a port of the file moves as another port does.
    """

    def __init__(self, model: ReducedModel) -> None:
        self.model = model
        self.name = model.name
        self._place_rows: dict[str, FloatArray] = {}
        self.regions = model.regions
        self.largest_losses = {region: model.validity[region][1] for region in model.regions}
        self.parameters = parameter_priors(model)
        if isinstance(model, ChangeableModel):
            mesh_errors = mesh_errors_of(model)
            self.parameters += mesh_errors
            self.nuisance_parameters = frozenset(error.name for error in mesh_errors)
        # loads
        units = zip(model.controls, model.control_units, strict=True)
        self.forces = tuple(name for name, unit in units if unit == "N" and not _is_at_port(name))
        if not self.forces and LOAD_FACTOR not in model.controls:
            raise ModelError(
                f"The structure {model.name} has no control in N and no load_factor, and a "
                'campaign needs a load that is recorded: give a [[control]] with unit = "N" and a '
                "[[load]] of 1 N tied to it, or a [[control]] load_factor."
            )
        if LOAD_FACTOR not in model.controls:
            self.kinds -= {TrialKind.FLIGHT}
        self.reference = self.forces[0] if self.forces else LOAD_FACTOR
        self.load_places = self.forces
        limits = [model.validity[name][1] for name in self.forces]
        self.largest_force = 0.5 * min(limits, default=np.inf)
        # outputs
        names = (*model.gauges, *model.displacements, *model.accelerations)
        if isinstance(model, ChangeableModel):
            self._name_changes(model)
            rows, self._unit_loads = model.whole_output, model.whole_load.T
        else:
            rows = np.concatenate((model.output_rows, model.acceleration_rows))
            self._unit_loads = model.unit_loads
        self._rows = dict(zip(names, rows, strict=True))
        if isinstance(model, ChangeableModel):
            self._rows |= strains_near_gauges(model)
            self._rows |= self._place_rows
            self._rows |= strains_of_possible_gauges(model)
        displacements = [name for name in model.displacements if not _is_at_port(name)]
        self.quantities = {
            **dict.fromkeys(model.gauges, Quantity.STRAIN),
            **dict.fromkeys(displacements, Quantity.DISPLACEMENT),
            **dict.fromkeys(model.accelerations, Quantity.ACCELERATION),
        }
        # ports
        self.port_rows = self._ports_of_loads(displacements)
        for port, row in self._ports_of_file().items():
            self._check_direction_is_new(port, row)
            self.port_rows[port] = row
        self.ports = tuple(self.port_rows)

    def _name_changes(self, model: ChangeableModel) -> None:
        """Set the attributes that say which changes the structure may have, from its model."""
        motions = list(zip(model.supports, model.motions, strict=True))
        self.support_motions = tuple(pair for pair in motions if pair[1] in MOTIONS)
        self.interface_motions = tuple(pair for pair in motions if pair[1] in INTERFACE_MOTIONS)
        self.mass_places = model.mass_places
        reaches = zip(model.mass_places, model.mass_reaches.tolist(), strict=True)
        self.kinds_with_weight = self._kinds_with_weight(model)
        self.mass_reaches = {place: reach for place, reach in reaches if reach > 0.0}
        self.loss_places = model.loss_places
        patches_with_gauges = np.unique(model.patch_of_gauge[model.patch_of_gauge >= 0]).tolist()
        self.places_with_gauges = frozenset(
            model.loss_places[number] for number in patches_with_gauges
        )
        losses_of_patches = dict.fromkeys(model.loss_places, LARGEST_LOSS)
        self.largest_losses = {**self.largest_losses, **losses_of_patches}
        self.length = model.size
        self.load_changes = tuple(
            zip(
                model.load_controls,
                model.load_change_kinds,
                model.load_change_axes,
                strict=True,
            )
        )
        self.gauge_shifts = tuple(zip(model.shifted_gauges, model.shift_axes, strict=True))
        self._place_rows = displacements_of_places(model)
        self.possible_loads = tuple(self._place_rows)
        self.possible_sensors = dict.fromkeys(self._place_rows, Quantity.DISPLACEMENT)
        self.possible_sensors |= dict.fromkeys(model.possible_gauges, Quantity.STRAIN)

    def _ports_of_loads(self, displacements: Iterable[str]) -> dict[str, FloatArray]:
        """Return the rows (n,) of the displacement outputs along which a force acts, by name.

        The force may act in either direction of the output.
        """
        mean_state = SystemState(tuple(self.prior_mean().tolist()))
        unit_loads = [self._unit_load(mean_state, force) for force in self.forces]
        rows: dict[str, FloatArray] = {}
        for unit_load in unit_loads:
            for name in displacements:
                if acts_along(unit_load, self._rows[name]):
                    rows[name] = self._rows[name]
        return rows

    def _ports_of_file(self) -> dict[str, FloatArray]:
        """Return the rows of the ports that the structure file declares, by name."""
        return {
            name.removeprefix(PORT_PREFIX): self._rows[name]
            for name in self.model.displacements
            if _is_at_port(name)
        }

    def _check_direction_is_new(self, port: str, row: FloatArray) -> None:
        """Raise `ModelError` if a port of the file moves along a row (n,) as another port does.

        Readings could not distinguish the forces at both.
        """
        for other_port, other_row in self.port_rows.items():
            if acts_along(row, other_row):
                raise ModelError(
                    f"The port {port!r} of the structure {self.name} moves exactly as its port "
                    f"{other_port!r} does, so that no reading can distinguish their forces: remove "
                    "this [[port]] from the file."
                )

    def prior_moments(self, campaign: Campaign) -> list[tuple[float, float]]:
        """Return mean and standard deviation of the prior of each parameter.

        Without a trial in motion no reading shows errors of frequencies by the mesh, whose
        deviations are zero then.
        """
        moments = super().prior_moments(campaign)
        if any(trial.is_dynamic for trial in campaign.trials):
            return moments
        return [
            (mean, 0.0 if parameter.name in self.nuisance_parameters else deviation)
            for parameter, (mean, deviation) in zip(self.parameters, moments, strict=True)
        ]

    def _input_vector(self, state: SystemState, controls: Mapping[str, float]) -> FloatArray:
        """Return the input vector of the reduced model; controls that are missing are nominal."""
        names = (*self.model.parameters, *self.model.masses)
        parameters = dict(zip(names, state.parameters, strict=False))
        return self.model.vector({**parameters, **controls}, state.losses)

    @cached_property
    def _rows_of_changes(self) -> Callable[[tuple[int, ...]], dict[str, FloatArray]]:
        """The function that returns the rows (k,) of outputs and ports under some changes.

        The rows are in the coordinates in which a structure with these changes is solved.
        """
        rows = self._rows | {PORT_PREFIX + name: row for name, row in self.port_rows.items()}

        def rows_of(changes_of_structure: tuple[int, ...]) -> dict[str, FloatArray]:
            if not isinstance(self.model, ChangeableModel):
                return rows
            basis = self.model.subspace(changes_of_structure).basis
            return {name: row @ basis for name, row in rows.items()}

        return lru_cache(KEPT_SUBSPACES)(rows_of)

    def _changes_of(self, state: SystemState) -> tuple[int, ...]:
        """Return the indices of the changes of the structure that act in a state; mostly none."""
        if not isinstance(self.model, ChangeableModel):
            return ()
        return self.model.changes_of(state.structure).numbers

    def _kinds_with_weight(self, model: ChangeableModel) -> frozenset[TrialKind]:
        """Return the kinds of trials at rest in which added masses have weight.

        A load factor gives it in flights, a constant acceleration in load steps, too. Controls that
        no trial records are nominal.
        """
        state = SystemState(tuple(self.prior_mean().tolist()))
        recorded = dict.fromkeys((*self.forces, LOAD_FACTOR), 0.0)
        kinds = set()
        for kind, controls in (
            (TrialKind.STATIC, recorded),
            (TrialKind.FLIGHT, recorded | {LOAD_FACTOR: 1.0}),
        ):
            in_model = {name: value for name, value in controls.items() if name in model.controls}
            coefficients = model.load_coefficients(self._input_vector(state, in_model))
            if model.load_accelerations[coefficients != 0.0].any():
                kinds.add(kind)
        return frozenset(kinds)

    def _in_state(self, load: FloatArray, state: SystemState) -> FloatArray:
        """Return a load (n,) of the reduced model in the k coordinates of a state, (k,).

        A structure with changes is solved in a subspace of its own.
        """
        if not isinstance(self.model, ChangeableModel):
            return load
        return np.asarray(load @ self.model.subspace(self._changes_of(state)).basis)

    def _load_of_controls(self, state: SystemState, controls: Mapping[str, float]) -> FloatArray:
        """Return the load (n,) under controls, of which those not given are nominal."""
        coefficients = self.model.load_coefficients(self._input_vector(state, controls))
        load = self._unit_loads @ coefficients
        if isinstance(self.model, ChangeableModel):
            load += self.model.weight_of_masses(state.structure, coefficients)
        return np.asarray(load)

    def _unit_load(self, state: SystemState, control: str) -> FloatArray:
        """Return the load (n,) per unit of a control, without the constant loads."""
        no_controls = dict.fromkeys(self.model.controls, 0.0)
        unit_control = no_controls | {control: 1.0}
        return self._load_of_controls(state, unit_control) - self._load_of_controls(
            state, no_controls
        )

    def output_equations(
        self, case: PatchedTrial, outputs: Outputs, excitation: Excitation | None
    ) -> list[OutputEquation]:
        """Return the equations of outputs; the strain of a shifted gauge is that at its true place.

        This strain follows from a Taylor series of second order in the distance of the shift.
        """
        rows = self._rows_of_changes(self._changes_of(case.state))
        shifts = [item for item in case.patch if isinstance(item, changes.GaugeOffset)]
        equations = []
        for output, quantity in outputs:
            row = rows[output]
            for shift in shifts:
                if shift.gauge == output:
                    slope, curvature = rows[f"{output}.{shift.axis}"]
                    row = row + shift.distance * slope + 0.5 * shift.distance**2 * curvature
            if isinstance(self.model, ChangeableModel) and output in self.model.gauges:
                row = self.model.strain_factor(output, case.patch) * row
            equations.append(OutputEquation.from_row(row, quantity.order))
        return equations

    def supports(self, primitive: type[Primitive]) -> bool:
        """Return whether the structure can have a primitive: whether it has what this acts on.

        ==========================  ==========================================
        internal forces             a port
        `RegionStiffnessLoss`       a damage region or a patch of the surface
        `PlaceMass`                 a place for a mass
        `LoadGain`                  a force
        `LoadOffset`, `LoadTilt`    a force that may be moved or turned
        `SupportCompliance`         a support that may yield
        `InterfaceCompliance`       an interface
        `GaugeOffset`               a gauge that may lie beside its place
        sensors                     nothing, as they act on readings
        ==========================  ==========================================
        """
        if primitive in INTERNAL_FORCES:
            return bool(self.ports)
        if primitive is changes.RegionStiffnessLoss:
            return bool(self.regions) or bool(self.loss_places)
        if primitive is changes.PlaceMass:
            return bool(self.mass_places)
        if primitive is changes.LoadGain:
            return bool(self.forces)
        if primitive in (changes.LoadOffset, changes.LoadTilt):
            return bool(self.load_changes)
        if primitive is changes.SupportCompliance:
            return bool(self.support_motions)
        if primitive is changes.InterfaceCompliance:
            return bool(self.interface_motions)
        if primitive is changes.GaugeOffset:
            return bool(self.gauge_shifts)
        return primitive in SENSORS

    def point_of_mass(self, mass: changes.PlaceMass) -> MassPoint | None:
        """Return where a mass lies that may lie beside a point of the grid, else None."""
        if not isinstance(self.model, ChangeableModel) or mass.place not in self.mass_reaches:
            return None
        number = self.mass_places.index(mass.place)
        axes = self.model.mass_axes[number]
        distances = np.array((mass.along, mass.across))
        return MassPoint(self.model.mass_points[number] + distances @ axes, axes)

    def respond(
        self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions
    ) -> Response:
        """Return the true response of a trial; added masses without weight change none at rest."""
        if not trial.is_dynamic and trial.kind not in self.kinds_with_weight:
            patch = patch.without(changes.PlaceMass)
        return super().respond(trial, outputs, patch, conditions)

    def force_row(
        self, place: Place, state: SystemState, change: ModelPatch = NO_PATCH
    ) -> FloatArray:
        """Return the load (k,) of a force of 1 N, or of the load factor 1 if there are no forces.

        The place is a force of the file, or one of `possible_loads`. The primitives of `change` may
        alter the place and the direction of a force of the file.

        Raises
        ------
        ModelError
            If there is no such force, or none is named of several.
        """
        if place in self._place_rows:
            return self._in_state(self._place_rows[str(place)], state)
        places = self.forces or (LOAD_FACTOR,)
        control = choose_load_place(places, place, self.quoted_name)
        load = self._unit_load(state, control)
        if isinstance(self.model, ChangeableModel):
            load = self.model.changed_load(load, control, change)
        return self._in_state(load, state)

    def output_quantity(self, output: str) -> Quantity | None:
        """Return the quantity of an output.

        Strains across gauges, shear strains and sensors that may be added are not listed in
        `quantities`.
        """
        if output.endswith(ACROSS) and output in self._rows:
            return Quantity.STRAIN
        return self.possible_sensors.get(output) or super().output_quantity(output)

    def lift_loads(self, state: SystemState, change: ModelPatch) -> FloatArray:
        """Return the load (1, k) of the load factor."""
        return self._in_state(self._unit_load(state, LOAD_FACTOR), state)[None]

    def excitation(self, case: PatchedTrial) -> Excitation:
        """Return the excitation of a trial, with the constant loads and unrecorded controls."""
        excitation = super().excitation(case)
        recorded_controls = [
            name for name in (*self.forces, LOAD_FACTOR) if name in self.model.controls
        ]
        constant_load = self._load_of_controls(case.state, dict.fromkeys(recorded_controls, 0.0))
        if not constant_load.any():
            return excitation
        constant_load = self._in_state(constant_load, case.state)
        always = RecordedHistory(excitation.time, np.ones(len(excitation.time)))
        return replace(excitation, loads=(*excitation.loads, Load(constant_load, always)))

    def region_losses(
        self, trial: Trial, health: FloatArray, patch: ModelPatch = NO_PATCH
    ) -> list[Losses]:
        """Return the losses of damage regions in each row, without losses of other patches.

        Those are part of the structure; see `patched_trial`.
        """
        in_regions = [primitive for primitive in patch if not self._is_loss_of_patch(primitive)]
        return super().region_losses(trial, health, ModelPatch(tuple(in_regions)))

    def _is_loss_of_patch(self, primitive: Primitive) -> bool:
        """Return whether a primitive is a stiffness loss of a patch that is no damage region."""
        is_loss = isinstance(primitive, changes.RegionStiffnessLoss)
        return is_loss and getattr(primitive, "region", "") in self.loss_places

    def patched_trial(
        self, trial: Trial, conditions: Conditions, patch: ModelPatch = NO_PATCH
    ) -> PatchedTrial:
        """Return a trial with its patch and conditions, with losses of patches in its structure."""
        case = super().patched_trial(trial, conditions, patch)
        structure = case.state.structure
        structure += ModelPatch(tuple(filter(self._is_loss_of_patch, patch)))
        if trial.load_place in self._place_rows:
            # no mass, but the columns of one: the responses to forces at the place
            place, _, _ = str(trial.load_place).rpartition(" along ")
            structure += ModelPatch((changes.PlaceMass(place, 0.0),))
        return case._replace(state=case.state._replace(structure=structure))

    def build_system(self, state: SystemState) -> LinearSystem:
        """Return the linear system in a state, in the coordinates in which it is solved.

        Raises
        ------
        OutsideModelError
            If a value lies outside the validity box of the reduced model.
        """
        structure = self._structure_in_state(state._replace(parameters=self._inputs_of(state)))
        rows = self._rows_of_changes(self._changes_of(state))
        ports = {name: rows[PORT_PREFIX + name] for name in self.port_rows}
        # the parameters after the inputs of the reduced model are the errors of the mesh
        errors = np.array(state.parameters[len(self._inputs_of(state)) :])
        solved = WithMeshErrors(structure, errors) if errors.any() else None
        return linear_system(structure, self.model.damping, ports, solved)

    @cached_property
    def _structure_in_state(self) -> Callable[[SystemState], StructureWithMatrices]:
        """The function that returns the structure in a state without mesh errors, with a cache."""

        def structure_in(state: SystemState) -> StructureWithMatrices:
            vector = self._input_vector(state, {})
            if not isinstance(self.model, ChangeableModel):
                return self.model.structure_at(vector)
            return ChangedStructure(self.model, vector, state.structure)

        return lru_cache(self.cache_size)(structure_in)

    def _inputs_of(self, state: SystemState) -> tuple[float, ...]:
        """Return the parameters of a state that are inputs of the reduced model: no mesh errors."""
        return state.parameters[: len(self.model.parameters) + len(self.model.masses)]

    def scales(self, campaign: Campaign) -> Scales:
        """Return the natural scales under a campaign, with those of supports and interfaces.

        The natural compliance of a motion that they hold is the one that changes a static
        compliance or an inverse squared frequency of the structure by 100 % (to first order). It is
        1 if the motion does not carry the structure.
        """
        scales = super().scales(campaign)
        if not isinstance(self.model, ChangeableModel):
            return scales
        state = SystemState(
            tuple(self.prior_mean(campaign).tolist()), losses=(0.0,) * len(self.regions)
        )
        # (support motions, loads + modes)
        gains = compliance_gains(self.model, self._input_vector(state, {}))
        largest_gains = gains.max(axis=1, initial=0.0).tolist()
        motions = zip(self.model.supports, self.model.motions, strict=True)
        compliances = {
            motion: 1.0 / gain if gain > 0.0 else 1.0
            for motion, gain in zip(motions, largest_gains, strict=True)
        }
        return replace(scales, support_compliances=compliances)


def _is_at_port(name: str) -> bool:
    """Return whether a control or a displacement acts at a port of the structure file."""
    return name.startswith(PORT_PREFIX)


def linear_system(
    structure: StructureWithMatrices,
    rayleigh: Iterable[float],
    ports: Mapping[str, FloatArray],
    solved: SolvedStructure | None = None,
) -> LinearSystem:
    """Return the linear system of a structure in a given state.

    Parameters
    ----------
    structure : StructureWithMatrices
        The structure at one state.
    rayleigh : iterable of float
        Rayleigh damping: alpha [1/s] and beta [s].
    ports : mapping of str to (n,) array
        The rows that give the displacement of each port from the n coordinates.
    solved : SolvedStructure, optional
        The structure with corrected modes; by default the modes are those of `structure`.
    """
    alpha, beta = rayleigh
    return LinearSystem(
        structure.mass,
        alpha * structure.mass + beta * structure.stiffness,
        structure.stiffness,
        ports,
        mode_count=structure.mode_count,
        relaxation=beta,
        on_modes=structure.rigid_ports,
        solved=solved or structure,
    )
