"""Models that are given by matrices (a wing, a structure, a lumped rig), at rest and in motion."""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property, lru_cache
from itertools import groupby

import numpy as np

from discrepancy.campaign.records import Campaign, FloatArray, Start, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.system.excitation import Excitation, Load, ReleasePoint
from discrepancy.system.interface import NO_PATCH, Model
from discrepancy.system.linear_system import LinearSystem
from discrepancy.system.load_change import LoadChange, require_release
from discrepancy.system.loaded_system import (
    LoadedSystem,
    errors_at_rest,
    ports_of_blocks,
)
from discrepancy.system.motion import Motion, simulate_motion
from discrepancy.system.natural_state import natural_state_magnitudes
from discrepancy.system.output_equation import OutputEquation
from discrepancy.system.port_scales import (
    GlobalScales,
    LargestMotion,
    PortScaleEstimator,
    displacement_readings,
    larger_magnitude,
    largest_measured_force,
    scales_of_moving_structure,
)
from discrepancy.system.ported_system import ported_system
from discrepancy.system.response import (
    Conditions,
    Outputs,
    Place,
    PortedSystem,
    PortsAtRest,
    Response,
)
from discrepancy.system.scales import PortScale, Scales
from discrepancy.system.system_state import (
    ExcitedSystem,
    LoadsAndMotions,
    PatchedTrial,
    RowsAtRest,
    SystemState,
)
from discrepancy.system.time_history import RecordedHistory, subdivide
from fe.runtime import patch as changes
from fe.runtime.errors import FiniteElementError
from fe.runtime.patch import INTERNAL_FORCES, LOADS, STRUCTURE, ModelPatch, PortLoad
from fe.runtime.port_laws import NO_LAWS, PortLaws, port_laws


class SystemModel(Model):
    """A model by its matrices (`discrepancy.system.interface.Model`), in N coordinates of its own.

    Attributes
    ----------
    port_rows : mapping of str to (N,) ndarray
        Rows of all ports where laws act.
    reference : str or None
        Load place whose stiffness and modal mass are the natural ones; None: that of the first
        trial.
    cache_size : int
        The number of systems that are kept; one of a wing takes 2 MB.
    """

    port_rows: Mapping[str, FloatArray]
    reference: str | None = None
    cache_size = 64
    kinds = frozenset(TrialKind) - {TrialKind.DRIVEN}

    @cached_property
    def system_in_state(self) -> Callable[[SystemState], LinearSystem]:
        """The function that returns the system in a state: `build_system` with a cache."""
        return lru_cache(self.cache_size)(self.build_system)

    def __getstate__(self) -> dict[str, object]:
        """Return the attributes without caches: a process cannot hand a cache to another one."""
        return {
            name: value for name, value in vars(self).items() if not hasattr(value, "cache_clear")
        }

    # ------------------------------------------------------------ what each kind of model defines

    @abstractmethod
    def build_system(self, state: SystemState) -> LinearSystem:
        """Assemble and return the linear system in a state.

        `system_in_state` does the same with a cache.
        """

    @abstractmethod
    def force_row(
        self, place: Place, state: SystemState, change: ModelPatch = NO_PATCH
    ) -> FloatArray:
        """Return the load (N,) of 1 N at a place, under the load primitives of a patch.

        Parameters
        ----------
        place : str or (float, float)
            The place at which the load acts.
        state : SystemState
            The state of the system.
        change : ModelPatch
            The load primitives that move the place.
        """

    def lift_loads(self, state: SystemState, change: ModelPatch) -> FloatArray:
        """Return the loads (k, N) of the load factor and of its powers 2 .. k in a flight.

        The load primitives of a patch change them.
        """
        raise NotImplementedError

    def loads_and_motions(self, case: PatchedTrial) -> LoadsAndMotions:
        """Return the loads and the prescribed motions in a trial.

        Here the load is a force at the load place, or the lift of a flight. In a static trial, the
        samples of a load's history are its values in the rows of the trial.
        """
        if case.trial.kind is TrialKind.FLIGHT:
            return LoadsAndMotions(self._flight_loads(case), {})
        trial = case.trial
        primitives = case.patch.of(*LOADS)
        direction = self.force_row(trial.load_place, case.state, primitives)
        force = LoadChange.from_patch(primitives).apply_to(trial.force, trial.force)
        load = Load(direction, RecordedHistory(trial.time, force, trial.hold))
        return LoadsAndMotions([load], {})

    def _flight_loads(self, case: PatchedTrial) -> list[Load]:
        """Return the loads of the load factor and its powers in a flight."""
        trial = case.trial
        # An added mass has weight in a flight. In other trials the zero readings are taken with the
        # mass in place, so that its weight does not show.
        primitives = case.patch.of(*LOADS, changes.PointMass)
        loads = []
        for power, direction in enumerate(self.lift_loads(case.state, primitives), start=1):
            history = RecordedHistory(trial.time, trial.load_factor**power, trial.hold)
            loads.append(Load(direction, history))
        return loads

    @abstractmethod
    def output_equations(
        self, case: PatchedTrial, outputs: Outputs, excitation: Excitation | None
    ) -> list[OutputEquation]:
        """Return the equations of outputs under an excitation.

        Parameters
        ----------
        case : PatchedTrial
            The trial and the state of the system.
        outputs : tuple of (str, Quantity)
            Outputs, and the quantity wanted of each.
        excitation : Excitation, optional
            The loads and motions in a dynamic trial; None for a static trial.
        """

    def distributed_scales(
        self, ports: Mapping[str, PortScale], shape: FloatArray
    ) -> dict[str, PortScale]:
        """Return the scales of forces that are distributed over the structure, by name.

        Here there are none. `ports` are the scales of single ports, and `shape` (N,) is that of the
        first mode, empty if springs do not hold the structure.
        """
        return {}

    # ------------------------------------------------------------ trials

    def laws_at_ports(self, parameters: FloatArray, patch: ModelPatch = NO_PATCH) -> PortLaws:
        """Return all laws that act at the ports: the model's own laws and the laws of a patch.

        `parameters` (P,) are values of the model's parameters, which may scale its own laws.
        """
        forces = self.forces_at_ports(self.built_in_laws(parameters) + patch.of(*INTERNAL_FORCES))
        return port_laws(forces, self.port_rows, in_windows=self.follows_windows)

    def patched_trial(
        self, trial: Trial, conditions: Conditions, patch: ModelPatch = NO_PATCH
    ) -> PatchedTrial:
        """Return a trial with its patch and conditions, and the state of the matrices at its start.

        Parameters
        ----------
        trial : Trial
            A trial of any kind.
        conditions : Conditions
            Parameters, initial state, clock and health.
        patch : ModelPatch
            The change of the model, with all primitives that act.
        """
        temperature_rise = float(trial.temperature[0]) if _depends_on_temperature(patch) else 0.0
        state = SystemState(
            parameters=tuple(conditions.parameters.tolist()),
            losses=self.region_losses(trial, conditions.health, patch)[0],
            structure=patch.of(*STRUCTURE),
            temperature_rise=temperature_rise,
        )
        return PatchedTrial(trial, conditions, patch, state)

    def excitation(self, case: PatchedTrial) -> Excitation:
        """Return the excitation of a trial: its loads and prescribed motions, or its release.

        Raises `ModelError` if a force by a formula in time acts in a ring-down.
        """
        trial = case.trial
        initial_state = case.conditions.initial
        excitation = Excitation(
            trial.time, case.conditions.motion_times(trial.time), begins=trial.begins
        )
        if trial.kind is TrialKind.RINGDOWN:
            if len(case.patch.of(PortLoad)):
                raise ModelError(
                    f"The trial {trial.name!r} is a ring-down, which no force with a course in "
                    'time can act on; set kind = "driven" and begins = "unknown".'
                )
            row = self.force_row(trial.load_place, case.state)
            changes_of_load = case.patch.of(changes.LoadOffset, changes.LoadTilt)
            pull = row
            if len(changes_of_load):
                pull = self.force_row(trial.load_place, case.state, changes_of_load)
            point = ReleasePoint(row, pull, require_release(trial))
            return replace(excitation, release=point, initial=initial_state)
        loads, prescribed_motions = self.loads_and_motions(case)
        return replace(
            excitation,
            loads=loads,
            prescribed_motions=prescribed_motions,
            initial=initial_state.ravel(),
        )

    def excited_system(self, case: PatchedTrial) -> ExcitedSystem:
        """Return the linear system in a dynamic trial, and its excitation."""
        excitation = self.excitation(case)
        drives = tuple(excitation.prescribed_motions)
        return ExcitedSystem(self.system_in_state(case.state._replace(drives=drives)), excitation)

    def simulate_motion(self, case: PatchedTrial, laws: PortLaws = NO_LAWS) -> Motion:
        """Simulate a dynamic trial, and return its motion.

        Raises
        ------
        ModelError
            If the motion cannot begin as the trial says, or the model lacks one of its inputs.
        """
        system, excitation = self.excited_system(case)
        trial_text = f"The trial {case.trial.name!r} of {self.name!r}: "
        with ModelError.instead_of(ModelError, FiniteElementError, before=trial_text):
            return simulate_motion(system, excitation, laws, case.conditions.refinement)

    # ------------------------------------------------------------ response

    def _respond(
        self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions
    ) -> Response:
        """Return the outputs of a trial, and for a dynamic trial also their rates.

        The force that acts is (1 + gain) times the recorded one, plus the tare at samples whose
        recorded force is not zero. In a dynamic trial the structure keeps the temperature and the
        damage of the first sample.
        """
        laws = self.laws_at_ports(conditions.parameters, patch)
        case = self.patched_trial(trial, conditions, patch)
        if not trial.is_dynamic:
            return Response(self._outputs_at_rest(case, outputs, laws))
        motion = self.simulate_motion(case, laws)
        return motion.response(self.output_equations(case, outputs, motion.excitation))

    def _outputs_at_rest(self, case: PatchedTrial, outputs: Outputs, laws: PortLaws) -> FloatArray:
        """Return the C outputs in the N rows of a static trial, an (N, C) array.

        The rows are computed in the order of the loading, because dry friction remembers how the
        present load was reached.

        Raises
        ------
        ModelError
            If a law or a force depends on time, if a channel measures a rate, or if there is no
            equilibrium.
        """
        trial = case.trial
        if laws.active_spans or len(case.patch.of(PortLoad)):
            raise ModelError(
                f"The trial {trial.name!r} has no times, but a law or force in time needs them."
            )
        values = np.empty((len(trial.force), len(outputs)))
        # what the laws remember of the loading, and the last load level, from one block to the next
        memory = None
        previous_level = None
        for block in self._loaded_systems(case, outputs):
            rows = block.rows
            with errors_at_rest(trial):
                values[rows], memory = block.system.static_path(
                    block.directions,
                    laws,
                    levels=block.levels[rows],
                    memory=memory,
                    previous_level=previous_level,
                    output_rows=block.output_rows,
                )
            values[rows] += block.constants
            previous_level = block.levels[rows.stop - 1]
        return values

    def _ports_at_rest(self, trial: Trial, outputs: Outputs, conditions: Conditions) -> PortsAtRest:
        """Return the ports in a trial at rest, without laws; a port of a state does not move."""
        case = self.patched_trial(trial, conditions, self.patch.in_trial(trial.name))
        return ports_of_blocks(trial, self._loaded_systems(case, outputs))

    def _loaded_systems(self, case: PatchedTrial, outputs: Outputs) -> Iterator[LoadedSystem]:
        """Yield the linear system of a trial at rest, with loads and outputs, by block of rows."""
        for rows, state in self._rows_by_state(case):
            case_in_state = case._replace(state=state)
            yield LoadedSystem.of_trial(
                case.trial,
                rows,
                self.system_in_state(state),
                self.excitation(case_in_state).load_levels,
                outputs,
                self.output_equations(case_in_state, outputs, None),
            )

    def _rows_by_state(self, case: PatchedTrial) -> Iterator[RowsAtRest]:
        """Yield blocks of consecutive rows of a static trial in which the structure is the same.

        Health and temperature change the structure, so that rows with equal health losses and equal
        temperature can share one set of matrices.

        Yields
        ------
        RowsAtRest
            A slice of rows, and the state of the structure in all of them.
        """
        row_count = len(case.trial.force)
        losses_of_rows = self.region_losses(case.trial, case.conditions.health, case.patch)
        # a single entry holds for all rows
        if len(losses_of_rows) == 1:
            losses_of_rows = losses_of_rows * row_count
        rises_count = _depends_on_temperature(case.patch)
        temperature_rises = case.trial.temperature.tolist() if rises_count else [0.0] * row_count
        start = 0
        for (row_losses, temperature_rise), equal_rows in groupby(
            zip(losses_of_rows, temperature_rises, strict=True)
        ):
            stop = start + len(list(equal_rows))
            state = case.state._replace(losses=row_losses, temperature_rise=temperature_rise)
            yield RowsAtRest(slice(start, stop), state)
            start = stop

    # ------------------------------------------------------------ ports

    def _ported_system(
        self, trial: Trial, outputs: Outputs, parameters: FloatArray
    ) -> PortedSystem:
        """Return the linear system from missing forces to outputs, in the modes at the prior mean.

        A missing force is an unknown force in time. It acts at a port: a place of the structure
        where a force may act. The modes at the prior mean of the parameters are the same for all
        parameters, so that systems at several parameters have the same coordinates.

        Parameters
        ----------
        trial : Trial
            The dynamic trial, with its inputs.
        outputs : tuple of (str, Quantity)
            The outputs that channels measure, and the quantity wanted of each.
        parameters : (P,) array
            Values of the calibrated parameters.
        """
        patch = self.patch.in_trial(trial.name)  # its primitives that act in this trial
        # a dynamic trial is simulated with the stiffness losses at its start
        losses_at_start = trial.health[:1]
        conditions_at_mean = Conditions(self.prior_mean(), health=losses_at_start)
        case_at_mean = self.patched_trial(trial, conditions_at_mean, patch)
        system_at_mean, _ = self.excited_system(case_at_mean)
        case = self.patched_trial(trial, Conditions(parameters, health=losses_at_start), patch)
        system, excitation = self.excited_system(case)
        equations = self.output_equations(case, outputs, excitation)
        return ported_system(system, equations, system_at_mean.shapes)

    def port_motion(
        self, trial: Trial, conditions: Conditions, parts: int = 1
    ) -> tuple[FloatArray, FloatArray]:
        """Return positions and speeds (N, P) of the ports in a dynamic trial, without laws.

        Each interval between samples is divided into `parts`.
        """
        case = self.patched_trial(trial, conditions, self.patch.in_trial(trial.name))
        system, excitation = self.excited_system(case)
        denser_excitation = replace(
            excitation, sample_times=subdivide(excitation.sample_times, parts)
        )
        port_rows = np.array(list(system.ports.values()))
        motion = simulate_motion(system, denser_excitation, NO_LAWS)
        return motion.displacements_and_speeds_at(port_rows)

    # ------------------------------------------------------------ natural sizes and scales

    def initial_state_magnitudes(self, campaign: Campaign, trial: Trial) -> FloatArray:
        """Return typical magnitudes (L,) of the unknown state at the start of a trial.

        See `natural_state_magnitudes`; the motion from rest is that of the prior mean.
        """
        parameters = self.prior_mean(campaign)
        case = self.patched_trial(replace(trial, begins=Start.STILL), Conditions(parameters))
        motion = self.simulate_motion(case, self.laws_at_ports(parameters))
        outputs = campaign.outputs(trial)
        self.check_outputs(outputs)
        equations = self.output_equations(case, outputs, motion.excitation)
        return natural_state_magnitudes(motion, equations, trial)

    def scales(self, campaign: Campaign) -> Scales:
        """Return the natural scales of length, force, frequency and so on under a campaign.

        They hold at the prior mean and without a patch. If springs hold the structure and all
        trials begin at rest, its stiffness and its first mode give the scales. Otherwise the loads
        and motions of the trials do.
        """
        trials = campaign.trials
        parameters = self.prior_mean(campaign)
        state = SystemState(tuple(parameters.tolist()), losses=(0.0,) * len(self.regions))
        system = self.system_in_state(state)
        uncontrolled = self.system_in_state(state._replace(controlled=False))
        port_rows = np.array([uncontrolled.ports[name] for name in self.ports]).reshape(
            len(self.ports), uncontrolled.unknown_count
        )
        is_held = system.mode_count is not None and all(_begins_at_rest(trial) for trial in trials)
        estimator = PortScaleEstimator(uncontrolled, port_rows)
        largest_motion = self._add_trials(estimator, campaign, is_held=is_held)
        # scales of the whole structure
        largest_of_campaign = campaign.largest_magnitudes
        if is_held:
            global_scales = self._scales_of_held_structure(system, state, campaign)
            first_shape = system.shapes[:, 0]
            static_stiffness = [
                1.0 / float(row @ system.equilibrium_under(row[None])[0]) for row in port_rows
            ]
        else:
            global_scales = scales_of_moving_structure(
                system, largest_motion, largest_of_campaign["duration"]
            )
            first_shape = np.zeros(0)
            static_stiffness = [0.0] * len(self.ports)
        only_driven = all(_is_moved_by_inputs(trial) for trial in trials)
        port_scales = estimator.port_scales(static_stiffness, only_driven=only_driven)
        ports = dict(zip(self.ports, port_scales, strict=True))
        farthest_station = max(map(abs, self.stations or (0.0,)))
        return Scales(
            length=self.length or farthest_station or 1.0,
            tip_stiffness=global_scales.stiffness,
            modal_mass=global_scales.mass,
            angular_frequency=global_scales.angular_frequency,
            force=largest_of_campaign["force"] or largest_motion.load,
            load_factor=largest_of_campaign["load_factor"],
            duration=largest_of_campaign["duration"],
            campaign_time=largest_of_campaign["campaign_time"],
            ports=ports | self.distributed_scales(ports, first_shape),
        )

    def _add_trials(
        self, estimator: PortScaleEstimator, campaign: Campaign, *, is_held: bool
    ) -> LargestMotion:
        """Add the motions of all trials to the estimator, and return their largest magnitudes.

        Trials at rest and ring-downs are added by their displacements at rest, and only if springs
        hold the structure (`is_held`). The returned magnitudes are those of trials under recorded
        inputs.
        """
        parameters = self.prior_mean(campaign)
        largest_motion = LargestMotion(0.0, 0.0, 0.0)
        for trial in campaign.trials:
            is_fitted = trial.is_dynamic and not trial.held_out
            if _is_moved_by_inputs(trial):
                motion = self._motion_under_inputs(campaign, trial)
                measured_force = largest_measured_force(campaign, trial)
                case = self.patched_trial(trial, Conditions(parameters))
                outputs = campaign.outputs(trial)
                self.check_outputs(outputs)
                equations = self.output_equations(case, outputs, motion.excitation)
                readings = displacement_readings(trial, equations)
                loads = estimator.add_motion(motion, measured_force, readings, is_fitted=is_fitted)
                # from modal coordinates (N, M + P) to the displacements of the structure
                shapes = motion.system.shapes_with_drives[: motion.system.displacement_count].T
                largest_motion = LargestMotion(
                    displacement=larger_magnitude(largest_motion.displacement, motion.q @ shapes),
                    speed=larger_magnitude(largest_motion.speed, motion.velocity @ shapes),
                    load=larger_magnitude(largest_motion.load, loads),
                )
            elif is_held:
                case = self.patched_trial(trial, Conditions(parameters))
                estimator.add_displacements(self._static_displacements(case), is_fitted=is_fitted)
        return largest_motion

    def _scales_of_held_structure(
        self, system: LinearSystem, state: SystemState, campaign: Campaign
    ) -> GlobalScales:
        """Return stiffness, mass and frequency scales of a structure that is held by springs.

        Stiffness and mass are those at a load place: the reference of the model, or else the load
        place of the first trial, or else the first load place of the model.
        """
        places = [*(trial.load_place for trial in campaign.trials), *(self.load_places or ())]
        load_row = self.force_row(self.reference or places[0], state)
        (displacements,) = system.equilibrium_under(load_row[None])
        static_deflection = float(load_row @ displacements)
        # Mass of the first mode, referred to the load point: its shape is scaled to a modal mass of
        # 1, so a unit displacement of the load point needs the modal coordinate 1 / (row . shape).
        shape_at_load = float(load_row @ system.shapes[:, 0])
        # If the first mode does not move the load point, the trace of the mass matrix has the right
        # order of magnitude.
        mass_at_load = 1.0 / shape_at_load**2 if shape_at_load else float(np.trace(system.mass))
        return GlobalScales(
            stiffness=1.0 / static_deflection,
            mass=mass_at_load,
            angular_frequency=float(system.angular_frequency[0]),
        )

    def _motion_under_inputs(self, campaign: Campaign, trial: Trial) -> Motion:
        """Return the motion of a trial under its recorded inputs, at the prior mean.

        If the start that the trial states cannot be computed, the motion begins at rest. If nothing
        moves, the structure was released by hand, and the motion begins with the typical magnitudes
        of an unknown initial state.
        """
        conditions = Conditions(self.prior_mean(campaign))
        laws = self.laws_at_ports(conditions.parameters)
        try:
            motion = self.simulate_motion(self.patched_trial(trial, conditions), laws)
        except ModelError:  # such as for the equilibrium of a free structure
            trial_from_rest = replace(trial, begins=Start.STILL)
            motion = self.simulate_motion(self.patched_trial(trial_from_rest, conditions), laws)
        if not np.any(motion.q) and not np.any(motion.velocity):
            magnitudes = self.initial_state_magnitudes(campaign, trial)
            released_trial = self.patched_trial(trial, replace(conditions, initial=magnitudes))
            motion = self.simulate_motion(released_trial, laws)
        return motion

    def _static_displacements(self, case: PatchedTrial) -> FloatArray:
        """Return the displacements (L, N) of all N unknowns of a structure at rest.

        The L rows are those of a static trial. A ring-down has a single row: the shape in which the
        structure is held before its release.
        """
        system = self.system_in_state(case.state)
        excitation = self.excitation(case)
        release_point = excitation.release
        if release_point is None:
            directions, levels = excitation.load_levels  # (D, N) and (L, D) for D loads
            return np.asarray(levels @ system.equilibrium_under(directions))
        # Compute the shape under a unit force at the release point, and scale it so that this point
        # has its stated displacement. The row is both the direction of the force and, times the
        # displacements, the displacement of the point.
        row = release_point.row  # (N,)
        shape_under_unit_force = system.equilibrium_under(row[None])  # (1, N)
        displacement_under_unit_force = float(row @ shape_under_unit_force[0])
        stated_displacement = release_point.release.displacement
        return np.asarray(
            stated_displacement / displacement_under_unit_force * shape_under_unit_force
        )


def _depends_on_temperature(patch: ModelPatch) -> bool:
    """Return whether a patch makes the structure depend on temperature."""
    return len(patch.of(changes.ModulusTemperature)) > 0


def _is_moved_by_inputs(trial: Trial) -> bool:
    """Return whether a trial is a motion under recorded inputs, not a release or at rest."""
    return trial.is_dynamic and trial.kind is not TrialKind.RINGDOWN


def _begins_at_rest(trial: Trial) -> bool:
    """Return whether only forces move the structure in a trial, from rest."""
    return trial.kind is not TrialKind.DRIVEN and trial.begins is Start.SETTLED
