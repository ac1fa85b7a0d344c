"""A measurement campaign: trials, channels, noise records and states, as records in SI units.

`discrepancy.campaign.reading` reads one from a folder; strain is dimensionless here, displacement
in metres.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from itertools import product
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from discrepancy.campaign.channels import BoolArray as BoolArray
from discrepancy.campaign.channels import Channel as Channel
from discrepancy.campaign.channels import FloatArray as FloatArray
from discrepancy.campaign.channels import Hold as Hold
from discrepancy.campaign.channels import InTables as InTables
from discrepancy.campaign.channels import IntArray as IntArray
from discrepancy.campaign.channels import NoiseRecord as NoiseRecord
from discrepancy.campaign.channels import RecordedInput as RecordedInput
from discrepancy.campaign.protocol import Accepted, Event, InFiles, Release
from discrepancy.campaign.quantity import Quantity as Quantity
from discrepancy.campaign.sampling import is_nearly_even
from reporting.formats.toml_file import Name, Number, Positive
from reporting.words import brief


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


USUAL_REGIONS = ("z1", "z2")
"""Damage regions of the shipped wing, which every trial has."""


@dataclass(frozen=True, kw_only=True)
class TrialKeys:
    """What the file of a campaign states of a trial, and a trial in memory keeps as it is."""

    name: Name
    """Name, unique in the campaign."""
    kind: TrialKind
    """The kind of the trial: what was done in it."""
    file: InFiles = field(default="", compare=False)
    """Name of its table; empty if it was not read from a file."""
    run: str = ""
    """Name of the set-up; readings of one run share one seating of the object."""
    held_out: Annotated[bool, Field(strict=True)] = False
    """True if the trial is used only for the proof, and not to find or to fit anything."""
    noise_factor: Positive = 1.0
    """Standard deviation of the noise in this trial over that of the channels' noise records, as
    known from the acquisition (averaging, another range) [1]."""
    load_place: Name | tuple[Number, Number] = "tip_load"
    """Point at which the force acts: a name that the model knows ("tip_load" of the wing), or (y,
    x), the distance from the root and the place along the chord [m and fraction of the chord]."""
    release: Release | None = None
    """How a ring-down began; None for other kinds."""
    hold: Hold | None = None
    """Course of the force of a forced trial between its samples, as that of an input."""
    accept: Accepted = ()
    """Faults of its data that the user accepts, in all channels."""

    @property
    def keys_in_file(self) -> dict[str, Any]:
        """The entries that the file states, by name, to build another record of the same trial."""
        return {key: getattr(self, key) for key in TrialKeys.__dataclass_fields__}


_FIELDS_OF_ROWS = (
    "values",
    "used",
    "time",
    "force",
    "load_factor",
    "temperature",
    "health",
    "health_deviation",
)
"""Fields of a trial that are arrays with an entry, or a row, for each of its rows."""


@dataclass(frozen=True, kw_only=True)
class Trial(TrialKeys):
    """One trial of N rows: what acted, what C channels measured, and the state of the structure.

    Attributes
    ----------
    channels : tuple of str
        Names of the measured channels.
    values : (N, C) ndarray
        Measured values, units of the channels.
    used : (N, C) ndarray of bool
        False where a sample is left out (an outlier, a gap), with the reason in the campaign's
        `remarks`.
    time : (N,) ndarray
        Ring-down, forced: time since the trial's start [s], strictly increasing. Static, flight:
        time of each row since the campaign's start [s].
    force : (N,) ndarray
        Applied force [N], upwards positive; zero in ring-downs and flights.
    load_factor : (N,) ndarray
        Load factor [1]; zero except in flight.
    temperature : (N,) ndarray
        Temperature less the campaign's reference temperature [K].
    start : float
        Start of the trial since the campaign's start [s].
    health : (N, K) ndarray
        Stiffness losses of the K `regions` [fraction]; prior means where `health_deviation` is
        positive.
    health_deviation : (N, K) ndarray
        Prior standard deviations of the losses; zero where they are known.
    begins : Start
        How a forced or driven trial began.
    begin_assumed : bool
        True if the file does not state `begins`.
    inputs : tuple of RecordedInput
        Driven trials: what acted; `force` is then the first force or torque among them, or zero.
        Static trials: inputs other than the force that were held constant in each row.
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
        cls, name: str, kind: TrialKind, channels: tuple[str, ...], time: FloatArray, **fields: Any
    ) -> "Trial":
        """Return a trial of a healthy structure, without force and with readings of zero.

        Parameters
        ----------
        name : str
            The name of the trial.
        kind : TrialKind
            What is done in it.
        channels : tuple of str
            Names of the C measured channels.
        time : (N,) ndarray
            Times of the rows [s].
        **fields : object
            Fields of the trial that differ from these defaults.
        """
        row_count = len(time)
        zeros = np.zeros(row_count)
        no_losses = np.zeros((row_count, len(USUAL_REGIONS)))
        defaults = {
            "values": np.zeros((row_count, len(channels))),
            "used": np.ones((row_count, len(channels)), dtype=bool),
            "force": zeros,
            "load_factor": zeros,
            "temperature": zeros,
            "health": no_losses,
            "health_deviation": no_losses,
        }
        return cls(name=name, kind=kind, channels=channels, time=time, **{**defaults, **fields})

    def rows(self, rows: BoolArray | IntArray | slice, **changes: Any) -> "Trial":
        """Return a copy of the trial with some of its rows only, and with other fields changed.

        Parameters
        ----------
        rows : (N,) ndarray of bool, (M,) ndarray of int, or slice
            The rows that stay.
        **changes : object
            New values of other fields, such as its name.
        """
        fields: dict[str, Any] = {}
        for key in _FIELDS_OF_ROWS:
            fields[key] = getattr(self, key)[rows]
        inputs = tuple(
            replace(recorded_input, values=recorded_input.values[rows])
            for recorded_input in self.inputs
        )
        return replace(self, inputs=inputs, **{**fields, **changes})

    def noise_deviation(self, channel: Channel) -> float:
        """Return the standard deviation of a channel's noise in this trial [channel's unit].

        The result is 0 if the channel has no noise record.
        """
        if channel.noise is None:
            return 0.0
        return channel.noise.standard_deviation * self.noise_factor

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the recorded inputs of the trial; the force of a forced trial is "force"."""
        if self.kind is TrialKind.FORCED:
            return ("force",)
        return tuple(recorded_input.name for recorded_input in self.inputs)

    @property
    def load(self) -> FloatArray:
        """Load of each row (N,): the load factor in flight [1], else the force [N]."""
        return self.load_factor if self.kind is TrialKind.FLIGHT else self.force

    @property
    def level(self) -> float:
        """Magnitude of the release displacement, or of the largest load."""
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
    def whitening_interval(self) -> float | None:
        """Sampling interval [s] of a dynamic trial for a filter that makes its noise white.

        None for a trial that is not dynamic, or whose samples are too unevenly spaced for a filter.
        """
        return self.interval if self.is_dynamic and is_nearly_even(self.time) else None


@dataclass(frozen=True)
class Campaign:
    """A measurement campaign: all trials of one structure, in SI.

    Attributes
    ----------
    name : str
        The title of the sheet or variable.
    channels : mapping of str to Channel
        The channels of the campaign by name.
    trials : tuple of Trial
        In the order of the file.
    reference_temperature : float or None
        Reference temperature [degC]; None if temperatures were not recorded.
    parameters : mapping of str to (float, float)
        Mean and standard deviation that replace the model's own prior of calibrated parameters.
    data_hash : str
        SHA-256 of the campaign's files.
    remarks : tuple of str
        Sentences on what the reader noticed and did, such as samples that were left out, and why.
    loggers : mapping of str to tuple of str
        Channels and inputs that share a clock, by the name of their logger; "force" is the force of
        forced trials. Empty if one logger recorded everything.
    events : tuple of Event
        Events in the order of the file; those of one name follow each other in a trial, or are in
        different trials.
    accept : tuple of str
        Faults of the data that the user accepts, in all channels and trials: words of `ACCEPTABLE`.
    provenance : tuple of str
        Sentences on the laboratory's files that the campaign was imported from, which no command
        prints.
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
    provenance: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return brief(self, name=self.name, trials=len(self.trials), channels=self.channels)

    def accepted_faults(self, channel: str = "", trial: str = "") -> frozenset[str]:
        """Return the faults of data that the campaign accepts in a channel of a trial.

        They are the union of the lists `accept` of the campaign, of the channel and of the trial.

        Parameters
        ----------
        channel, trial : str
            The names of the channel and the trial; an empty name leaves its list out.
        """
        faults = set(self.accept)
        if channel in self.channels:
            faults.update(self.channels[channel].accept)
        for candidate in self.trials:
            if candidate.name == trial:
                faults.update(candidate.accept)
        return frozenset(faults)

    def names_of_event_times(self, trial: str) -> frozenset[str]:
        """Return the names that expressions use for the times of the events in a trial.

        An event `pump` has the time `pump` and, if its end is stated, the time `pump_until`.
        """
        names: set[str] = set()
        for event in self.events:
            if trial in event.trials:
                names |= event.times_by_name.keys()
        return frozenset(names)

    def event_times(self, trial: str, names: Collection[str]) -> list[dict[str, float]]:
        """Return the start and end times of a trial's events, once for each occurrence.

        Parameters
        ----------
        trial : str
            The name of the trial.
        names : collection of str
            Names of the times that an expression uses, such as `pump_on` and `pump_on_until`.

        Returns
        -------
        list of dict of str to float
            Times by name [s]. If the names belong to several events, every occurrence of one event
            is combined with every occurrence of the others. Empty if a name has no time in the
            trial.
        """
        occurrences: dict[str, list[dict[str, float]]] = {}
        for event in self.events:
            is_used = not event.times_by_name.keys().isdisjoint(names)
            if trial in event.trials and is_used:
                occurrences.setdefault(event.name, []).append(event.times_by_name)
        combined = []
        for combination in product(*occurrences.values()):
            times: dict[str, float] = {}
            for times_of_event in combination:
                times |= times_of_event
            if times.keys() >= set(names):
                combined.append(times)
        return combined

    def records(self, channel: str) -> Iterator[tuple[Trial, FloatArray, BoolArray]]:
        """Yield the trials of a channel, with its readings (N,) and which of them are used (N,)."""
        for trial in self.trials:
            if channel in trial.channels:
                column = trial.channels.index(channel)
                yield trial, trial.values[:, column], trial.used[:, column]

    def outputs(self, trial: Trial) -> tuple[tuple[str, Quantity], ...]:
        """Return the model output of each channel of a trial, and the quantity that it reads."""
        channels = (self.channels[name] for name in trial.channels)
        return tuple((channel.output, channel.quantity) for channel in channels)

    @property
    def fitted(self) -> tuple[Trial, ...]:
        """Trials that may be used to find and fit an effect."""
        return tuple(trial for trial in self.trials if not trial.held_out)

    @property
    def held_out(self) -> tuple[Trial, ...]:
        """Trials that are not fitted, but kept to prove a verdict."""
        return tuple(trial for trial in self.trials if trial.held_out)

    @property
    def largest_magnitudes(self) -> dict[str, float]:
        """The largest loads and times of the campaign, which scale the parameters of effects.

        ``force`` is the largest force [N], and ``load_factor`` the largest load factor [1]; 0 if
        they do not occur. ``duration`` is the longest record of a dynamic trial, or 1 s without
        one. ``campaign_time`` is the time from the first sample to the last, or 1 s if it is zero.
        """
        force = load_factor = 0.0
        durations: list[float] = []
        sample_times: list[FloatArray] = []
        for trial in self.trials:
            force = max(force, float(np.max(np.abs(trial.force))))
            load_factor = max(load_factor, float(np.max(np.abs(trial.load_factor))))
            if trial.is_dynamic:
                durations.append(float(trial.time[-1] - trial.time[0]))
                sample_times.append(trial.start + trial.time)
            else:
                sample_times.append(trial.time)
        campaign_time = 0.0
        if sample_times:
            first_time = min(float(np.min(times)) for times in sample_times)
            last_time = max(float(np.max(times)) for times in sample_times)
            campaign_time = last_time - first_time
        return {
            "force": force,
            "load_factor": load_factor,
            "duration": max(durations, default=1.0),
            "campaign_time": campaign_time or 1.0,
        }
