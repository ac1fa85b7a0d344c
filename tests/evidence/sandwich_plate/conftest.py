import pytest

from fe.wing.design import WingDesign, load_design
from fe.wing.operators import AffineOperators, assemble


@pytest.fixture(scope="session")
def shipped_design() -> WingDesign:
    return load_design()


@pytest.fixture(scope="session")
def coarse_design(shipped_design: WingDesign) -> WingDesign:
    return shipped_design.changed(mesh={"refinement": 0.25})


@pytest.fixture(scope="session")
def coarse_operators(coarse_design: WingDesign) -> AffineOperators:
    return assemble(coarse_design)


@pytest.fixture(scope="session")
def shipped_operators(shipped_design: WingDesign) -> AffineOperators:
    return assemble(shipped_design)
