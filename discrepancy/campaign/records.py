"""A measurement campaign: trials, channels, noise records and states, as records in SI units.

`discrepancy.campaign.reading` reads one from a folder; strain is dimensionless here, displacement in metres.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from itertools import product
from math import inf
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from discrepancy.campaign.protocol import IN_FILES, NOT_IN_FILES, Accepted, Deviation, Event, InFiles, Release
from discrepancy.campaign.quantity import Quantity as Quantity
from discrepancy.campaign.sampling import nearly_even
from reporting.toml_file import Name, NotNegative, Number, Positive
from reporting.words import brief

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


class Hold(StrEnum):
    """What an input does between its samples."""

    ZERO_ORDER = "zero_order"  # each value is held until the next sample, as a converter does
    LINEAR = "linear"  # straight lines
    SMOOTH = "smooth"  # a cubic spline through all samples


class Start(StrEnum):
    """How a trial under recorded inputs began; ring-downs say it by their release."""

    SETTLED = "settled"  # at rest under what acts at the first sample
    STILL = "still"  # at rest under nothing: displacements, speeds and states are zero
    UNKNOWN = "unknown"  # anything: the initial state is a nuisance


class TrialKind(StrEnum):
    """What was done in a trial."""

    STATIC = "static"  # rows are load levels at rest: an applied force
    RINGDOWN = "ringdown"  # rows are samples in time after a release; no external load
    FORCED = "forced"  # rows are samples in time under a recorded force
    DRIVEN = "driven"  # rows are samples in time under any recorded inputs, or none (a fall)
    FLIGHT = "flight"  # rows are steady turns: a load factor


@dataclass(frozen=True)
class NoiseRecord:
    """What is known of a channel's noise; `noise` of a channel in a file.

    Attributes
    ----------
    standard_deviation : float
        s0 [channel's unit].
    degrees_of_freedom : float
        n0; infinite if the standard deviation is taken as exact.
    samples : (n,) ndarray or None
        The recorded noise itself, mean removed, if there is one.
    interval : float or None
        Sampling interval of `samples` [s].
    source : str
        "pre-trigger", "repeats" or "stated".
    file : str
        That holds `samples`; empty where there is none.
    """

    standard_deviation: Positive
    degrees_of_freedom: Positive = inf
    samples: Annotated[FloatArray | None, NOT_IN_FILES] = None
    interval: Annotated[float | None, NOT_IN_FILES] = None
    source: Literal["pre-trigger", "repeats", "stated"] = "stated"
    file: Annotated[str, NOT_IN_FILES] = field(default="", compare=False)

    __pydantic_config__ = ConfigDict(**IN_FILES, arbitrary_types_allowed=True)


@dataclass(frozen=True)
class InTables:
    """What has a column of a campaign's tables.

    Attributes
    ----------
    name : str
        Unique in the campaign; also the column of the tables unless the file says otherwise.
    quantity : Quantity
        What it is.
    column, unit : str
        Of the files; empty where there are none, or the column is called as the name.
    """

    name: Name
    quantity: Quantity
    column: Name = field(default="", compare=False, kw_only=True)
    unit: InFiles = field(default="", compare=False, kw_only=True)

    __pydantic_config__ = ConfigDict(**IN_FILES, arbitrary_types_allowed=True)

    @property
    def table_column(self) -> str:
        """Column of the tables."""
        return self.column or self.name


@dataclass(frozen=True)
class RecordedInput(InTables):
    """What one input of a model was in a trial; without its values `[[input]]` of a file.

    Attributes
    ----------
    name : str
        Input of the model.
    values : (N,) ndarray
        At the samples [SI].
    hold : Hold or None
        Between them; None: nobody said it, and it is taken as linear.
    offset_deviation : float
        Prior standard deviation of a constant that the record lacks in this trial [SI]; zero: none.
    reference : bool
        Of a motion in a file: it is none of the structure, so that it need not be smooth.
    """

    values: Annotated[FloatArray, NOT_IN_FILES, Field(default=np.empty(0), exclude=True)]
    hold: Hold | None = None
    offset_deviation: NotNegative = 0.0
    reference: Annotated[bool, Field(strict=True)] = field(default=False, compare=False)


@dataclass(frozen=True)
class Channel(InTables):
    """One measuring channel; `[[channel]]` of a file, until it is read in its unit.

    Attributes
    ----------
    output : str
        The model's output that it is compared with, such as "strain[17]" or "tip_displacement".
    noise : NoiseRecord or None
        None: nothing is known, and no absolute statement about the fit can be made.
    gain_deviation : float
        Prior standard deviation of the channel's relative gain error [1]; infinite for a signal of unknown
        scale (one of them is then the scale of the release amplitudes).
    offset_deviation : float
        Prior standard deviation of its zero in each trial [channel's unit]; infinite: a free zero.
    station : float or None
        Place along the span [m], for maps.
    chord : float or None
        Place along the chord [fraction], for maps.
    accept : tuple of str
        Faults of its data that are no faults, in all trials: words of `ACCEPTABLE`.
    """

    output: Name
    noise: NoiseRecord | None = None
    gain_deviation: Deviation = 0.0
    offset_deviation: Deviation = 0.0
    station: Number | None = None
    chord: Number | None = None
    accept: Accepted = ()

    def noise_in(self, trial: "Trial") -> float:
        """Return the deviation of its noise in a trial [its unit], 0 where it is not known."""
        return 0.0 if self.noise is None else self.noise.standard_deviation * trial.noise_factor


USUAL_REGIONS = ("z1", "z2")
"""Damage regions that every trial knows: those of the shipped wing."""


@dataclass(frozen=True, kw_only=True)
class TrialKeys:
    """What a trial has as its file says it: a name that is unique in the campaign, and what was done.

    Attributes
    ----------
    file : str
        That holds it; empty where there is none.
    run : str
        Label of the run (set-up) that the trial belongs to.
    held_out : bool
        True: not used to find or fit anything, only for proof.
    noise_factor : float
        Standard deviation of the noise in this trial over that of the channels' noise records, as known from
        the acquisition (averaging, another range) [1].
    load_place : str or tuple of float
        Where the force acts: a named place of the model ("tip_load" is the wing's own), or (y [m] from the
        root, x [fraction of the chord]).
    release : Release or None
        Ring-downs only.
    hold : Hold or None
        Forced trials: as that of an input, for the force.
    accept : tuple of str
        Faults of its data that are no faults, in all channels: words of `ACCEPTABLE`.
    """

    name: Name
    kind: TrialKind
    file: InFiles = field(default="", compare=False)
    run: str = ""
    held_out: Annotated[bool, Field(strict=True)] = False
    noise_factor: Positive = 1.0
    load_place: Name | tuple[Number, Number] = "tip_load"
    release: Release | None = None
    hold: Hold | None = None
    accept: Accepted = ()

    @property
    def said(self) -> dict[str, Any]:
        """All of this by name, for another record of the trial."""
        return {key: getattr(self, key) for key in TrialKeys.__dataclass_fields__}


@dataclass(frozen=True, kw_only=True)
class Trial(TrialKeys):
    """One trial: known inputs, measured values, labels of its state.

    Attributes
    ----------
    channels : tuple of str
        Names of the measured channels.
    values : (N, C) ndarray
        Measured values, units of the channels.
    used : (N, C) ndarray of bool
        False where a sample is left out (an outlier, a gap), with the reason in the campaign's `remarks`.
    time : (N,) ndarray
        Ring-down, forced: time since the trial's start [s], strictly increasing. Static, flight: time of each
        row since the campaign's start [s].
    force : (N,) ndarray
        Applied force [N], upwards positive; zero in ring-downs and flights.
    load_factor : (N,) ndarray
        Load factor [1]; zero except in flight.
    temperature : (N,) ndarray
        Temperature less the campaign's reference temperature [K].
    start : float
        Start of the trial since the campaign's start [s].
    health : (N, K) ndarray
        Known stiffness losses of `regions` (fractions); prior means where `health_deviation` is positive.
    health_deviation : (N, K) ndarray
        Prior standard deviations; zero where they are known.
    begins : Start
        How a forced or driven trial began.
    begin_assumed : bool
        Nobody said so.
    inputs : tuple of RecordedInput
        Driven trials: what acted. `force` is then the first force or torque among them, or zero. Static
        trials: what was held in each row beside the force.
    regions : tuple of str
        Names of the damage regions, z1 and z2 first.
    """

    channels: tuple[str, ...]
    values: FloatArray
    used: BoolArray
    time: FloatArray
    force: FloatArray
    load_factor: FloatArray
    temperature: FloatArray
    health: FloatArray
    health_deviation: FloatArray
    start: float = 0.0
    begins: Start = Start.SETTLED
    begin_assumed: bool = field(default=False, compare=False)
    inputs: tuple[RecordedInput, ...] = ()
    regions: tuple[str, ...] = USUAL_REGIONS

    @classmethod
    def plain(
        cls, name: str, kind: TrialKind, channels: tuple[str, ...], time: FloatArray, **given: Any
    ) -> "Trial":
        """Return a trial of which only this and `given` are said: readings of zero, no force, healthy."""
        zeros, shape, pair = np.zeros(len(time)), (len(time), len(channels)), np.zeros((len(time), 2))
        usual = {
            "values": np.zeros(shape), "used": np.ones(shape, dtype=bool), "force": zeros,
            "load_factor": zeros, "temperature": zeros, "health": pair, "health_deviation": pair,
        }  # fmt: skip
        return cls(name=name, kind=kind, channels=channels, time=time, **{**usual, **given})

    def rows(self, rows: BoolArray | IntArray | slice, **changes: Any) -> "Trial":
        """Return the trial with its rows as an index chooses them, and other fields changed."""
        keys = ("values", "used", "time", "force", "load_factor", "temperature", "health", "health_deviation")
        of_rows: dict[str, Any] = {key: getattr(self, key)[rows] for key in keys}
        inputs = tuple(replace(item, values=item.values[rows]) for item in self.inputs)
        return replace(self, inputs=inputs, **{**of_rows, **changes})

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of what is recorded beside the channels; the force of a forced trial is "force"."""
        if self.kind is TrialKind.FORCED:
            return ("force",)
        return tuple(item.name for item in self.inputs)

    @property
    def load(self) -> FloatArray:
        """What was applied (N,): the load factor in flight, else the force [N]."""
        return self.load_factor if self.kind is TrialKind.FLIGHT else self.force

    @property
    def level(self) -> float:
        """Release displacement, or the largest load."""
        if self.release is not None:
            return abs(self.release.displacement)
        return float(np.max(np.abs(self.load)))

    @property
    def is_dynamic(self) -> bool:
        """Whether the rows are samples in time of a motion."""
        return self.kind in (TrialKind.RINGDOWN, TrialKind.FORCED, TrialKind.DRIVEN)

    @property
    def interval(self) -> float:
        """Sampling interval [s] of a dynamic trial; the mean one where stamps are uneven."""
        return float(self.time[-1] - self.time[0]) / (len(self.time) - 1)

    @cached_property
    def whitened_at(self) -> float | None:
        """Interval [s] at which noise of a dynamic trial can be whitened; None at too uneven stamps."""
        return self.interval if self.is_dynamic and nearly_even(self.time) else None


@dataclass(frozen=True)
class Campaign:
    """All trials of one structure.

    Attributes
    ----------
    name : str
        Title.
    channels : mapping of str to Channel
        By name.
    trials : tuple of Trial
        In the order of the file.
    reference_temperature : float or None
        [degC]; None where temperatures were not recorded.
    parameters : mapping of str to (float, float)
        Mean and standard deviation that replace the model's own prior of calibrated parameters.
    data_hash : str
        SHA-256 of the campaign's files.
    remarks : tuple of str
        What the reader noticed and did: samples left out and why, a missing noise record.
    loggers : mapping of str to tuple of str
        Channels and inputs ("force": of forced trials) that share a clock, by logger; empty: one has all.
    events : tuple of Event
        In the order of the file; those of one name follow each other in a trial, or are in different ones.
    accept : tuple of str
        Faults of the data that are no faults, in all channels and trials: words of `ACCEPTABLE`.
    """

    name: str
    channels: Mapping[str, Channel]
    trials: tuple[Trial, ...]
    reference_temperature: float | None
    parameters: Mapping[str, tuple[float, float]]
    data_hash: str
    remarks: tuple[str, ...] = field(default=())
    loggers: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    events: tuple[Event, ...] = ()
    accept: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return brief(self, name=self.name, trials=len(self.trials), channels=self.channels)

    def accepted(self, channel: str = "", trial: str = "") -> frozenset[str]:
        """Return the faults of data that are accepted in a channel and a trial; an empty name is none."""
        words = list(self.accept)
        if channel in self.channels:
            words += self.channels[channel].accept
        for item in self.trials:
            words += item.accept if item.name == trial else ()
        return frozenset(words)

    def moment_names(self, trial: str) -> frozenset[str]:
        """Return the names by which expressions know the moments of events in a trial."""
        names: set[str] = set()
        for event in self.events:
            if trial in event.trials:
                names |= event.moments.keys()
        return frozenset(names)

    def event_moments(self, trial: str, names: Collection[str]) -> list[dict[str, float]]:
        """Return the moments of a trial's events, once for each time that the events happened.

        Parameters
        ----------
        trial : str
            Name of the trial.
        names : collection of str
            The moments that an expression uses: `pump_on`, `pump_on_until`.

        Returns
        -------
        list of dict of str to float
            Moments by name [s]. Where several events are used, every occurrence of the one is combined with
            every occurrence of the other. Empty where a name has no moment in the trial.
        """
        occurrences: dict[str, list[dict[str, float]]] = {}
        for event in self.events:
            wanted = event.moments.keys() & set(names)
            if trial in event.trials and wanted:
                occurrences.setdefault(event.name, []).append(event.moments)
        combined = []
        for combination in product(*occurrences.values()):
            moments = {name: time for event in combination for name, time in event.items()}
            if moments.keys() >= set(names):
                combined.append(moments)
        return combined

    def records(self, channel: str) -> Iterator[tuple[Trial, FloatArray, BoolArray]]:
        """Yield each trial that has a channel, what it read there (N,), and which readings count."""
        for trial in self.trials:
            if channel in trial.channels:
                column = trial.channels.index(channel)
                yield trial, trial.values[:, column], trial.used[:, column]

    def outputs(self, trial: Trial) -> tuple[tuple[str, Quantity], ...]:
        """Return the outputs that the channels of a trial measure, and as what quantity."""
        channels = (self.channels[name] for name in trial.channels)
        return tuple((channel.output, channel.quantity) for channel in channels)

    @property
    def fitted(self) -> tuple[Trial, ...]:
        """Trials that may be used to find and fit an effect."""
        return tuple(trial for trial in self.trials if not trial.held_out)

    @property
    def held_out(self) -> tuple[Trial, ...]:
        """Trials kept for proof."""
        return tuple(trial for trial in self.trials if trial.held_out)

    @property
    def sizes(self) -> dict[str, float]:
        """Largest force [N] and load factor, longest dynamic record and time from first to last sample [s].

        Times that nothing tells are one.
        """
        trials = self.trials
        moments = [trial.start + trial.time if trial.is_dynamic else trial.time for trial in trials]
        span = float(max(map(np.max, moments)) - min(map(np.min, moments))) if moments else 0.0
        lengths = (float(trial.time[-1] - trial.time[0]) for trial in trials if trial.is_dynamic)
        return {
            "force": max((float(np.max(np.abs(trial.force))) for trial in trials), default=0.0),
            "load_factor": max((float(np.max(np.abs(trial.load_factor))) for trial in trials), default=0.0),
            "duration": max(lengths, default=1.0),
            "campaign_time": span or 1.0,
        }
