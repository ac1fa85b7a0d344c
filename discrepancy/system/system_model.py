"""A model by its matrices, a wing, a structure or a lumped rig: under patches, at rest and in motion."""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np

from discrepancy.campaign.records import Campaign, FloatArray, Quantity, Start, Trial, TrialKind
from discrepancy.errors import ModelError, said
from discrepancy.system.excitation import Acting, Course, Load, LoadChange, Shown, divided, release_of
from discrepancy.system.interface import NO_PATCH, Model
from discrepancy.system.linear_system import LinearSystem
from discrepancy.system.motion import Motion, motion_of
from discrepancy.system.response import Conditions, Outputs, Place, PortedSystem, Response
from discrepancy.system.scales import PortScale, Scales
from fe.runtime import patch as changes
from fe.runtime.errors import FiniteElementError
from fe.runtime.motion import NO_LAWS, Laws, laws_of
from fe.runtime.patch import INTERNAL_FORCES, LOADS, STRUCTURE, ModelPatch, PortLoad
from fe.runtime.state import Losses

FORCES = 5.0
"""Force scale of a port that no stiffness holds over the rms of the forces there: friction of 1 to 25 % of
what acts is in the middle of its prior, and drag of as much at the largest speed."""
BOTH_WAYS = 1e-3
"""Share of the largest speed of a port that both directions must reach, for a motion that turns."""


class State(NamedTuple):
    """What a system depends on.

    Attributes
    ----------
    parameters : tuple of float
        Values (P,) of the model's.
    losses : tuple of float
        Of its damage regions.
    structure : ModelPatch
        What of a patch changes it.
    warmer : float
        Temperature above the reference [K], zero where the structure does not depend on it.
    drives : tuple of str
        Inputs whose motion is prescribed.
    closed : bool
        Whether its controllers act.
    """

    parameters: tuple[float, ...]
    losses: Losses = ()
    structure: ModelPatch = NO_PATCH
    warmer: float = 0.0
    drives: tuple[str, ...] = ()
    closed: bool = True


class Case(NamedTuple):
    """A trial under a patch and in conditions, and the state of the matrices in it."""

    trial: Trial
    conditions: Conditions
    patch: ModelPatch
    state: State


class SystemModel(Model):
    """A model by its matrices (`discrepancy.system.interface.Model`), in N coordinates of its own.

    Attributes
    ----------
    port_rows : mapping of str to (N,) ndarray
        Rows of all ports where laws act.
    reference : str or None
        Place whose stiffness and modal mass are the natural ones; None: that of the first trial.
    kept : int
        Systems that are kept, of a wing 2 MB each.
    """

    port_rows: Mapping[str, FloatArray]
    reference: str | None = None
    kept = 64
    kinds = frozenset(TrialKind) - {TrialKind.DRIVEN}

    @cached_property
    def system(self) -> Callable[[State], LinearSystem]:
        """What gives what moves in a state: `made`, which is kept."""
        return lru_cache(self.kept)(self.made)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what is kept for speed: a process cannot hand it to another one."""
        return {name: value for name, value in vars(self).items() if not hasattr(value, "cache_clear")}

    # ------------------------------------------------------------ what each says

    @abstractmethod
    def made(self, state: State) -> LinearSystem:
        """Return what moves in a state, made anew."""

    @abstractmethod
    def force_row(self, place: Place, state: State, change: ModelPatch = NO_PATCH) -> FloatArray:
        """Return the load (N,) of 1 N at a place, as load primitives have it."""

    def lift(self, state: State, change: ModelPatch) -> FloatArray:
        """Return the loads (k, N) of a load factor and of its powers, as load primitives have them."""
        raise NotImplementedError

    def pushes(self, case: Case) -> tuple[list[Load], dict[str, Course]]:
        """Return loads, and prescribed motions, in a trial; at rest the values of their courses are by row.

        These are a force at a place, or lift.
        """
        trial, _, patch, state = case
        loads = patch.of(*LOADS)
        if trial.kind is TrialKind.FLIGHT:
            # where a mass has weight; other zeros are read with it in place
            rows = self.lift(state, patch.of(*LOADS, changes.PointMass))
            amounts = [trial.load_factor**power for power in range(1, len(rows) + 1)]
        else:
            rows = self.force_row(trial.load_place, state, loads)[None]
            amounts = [LoadChange.of(loads).changed(trial.force, trial.force)]
        courses = [Course(trial.time, values, trial.hold) for values in amounts]
        return list(map(Load, rows, courses)), {}

    @abstractmethod
    def shown(self, case: Case, outputs: Outputs, acting: Acting | None) -> list[Shown]:
        """Return what outputs show under what acts, in its coordinates; None: at rest."""

    def spread(self, ports: Mapping[str, PortScale], shape: FloatArray) -> dict[str, PortScale]:
        """Return the scales of forces that are spread over the structure, by the first mode (N,)."""
        return {}

    # ------------------------------------------------------------ what all do alike

    def laws(self, parameters: FloatArray, patch: ModelPatch = NO_PATCH) -> Laws:
        """Return the laws at its ports, its own and those of a patch."""
        forces = self.at_ports(self.own_laws(parameters) + patch.of(*INTERNAL_FORCES))
        return laws_of(forces, self.port_rows, in_windows=self.follows_windows)

    def case(self, trial: Trial, conditions: Conditions, patch: ModelPatch = NO_PATCH) -> Case:
        """Return a trial as it is at its begin."""
        parameters, structure = tuple(conditions.parameters.tolist()), patch.of(*STRUCTURE)
        warmer = float(trial.temperature[0]) if len(patch.of(changes.ModulusTemperature)) else 0.0
        losses = self.losses(trial, conditions.health)[0]
        return Case(trial, conditions, patch, State(parameters, losses, structure, warmer))

    def acting(self, case: Case) -> Acting:
        """Return what acts in a trial."""
        trial, conditions, patch, state = case
        acting = Acting(trial.time, conditions.stamps(trial.time), begins=trial.begins)
        if trial.kind is TrialKind.RINGDOWN:
            if len(patch.of(PortLoad)):
                raise ModelError(said("models.forced_ringdown", trial=trial))
            release = self.force_row(trial.load_place, state), release_of(trial)
            return replace(acting, release=release, initial=conditions.initial)
        loads, drives = self.pushes(case)
        return replace(acting, loads=loads, drives=drives, initial=conditions.initial.ravel())

    def begun(self, case: Case) -> tuple[LinearSystem, Acting]:
        """Return what moves in a dynamic trial, and what acts on it."""
        acting = self.acting(case)
        return self.system(case.state._replace(drives=tuple(acting.drives))), acting

    def moved(self, case: Case, laws: Laws = NO_LAWS) -> Motion:
        """Return the motion in a dynamic trial.

        Raises
        ------
        ModelError
            If it cannot begin so, or what acts is not the model's.
        """
        system, acting = self.begun(case)
        where = f"The trial {case.trial.name!r} of {self.name!r}: "
        with ModelError.instead_of(ModelError, FiniteElementError, before=where):
            return motion_of(system, acting, laws, case.conditions.refinement)

    def _respond(self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions) -> Response:
        """Return the response of a trial.

        The force of a trial is (1 + gain) times the recorded one, plus the tare where it is not zero. In a
        dynamic trial the structure is that at its first temperature.
        """
        laws, case = self.laws(conditions.parameters, patch), self.case(trial, conditions, patch)
        if not trial.is_dynamic:
            return Response(self._at_rest(case, outputs, laws))
        moved = self.moved(case, laws)
        return moved.seen(self.shown(case, outputs, moved.acting))

    def _at_rest(self, case: Case, outputs: Outputs, laws: Laws) -> FloatArray:
        """Return what is shown at rest; rows of one structure that follow one another go together."""
        trial, conditions, patch, first = case
        if laws.spans or len(patch.of(PortLoad)):
            raise ModelError(f"The trial {trial.name!r} has no time, which a law or force in time asks for.")
        count, losses = len(trial.force), self.losses(trial, conditions.health)
        losses = losses * count if len(losses) == 1 else losses
        warmer = trial.temperature.tolist() if len(patch.of(changes.ModulusTemperature)) else [0.0] * count
        values = np.empty((count, len(outputs)))
        memory, before, start = None, None, 0
        for (lost, warm), group in groupby(zip(losses, warmer, strict=True)):
            rows = slice(start, start + len(list(group)))
            case = case._replace(state=first._replace(losses=lost, warmer=warm))
            shown = self.shown(case, outputs, None)
            units, amounts = self.acting(case).levels
            system, given = self.system(case.state), amounts[rows]
            n = system.displacements
            for (_, quantity), item in zip(outputs, shown, strict=True):
                if np.any(item.rows[2:, n:]) or (quantity.order > 0 and np.any(item.rows[1:, :n])):
                    raise ModelError(said("models.speed_at_rest", trial=trial))
            seen = np.array([np.concatenate((item.rows[0, :n], item.rows[1, n:])) for item in shown])
            where = f"The trial {trial.name!r} is at rest, but "
            with ModelError.instead_of(ModelError, FiniteElementError, before=where):
                values[rows], memory = system.static(units, laws, given, memory, before, seen=seen)
            values[rows] += [item.constant for item in shown]
            before, start = amounts[rows.stop - 1], rows.stop
        return values

    # ------------------------------------------------------------ ports

    def _ported(self, trial: Trial, outputs: Outputs, parameters: FloatArray) -> PortedSystem:
        """Return the system by which outputs see missing forces, in the modes of the prior means."""
        patch = self.patch.in_trial(trial.name)
        at_mean, case = (
            self.case(trial, Conditions(values, health=trial.health[:1]), patch)
            for values in (self.prior_mean(), parameters)
        )
        (base, _), (system, acting) = map(self.begun, (at_mean, case))
        return system.seen_by(self.shown(case, outputs, acting), base.shapes)

    def port_motion(
        self, trial: Trial, conditions: Conditions, parts: int = 1
    ) -> tuple[FloatArray, FloatArray]:
        """Return positions and speeds (N, P) of the ports in a dynamic trial, without laws."""
        system, acting = self.begun(self.case(trial, conditions, self.patch.in_trial(trial.name)))
        moved = motion_of(system, replace(acting, sampled=divided(acting.sampled, parts)), NO_LAWS)
        return moved.at(np.array(list(self.port_rows.values())))

    # ------------------------------------------------------------ sizes

    def initial_sizes(self, campaign: Campaign, trial: Trial) -> FloatArray:
        """Return natural sizes (L,) of a state at the begin of a trial: of motion from rest, and of data."""
        parameters = self.prior_mean(campaign)
        case = self.case(replace(trial, begins=Start.STILL), Conditions(parameters))
        moved = self.moved(case, self.laws(parameters))
        rig = moved.system
        count, moving = len(rig.angular_frequency), rig.moving
        x, v = (np.max(np.abs(item[:, :count]), axis=0) for item in (moved.q, moved.velocity))
        pace = np.maximum(rig.angular_frequency[:moving], 1.0 / float(trial.time[-1] - trial.time[0]))
        outputs = campaign.outputs(trial)
        self.check_outputs(outputs)
        for column, item in enumerate(self.shown(case, outputs, moved.acting)):
            kept = trial.values[trial.used[:, column], column] - item.constant
            if item.courses is not None or not kept.size:
                continue
            size, rows = float(np.max(np.abs(kept))), item.rows @ rig.shapes
            of_u, of_x, order = rows[:, :moving], rows[:, moving:], np.argmax(np.any(rows, axis=1))
            if np.any(of_u):
                at = size / float(np.linalg.norm(of_u)) / pace**order
                x[:moving], v[:moving] = np.maximum(x[:moving], at), np.maximum(v[:moving], at * pace)
            if np.any(of_x):
                v[moving:] = np.maximum(v[moving:], size / float(np.linalg.norm(of_x)))
        found = np.concatenate((x[:moving], v))
        return np.asarray(np.where(found > 0.0, found, max(float(found.max(initial=0.0)), 1e-9)))

    def scales(self, campaign: Campaign) -> Scales:
        """Return the natural scales of a model under a campaign, at its prior mean and without a patch.

        A structure that springs hold, which only forces move from rest, has scales of its own; for others
        what acts and moves is the measure.
        """
        trials, parameters, names = campaign.trials, self.prior_mean(campaign), self.ports
        state = State(tuple(parameters.tolist()), (0.0,) * len(self.regions))
        system, bare = self.system(state), self.system(state._replace(closed=False))
        rows = np.array([self.port_rows[name] for name in names]).reshape(len(names), len(bare.mass))
        held = system.mode_count is not None and all(
            trial.kind is not TrialKind.DRIVEN and trial.begins is Start.SETTLED for trial in trials
        )
        ports, largest, driven_only = Ports(bare, rows), np.zeros(3), True
        for trial in trials:
            fitted = trial.is_dynamic and not trial.held_out
            if trial.is_dynamic and trial.kind is not TrialKind.RINGDOWN:
                motion = self._driven(campaign, trial)
                loads = ports.follow(motion, _measured(campaign, trial), fitted=fitted)
                shapes = motion.system.all_shapes[: motion.system.displacements].T
                felt = motion.q @ shapes, motion.velocity @ shapes, loads
                largest = np.maximum(largest, [np.max(np.abs(item), initial=0.0) for item in felt])
                continue
            driven_only = False
            if held:
                ports.rest(self._held(self.case(trial, Conditions(parameters))), fitted=fitted)
        (peak, speed, weight), sizes = largest.tolist(), campaign.sizes
        shape, stiff = np.zeros(0), np.zeros(len(names))
        if held:
            known = [*(trial.load_place for trial in trials), *(self.load_places or ())]
            row, shape = self.force_row(self.reference or known[0], state), system.shapes[:, 0]
            stiff = np.array([1.0 / float(own @ system.resting(own[None])[0]) for own in rows])
            frequency, participation = float(system.angular_frequency[0]), float(row @ shape) ** 2
            mass = 1.0 / participation if participation else float(np.trace(system.mass))
            stiffness = 1.0 / float(row @ system.resting(row[None])[0])
        else:
            elastic = system.angular_frequency[system.angular_frequency > 0.0]
            usual = speed / peak if peak > 0.0 < speed else 1.0 / sizes["duration"]
            frequency = float(elastic[0]) if len(elastic) else usual
            mass = float(np.trace(system.mass)) / max(len(system.mass), 1)
            stiffness = weight / peak if peak > 0.0 < weight else mass * frequency**2
        found = dict(zip(names, ports.scales(stiff.tolist(), driven_only=driven_only), strict=True))
        return Scales(
            **{**sizes, "force": sizes["force"] or weight},
            length=self.length or max(map(abs, self.stations or (0.0,))) or 1.0,
            tip_stiffness=stiffness, modal_mass=mass, angular_frequency=frequency,
            ports=found | self.spread(found, shape),
        )  # fmt: skip

    def _driven(self, campaign: Campaign, trial: Trial) -> Motion:
        """Return the motion of a trial under recorded inputs, as far as these tell it."""
        conditions = Conditions(self.prior_mean(campaign))
        laws = self.laws(conditions.parameters)
        try:
            motion = self.moved(self.case(trial, conditions), laws)
        except ModelError:
            motion = self.moved(self.case(replace(trial, begins=Start.STILL), conditions), laws)
        if not np.any(motion.q) and not np.any(motion.velocity):  # nothing drives it: it was let go
            initial = self.initial_sizes(campaign, trial)
            motion = self.moved(self.case(trial, replace(conditions, initial=initial)), laws)
        return motion

    def _held(self, case: Case) -> FloatArray:
        """Return the displacements (L, N) in a trial at rest, or from which a ring-down is released."""
        rest, acting = self.system(case.state).resting, self.acting(case)
        if acting.release is None:
            units, amounts = acting.levels
            return np.asarray(amounts @ rest(units))
        row, release = acting.release
        shape = rest(row[None])
        return np.asarray(release.displacement / float(row @ shape[0]) * shape)


def _measured(campaign: Campaign, trial: Trial) -> float:
    """Return the largest force measured in a trial [N]."""
    forces = [
        campaign.channels[name].quantity in (Quantity.FORCE, Quantity.TORQUE) for name in trial.channels
    ]
    return float(np.max(np.abs(trial.values), where=trial.used & np.array(forces, bool), initial=0.0))


class Ports:
    """What acts and moves at ports in a campaign, one trial after the other.

    Where no stiffness of the structure holds a port (that of a controller is none), its force scale is
    `FORCES` times the rms of inertia, damping, own laws and loads there, its displacement and speed the
    largest: effects are measured by what acts and moves. At a port of a state likewise, of flows. Where
    drives alone move a port, no frequency of the structure says how fast: its force scale is the largest
    measured force.

    Parameters
    ----------
    bare : LinearSystem
        The system at the prior mean, without controllers.
    rows : (P, N) ndarray
        Of the ports.
    """

    def __init__(self, bare: LinearSystem, rows: FloatArray) -> None:
        self.bare, self.rows, count = bare, rows, len(rows)
        self.sizes, self.squares, self.count = np.zeros((3, count)), np.zeros(count), 0
        self.turned, self.follows = np.zeros(count, bool), np.ones(count, bool)

    def rest(self, displacements: FloatArray, *, fitted: bool) -> None:
        """Add displacements (L, N) at rest, or after a release."""
        x = np.max(np.abs(displacements @ self.rows.T), axis=0)
        self.sizes = np.maximum(self.sizes, (x * fitted, x, 0.0 * x))

    def follow(self, motion: Motion, measured: float, *, fitted: bool) -> FloatArray:
        """Add a motion and the largest force measured in it [N]; return the loads (N, n) in it."""
        system, shapes = motion.system, motion.system.shapes
        position, speed = motion.at(self.rows)
        x, v = (np.max(np.abs(item), axis=0, initial=0.0) for item in (position, speed))
        self.sizes = np.maximum(self.sizes, (x * fitted, x, v))
        least = BOTH_WAYS * np.max(np.abs(speed), axis=0)
        self.turned |= (np.min(speed, axis=0) < -least) & (np.max(speed, axis=0) > least)
        pushed = (
            motion.acceleration[:, : shapes.shape[1]] @ (system.mass @ shapes).T,
            motion.velocity[:, : shapes.shape[1]] @ (self.bare.damping @ shapes).T,
            motion.acting.load_at(motion.time, np.eye(len(system.mass))),
        )
        # modal force along the port, over what a unit force there gives
        lent = np.sum((self.rows @ shapes) ** 2, axis=1)
        along = shapes @ (shapes.T @ self.rows.T) / np.where(lent > 0.0, lent, 1.0)
        largest = np.max([np.mean((item @ along) ** 2, axis=0) for item in pushed], axis=0)
        self.squares += len(motion.time) * np.where(lent > 0.0, largest, (measured / FORCES) ** 2)
        self.count += len(motion.time)
        self.follows &= lent == 0.0
        return pushed[-1]

    def scales(self, still: Sequence[float], *, driven_only: bool) -> Iterator[PortScale]:
        """Yield the scale of each port.

        `still` are their stiffnesses at rest, zero where the modes tell it. Where all trials are followed in
        time from known inputs (`driven_only`), what was not seen to turn does not.
        """
        bare, forces = self.bare, FORCES * np.sqrt(self.squares / max(self.count, 1))
        frequency = bare.angular_frequency[: bare.moving]
        for number, (row, stiff, force) in enumerate(zip(self.rows, still, forces.tolist(), strict=True)):
            usual, most, pace = self.sizes[:, number].tolist()
            weight = (row @ bare.shapes)[: bare.moving] ** 2
            holds = weight > 1e-6 * float(weight.sum())
            size, free = usual or most or 1.0, not np.any(frequency[holds] > 0.0)
            if np.any(holds) and np.all(frequency[holds] > 0.0):
                stiff = stiff or 1.0 / float(np.sum(weight[holds] / frequency[holds] ** 2))
                w, of_mode = float(frequency[holds][0]), float(weight[holds][0])
                if driven_only and self.follows[number] and force > 0.0 < pace:
                    yield PortScale(size, force / size, pace / size, stiff, most or size, driven=True)
                else:
                    yield PortScale(size, w**2 / of_mode, w, stiff, most or 1.0)
                continue
            yield PortScale(
                size, (force or 1.0) / size, (pace or 1.0) / size, None, most or size, free=free,
                turns=bool(self.turned[number]) or not (free and driven_only and np.any(holds)),
                of_state=not np.any(row[: bare.displacements]),
            )  # fmt: skip
