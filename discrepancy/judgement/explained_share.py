"""What share of the gap a hypothesis explains on trials that it did not see, and how sure that is."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from discrepancy.location.residuals import ResidualSet
from discrepancy.verdict import ExplainedShare

FloatArray = NDArray[np.float64]

WINDOWS = 16
"""Blocks into which a record in time is cut."""
SHORTEST_WINDOW = 8
"""Samples of a block at least."""
DRAWS = 2000


@dataclass(frozen=True, eq=False)
class Shares:
    """Sums of squares by block, without effect and with it.

    Attributes
    ----------
    before, after, noise : (B,) ndarray
        Sums of squared residuals over the noise of each block, and what noise alone would leave.
    trials : str
        "held-out" or "fitted".
    seed : int
        Of the bootstrap: blocks are drawn with replacement (Kuensch 1989, Ann. Statist. 17, 1217-1241).
    """

    before: FloatArray
    after: FloatArray
    noise: FloatArray
    trials: str
    seed: int = 0

    @classmethod
    def of(
        cls, before: ResidualSet, after: ResidualSet, noise: Mapping[str, float], *, seed: int = 0
    ) -> "Shares":
        """Return them from the residuals of the same trials; `noise` is the variance of each channel's noise.

        Held-out trials if there are any, else those that were fitted.
        """
        outside = before.held_out, after.held_out
        inside = before.fitted, after.fitted
        one, other = outside if outside[0] is not None and outside[1] is not None else inside
        assert one is not None
        assert other is not None
        rows = []
        for first, second in zip(one.trials, other.trials, strict=True):
            scale = np.array([noise[name] for name in first.trial.channels])
            count = len(first.used)
            parts = min(WINDOWS, max(1, count // SHORTEST_WINDOW)) if first.trial.is_dynamic else 1
            squares = [np.where(item.used, item.standardised, 0.0) ** 2 for item in (first, second)]
            for part in np.array_split(np.arange(count), parts):
                level = float((first.used[part] * scale).sum())
                rows.append((float(squares[0][part].sum()), float(squares[1][part].sum()), level))
        columns = np.array(rows).T
        return cls(columns[0], columns[1], columns[2], "fitted" if outside[0] is None else "held-out", seed)

    @property
    def value(self) -> float:
        """The explained share."""
        return _share(self.before.sum(), self.after.sum(), self.noise.sum())

    def drawn(self) -> FloatArray:
        """Return the explained share at draws of the bootstrap, the same blocks for equal seeds."""
        count = len(self.before)
        times = np.random.default_rng(self.seed).multinomial(count, np.full(count, 1.0 / count), DRAWS)
        sums = [times @ column for column in (self.before, self.after, self.noise)]
        return np.array([_share(*row) for row in zip(*sums, strict=True)])

    def told_from(self, other: "Shares") -> bool:
        """Whether this share is larger than that of another hypothesis beyond chance (5 %)."""
        return bool(np.quantile(self.drawn() - other.drawn(), 0.05) > 0.0)

    def summary(self) -> ExplainedShare:
        """Return the record for the verdict."""
        low, high = np.quantile(self.drawn(), (0.05, 0.95))
        before, after, noise = (float(column.sum()) for column in (self.before, self.after, self.noise))
        noise_share = min(noise / before, 1.0)
        remainder = min(max(after - noise, 0.0) / before, 1.0 - noise_share)
        return ExplainedShare(
            value=self.value,
            low=float(low),
            high=float(high),
            left=float(np.sqrt(max(after - noise, 0.0) / noise)),
            effect=1.0 - noise_share - remainder,
            remainder=remainder,
            noise=noise_share,
            trials=self.trials,
        )


def _share(before: float, after: float, noise: float) -> float:
    """Return 1 - (after - noise) / (before - noise); noughts where there is no gap, no more than one."""
    gap = before - noise
    return 1.0 - max(after - noise, 0.0) / gap if gap > 0.0 else 0.0
