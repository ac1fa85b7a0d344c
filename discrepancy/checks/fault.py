"""What can be wrong with measured data, as a record."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class FaultKind(StrEnum):
    """What is wrong."""

    NO_NOISE_RECORD = "no noise record"
    NOISE_LABEL = "noise label"  # the noise record contradicts repeats or the record itself
    CLIPPED = "clipped"
    DEAD = "dead"  # a channel that shows nothing
    OUTLIERS = "outliers"  # too many to be left out
    TOO_SHORT = "too short"
    UNDERSAMPLED = "undersampled"
    MISSING_OUTPUT = "missing output"
    WRONG_QUANTITY = "wrong quantity"
    UNIT_SLIP = "unit slip"
    INPUT_SLIP = "input slip"  # force or load factor of a trial in another unit
    SIGN = "sign"
    SWAPPED = "swapped"
    BETWEEN_SAMPLES = "between samples"  # what an input did there matters, and is not known
    UNOBSERVABLE = "unobservable parameter"


HARMLESS = frozenset(
    {
        FaultKind.NO_NOISE_RECORD,
        FaultKind.NOISE_LABEL,
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
