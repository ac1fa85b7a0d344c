"""The tables of a scenario that say what really happens, unseen by the twin: damage, noise, faults."""

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from twin_master.scenario.modes import RecordSection
from twin_master.scenario.section import (
    Count,
    Name,
    NotNegative,
    Number,
    Probability,
    Section,
    Step,
)


class Gain(Section):
    """What one factor of the true state gains at each step from `first_step` to `last_step`."""

    units: ClassVar[Mapping[str, str]] = {"gain": "percent"}
    state: Name
    first_step: Step
    last_step: Step | None = None
    gain: Number

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.last_step is not None and self.last_step < self.first_step:
            raise ValueError(f"`last_step` {self.last_step} lies before `first_step` {self.first_step}")
        return self


class Noise(Section):
    """Noise of the real sensors, Gaussian and independent."""

    units: ClassVar[Mapping[str, str]] = {"standard_deviation": "microstrain"}
    standard_deviation: NotNegative | tuple[NotNegative, ...]
    """One for all sensors or one for each."""


class SensorFault(Section):
    """A fault of some sensors (numbered from 1) between two steps, the last one included."""

    units: ClassVar[Mapping[str, str]] = {"rate": "microstrain_per_step"}
    kind: Literal["dropout", "drift"]
    sensors: Literal["all"] | Annotated[tuple[Count, ...], Field(min_length=1)]
    first_step: Step
    last_step: Step | None = None
    rate: Number | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.kind == "drift") != (self.rate is not None):
            raise ValueError("a drift needs `rate_microstrain_per_step`, and a dropout has none")
        if self.last_step is not None and self.last_step < self.first_step:
            raise ValueError(f"`last_step` {self.last_step} lies before `first_step` {self.first_step}")
        return self


class TruthSection(Section):
    """What really happens, unseen by the twin: damage, sensor noise and faults.

    With the kind `asset`, all of it happens inside the asset, and is read back for scoring only.
    """

    kind: Literal["scripted", "random_growth", "asset"]
    gains: tuple[Gain, ...] = ()
    probability: dict[str, Probability | dict[str, Probability]] = Field(default_factory=dict)
    """`random_growth`: the true probabilities to worsen, as in `transition`; those of the twin if absent."""
    noise: Noise = Noise(standard_deviation=0.0)
    sensor_faults: tuple[SensorFault, ...] = ()
    state: dict[str, Name] = Field(default_factory=dict)
    """`asset`: for each state, the monitor of the binding that tells its true value."""
    observation: Name | None = None
    """`asset`: the observation of the binding that is free of noise; that of the scenario if absent."""
    received: Name | None = None
    """`asset`: the observation of the binding that is 0 where a sensor is lost."""

    record: RecordSection | None = None
    """Where modes are observed: the record of each turn."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.record is not None:
            if self.kind == "asset" or self.sensor_faults or self.noise.standard_deviation:
                raise ValueError(
                    "with `truth.record` the noise is that of the record (`truth.record.noise`), and the "
                    "truth the scenario's: leave out `truth.noise`, `truth.sensor_faults`, the kind `asset`"
                )
            return self
        if self.kind == "asset":
            if self.gains or self.sensor_faults or self.noise.standard_deviation:
                raise ValueError(
                    "the kind `asset` leaves damage, noise and faults to the asset: leave out `truth.gains`, "
                    "`truth.noise` and `truth.sensor_faults`"
                )
        elif self.state or self.observation or self.received:
            raise ValueError("`state`, `observation` and `received` of `truth` belong to the kind `asset`")
        elif "noise" not in self.model_fields_set:
            raise ValueError("`truth.noise` is missing")
        return self
