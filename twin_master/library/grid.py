"""The grid over which an FMU is sampled, and one worker's way through a block of it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import prod

import numpy as np
from numpy.typing import NDArray

from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import FmuCallError, FmuEndedError, FmuError, FmuInputError, FmuOutputError
from twin_master.errors import InvalidObservationLibraryError
from twin_master.sentences import said

Float = NDArray[np.float64]

STEP_TIMEOUT = 60.0
"""Wall-clock limit of a step where nothing else is said [s]."""
MEMORY_TOLERANCE = 1e-8
"""Two visits of a point that differ by more than this share of the value show that the FMU remembers."""
SETTLED_TOLERANCE = 1e-3
"""What may still change, as a share of the value, when a point is given as many steps again to settle."""

_LONGEST_BLOCK = 4096
_BLOCKS = 64


@dataclass(frozen=True)
class SamplingGrid:
    """What is sampled; plain values.

    Attributes
    ----------
    fmu, binding : str
        The files.
    role : str
        Observation of the binding.
    parameter : str
        The uncertain parameter; empty without one.
    draws : tuple of float
        Its values; one, of no meaning, without a parameter.
    states : dict of str to tuple of float
        Levels of each state factor, the outermost first.
    controls : dict of str to dict of str to float
        Value of each control input under each control.
    load, parameters : dict of str to float
        What else is set; parameters but the uncertain one.
    settling_steps : int
        Steps from a fresh start at every point; 0 for an FMU without memory.
    step_timeout : float
        Wall-clock limit of a step [s].
    """

    fmu: str
    binding: str
    role: str
    parameter: str
    draws: tuple[float, ...]
    states: Mapping[str, tuple[float, ...]]
    controls: Mapping[str, Mapping[str, float]]
    load: Mapping[str, float] = field(default_factory=dict)
    parameters: Mapping[str, float] = field(default_factory=dict)
    settling_steps: int = 0
    step_timeout: float = STEP_TIMEOUT

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of draws, levels of each factor, and controls."""
        return (len(self.draws), *(len(levels) for levels in self.states.values()), len(self.controls))

    @property
    def size(self) -> int:
        """Number of points."""
        return prod(self.shape)

    @property
    def blocks(self) -> tuple[tuple[int, int], ...]:
        """First and last point (excluded) of each block; they depend on nothing but the grid."""
        length = min(_LONGEST_BLOCK, max(1, -(-self.size // _BLOCKS)))
        return tuple((first, min(first + length, self.size)) for first in range(0, self.size, length))

    def point(self, index: int) -> tuple[int, dict[str, float], str]:
        """Return draw, state and name of the control of a point."""
        draw, *levels, control = (int(part) for part in np.unravel_index(index, self.shape))
        state = {
            name: float(values[level])
            for (name, values), level in zip(self.states.items(), levels, strict=True)
        }
        return draw, state, list(self.controls)[control]


class GridSampler:
    """An FMU that is asked for the observations of blocks of a grid.

    Every block begins with a reset, so that what it gives does not depend on the blocks before it.

    Parameters
    ----------
    grid : SamplingGrid
        What is sampled.

    Raises
    ------
    FmuError
        The FMU cannot be opened, or binding or grid do not fit it.
    """

    def __init__(self, grid: SamplingGrid) -> None:
        self._grid = grid
        self._asset = FmiAsset(grid.fmu, grid.binding, step_timeout=grid.step_timeout)
        self._chosen = self._asset.binding.observation_slice(grid.role)

    def close(self) -> None:
        """End the FMU."""
        self._asset.close()

    def block(self, first: int, last: int) -> Float:
        """Return the observations (last - first, G).

        Raises
        ------
        InvalidObservationLibraryError
            The FMU has a memory, or does not settle.
        FmuError
            The FMU failed; the sentence names the point.
        """
        length = 1 if self._grid.settling_steps else self._grid.size // len(self._grid.draws)
        parts, end = [], first
        while end < last:
            begin, end = end, min(end - end % length + length, last)
            self._start(begin)
            parts.append(self._ask(begin, end))
        values = np.concatenate(parts)
        again = last - 1 if self._grid.settling_steps else begin  # with other points in between
        self._check_again(again, values[again - first])
        return values

    def _start(self, index: int) -> None:
        grid = self._grid
        draw, state, control = grid.point(index)
        setting = dict(grid.parameters)
        if grid.parameter:
            setting[grid.parameter] = grid.draws[draw]
        try:
            if grid.settling_steps:
                self._asset.reset(setting, control=grid.controls[control], health=state, load=grid.load)
            else:
                self._asset.reset(setting)
        except FmuError as error:
            raise self._located(error, index) from error

    def _ask(self, first: int, last: int) -> Float:
        """Return the observations of points of one draw, of which each may have its steps to settle."""
        grid, before = self._grid, self._asset.step_index
        steps = max(grid.settling_steps, 1)
        points = [point for point in map(grid.point, range(first, last)) for _ in range(steps)]
        controls = [grid.controls[control] for _, _, control in points]
        try:
            seen = self._asset.simulate(
                {name: [control[name] for control in controls] for name in controls[0]},
                {name: [state[name] for _, state, _ in points] for name in grid.states},
                grid.load,
                steps=len(points),
            )
            if seen.ended:
                raise FmuEndedError(seen.ended)
        except FmuInputError:
            raise  # before the first step; it names the value
        except FmuError as error:
            made = self._asset.step_index - before - isinstance(error, FmuOutputError)
            raise self._located(error, first + min(made // steps, last - first - 1)) from error
        return seen.values[steps - 1 :: steps, self._chosen]

    def _located(self, error: FmuError, index: int) -> FmuError:
        # What ends a worker is located by its last report only.
        later = not isinstance(error, FmuCallError | FmuInputError | FmuOutputError)
        where = "at or soon after" if later else "at"
        return type(error)(f"{where} {self._name(index)}: {error.sentence}", error.messages)

    def _name(self, index: int) -> str:
        grid = self._grid
        draw, state, control = grid.point(index)
        parts = [f"{name} = {value:g}" for name, value in state.items()] + [f"control {control}"]
        if grid.parameter:
            parts.append(f"{grid.parameter} = {grid.draws[draw]:g}")
        return ", ".join(parts)

    def _check_again(self, index: int, before: Float) -> None:
        """Ask for a point once more: an FMU without memory shows the same, one that has settled nearly so."""
        steps = self._grid.settling_steps
        again = self._ask(index, index + 1)[0]
        change = np.abs(again - before)
        tolerance = SETTLED_TOLERANCE if steps else MEMORY_TOLERANCE
        if not np.any(change > tolerance * np.maximum(np.abs(before), np.abs(again))):
            return
        worst = int(np.argmax(change))
        sensor = self._asset.binding.observation[self._grid.role].variables[worst]
        shown = f"{sensor} = {before[worst]:.9g}"
        of = {"grid": self._grid, "place": self._name(index), "shown": shown, "later": again[worst]}
        why = said("library.unsettled" if steps else "library.remembers", **of)
        raise InvalidObservationLibraryError(why)
