"""A share of the gap that a hypothesis explains, with its interval by a block bootstrap."""

from dataclasses import dataclass

import numpy as np

from discrepancy.campaign.records import FloatArray

OF_FORCE = "the missing force"
OF_PREDICTIONS = "what the missing force does to predictions"
OF_READINGS = "the gap"
DRAWS = 2000
"""Draws of the bootstrap."""
SEED = 0
"""Seed of the bootstrap, and of the noise that is simulated."""


@dataclass(frozen=True, eq=False)
class GapShare:
    """A share of the gap that a hypothesis explains: 1 - mean square after over mean square before.

    Attributes
    ----------
    before, after : (B,) array
        The sums of squares of each block without and with the hypothesis.
    noise : (B,) array
        The part of these sums that the noise of the readings alone makes.
    held_out : bool
        Whether the trials were held out.
    trial_count : int
        The number of trials.
    remaining_rms, total_rms : float
        The rms of the force at the port of the law (or where most is missing), beside the law and
        without it [N, N m or the port's flow]; or of the gap between readings and simulation.
    kind : str
        What it is a share of: of the forces, weighted by what they do to the state; of what they do
        to the readings over a block, from its begin (the error of predictions); or of the gap
        between readings and simulation.
    tested : bool
        Whether the law has a force in these trials that could be seen.
    """

    before: FloatArray
    after: FloatArray
    noise: FloatArray
    held_out: bool
    trial_count: int
    remaining_rms: float
    total_rms: float
    kind: str
    tested: bool

    @property
    def value(self) -> float:
        """The share."""
        return float(_share_of(self.before.sum(), self.after.sum(), self.noise.sum()))

    def bootstrap_draws(self) -> FloatArray:
        """Return the share (DRAWS,) at draws of blocks with replacement.

        A block bootstrap (Kuensch 1989, Ann. Statist. 17, 1217-1241); all shares draw the same
        blocks.
        """
        count = len(self.before)
        generator = np.random.default_rng(SEED)
        times_drawn = generator.multinomial(count, np.full(count, 1.0 / count), DRAWS)
        return _share_of(
            times_drawn @ self.before, times_drawn @ self.after, times_drawn @ self.noise
        )

    def is_larger_than(self, other: "GapShare") -> bool:
        """Return whether this share is larger than another one beyond chance (5 %)."""
        difference = self.bootstrap_draws() - other.bootstrap_draws()
        return bool(np.quantile(difference, 0.05) > 0.0)

    @property
    def interval(self) -> tuple[float, float]:
        """The ends of the 90 % interval of the share."""
        low, high = np.quantile(self.bootstrap_draws(), (0.05, 0.95))
        return float(low), float(high)


def _share_of(before: FloatArray, after: FloatArray, noise: FloatArray) -> FloatArray:
    """Return 1 - (after - noise) / (before - noise), and 0 where nothing is missing."""
    gap = before - noise
    remaining = np.divide(
        np.maximum(after - noise, 0.0), gap, out=np.ones_like(gap), where=gap > 0.0
    )
    return 1.0 - remaining
