"""What can be wrong with measured data, as a record."""

from dataclasses import dataclass
from enum import StrEnum

from discrepancy.campaign.records import Channel, Trial
from discrepancy.errors import said


class FaultKind(StrEnum):
    """What is wrong."""

    NO_NOISE_RECORD = "no noise record"
    NOISE_LABEL = "noise label"  # the noise record contradicts repeats or the record itself
    MOVES_AT_REST = "motion at rest"  # the noise record holds more than noise
    CLIPPED = "clipped"
    DEAD = "dead"  # a channel that shows nothing
    FROZEN = "frozen"  # a value that is held while all else moves
    COPIED = "copied"  # a channel that is another one
    OUTLIERS = "outliers"  # too many to be left out
    TOO_SHORT = "too short"
    UNDERSAMPLED = "undersampled"
    MISSING_OUTPUT = "missing output"
    WRONG_QUANTITY = "wrong quantity"
    UNIT_SLIP = "unit slip"
    UNIT_DOUBT = "unit doubt"  # a factor between two units that physics may be as well
    INPUT_SLIP = "input slip"  # force or load factor of a trial in another unit
    SIGN = "sign"
    SWAPPED = "swapped"
    BETWEEN_SAMPLES = "between samples"  # what an input did there matters, and is not known
    UNOBSERVABLE = "unobservable parameter"


HARMLESS = frozenset(
    {
        FaultKind.NO_NOISE_RECORD,
        FaultKind.NOISE_LABEL,
        FaultKind.MOVES_AT_REST,
        FaultKind.UNIT_DOUBT,
        FaultKind.BETWEEN_SAMPLES,
        FaultKind.UNOBSERVABLE,
    }
)
"""Faults that limit what can be concluded, but do not make the data wrong."""


@dataclass(frozen=True)
class DataFault:
    """A fault of the data.

    Attributes
    ----------
    kind : FaultKind
        What is wrong.
    sentence : str
        What was found, where, and what to do.
    channel, trial : str
        Where; empty where it concerns all.
    """

    kind: FaultKind
    sentence: str
    channel: str = ""
    trial: str = ""

    @property
    def fatal(self) -> bool:
        """Whether conclusions from these data would be wrong, not only limited."""
        return self.kind not in HARMLESS


def fault(kind: FaultKind, channel: str = "", trial: str = "", say: str = "", **values: object) -> DataFault:
    """Return a fault with the sentence of its kind, or with that called `say`, filled in with values."""
    name = say or kind.name.lower()
    return DataFault(kind, said(f"faults.{name}", channel=channel, trial=trial, **values), channel, trial)


def place_of(channel: Channel, trial: Trial, start: int = 0, stop: int | None = None) -> str:
    """Return where samples of a trial stand: column, file, trial and time span."""
    time = trial.time[start:stop]
    file = f" of {trial.file}" if trial.file else ""
    return (
        f"the column {channel.table_column!r}{file} (the trial {trial.name!r}, {time[0]:.6g} to "
        f"{time[-1]:.6g} s)"
    )
