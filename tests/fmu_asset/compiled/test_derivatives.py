"""Exact derivatives of the compiled wing, of FMI 2 and of FMI 3."""

from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest
from scipy.linalg import eigh

from fe.runtime.reduced import ReducedModel
from tests.fmu_asset.ours import OurFmus
from tests.fmu_asset.slaves.slave import DISCARD, ERROR, OK, Slave

STRAINS = [f"strain[{gauge}]" for gauge in range(1, 25)]
FREQUENCIES, RATIOS = ([f"{name}[{mode}]" for mode in range(1, 7)] for name in ("frequency", "damping_ratio"))
TIP, LOAD_POINT = "tip_displacement", "load_point_displacement"
STATIC = [*STRAINS, TIP, LOAD_POINT]
AT = {
    "young_modulus_factor": 1.05,
    "health.z1": 0.3,
    "health.z2": 0.55,
    "load_factor": 2.5,
    "tip_force": -7.0,
}
"""Where the derivatives are taken."""
DAMPED = {"damping__alpha": 2.0, "damping__beta": 3e-4}
SLOPE = {1: 0.75, 2: -0.15, 3: 1 / 60}
"""Weights of differences of sixth order."""


@pytest.fixture(params=["compiled", "fmi3"])
def wing(request: pytest.FixtureRequest, ours: OurFmus) -> Iterator[Slave]:
    with closing(Slave(ours(request.param))) as made:
        yield made


def flown(wing: Slave, response: int = 1, **given: float) -> Slave:
    factor = AT["young_modulus_factor"]
    assert wing.start(response=response, anew=False, young_modulus_factor=factor, **given) == OK
    inputs = [AT[name] for name in ("load_factor", "health.z1", "health.z2", "tip_force")]
    assert wing.step(inputs, 0.0, 1.0) == OK
    return wing


def outputs(model: ReducedModel, at: dict[str, complex]) -> np.ndarray:
    """Strains, tip and load point displacement at equilibrium: the reduced model in complex numbers."""
    theta = np.array([at["young_modulus_factor"], 1 - at["health.z1"], 1 - at["health.z2"], 1.0])
    stiffness = np.tensordot(theta, model.static_stiffness, 1)
    load = at["load_factor"] * model.static_load[0] + at["tip_force"] * model.static_load[1]
    return np.vstack((model.static_output, model.static_load[1])) @ np.linalg.solve(stiffness, load)


def modal(model: ReducedModel, at: dict[str, float]) -> np.ndarray:
    """Frequencies and damping ratios."""
    theta = [at["young_modulus_factor"], 1 - at["health.z1"], 1 - at["health.z2"], 1.0]
    mass = np.tensordot([1.0, at["mass.servo"], at["mass.pitot"]], model.modal_mass, 1)
    omega = np.sqrt(eigh(np.tensordot(theta, model.modal_stiffness, 1), mass, eigvals_only=True)[:6])
    return np.concatenate((omega / (2 * np.pi), 0.5 * (2.0 / omega + 3e-4 * omega)))


def test_static_derivatives_are_those_of_a_complex_step(wing, model) -> None:
    flown(wing)
    np.testing.assert_allclose(wing.get(*STATIC), outputs(model, AT), rtol=1e-12)
    for name, value in AT.items():
        expected = outputs(model, AT | {name: value + 1e-30j}).imag / 1e-30
        seen = wing.derivative(STATIC, {name: 1.0})
        np.testing.assert_allclose(seen, expected, rtol=1e-11, atol=1e-13 * np.abs(expected).max())
    together = wing.derivative(STRAINS, {"health.z1": 0.7, "load_factor": -0.2})
    parts = (wing.derivative(STRAINS, {name: 1.0}) for name in ("health.z1", "load_factor"))
    np.testing.assert_allclose(together, np.array([0.7, -0.2]) @ [*parts], rtol=1e-12)


def test_modal_derivatives_are_those_of_differences(wing, model) -> None:
    flown(wing, **DAMPED)
    names = [*FREQUENCIES, *RATIOS]
    at = AT | {name: wing.of(name) for name in ("mass.servo", "mass.pitot")}
    np.testing.assert_allclose(wing.get(*names), modal(model, at), rtol=1e-10)
    for name in at.keys() - {"load_factor", "tip_force"}:
        shifts = [(sign * k * 1e-3, sign * weight) for k, weight in SLOPE.items() for sign in (1, -1)]
        expected = sum(w * modal(model, at | {name: at[name] + shift}) for shift, w in shifts) / 1e-3
        seen = wing.derivative(names, {name: 1.0})
        for part in (slice(6), slice(6, 12)):
            within = 1e-8 * np.abs(expected[part]).max()
            np.testing.assert_allclose(seen[part], expected[part], rtol=0, atol=within)
    omega = 2 * np.pi * modal(model, at)[:6]
    seen = wing.derivative(RATIOS, {"damping.alpha": 1.0, "damping.beta": 0.0})
    np.testing.assert_allclose(seen, 0.5 / omega, rtol=1e-10)
    assert not np.any(wing.derivative([*STRAINS, *FREQUENCIES], {"damping.beta": 1.0}))


def test_in_motion_loads_act_at_once_and_health_is_refused(wing) -> None:
    flown(wing, response=2)
    feed_through = wing.derivative(STATIC, {"load_factor": 1.0})
    kept, shown = wing.saved(), []
    for load_factor in (3.0, 2.0):
        assert wing.restore(kept) == OK
        inputs = [load_factor, AT["health.z1"], AT["health.z2"], AT["tip_force"]]
        assert wing.step(inputs, 1.0, 1e-12) == OK  # s; the modes have no time to move
        shown.append(np.array(wing.get(*STATIC)))
    within = 1e-12 * np.abs(shown[0]).max()
    np.testing.assert_allclose(feed_through, shown[0] - shown[1], rtol=0, atol=within)
    assert wing.status_of(wing.derivative, STRAINS, {"health.z1": 1.0}) == DISCARD
    assert "is not offered in motion" in wing.log[-1][1]


def test_the_adjoint_is_the_transpose(ours) -> None:
    with closing(Slave(ours("fmi3"))) as wing:
        flown(wing)
        rng = np.random.default_rng(3)
        unknowns, knowns = (
            [wing.reference[name] for name in names]
            for names in (
                (LOAD_POINT, "strain[1]", "frequency[1]", TIP),
                ("health.z1", "load_factor", "young_modulus_factor", "mass.servo"),
            )
        )
        v, w = rng.normal(size=5), rng.normal(size=1 + 24 + 6 + 1)
        forward = wing.fmu.getDirectionalDerivative(unknowns, knowns, v, len(w))
        backward = wing.fmu.getAdjointDerivative(unknowns, knowns, w, len(v))
        assert w @ forward == pytest.approx(np.array(backward) @ v, rel=1e-12)


def test_derivatives_that_there_are_not_are_refused_in_a_sentence(ours) -> None:
    with closing(Slave(ours("fmi3"))) as wing:

        def status(unknown: str, known: str, size: int) -> int:
            places = [wing.reference[unknown]], [wing.reference[known]]
            return wing.status_of(wing.fmu.getDirectionalDerivative, *places, [1.0], size)

        assert status("strain[1]", "load_factor", 24) == ERROR
        assert "not initialised" in wing.log[-1][1]
        flown(wing)
        for unknown, known, size, sentence in (
            ("strain_error_bound", "load_factor", 1, "strain_error_bound with respect to load_factor is not"),
            (TIP, "initial_tip_displacement", 1, "initial_tip_displacement is not offered"),
            (TIP, "health.z1", 1, "one number for each value"),
            (TIP, "load_factor", 2, "one number for each value"),
            ("status", "load_factor", 1, "one number for each value"),
            (TIP, "health.z2", 1, "one number for each value"),
        ):
            assert status(unknown, known, size) == DISCARD
            assert sentence in wing.log[-1][1]
