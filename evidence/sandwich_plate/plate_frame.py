"""Frame stiffness of the sections: the skins as strips clamped to the webs along the chord.

A section without it would rack like a parallelogram: upper and lower skin slide against each other along the
chord while the webs turn as on hinges. The webs turn their ends of the skins with them, so that each strip
of skin between two webs bends, as the beams of a frame do.
"""

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from .plate import W
from .plate_layout import PlateLayout

FloatArray = NDArray[np.float64]


def strip_stiffness(length: FloatArray) -> FloatArray:
    """Stiffness (n, 4, 4) of beams of unit bending stiffness on deflection and slope of both ends.

    Parameters
    ----------
    length : (n,)
        Lengths [m].
    """
    one = np.ones_like(length)
    half = np.array(
        [
            [6.0 * one, 3.0 * length, -6.0 * one, 3.0 * length],
            [3.0 * length, 2.0 * length**2, -3.0 * length, length**2],
            [-6.0 * one, -3.0 * length, 6.0 * one, -3.0 * length],
            [3.0 * length, length**2, -3.0 * length, 2.0 * length**2],
        ]
    )
    return np.moveaxis(2.0 * half / length**3, 2, 0)


def frame_stiffness(layout: PlateLayout) -> sparse.csr_array:
    """Bending stiffness (5 N, 5 N) of both skins between the webs, along the chord.

    The slope of a strip's end is that of the deflection across the web, at the web's face. The panel itself
    stays as it is described by the plate, straight; only the energy of the bent strip is added.
    """
    plate, grid, skin = layout.plate, layout.half_grid, layout.design.skin
    points = plate.node_points
    distance = points[grid[0], 1]
    cell = np.diff(distance[::2])
    share = np.zeros(len(distance))  # Simpson's rule, as the nodes of an element have it
    share[:-1:2] += cell / 6.0
    share[1::2] = 4.0 * cell / 6.0
    share[2::2] += cell / 6.0
    modulus = layout.skin_modulus_at(distance / layout.design.planform.semi_span)
    bending = 2.0 * modulus * skin.thickness**3 / 12.0 / (1.0 - skin.poisson_ratio**2)
    total = sparse.csr_array((plate.unknowns, plate.unknowns))
    for left, right in itertools.pairwise(np.flatnonzero(layout.stiff_columns)):
        if right == left + 1:
            continue
        nodes = grid[[2 * left + n for n in range(3)] + [2 * right + n for n in range(3)]].T
        x = points[nodes, 0]
        ends = np.zeros((len(nodes), 4, 6))
        ends[:, 0, 2] = ends[:, 2, 3] = 1.0
        ends[:, 1, :3] = np.array([1.0, -4.0, 3.0]) / (x[:, 2] - x[:, 0])[:, None]
        ends[:, 3, 3:] = np.array([-3.0, 4.0, -1.0]) / (x[:, 5] - x[:, 3])[:, None]
        beam = strip_stiffness(x[:, 3] - x[:, 2]) * (bending * share)[:, None, None]
        blocks = np.swapaxes(ends, 1, 2) @ beam @ ends
        dofs = nodes + W * plate.nodes
        rows, columns = np.repeat(dofs, 6, axis=1).ravel(), np.tile(dofs, (1, 6)).ravel()
        total = total + sparse.coo_array((blocks.ravel(), (rows, columns)), shape=total.shape).tocsr()
    return total.tocsr()
