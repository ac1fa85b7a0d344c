"""An FMU as a model: loads act on its inputs, laws at its ports, and its outputs are read."""

from dataclasses import replace
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from discrepancy.campaign.records import Campaign, FloatArray, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.fmu_models.description import FmuModelDescription
from discrepancy.fmu_models.fmu_excitation import FmuExcitation
from discrepancy.fmu_models.fmu_motion import FmuSimulator
from discrepancy.fmu_models.readout import OutputColumns, Readout, SampledOutputs
from discrepancy.fmu_models.trials import (
    effect_parameters,
    first_trial,
    release_values,
    trial_without_readings,
)
from discrepancy.system.interface import NO_PATCH
from discrepancy.system.load_change import LoadChange, choose_load_place
from discrepancy.system.model_file import DescribedModel
from discrepancy.system.response import Conditions, Outputs, PortedSystem, Response
from discrepancy.system.scales import PortScale, Scales
from discrepancy.system.time_history import RecordedHistory, subdivide
from fe.runtime.patch import (
    SENSORS,
    LoadGain,
    LoadPlace,
    ModelPatch,
    PortForce,
    Primitive,
    RegionStiffnessLoss,
)
from fe.runtime.port_laws import PortLaws, port_laws
from fmu_asset.client.runs import OperatingPoint
from fmu_asset.client.state_space import FmuStateSpace
from reporting.words import comma_list

LATEST_BEGIN = 100.0
"""If the first stamp is later than this many lengths of the record, the stamps do not count from
the start of the trial."""
PHASE_IN_INTERVAL = 0.3
"""Suitable phase of the first mode in a sampling interval [rad]."""


class PortStiffness(NamedTuple):
    """Stiffness of the most flexible mode at a port, and static stiffness [N/m or N m/rad]."""

    modal: float
    static: float


class FmuModel(DescribedModel):
    """An FMU (`discrepancy.system.interface.Model`).

    Parameters
    ----------
    description : FmuModelDescription
        Content of its file.
    folder : path-like
        Where relative names in it begin.

    Raises
    ------
    ModelError
        If FMU, binding or a variable is missing, or of another causality or unit.

    Notes
    -----
    The FMU has one release, so that only the first entry of `Conditions.initial` acts; deviations
    of single modes are ignored. `transverse` and `shear` are never known.
    """

    holds_inputs: ClassVar[bool] = True
    shows_ports_at_rest: ClassVar[bool] = False

    def __init__(self, description: FmuModelDescription, folder: Path | str = ".") -> None:
        self.description: FmuModelDescription = description
        self.fmu = FmuSimulator(description, Path(folder))
        self.variables = self.fmu.variables
        super().__init__(description, self.variables.quantities)
        inputs = description.inputs
        self.length = description.scales.length
        self.stations = None if self.length is None else (0.0, self.length)
        self.regions = tuple(inputs.regions)
        self.kinds = frozenset(TrialKind) - {TrialKind.DRIVEN}
        if inputs.load_factor is None:
            self.kinds -= {TrialKind.FLIGHT}
        self._parameter_keys = [
            self.variables.parameter(section.variable) for section in description.parameter
        ]
        self._force_inputs = {
            place: self.variables.variable(name) for place, name in inputs.force.items()
        }
        self._variable_of_input = {
            section.name: self.variables.variable(section.variable) for section in description.input
        }
        self.load_places = tuple(self._force_inputs)
        self.support_motions = description.support_motions
        limits = [self.fmu.largest_input(name) for name in self._force_inputs.values()]
        self.largest_losses = {
            region: self.fmu.largest_input(self.variables.variable(name))
            for region, name in inputs.regions.items()
        }
        self.largest_force = 0.5 * min(limits, default=np.inf)
        self.fmu.nominal_point = self._operating_point(
            trial_without_readings(TrialKind.RINGDOWN, 1.0), Conditions(self.prior_mean())
        )

    @classmethod
    def load(cls, path: Path | str) -> "FmuModel":
        """Return the model of a TOML file; raises `ModelError`."""
        return cls(FmuModelDescription.read(path), Path(path).parent)

    def close(self) -> None:
        """End the FMU; it is opened again when it is needed."""
        self.fmu.close()

    def supports(self, primitive: type[Primitive]) -> bool:
        """Return whether the model can have a primitive: whether its FMU has the inputs for it.

        These are inputs that the description names:

        ========================  ==========================================
        sensors                   nothing, as they act on readings
        kinds under `[effects]`   nothing else
        `LoadGain`                a force
        `RegionStiffnessLoss`     a region
        `LoadPlace`               a force and a bending moment
        forces of laws            a port
        ========================  ==========================================
        """
        inputs = self.description.inputs
        if primitive in SENSORS or primitive.kind in self.description.effects:
            return True
        if primitive is LoadGain:
            return bool(inputs.force)
        if primitive is RegionStiffnessLoss:
            return bool(self.regions)
        if primitive is LoadPlace:
            return bool(inputs.force) and inputs.bending_moment is not None
        return issubclass(primitive, PortForce) and bool(self.ports)

    # ------------------------------------------------------------ scales

    def scales(self, campaign: Campaign) -> Scales:
        """Return the natural scales under a campaign.

        Scales that the file states are taken from there; the others are computed with the FMU at
        the prior mean of the parameters.
        """
        conditions = Conditions(self.prior_mean(campaign))
        largest_displacements = self._largest_displacements(campaign, conditions)
        stiffnesses = self._port_stiffnesses(campaign, conditions)
        angular_frequency = self._first_angular_frequency(campaign, conditions)
        load_point = self._load_point_stiffness(stiffnesses)
        ports = {}
        for port, displacement, stiffness in zip(
            self.ports, largest_displacements, stiffnesses, strict=True
        ):
            ports[port] = PortScale(
                displacement=float(displacement) or 1.0,
                stiffness=stiffness.modal,
                angular_frequency=angular_frequency,
                static_stiffness=stiffness.static,
            )
        file_scales = self.description.scales
        largest = campaign.largest_magnitudes
        return Scales(
            length=file_scales.length or 1.0,
            tip_stiffness=file_scales.tip_stiffness or load_point.static,
            modal_mass=file_scales.modal_mass or load_point.modal / angular_frequency**2,
            angular_frequency=angular_frequency,
            force=largest["force"],
            load_factor=largest["load_factor"],
            duration=largest["duration"],
            campaign_time=largest["campaign_time"],
            ports=ports,
        )

    def _largest_displacements(self, campaign: Campaign, conditions: Conditions) -> FloatArray:
        """Return the largest displacement of each port (P,), simulated in the trials of a campaign.

        Units are m, or rad at a port that turns. Laws of the patch are left out.
        """
        largest = np.zeros(len(self.ports))
        for trial in campaign.trials:
            if trial.is_dynamic:
                port_displacements = self._sampled_motion(
                    trial, conditions, NO_PATCH, self._port_columns()
                ).values
            else:
                at_health = replace(conditions, health=trial.health)
                outputs = self._outputs_at_rest(trial, at_health, NO_PATCH)
                port_displacements = outputs[:, self.fmu.displacement_columns]
            largest = np.maximum(largest, np.max(np.abs(port_displacements), axis=0))
        return largest

    def _port_stiffnesses(self, campaign: Campaign, conditions: Conditions) -> list[PortStiffness]:
        """Return the modal and the static stiffness of each port [N/m].

        If there is a dynamic trial and the FMU is linear in the first one, they are computed from
        its linear system. Otherwise both are the static stiffness of the FMU.
        """
        static_trial = first_trial(campaign, is_dynamic=False)
        if static_trial is None:
            # the sampling interval of 1 s has no effect at rest
            static_trial = trial_without_readings(TrialKind.STATIC, 1.0)
        static_state = self._operating_point(static_trial, conditions)
        # displacement of each port under a unit force at this port
        compliances = np.diag(self.fmu.port_flexibility(static_state))
        dynamic_trial = first_trial(campaign, is_dynamic=True)
        if dynamic_trial is not None:
            state = self._operating_point(dynamic_trial, conditions)
            excitation = self.fmu.excitation_of(dynamic_trial, state, self.ports)
            system = self.fmu.linear_system(excitation)
            if system is not None:
                return self._stiffnesses_of_system(system)
        return [
            PortStiffness(1.0 / port_compliance, 1.0 / port_compliance)
            for port_compliance in compliances.tolist()
        ]

    def _stiffnesses_of_system(self, system: FmuStateSpace) -> list[PortStiffness]:
        """Return the stiffness of each port of a linear system."""
        stiffnesses = []
        for port, column in enumerate(self.fmu.displacement_columns):
            modal, static = system.stiffness(column, port)
            stiffnesses.append(PortStiffness(modal, static))
        return stiffnesses

    def _first_angular_frequency(self, campaign: Campaign, conditions: Conditions) -> float:
        """Return the angular frequency of the first mode [rad/s].

        The file of the model may state it. Otherwise it is found from the FMU in the first dynamic
        trial, or, without any trial, in a simulated ring-down. In a campaign of trials at rest the
        result is 1 rad/s.
        """
        angular_frequency = self.description.scales.angular_frequency
        if angular_frequency:
            return angular_frequency
        dynamic_trial = first_trial(campaign, is_dynamic=True)
        if dynamic_trial is not None:
            operating_point = self._operating_point(dynamic_trial, conditions)
            return self.fmu.choose_step(dynamic_trial, operating_point).angular_frequency or 1.0
        if campaign.trials:
            return 1.0
        # without trials: adapt the sampling interval to the frequency, in three rounds
        interval = 0.01
        for _ in range(3):
            trial = trial_without_readings(TrialKind.RINGDOWN, interval)
            step_choice = self.fmu.choose_step(trial, self.fmu.nominal_point)
            interval = PHASE_IN_INTERVAL / step_choice.angular_frequency
        return step_choice.angular_frequency or 1.0

    def _load_point_stiffness(self, stiffnesses: list[PortStiffness]) -> PortStiffness:
        """Return the stiffness of the first port whose force input is one of the trials' loads.

        If there is none, it is that of the first port; without ports, 1 N/m.
        """
        force_inputs = self._force_inputs.values()
        for port_input, stiffness in zip(self.fmu.port_inputs, stiffnesses, strict=True):
            if port_input in force_inputs:
                return stiffness
        return stiffnesses[0] if stiffnesses else PortStiffness(1.0, 1.0)

    # ------------------------------------------------------------ response

    def _respond(
        self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions
    ) -> Response:
        """Return the outputs (N, C) of a trial, and their rates if it is dynamic.

        The force that acts is (1 + gain) times the recorded one, plus the tare at samples whose
        recorded force is not zero. Raises `ModelError` if the trial is at rest, but an output is a
        velocity or an acceleration.
        """
        columns = self._output_columns(outputs)
        if trial.is_dynamic:
            sampled = self._sampled_motion(trial, conditions, patch, columns)
            return Response(sampled.values, sampled.rates)
        if any(quantity.order > 0 for _, quantity in outputs):
            raise ModelError(
                f"The trial {trial.name!r} is at rest, but a channel measures velocity or "
                "acceleration."
            )
        return Response(self._outputs_at_rest(trial, conditions, patch)[:, columns.columns])

    def _output_columns(self, outputs: Outputs) -> OutputColumns:
        """Return the columns of outputs, and how many times each is differentiated."""
        derivatives = [
            quantity.derivatives_of(self.quantities[output]) for output, quantity in outputs
        ]
        return OutputColumns([self.variables.columns[output] for output, _ in outputs], derivatives)

    def _port_columns(self) -> OutputColumns:
        """Return the columns of the ports' displacements."""
        columns = self.fmu.displacement_columns
        return OutputColumns(columns, [0] * len(columns))

    def _sampled_motion(
        self,
        trial: Trial,
        conditions: Conditions,
        patch: ModelPatch,
        columns: OutputColumns,
        parts: int = 1,
    ) -> SampledOutputs:
        """Return outputs of the FMU in a dynamic trial, and their rates.

        The outputs are read at the times of the samples with the clock error of `conditions`; each
        interval between samples is divided into `parts`.
        """
        laws = self._laws_at_ports(patch)
        times = subdivide(conditions.motion_times(trial.time), parts)
        first_stamp = float(trial.time[0])
        record_length = float(trial.time[-1]) - first_stamp
        # An FMU is simulated from time zero. If the first stamp is far from it (a time of day), all
        # stamps are shifted, so that nothing is simulated before the record.
        begins_near_zero = 0.0 <= first_stamp <= LATEST_BEGIN * record_length
        if trial.kind is not TrialKind.RINGDOWN and not begins_near_zero:
            trial = replace(trial, time=trial.time - first_stamp)
            times = times - first_stamp
        excitation = self._excitation_of_trial(trial, conditions, patch, laws)
        readout = Readout(columns.columns, columns.derivatives, times)
        return self.fmu.simulate_motion(excitation, trial, laws, readout, conditions.refinement)

    def _outputs_at_rest(
        self, trial: Trial, conditions: Conditions, patch: ModelPatch
    ) -> FloatArray:
        """Return all outputs (N, C) of the FMU in the N rows of a static trial or a flight."""
        loads = self._loads_at_rest(trial, conditions, patch)
        rows = range(len(trial.time))
        states = [self._operating_point(trial, conditions, patch, row) for row in rows]
        return self.fmu.solve_rest_with_laws(states, loads, self._laws_at_ports(patch), trial.name)

    def _loads_at_rest(
        self, trial: Trial, conditions: Conditions, patch: ModelPatch
    ) -> dict[str, FloatArray]:
        """Return the values (N,) of the FMU's inputs in the N rows of a trial at rest, by variable.

        - A flight sets only the load factor.
        - Other trials set the inputs that they hold, with the fitted offsets, and the recorded
          force at their load place. If they hold inputs, a force that is zero in all rows is not
          set.

        Raises `ModelError` if a trial of either kind holds an input that the FMU lacks.
        """
        offsets = conditions.offset or (0.0,) * len(trial.inputs)
        loads: dict[str, FloatArray] = {}
        for recorded, offset in zip(trial.inputs, offsets, strict=True):
            if recorded.name not in self._variable_of_input:
                raise ModelError(
                    f"The trial {trial.name!r} holds the input {recorded.name!r}, which the FMU "
                    f"model {self.name!r} does not have; it has "
                    f"{comma_list(self._variable_of_input)}: name it in [[input]]."
                )
            variable = self._variable_of_input[recorded.name]
            loads[variable] = self.variables.input_factors[variable] * (recorded.values + offset)
        if trial.kind is TrialKind.FLIGHT:
            load_factor = str(self.description.inputs.load_factor)
            return {self.variables.variable(load_factor): trial.load_factor}
        if not loads or np.any(trial.force):
            # no offset of the recorder is fitted to the force of a trial at rest
            force = self._load_change(patch).apply_to(trial.force, recorded_values=trial.force)
            for variable, factor in self._force_factors(trial, patch).items():
                loads[variable] = force * factor
        return loads

    # ------------------------------------------------------------ ports

    def _ported_system(
        self, trial: Trial, outputs: Outputs, parameters: FloatArray
    ) -> PortedSystem:
        """Return the linear system from missing forces at the ports to the outputs.

        A missing force is an unknown force in time. It acts at a port: a place of the structure
        where a force may act.

        The system is identified from simulated responses of the FMU to a force at each port. The
        coordinates of an identified state are arbitrary. So the state is returned in the
        coordinates of the system at the prior mean of the parameters, and systems at different
        values of the parameters can be compared.

        Parameters
        ----------
        trial : Trial
            The trial whose operating point is taken.
        outputs : Outputs
            The C outputs of the FMU that channels measure.
        parameters : (P,) array
            Values of the calibrated parameters.

        Raises
        ------
        ModelError
            If the FMU is not linear, if no system can be identified, or if the speed of a port
            jumps with a force.
        """
        mean_system = self._system_with_parameters(trial, self.prior_mean())
        system = self._system_with_parameters(trial, parameters)
        # coordinates can be compared only between systems of the same number of states
        if (
            mean_system is None
            or system is None
            or len(mean_system.input_matrix) != len(system.input_matrix)
            or self._has_jumping_port_speed(system)
        ):
            raise ModelError(
                f"The FMU model {self.name!r} does not show by its responses to single forces how "
                "its ports move: it is not linear, the responses are too short or too rough, or "
                "speeds jump with forces."
            )
        system = system.in_coordinates_of(mean_system)
        # matrices (ports, n) from the state to positions and speeds of the ports
        port_displacements = self.fmu.displacement_columns
        positions_by_state, _ = system.output_rows(port_displacements, 0)
        speeds_by_state, _ = system.output_rows(port_displacements, 1)
        # matrices (C, n) and (C, ports) from state and port forces to the outputs
        output_columns = self._output_columns(outputs)
        outputs_by_state, outputs_by_force = system.output_rows(
            output_columns.columns, output_columns.derivatives
        )
        return PortedSystem(
            generator=system.state_matrix,
            ports=self.ports,
            actions=system.input_matrix.T,
            positions=positions_by_state,
            speeds=speeds_by_state,
            outputs=outputs_by_state,
            through=outputs_by_force.T,
        )

    def _has_jumping_port_speed(self, system: FmuStateSpace) -> bool:
        """Return whether the speed of a port jumps with the force there, as no mass resists it."""
        port_displacements = np.array(self.fmu.displacement_columns, dtype=np.int64)
        # the forces at the ports are the first inputs, in the order of the ports
        return system.has_jumping_speed(port_displacements, np.arange(len(port_displacements)))

    def _system_with_parameters(self, trial: Trial, parameters: FloatArray) -> FmuStateSpace | None:
        """Return the linear system at values of the parameters; None if the FMU is not linear.

        The damage is that of the first row of the trial.
        """
        conditions = Conditions(parameters, health=trial.health[:1])
        state = self._operating_point(trial, conditions, self.patch)
        return self.fmu.linear_system(self.fmu.excitation_of(trial, state, self.ports))

    def port_motion(
        self, trial: Trial, conditions: Conditions, parts: int = 1
    ) -> tuple[FloatArray, FloatArray]:
        """Return positions and speeds (N, P) of the ports in a dynamic trial, without laws."""
        without_laws = self.patch.without(PortForce)
        return self._sampled_motion(trial, conditions, without_laws, self._port_columns(), parts)

    # ------------------------------------------------------------ trials in the FMU's terms

    def _laws_at_ports(self, patch: ModelPatch) -> PortLaws:
        """Return the laws of a patch at the ports."""
        return port_laws(patch.of(PortForce), self.ports)

    def _load_change(self, patch: ModelPatch) -> LoadChange:
        """Return how a patch changes the loads of trials.

        Primitives that the FMU simulates itself are left out, as they act there.
        """
        effects = self.description.effects
        return LoadChange.from_patch(
            primitive for primitive in patch if primitive.kind not in effects
        )

    def _excitation_of_trial(
        self, trial: Trial, conditions: Conditions, patch: ModelPatch, laws: PortLaws
    ) -> FmuExcitation:
        """Return the excitation of the FMU in a dynamic trial: a release or a recorded force."""
        state = self._operating_point(trial, conditions, patch)
        if trial.kind is TrialKind.RINGDOWN:
            excitation = self.fmu.excitation_of(trial, state, laws.ports)
            return excitation._replace(releases=release_values(self.fmu, trial, conditions))
        force_factors = self._force_factors(trial, patch)
        excitation = self.fmu.excitation_of(trial, state, laws.ports, force_factors)
        force = self._load_change(patch).apply_to(trial.force, trial.force)
        return excitation._replace(force=RecordedHistory(trial.time, force, trial.hold))

    def _force_factors(self, trial: Trial, patch: ModelPatch) -> dict[str, float]:
        """Return the factor of the recorded force on each input of the FMU, by variable name.

        The factor is 1 for the force input of the load place. If a patch moves the load, the inputs
        of bending moment and torque have its distances along the span and the chord [m] as factors.
        Raises `ModelError` if a load moves along the chord of an FMU without an input of torque.
        """
        inputs = self.description.inputs
        change = self._load_change(patch)
        if change.along_chord and inputs.torque is None:
            raise ModelError(
                f"The FMU model {self.name!r} names no torque in [inputs], so no load moves along "
                "the chord."
            )
        trial_text = f"the trial {trial.name!r}"
        place = choose_load_place(
            [*self._force_inputs], trial.load_place, self.quoted_name, trial_text
        )
        force_factors = {self._force_inputs[place]: 1.0}
        if inputs.bending_moment is not None and change.along_span:
            force_factors[self.variables.variable(inputs.bending_moment)] = change.along_span
        if inputs.torque is not None and change.along_chord:
            force_factors[self.variables.variable(inputs.torque)] = change.along_chord
        return force_factors

    def _operating_point(
        self, trial: Trial, conditions: Conditions, patch: ModelPatch = NO_PATCH, row: int = 0
    ) -> OperatingPoint:
        """Return the parameters and constant inputs of the FMU in a row of a trial.

        The inputs are stiffness losses and temperature. The parameters are those that the file
        states for this kind of trial, the calibrated ones, and those of primitives of the patch
        that the FMU simulates itself. A dynamic trial has the temperature of its first sample.
        """
        variables = self.variables
        # inputs
        input_names = self.description.inputs
        losses = self.region_losses(trial, conditions.health, patch)  # (rows or 1, regions)
        row_losses = losses[min(row, len(losses) - 1)]
        inputs: dict[str, float] = {}
        for name, loss in zip(input_names.regions.values(), row_losses, strict=True):
            inputs[variables.variable(name)] = loss
        if input_names.temperature is not None:
            rise = float(trial.temperature[0 if trial.is_dynamic else row])
            reference = input_names.temperature_reference or 0.0
            inputs[variables.variable(input_names.temperature)] = reference + rise
        # parameters
        section = self.description.motion if trial.is_dynamic else self.description.static
        parameters = {variables.parameter(key): value for key, value in section.parameters.items()}
        values = conditions.parameters.tolist()
        parameters |= dict(zip(self._parameter_keys, values, strict=True))
        parameters |= effect_parameters(
            patch, self.description.effects, parameters, self.quoted_name
        )
        return OperatingPoint((), tuple(sorted(inputs.items()))).with_parameters(parameters)
