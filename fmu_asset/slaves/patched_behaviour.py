"""What the wing with missing effects does in one communication step.

While no effect is switched on, everything is `WingBehaviour`, to the last bit. Sensor effects act on what it
gives; effects of structure and loads have a wing of their own (`fe.runtime.patched_steps`), which takes the
motion over.

This file is copied into the FMU, as `behaviour`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fe.runtime.errors import FiniteElementError
from fe.runtime.patch import ModelPatch
from fe.runtime.patched_steps import PatchedSteps
from fe.runtime.reduced import ReducedModel
from fe.runtime.sensor_stream import Sample, SensorStream, needs_structure

from .behaviour import Moment, Response, UnacceptableEffectError, WingBehaviour, WingParameters
from .effect_variables import TEMPERATURE, active_primitives, effect_rows
from .variables import TRANSIENT


class PatchedBehaviour(WingBehaviour):
    """The wing in time, with missing effects that can be switched on and changed between steps.

    Parameters
    ----------
    model, mode_count
        As of `WingBehaviour`.
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
        mode_count: int,
        effects: Sequence[Mapping[str, Any]],
        channels: tuple[tuple[str, str], ...],
        steps: Callable[..., PatchedSteps] | None = None,
    ) -> None:
        super().__init__(model, mode_count)
        self._steps_of = steps
        self._effects = effects
        self._channels = channels
        self._names = tuple(row.name for row in effect_rows(effects, 0, {}))
        self._applied: tuple[float, ...] = ()
        self._patch: ModelPatch | None = None
        self._start = 0.0
        self._steps: PatchedSteps | None = None
        self._made: tuple[object, PatchedSteps] | None = None  # the last one: it never changes
        self._motion: list[float] = []
        self._filters: list[float] | None = None
        self._shown: list[float] | None = None

    def start(
        self, parameters: WingParameters, inputs: Sequence[float], moment: Moment | None = None
    ) -> Response:
        """Find the initial state, as `WingBehaviour` does, with the effects that are on.

        Raises
        ------
        UnacceptableEffectError
            If the wing cannot have the effects.
        """
        return self._whole(lambda: self._begin(parameters, inputs, _given(moment)))

    def advance(self, inputs: Sequence[float], duration: float, moment: Moment | None = None) -> Response:
        """Advance by one step with inputs and effects held.

        Raises
        ------
        UnacceptableEffectError
            If the wing cannot have the effects; nothing changed.
        """
        return self._whole(lambda: self._proceed(inputs, duration, _given(moment)))

    def load_point_displacement(self) -> float:
        """Return the displacement of the point where the tip force acts, as it is shown [m]."""
        return super().load_point_displacement() if self._shown is None else self._shown[-1]

    def modal_data(self) -> tuple[list[float], list[float]]:
        """Return natural frequencies [Hz] and damping ratios [1] under the last inputs."""
        if self._steps is None:
            return super().modal_data()
        frequency, ratio = self._steps.modal_data()
        return frequency[: self._mode_count].tolist(), ratio[: self._mode_count].tolist()

    def state(self) -> list[float]:
        """Return all that is remembered as plain floats."""
        parts: list[Sequence[float]] = [
            super().state(),
            self._applied,
            [self._start],
            self._motion,
            [float(self._filters is not None), *(self._filters or ())],
            [float(self._shown is not None), *(self._shown or ())],
        ]
        return [number for part in parts for number in (float(len(part)), *part)]

    def restore(self, parameters: WingParameters, values: Sequence[float]) -> None:
        """Take back what `state` returned."""
        parts: list[Sequence[float]] = []
        at = 0
        for _ in range(6):
            length = int(values[at])
            parts.append(list(values[at + 1 : at + 1 + length]))
            at += 1 + length
        base, applied, (start,), motion, filters, shown = parts
        patch, steps = None, None
        if len(applied):
            patch = self._patch_of(applied)
            if self._needs_steps(patch):
                steps = self._make_steps(parameters, base[2 : 2 + self.input_count], patch, applied)
        super().restore(parameters, base)
        self._applied, self._patch, self._start, self._steps = tuple(applied), patch, start, steps
        self._motion = list(motion)
        self._filters = list(filters[1:]) if filters[0] else None
        self._shown = list(shown[1:]) if shown[0] else None

    # ------------------------------------------------------------------ steps

    def _whole(self, act: Callable[[], Response]) -> Response:
        """Do something completely, or leave everything as it was."""
        before = dict(self.__dict__)
        try:
            return act()
        except FiniteElementError as error:
            self.__dict__.update(before)
            sentence = str(error)
            raise UnacceptableEffectError(sentence if sentence.endswith(".") else f"{sentence}.") from error
        except Exception:
            self.__dict__.update(before)
            raise

    def _begin(self, parameters: WingParameters, inputs: Sequence[float], moment: Moment) -> Response:
        applied = tuple(moment.values[name] for name in self._names)
        patch = self._patch_of(applied)
        self._applied, self._patch, self._start = applied, patch, moment.start
        self._filters = self._shown = self._steps = None
        self._motion = []
        if not self._needs_steps(patch):
            return self._show(super().start(parameters, inputs), parameters, 0.0, moment)
        steps = self._make_steps(parameters, inputs, patch, applied)
        n, force = inputs[0], inputs[-1]
        if parameters.response == TRANSIENT:
            self._motion = steps.released(parameters.initial_tip_displacement, n, force)
        else:
            self._motion = steps.settled([], n, force)
        self._steps, self._parameters, self._inputs = steps, parameters, tuple(inputs)
        self._integrator = self._transient = self._bound = None
        return self._show(None, parameters, 0.0, moment)

    def _proceed(self, inputs: Sequence[float], duration: float, moment: Moment) -> Response:
        parameters = self._parameters
        if parameters is None:
            raise RuntimeError("the wing was not initialised")
        applied = tuple(moment.values[name] for name in self._names)
        before, moved = self._steps, parameters.response == TRANSIENT
        if applied != self._applied:
            patch = self._patch_of(applied)
            if self._patch is None or not _same_filters(patch, self._patch):
                self._filters = None
            self._patch = patch
        patch = self._patch if self._patch is not None else self._patch_of(applied)
        if not self._needs_steps(patch):
            if before is not None and moved:
                self._integrator, self._transient = self._let_go(before, parameters)
            self._steps, self._motion, self._applied = None, [], applied
            return self._show(super().advance(inputs, duration), parameters, duration, moment)
        steps = before
        if steps is None or applied != self._applied or tuple(inputs[1:-1]) != self._inputs[1:-1]:
            steps = self._make_steps(parameters, inputs, patch, applied)
            if before is not None:
                self._motion = steps.take_over(self._motion, before, moving=moved)
            elif self._integrator is not None and self._transient is not None:
                self._motion = steps.take_over_unpatched(self._transient, self._integrator)
            else:
                self._motion = []
        n, force = inputs[0], inputs[-1]
        if moved:
            self._motion = steps.advance(
                self._motion, duration, n, force, moment.time - duration - self._start
            )
        else:
            self._motion = steps.settled(self._motion, n, force)
        self._steps, self._applied, self._inputs = steps, applied, tuple(inputs)
        self._integrator = self._transient = self._bound = None
        return self._show(None, parameters, duration, moment)

    def _let_go(self, steps: PatchedSteps, parameters: WingParameters) -> tuple[Any, Any]:
        """Return integrator and state of the wing without effects, once the last one is off."""
        integrator = self._make_integrator(parameters, self._inputs)
        return integrator, steps.give_back(self._motion, integrator)

    def _show(
        self, response: Response | None, parameters: WingParameters, duration: float, moment: Moment
    ) -> Response:
        """Return what sensors make of a response, or of the motion of the patched wing."""
        patch = self._patch
        if patch is None or not len(patch):
            self._filters = self._shown = None
            assert response is not None
            return response
        across = shear = None
        if response is not None:
            point = super().load_point_displacement()
            values = np.append(response.strain, (response.tip_displacement, point))
        elif self._steps is not None:
            values, across, shear = self._steps.read(self._motion, moving=parameters.response == TRANSIENT)
        else:
            raise RuntimeError("there is nothing to show")
        transient = parameters.response == TRANSIENT
        stream = SensorStream(
            patch=patch,
            channels=self._channels,
            dynamic=transient,
            start=self._start,
            release=parameters.initial_tip_displacement if transient else 0.0,
        )
        sample = Sample(values, moment.time, float(moment.values.get(TEMPERATURE, 0.0)), across, shear)
        shown, self._filters = stream.read(sample, self._filters, duration)
        self._shown = shown.tolist()
        if not math.isfinite(sum(self._shown)):
            raise UnacceptableEffectError("With the effects that are on, an output is not finite.")
        return Response(shown[:-2], float(shown[-2]))

    # ------------------------------------------------------------------ patches

    def _patch_of(self, applied: Sequence[float]) -> ModelPatch:
        value = dict(zip(self._names, applied, strict=True))
        return ModelPatch.from_list(active_primitives(self._effects, value))

    def _needs_steps(self, patch: ModelPatch) -> bool:
        return len(patch) > 0 and needs_structure(patch)

    def _make_steps(
        self,
        parameters: WingParameters,
        inputs: Sequence[float],
        patch: ModelPatch,
        applied: Sequence[float],
    ) -> PatchedSteps:
        if self._steps_of is None:
            raise RuntimeError("this FMU holds no arrays for effects of structure and loads")
        key = (parameters, tuple(inputs[1:-1]), tuple(applied))
        if self._made is not None and self._made[0] == key:
            return self._made[1]
        value = dict(zip(self._names, applied, strict=True))
        steps = self._steps_of(
            young_modulus_factor=parameters.young_modulus_factor,
            stiffness_loss=tuple(inputs[1:-1]),
            servo_mass=parameters.servo_mass,
            pitot_mass=parameters.pitot_mass,
            damping_alpha=parameters.damping_alpha,
            damping_beta=parameters.damping_beta,
            patch=patch,
            temperature=float(value.get(TEMPERATURE, 0.0)),
        )
        self._made = (key, steps)
        return steps


def _given(moment: Moment | None) -> Moment:
    if moment is None:
        raise RuntimeError("a wing with effects needs their values")
    return moment


def _same_filters(one: ModelPatch, other: ModelPatch) -> bool:
    """Return whether two patches have the same chain of filters, whose memory then stays."""

    def chain(patch: ModelPatch) -> list[tuple[object, ...]]:
        return [
            (item["channel"], item["quantity"], item["order"])
            for item in patch.to_list()
            if item["kind"] == "high_pass"
        ]

    return chain(one) == chain(other)
