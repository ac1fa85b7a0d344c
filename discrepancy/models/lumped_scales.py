"""Natural scales of a lumped rig under a campaign: what acts and moves where the structure has none."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.records import Campaign, Quantity, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.interface import Conditions, PortScale, Scales
from discrepancy.models.lumped_rig import LumpedRig
from discrepancy.models.rig import RigMotion

FloatArray = NDArray[np.float64]


def state_sizes(lumped: LumpedRig, campaign: Campaign, trial: Trial, conditions: Conditions) -> FloatArray:
    """Return natural sizes (L,) of a state at the begin of a trial: of motion from rest, and of data."""
    rig, _, drives = lumped.acting(trial, conditions, 0.0, 0.0, None)
    count, moving = len(rig.angular_frequency), rig.moving
    moved = lumped.moving(trial, conditions, still=True)
    x, v = (np.max(np.abs(item[:, :count]), axis=0) for item in (moved.q, moved.velocity))
    pace = np.maximum(rig.angular_frequency[:moving], 1.0 / float(trial.time[-1] - trial.time[0]))
    n, shapes = rig.displacements, rig.shapes[:, :count]
    channels = [campaign.channels[name] for name in trial.channels]
    shown = lumped.shown([(channel.output, channel.quantity) for channel in channels], drives)
    for column, item in enumerate(shown):
        kept = trial.values[trial.used[:, column], column] - item.constant
        if item.reaction is not None or item.effort is not None or not kept.size:
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
        self._rig, self._driven_only = lumped.open(), driven_only
        self._turns = dict.fromkeys(self._rig.ports, False)
        self._follows = dict.fromkeys(self._rig.ports, True)
        self._sizes = {name: np.zeros(3) for name in self._rig.ports}
        self._forces: dict[str, list[FloatArray]] = {name: [] for name in self._rig.ports}

    def add(self, motion: RigMotion, measured: float, fitted: bool) -> None:
        """Take up the motion of a trial, and the largest force that was measured in it [N]."""
        rig, free = motion.rig, len(motion.rig.angular_frequency)
        shapes = rig.shapes[:, :free]
        pushed = (
            motion.acceleration[:, :free] @ (rig.mass @ shapes).T,
            motion.velocity[:, :free] @ (self._rig.damping @ shapes).T,
            rig.load_at(motion.acting, motion.time) if self._rig.drives.size == 0 else 0.0,
        )
        for name, row in rig.ports.items():
            modal = row @ rig.shapes
            lent = float((row @ shapes) @ (row @ shapes))
            self._follows[name] &= lent == 0.0
            if lent > 0.0:  # modal force along the port, over what a unit force there gives
                along = shapes @ (shapes.T @ row) / lent
                squares = [np.mean((item @ along) ** 2) for item in pushed if isinstance(item, np.ndarray)]
                force = float(np.sqrt(max(squares)))
            else:
                force = measured / FORCES
            self._forces[name].append(np.array([len(motion.time), force**2]))
            x, v = (float(np.max(np.abs(item @ modal))) for item in (motion.q, motion.velocity))
            self._sizes[name] = np.maximum(self._sizes[name], (x * fitted, x, v))
            speed = motion.velocity @ modal
            self._turns[name] |= bool(np.min(speed) < -TURNS * v and np.max(speed) > TURNS * v)

    def scale(self, name: str) -> PortScale:
        """Return the natural scales of a port."""
        usual, largest, speed = self._sizes[name].tolist()
        rig = self._rig
        along = (rig.ports[name] @ rig.shapes)[: rig.moving]
        frequency, weight = rig.angular_frequency[: rig.moving], along**2
        seen = weight > 1e-6 * float(weight.sum())
        amount = usual or largest or 1.0
        table = np.array(self._forces[name]).reshape(-1, 2)
        force = FORCES * float(np.sqrt(np.average(table[:, 1], weights=table[:, 0]))) if len(table) else 0.0
        if np.any(seen) and np.all(frequency[seen] > 0.0):
            first = int(np.flatnonzero(seen)[0])
            still = 1.0 / float(np.sum(weight[seen] / frequency[seen] ** 2))
            if self._driven_only and self._follows[name] and force > 0.0 < speed:
                return PortScale(
                    amount, force / amount, speed / amount, still, largest or amount, driven=True
                )
            w = float(frequency[first])
            return PortScale(amount, w**2 / float(weight[first]), w, still, largest or 1.0)
        free = not np.any(frequency[seen] > 0.0)
        of_state = not np.any(rig.ports[name][: rig.displacements])
        return PortScale(
            amount, (force or 1.0) / amount, (speed or 1.0) / amount, None, largest or amount,
            free=free, turns=self._turns[name] or not (free and self._driven_only and np.any(seen)),
            of_state=of_state,
        )  # fmt: skip


def rig_scales(
    lumped: LumpedRig, parameters: FloatArray, campaign: Campaign, stations: tuple[float, float] | None
) -> Scales:
    """Return the natural scales of a rig under a campaign, at its prior mean."""
    driven_only = all(trial.is_dynamic and trial.kind is not TrialKind.RINGDOWN for trial in campaign.trials)
    conditions, ports = Conditions(parameters), PortSizes(lumped, driven_only=driven_only)
    rig, description = lumped.rig(), lumped.description
    force, peak, speed, weight = 0.0, 0.0, 0.0, 0.0
    for trial in campaign.trials:
        pushes = [
            float(np.max(np.abs(trial.values[trial.used[:, column], column]), initial=0.0))
            for column, name in enumerate(trial.channels)
            if campaign.channels[name].quantity in (Quantity.FORCE, Quantity.TORQUE)
        ]
        force = max(force, float(np.max(np.abs(trial.force))))
        if not trial.is_dynamic or trial.kind is TrialKind.RINGDOWN:
            continue
        try:
            motion = lumped.moving(trial, conditions)
        except ModelError:
            motion = lumped.moving(trial, conditions, still=True)
        if not np.any(motion.q) and not np.any(motion.velocity):  # nothing drives it: it was let go
            sizes = state_sizes(lumped, campaign, trial, conditions)
            motion = lumped.moving(trial, replace(conditions, initial=sizes))
        ports.add(motion, max(pushes, default=0.0), not trial.held_out)
        here = motion.q @ motion.rig.shapes.T[:, : description.size]
        pace = motion.velocity @ motion.rig.shapes.T[:, : description.size]
        peak = max(peak, float(np.max(np.abs(here), initial=0.0)))
        speed = max(speed, float(np.max(np.abs(pace), initial=0.0)))
        weight = max(weight, float(np.max(np.abs(motion.rig.load_at(motion.acting, motion.time)))))
    dynamic = [trial for trial in campaign.trials if trial.is_dynamic]
    duration = max((float(trial.time[-1] - trial.time[0]) for trial in dynamic), default=1.0)
    elastic = rig.angular_frequency[rig.angular_frequency > 0.0]
    begins = [trial.start + (trial.time[0] if trial.is_dynamic else 0.0) for trial in campaign.trials]
    ends = [trial.start + (trial.time[-1] if trial.is_dynamic else 0.0) for trial in campaign.trials]
    frequency = float(elastic[0]) if len(elastic) else speed / peak if peak > 0.0 < speed else 1.0 / duration
    mass = float(np.trace(rig.mass)) / max(len(rig.mass), 1)
    stiffness = weight / peak if peak > 0.0 < weight else mass * frequency**2
    return Scales(
        length=description.characteristic_length or (max(map(abs, stations)) if stations else 0.0) or 1.0,
        tip_stiffness=stiffness,
        modal_mass=mass,
        angular_frequency=frequency,
        force=force or weight,
        load_factor=0.0,
        duration=duration,
        campaign_time=max(max(ends) - min(begins), 0.0) or 1.0,
        ports={item.name: ports.scale(item.name) for item in description.port},
    )
