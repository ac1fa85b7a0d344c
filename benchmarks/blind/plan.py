"""The plan of a campaign: channels and trials, before anything is measured."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

PAUSE = 600.0
"""Time between the last row of a trial and the start of the next trial [s]."""


@dataclass(frozen=True)
class ChannelPlan:
    """A channel; `scale` SI units make one of its own.

    Attributes
    ----------
    name, quantity, unit, output : str
        As in the campaign file.
    scale : float
        SI value of one unit.
    noise : float
        Standard deviation [unit].
    gain, offset : float
        Prior deviations of the gain [1] and of the zero of a trial [unit].
    station, chord : float
        Place (nan for none).
    """

    name: str
    quantity: str
    unit: str
    output: str
    scale: float
    noise: float
    gain: float = 0.0
    offset: float = 0.0
    station: float = float("nan")
    chord: float = float("nan")


@dataclass(frozen=True)
class TrialPlan:
    """A trial.

    Attributes
    ----------
    name, kind, run : str
        As in the campaign file; kinds "static", "ringdown" and "flight".
    channels : tuple of str
        Measured.
    rows : (n,) N, 1 or s
        Forces, load factors, or times since the release.
    place : str
        Where the force acts, a key of the rig.
    start : float
        Since the campaign's start [s].
    interval : float
        Between rows of static trials and flights [s].
    temperature : float
        Above the reference [K].
    release : float
        Nominal displacement of the release point [m]; 0 if there is no release.
    held_out : bool
        Kept for proof.
    """

    name: str
    kind: str
    run: str
    channels: tuple[str, ...]
    rows: FloatArray
    place: str = ""
    start: float = 0.0
    interval: float = 30.0
    temperature: float = 0.0
    release: float = 0.0
    held_out: bool = False

    @property
    def campaign_times(self) -> FloatArray:
        """Time of each row since the campaign's start (n,) [s]."""
        if self.kind == "ringdown":
            return self.start + self.rows
        return self.start + self.interval * np.arange(len(self.rows), dtype=np.float64)


def schedule(
    trials: Iterable[TrialPlan], longer_pauses: Mapping[str, float] | None = None
) -> tuple[TrialPlan, ...]:
    """Return trials with start times one after the other, `PAUSE` apart.

    Parameters
    ----------
    trials : iterable of TrialPlan
        Trials in order; their start times are ignored.
    longer_pauses : mapping of str to float, optional
        Additional time before some trials, by name [s].
    """
    longer = longer_pauses or {}
    scheduled: list[TrialPlan] = []
    for trial in trials:
        start = float(scheduled[-1].campaign_times[-1]) + PAUSE if scheduled else 0.0
        start += longer.get(trial.name, 0.0)
        scheduled.append(replace(trial, start=start))
    return tuple(scheduled)


@dataclass(frozen=True)
class CampaignPlan:
    """A campaign.

    Attributes
    ----------
    name : str
        Title.
    channels : mapping of str to ChannelPlan
        By name.
    trials : tuple of TrialPlan
        In order.
    reference_temperature : float or None
        [degC].
    priors : mapping of str to (float, float)
        Mean and deviation of the calibrated parameters.
    places : mapping of str to object
        What the campaign file says of a place of load.
    release_deviation : float
        Prior relative deviation of a release's amplitude.
    noise_samples : int
        Length of the noise record, of the channels of ring-downs.
    """

    name: str
    channels: Mapping[str, ChannelPlan]
    trials: tuple[TrialPlan, ...]
    reference_temperature: float | None
    priors: Mapping[str, tuple[float, float]]
    places: Mapping[str, str | tuple[float, float]]
    release_deviation: float = 0.05
    noise_samples: int = 800
    rate: float = 250.0
    model_file: str = ""
    model_text: str = field(default="", repr=False)

    @property
    def duration(self) -> float:
        """Time from the first to the last row [s]."""
        return float(max(trial.campaign_times[-1] for trial in self.trials))

    @property
    def dynamic_channels(self) -> tuple[str, ...]:
        """Channels of the ring-downs."""
        names = [
            name for trial in self.trials if trial.kind == "ringdown" for name in trial.channels
        ]
        return tuple(dict.fromkeys(names))
