"""Assets that several files fly."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).with_name("heat_exchanger")


@pytest.fixture(scope="session")
def heat_exchanger(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with an FMU of a heat exchanger, its binding and its scenario."""
    folder = tmp_path_factory.mktemp("heat_exchanger")
    for path in HERE.iterdir():
        if path.is_file():
            shutil.copy(path, folder)
    build = [sys.executable, "-m", "pythonfmu", "build", "-f", "HeatExchanger.py"]
    subprocess.run(build, cwd=folder, check=True, capture_output=True)
    return folder
