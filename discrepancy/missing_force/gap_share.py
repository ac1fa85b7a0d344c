"""The share of a gap that a hypothesis explains, with its interval by a block bootstrap."""

from dataclasses import dataclass

import numpy as np

from discrepancy.campaign.records import FloatArray

OF_FORCE = "the missing force"
OF_PREDICTIONS = "what the missing force does to predictions"
OF_READINGS = "the gap"
DRAWS = 2000
"""Number of draws of the bootstrap."""
SEED = 0
"""Seed of the bootstrap, and of simulated noise."""


@dataclass(frozen=True, eq=False)
class GapShare:
    """The share of a gap that a hypothesis explains: 1 - mean square after / mean square before.

    The gap is a missing force, or a difference between readings and predictions. Its mean squares
    are reduced by what noise alone would give.

    Attributes
    ----------
    squares_before, squares_after : (B,) array
        The sum of squares of the gap in each of B blocks of time, without and with the hypothesis.
    noise_squares : (B,) array
        The sum of squares that the noise of the readings alone gives in each block.
    held_out : bool
        Whether the trials were held out.
    trial_count : int
        The number of trials that were compared.
    remaining_rms, total_rms : float
        The rms of the missing force with and without the law, at the port of the law or where most
        force is missing [N, N m or the port's flow]; or that of the gap between readings and
        simulation.
    kind : str
        The gap: `OF_FORCE` (missing forces, weighted by their influence on state and readings),
        `OF_PREDICTIONS` (changes of the readings within a block by the missing forces in it), or
        `OF_READINGS` (differences between readings and simulation).
    is_tested : bool
        Whether the force of the law is so large in these trials that they test it. It is always
        true for a hypothesis without a law at a port, and for `OF_READINGS`.
    """

    squares_before: FloatArray
    squares_after: FloatArray
    noise_squares: FloatArray
    held_out: bool
    trial_count: int
    remaining_rms: float
    total_rms: float
    kind: str
    is_tested: bool

    @property
    def value(self) -> float:
        """The share of the gap that the hypothesis explains, over all blocks together."""
        return float(
            _share_of(self.squares_before.sum(), self.squares_after.sum(), self.noise_squares.sum())
        )

    def bootstrap_draws(self) -> FloatArray:
        """Return the shares (DRAWS,) in random sets of blocks, drawn with replacement.

        This is a block bootstrap (Kuensch 1989, Ann. Statist. 17, 1217-1241). The seed is fixed, so
        that two shares with the same number of blocks can be compared draw by draw.
        """
        block_count = len(self.squares_before)
        generator = np.random.default_rng(SEED)
        times_drawn = generator.multinomial(
            block_count, np.full(block_count, 1.0 / block_count), DRAWS
        )
        return _share_of(
            times_drawn @ self.squares_before,
            times_drawn @ self.squares_after,
            times_drawn @ self.noise_squares,
        )

    def is_larger_than(self, other_share: "GapShare") -> bool:
        """Return whether this share is significantly larger than another one (level 5 %)."""
        difference = self.bootstrap_draws() - other_share.bootstrap_draws()
        return bool(np.quantile(difference, 0.05) > 0.0)

    @property
    def interval(self) -> tuple[float, float]:
        """The ends of the 90 % interval of the share."""
        low, high = np.quantile(self.bootstrap_draws(), (0.05, 0.95))
        return float(low), float(high)


def _share_of(
    squares_before: FloatArray, squares_after: FloatArray, noise: FloatArray
) -> FloatArray:
    """Return the share of a gap that a hypothesis explains, element by element.

    The share is 1 - (squares_after - noise) / (squares_before - noise), with a numerator of at
    least zero. It is zero if `squares_before` is not larger than `noise`, as there is then no gap
    that could be explained.
    """
    gap_squares = squares_before - noise
    remaining_ratio = np.divide(
        np.maximum(squares_after - noise, 0.0),
        gap_squares,
        out=np.ones_like(gap_squares),
        where=gap_squares > 0.0,
    )
    return 1.0 - remaining_ratio
