"""What can be wrong with measured data, as a record."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum

from discrepancy.campaign.protocol import ACCEPTABLE
from discrepancy.campaign.records import Campaign, Channel, Trial


class FaultKind(StrEnum):
    """What is wrong with the data; the words are those of the key `accept` of a campaign."""

    NO_NOISE_RECORD = "no noise record"
    NOISE_LABEL = "noise label"  # the noise record contradicts repeats or itself
    MOVES_AT_REST = "motion at rest"  # the noise record holds more than noise
    CLIPPED = "clipped"
    DEAD = "dead"  # the channel shows one value throughout a trial
    FROZEN = "held"  # the channel stands still within a motion
    COPIED = "copied"  # the channel repeats another one
    OUTLIERS = "outliers"  # too many to be left out
    TOO_SHORT = "too short"
    UNDERSAMPLED = "undersampled"
    MISSING_OUTPUT = "missing output"
    WRONG_QUANTITY = "wrong quantity"
    FREQUENCY = "frequency"  # ring-downs oscillate far from the model's first frequency
    UNIT_SLIP = "unit slip"
    UNIT_DOUBT = "unit doubt"  # a factor between two units that may also be physical
    INPUT_SLIP = "input slip"  # force or load factor of a trial in another unit
    SIGN = "sign"
    SWAPPED = "swapped"
    BETWEEN_SAMPLES = "between samples"  # the course of an input there matters, and is not known
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
        The kind of fault.
    sentence : str
        The message to the user: what was found, where, and what to do.
    channel, trial : str
        The names of the channel and the trial; empty if it concerns all.
    accepted : bool
        True if the campaign accepts it by its key `accept`.
    """

    kind: FaultKind
    sentence: str
    channel: str = ""
    trial: str = ""
    accepted: bool = False

    @property
    def fatal(self) -> bool:
        """Whether conclusions from these data would be wrong, not only limited."""
        return self.kind not in HARMLESS and not self.accepted


def mark_accepted(faults: Iterable[DataFault], campaign: Campaign) -> tuple[DataFault, ...]:
    """Return faults of the data, marked as accepted where a key `accept` of the campaign says so.

    The sentence of an accepted fault then begins with this. The sentence of a fatal fault that is
    not accepted, but can be, ends with the key that would accept it.
    """
    marked = []
    for fault in faults:
        word = fault.kind.value
        if word in campaign.accepted_faults(fault.channel, fault.trial):
            sentence = f"Accepted by the campaign ({word}): {fault.sentence}"
            marked.append(replace(fault, sentence=sentence, accepted=True))
        elif word in ACCEPTABLE and fault.fatal:
            sentence = f"{fault.sentence.removesuffix('.')}; {_acceptance_clause(fault)}."
            marked.append(replace(fault, sentence=sentence))
        else:
            marked.append(fault)
    return tuple(marked)


def _acceptance_clause(fault: DataFault) -> str:
    """Return the clause that tells which key of the campaign accepts a fault."""
    tables = []
    if fault.trial:
        tables.append(f"the [[trial]] {fault.trial!r}")
    if fault.channel:
        tables.append(f"the [[channel]] {fault.channel!r}")
    section = f"in {' or '.join(tables)}" if tables else "at the top of campaign.toml"
    return f'if the data are right, set accept = ["{fault.kind.value}"] {section}'


def samples_text(channel: Channel, trial: Trial, start: int = 0, stop: int | None = None) -> str:
    """Return column, file, trial and time span of the samples `start` to `stop` of a channel."""
    time = trial.time[start:stop]
    file = f" of {trial.file}" if trial.file else ""
    return (
        f"the column {channel.table_column!r}{file} (the trial {trial.name!r}, {time[0]:.6g} to "
        f"{time[-1]:.6g} s)"
    )
