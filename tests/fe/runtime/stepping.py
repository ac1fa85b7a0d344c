"""Motion under a force that is linear between evenly spaced samples, by the loops of the product."""

import numpy as np
from numpy.typing import NDArray

from fe.runtime.modal_system import ModalSystem
from fe.runtime.motion import NO_LAWS, PLAIN, Kernel, Laws
from fe.runtime.stepwise import Begin, ModalMotion, advance, steps_under
from fe.runtime.stepwise import substeps as divided

FloatArray = NDArray[np.float64]


def simulate(
    system: ModalSystem,
    laws: Laws,
    *,
    q: FloatArray,
    v: FloatArray,
    force: FloatArray,
    interval: float,
    shape: FloatArray | float = 0.0,
    constant: FloatArray | float = 0.0,
    memory: FloatArray | None = None,
    start: float = 0.0,
    refinement: int = 1,
    substeps: int | None = None,
    kernel: Kernel | None = None,
) -> ModalMotion:
    """Return the motion at samples (N,) under modal forces shape f(t) + constant."""
    stamps = interval * np.arange(len(force))
    boundaries = divided(system, NO_LAWS if substeps else laws, stamps, refinement * (substeps or 1))
    modal = np.outer(np.interp(boundaries.time, stamps, force), np.broadcast_to(shape, q.shape)) + constant
    feed = np.zeros((len(boundaries.time), len(laws)))
    steps = steps_under(system, boundaries, modal[:-1], modal[1:], feed)
    begin = Begin(q, v, memory)
    return advance(system, laws, steps._replace(time=start + steps.time), begin, kernel or PLAIN)
