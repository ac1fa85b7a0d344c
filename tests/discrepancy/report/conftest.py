"""A verdict that names an effect, and its folder."""

from pathlib import Path

import pytest

from discrepancy.judgement.separability import Separability, separability
from discrepancy.report.figures import ReportInput
from discrepancy.verdict_folder import write_verdict_folder
from discrepancy.workflow import Investigation
from tests.discrepancy.rigs import FEW, ORIGIN, drag_found


@pytest.fixture(scope="session")
def drag() -> Investigation:
    return drag_found()


@pytest.fixture(scope="session")
def able(drag: Investigation) -> Separability:
    assert drag.problem is not None
    return separability(drag.campaign, drag.model, drag.problem.setting, FEW)


@pytest.fixture(scope="session")
def written(drag: Investigation, able: Separability, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of that verdict."""
    folder = tmp_path_factory.mktemp("named") / "verdict"
    write_verdict_folder(folder, ReportInput(drag, ORIGIN, able))
    return folder
