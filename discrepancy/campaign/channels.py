"""Channels and inputs of a campaign: what has a column in its tables, and the noise of it."""

from dataclasses import dataclass, field
from enum import StrEnum
from math import inf
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from discrepancy.campaign.protocol import IN_FILES, NOT_IN_FILES, Accepted, Deviation, InFiles
from discrepancy.campaign.quantity import Quantity
from reporting.formats.toml_file import Name, NotNegative, Number, Positive

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


class Hold(StrEnum):
    """What an input does between its samples."""

    ZERO_ORDER = "zero_order"  # each value is held until the next sample, as a converter does
    LINEAR = "linear"  # straight lines
    SMOOTH = "smooth"  # a cubic spline through all samples


@dataclass(frozen=True)
class NoiseRecord:
    """The noise of a channel and how well it is known; the table `noise` of a channel in a file."""

    standard_deviation: Positive
    """Standard deviation s0 of a reading [channel's unit]."""
    degrees_of_freedom: Positive = inf
    """Degrees of freedom n0 of s0; infinite if the standard deviation is taken as exact [1]."""
    samples: Annotated[FloatArray | None, NOT_IN_FILES] = None
    """The recorded noise itself (n,), mean removed, if there is one."""
    interval: Annotated[float | None, NOT_IN_FILES] = None
    """Sampling interval of `samples` [s]."""
    source: Literal["pre-trigger", "repeats", "stated"] = "stated"
    """What the standard deviation comes from."""
    file: Annotated[str, NOT_IN_FILES] = field(default="", compare=False)
    """Name of the file that holds `samples`; empty if there is none."""

    __pydantic_config__ = ConfigDict(**IN_FILES, arbitrary_types_allowed=True)


@dataclass(frozen=True)
class InTables:
    """A channel or an input: anything that has a column in the tables of a campaign."""

    name: Name
    """Name, unique in the campaign; also that of its column unless `column` says otherwise."""
    quantity: Quantity
    """The physical quantity; a signal is not calibrated."""
    column: Name = field(default="", compare=False, kw_only=True)
    """Name of its column in the tables and the noise record; empty if that is `name`."""
    unit: InFiles = field(default="", compare=False, kw_only=True)
    """Unit of its column in the files; empty if the campaign was not read from files."""

    __pydantic_config__ = ConfigDict(**IN_FILES, arbitrary_types_allowed=True)

    @property
    def table_column(self) -> str:
        """Column of the tables."""
        return self.column or self.name


@dataclass(frozen=True)
class RecordedInput(InTables):
    """The time history of one input of a model in a trial.

    Without its values `[[input]]` of a file.
    """

    name: Name
    """Name of the model's input."""
    values: Annotated[FloatArray, NOT_IN_FILES, Field(default=np.empty(0), exclude=True)]
    """Values at the samples (N,) [SI]."""
    hold: Hold | None = None
    """Course between the samples. "zero_order": constant, and the readings of a row are those just
    before the input is set. "linear", the default: straight lines. "smooth": a cubic spline, as all
    motions and prescribed states have."""
    offset_deviation: NotNegative = 0.0
    """Prior standard deviation of a constant error of the record in this trial [SI]; zero for
    none."""
    reference: Annotated[bool, Field(strict=True)] = field(default=False, compare=False)
    """True for a motion that a controller is to follow: it is not a motion of the structure, and
    need not be smooth."""


@dataclass(frozen=True)
class Channel(InTables):
    """One measuring channel; in a file `[[channel]]`, with deviations in the unit of the file."""

    output: Name
    """Output of the model that it is compared with, such as "strain[17]" or "tip_displacement"."""
    noise: NoiseRecord | None = None
    """Its noise; without it, the size of the residuals of a fit cannot be judged."""
    gain_deviation: Deviation = 0.0
    """Prior standard deviation of the channel's relative gain error [1]; "free" (infinite) for a
    signal of unknown scale (the scale of the release amplitudes, if only these show it)."""
    offset_deviation: Deviation = 0.0
    """Prior standard deviation of its zero in each trial [channel's unit]; "free" (infinite) for a
    free zero."""
    station: Number | None = None
    """Position along the span [m], for maps."""
    chord: Number | None = None
    """Position along the chord [fraction], for maps."""
    accept: Accepted = ()
    """Faults of its data that the user accepts, in all trials."""
