"""A verdict that names an effect, and its folder."""

import pytest

from discrepancy.judgement.separability import Separability, separability
from discrepancy.workflow import Investigation
from tests.discrepancy.rigs import FEW, drag_found


@pytest.fixture(scope="session")
def drag() -> Investigation:
    return drag_found()


@pytest.fixture(scope="session")
def able(drag: Investigation) -> Separability:
    assert drag.problem is not None
    return separability(drag.campaign, drag.model, drag.problem.setting, FEW)
