"""What acts on a system in a trial: loads, prescribed motions, a release and the initial state."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import FloatArray, Hold, Start
from discrepancy.system.time_history import LoadHistory, RecordedHistory


class Load(NamedTuple):
    """A load in a fixed direction.

    Attributes
    ----------
    direction : (N,) ndarray
        The load on the unknowns for a value of one.
    history : LoadHistory
        The values of the load over time.
    derivative : int
        How many times the history is differentiated in time.
    """

    direction: FloatArray
    history: LoadHistory
    derivative: int = 0

    def values_at(self, time: FloatArray) -> FloatArray:
        """Return the values (T,) of the load at T times [s]."""
        return self.history.values_at(time, self.derivative)


class LoadLevels(NamedTuple):
    """The loads of a static trial.

    Attributes
    ----------
    directions : (k, N) ndarray
        The load on all unknowns for a value of one of each of k loads.
    values : (L, k) ndarray
        The values of these loads in each row of the trial.
    """

    directions: FloatArray
    values: FloatArray


@dataclass(frozen=True)
class ReleasePoint:
    """How a structure is let go, and where.

    Attributes
    ----------
    row : (n,) ndarray
        row . u is the displacement of the release point.
    pull : (n,) ndarray
        The load of a unit of the force that holds the structure: the row, unless the force acts at
        another point or in another direction.
    release : Release
        The displacement of the release point, and whether the motion begins at rest.
    """

    row: FloatArray
    pull: FloatArray
    release: Release


@dataclass(frozen=True)
class Excitation:
    """What acts in a trial.

    Attributes
    ----------
    time : (N,) ndarray
        The stamps of the inputs [s].
    sample_times : (S,) ndarray
        Times at which the samples show the motion [s].
    loads : sequence of Load
        The forces and flows that act on the system.
    prescribed_motions : mapping of str to RecordedHistory
        The prescribed motions by the names of their inputs, in the order of `LinearSystem.drives`.
    begins : Start
        How the motion begins, unless it is a release.
    initial : (L,) or (R, 2) ndarray
        The unknown state at the first stamp: displacements of the modes, their speeds, then the
        states. Of a release as in `Conditions.initial`; rows beyond the modes are ignored.
    release : ReleasePoint, optional
        For a ring-down, how the structure is let go.
    """

    time: FloatArray
    sample_times: FloatArray
    loads: Sequence[Load] = ()
    prescribed_motions: Mapping[str, RecordedHistory] = field(default_factory=dict)
    begins: Start = Start.SETTLED
    initial: FloatArray = field(default_factory=lambda: np.zeros(0))
    release: ReleasePoint | None = None

    @property
    def jump_times(self) -> FloatArray:
        """Times at which a load jumps, begins or ends, (J,) [s]."""
        return np.concatenate([np.zeros(0), *(load.history.jump_times for load in self.loads)])

    @property
    def is_smooth(self) -> bool:
        """Whether a load follows a smooth curve between its samples."""
        return any(load.history.hold is Hold.SMOOTH for load in self.loads)

    @property
    def load_levels(self) -> LoadLevels:
        """The recorded loads in each row of a trial at rest, without loads by a formula."""
        directions = []
        values = []
        for load in self.loads:
            if isinstance(load.history, RecordedHistory):
                directions.append(load.direction)
                values.append(load.history.values)
        return LoadLevels(np.array(directions), np.column_stack(values))

    def loads_at(self, time: FloatArray, basis: FloatArray) -> FloatArray:
        """Return the sum of all loads at given times, projected on a basis.

        If a load jumps at a time, its value just before the jump is taken.

        Parameters
        ----------
        time : (T,) array
            The times of the samples [s].
        basis : (N, B) array
            Columns that the loads are multiplied by: shapes, or the identity.

        Returns
        -------
        (T, B) array
            The loads times the basis [N, or modal force].
        """
        count = len(self.loads)
        directions = np.array([load.direction for load in self.loads])
        values = np.array([load.values_at(time) for load in self.loads])
        # without loads the arrays are empty, but still need two axes
        directions = directions.reshape(count, len(basis))
        values = values.reshape(count, len(time))
        return values.T @ (directions @ basis)
