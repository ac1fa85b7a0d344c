"""Motion under forces that are linear between samples: by the loops of the product, and exactly."""

from functools import cache
from typing import Any

import numpy as np
from scipy.linalg import expm

from fe.runtime.arrays import FloatArray
from fe.runtime.modal_system import ModalSystem
from fe.runtime.motion import PLAIN_KERNEL, InitialMotion, Kernel, integrate_motion
from fe.runtime.motion_arrays import ModalMotion
from fe.runtime.patch import BoucWen, FreePlay, MicroSlip, PowerDamping, PowerStiffness, Primitive
from fe.runtime.port_laws import NO_LAWS, PortLaws
from fe.runtime.time_steps import loaded_steps
from fe.runtime.time_steps import step_boundaries as divided


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
    """Return the motion at samples (N,) under forces shape f(t) + constant; all intervals, or each."""
    stamps = np.append(0.0, np.cumsum(np.broadcast_to(interval, len(force) - 1)))
    boundaries = divided(system, NO_LAWS if substeps else laws, stamps, refinement * (substeps or 1))
    modal = np.outer(np.interp(boundaries.time, stamps, force), np.broadcast_to(shape, q.shape)) + constant
    feed = np.zeros((len(boundaries.time), len(laws)))
    steps = loaded_steps(system, boundaries, modal[:-1], modal[1:], feed)
    begin = InitialMotion(q, v, memory)
    return integrate_motion(
        system, laws, steps._replace(time=start + steps.time), begin, kernel or PLAIN_KERNEL
    )


def exact(
    matrix: Any, into: Any, time: FloatArray, inputs: FloatArray, held: bool = False, first: Any = None
) -> FloatArray:
    """States (N, n) of y' = A y + B u, zero at first, u (N, I) linear or held between the samples."""
    n, wide = np.shape(into)
    block = np.zeros((n + 2 * wide, n + 2 * wide))
    block[:n, :n], block[:n, n : n + wide] = matrix, into
    block[n : n + wide, n + wide :] = np.eye(wide)
    states = [np.zeros(n) if first is None else np.asarray(first)]
    for k, h in enumerate(np.diff(time)):
        slope = 0.0 * inputs[k] if held else (inputs[k + 1] - inputs[k]) / h
        states.append((expm(h * block) @ np.concatenate((states[-1], inputs[k], slope)))[:n])
    return np.array(states)


def second_order(stiffness: Any, damping: Any) -> FloatArray:
    """The matrix of (x, v)' where v' = -K x - D v."""
    n = len(stiffness)
    return np.block([[np.zeros((n, n)), np.eye(n)], [-np.asarray(stiffness), -np.asarray(damping)]])


# ---------------------------------------------------------------- laws by their equations


def states_of(law: Primitive) -> int:
    """How many states a law has."""
    return law.element_count if isinstance(law, MicroSlip) else int(isinstance(law, BoucWen))


def force_of(law: Any, x: float, v: float, z: FloatArray) -> float:
    """Force of a law at a place and a speed, z the states of its elements."""
    if isinstance(law, PowerDamping):
        size = abs(v / law.reference_velocity) ** law.velocity_exponent * np.sign(v)
        return float(
            law.coefficient * size * abs(x / law.reference_displacement) ** law.displacement_exponent
        )
    if isinstance(law, PowerStiffness):
        size = law.coefficient * abs(x / law.reference_displacement) ** law.exponent
        return float(size * np.sign(x) * (law.side * x >= 0.0))
    if isinstance(law, FreePlay):
        return float(-law.stiffness * np.clip(x, -law.half_width, law.half_width))
    return float(law.stiffness * (z.mean() - x)) if len(z) else 0.0


limits_of = cache(MicroSlip.slip_displacements)


def rates_of(law: Any, v: float, z: FloatArray) -> FloatArray:
    """Rates of the states of its elements."""
    if isinstance(law, BoucWen):
        return np.where(z * v > 0.0, v * (1.0 - np.abs(z / law.yield_displacement) ** law.order), v)
    return np.where((np.abs(z) >= limits_of(law)) & (z * v > 0.0), 0.0, v) if len(z) else z
