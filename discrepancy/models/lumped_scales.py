"""Natural scales of a lumped rig under a campaign: what acts and moves where the structure has none."""

from dataclasses import replace

import numpy as np

from discrepancy.campaign.records import Campaign, FloatArray, Quantity, Start, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.interface import Conditions, PortScale, Scales, campaign_sizes
from discrepancy.models.lumped_rig import LumpedRig
from discrepancy.models.second_order import Motion


def state_sizes(lumped: LumpedRig, campaign: Campaign, trial: Trial, conditions: Conditions) -> FloatArray:
    """Return natural sizes (L,) of a state at the begin of a trial: of motion from rest, and of data."""
    moved = lumped.moved(trial, conditions, lumped.own_laws, still=True)
    rig = moved.system
    count, moving = len(rig.angular_frequency), rig.moving
    x, v = (np.max(np.abs(item[:, :count]), axis=0) for item in (moved.q, moved.velocity))
    pace = np.maximum(rig.angular_frequency[:moving], 1.0 / float(trial.time[-1] - trial.time[0]))
    n, shapes = rig.displacements, rig.shapes
    channels = [campaign.channels[name] for name in trial.channels]
    shown = lumped.shown([(channel.output, channel.quantity) for channel in channels], moved.acting)
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
    lumped : LumpedRig
        The model at its prior mean.
    driven_only : bool
        Whether all trials are followed in time from known inputs, so that what was not seen to turn does not.
    """

    def __init__(self, lumped: LumpedRig, *, driven_only: bool = False) -> None:
        self._open, self._driven_only = lumped.system(closed=False), driven_only
        self.rows = np.array(list(self._open.ports.values())).reshape(-1, lumped.width)
        self._turns, self._follows = np.zeros(len(self.rows), bool), np.ones(len(self.rows), bool)
        self._sizes = np.zeros((3, len(self.rows)))
        self._squares: list[FloatArray] = []
        self._counts: list[int] = []

    def add(self, motion: Motion, measured: float, fitted: bool) -> None:
        """Take up the motion of a trial, and the largest force that was measured in it [N]."""
        system, shapes = motion.system, motion.system.shapes
        free, modal = shapes.shape[1], self.rows @ system.all_shapes
        pushed = (
            motion.acceleration[:, :free] @ (system.mass @ shapes).T,
            motion.velocity[:, :free] @ (self._open.damping @ shapes).T,
            motion.acting.load_at(motion.time, np.eye(len(system.mass))),
        )
        # modal force along the port, over what a unit force there gives
        lent = np.sum((self.rows @ shapes) ** 2, axis=1)
        along = shapes @ (shapes.T @ self.rows.T) / np.where(lent > 0.0, lent, 1.0)
        largest = np.max([np.mean((item @ along) ** 2, axis=0) for item in pushed], axis=0)
        self._squares.append(np.where(lent > 0.0, largest, (measured / FORCES) ** 2))
        self._counts.append(len(motion.time))
        self._follows &= lent == 0.0
        speed = motion.velocity @ modal.T
        self.see(motion.q @ modal.T, fitted, speed)
        least = TURNS * np.max(np.abs(speed), axis=0)
        self._turns |= (np.min(speed, axis=0) < -least) & (np.max(speed, axis=0) > least)

    def see(self, position: FloatArray, fitted: bool, speed: FloatArray | None = None) -> None:
        """Take up where the ports were (N, P), and their speeds."""
        x = np.max(np.abs(position), axis=0)
        v = 0.0 * x if speed is None else np.max(np.abs(speed), axis=0)
        self._sizes = np.maximum(self._sizes, (x * fitted, x, v))

    def scale(self, name: str) -> PortScale:
        """Return the natural scales of a port."""
        rig, number = self._open, list(self._open.ports).index(name)
        usual, largest, speed = self._sizes[:, number].tolist()
        along = (rig.ports[name] @ rig.shapes)[: rig.moving]
        frequency, weight = rig.angular_frequency[: rig.moving], along**2
        seen = weight > 1e-6 * float(weight.sum())
        amount = usual or largest or 1.0
        squares = [square[number] for square in self._squares]
        force = FORCES * float(np.sqrt(np.average(squares, weights=self._counts))) if squares else 0.0
        if np.any(seen) and np.all(frequency[seen] > 0.0):
            first = int(np.flatnonzero(seen)[0])
            still = 1.0 / float(np.sum(weight[seen] / frequency[seen] ** 2))
            if self._driven_only and self._follows[number] and force > 0.0 < speed:
                return PortScale(
                    amount, force / amount, speed / amount, still, largest or amount, driven=True
                )
            w = float(frequency[first])
            return PortScale(amount, w**2 / float(weight[first]), w, still, largest or 1.0)
        free = not np.any(frequency[seen] > 0.0)
        of_state = not np.any(rig.ports[name][: rig.displacements])
        return PortScale(
            amount, (force or 1.0) / amount, (speed or 1.0) / amount, None, largest or amount,
            free=free, turns=bool(self._turns[number]) or not (free and self._driven_only and np.any(seen)),
            of_state=of_state,
        )  # fmt: skip


def lumped_scales(
    lumped: LumpedRig, parameters: FloatArray, campaign: Campaign, stations: tuple[float, float] | None
) -> Scales:
    """Return the natural scales of a lumped model under a campaign, at its prior mean.

    A structure that springs hold, which only forces move from rest, has scales of its own; for others what
    acts and moves is the measure.
    """
    trials, description, system = campaign.trials, lumped.description, lumped.system()
    driven_only = all(trial.is_dynamic and trial.kind is not TrialKind.RINGDOWN for trial in trials)
    held = description.is_plain and all(
        trial.kind is not TrialKind.DRIVEN and trial.begins is Start.SETTLED for trial in trials
    )
    conditions, ports = Conditions(parameters), PortSizes(lumped, driven_only=driven_only)
    peak, speed, weight = 0.0, 0.0, 0.0
    for trial in trials:
        if held and trial.kind in (TrialKind.STATIC, TrialKind.RINGDOWN):
            ports.see(lumped.held(trial) @ ports.rows.T, trial.is_dynamic and not trial.held_out)
        if not trial.is_dynamic or trial.kind is TrialKind.RINGDOWN:
            continue
        try:
            motion = lumped.moved(trial, conditions, lumped.own_laws)
        except ModelError:
            motion = lumped.moved(trial, conditions, lumped.own_laws, still=True)
        if not np.any(motion.q) and not np.any(motion.velocity):  # nothing drives it: it was let go
            sizes_of_state = state_sizes(lumped, campaign, trial, conditions)
            motion = lumped.moved(trial, replace(conditions, initial=sizes_of_state), lumped.own_laws)
        pushes = [
            float(np.max(np.abs(trial.values[trial.used[:, column], column]), initial=0.0))
            for column, name in enumerate(trial.channels)
            if campaign.channels[name].quantity in (Quantity.FORCE, Quantity.TORQUE)
        ]
        ports.add(motion, max(pushes, default=0.0), not trial.held_out)
        shapes = motion.system.all_shapes.T[:, : description.size]
        peak = max(peak, float(np.max(np.abs(motion.q @ shapes), initial=0.0)))
        speed = max(speed, float(np.max(np.abs(motion.velocity @ shapes), initial=0.0)))
        weight = max(weight, float(np.max(np.abs(motion.acting.load_at(motion.time, np.eye(lumped.width))))))
    sizes = campaign_sizes(campaign)
    if held:
        loaded = next((trial.load_place for trial in trials if trial.kind is not TrialKind.FLIGHT), None)
        row = lumped.moved_row(description.input[0] if loaded is None else lumped.input_at(loaded))
        frequency = float(system.angular_frequency[0])
        participation = float(row @ system.shapes[:, 0]) ** 2
        mass = 1.0 / participation if participation else float(np.trace(description.whole("mass")))
        stiffness = 1.0 / float(row @ system.flexibility(row))
    else:
        elastic = system.angular_frequency[system.angular_frequency > 0.0]
        usual = speed / peak if peak > 0.0 < speed else 1.0 / sizes["duration"]
        frequency = float(elastic[0]) if len(elastic) else usual
        mass = float(np.trace(system.mass)) / max(len(system.mass), 1)
        stiffness = weight / peak if peak > 0.0 < weight else mass * frequency**2
    return Scales(
        **{**sizes, "force": sizes["force"] or weight},
        length=description.characteristic_length or (max(map(abs, stations)) if stations else 0.0) or 1.0,
        tip_stiffness=stiffness,
        modal_mass=mass,
        angular_frequency=frequency,
        ports={item.name: ports.scale(item.name) for item in description.port},
    )
