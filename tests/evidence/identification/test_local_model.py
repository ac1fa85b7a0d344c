import numpy as np
import pytest

from evidence.identification.local_model import build_local_model
from evidence.identification.parameters import deviations, values_of, with_values
from evidence.identification.pieces import reduced, wing_pieces
from evidence.identification.residuals import fitted_residuals
from evidence.identification.targets import Weights
from fe.wing.operators import assemble, eigenmodes, solve_static
from tests.wings import tip_stiffness


@pytest.mark.parametrize("relief", [False, True])
def test_the_pieces_are_those_of_the_operators(virtual_design, relief):
    design = virtual_design.changed(lift={"inertia_relief": relief})
    operators = assemble(design)
    random = np.random.default_rng(3)
    static, modal = (random.standard_normal((operators.unknowns, k)) for k in (3, 2))
    found = reduced(wing_pieces(design), static, modal)
    for term, own in zip(operators.stiffness_terms, found.stiffness, strict=True):
        assert own == pytest.approx(static.T @ (term.matrix @ static), rel=1e-9)
    for term, own in zip(operators.mass_terms, found.modal_mass, strict=True):
        assert own == pytest.approx(modal.T @ (term @ modal), rel=1e-9)
    assert found.lift == pytest.approx(operators.load_lift @ static, rel=1e-9)
    assert found.tip == pytest.approx(operators.load_tip @ static, rel=1e-9)
    assert found.gauges == pytest.approx(operators.gauge_output @ static, rel=1e-9)


@pytest.mark.long
def test_values_are_those_of_the_full_model(virtual_model, virtual_design):
    operators = assemble(virtual_design)
    wing = virtual_model.wing
    for loss in ((0.0, 0.0), (0.8, 0.0), (0.6, 0.0), (0.8, 0.8)):
        full = solve_static(operators, 1.0073, loss, load_factor=3.0).strain
        # States that are not in the basis are close, not exact.
        limit = 5e-5 if loss in {(0.0, 0.0), (0.8, 0.0)} else 2e-3
        assert wing.strain(1.0073, loss).value == pytest.approx(full, rel=limit)
    for factor in (0.97, 1.0, 1.04):
        assert wing.tip_stiffness(factor).value[0] == pytest.approx(
            tip_stiffness(operators, factor), rel=2e-5
        )
        modes = eigenmodes(operators, factor, (0.0, 0.0), 0.16, 0.14)
        own = np.exp(wing.log_frequency(*(np.array([x]) for x in (factor, 0.16, 0.14))).value[0])
        assert own == pytest.approx(modes.frequency[modes.flapwise_bending], rel=1e-5)


def test_slopes_are_differences_of_values(virtual_model):
    wing, factor, h = virtual_model.wing, 1.0073, 1e-4
    for slope, value in (
        (wing.strain_slope(factor).value, lambda e: wing.strain(e, (0.0, 0.0)).value),
        (wing.tip_stiffness(factor).value[1:], lambda e: wing.tip_stiffness(e).value[:1]),
    ):
        difference = np.log(value(factor * np.exp(h)) / value(factor * np.exp(-h))) / (2.0 * h)
        assert slope == pytest.approx(difference, rel=1e-5)


@pytest.mark.long
def test_the_jacobian_is_that_of_the_full_model(
    virtual_model, virtual_design, some_parameters, virtual_targets
):
    # Two wings on either side, each with a basis of its own: every approximation is in the difference.
    weights, width = Weights(), deviations(some_parameters)
    base = values_of(virtual_design, some_parameters)
    jacobian = fitted_residuals(virtual_model.wing, virtual_targets, weights).gradient * width
    step = 0.02  # the soft webs give as 1 / G: over a tenth of a deviation that is no derivative any more
    for number in (2, 7):
        sides = []
        for sign in (1.0, -1.0):
            values = base.copy()
            values[number] += sign * step * width[number]
            model = build_local_model(with_values(virtual_design, some_parameters, values), ())
            sides.append(fitted_residuals(model.wing, virtual_targets, weights).value)
        difference = (sides[0] - sides[1]) / (2.0 * step)
        largest = np.abs(jacobian[:, number]).max()
        assert largest > 0.1
        assert np.abs(jacobian[:, number] - difference).max() < 0.002 * largest + 0.02


def test_an_affine_step_is_exact(virtual_model, virtual_design, some_parameters):
    values = virtual_model.values.copy()
    names = [parameter.name for parameter in some_parameters]
    values[names.index("skin modulus at 0")] *= 1.02
    values[names.index("net lift at 3g")] *= 1.02
    full = assemble(with_values(virtual_design, some_parameters, values))
    found = virtual_model.at(values).strain(1.0073, (0.0, 0.0)).value
    # Only what the basis lacks of the moved solution is left: second order in the step.
    assert found == pytest.approx(solve_static(full, 1.0073, load_factor=3.0).strain, rel=1e-3)
