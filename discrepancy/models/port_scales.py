"""What acts and moves at ports in a campaign, by a model of matrices, and the natural scales from it."""

from collections.abc import Iterator, Sequence

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.models.linear_system import LinearSystem
from discrepancy.models.motion import Motion
from discrepancy.models.scales import PortScale

FORCES = 5.0
"""Force scale of a port that no stiffness holds over the rms of the forces there: friction of 1 to 25 % of
what acts is in the middle of its prior, and drag of as much at the largest speed."""
TURNS = 1e-3
"""Share of the largest speed of a port that both directions must reach, for a motion that turns."""


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
        least = TURNS * np.max(np.abs(speed), axis=0)
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
