"""Natural scales of ports under a campaign: what acts and moves where the structure of a model has none."""

from collections.abc import Sequence

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.models.linear_system import LinearSystem
from discrepancy.models.scales import PortScale
from discrepancy.models.second_order import Motion

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
        self._sizes, self._squares, self._count = np.zeros((3, len(names))), np.zeros(len(names)), 0

    def add(self, motion: Motion, measured: float, fitted: bool) -> None:
        """Take up the motion of a trial, and the largest force that was measured in it [N]."""
        system, names = motion.system, list(motion.system.ports)
        at = [names.index(name) for name in self._names]
        position, speed = (item[:, at] for item in motion.at_ports)
        self.see(position, speed, fitted)
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
        self._squares += len(motion.time) * np.where(lent > 0.0, largest, (measured / FORCES) ** 2)
        self._count += len(motion.time)
        self._follows &= lent == 0.0

    def see(self, position: FloatArray, speed: FloatArray, fitted: bool) -> None:
        """Take up where the ports were (N, P), and their speeds."""
        x, v = (np.max(np.abs(item), axis=0, initial=0.0) for item in (position, speed))
        self._sizes = np.maximum(self._sizes, (x * fitted, x, v))

    def scale(self, number: int, still: float) -> PortScale:
        """Return the natural scales of a port of a stiffness at rest."""
        bare, row = self._bare, self._bare.ports[self._names[number]]
        usual, largest, speed = self._sizes[:, number].tolist()
        frequency = bare.angular_frequency[: bare.moving]
        weight = (row @ bare.shapes)[: bare.moving] ** 2
        seen = weight > 1e-6 * float(weight.sum())
        amount = usual or largest or 1.0
        force = FORCES * float(np.sqrt(self._squares[number] / max(self._count, 1)))
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
