"""What a structure does in one communication step: static equilibrium, or its modes integrated in time.

Missing effects may be switched on and changed between steps: a patch of the structure, and sensors on what it
shows. Copied into the FMU, where `fe.runtime` is the folder `fe` beside it; `structure_behaviour.c` does the
same for a structure without effects.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import FiniteElementError
from fe.runtime.modal_system import rayleigh_damping_ratio
from fe.runtime.reduced import ReducedModel
from fe.runtime.reduced_results import ReducedResponse
from fe.runtime.transient import ModalIntegrator, TransientState

from .base import Contents, UnacceptableValuesError
from .table import MODE_COUNT, Roles, structure_table
from .variables import TRANSIENT, FmuVariable

if TYPE_CHECKING:
    from .effects import Acting, Effects


BOUND, POINT_OR_BOUND, MODES = range(3)
"""Groups of outputs that are computed when they are read."""


def later_outputs(table: Sequence[FmuVariable], roles: Roles) -> tuple[slice, ...]:
    """Return the rows of the groups `BOUND`, `POINT_OR_BOUND` and `MODES`."""
    reference = {row.name: row.reference for row in table}
    other = reference[roles.load_point or roles.displacement_bound or ""]
    bound, first = reference["strain_error_bound"], reference["frequency[1]"]
    count = 2 * sum(name.startswith("frequency[") for name in reference)
    return slice(bound, bound + 1), slice(other, other + 1), slice(first, first + count)


class StructureBehaviour:
    """A structure in time; a call either completes or raises and leaves everything as it was.

    Outputs are gauges, displacements and accelerations. While effects of structure or loads are on, and in
    every motion of a structure that can have them, it is the wing for patches that rests and moves.

    Parameters
    ----------
    model : ReducedModel
        The reduced structure.
    table : sequence of FmuVariable
        Its variables, the inputs first.
    roles : Roles
        Which of them is what.
    effects : Effects, optional
        Missing effects of a wing.
    """

    def __init__(
        self, model: ReducedModel, table: Sequence[FmuVariable], roles: Roles, effects: Effects | None = None
    ) -> None:
        self._model, self._roles, self._effects = model, roles, effects
        self._inputs = [row.name for row in table if row.causality == "input"]
        self._resting = [0.0] * len(model.accelerations)
        self._own = len(model.input_names) - len(model.controls)  # what modes depend on
        self._parameters: Mapping[str, float] = {}
        self._tuned: tuple[Mapping[str, float], float] = ({}, 0.0)
        self._moves, self._begun = False, 0.0
        self._acting: Acting | None = None  # of the effects
        self._vector: FloatArray | None = None
        self._integrator: ModalIntegrator | None = None
        self._state: TransientState | None = None  # without an integrator, the model itself is at rest
        self._static: ReducedResponse | None = None
        self._filters: list[float] | None = None
        self._shown: list[float] = []

    def tune(self, values: Mapping[str, float], start: float) -> None:
        """Take the variables of the effects by name, and the time at the start of the simulation [s]."""
        self._tuned = values, start

    def start(self, parameters: Mapping[str, float], time: float, inputs: Sequence[float]) -> Sequence[float]:
        """Begin in equilibrium under the inputs, or just let go of where a force held the structure aside.

        Raises
        ------
        UnacceptableValuesError
            If the structure cannot have the effects that are on.
        """
        return self._whole(time, 0.0, inputs, parameters)

    def advance(self, time: float, duration: float, inputs: Sequence[float]) -> Sequence[float]:
        """Advance by one step of `duration` [s] with inputs and effects held; raises as `start`."""
        if self._vector is None:
            raise RuntimeError("the structure was not initialised")
        return self._whole(time, duration, inputs)

    def later(self, group: int) -> list[float]:
        """Return the outputs of a group: the bound, the other bound or the load point, the modes."""
        if self._vector is None:
            raise RuntimeError("the structure was not initialised")
        if group == MODES:
            modes = self._model.modes(self._vector) if self._integrator is None else self._integrator.modes
            frequency = modes.frequency[:MODE_COUNT]
            return [*frequency.tolist(), *rayleigh_damping_ratio(*self._damping, frequency).tolist()]
        if group == POINT_OR_BOUND and self._roles.load_point is not None:
            # as sensors show it, where they are on
            return [self._shown[-1] if self._shown else self._point()]
        self._static = self._static or self._model.static_response(self._vector)
        bounds = self._static.strain_error_bound, self._static.displacement_error_bound
        return [bounds[group]]

    def _point(self) -> float:
        """Return the displacement of the point whose load holds the structure aside [m]."""
        if self._integrator is not None and self._state is not None:
            return self._integrator.point_displacement(self._state, self._held(self._integrator))
        self._static = self._static or self._model.static_response(self._vector)
        return float(self._model.static_load[self._roles.point_load] @ self._static.coordinates)

    def state(self) -> list[float]:
        """Return all that is remembered, without the parameters."""
        now, values = self._state, None if self._acting is None else self._acting.values
        motion = () if now is None else (now.displacement, now.velocity, now.load, *now.memory)
        parts = (self._vector, values, (self._begun,), self._filters, self._shown, *motion)
        # a part that is not there has the length -1
        told = (item for part in parts for item in ((-1.0,) if part is None else (len(part), *part)))
        return [float(len(parts)), *map(float, told)]

    def restore(self, parameters: Mapping[str, float], state: Sequence[float]) -> None:
        """Take back what `state` returned; `parameters` are those of that moment."""
        if not np.isfinite(list(state)).all():
            raise ValueError("it holds a number that is not finite")
        numbers = iter(state)
        parts = [
            None if length < 0.0 else [next(numbers) for _ in range(int(length))]
            for length in (next(numbers) for _ in range(int(next(numbers))))
        ]
        vector, values, begun, filters, shown, *motion = parts
        self._keep(parameters)
        self._static = None
        self._begun, self._filters, self._shown = (begun or [0.0])[0], filters, shown or []
        self._vector = None if vector is None else np.array(vector)
        if self._effects is not None and values is not None:
            self._acting = self._effects.acting(values)
        self._integrator = self._state = None
        if motion and self._vector is not None:
            self._integrator = self._made(self._vector)
            place, velocity, load, *memory = map(np.array, motion)
            self._state = TransientState(place, velocity, load, *([np.array(memory)] if memory else []))

    # ------------------------------------------------------------ parts

    def _keep(self, parameters: Mapping[str, float]) -> None:
        self._parameters = dict(parameters)
        self._damping = parameters["damping.alpha"], parameters["damping.beta"]
        self._moves = int(parameters["response"]) == TRANSIENT

    def _whole(
        self, time: float, duration: float, inputs: Sequence[float], start: Mapping[str, float] | None = None
    ) -> list[float]:
        """Make a step, or a start with parameters, completely, or leave everything as it was."""
        before = dict(self.__dict__)
        try:
            if start is not None:
                self._keep(start)
                self._begun = self._tuned[1]
                self._vector = self._state = self._integrator = self._filters = None
            return self._go(time, duration, inputs)
        except Exception as error:
            self.__dict__.update(before)
            if not isinstance(error, FiniteElementError):
                raise
            sentence = str(error)
            raise UnacceptableValuesError(sentence if sentence.endswith(".") else f"{sentence}.") from error

    def _go(self, time: float, duration: float, inputs: Sequence[float]) -> list[float]:
        """Begin, where there is no state yet, or advance; return the outputs."""
        changed = self._effects is not None and self._take_effects(self._effects)
        before, parameters, own = self._vector, self._parameters, self._own
        values = {**parameters, **dict(zip(self._inputs, inputs, strict=True))}
        vector = np.array([values[name] for name in self._roles.chosen])
        integrator, state, static = self._integrator, self._state, None
        if not (self._moves or (self._acting is not None and self._acting.changes_structure)):
            integrator = state = None
            static = self._model.static_response(vector)
            outputs = [*static.strain.tolist(), *static.displacement.tolist(), *self._resting]
        else:
            same = before is not None and vector[:own].tobytes() == before[:own].tobytes()
            if integrator is None or changed or not same:
                integrator = self._made(vector)
                if self._integrator is not None and state is not None:
                    state = integrator.take_over(state, self._integrator)
            load = integrator.structure.load_coefficients(vector)
            if not self._moves:
                state = integrator.equilibrium(load, state)
            elif state is not None:
                state = integrator.advance(state, duration, load, time - self._begun)
            elif self._roles.release is None:
                state = integrator.state_at_rest(load)
            else:
                state = integrator.state_after_release(
                    parameters[self._roles.release], load, self._held(integrator)
                )
            outputs = integrator.outputs(state).tolist()
        self._vector, self._integrator, self._state, self._static = vector, integrator, state, static
        return outputs if self._acting is None else self._show(outputs, duration, time + duration)

    def _held(self, integrator: ModalIntegrator) -> int:
        """Return the number of the load that holds the structure aside."""
        holding = integrator.structure.holding_load
        return self._roles.point_load if holding is None else holding

    def _take_effects(self, effects: Effects) -> bool:
        """Take the effects as they are tuned; return whether they changed."""
        values = effects.values(self._tuned[0])
        old = self._acting
        if old is not None and old.values == values:
            return False
        self._acting = effects.acting(values)
        if old is None or old.filters != self._acting.filters:
            self._filters = None
        return True

    def _show(self, values: list[float], duration: float, end: float) -> list[float]:
        """Return what sensors make of outputs."""
        assert self._effects is not None
        assert self._acting is not None
        if not len(self._acting.patch):
            self._filters, self._shown = None, []
            return values
        across = None
        if self._integrator is not None and self._state is not None and self._acting.changes_structure:
            seen = self._integrator.structure.strain_component_rows @ self._integrator.displacement(
                self._state
            )
            across = np.pad(seen, ((0, 0), (0, len(values) + 1 - seen.shape[1])))
        release = self._parameters.get(self._roles.release or "", 0.0)
        kind = "flight" if not self._moves else "ringdown" if release else "forced"
        since = end - self._begun if self._moves else end
        self._shown, self._filters = self._effects.shown(
            self._acting, np.array([*values, self._point()]), across, self._filters, duration,
            kind=kind, time=since, start=self._begun, release=release,
        )  # fmt: skip
        return self._shown[:-1]

    def _made(self, vector: FloatArray) -> ModalIntegrator:
        """Return the structure in time; that of a wing with effects in its basis for patches."""
        if self._effects is None or self._effects.wing is None:
            return ModalIntegrator(self._model.structure_at(vector), *self._damping)
        assert self._acting is not None
        return self._effects.integrator(vector, self._damping, self._acting)


def load_contents(resources: Path) -> Contents:
    """Return what the files that `fmu_asset.packing.structure_fmu` packed describe."""
    model = ReducedModel.load(resources / "reduced_model.npz")
    start = json.loads((resources / "start.json").read_text(encoding="utf-8"))
    own = {name: value for name, value in start.items() if not name.startswith("effect.")}
    table, roles = structure_table(model, own)
    later, behaviour = later_outputs(table, roles), partial(StructureBehaviour, model, table, roles)
    if not (resources / "effects.json").is_file():
        return Contents(table, behaviour, later)
    # a plain structure needs nothing of these
    from fe.runtime.patch_arrays import PatchArrays

    from .effects import Effects, effect_rows

    effects = json.loads((resources / "effects.json").read_text(encoding="utf-8"))
    file = resources / "patch_arrays.npz"
    arrays = PatchArrays.load(file) if file.is_file() else None
    rows = effect_rows(effects, len(table), start)
    return Contents(table + rows, lambda: behaviour(Effects(effects, len(model.gauges), arrays)), later)
