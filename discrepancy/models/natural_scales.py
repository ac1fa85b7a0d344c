"""Natural scales of a model under a campaign: what acts and moves where its structure has none."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from discrepancy.campaign.records import Campaign, FloatArray, Quantity, Start, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.interface import Conditions, PortScale, Scales, campaign_sizes
from discrepancy.models.linear_system import LinearSystem
from discrepancy.models.questions import prior_mean
from discrepancy.models.second_order import Motion
from discrepancy.models.system_model import Case, State, SystemModel


def state_sizes(model: SystemModel, campaign: Campaign, trial: Trial, conditions: Conditions) -> FloatArray:
    """Return natural sizes (L,) of a state at the begin of a trial: of motion from rest, and of data."""
    moved = model.moved(model.case(trial, conditions), model.laws(conditions.parameters), still=True)
    rig = moved.system
    count, moving = len(rig.angular_frequency), rig.moving
    x, v = (np.max(np.abs(item[:, :count]), axis=0) for item in (moved.q, moved.velocity))
    pace = np.maximum(rig.angular_frequency[:moving], 1.0 / float(trial.time[-1] - trial.time[0]))
    n, shapes = rig.displacements, rig.shapes
    channels = [campaign.channels[name] for name in trial.channels]
    outputs = tuple((channel.output, channel.quantity) for channel in channels)
    shown = model.shown(model.case(trial, conditions), outputs, moved.acting)
    for column, item in enumerate(shown):
        kept = trial.values[trial.used[:, column], column] - item.constant
        if item.reaction is not None or item.speed is not None or not kept.size:
            continue
        size = float(np.max(np.abs(kept)))
        of_u, of_x = item.row[:n] @ shapes[:n, :moving], item.row[n:] @ shapes[n:, moving:]
        if np.any(of_u):
            at = size / float(np.linalg.norm(of_u)) / pace**item.order
            x[:moving], v[:moving] = np.maximum(x[:moving], at), np.maximum(v[:moving], at * pace)
        if np.any(of_x):
            v[moving:] = np.maximum(v[moving:], size / float(np.linalg.norm(of_x)))
    found = np.concatenate((x[:moving], v))
    return np.asarray(np.where(found > 0.0, found, max(float(found.max(initial=0.0)), 1e-9)))


FORCES = 5.0
"""Force scale of a port that no stiffness holds over the rms of the forces there: friction of 1 to 25 % of
what acts is in the middle of its prior, and drag of as much at the largest speed."""


TURNS = 1e-3
"""Share of the largest speed of a port that both directions must reach, for a motion that turns."""


class PortSizes:
    """What the ports of a model saw in a campaign, for scales that the structure does not have.

    Where no stiffness of the structure holds a port (that of a controller is none), its force scale is
    `FORCES` times the rms of inertia, damping, own laws and loads there, its displacement and speed the
    largest: effects are measured by what acts and moves. At a port of a state likewise, of flows. Where
    drives alone move a port, no frequency of the structure says how fast: its force scale is the largest
    measured force.

    Parameters
    ----------
    names : sequence of str
        The ports.
    bare : LinearSystem
        The system at the prior mean, without controllers.
    driven_only : bool
        Whether all trials are followed in time from known inputs, so that what was not seen to turn does not.
    """

    def __init__(self, names: Sequence[str], bare: LinearSystem, *, driven_only: bool) -> None:
        self._names, self._bare, self._driven_only = names, bare, driven_only
        self._turns, self._follows = np.zeros(len(names), bool), np.ones(len(names), bool)
        self._sizes = np.zeros((3, len(names)))
        self._squares: list[FloatArray] = []
        self._counts: list[int] = []

    def add(self, motion: Motion, measured: float, fitted: bool) -> None:
        """Take up the motion of a trial, and the largest force that was measured in it [N]."""
        system, names = motion.system, list(motion.system.ports)
        at = [names.index(name) for name in self._names]
        position, speed = (item[:, at] for item in motion.at_ports)
        self.see(position, fitted, speed)
        least = TURNS * np.max(np.abs(speed), axis=0)
        self._turns |= (np.min(speed, axis=0) < -least) & (np.max(speed, axis=0) > least)
        if system.mode_count is not None:
            self._follows[:] = False
            return
        shapes = system.shapes
        rows = np.array([system.ports[name] for name in self._names]).reshape(-1, len(shapes))
        pushed = (
            motion.acceleration[:, : shapes.shape[1]] @ (system.mass @ shapes).T,
            motion.velocity[:, : shapes.shape[1]] @ (self._bare.damping @ shapes).T,
            motion.acting.load_at(motion.time, np.eye(len(system.mass))),
        )
        # modal force along the port, over what a unit force there gives
        lent = np.sum((rows @ shapes) ** 2, axis=1)
        along = shapes @ (shapes.T @ rows.T) / np.where(lent > 0.0, lent, 1.0)
        largest = np.max([np.mean((item @ along) ** 2, axis=0) for item in pushed], axis=0)
        self._squares.append(np.where(lent > 0.0, largest, (measured / FORCES) ** 2))
        self._counts.append(len(motion.time))
        self._follows &= lent == 0.0

    def see(self, position: FloatArray, fitted: bool, speed: FloatArray | None = None) -> None:
        """Take up where the ports were (N, P), and their speeds."""
        x = np.max(np.abs(position), axis=0, initial=0.0)
        v = 0.0 * x if speed is None else np.max(np.abs(speed), axis=0)
        self._sizes = np.maximum(self._sizes, (x * fitted, x, v))

    def scale(self, number: int, still: float) -> PortScale:
        """Return the natural scales of a port of a stiffness at rest."""
        bare, row = self._bare, self._bare.ports[self._names[number]]
        usual, largest, speed = self._sizes[:, number].tolist()
        frequency = bare.angular_frequency[: bare.moving]
        weight = (row @ bare.shapes)[: bare.moving] ** 2
        seen = weight > 1e-6 * float(weight.sum())
        amount = usual or largest or 1.0
        squares = [square[number] for square in self._squares]
        force = FORCES * float(np.sqrt(np.average(squares, weights=self._counts))) if squares else 0.0
        if np.any(seen) and np.all(frequency[seen] > 0.0):
            first = int(np.flatnonzero(seen)[0])
            still = still or 1.0 / float(np.sum(weight[seen] / frequency[seen] ** 2))
            if self._driven_only and self._follows[number] and force > 0.0 < speed:
                return PortScale(
                    amount, force / amount, speed / amount, still, largest or amount, driven=True
                )
            w = float(frequency[first])
            return PortScale(amount, w**2 / float(weight[first]), w, still, largest or 1.0)
        free = not np.any(frequency[seen] > 0.0)
        of_state = not np.any(row[: bare.displacements])
        return PortScale(
            amount, (force or 1.0) / amount, (speed or 1.0) / amount, None, largest or amount,
            free=free, turns=bool(self._turns[number]) or not (free and self._driven_only and np.any(seen)),
            of_state=of_state,
        )  # fmt: skip


def natural_scales(model: SystemModel, campaign: Campaign) -> Scales:
    """Return the natural scales of a model under a campaign, at its prior mean and without a patch.

    A structure that springs hold, which only forces move from rest, has scales of its own; for others what
    acts and moves is the measure.
    """
    trials, parameters = campaign.trials, prior_mean(campaign, model.declared)
    state, names = State(parameters, (0.0,) * len(model.regions)), model.ports()
    system, rest, laws = model.system(state), model.rest(state), model.laws(parameters)
    held = system.mode_count is not None and all(
        trial.kind is not TrialKind.DRIVEN and trial.begins is Start.SETTLED for trial in trials
    )
    driven_only = all(trial.is_dynamic and trial.kind is not TrialKind.RINGDOWN for trial in trials)
    ports = PortSizes(names, model.system(state._replace(closed=False)), driven_only=driven_only)
    rows = np.array([model.port_rows[name] for name in names])
    conditions, peak, speed, weight = Conditions(parameters), 0.0, 0.0, 0.0
    for trial in trials:
        case, fitted = model.case(trial, conditions), trial.is_dynamic and not trial.held_out
        if not trial.is_dynamic or trial.kind is TrialKind.RINGDOWN:
            if held and names:
                ports.see(_held(model, case) @ rows.T, fitted)
            continue
        try:
            motion = model.moved(case, laws)
        except ModelError:
            motion = model.moved(case, laws, still=True)
        if not np.any(motion.q) and not np.any(motion.velocity):  # nothing drives it: it was let go
            initial = state_sizes(model, campaign, trial, conditions)
            motion = model.moved(model.case(trial, replace(conditions, initial=initial)), laws)
        pushes = [
            float(np.max(np.abs(trial.values[trial.used[:, column], column]), initial=0.0))
            for column, name in enumerate(trial.channels)
            if campaign.channels[name].quantity in (Quantity.FORCE, Quantity.TORQUE)
        ]
        ports.add(motion, max(pushes, default=0.0), fitted)
        shapes = motion.system.all_shapes[: model.displacements].T
        peak = max(peak, float(np.max(np.abs(motion.q @ shapes), initial=0.0)))
        speed = max(speed, float(np.max(np.abs(motion.velocity @ shapes), initial=0.0)))
        loads = motion.acting.load_at(motion.time, np.eye(len(motion.acting.constant)))
        weight = max(weight, float(np.max(np.abs(loads))))
    sizes = campaign_sizes(campaign)
    shape, still = np.zeros(0), [0.0] * len(names)
    if held:
        row, shape = model.reference_load(parameters, campaign), system.shapes[:, 0]
        shape = shape if system.basis is None else system.basis @ shape
        still = [1.0 / float(own @ rest.resting(own[None])[0]) for own in rows]
        frequency, participation = float(system.angular_frequency[0]), float(row @ shape) ** 2
        mass = 1.0 / participation if participation else float(np.trace(system.mass))
        stiffness = 1.0 / float(row @ rest.resting(row[None])[0])
    else:
        elastic = system.angular_frequency[system.angular_frequency > 0.0]
        usual = speed / peak if peak > 0.0 < speed else 1.0 / sizes["duration"]
        frequency = float(elastic[0]) if len(elastic) else usual
        mass = float(np.trace(system.mass)) / max(len(system.mass), 1)
        stiffness = weight / peak if peak > 0.0 < weight else mass * frequency**2
    found = {name: ports.scale(number, still[number]) for number, name in enumerate(names)}
    return Scales(
        **{**sizes, "force": sizes["force"] or weight},
        length=model.length or max(map(abs, model.stations() or (0.0,))) or 1.0,
        tip_stiffness=stiffness,
        modal_mass=mass,
        angular_frequency=frequency,
        ports=found | model.spread(found, shape),
    )


def _held(model: SystemModel, case: Case) -> FloatArray:
    """Return the displacements (L, N) in a trial at rest, or from which a ring-down is released."""
    rest = model.rest(case.state)
    if case.trial.is_dynamic:
        let_go = model.acting(case).release
        assert let_go is not None  # of a ring-down there is
        row, release = let_go
        shape = rest.resting(row[None])
        return np.asarray(release.displacement / float(row @ shape[0]) * shape)
    units, amounts = model.acting(case).levels
    return np.asarray(amounts @ rest.resting(units))
