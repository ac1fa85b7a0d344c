"""Sampling an FMU at the points of a grid, block by block."""

import numpy as np

from fmu_asset.client.session import FmiAsset
from fmu_asset.errors import FmuCallError, FmuEndedError, FmuError, FmuInputError, FmuOutputError
from reporting.arrays import Float
from twin_master.errors import MissionInputError
from twin_master.library.grid import SamplingGrid

MEMORY_TOLERANCE = 1e-8
"""Largest difference of two observations at the same point of an FMU without memory, as a fraction
of the value; a larger one shows that the FMU remembers earlier steps."""
SETTLED_TOLERANCE = 1e-3
"""Largest change of a settled observation, as a fraction of the value, in another `settling_steps`
steps."""


class GridSampler:
    """An FMU that is sampled at the points of a grid, block by block.

    Every block begins with a reset of the FMU, so that its observations do not depend on the blocks
    before it.

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
        """Return the observations of a block of points, and check that they are repeatable.

        Parameters
        ----------
        first, last : int
            The first point, and the point after the last one.

        Returns
        -------
        (last - first, G) array
            The values of the G sensors at each point.

        Raises
        ------
        MissionInputError
            If the FMU has a memory, or does not settle.
        FmuError
            If the FMU failed. The message names the point.
        """
        settles = self._grid.settling_steps > 0
        # The draw varies slowest over the points. Parameters can be set only at the start of the
        # FMU, so that an FMU without memory is started once for each draw. An FMU that settles is
        # started at each point.
        points_per_start = 1 if settles else self._grid.size // len(self._grid.draws)
        observations_per_start = []
        start = first
        next_start = first
        while next_start < last:
            start = next_start
            next_start = min((start // points_per_start + 1) * points_per_start, last)
            self._start_at(start)
            observations_per_start.append(self._observe(start, next_start))
        observations = np.concatenate(observations_per_start)
        # Check that an observation depends on its point alone, by repeating one without a new
        # start. If the FMU settles, it makes as many steps again at its last point: the observation
        # must not change any more. If it has no memory, it returns to the point of its last start:
        # an FMU that remembered the points in between would give another observation.
        repeated_point = last - 1 if settles else start
        self._check_repeated_point(repeated_point, observations[repeated_point - first])
        return observations

    def _start_at(self, point: int) -> None:
        """Reset the FMU to the parameters of a point, and to its inputs if the FMU must settle."""
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
        """Return the observations (last - first, G) at points of one draw, each after settling.

        All points are simulated in one run, with `settling_steps` steps, at least one, at each.
        """
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
            raise  # a value is refused before the first step, and the error names it
        except FmuError as error:
            completed_steps = self._asset.step_index - steps_before
            if isinstance(error, FmuOutputError):
                completed_steps -= 1  # the step was made; its outputs cannot be read
            failed_point = min(first + completed_steps // steps_per_point, last - 1)
            raise self._error_at(error, failed_point) from error
        # Only the last step at each point counts.
        return history.values[steps_per_point - 1 :: steps_per_point, self._observation_slice]

    def _error_at(self, error: FmuError, point: int) -> FmuError:
        """Return an error whose message begins with the point at which it happened."""
        # A worker that ends abruptly has reported its progress some steps earlier.
        is_located = isinstance(error, FmuCallError | FmuInputError | FmuOutputError)
        where = "at" if is_located else "at or soon after"
        sentence = f"{where} {self._point_name(point)}: {error.sentence}"
        return type(error)(sentence, error.messages)

    def _point_name(self, point: int) -> str:
        """Return the state, control and parameter of a point in words, for messages."""
        grid = self._grid
        draw, state, control = grid.point(point)
        settings = [f"{name} = {value:g}" for name, value in state.items()]
        settings.append(f"control {control}")
        if grid.parameter:
            settings.append(f"{grid.parameter} = {grid.draws[draw]:g}")
        return ", ".join(settings)

    def _check_repeated_point(self, point: int, first_observation: Float) -> None:
        """Observe a point again, and refuse the FMU if the observation (G,) has changed too much.

        An FMU without memory returns the same values, and an FMU that has settled nearly the same.
        """
        settling_steps = self._grid.settling_steps
        repeated_observation = self._observe(point, point + 1)[0]
        change = np.abs(repeated_observation - first_observation)
        tolerance = SETTLED_TOLERANCE if settling_steps else MEMORY_TOLERANCE
        if not np.any(
            change > tolerance * np.maximum(np.abs(first_observation), np.abs(repeated_observation))
        ):
            return
        worst_sensor = int(np.argmax(change))
        variable = self._asset.binding.observation[self._grid.role].variables[worst_sensor]
        fmu = self._grid.fmu
        point_name = self._point_name(point)
        former_value = f"{variable} = {first_observation[worst_sensor]:.9g}"
        latter_value = f"{repeated_observation[worst_sensor]:.9g}"
        if settling_steps:
            raise MissionInputError(
                f"the FMU {fmu} has not settled after {settling_steps} steps: at {point_name} it "
                f"shows {former_value}, and as many steps later {latter_value}. Give a larger "
                "--settle."
            )
        raise MissionInputError(
            f"the FMU {fmu} remembers earlier steps: at {point_name} it shows {former_value} and, "
            f"on a later visit, {latter_value}. Give --settle STEPS, in which it settles from a "
            "fresh start at each point."
        )
