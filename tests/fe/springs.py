"""Springs in a row as a wing: a small affine system of which everything can be solved directly."""

from dataclasses import replace
from functools import cache

import numpy as np
from scipy import sparse

from fe.reduction.reduced_basis import Reduction, reduce_structure
from fe.runtime.state import region_names
from fe.structure.affine import StiffnessTerm, designed
from fe.structure.tables import StructureSettings
from fe.wing.design import wing_structure
from fe.wing.operators import AffineWing, outputs, stiffness_parts

SETTINGS = StructureSettings(mode_count=4)
ROUGH = 0.1
"""Tolerance of `rough_springs`."""
PIECES = ((6, 20), (30, 48), (48, 56), (20, 24), (24, 28), (2, 6), (28, 30), (56, 60))
"""First and last spring, of sixty, of the damage regions of a chain; the first holds every other one."""


def springs(regions: int = 2, root: float = 1.0) -> AffineWing:
    """Sixty springs of several kinds in a row, masses along it; the first is `root` times as stiff."""
    count, random = 60, np.random.default_rng(0)
    stretch = sparse.csr_array(np.eye(count) - np.eye(count, k=-1))
    kind = np.zeros((regions + 2, count))
    kind[0, ::2] = 1.0
    for number, (first, last) in enumerate(PIECES[:regions], start=1):
        kind[number, first : last : 2 if number == 1 else 1] = 1.0
    kind[0] *= 1 - kind[1:-1].max(axis=0)
    kind[-1] = 0.2 + random.uniform(0, 0.2, count)
    kind[:, 0] *= root
    masses = np.zeros((3, count))
    masses[0] = 0.01
    masses[1, [count // 2, 3 * count // 4]] = 1.0
    masses[2, -1] = 1.0
    tip = np.eye(count)[-1]
    # each gauge is a mean over a piece of the chain, so that no spring decides alone
    places = np.linspace(0, count - 9, 24).astype(int)
    gauges = sparse.csr_array((np.eye(count)[places + 8] - np.eye(count)[places]) / 8)
    names = region_names(regions)
    terms = ((stretch.T @ sparse.diags_array(1e3 * row) @ stretch).tocsr() for row in kind)
    structure, *points = (sparse.diags_array(row).tocsr() for row in masses)
    loads = random.uniform(0.5, 1.5, count), tip
    expansion = sparse.eye_array(count).tocsr()
    design = wing_structure(names, len(places))
    return AffineWing(
        **designed(design, expansion, structure, points, loads, outputs(gauges, tip)),
        stiffness_terms=tuple(map(StiffnessTerm, terms, *zip(*stiffness_parts(names), strict=True))),
        design_hash="a chain",
    )


@cache
def reduced_springs(regions: int) -> Reduction:
    """Return the reduction, of two regions as good as usual and else to half a per cent."""
    rough = replace(SETTINGS, bound_tolerance=5e-3, most_snapshots=30)
    return reduce_structure(springs(regions), SETTINGS if regions == 2 else rough)


@cache
def rough_springs() -> Reduction:
    """Return a reduction so small that its errors are far above rounding."""
    return reduce_structure(springs(), replace(SETTINGS, bound_tolerance=ROUGH))
