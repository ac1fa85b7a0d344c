"""Our FMUs and others', packed once; a small wing of springs and masses stands for the real one."""

import tempfile
from pathlib import Path
from typing import Any

import pytest

from fe.runtime.reduced import ReducedModel
from fmu_asset.compiled.compiler import find_compiler
from fmu_asset.errors import FmuBuildError
from tests.fmu_asset.ours import OurFmus, wing_model


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder in which this test alone, with its subprocesses, makes temporary folders."""
    folder = tmp_path / "scratch"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.setenv("TMPDIR", str(folder))
    return folder


@pytest.fixture(params=[True, False], ids=["worker", "in process"])
def isolated(request: pytest.FixtureRequest) -> bool:
    """Whether FMUs run in a process of their own: tests with this fixture run in both ways."""
    return bool(request.param)


@pytest.fixture(scope="session")
def compiler() -> list[str]:
    """The command of the C compiler; skips where there is none."""
    try:
        return find_compiler()
    except FmuBuildError as error:
        pytest.skip(f"no C compiler: {error}")


@pytest.fixture(scope="session")
def model() -> ReducedModel:
    """The wing of most FMUs."""
    return wing_model()


@pytest.fixture(scope="session")
def ours(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> OurFmus:
    """Pack our own FMUs: `ours("compiled")` is a path."""
    return OurFmus(tmp_path_factory.mktemp("ours"), request.getfixturevalue)


def _packed(name: str) -> Any:
    def made(ours: OurFmus) -> Path:
        return ours(name)

    return pytest.fixture(scope="session")(made)


NAMED = "python", "compiled", "spring_mass", "sensing", "patched"
fmu, compiled_fmu, spring_mass, sensing, patched = map(_packed, NAMED)
