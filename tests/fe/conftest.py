import pytest
from threadpoolctl import threadpool_limits

from fe.reduction.model_cache import WingFields, field_basis
from fe.reduction.reduced_basis import Reduction, reduce_structure
from fe.runtime.reduced import ReducedModel
from fe.wing.design import WingDesign
from fe.wing.operators import AffineOperators
from tests.kept import FE, kept


@pytest.fixture(scope="session")
def coarse_reduction(coarse_design: WingDesign, coarse_operators: AffineOperators) -> Reduction:
    with threadpool_limits(1):
        return kept(
            "coarse-reduction", lambda: reduce_structure(coarse_operators), FE, coarse_design.hash
        )


@pytest.fixture(scope="session")
def coarse_fields(coarse_operators: AffineOperators, coarse_reduction: Reduction) -> WingFields:
    with threadpool_limits(1):
        return field_basis(coarse_operators, coarse_reduction)


@pytest.fixture(scope="session")
def model(coarse_reduction: Reduction) -> ReducedModel:
    """The reduced model of the coarse wing."""
    return coarse_reduction.model
