import numpy as np
import pytest
from skfem import Basis, BilinearForm, ElementHexS2, ElementVector
from skfem.helpers import ddot, dot, sym_grad, trace

from fe.full.assembly import (
    isotropic_elasticity,
    orthotropic_elasticity,
    rotate_elasticity,
    shape_functions,
)
from fe.verification.known_answers import brick

ELEMENT = ElementVector(ElementHexS2())


def test_batched_assembly_equals_scikit_fem():
    body = brick((1.0, 0.5, 0.7), (3, 2, 2), distortion=0.2)
    basis = Basis(body.mesh, ELEMENT, intorder=5)
    assert np.array_equal(basis.element_dofs.T, body.cell_dofs)
    modulus, ratio = 2.0, 0.3
    first, second = modulus * ratio / ((1 + ratio) * (1 - 2 * ratio)), modulus / (2 * (1 + ratio))

    @BilinearForm
    def elastic(u, v, _):
        strain = sym_grad(u)
        return first * trace(strain) * trace(sym_grad(v)) + 2.0 * second * ddot(strain, sym_grad(v))

    @BilinearForm
    def inertia(u, v, _):
        return 3.0 * dot(u, v)

    cells = np.arange(len(body.corners))
    elasticity = np.broadcast_to(isotropic_elasticity(modulus, ratio), (len(cells), 6, 6))
    for ours, theirs in (
        (body.stiffness(cells, elasticity), elastic.assemble(basis)),
        (body.mass(cells, np.full(len(cells), 3.0)), inertia.assemble(basis)),
    ):
        assert abs(ours - theirs).max() < 1e-13 * abs(theirs).max()


def test_shape_functions_sum_to_one_and_are_nodal():
    values, gradients = shape_functions(ElementHexS2().doflocs)
    assert values == pytest.approx(np.eye(20), abs=1e-14)
    assert gradients.sum(axis=1) == pytest.approx(0.0, abs=1e-13)


def test_an_isotropic_material_does_not_feel_a_rotation():
    elasticity = isotropic_elasticity(7.0, 0.3)
    rotation, _ = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))
    assert rotate_elasticity(elasticity[None], rotation[None])[0] == pytest.approx(elasticity, abs=1e-13)


def test_turning_an_orthotropic_material_by_a_right_angle_swaps_its_axes():
    local = orthotropic_elasticity(5.0, 0.1, 0.3, 0.7, 1.1)
    local[0, 0] += 2.0
    quarter = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = rotate_elasticity(local[None], quarter[None])[0]
    order = [1, 0, 2, 4, 3, 5]
    assert turned == pytest.approx(local[np.ix_(order, order)], abs=1e-13)


def test_nodes_lie_where_scikit_fem_puts_them():
    body = brick((1.0, 0.5, 0.7), (2, 2, 1), distortion=0.1)
    basis = Basis(body.mesh, ELEMENT, intorder=2)
    assert pytest.approx(body.node_points) == basis.doflocs[:, ::3].T


def test_shape_functions_are_those_of_scikit_fem():
    points = np.random.default_rng(8).uniform(-0.1, 1.1, (40, 3))
    values, gradients = shape_functions(points)
    for node in range(20):
        value, gradient = ElementHexS2().lbasis(points.T, node)
        assert values[:, node] == pytest.approx(value, abs=1e-14)
        assert gradients[:, node] == pytest.approx(np.stack(np.broadcast_arrays(*gradient)).T, abs=1e-14)
    at_nodes, _ = shape_functions(np.asarray(ElementHexS2.doflocs, dtype=float))
    assert np.array_equal(at_nodes, np.eye(20))
