"""The authors' folder of measurements, which is beside the project where it is at hand."""

from pathlib import Path

import pytest

REFERENCE = (
    Path(__file__).parents[2].parent / "shared" / "reference" / "uav_experimental_calibration"
)


@pytest.fixture(scope="session")
def reference() -> Path:
    if not REFERENCE.is_dir():
        pytest.skip(f"the authors' calibration folder is not at {REFERENCE}")
    return REFERENCE
