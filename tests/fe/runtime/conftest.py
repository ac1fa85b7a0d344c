import pytest

from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.patched_wing import PatchedWing
from fe.wing.operators import AffineOperators
from tests.fe.runtime.full_wing import WingComparison


@pytest.fixture(scope="package")
def wings(coarse_patch_arrays: PatchArrays, coarse_operators: AffineOperators) -> WingComparison:
    """The patched wing, and its full model to compare with."""
    return WingComparison(PatchedWing(coarse_patch_arrays), coarse_operators)
