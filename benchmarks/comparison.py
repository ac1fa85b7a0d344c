"""The change of each figure since an earlier run of the benchmarks."""

from dataclasses import dataclass

from benchmarks.measurement import Measurement
from reporting.words import significant

NOTEWORTHY = 0.05
"""A figure that is worse by more than this share is listed."""


@dataclass(frozen=True)
class Change:
    """The change of a figure.

    Attributes
    ----------
    before, after : Measurement
        The figure of the earlier run, and that of the later one.
    """

    before: Measurement
    after: Measurement

    @property
    def relative(self) -> float:
        """The change over the earlier figure: 0.1 if the figure has grown by a tenth."""
        return self.after.value / self.before.value - 1.0

    @property
    def is_worse(self) -> bool:
        """Whether the figure has become worse by more than a share of `NOTEWORTHY`.

        A larger figure is worse, or a smaller one where larger ones are better.
        """
        if self.after.larger_is_better:
            return self.before.value > (1.0 + NOTEWORTHY) * self.after.value
        return self.after.value > (1.0 + NOTEWORTHY) * self.before.value

    @property
    def sentence(self) -> str:
        """The change in words."""
        unit = self.after.unit
        return (
            f"{self.after.name}: {significant(self.before.value)} {unit} before, "
            f"{significant(self.after.value)} {unit} now ({100 * self.relative:+.0f} %)"
        )


def change_since(before: Measurement | None, after: Measurement) -> Change | None:
    """Return the change of a figure.

    Returns
    -------
    Change or None
        None if there is no earlier figure, if it has another unit, or if one of the two is zero or
        negative, so that a share of it says nothing.
    """
    if before is None or before.unit != after.unit:
        return None
    if before.value <= 0.0 or after.value <= 0.0:
        return None
    return Change(before, after)
