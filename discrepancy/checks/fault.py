"""What can be wrong with measured data, as a record."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from math import log
from statistics import median
from typing import NamedTuple

from discrepancy.campaign.protocol import ACCEPTABLE
from discrepancy.campaign.records import Campaign, Channel, Quantity, Trial, TrialKind
from discrepancy.campaign.units import UNITS, conversion_of
from discrepancy.errors import said


class FaultKind(StrEnum):
    """What is wrong."""

    NO_NOISE_RECORD = "no noise record"
    NOISE_LABEL = "noise label"  # the noise record contradicts repeats or the record itself
    MOVES_AT_REST = "motion at rest"  # the noise record holds more than noise
    CLIPPED = "clipped"
    DEAD = "dead"  # a channel that shows nothing
    FROZEN = "held"  # a value that is held while all else moves
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
    accepted : bool
        Whether the campaign accepts it by its key `accept`.
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


def fault(kind: FaultKind, channel: str = "", trial: str = "", say: str = "", **values: object) -> DataFault:
    """Return a fault with the sentence of its kind, or with that called `say`, filled in with values."""
    name = say or kind.name.lower()
    return DataFault(kind, said(f"faults.{name}", channel=channel, trial=trial, **values), channel, trial)


def with_acceptance(faults: Iterable[DataFault], campaign: Campaign) -> tuple[DataFault, ...]:
    """Return faults with what the campaign's key `accept` says of them.

    The sentence of an accepted fault says so. That of another one ends with the key that would accept it,
    where there is one.
    """
    found = []
    for item in faults:
        word = item.kind.value
        if word in campaign.accepted(item.channel, item.trial):
            sentence = f"Accepted by the campaign ({word}): {item.sentence}"
            item = replace(item, sentence=sentence, accepted=True)
        elif word in ACCEPTABLE and item.fatal:
            item = replace(item, sentence=f"{item.sentence.removesuffix('.')}; {_how_to_accept(item)}.")
        found.append(item)
    return tuple(found)


def _how_to_accept(item: DataFault) -> str:
    """Return the clause that names the key by which a campaign accepts a fault."""
    tables = []
    if item.trial:
        tables.append(f"the [[trial]] {item.trial!r}")
    if item.channel:
        tables.append(f"the [[channel]] {item.channel!r}")
    place = " or ".join(tables) or "at the top of campaign.toml"
    where = f"in {place}" if tables else place
    return f'if the data are right, say accept = ["{item.kind.value}"] {where}'


def place_of(channel: Channel, trial: Trial, start: int = 0, stop: int | None = None) -> str:
    """Return where samples of a trial stand: column, file, trial and time span."""
    time = trial.time[start:stop]
    file = f" of {trial.file}" if trial.file else ""
    return (
        f"the column {channel.table_column!r}{file} (the trial {trial.name!r}, {time[0]:.6g} to "
        f"{time[-1]:.6g} s)"
    )


# ---------------------------------------------------------------- units that records were not stated in

_DRIVES = {
    TrialKind.STATIC: (Quantity.FORCE, "N"), TrialKind.FORCED: (Quantity.FORCE, "N"),
    TrialKind.RINGDOWN: (Quantity.DISPLACEMENT, ""), TrialKind.FLIGHT: (Quantity.ACCELERATION, "g"),
}  # fmt: skip
"""What drives a trial, and in which unit it is stated: the load factor may have been given in m/s2."""
SURE_SLIP = 500.0
"""Slips beyond this factor are sure from a single record; smaller ones are a doubt until several agree."""
DOUBT = 7.0
"""Slips within this factor may be physics: they are a doubt where several records agree, else nothing."""
LEAST = 2.0


class Slip(NamedTuple):
    """A factor of data over model that two units explain."""

    factor: float
    meant: str
    stated: str

    @property
    def size(self) -> float:
        """The factor or one over it, whichever is larger."""
        return max(self.factor, 1.0 / self.factor)

    @property
    def width(self) -> float:
        """The factor by which physics may be off besides."""
        for least, width in ((200.0, 3.0), (20.0, 2.0), (DOUBT, 1.35)):
            if self.size >= least:
                return width
        return 1.1

    def __str__(self) -> str:
        """Return the pair of units."""
        meant, stated = ("strain" if unit == "1" else unit for unit in (self.meant, self.stated))
        return f"({meant} given as {stated}?)"


def slip_between(scale: float, quantity: Quantity, stated: str = "", *, drive: bool = False) -> Slip | None:
    """Return the pair of a quantity's units that a factor of data over model says, None if none does.

    Parameters
    ----------
    scale : float
        Data over model, of any sign.
    quantity : Quantity
        Whose units.
    stated : str
        The unit that the file states; empty: any, of which one of a pair is SI.
    drive : bool
        The quantity is what drives the model: what is too small there shows as data that are too large.
    """
    if abs(log(abs(scale))) < log(LEAST / 1.1):
        return None
    units = {*UNITS[quantity].usual, *([stated] if stated else [])}
    sizes = {unit: conversion_of(quantity, unit) for unit in sorted(units)}
    sizes |= UNITS[quantity].foreign
    slips = [
        Slip(sizes[meant] / size if drive else size / sizes[meant], meant, unit)
        for unit, size in sizes.items()
        for meant in sizes
        if unit == stated or (not stated and 1.0 in (size, sizes[meant]))
    ]
    off = {slip: abs(log(abs(scale) / slip.factor)) for slip in slips if slip.size > LEAST}
    near = [slip for slip, distance in off.items() if distance < log(slip.width)]
    return min(near, key=off.__getitem__, default=None)


def unit_slips(campaign: Campaign, scales: Mapping[tuple[str, str], float]) -> Iterator[DataFault]:
    """Yield the slips of channels, and of what drives trials, by data over model of (channel, trial).

    A channel that slips between units of its own in all its trials is at fault itself; where all others of a
    trial slip alike, what drives it is.
    """
    trials = {trial.name: trial for trial in campaign.trials}
    channels: dict[str, list[tuple[str, float]]] = defaultdict(list)
    for (name, where), scale in scales.items():
        channels[name].append((where, scale))
    driven = {key: _of_drive(trials[key[1]], scale) for key, scale in scales.items()}
    slips = list(driven.values())
    if len(channels) > 1 and slips[0] is not None and all(slip == slips[0] for slip in slips):
        yield from _faults(FaultKind.INPUT_SLIP, slips[0], len(slips), say="input_slip_of_all")
        return
    wrong = set()
    for name, found in channels.items():
        slip = _own(campaign, name, [scale for _, scale in found])
        if slip is not None:
            wrong.add(name)
            yield from _of_channel(campaign, name, slip, [trials[where] for where, _ in found])
    for trial in trials.values():
        left = [key for key in scales if key[1] == trial.name and key[0] not in wrong]
        slips = [driven[key] for key in left]
        if slips and slips[0] is not None and all(slip == slips[0] for slip in slips):
            yield from _faults(FaultKind.INPUT_SLIP, slips[0], len(slips), trial=trial.name)
            continue
        for name, _ in left:
            slip = _own(campaign, name, [scales[name, trial.name]])
            # a small factor in one trial alone may well be physics: lift that leaves the outer wing
            if slip is not None and slip.size >= SURE_SLIP:
                yield from _of_channel(campaign, name, slip, [trial])


def _own(campaign: Campaign, name: str, scales: list[float]) -> Slip | None:
    """Return the slip between a channel's units that the median of its scales says, and none contradicts."""
    channel = campaign.channels[name]
    slip = slip_between(median(map(abs, scales)), channel.quantity, channel.unit)
    if slip is None or any(abs(log(abs(scale) / slip.factor)) > 2.0 * log(slip.width) for scale in scales):
        return None
    return slip


def _of_drive(trial: Trial, scale: float) -> Slip | None:
    drives = [_DRIVES[trial.kind]] if trial.kind in _DRIVES else []
    drives += [(item.quantity, item.unit) for item in trial.inputs]
    found = (slip_between(scale, quantity, unit, drive=True) for quantity, unit in drives)
    return next((slip for slip in found if slip is not None), None)


def _of_channel(campaign: Campaign, name: str, slip: Slip, trials: list[Trial]) -> Iterator[DataFault]:
    channel, first = campaign.channels[name], trials[0]
    column = f", column {channel.column!r} of {first.file}," if channel.column and first.file else ""
    alone = len(trials) == 1 and sum(name in trial.channels for trial in campaign.trials) > 1
    where = f" in the trial {first.name!r}" if alone else ""
    # what gravity is to an acceleration, a single record tells
    count = len(trials) + (channel.quantity is Quantity.ACCELERATION)
    told = {"channel": name, "trial": first.name if alone else "", "column": column, "where": where}
    yield from _faults(FaultKind.UNIT_SLIP, slip, count, **told)


def _faults(kind: FaultKind, slip: Slip, count: int, **told: str) -> Iterator[DataFault]:
    """Yield a slip that so many records agree on as a fault, as a doubt, or not at all."""
    found = fault(kind, slip=slip, **told)
    if slip.size >= SURE_SLIP or (slip.size >= DOUBT and count > 1):
        yield replace(found, sentence=f"{found.sentence}; no physical effect is that large.")
    elif slip.size >= DOUBT or count > 1:
        yield replace(found, kind=FaultKind.UNIT_DOUBT, sentence=f"{found.sentence}, or mend the model.")
