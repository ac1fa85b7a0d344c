"""An FMU that returns the observations at the points of a grid, block by block."""

import numpy as np

from fmu_asset.client.session import FmiAsset
from fmu_asset.errors import FmuCallError, FmuEndedError, FmuError, FmuInputError, FmuOutputError
from reporting.arrays import Float
from twin_master.errors import MissionInputError
from twin_master.library.grid import SamplingGrid

MEMORY_TOLERANCE = 1e-8
"""Two visits of a point that differ by more than this fraction of the value show that the FMU has
a memory."""
SETTLED_TOLERANCE = 1e-3
"""Largest change, as a fraction of the value, if a point is given as many steps again to settle."""


class GridSampler:
    """An FMU that returns the observations of blocks of a grid.

    Every block begins with a reset, so that its observations do not depend on the blocks before it.

    Parameters
    ----------
    grid : SamplingGrid
        The grid.

    Raises
    ------
    FmuError
        If the FMU cannot be opened, or the binding or the grid does not fit it.
    """

    def __init__(self, grid: SamplingGrid) -> None:
        self._grid = grid
        self._asset = FmiAsset(grid.fmu, grid.binding, step_timeout=grid.step_timeout)
        self._observation_slice = self._asset.binding.observation_slice(grid.role)

    def close(self) -> None:
        """Close the FMU."""
        self._asset.close()

    def observe_block(self, first: int, last: int) -> Float:
        """Return the observations of a block of points.

        Parameters
        ----------
        first, last : int
            The first point, and the point after the last one.

        Returns
        -------
        (last - first, G) array

        Raises
        ------
        MissionInputError
            If the FMU has a memory, or does not settle.
        FmuError
            If the FMU failed. The sentence names the point.
        """
        settles = self._grid.settling_steps > 0
        # The points of a draw follow each other. An FMU without memory is started once for each
        # draw, because it takes its parameters at the start only; one that settles at each point.
        points_per_start = 1 if settles else self._grid.size // len(self._grid.draws)
        parts = []
        start = first
        next_start = first
        while next_start < last:
            start = next_start
            next_start = min((start // points_per_start + 1) * points_per_start, last)
            self._start_at(start)
            parts.append(self._observe(start, next_start))
        observations = np.concatenate(parts)
        # The last point settles once more. Without settling, other points lie between the two
        # visits of the point at the last start.
        repeated_point = last - 1 if settles else start
        self._check_repeated_point(repeated_point, observations[repeated_point - first])
        return observations

    def _start_at(self, point: int) -> None:
        """Reset the FMU with the parameters of a point, and its inputs if it settles there."""
        grid = self._grid
        draw, state, control = grid.point(point)
        parameters = dict(grid.parameters)
        parameters |= {name: values[draw] for name, values in grid.others.items()}
        if grid.parameter:
            parameters[grid.parameter] = grid.draws[draw]
        try:
            if grid.settling_steps:
                inputs = grid.controls[control]
                self._asset.reset(parameters, control=inputs, health=state, load=grid.load)
            else:
                self._asset.reset(parameters)
        except FmuError as error:
            raise self._error_at(error, point) from error

    def _observe(self, first: int, last: int) -> Float:
        """Return the observations (last - first, G) of points of one draw, after they settled."""
        grid = self._grid
        steps_per_point = max(grid.settling_steps, 1)
        states = []
        controls = []
        for point in range(first, last):
            _draw, state, control = grid.point(point)
            states += [state] * steps_per_point
            controls += [grid.controls[control]] * steps_per_point
        control_histories = {name: [control[name] for control in controls] for name in controls[0]}
        health_histories = {name: [state[name] for state in states] for name in grid.states}
        steps_before = self._asset.step_index
        try:
            history = self._asset.simulate(
                control_histories, health_histories, grid.load, steps=len(states)
            )
            if history.ended:
                raise FmuEndedError(history.ended)
        except FmuInputError:
            raise  # it comes before the first step, and names the value
        except FmuError as error:
            completed_steps = self._asset.step_index - steps_before
            if isinstance(error, FmuOutputError):
                completed_steps -= 1  # the step was made; its outputs cannot be read
            failed_point = min(first + completed_steps // steps_per_point, last - 1)
            raise self._error_at(error, failed_point) from error
        # The last step of each point.
        return history.values[steps_per_point - 1 :: steps_per_point, self._observation_slice]

    def _error_at(self, error: FmuError, point: int) -> FmuError:
        """Return an error with the name of the point at which it happened."""
        # Of a worker that ends, only the last report is known, which may be some steps earlier.
        is_located = isinstance(error, FmuCallError | FmuInputError | FmuOutputError)
        where = "at" if is_located else "at or soon after"
        sentence = f"{where} {self._point_name(point)}: {error.sentence}"
        return type(error)(sentence, error.messages)

    def _point_name(self, point: int) -> str:
        """Return state, control and parameter of a point in words."""
        grid = self._grid
        draw, state, control = grid.point(point)
        parts = [f"{name} = {value:g}" for name, value in state.items()]
        parts.append(f"control {control}")
        if grid.parameter:
            parts.append(f"{grid.parameter} = {grid.draws[draw]:g}")
        return ", ".join(parts)

    def _check_repeated_point(self, point: int, former: Float) -> None:
        """Observe a point once more, and refuse the FMU if its observation (G,) changed.

        An FMU without memory returns the same again, and one that has settled nearly the same.
        """
        settling_steps = self._grid.settling_steps
        latter = self._observe(point, point + 1)[0]
        change = np.abs(latter - former)
        tolerance = SETTLED_TOLERANCE if settling_steps else MEMORY_TOLERANCE
        if not np.any(change > tolerance * np.maximum(np.abs(former), np.abs(latter))):
            return
        worst = int(np.argmax(change))
        sensor = self._asset.binding.observation[self._grid.role].variables[worst]
        fmu = self._grid.fmu
        where = self._point_name(point)
        before = f"{sensor} = {former[worst]:.9g}"
        after = f"{latter[worst]:.9g}"
        if settling_steps:
            raise MissionInputError(
                f"the FMU {fmu} has not settled after {settling_steps} steps: at {where} it shows "
                f"{before}, and as many steps later {after}. Give a larger --settle."
            )
        raise MissionInputError(
            f"the FMU {fmu} remembers earlier steps: at {where} it shows {before} and, on a later "
            f"visit, {after}. Give --settle STEPS, in which it settles from a fresh start at each "
            "point."
        )
