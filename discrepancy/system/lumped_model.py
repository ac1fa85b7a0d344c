"""A lumped linear structure as a model, with named inputs, outputs and ports."""

from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np

from discrepancy.campaign.records import FloatArray, Hold, Quantity, RecordedInput, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.system.excitation import Excitation, Load
from discrepancy.system.interface import NO_PATCH
from discrepancy.system.linear_system import LinearSystem
from discrepancy.system.load_change import LoadChange, choose_load_place
from discrepancy.system.lumped_file import BLOCKS, LumpedDescription
from discrepancy.system.lumped_sections import InputSection, OutputSection
from discrepancy.system.model_file import DescribedModel
from discrepancy.system.output_equation import Feedthrough, OutputEquation
from discrepancy.system.port_units import units_at_port
from discrepancy.system.response import EITHER, Outputs, Place
from discrepancy.system.rig import OffsetInput, Rig, build_rig
from discrepancy.system.system_model import SystemModel
from discrepancy.system.system_state import LoadsAndMotions, PatchedTrial, SystemState
from discrepancy.system.time_history import FormulaHistory, RecordedHistory
from fe.runtime import patch as changes
from fe.runtime.laws import LAWS
from fe.runtime.patch import SENSORS, ModelPatch, PortLoad, Primitive, time_formula
from fe.runtime.state import Losses
from reporting.words import comma_list

MOST_MODES = 8
"""Number of modes with inertia of a structure on springs; higher ones deform without inertia."""


class LumpedModel(DescribedModel, SystemModel):
    """A lumped model (`discrepancy.system.interface.Model`).

    Damping that is given as modal ratios stays at these ratios when the structure changes. Health
    (z1, z2) has no meaning here and is ignored.

    Parameters
    ----------
    description : LumpedDescription
        The content of the model file.
    """

    follows_windows: ClassVar[bool] = True

    cache_size = 256

    def __init__(self, description: LumpedDescription) -> None:
        self.description = description
        super().__init__(
            description, {output.name: output.quantity for output in description.output}
        )
        self.load_places = tuple(section.name for section in description.input)
        self.kinds = _trial_kinds(description)
        self.length = description.characteristic_length
        self.port_rows = {}
        self.law_directions = {}
        for port in description.port:
            self.port_rows[port.name] = description.pad_to_all_unknowns(port.vector)
            self.law_directions[port.name] = description.pad_to_all_unknowns(
                port.acts or port.vector
            )
        self._places = sorted(description.place, key=lambda place: place.station)
        if self._places:
            self.stations = (self._places[0].station, self._places[-1].station)
        if description.root is not None:
            self.support_motions = (changes.ROOT_TURN,)
        self._inputs = {section.name: section for section in description.input}
        self._outputs = {section.name: section for section in description.output}

    @classmethod
    def load(cls, path: Path | str) -> "LumpedModel":
        """Return the model of a TOML file, or a shipped one by name; raises `ModelError`."""
        return cls(LumpedDescription.read(path))

    # ------------------------------------------------------------ what it is

    def supports(self, primitive: type[Primitive]) -> bool:
        """Return whether the model can have a primitive: whether it has what this acts on.

        ======================  ======================================================
        laws of the velocity    a port
        other laws              ports, all of which are displaced
        `StiffnessDrift`        a displacement
        `ModulusTemperature`    nothing
        `PointMass`             a place
        `SupportCompliance`     a support that may yield
        `LoadGain`              nothing
        `LoadPlace`             an input with a derivative by its station
        `PortLoad`              a port
        sensors                 nothing, as they act on readings
        ======================  ======================================================

        A port that is a state, such as the level of a tank, is not displaced: only its value and
        its rate act, and its position means nothing.
        """
        description = self.description
        if primitive in LAWS:
            displacement_count = description.displacement_count
            all_ports_are_displaced = all(
                np.any(row[:displacement_count]) for row in self.port_rows.values()
            )
            return bool(self.port_rows) and (primitive.depends_on_speed or all_ports_are_displaced)
        can_move_load = any(section.station_derivative is not None for section in description.input)
        is_carried: dict[type[Primitive], bool] = {
            changes.StiffnessDrift: description.displacement_count > 0,
            changes.ModulusTemperature: True,
            changes.PointMass: bool(self._places),
            changes.SupportCompliance: bool(self.support_motions),
            changes.LoadGain: True,
            changes.LoadPlace: can_move_load,
            PortLoad: bool(self.port_rows),
        }
        return is_carried.get(primitive, primitive in SENSORS)

    def region_losses(
        self, trial: Trial, health: FloatArray, patch: ModelPatch = NO_PATCH
    ) -> list[Losses]:
        """Return one row without losses, whatever the campaign states: there are no regions."""
        return [()]

    @property
    def oscillates(self) -> bool:
        """Whether the model has a mode that vibrates."""
        mean_state = SystemState(tuple(self.prior_mean().tolist()))
        return bool(np.any(self.system_in_state(mean_state).angular_frequency > 0.0))

    def built_in_laws(self, parameters: FloatArray) -> ModelPatch:
        """Return the laws that the model itself has at ports, multiplied by their factors.

        There are no laws if the model is a copy without laws (`linear`).
        """
        if self.linear:
            return NO_PATCH
        factors = self._term_factors(parameters.tolist())
        return ModelPatch(
            tuple(law.scaled_force(factors.get(law.name, 1.0)) for law in self.description.law)
        )

    # ------------------------------------------------------------ what acts in a trial

    def force_row(
        self, place: Place, state: SystemState, change: ModelPatch = NO_PATCH
    ) -> FloatArray:
        """Return the load (N,) of 1 N at a place, or of one unit of another input.

        A place is the name of an input; a patch may move it along the structure.
        """
        load_change = LoadChange.from_patch(change)
        return self._input_direction(self.rig_in_state(state), self._input_at(place), load_change)

    def loads_and_motions(self, case: PatchedTrial) -> LoadsAndMotions:
        """Return the loads and the prescribed motions in a trial.

        Loads are the constant ones, the references of controllers, the recorded inputs, and forces
        of the patch by a formula in time.
        """
        trial = case.trial
        rig = self.rig_in_state(case.state)
        inputs = self._offset_inputs(case)
        loads = self._constant_loads(rig, trial) + rig.loads_of_references(trial, inputs)
        motions = self._motions_held_at_zero(trial)
        # recorded loads and motions, without the references of controllers
        references = {loop.section.reference for loop in rig.loops.values()}
        load_change = LoadChange.from_patch(case.patch)
        for name, offset_input in inputs.items():
            if name in references:
                continue
            section = self._section_of(trial, offset_input.recorded)
            if section.is_prescribed:
                factor = rig.term_factor(name)
                motions[name] = _prescribed_motion(trial, offset_input, section, factor)
            else:
                direction = self._input_direction(rig, section, load_change)
                loads.append(Load(direction, _load_history(trial, offset_input, load_change)))
        # forces by a formula in time
        for primitive in case.patch:
            if isinstance(primitive, PortLoad):
                loads.append(self._port_load(primitive))
        return LoadsAndMotions(loads, motions)

    def _constant_loads(self, rig: Rig, trial: Trial) -> list[Load]:
        """Return the loads of the tables `[[load]]`, which act throughout a trial."""
        history = RecordedHistory(trial.time, np.ones(len(trial.time)))
        return [
            Load(rig.load_direction(section, section.vector), history)
            for section in self.description.load
        ]

    def _motions_held_at_zero(self, trial: Trial) -> dict[str, RecordedHistory]:
        """Return motions of zero for all inputs whose reaction force an output measures.

        A motion that the trial records replaces the zero. A motion that it does not record is held
        at zero, since the reaction of a free motion would be zero and nothing to measure.
        """
        zero_motion = RecordedHistory(
            trial.time, np.zeros(len(trial.time)), Hold.SMOOTH, motion_order=0
        )
        motions = {}
        for section in self.description.output:
            if section.reaction is not None:
                motions[section.reaction] = zero_motion
        return motions

    def _port_load(self, primitive: PortLoad) -> Load:
        """Return the load for a force that is given as a formula of time.

        Raises
        ------
        ModelError
            If the model does not have the port at which the force acts.
        """
        if primitive.port not in self.law_directions:
            raise ModelError(
                f"A force acts at the port {primitive.port!r}, which {self.name!r} does not have; "
                f"it has {comma_list(self.law_directions)}."
            )
        spans = tuple(window.span for window in primitive.windows)
        history = FormulaHistory(time_formula(primitive.force, primitive.kind), spans)
        return Load(self.law_directions[primitive.port], history)

    def _offset_inputs(self, case: PatchedTrial) -> dict[str, OffsetInput]:
        """Return the recorded inputs of a trial by name, each with its offset.

        A driven trial has inputs of its own; any other has its force as the only one.
        """
        trial = case.trial
        recorded_inputs = trial.inputs
        if trial.kind is not TrialKind.DRIVEN:
            section = self._input_at(trial.load_place)
            recorded_inputs = (
                RecordedInput(section.name, section.quantity, trial.force, trial.hold),
            )
        # the conditions may state no offsets: those that are missing are zero
        missing_offsets = (0.0,) * len(recorded_inputs)
        offsets = (*case.conditions.offset, *missing_offsets)
        offset_inputs = {}
        for recorded_input, offset in zip(recorded_inputs, offsets, strict=False):
            offset_inputs[recorded_input.name] = OffsetInput(recorded_input, offset)
        return offset_inputs

    def _section_of(self, trial: Trial, record: RecordedInput) -> InputSection:
        """Return the section [[input]] of the model for an input that a trial records.

        Raises
        ------
        ModelError
            If the model has no such input, or one of another quantity, or if `hold` of a motion or
            state that the model prescribes is given and is not smooth.
        """
        section = self._inputs.get(record.name)
        if section is None:
            raise ModelError(
                f"The trial {trial.name!r} records the input {record.name!r}, which "
                f"{self.quoted_name} does not have; it has {comma_list(self._inputs)}."
            )
        motion_chain = section.quantity.motion_chain
        if record.quantity is not section.quantity and record.quantity not in motion_chain:
            raise ModelError(
                f"The input {record.name!r} of {self.quoted_name} is {section.quantity.value}, "
                f"but the trial {trial.name!r} records {record.quantity.value}."
            )
        if section.is_prescribed and record.hold not in (None, Hold.SMOOTH):
            prescribed = "state" if section.prescribes_state else "motion"
            raise ModelError(
                f"The input {record.name!r} of the trial {trial.name!r} is a {prescribed} "
                f"that {self.name!r} prescribes, and no drive goes in steps or with corners: leave "
                "`reference` and `hold` out."
            )
        return section

    def _input_at(self, place: Place) -> InputSection:
        """Return the input of a load place; raises `ModelError` if there is none.

        A prescribed motion is a load place only if the trial names it.
        """
        candidates = [
            name
            for name, section in self._inputs.items()
            if name == place or not section.is_prescribed
        ]
        return self._inputs[choose_load_place(candidates, place, self.quoted_name)]

    def _input_direction(self, rig: Rig, section: InputSection, change: LoadChange) -> FloatArray:
        """Return the load (N,) of one unit of an input whose place may have been moved.

        Raises `ModelError` if its place moves, but the file does not say how the load then changes.
        """
        row = np.array(section.vector)
        if change.along_span or change.along_chord:
            if section.station_derivative is None:
                raise ModelError(
                    f"The input {section.name!r} of {self.name!r} declares no station_derivative, "
                    "so its place cannot move."
                )
            row = row + change.along_span * np.array(section.station_derivative)
        return rig.load_direction(section, row)

    # ------------------------------------------------------------ outputs

    def output_equations(
        self, case: PatchedTrial, outputs: Outputs, excitation: Excitation | None
    ) -> list[OutputEquation]:
        """Return the equation of each output under an excitation; None for a static trial."""
        equations = []
        for name, quantity in outputs:
            section = self._outputs[name]
            if section.vector is not None:
                equation = self._vector_equation(section, section.vector, quantity)
            elif section.controller is not None:
                equation = self._controller_equation(section.controller, case, excitation)
            else:
                equation = self._reaction_equation(section, case, excitation)
            equations.append(equation)
        return equations

    def _vector_equation(
        self, section: OutputSection, vector: Sequence[float], quantity: Quantity
    ) -> OutputEquation:
        """Return the equation of an output: vector . unknowns, or the time derivative of it.

        The output is differentiated as often as the quantity requires, such as once if the output
        is a displacement and a channel measures its speed. The derivative has no constant.
        """
        derivatives = 0
        if quantity is not section.quantity:
            derivatives = quantity.derivatives_of(section.quantity)
        description = self.description
        equation = OutputEquation.from_row(
            description.pad_to_all_unknowns(vector),
            displacement_derivative=section.quantity.order + derivatives,
            state_derivative=derivatives,
            state_count=description.unknown_count - description.displacement_count,
        )
        constant = 0.0 if derivatives else section.constant
        return OutputEquation(equation.rows, constant=constant)

    def _controller_equation(
        self, controller: str, case: PatchedTrial, excitation: Excitation | None
    ) -> OutputEquation:
        """Return the equation of an output that is the output of a controller.

        In a static trial, without an excitation, the references of the controller are zero.
        """
        loop = self.rig_in_state(case.state).loops[controller]
        # gives the factor x of a load x direction (pseudo-inverse of a vector)
        inverse_direction = loop.direction / float(loop.direction @ loop.direction)
        references: list[Load] = []
        if excitation is not None:
            references = loop.reference_loads(case.trial, self._offset_inputs(case))
        feedthrough = [
            Feedthrough(float(load.direction @ inverse_direction), load) for load in references
        ]
        return OutputEquation(loop.output_rows, feedthrough=feedthrough)

    def _reaction_equation(
        self, section: OutputSection, case: PatchedTrial, excitation: Excitation | None
    ) -> OutputEquation:
        """Return the equation of an output that is the force which a prescribed motion needs.

        By the equation of motion along the drive, this force is K u + C u' + M u'' minus the loads,
        plus the forces of laws there. Raises `ModelError` if the trial does not prescribe the
        motion.
        """
        drive_names = [] if excitation is None else list(excitation.prescribed_motions)
        if excitation is None or section.reaction not in drive_names:
            raise ModelError(
                f"The output {section.name!r} of {self.name!r} is the reaction of "
                f"{section.reaction!r}, whose motion this trial does not prescribe."
            )
        system = self.system_in_state(case.state._replace(drives=tuple(drive_names)))
        drive_shape = system.drive_shapes[:, drive_names.index(section.reaction)]
        rows = [
            drive_shape @ system.stiffness,
            drive_shape @ system.damping,
            drive_shape @ system.mass,
            0.0 * drive_shape,
        ]
        feedthrough = [
            Feedthrough(-float(load.direction @ drive_shape), load) for load in excitation.loads
        ]
        return OutputEquation(np.array(rows), feedthrough=feedthrough, law_direction=drive_shape)

    # ------------------------------------------------------------ units of ports

    def port_units(self, port: str) -> tuple[str, str]:
        """Return the units of the force and of the motion at a port, `EITHER` if not known."""
        row = self.port_rows.get(port)
        return EITHER if row is None else units_at_port(self.description, row)

    def _term_factors(self, parameters: Sequence[float]) -> dict[str, float]:
        """Return the factor of each term by name; parameters that scale the same term multiply."""
        factors: dict[str, float] = {}
        for section, value in zip(self.description.parameter, parameters, strict=True):
            for term in section.terms:
                factors[term] = factors.get(term, 1.0) * value
        return factors

    @cached_property
    def rig_in_state(self) -> Callable[[SystemState], Rig]:
        """The function that returns the matrices and controllers in a state, with a cache."""

        def build(state: SystemState) -> Rig:
            factors = self._term_factors(state.parameters)
            return build_rig(self.description, factors, state, self._places)

        return lru_cache(self.cache_size)(build)

    def build_system(self, state: SystemState) -> LinearSystem:
        """Return the linear system in a state, with its prescribed motions and controllers.

        The output of a controller is a load, so that it is subtracted from the left-hand side
        K z + D z' + M z'' of the equation of motion. The integral s of its error, with
        s' = reference - measured, is a further state: the speed z' of an unknown of its own. In the
        row of this unknown, M has a one, and the measured quantity is added to the left-hand side.
        """
        description = self.description
        rig = self.rig_in_state(state)
        count = description.unknown_count
        # stiffness, damping and mass, by the derivative that they multiply
        matrices = np.zeros((3, count, count))
        for kind, block in BLOCKS.items():
            matrices[block.derivative] += rig.matrices[kind]
        first_integral = description.displacement_count + description.state_count
        integrals = np.arange(first_integral, count)
        matrices[2, integrals, integrals] = 1.0
        if state.controlled:
            for loop in rig.loops.values():
                output_rows = loop.output_rows
                for derivative in range(3):
                    matrices[derivative] += np.outer(
                        loop.error_integral, loop.measured[derivative]
                    ) - np.outer(loop.direction, output_rows[derivative])
        stiffness, damping, mass = matrices
        beta = None if description.damping is None else description.damping.beta
        drives = [
            description.pad_to_all_unknowns(self._inputs[name].vector) for name in state.drives
        ]
        return LinearSystem(
            mass,
            damping,
            stiffness,
            self.port_rows,
            mode_count=MOST_MODES if description.is_structure_on_springs else None,
            relaxation=rig.term_factor("damping") * (beta or 0.0),
            state_count=count - description.displacement_count,
            drives=np.array(drives).reshape(len(drives), count),
            actions=self.law_directions,
        )


def _trial_kinds(description: LumpedDescription) -> frozenset[TrialKind]:
    """Return the kinds of trials that a lumped model can follow."""
    kinds = frozenset(TrialKind) - {TrialKind.FLIGHT}
    if not description.is_structure_on_springs:
        kinds -= {TrialKind.RINGDOWN}
    if description.free:
        # nothing holds it at rest
        kinds -= {TrialKind.STATIC}
    return kinds


def _prescribed_motion(
    trial: Trial, offset_input: OffsetInput, section: InputSection, factor: float
) -> RecordedHistory:
    """Return the motion that an input prescribes, multiplied by a factor.

    A state is the speed of its coordinate, so that a prescribed state is a recorded velocity.
    """
    order = 1 if section.prescribes_state else offset_input.recorded.quantity.order
    return RecordedHistory(
        trial.time, factor * offset_input.values, Hold.SMOOTH, motion_order=order
    )


def _load_history(trial: Trial, offset_input: OffsetInput, change: LoadChange) -> RecordedHistory:
    """Return a recorded load over time, changed by a patch if it is a force or a torque."""
    recorded_input = offset_input.recorded
    values = offset_input.values
    if recorded_input.quantity in (Quantity.FORCE, Quantity.TORQUE):
        values = change.apply_to(values, recorded_input.values)
    return RecordedHistory(trial.time, values, recorded_input.hold)
