"""Unit slips: data in one unit of a quantity that the file states in another.

A slip shows as a factor between data and model that is the ratio of two units.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from math import log
from statistics import median
from typing import NamedTuple

from discrepancy.campaign.records import Campaign, Quantity, Trial, TrialKind
from discrepancy.campaign.units import UNITS, factor_to_si
from discrepancy.checks.fault import DataFault, FaultKind

_DRIVES = {
    TrialKind.STATIC: (Quantity.FORCE, "N"),
    TrialKind.FORCED: (Quantity.FORCE, "N"),
    TrialKind.RINGDOWN: (Quantity.DISPLACEMENT, ""),
    TrialKind.FLIGHT: (Quantity.ACCELERATION, "g"),
}
"""Quantity that drives a trial, and its unit; a load factor may have been recorded in m/s2."""
CERTAIN_FACTOR = 500.0
"""Slips beyond this factor are certain from one record.

Smaller ones are a doubt until several agree.
"""
DOUBTFUL_FACTOR = 7.0
"""Slips within this factor may be physical: a doubt if several records agree, else nothing."""
LEAST_FACTOR = 2.0
"""Least factor between two units that is a slip."""


class Slip(NamedTuple):
    """Two units of a quantity that were mixed up.

    Attributes
    ----------
    factor : float
        The ratio of data to model that the mix-up causes.
    meant : str
        The unit that the data have.
    stated : str
        The unit that the file states.
    """

    factor: float
    meant: str
    stated: str

    @property
    def ratio(self) -> float:
        """The factor or its reciprocal, whichever is larger."""
        return max(self.factor, 1.0 / self.factor)

    @property
    def tolerance_factor(self) -> float:
        """By which factor an observed ratio may differ from `factor` and still count as this slip.

        Physical effects change the ratio, too. A larger slip is farther from other slips, and
        allows for a larger factor.
        """
        for least_ratio, tolerance in ((200.0, 3.0), (20.0, 2.0), (DOUBTFUL_FACTOR, 1.35)):
            if self.ratio >= least_ratio:
                return tolerance
        return 1.1

    def log_distance(self, scale: float) -> float:
        """Return |log(scale / factor)|: how far a ratio of data to model is from this slip."""
        return abs(log(abs(scale) / self.factor))

    def __str__(self) -> str:
        """Return the pair of units, in brackets."""
        meant = "strain" if self.meant == "1" else self.meant
        stated_unit = "strain" if self.stated == "1" else self.stated
        return f"({meant} given as {stated_unit}?)"


def find_slip(
    scale: float, quantity: Quantity, stated_unit: str = "", *, is_input: bool = False
) -> Slip | None:
    """Return the two units of a quantity whose confusion best explains a ratio of data to model.

    Parameters
    ----------
    scale : float
        The ratio of data to model, of any sign.
    quantity : Quantity
        The quantity whose units may have been mixed up.
    stated_unit : str
        The unit that the file states. If it is empty, all pairs with one SI unit are tried.
    is_input : bool
        True if the quantity is an input of the model. An input that is too small makes the data
        look too large, so that the ratio is inverted.

    Returns
    -------
    Slip or None
        The slip nearest to the ratio; None if the ratio is beyond the tolerance of every slip, or
        within a factor of about `LEAST_FACTOR` of 1.
    """
    if abs(log(abs(scale))) < log(LEAST_FACTOR / 1.1):
        return None
    names = {*UNITS[quantity].usual}
    if stated_unit:
        names.add(stated_unit)
    units_in_si = {unit: factor_to_si(quantity, unit) for unit in sorted(names)}
    units_in_si |= UNITS[quantity].foreign
    distances: dict[Slip, float] = {}
    for assumed, assumed_in_si in units_in_si.items():
        for meant, meant_in_si in units_in_si.items():
            # the assumed unit is the stated one; if none is stated, one of the two must be SI
            has_si = 1.0 in (assumed_in_si, meant_in_si)
            if assumed != stated_unit and (stated_unit or not has_si):
                continue
            factor = meant_in_si / assumed_in_si if is_input else assumed_in_si / meant_in_si
            slip = Slip(factor, meant, assumed)
            if slip.ratio > LEAST_FACTOR:
                distances[slip] = slip.log_distance(scale)
    explaining = [
        slip for slip, distance in distances.items() if distance < log(slip.tolerance_factor)
    ]
    return min(explaining, key=lambda slip: distances[slip], default=None)


def unit_slips(campaign: Campaign, scales: Mapping[tuple[str, str], float]) -> Iterator[DataFault]:
    """Yield the unit slips of channels and of the inputs of trials.

    If all channels of all trials have one slip of the inputs in common, this alone is reported. A
    channel with the same slip in all its trials has a wrong unit itself. If all other channels of a
    trial have one slip in common, the input of that trial has a wrong unit.

    Parameters
    ----------
    campaign : Campaign
        The trials and channels, with the units that their files state.
    scales : mapping of (str, str) to float
        The ratio of data to model, by channel and trial.
    """
    trials = {trial.name: trial for trial in campaign.trials}
    input_slips = {key: _slip_of_input(trials[key[1]], scale) for key, scale in scales.items()}
    trials_of_channels: dict[str, list[str]] = defaultdict(list)
    for channel, trial_name in scales:
        trials_of_channels[channel].append(trial_name)
    common_slip = _common_slip([*input_slips.values()])
    if len(trials_of_channels) > 1 and common_slip is not None:
        sentence = (
            f"All channels of all trials are about {common_slip.factor:.6g} times what the model "
            f"predicts {common_slip}: check the units of forces (N), load factors (1) and release "
            "displacements, or of the channels"
        )
        fault = DataFault(FaultKind.INPUT_SLIP, sentence)
        yield from _grade_slip(fault, common_slip, agreeing=len(input_slips))
        return
    wrong_channels = set()
    for channel, trial_names in trials_of_channels.items():
        slip = _slip_of_channel(campaign, channel, [scales[channel, name] for name in trial_names])
        if slip is not None:
            wrong_channels.add(channel)
            slipping_trials = [trials[name] for name in trial_names]
            yield from _channel_faults(campaign, channel, slip, slipping_trials)
    for trial in trials.values():
        scale_of_channel = {
            channel: scale
            for (channel, trial_name), scale in scales.items()
            if trial_name == trial.name and channel not in wrong_channels
        }
        yield from _slips_in_trial(campaign, trial, scale_of_channel)


def _slips_in_trial(
    campaign: Campaign, trial: Trial, scale_of_channel: Mapping[str, float]
) -> Iterator[DataFault]:
    """Yield the unit slip of a trial's input; without one, the slips of its channels alone.

    `scale_of_channel` holds the ratio of data to model in this trial, without the channels that
    have a wrong unit in all their trials. The input has a slip if the same slip explains all these
    ratios. A slip of a channel in this trial alone is reported from `CERTAIN_FACTOR` on.
    """
    common_slip = _common_slip(
        [_slip_of_input(trial, scale) for scale in scale_of_channel.values()]
    )
    if common_slip is not None:
        sentence = (
            f"All channels of the trial {trial.name!r} are about {common_slip.factor:.6g} times "
            f"what the model predicts {common_slip}, and those of other trials are not: check the "
            "unit of its force, load factor, release displacement or inputs"
        )
        fault = DataFault(FaultKind.INPUT_SLIP, sentence, trial=trial.name)
        yield from _grade_slip(fault, common_slip, agreeing=len(scale_of_channel))
        return
    for channel, scale in scale_of_channel.items():
        slip = _slip_of_channel(campaign, channel, [scale])
        # a small factor in one trial may be physical, such as lift that shifts from the outer wing
        if slip is not None and slip.ratio >= CERTAIN_FACTOR:
            yield from _channel_faults(campaign, channel, slip, [trial])


def _common_slip(slips: Sequence[Slip | None]) -> Slip | None:
    """Return the slip that all entries have; None if they differ, or if there are no entries."""
    if not slips or any(slip != slips[0] for slip in slips):
        return None
    return slips[0]


def _slip_of_channel(campaign: Campaign, name: str, scales: Sequence[float]) -> Slip | None:
    """Return the slip of a channel's unit that explains its ratios of data to model, or None.

    The slip must explain the median of the ratios, and each single ratio within twice the tolerance
    of the slip (of the logarithm).
    """
    channel = campaign.channels[name]
    slip = find_slip(median(map(abs, scales)), channel.quantity, channel.unit)
    if slip is None:
        return None
    if any(slip.log_distance(scale) > 2.0 * log(slip.tolerance_factor) for scale in scales):
        return None
    return slip


def _slip_of_input(trial: Trial, scale: float) -> Slip | None:
    """Return the first slip of a trial's inputs that explains a ratio of data to model, or None.

    The inputs that are tried are what drives a trial of this kind, and then the recorded inputs.
    """
    drives = []
    if trial.kind in _DRIVES:
        drives.append(_DRIVES[trial.kind])
    drives += [(recorded_input.quantity, recorded_input.unit) for recorded_input in trial.inputs]
    for quantity, unit in drives:
        slip = find_slip(scale, quantity, unit, is_input=True)
        if slip is not None:
            return slip
    return None


def _channel_faults(
    campaign: Campaign, name: str, slip: Slip, trials: Sequence[Trial]
) -> Iterator[DataFault]:
    """Yield the fault of a channel whose readings have a wrong unit in the given trials.

    Without sufficient evidence the fault is a doubt, or there is none; see `_grade_slip`.
    """
    channel = campaign.channels[name]
    first_trial = trials[0]
    column = ""
    if channel.column and first_trial.file:
        column = f", column {channel.column!r} of {first_trial.file},"
    number_of_trials = sum(name in trial.channels for trial in campaign.trials)
    is_in_one_of_several = len(trials) == 1 and number_of_trials > 1
    trials_text = f" in the trial {first_trial.name!r}" if is_in_one_of_several else ""
    sentence = (
        f"The channel {name!r}{column} shows about {slip.factor:.6g} times what the model "
        f"predicts{trials_text} {slip}: correct its `unit`, or convert the column"
    )
    trial_name = first_trial.name if is_in_one_of_several else ""
    fault = DataFault(FaultKind.UNIT_SLIP, sentence, name, trial_name)
    # an accelerometer also shows gravity, whose value is known: this counts as a second record
    further_evidence = 1 if channel.quantity is Quantity.ACCELERATION else 0
    yield from _grade_slip(fault, slip, agreeing=len(trials) + further_evidence)


def _grade_slip(fault: DataFault, slip: Slip, *, agreeing: int) -> Iterator[DataFault]:
    """Yield a slip as a fault, as a doubt, or not at all, by its size and the evidence for it.

    From `CERTAIN_FACTOR` on it is a fault. From `DOUBTFUL_FACTOR` on it is a fault if several
    records show it, else a doubt. Below, it is a doubt if several records show it, else nothing.

    Parameters
    ----------
    fault : DataFault
        The fault, whose sentence has no full stop yet.
    slip : Slip
        The slip, whose ratio decides.
    agreeing : int
        The number of records that show this slip.
    """
    sentence = fault.sentence
    if slip.ratio >= CERTAIN_FACTOR or (slip.ratio >= DOUBTFUL_FACTOR and agreeing > 1):
        yield replace(fault, sentence=f"{sentence}; no physical effect is that large.")
    elif slip.ratio >= DOUBTFUL_FACTOR or agreeing > 1:
        yield replace(
            fault, kind=FaultKind.UNIT_DOUBT, sentence=f"{sentence}, or correct the model."
        )
