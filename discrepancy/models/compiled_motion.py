"""The loops of motion with laws at ports, compiled: the files that the FMU runs as plain Python, and another.

That is the loop of `fe.runtime.motion_kernel` over steps of any lengths, under any forces on the modes. The
steps' exact parts come from outside (`discrepancy.models.stepwise`): a transition for each length, and what
the applied forces add in each step. The laws at ports are those of `fe.runtime.motion_kernel`, function by
function. Written in the subset of Python that numba compiles too.
"""

from collections.abc import Callable
from functools import cache
from inspect import getmembers, isfunction
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.records import FloatArray
from fe.compilation import callable_when_compiled, choose_when_compiled, compiled
from fe.runtime import flexible_ports, laws, motion_arrays, motion_kernel, static_path
from fe.runtime.flexible_ports import begin_flexible, carry_flexible
from fe.runtime.laws import interface
from fe.runtime.motion import Kernel
from fe.runtime.motion_arrays import SPEED, Acting, Before, Course, Linear, Ports, Samples, State
from fe.runtime.motion_kernel import (
    begin_on_modes,
    find_answer,
    find_routes,
    first_half,
    hold,
    move,
    record,
    second_half,
)

IntArray = NDArray[np.int64]


class Steps(NamedTuple):
    """K steps, M modes, J laws; boundary k is the begin of step k.

    Attributes
    ----------
    transition : (S, 2M, 2M) ndarray
        Of (q, v), one for each distinct length.
    length : (S,) ndarray
        [s].
    which : (K,) ndarray of int
        Length of each step.
    push : (K, 2M) ndarray
        What the applied forces add to (q, v) in each step.
    begin, end : (K, M) ndarray
        Modal forces at the begin and at the end of each step.
    feed : (K + 1, J) ndarray
        What loads add to the positions of the laws' ports beyond the modes.
    time : (K + 1,) ndarray
        Of the boundaries [s].
    sample : (N,) ndarray of int
        Boundary of each sample, the first at 0.
    """

    transition: FloatArray
    length: FloatArray
    which: IntArray
    push: FloatArray
    begin: FloatArray
    end: FloatArray
    feed: FloatArray
    time: FloatArray
    sample: IntArray

    def between(self, first: int, last: int) -> "Steps":
        """Return the steps between two boundaries, each of which is a sample."""
        steps, boundaries = slice(first, last), slice(first, last + 1)
        return self._replace(
            which=self.which[steps], push=self.push[steps], begin=self.begin[steps], end=self.end[steps],
            feed=self.feed[boundaries], time=self.time[boundaries], sample=np.arange(last - first + 1),
        )  # fmt: skip


class Structure(NamedTuple):
    """What moves: `coupled`, `stiffness` (M,), `damping` (M, M) and `rate` as in `Linear`; `known` memory."""

    coupled: bool
    stiffness: FloatArray
    damping: FloatArray
    rate: float
    known: bool


def integrate_steps(
    steps: tuple[Any, ...], structure: tuple[Any, ...], ports: tuple[Any, ...], state: tuple[Any, ...],
    out: tuple[Any, ...],
) -> None:  # fmt: skip
    """Integrate over the steps; given are the fields of the records above and of `motion_arrays`, unnamed."""
    go, body = Steps(*steps), Structure(*structure)
    given, moving, samples = Ports(*ports), State(*state), Samples(*out)
    modes, count = len(moving.q), len(given.numbers)
    none, whole = np.zeros((7, count)), np.zeros((3, count), dtype=np.int64)
    acting = Acting(
        whole[0], whole[1], whole[2], none[0], none[1], none[2], np.zeros((count, modes)),
        np.zeros((count, 2 * modes)),
    )  # fmt: skip
    before = Before(np.zeros(modes), np.zeros(modes), np.zeros(2 * modes), none[3], none[4], none[5], none[6])
    # the force of a step goes from `load` to `load` + `shape`, its effect on the modes is `constant`
    linear = Linear(
        go.transition[0].copy(), np.zeros(2 * modes), np.zeros(2 * modes), np.zeros(2 * modes), body.coupled,
        body.stiffness, body.damping, np.zeros(modes), go.begin[0].copy(), body.rate,
    )  # fmt: skip
    laws = Ports(
        given.rows, given.numbers, given.of_speed, given.values, given.elements, given.flexibility,
        given.relaxation, np.zeros((2, count)), given.acts,
    )  # fmt: skip
    laws.feed[1, :] = go.feed[0]
    h = go.length[go.which[0]]
    find_routes(laws, acting)
    begin_on_modes(linear, laws, acting, moving, body.known)
    begin_flexible(laws, acting, moving, Course(np.zeros(1), go.time[0], h, 1, body.known))
    record(linear, laws, acting, moving, 0.0, go.time[0], 0, samples)
    sample, last = 1, -1
    for k in range(len(go.which)):
        if go.which[k] != last:
            last = go.which[k]
            h = go.length[last]
            linear.transition[:, :] = go.transition[last]
            for j in range(count):
                if acting.route[j] == SPEED:
                    find_answer(linear, laws, acting, j)
        for m in range(modes):
            linear.load[m] = go.begin[k, m]
            linear.shape[m] = go.end[k, m] - go.begin[k, m]
            linear.constant[m] = go.push[k, m]
            linear.constant[modes + m] = go.push[k, modes + m]
        laws.feed[1, :] = go.feed[k + 1]
        first_half(linear, laws, acting, moving, before, go.time[k], h)
        move(linear, moving, before.room, 0.0, 0.0, False)
        hold(laws, acting, moving, before, h)
        carry_flexible(laws, acting, moving, 0.0, h)
        second_half(linear, laws, acting, moving, before, go.time[k], h, 0.0, 1.0)
        if k + 1 == go.sample[sample]:
            record(linear, laws, acting, moving, 1.0, go.time[k + 1], sample, samples)
            sample += 1


SELDOM = (
    motion_kernel.follow,
    motion_kernel.find_routes,
    motion_kernel.begin_on_modes,
    motion_kernel.find_answer,
    flexible_ports.begin_flexible,
    flexible_ports.settle_port,
)
"""Functions that are not called at every step; the others become part of their callers."""


def _functions(module: ModuleType) -> list[Callable[..., Any]]:
    return [item for _, item in getmembers(module, isfunction) if item.__module__ == module.__name__]


@cache
def law_functions() -> tuple[Callable[..., Any], ...]:
    """Return the functions of `fe.runtime.laws`, which compiled functions can call from then on."""
    functions = [item for module in (*laws.MODULES, interface) for item in _functions(module)]
    for function in functions:
        callable_when_compiled(function, makes_arrays=False)
    for name in interface.FUNCTIONS:
        choose_when_compiled(getattr(laws, name), laws.answers(name))
    return tuple(functions)


@cache
def _kernel_functions() -> tuple[Callable[..., Any], ...]:
    """Return the functions of the loops, which compiled functions can call from then on."""
    functions = list(law_functions())
    for module in (motion_arrays, flexible_ports, motion_kernel):
        for function in _functions(module):
            functions.append(function)
            if function is not motion_kernel.integrate:
                callable_when_compiled(function, makes_arrays=False, inline=function not in SELDOM)
    return tuple(functions)


@cache
def compiled_kernel() -> Kernel:
    """Return the compiled loops, for `kernel` of `fe.runtime.motion.simulate` and `static_solution`.

    The functions of `fe` stay plain; they can be called from compiled ones from then on.
    """
    functions = _kernel_functions()
    for function in (static_path.static_forces, static_path.arrive_at_rest):
        callable_when_compiled(function)
    return Kernel(
        compiled(motion_kernel.integrate, functions),
        compiled(static_path.static_path, functions),
    )


@cache
def compiled_steps() -> Callable[..., None]:
    """Return the compiled loop over steps of any lengths."""
    return compiled(integrate_steps, _kernel_functions())
