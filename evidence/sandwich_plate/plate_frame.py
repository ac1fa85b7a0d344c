"""Frame stiffness of the sections: the skins as strips clamped to the webs along the chord.

Without it, a section would rack like a parallelogram: the upper and the lower skin slide against
each other along the chord while the webs turn as on hinges. In fact the webs turn the ends of the
skins with them. So each strip of skin between two webs bends like a beam of a frame.
"""

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from .plate import W
from .plate_layout import PlateLayout

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

NODES_ACROSS_WEB = 3
STRIP_NODES = 2 * NODES_ACROSS_WEB
"""Nodes of a strip: those across the web at its first end, then those at its second end."""
FIRST_END_NODE = NODES_ACROSS_WEB - 1
SECOND_END_NODE = NODES_ACROSS_WEB
FIRST_DEFLECTION, FIRST_SLOPE, SECOND_DEFLECTION, SECOND_SLOPE = range(4)
END_UNKNOWNS = 4
"""Unknowns of a beam: deflection and slope of both ends."""
SLOPE_AT_FIRST_NODE = np.array([-3.0, 4.0, -1.0])
SLOPE_AT_LAST_NODE = np.array([1.0, -4.0, 3.0])
"""Slope of a parabola at the first and last of three equidistant nodes, times their distance."""


def strip_stiffness(length: FloatArray) -> FloatArray:
    """Return the stiffness (n, 4, 4) of beams of unit bending stiffness.

    The unknowns are deflection and slope of both ends.

    Parameters
    ----------
    length : (n,) array
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
    """Return the bending stiffness (5 N, 5 N) of both skins between the webs, along the chord.

    The slope at the end of a strip is that of the deflection across the web, at the face of the
    web. The panel itself stays straight, as in the plate; only the energy of the bent strip is
    added.
    """
    plate = layout.plate
    skin = layout.design.skin
    _, distance = plate.node_points[layout.half_grid[0]].T
    modulus = layout.skin_modulus_at(distance / layout.design.planform.semi_span)
    bending = 2.0 * modulus * skin.thickness**3 / 12.0 / (1.0 - skin.poisson_ratio**2)
    bending_of_strips = bending * _simpson_weights(distance)
    stiffness = plate.no_stiffness()
    for web, next_web in itertools.pairwise(np.flatnonzero(layout.stiff_columns).tolist()):
        if next_web > web + 1:
            nodes = _strip_nodes(layout, web, next_web)
            stiffness = stiffness + _strips_between_webs(layout, nodes, bending_of_strips)
    return stiffness.tocsr()


def _simpson_weights(distance: FloatArray) -> FloatArray:
    """Return the weights (n,) of the nodes of quadratic elements along a line, by Simpson's rule.

    Parameters
    ----------
    distance : (n,) array
        Positions of the nodes [m]: corners and middles in turn.
    """
    cell = np.diff(distance[::2])
    weights = np.zeros(len(distance))
    weights[:-1:2] += cell / 6.0
    weights[1::2] = 4.0 * cell / 6.0
    weights[2::2] += cell / 6.0
    return weights


def _strip_nodes(layout: PlateLayout, web: int, next_web: int) -> IntArray:
    """Return the nodes (strips, 6) across two webs that fill two columns of cells."""
    lines_across_web = 2 * web + np.arange(NODES_ACROSS_WEB)
    lines_across_next_web = 2 * next_web + np.arange(NODES_ACROSS_WEB)
    lines = np.concatenate((lines_across_web, lines_across_next_web))
    return np.asarray(layout.half_grid[lines].T)


def _strips_between_webs(
    layout: PlateLayout, nodes: IntArray, bending: FloatArray
) -> sparse.csr_array:
    """Return the stiffness (5 N, 5 N) of the strips between two webs.

    Parameters
    ----------
    layout : PlateLayout
        The plate.
    nodes : (strips, 6) array
        Nodes of each strip.
    bending : (strips,) array
        Bending stiffness of each strip [N m^2].
    """
    plate = layout.plate
    x, _ = np.moveaxis(plate.node_points[nodes], -1, 0)
    first_web_start, _, first_web_end, second_web_start, _, second_web_end = x.T
    first_width = first_web_end - first_web_start
    second_width = second_web_end - second_web_start
    length = second_web_start - first_web_end

    # Deflections and slopes of the ends of each strip from the deflections of its nodes
    ends = np.zeros((len(nodes), END_UNKNOWNS, STRIP_NODES))
    ends[:, FIRST_DEFLECTION, FIRST_END_NODE] = 1.0
    ends[:, SECOND_DEFLECTION, SECOND_END_NODE] = 1.0
    ends[:, FIRST_SLOPE, :NODES_ACROSS_WEB] = SLOPE_AT_LAST_NODE / first_width[:, np.newaxis]
    ends[:, SECOND_SLOPE, NODES_ACROSS_WEB:] = SLOPE_AT_FIRST_NODE / second_width[:, np.newaxis]

    beam = strip_stiffness(length) * bending[:, np.newaxis, np.newaxis]
    blocks = np.swapaxes(ends, 1, 2) @ beam @ ends
    unknowns = nodes + W * plate.nodes
    rows = np.repeat(unknowns, STRIP_NODES, axis=1).ravel()
    columns = np.tile(unknowns, (1, STRIP_NODES)).ravel()
    return sparse.coo_array(
        (blocks.ravel(), (rows, columns)), shape=(plate.unknowns, plate.unknowns)
    ).tocsr()
