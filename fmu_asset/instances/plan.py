"""What an instance exchanges with its FMU: plain values, sent to a worker."""

from dataclasses import dataclass, field
from typing import Literal

Interface = Literal["co-simulation", "model-exchange"]

SOLVER_TOLERANCE = 1e-6
"""Relative, of our solver, unless the binding gives another or the FMU declares a smaller one."""

Settings = list[tuple[str, int, list[float]]]
"""FMI base type, value reference, values: one for a scalar, all elements for an array."""


@dataclass(frozen=True)
class Group:
    """Variables of one base type, set or read in one call.

    Attributes
    ----------
    kind : str
        FMI base type: Real, Integer, Boolean; Float64, Int32, ... in FMI 3.
    references : tuple of int
        Value references, in the order of the block.
    count : int
        Number of values; more than references if there are arrays.
    linear : bool
        Whether the values move in straight lines over a step; such inputs come first.
    """

    kind: str
    references: tuple[int, ...]
    count: int
    linear: bool = False


@dataclass(frozen=True)
class Plan:
    """What an instance is and what it exchanges.

    Attributes
    ----------
    folder : str
        Where the FMU is extracted.
    fmi_version : int
        1, 2 or 3.
    interface : {"co-simulation", "model-exchange"}
        How the FMU is run.
    guid, model_identifier, instance_name : str
        As FMI wants them.
    inputs, outputs : tuple of Group
        What is set and read at every step, in the order of the request and of the reply block.
    substeps : int
        Communication steps of the FMU between two observations.
    tolerance : float or None
        Relative tolerance that the FMU is told.
    solver_tolerance : float
        Relative tolerance of our solver (model exchange).
    states, event_indicators : int
        Numbers of continuous states and event indicators (model exchange).
    completed_step : bool
        Whether the FMU wants to hear of completed integrator steps (model exchange).
    configuration : Settings
        Structural parameters (FMI 3), set before everything else.
    """

    folder: str
    fmi_version: int
    interface: Interface
    guid: str
    model_identifier: str
    instance_name: str
    inputs: tuple[Group, ...]
    outputs: tuple[Group, ...]
    substeps: int = 1
    tolerance: float | None = None
    solver_tolerance: float = SOLVER_TOLERANCE
    states: int = 0
    event_indicators: int = 0
    completed_step: bool = False
    configuration: Settings = field(default_factory=list)

    @property
    def linear_count(self) -> int:
        """Number of input values that move in straight lines."""
        return sum(group.count for group in self.inputs if group.linear)

    @property
    def input_count(self) -> int:
        """Number of values behind time and step size in a request: all inputs, then where lines begin."""
        return sum(group.count for group in self.inputs) + self.linear_count

    @property
    def output_count(self) -> int:
        """Number of output values."""
        return sum(group.count for group in self.outputs)
