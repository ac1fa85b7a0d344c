"""The steps that a twin keeps, for smoothing and for late observations."""

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from reporting.arrays import Float
from twin_master.network.estimator import Carried, Estimator

RECENT_STEPS = 3
"""The last steps of which all arrays are kept: most late observations are of one of them."""
CHECKPOINT_STEPS = 40
"""Of earlier steps, all arrays are kept once in so many steps."""


@dataclass(frozen=True)
class KeptStep:
    """A step that the twin keeps.

    Attributes
    ----------
    observation : (G,) array
        The observed values, SI; NaN where nothing was received.
    carried : Carried
        The arrays that the estimator carried on from the step.
    proposals : int
        How often in a row a harder control was proposed, this step included; 0 without a `Hold`.
    is_complete : bool
        Whether `carried` has all arrays, and not only those for smoothing.
    """

    observation: Float
    carried: Carried
    proposals: int = 0
    is_complete: bool = True


class KeptSteps:
    """The last steps of a twin, by their numbers.

    The arrays with which an estimator goes on may be large. If it tells which of them smoothing
    needs (`Estimator.for_smoothing`), only these are kept of most steps. The others are computed
    anew when they are needed: the observations since the last complete step are filtered again,
    with the same result to the last bit.

    Parameters
    ----------
    estimator : Estimator
        The estimator that filters the steps.
    most : int or None
        The number of last steps that are needed; all if it is None. A few earlier ones are kept,
        too, back to a complete one.

    Attributes
    ----------
    end : int
        The number of the step after the last one.
    """

    def __init__(self, estimator: Estimator, most: int | None) -> None:
        self._estimator = estimator
        self._most = most
        self._steps: deque[KeptStep] = deque()
        self.end = 0
        # The first step that this estimator has filtered, and not that of a restored state.
        self._first_filtered = 0

    def __getitem__(self, step: int) -> KeptStep:
        """Return a kept step; an IndexError is raised if it is not kept."""
        index = step - self.end + len(self._steps)
        if index < 0:
            raise IndexError(f"step {step} is not kept")
        return self._steps[index]

    @property
    def first(self) -> int:
        """The number of the first step that is needed."""
        count = len(self._steps)
        return self.end - (count if self._most is None else min(count, self._most))

    def restore(self, end: int, steps: Iterable[KeptStep]) -> None:
        """Replace all steps by complete ones, the last of which has the number `end` - 1."""
        self._steps = deque(steps)
        self.end = end
        self._first_filtered = end

    def replace_from(self, step: int, new_steps: Sequence[KeptStep]) -> None:
        """Replace the steps from number `step` on by complete ones."""
        for _ in range(self.end - step):
            self._steps.pop()
        self._steps.extend(new_steps)
        self.end = step + len(new_steps)
        self._leave_out_arrays(step)
        self._leave_out_steps()

    def _leave_out_arrays(self, first_new: int) -> None:
        """Keep only the arrays for smoothing of steps that are no longer recent."""
        for_smoothing = getattr(self._estimator, "for_smoothing", None)
        if for_smoothing is None:
            return
        first = max(first_new - RECENT_STEPS, self._first_filtered)
        for step in range(first, self.end - RECENT_STEPS):
            kept_step = self[step]
            if kept_step.is_complete and step % CHECKPOINT_STEPS != 0:
                self._steps[step - self.end] = replace(
                    kept_step, carried=for_smoothing(kept_step.carried), is_complete=False
                )

    def _leave_out_steps(self) -> None:
        """Keep only the needed steps, and earlier ones back to the last complete step."""
        if self._most is None:
            return
        count = 0
        for index in range(1, len(self._steps) - self._most + 1):
            if self._steps[index].is_complete:
                count = index
        for _ in range(count):
            self._steps.popleft()

    def complete_steps(self, first: int, end: int) -> list[KeptStep]:
        """Return the steps from number `first` up to `end` with all arrays."""
        begin = first
        while begin < end and not self[begin].is_complete:
            begin -= 1
        complete_steps: list[KeptStep] = []
        for step in range(begin, end):
            kept_step = self[step]
            if not kept_step.is_complete:
                with np.errstate(over="ignore", invalid="ignore"):
                    estimate = self._estimator.step(
                        complete_steps[-1].carried,
                        kept_step.observation,
                        kept_step.carried.control_index,
                        step,
                    )
                kept_step = replace(kept_step, carried=estimate.carried, is_complete=True)
            complete_steps.append(kept_step)
        return complete_steps[first - begin :]
