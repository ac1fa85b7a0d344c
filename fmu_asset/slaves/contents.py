"""What a slave needs: a table of variables and a behaviour. Copied into the FMUs.

Standard library and relative imports only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from .variables import FmuVariable


class UnacceptableValuesError(ValueError):
    """Values that lie in their ranges but are impossible together; the message is one sentence."""


class Behaviour(Protocol):
    """The behaviour of an FMU: its outputs at the start and after steps.

    A call either completes, or raises and changes nothing. Outputs are returned in the order of the
    table, beginning with the first; Booleans are 0 or 1.
    """

    def start(
        self, parameters: Mapping[str, float], time: float, inputs: Sequence[float], /
    ) -> Sequence[float]:
        """Return the outputs at the start; time in s, inputs in the order of the table."""

    def advance(self, time: float, duration: float, inputs: Sequence[float], /) -> Sequence[float]:
        """Return the outputs after a step; time at its beginning and duration in s."""

    def state(self) -> Sequence[float]:
        """Return all numbers that are needed to continue, except the parameters."""

    def restore(self, parameters: Mapping[str, float], state: Sequence[float], /) -> None:
        """Restore a state that `state` returned, with the parameters of that time."""


class TunableBehaviour(Behaviour, Protocol):
    """A behaviour whose table ends with tunable parameters and further inputs."""

    def tune(self, values: Mapping[str, float], start_time: float, /) -> None:
        """Take the values of the rows after the outputs, by name, and the start time [s]."""


class LazyBehaviour(Behaviour, Protocol):
    """A behaviour with groups of outputs that are computed when they are read."""

    def later(self, group: int, /) -> Sequence[float]:
        """Return the outputs of a group."""


class SlaveContents(NamedTuple):
    """The content of the FMU's resources.

    Attributes
    ----------
    table : tuple of FmuVariable
        Inputs, parameters and outputs, in this order; one output is `status`. Tunable parameters
        and further inputs may follow at its end; they are for a `TunableBehaviour`.
    make_behaviour : callable
        Makes a new `Behaviour`, tunable and lazy where the table needs that.
    later : tuple of slice
        Groups of outputs that are computed only when they are read, since most masters do not read
        them: rows that follow one another.
    """

    table: tuple[FmuVariable, ...]
    make_behaviour: Callable[[], Any]
    later: tuple[slice, ...] = ()
