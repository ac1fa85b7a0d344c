"""Excitation of an FMU: its state, a recorded force, a release, and the inputs of laws."""

from collections.abc import Hashable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.system.time_history import RecordedHistory
from fmu_asset.client.runs import OperatingPoint


class FmuExcitation(NamedTuple):
    """The excitation of an FMU in a dynamic trial.

    Attributes
    ----------
    state : OperatingPoint
        Parameters and constant inputs of the FMU.
    step : float
        Communication step [s].
    record : int
        Number of steps of the recorded response to each input and each release.
    inputs : tuple of str
        Force inputs on which a recorded force or laws may act.
    levers : mapping of str to float
        Factor of the recorded force on each input: one for a force, an arm [m] for a moment.
    force : RecordedHistory, optional
        The recorded force.
    releases : mapping of str to float
        Parameters that release the FMU, with displacement [m] and velocity [m/s] of the release
        point; or the input that holds it until then, with the displacement.
    settles : bool
        Whether the FMU is to come to rest.
    """

    state: OperatingPoint
    step: float
    record: int
    inputs: tuple[str, ...] = ()
    levers: Mapping[str, float] = MappingProxyType({})
    force: RecordedHistory | None = None
    releases: Mapping[str, float] = MappingProxyType({})
    settles: bool = False

    @property
    def recording(self) -> tuple[OperatingPoint, float, int]:
        """State, step and number of steps of a recorded answer."""
        return self.state, self.step, self.record

    @property
    def lever_values(self) -> FloatArray:
        """Factor of the recorded force for each of the inputs (E,)."""
        return np.array([self.levers.get(name, 0.0) for name in self.inputs])

    @property
    def first_force(self) -> float:
        """The recorded force at the first sample, zero without one."""
        return 0.0 if self.force is None else float(self.force.values[0])

    @property
    def kind(self) -> tuple[Hashable, ...]:
        """Inputs and releases for which an FMU is linear, or is not."""
        return self.inputs, *self.releases, self.settles
