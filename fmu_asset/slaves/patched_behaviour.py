"""What the wing with missing effects does in one communication step.

While no effect of structure or loads is switched on, it is `StructureBehaviour` that moves. Sensor effects
act on what that gives; effects of structure and loads have a wing of their own (`fe.runtime.patched_steps`),
which takes the motion over.

This file is copied into the FMU, as `behaviour`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fe.runtime.errors import FiniteElementError
from fe.runtime.patch import ModelPatch
from fe.runtime.patched_steps import PatchedSteps
from fe.runtime.reduced import ReducedModel
from fe.runtime.sensor_stream import Sample, SensorStream, needs_structure

from .base import UnacceptableValuesError
from .behaviour import StructureBehaviour
from .effect_variables import TEMPERATURE, active_primitives, effect_rows
from .table import MODE_COUNT, Roles
from .variables import TRANSIENT, FmuVariable

FloatArray = npt.NDArray[np.float64]


class PatchedBehaviour(StructureBehaviour):
    """The wing in time, with missing effects that can be switched on and changed between steps.

    Parameters
    ----------
    model, table, roles
        As of `StructureBehaviour`, of a wing.
    effects : sequence of mapping
        `id` and `primitives` of each effect.
    channels : tuple of (str, str)
        Outputs that sensors show, with their quantities: strains, tip displacement, load point displacement.
    steps : callable, optional
        Makes `PatchedSteps`; None where the effects are of sensors alone.
    """

    def __init__(
        self,
        model: ReducedModel,
        table: Sequence[FmuVariable],
        roles: Roles,
        effects: Sequence[Mapping[str, Any]],
        channels: tuple[tuple[str, str], ...],
        steps: Callable[..., PatchedSteps] | None = None,
    ) -> None:
        super().__init__(model, table, roles)
        self._steps_of = steps
        self._effects = effects
        self._channels = channels
        self._names = tuple(row.name for row in effect_rows(effects, 0, {}))
        self._tuned: tuple[Mapping[str, float], float] = ({}, 0.0)
        self._applied: tuple[float, ...] = ()
        self._patch = ModelPatch()
        self._begun = 0.0
        self._steps: PatchedSteps | None = None
        self._made: tuple[object, PatchedSteps] | None = None  # the last one: it never changes
        self._stepped: list[float] = []
        self._filters: list[float] | None = None
        self._shown: list[float] | None = None

    def tune(self, values: Mapping[str, float], start: float) -> None:
        """Take the variables of the effects by name, and the time at the start of the simulation [s]."""
        self._tuned = values, start

    def start(self, parameters: Mapping[str, float], time: float, inputs: Sequence[float]) -> Sequence[float]:
        """Find the initial state, as `StructureBehaviour` does, with the effects that are on.

        Raises
        ------
        UnacceptableValuesError
            If the wing cannot have the effects.
        """
        return self._whole(lambda: self._begin(parameters, time, inputs))

    def advance(self, time: float, duration: float, inputs: Sequence[float]) -> Sequence[float]:
        """Advance by one step with inputs and effects held.

        Raises
        ------
        UnacceptableValuesError
            If the wing cannot have the effects; nothing changed.
        """
        return self._whole(lambda: self._proceed(time, duration, inputs))

    def load_point_displacement(self) -> float:
        """Return the displacement of the point where the tip force acts, as it is shown [m]."""
        return super().load_point_displacement() if self._shown is None else self._shown[-1]

    def modal_data(self) -> list[float]:
        """Return natural frequencies [Hz], then damping ratios [1], under the last inputs."""
        if self._steps is None:
            return super().modal_data()
        return [value for part in self._steps.modal_data() for value in part[:MODE_COUNT].tolist()]

    def state(self) -> list[float]:
        """Return all that is remembered as plain floats."""
        parts: list[Sequence[float]] = [
            super().state(),
            self._applied,
            [self._begun],
            self._stepped,
            [float(self._filters is not None), *(self._filters or ())],
            [float(self._shown is not None), *(self._shown or ())],
        ]
        return [number for part in parts for number in (float(len(part)), *part)]

    def restore(self, parameters: Mapping[str, float], state: Sequence[float]) -> None:
        """Take back what `state` returned."""
        parts: list[Sequence[float]] = []
        at = 0
        for _ in range(6):
            length = int(state[at])
            parts.append(list(state[at + 1 : at + 1 + length]))
            at += 1 + length
        base, applied, (begun,), stepped, filters, shown = parts
        patch, steps = ModelPatch(), None
        if len(applied):
            patch = self._patch_of(applied)
            if needs_structure(patch):
                vector = np.array(base[: len(self._model.chosen)])
                steps = self._make_steps(parameters, vector, patch, applied)
        super().restore(parameters, base)
        self._applied, self._patch, self._begun, self._steps = tuple(applied), patch, begun, steps
        self._stepped = list(stepped)
        self._filters = list(filters[1:]) if filters[0] else None
        self._shown = list(shown[1:]) if shown[0] else None

    # ------------------------------------------------------------------ steps

    def _whole(self, act: Callable[[], list[float]]) -> list[float]:
        """Do something completely, or leave everything as it was."""
        before = dict(self.__dict__)
        try:
            return act()
        except FiniteElementError as error:
            self.__dict__.update(before)
            sentence = str(error)
            raise UnacceptableValuesError(sentence if sentence.endswith(".") else f"{sentence}.") from error
        except Exception:
            self.__dict__.update(before)
            raise

    def _begin(self, parameters: Mapping[str, float], time: float, inputs: Sequence[float]) -> list[float]:
        values, self._begun = self._tuned
        self._applied = tuple(values[name] for name in self._names)
        self._patch = patch = self._patch_of(self._applied)
        self._filters = self._shown = self._steps = None
        self._stepped = []
        self._parameters = dict(parameters)
        if not needs_structure(patch):
            return self._show(super().start(parameters, time, inputs), 0.0, time)
        vector = self._chosen(parameters, inputs)
        self._steps = steps = self._make_steps(parameters, vector, patch, self._applied)
        loads = vector[-2:].tolist()
        if self._moving:
            self._stepped = steps.released(parameters["initial_tip_displacement"], *loads)
        else:
            self._stepped = steps.settled([], *loads)
        self._vector, self._motion, self._static = vector, None, None
        return self._show(None, 0.0, time)

    def _proceed(self, time: float, duration: float, inputs: Sequence[float]) -> list[float]:
        old, before = self._vector, self._steps
        if old is None:
            raise RuntimeError("the wing was not initialised")
        applied = tuple(self._tuned[0][name] for name in self._names)
        changed = applied != self._applied
        if changed:
            patch = self._patch_of(applied)
            if not _same_filters(patch, self._patch):
                self._filters = None
            self._patch, self._applied = patch, applied
        if not needs_structure(self._patch):
            if before is not None and self._moving:
                integrator = self._integrator(self._parameters, old)
                self._motion = integrator, before.give_back(self._stepped, integrator)
            self._steps, self._stepped = None, []
            return self._show(super().advance(time, duration, inputs), duration, time + duration)
        vector = self._chosen(self._parameters, inputs)
        steps = before
        if steps is None or changed or vector[:-2].tolist() != old[:-2].tolist():
            steps = self._make_steps(self._parameters, vector, self._patch, applied)
            if before is not None:
                self._stepped = steps.take_over(self._stepped, before, moving=self._moving)
            elif self._motion is not None:
                integrator, state = self._motion
                self._stepped = steps.take_over_unpatched(state, integrator)
            else:
                self._stepped = []
        loads = vector[-2:].tolist()
        if self._moving:
            self._stepped = steps.advance(self._stepped, duration, loads[0], loads[1], time - self._begun)
        else:
            self._stepped = steps.settled(self._stepped, *loads)
        self._steps, self._vector, self._motion, self._static = steps, vector, None, None
        return self._show(None, duration, time + duration)

    @property
    def _moving(self) -> bool:
        return int(self._parameters["response"]) == TRANSIENT

    def _show(self, outputs: Sequence[float] | None, duration: float, end: float) -> list[float]:
        """Return what sensors make of outputs, or of the motion of the patched wing."""
        if not len(self._patch):
            self._filters = self._shown = None
            assert outputs is not None
            return list(outputs)
        across = shear = None
        if outputs is not None:
            values = np.append(outputs, super().load_point_displacement())
        elif self._steps is not None:
            values, across, shear = self._steps.read(self._stepped, moving=self._moving)
        else:
            raise RuntimeError("there is nothing to show")
        stream = SensorStream(
            patch=self._patch,
            channels=self._channels,
            dynamic=self._moving,
            start=self._begun,
            release=self._parameters["initial_tip_displacement"] if self._moving else 0.0,
        )
        sample = Sample(values, end, float(self._tuned[0].get(TEMPERATURE, 0.0)), across, shear)
        shown, self._filters = stream.read(sample, self._filters, duration)
        self._shown = shown.tolist()
        if not math.isfinite(sum(self._shown)):
            raise UnacceptableValuesError("With the effects that are on, an output is not finite.")
        return self._shown[:-1]

    # ------------------------------------------------------------------ patches

    def _patch_of(self, applied: Sequence[float]) -> ModelPatch:
        value = dict(zip(self._names, applied, strict=True))
        return ModelPatch.from_list(active_primitives(self._effects, value))

    def _make_steps(
        self,
        parameters: Mapping[str, float],
        vector: FloatArray,
        patch: ModelPatch,
        applied: Sequence[float],
    ) -> PatchedSteps:
        if self._steps_of is None:
            raise RuntimeError("this FMU holds no arrays for effects of structure and loads")
        key = (tuple(vector[:-2].tolist()), self._damping(parameters), tuple(applied))
        if self._made is not None and self._made[0] == key:
            return self._made[1]
        value = dict(zip(self._names, applied, strict=True))
        warmer = float(value.get(TEMPERATURE, 0.0))
        steps = self._steps_of(vector, damping=self._damping(parameters), patch=patch, temperature=warmer)
        self._made = (key, steps)
        return steps


def _same_filters(one: ModelPatch, other: ModelPatch) -> bool:
    """Return whether two patches have the same chain of filters, whose memory then stays."""

    def chain(patch: ModelPatch) -> list[tuple[object, ...]]:
        return [
            (item["channel"], item["quantity"], item["order"])
            for item in patch.to_list()
            if item["kind"] == "high_pass"
        ]

    return chain(one) == chain(other)
