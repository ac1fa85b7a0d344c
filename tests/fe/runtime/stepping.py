"""Motion under forces that are linear between samples: by the loops of the product, and exactly.

Also the laws of ports by their equations, and patches of laws for tests.
"""

from functools import cache
from typing import Any

import numpy as np
from scipy.linalg import expm

from fe.runtime.arrays import FloatArray
from fe.runtime.modal_system import ModalSystem
from fe.runtime.motion import PLAIN_KERNEL, InitialMotion, Kernel, integrate_motion
from fe.runtime.motion_arrays import ModalMotion
from fe.runtime.patch import (
    BoucWen,
    FreePlay,
    MicroSlip,
    ModelPatch,
    PowerDamping,
    PowerStiffness,
    Primitive,
)
from fe.runtime.port_laws import NO_LAWS, PLANFORM, PortLaws, port_laws
from fe.runtime.time_steps import loaded_steps, step_boundaries

PORT_NAMES = ["tip", "root", "mass", PLANFORM]
"""Ports of the structures that the tests set in motion."""


def make_laws(*primitives: Primitive) -> PortLaws:
    """Return the laws of a patch whose primitives act at ports of `PORT_NAMES`."""
    return port_laws(ModelPatch(primitives), PORT_NAMES)


def simulate(
    system: ModalSystem,
    laws: PortLaws,
    *,
    q: FloatArray,
    v: FloatArray,
    force: FloatArray,
    interval: float | FloatArray,
    shape: FloatArray | float = 0.0,
    constant: FloatArray | float = 0.0,
    memory: FloatArray | None = None,
    start: float = 0.0,
    refinement: int = 1,
    substeps: int | None = None,
    kernel: Kernel | None = None,
) -> ModalMotion:
    """Return the motion at samples under the modal forces `shape * force(t) + constant`.

    Parameters
    ----------
    system, laws
        The modes, and the laws at their ports.
    q, v : (M,) array
        Modal displacements and velocities at the first sample.
    force : (N,) array
        The force at the samples, linear between them.
    interval : float or (N - 1,) array
        The time between samples [s], of all or of each.
    shape, constant : float or (M,) array
        How the force acts on the modes, and a modal force that does not change.
    memory : array
        The memory of the laws at the first sample; that of unloaded laws if None.
    start : float
        Time of the first sample [s].
    refinement : int
        By how much steps are finer than the default steps.
    substeps : int
        Steps between two samples, in the place of those that the laws need.
    kernel
        The loop over steps; that of plain Python if None.
    """
    intervals = np.broadcast_to(interval, len(force) - 1)
    stamps = np.append(0.0, np.cumsum(intervals))
    if substeps is None:
        boundaries = step_boundaries(system, laws, stamps, refinement)
    else:
        boundaries = step_boundaries(system, NO_LAWS, stamps, refinement * substeps)
    forces = np.interp(boundaries.time, stamps, force)
    modal_forces = np.outer(forces, np.broadcast_to(shape, q.shape)) + constant
    port_feed = np.zeros((len(boundaries.time), len(laws)))
    steps = loaded_steps(system, boundaries, modal_forces[:-1], modal_forces[1:], port_feed)
    steps = steps._replace(time=start + steps.time)
    return integrate_motion(
        system, laws, steps, InitialMotion(q, v, memory), kernel or PLAIN_KERNEL
    )


def exact(
    matrix: Any,
    input_matrix: Any,
    time: FloatArray,
    inputs: FloatArray,
    held: bool = False,
    first: Any = None,
) -> FloatArray:
    """Return the states (N, n) of y' = A y + B u by the matrix exponential.

    Parameters
    ----------
    matrix, input_matrix : (n, n), (n, I) array
        A and B.
    time : (N,) array
        The samples.
    inputs : (N, I) array
        The inputs u at the samples.
    held : bool
        Whether inputs are held from a sample to the next; else they are linear between them.
    first : (n,) array
        The first state; zero if None.
    """
    n, input_count = np.shape(input_matrix)
    # the states, the inputs and the slopes of the inputs as one linear system (Van Loan 1978)
    block = np.zeros((n + 2 * input_count, n + 2 * input_count))
    block[:n, :n] = matrix
    block[:n, n : n + input_count] = input_matrix
    block[n : n + input_count, n + input_count :] = np.eye(input_count)
    states = [np.zeros(n) if first is None else np.asarray(first)]
    for k, step in enumerate(np.diff(time)):
        slope = (inputs[k + 1] - inputs[k]) / step
        if held:
            slope = np.zeros(input_count)
        augmented = np.concatenate((states[-1], inputs[k], slope))
        states.append((expm(step * block) @ augmented)[:n])
    return np.array(states)


def second_order(stiffness: Any, damping: Any) -> FloatArray:
    """Return the matrix of (x, v)' where v' = -K x - D v."""
    n = len(stiffness)
    return np.block([[np.zeros((n, n)), np.eye(n)], [-np.asarray(stiffness), -np.asarray(damping)]])


# ---------------------------------------------------------------- laws by their equations


def states_of(law: Primitive) -> int:
    """Return the number of states of a law."""
    if isinstance(law, MicroSlip):
        return law.element_count
    return 1 if isinstance(law, BoucWen) else 0


def force_of(law: Any, x: float, v: float, z: FloatArray) -> float:
    """Return the force of a law at a displacement and a velocity, z the states of its elements."""
    if isinstance(law, PowerDamping):
        by_velocity = abs(v / law.reference_velocity) ** law.velocity_exponent
        by_displacement = abs(x / law.reference_displacement) ** law.displacement_exponent
        return float(law.coefficient * by_velocity * np.sign(v) * by_displacement)
    if isinstance(law, PowerStiffness):
        if law.side * x < 0.0:
            return 0.0
        size = law.coefficient * abs(x / law.reference_displacement) ** law.exponent
        return float(size * np.sign(x))
    if isinstance(law, FreePlay):
        return float(-law.stiffness * np.clip(x, -law.half_width, law.half_width))
    if len(z) == 0:
        return 0.0
    return float(law.stiffness * (z.mean() - x))


slip_displacements = cache(MicroSlip.slip_displacements)


def rates_of(law: Any, v: float, z: FloatArray) -> FloatArray:
    """Return the rates of the states of a law's elements at a velocity."""
    if len(z) == 0:
        return z
    is_loading = z * v > 0.0
    if isinstance(law, BoucWen):
        return np.where(is_loading, v * (1.0 - np.abs(z / law.yield_displacement) ** law.order), v)
    slips = is_loading & (np.abs(z) >= slip_displacements(law))
    return np.where(slips, 0.0, v)
