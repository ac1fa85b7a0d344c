"""Full operators of the primitives of `fe.runtime.patch`: what a missing effect does to the full model.

Stations are the sections of the mesh that hold nodes: its lines along the span and the middles between them.
Forces and displacements of a section are those of lines along the span, the elastic line (the chord line of
the static test) and the webs; between two of them the section moves as a straight line, beyond the outermost
as the straight line through the last two, and a force goes to two lines by the law of the lever. A force
between two webs therefore does not dent the thin skin; nor would one in a test, where a clamp or a cord
around the section takes it.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy import sparse

from fe.runtime.arrays import FloatArray
from fe.runtime.state import STANDARD_GRAVITY

from . import operators as full
from .design import WingDesign

LEAST_LINE_DISTANCE = 0.1
"""Least distance between lines of a section, as a fraction of the chord."""


class PatchOperators(NamedTuple):
    """What `fe.runtime.wing_rows.PatchArrays` hold of a wing, on its n free unknowns, by the same names.

    Attributes
    ----------
    operators : AffineOperators
        The wing that they belong to.
    rows : dict of str to csr (..., n), (n,), or a tuple of csr
        What is multiplied with a basis; of `strain_rows` the first are `AffineOperators.gauge_output`.
    plain : dict of str to array or float
        What has no unknowns.
    strips : tuple of csr (n, n) N/m
        Parts of the stiffness terms of the skin that lie in the strips.
    """

    operators: full.AffineOperators
    rows: dict[str, Any]
    plain: dict[str, Any]
    strips: tuple[sparse.csr_array, ...]


def area_shares(stations: FloatArray, root_chord: float, tip_chord: float) -> FloatArray:
    """Weights (P,) of the mean over the planform of what is quadratic between every other station."""
    length = stations[2::2] - stations[:-2:2]
    weights = np.zeros(len(stations))
    for offset, share in enumerate((1.0, 4.0, 1.0)):  # Simpson's rule
        weights[offset : len(stations) - 2 + offset : 2] += share * length
    weights *= root_chord + (tip_chord - root_chord) * stations / stations[-1]
    return np.asarray(weights / weights.sum())


def section_lines(design: WingDesign) -> tuple[float, ...]:
    """Return the chord fractions of the elastic line and of the webs that are other lines, ascending."""
    elastic = design.tip_load.chord
    webs = sorted((web.chord for web in design.webs), key=lambda chord: abs(chord - elastic))
    lines = [elastic]
    for chord in webs:  # the nearest first: what is too near to one gives no lever
        if min(abs(chord - line) for line in lines) >= LEAST_LINE_DISTANCE:
            lines.append(chord)
    return elastic, *sorted(lines[1:])


def assemble_patch_operators(operators: full.AffineOperators) -> PatchOperators:
    """Assemble the operators of the primitives for a wing.

    Parameters
    ----------
    operators : AffineOperators
        The wing.
    """
    mesh, design, expansion = operators.wing_mesh, operators.wing_mesh.design, operators.expansion
    restriction = expansion.T.tocsr()
    lines = mesh.span_lines
    stations = np.sort(np.concatenate([lines, 0.5 * (lines[1:] + lines[:-1])]))
    plan, chords = design.planform, section_lines(design)

    def rows(chord: float, component: int) -> sparse.csr_array:
        nodal = np.array([full.section_displacement(mesh, place, chord) for place in stations])
        return sparse.csr_array(sparse.csr_array(nodal) @ expansion[component::3])

    weight = -STANDARD_GRAVITY * full.upward(operators.body.nodal_mass)
    lift = full.turn_load(operators.body)
    if design.lift.inertia_relief:  # the load holds the weight
        lift = lift - weight
    node_station = np.abs(mesh.points[:, 1:2] - stations).argmin(axis=1)
    by_station = sparse.coo_array(
        (lift, (np.repeat(node_station, 3), np.arange(mesh.unknowns))), shape=(len(stations), len(lift))
    ).tocsr()

    along = operators.gauge_output
    across, diagonal = (full.gauge_output(mesh, angle) @ expansion for angle in (0.5 * np.pi, 0.25 * np.pi))
    strips = np.searchsorted(lines, mesh.centres[:, 1]) - 1
    skin = np.flatnonzero(mesh.stiffness_term <= len(design.regions))
    found, part_of = np.unique(
        np.stack((strips, mesh.stiffness_term), axis=1)[skin], axis=0, return_inverse=True
    )
    flap = np.zeros(operators.unknowns)
    flap[-2] = 1.0
    return PatchOperators(
        operators,
        rows={
            "flap_row": flap,
            "line_rows": (
                *(rows(chords[0], component) for component in range(3)),
                *(rows(chord, 2) for chord in chords[1:]),
            ),
            "load_tip": operators.load_tip,
            "load_lift": operators.load_lift,
            "lift_rows": sparse.csr_array(by_station @ expansion),
            "weight": np.asarray(restriction @ weight),
            "strain_rows": (along, across, sparse.csr_array(2.0 * diagonal - along - across)),
            "tip_row": operators.tip_row,
        },
        plain={
            "strip_lines": np.array(lines),
            "strip_of": found[:, 0],
            "term_of": found[:, 1],
            "flap_spring": design.root.flap_spring,
            **plan.model_dump(),
            "load_place": plan.semi_span - design.tip_load.distance_from_tip,
            "stations": stations,
            "line_chord": np.array(chords),
            "station_weights": area_shares(stations, plan.root_chord, plan.tip_chord),
            "gauge_stations": np.array([place for place, _ in design.gauges.positions]),
            "gauge_length": design.gauges.averaging_spanwise,
        },
        strips=tuple(operators.body.stiffness(skin[part_of == number]) for number in range(len(found))),
    )
