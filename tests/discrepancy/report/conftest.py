"""A verdict that names an effect, and its folder."""

from pathlib import Path

import pytest

from discrepancy.judgement.separability import Separability, separability
from discrepancy.report.figures import ReportInput
from discrepancy.verdict_folder import write_verdict_folder
from discrepancy.workflow import Investigation, investigate
from tests.discrepancy.rigs import FEW, ORIGIN, measured


@pytest.fixture(scope="module")
def drag() -> Investigation:
    """Quadratic damping, hidden in ring-downs and static trials, and found."""
    campaign, model = measured("quadratic_damping", 0.01)
    return investigate(campaign, model, FEW)


@pytest.fixture(scope="module")
def able(drag: Investigation) -> Separability:
    assert drag.problem is not None
    return separability(drag.campaign, drag.model, drag.problem.setting, FEW)


@pytest.fixture(scope="module")
def written(drag: Investigation, able: Separability, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of that verdict."""
    folder = tmp_path_factory.mktemp("named") / "verdict"
    write_verdict_folder(folder, ReportInput(drag, ORIGIN, able))
    return folder
