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
    recorded_steps : int
        Number of steps of the recorded response to each input and each release.
    inputs : tuple of str
        Force inputs on which a recorded force or laws may act.
    force_factors : mapping of str to float
        Factor of the recorded force on each input: one for a force, the lever arm [m] for a moment.
    force : RecordedHistory, optional
        The recorded force.
    releases : mapping of str to float
        Parameters that release the FMU, with displacement [m] and velocity [m/s] of the release
        point; or the input that holds it until then, with the displacement.
    decays_to_rest : bool
        Whether the FMU is stepped until its motion has decayed, for its outputs at rest.
    """

    state: OperatingPoint
    step: float
    recorded_steps: int
    inputs: tuple[str, ...] = ()
    force_factors: Mapping[str, float] = MappingProxyType({})
    force: RecordedHistory | None = None
    releases: Mapping[str, float] = MappingProxyType({})
    decays_to_rest: bool = False

    @property
    def recording_arguments(self) -> tuple[OperatingPoint, float, int]:
        """State, step [s] and number of steps: the first arguments of an `FmuRun`."""
        return self.state, self.step, self.recorded_steps

    @property
    def force_factor_values(self) -> FloatArray:
        """Factor (E,) of the recorded force on each of the E inputs; 0 if it does not act there."""
        return np.array([self.force_factors.get(name, 0.0) for name in self.inputs])

    @property
    def first_force(self) -> float:
        """The recorded force at the first sample; zero if no force is recorded."""
        return 0.0 if self.force is None else float(self.force.values[0])

    @property
    def linearity_key(self) -> tuple[Hashable, ...]:
        """What decides whether the FMU counts as linear: inputs, releases and decay to rest."""
        return self.inputs, *self.releases, self.decays_to_rest
