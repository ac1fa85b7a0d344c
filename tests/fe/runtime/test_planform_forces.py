"""Forces that are spread over the planform, against integrals in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial
from scipy.interpolate import CubicSpline

from fe.runtime.errors import InvalidPatchError
from fe.runtime.laws import LAWS as PORT_LAWS
from fe.runtime.laws.overflow import Overflow
from fe.runtime.laws.sine_force import SineForce
from fe.runtime.motion import laws_of
from fe.runtime.patch import (
    BoucWen,
    FreePlay,
    MicroSlip,
    ModelPatch,
    PointMass,
    PortForce,
    PowerDamping,
    PowerStiffness,
    StiffnessDrift,
)
from fe.runtime.patched_wing import PatchedWing
from fe.runtime.planform_forces import PLANFORM, STATION_COUNT, STATION_PORTS, at_stations, planform_stations

SPAN, ROOT, TIP = 1.8, 0.4, 0.25
LAWS: tuple[PortForce, ...] = (
    PowerDamping(PLANFORM, 2.0, 2.0, 0.5, 0.3, 0.1),
    PowerStiffness(PLANFORM, 40.0, 3.0, 0, 0.02),
    FreePlay(PLANFORM, 90.0, 0.004),
    MicroSlip(PLANFORM, 12.0, 1500.0, -0.3, 8),
    BoucWen(PLANFORM, 800.0, 0.01, 1.5),
    SineForce(PLANFORM, 3.0, 2.0, 0.1),
    Overflow(PLANFORM, 5.0, 1.0, 0.2, 0.1),
)


@given(st.floats(0.05, 5.0), st.floats(0.05, 5.0), st.integers(0, 2 * STATION_COUNT - 2))
def test_powers_of_the_distance_have_the_mean_over_the_area(root: float, tip: float, power: int) -> None:
    distance, share = planform_stations(SPAN, root, tip)
    chord = Polynomial((root, (tip - root) / SPAN))
    moment = (chord * Polynomial((0.0, 1.0)) ** power).integ()(SPAN) / chord.integ()(SPAN)
    assert share.sum() == pytest.approx(1.0)
    assert float(share @ distance**power) == pytest.approx(moment, rel=1e-12)


@pytest.mark.parametrize("item", LAWS, ids=lambda item: str(item.kind))
def test_where_all_places_move_alike_the_forces_add_up_to_the_law(item: PortForce) -> None:
    _, share = planform_stations(SPAN, ROOT, TIP)
    before, after = PointMass(0.1, 1.0), FreePlay("root", 2.0, 1e-3)
    first, *spread, last = at_stations(ModelPatch((before, item, after)), share)
    assert (first, last) == (before, after)
    assert [force.port for force in spread if isinstance(force, PortForce)] == list(STATION_PORTS)
    one = laws_of(ModelPatch((item,)), [PLANFORM])
    parts = laws_of(ModelPatch(tuple(spread)), STATION_PORTS)
    assert parts.values[:, 0].sum() == pytest.approx(one.values[0, 0])
    assert np.all(parts.values[:, 1:] == one.values[0, 1:])
    assert np.allclose(parts.elements, one.elements)  # each slips where the whole does


def test_every_law_can_be_spread() -> None:
    assert {type(item) for item in LAWS} == set(PORT_LAWS)


def test_a_patch_without_such_a_force_stays_as_it_is() -> None:
    patch = ModelPatch(
        (PointMass(0.1, 1.0), PowerDamping("tip", 1.0, 0.0, 0.0, 1.0, 1.0), StiffnessDrift(0.1))
    )
    assert at_stations(patch, planform_stations(SPAN, ROOT, TIP).share) == patch


def test_rows_of_the_stations_are_displacements_of_the_elastic_line(coarse_patched_wing: PatchedWing) -> None:
    wing = coarse_patched_wing
    bent = np.linalg.solve(wing.structure(1.0, (0.0, 0.0), 0.17, 0.13).stiffness, wing.arrays.load_tip)
    along = wing.arrays.line_rows[2] @ bent
    seen = np.array([wing.port_rows[port] @ bent for port in STATION_PORTS])
    between = CubicSpline(wing.arrays.stations, along)(wing.planform.distance)
    assert seen == pytest.approx(between, rel=1e-2)
    # the mean over the area is that of the port "span"
    assert float(wing.planform.share @ seen) == pytest.approx(float(wing.port_rows["span"] @ bent), rel=1e-2)


def test_unknown_ports_are_refused(coarse_patched_wing: PatchedWing) -> None:
    wing = coarse_patched_wing
    with pytest.raises(InvalidPatchError, match="it has root, tip, span, planform"):
        laws_of(wing.internal_forces(ModelPatch((FreePlay("flap", 1.0, 1e-3),))), wing.port_rows)
