"""Derivatives that compiled FMUs give, by differences and by each other."""

from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest

from tests.fmu_asset.making import tables
from tests.fmu_asset.ours import OurFmus
from tests.fmu_asset.slaves.slave import DISCARD, ERROR, OK, Slave

REFUSED = tables(__file__)["derivatives"]
INPUTS = ("load_factor", "health.z1", "health.z2", "tip_force")
POINT = {
    "young_modulus_factor": 1.05,
    "health.z1": 0.3,
    "health.z2": 0.55,
    "load_factor": 2.5,
    "tip_force": -7.0,
}
"""Where the derivatives are taken."""
PARAMETERS = {"mass.servo": 0.2, "mass.pitot": 0.1, "damping.alpha": 2.0, "damping.beta": 3e-4}
KNOWNS = POINT | PARAMETERS

STRAINS = [f"strain[{gauge}]" for gauge in range(1, 25)]
OUTPUTS_OF_KIND = {
    "strain": STRAINS,
    "displacement": ["tip_displacement", "load_point_displacement"],
    "frequency": [f"frequency[{mode}]" for mode in range(1, 7)],
    "damping ratio": [f"damping_ratio[{mode}]" for mode in range(1, 7)],
}
OUTPUTS = [name for names in OUTPUTS_OF_KIND.values() for name in names]


def start_and_step(wing: Slave, values: dict[str, float], response: int = 1) -> None:
    """Start a wing with parameters, and make a step with inputs."""
    parameters = {
        name.replace(".", "__"): value for name, value in values.items() if name not in INPUTS
    }
    assert wing.start(response=response, **parameters) == OK
    assert wing.step([values[name] for name in INPUTS], 0.0, 1.0) == OK


@pytest.fixture(scope="module", params=["compiled", "fmi3"])
def wing(request: pytest.FixtureRequest, ours: OurFmus) -> Iterator[Slave]:
    """A wing that each test starts anew."""
    with closing(Slave(ours(request.param))) as slave:
        yield slave


# ---------------------------------------------------------------------- forward


def slope_by_differences(wing: Slave, name: str) -> np.ndarray:
    """Return the slopes of all outputs by a variable, over four neighbours: of fourth order."""
    value = KNOWNS[name]
    neighbours = []
    for change in (-2e-3, -1e-3, 1e-3, 2e-3):
        start_and_step(wing, KNOWNS | {name: value * (1.0 + change)})
        neighbours.append(wing.get(*OUTPUTS))
    weights = np.array([1.0, -8.0, 8.0, -1.0])
    return weights @ np.array(neighbours) / (12e-3 * value)


@pytest.mark.parametrize("name", KNOWNS)
def test_derivatives_are_the_slopes_of_the_outputs(wing, name):
    slopes = dict(zip(OUTPUTS, slope_by_differences(wing, name), strict=True))
    start_and_step(wing, KNOWNS)
    outputs = dict(zip(OUTPUTS, np.abs(wing.get(*OUTPUTS)), strict=True))

    derivatives = dict(zip(OUTPUTS, wing.derivative(OUTPUTS, {name: 1.0}), strict=True))

    for kind, names in OUTPUTS_OF_KIND.items():
        expected = np.array([slopes[output] for output in names])
        rounding = 1e-12 * max(outputs[output] for output in names) / abs(KNOWNS[name])
        tolerance = 1e-8 * np.abs(expected).max() + rounding
        of_kind = [derivatives[output] for output in names]
        np.testing.assert_allclose(of_kind, expected, rtol=0, atol=tolerance, err_msg=kind)


def test_derivatives_are_linear_in_their_direction(wing):
    start_and_step(wing, KNOWNS)

    together = wing.derivative(OUTPUTS, {"health.z1": 0.7, "load_factor": -0.2})

    by_health = wing.derivative(OUTPUTS, {"health.z1": 1.0})
    by_load = wing.derivative(OUTPUTS, {"load_factor": 1.0})
    np.testing.assert_allclose(together, 0.7 * by_health - 0.2 * by_load, rtol=1e-12)


def test_derivatives_in_motion_are_refused(wing):
    start_and_step(wing, POINT, response=2)

    assert wing.status_of(wing.derivative, STRAINS, {"health.z1": 1.0}) == DISCARD
    assert "is not offered in motion" in wing.log[-1][1]


# ---------------------------------------------------------------------- adjoint and refusals


@pytest.fixture(scope="module")
def fmi3_wing(ours: OurFmus) -> Iterator[Slave]:
    """A wing of FMI 3 after a step."""
    with closing(Slave(ours("fmi3"))) as slave:
        start_and_step(slave, POINT)
        yield slave


def status_of_derivative(wing: Slave, unknown: str, known: str, size: int) -> int:
    """Return the status of a derivative that should have some number of elements."""
    references = ([wing.reference[unknown]], [wing.reference[known]])
    return wing.status_of(wing.fmu.getDirectionalDerivative, *references, [1.0], size)


def test_the_adjoint_is_the_transpose(fmi3_wing):
    """w (J v) = (w J) v for random v and w."""
    unknown_names = ("load_point_displacement", "strain[1]", "frequency[1]", "tip_displacement")
    known_names = ("health.z1", "load_factor", "young_modulus_factor", "mass.servo")
    unknowns = [fmi3_wing.reference[name] for name in unknown_names]
    knowns = [fmi3_wing.reference[name] for name in known_names]
    random = np.random.default_rng(3)
    v = random.normal(size=5)  # health is an array of two
    w = random.normal(size=1 + 24 + 6 + 1)

    forward = fmi3_wing.fmu.getDirectionalDerivative(unknowns, knowns, v, len(w))
    backward = fmi3_wing.fmu.getAdjointDerivative(unknowns, knowns, w, len(v))

    assert w @ forward == pytest.approx(np.array(backward) @ v, rel=1e-12)


def test_derivatives_before_initialisation_are_refused(ours):
    with closing(Slave(ours("fmi3"))) as slave:
        assert status_of_derivative(slave, "strain[1]", "load_factor", 24) == ERROR
        assert "not initialised" in slave.log[-1][1]


@pytest.mark.parametrize(("unknown", "known", "size", "sentence"), REFUSED)
def test_an_impossible_derivative_is_refused_in_a_sentence(
    fmi3_wing, unknown, known, size, sentence
):
    assert status_of_derivative(fmi3_wing, unknown, known, size) == DISCARD
    assert sentence in fmi3_wing.log[-1][1]
