"""What is too small to be a name: a gain of half a thousandth is a nuisance of instruments, not a cause."""

from discrepancy.campaign.records import TrialKind
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from fe.runtime.patch import Clock, LoadGain, Primitive, SensorGain

LEAST_SIZE = 1e-3
"""Size of a gain, tare or clock error over what it acts on, below which it is a nuisance and no name."""
UNSTATED_GAIN = 1e-2
"""The same of the gain of a channel of which no deviation is stated, beside a law that explains as much: a
calibration that nobody stated is not exact."""


def is_one_driven_channel(problem: Problem) -> bool:
    """Whether a campaign is of driven trials and one channel: no error of it has a pattern of its own."""
    driven = all(trial.kind in (TrialKind.DRIVEN, TrialKind.FORCED) for trial in problem.campaign.trials)
    return driven and len(problem.channel_names) == 1


def small_terms(
    problem: Problem, found: CandidateFit, *, unstated: float = LEAST_SIZE
) -> tuple[float | None, ...]:
    """Return for each effect of a fit its size over what it acts on where that is too small, else None.

    `unstated`: the least size of a gain of a channel of which no deviation is stated.
    """
    sizes: list[float | None] = []
    for term, part in zip(found.candidate.terms, found.candidate.parts(found.point.effect), strict=True):
        patch = Candidate((term,)).patch(problem.setting, part)
        known = [_size(problem, item) for item in patch]
        largest = max((size for size in known if size is not None), default=None)
        least = max((_least(problem, item, unstated) for item in patch), default=LEAST_SIZE)
        small = largest is not None and None not in known and largest < least
        sizes.append(largest if small else None)
    return tuple(sizes)


def _least(problem: Problem, item: Primitive, unstated: float) -> float:
    """Return the size from which an error of an instrument may be a name."""
    if not isinstance(item, SensorGain) or item.channel not in problem.campaign.channels:
        return LEAST_SIZE
    return unstated if problem.campaign.channels[item.channel].gain_deviation == 0.0 else LEAST_SIZE


def _size(problem: Problem, item: Primitive) -> float | None:
    """Return the size of an error of an instrument over what it acts on, None of anything else."""
    scales = problem.setting.scales
    if isinstance(item, LoadGain):
        return max(abs(item.gain), abs(item.tare) / scales.force if scales.force > 0.0 else 0.0)
    if isinstance(item, SensorGain):
        return abs(item.gain)
    if isinstance(item, Clock):
        return max(abs(item.rate), abs(item.zero) * scales.angular_frequency)
    return None
