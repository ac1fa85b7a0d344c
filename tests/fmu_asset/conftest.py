"""Our FMUs and others', packed once; a small wing of springs and masses stands for the real one."""

import tempfile
from pathlib import Path
from typing import Any

import pytest

from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.reduced import ReducedModel
from fmu_asset.compiled.compiler import find_compiler
from fmu_asset.door.binding import Binding, load_binding
from fmu_asset.errors import FmuBuildError
from scenarios import binding_files
from tests.conftest import BEAM
from tests.fmu_asset.making import with_dependencies
from tests.fmu_asset.ours import OurFmus, chain_arrays, chain_model
from tests.kept import FE, kept


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder in which this test alone makes its temporary folders, here and in subprocesses."""
    folder = tmp_path / "scratch"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.setenv("TMPDIR", str(folder))
    return folder


@pytest.fixture(params=[True, False], ids=["worker", "in process"])
def isolated(request: pytest.FixtureRequest) -> bool:
    """Whether FMUs run in a process of their own: each test that asks for it is run in both ways."""
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
    return chain_model()


@pytest.fixture(scope="session")
def arrays(model: ReducedModel) -> PatchArrays:
    return chain_arrays(model)


@pytest.fixture(scope="session")
def beam_model(request: pytest.FixtureRequest) -> ReducedModel:
    """The beam of the tests, reduced."""
    return kept("beam", lambda: request.getfixturevalue("beam_reduction").model, FE, BEAM)


@pytest.fixture(scope="session")
def ours(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> OurFmus:
    """Pack our own FMUs: `ours("compiled")` is a path."""
    return OurFmus(tmp_path_factory.mktemp("ours"), lambda: request.getfixturevalue("beam_model"))


def _packed(name: str) -> Any:
    def made(ours: OurFmus) -> Path:
        return ours(name)

    return pytest.fixture(scope="session")(made)


fmu, compiled_fmu, spring_mass = map(_packed, ("python", "compiled", "spring_mass"))
linear_fmu = _packed("linear")
"""The linear system as pythonfmu exports it: it declares no dependencies, so all outputs have all."""


@pytest.fixture(scope="session")
def binding() -> Binding:
    return load_binding(binding_files()["uav_wing"])


@pytest.fixture(scope="session")
def spring_binding() -> Binding:
    return load_binding(Path(__file__).parent / "door" / "bindings" / "spring_mass.toml")


@pytest.fixture(scope="session")
def state_fmu(linear_fmu: Path) -> Path:
    """The same, declaring that no output depends on an input directly."""
    return with_dependencies(linear_fmu, linear_fmu.with_name("state.fmu"), {"y1": [], "y2": []})


@pytest.fixture(scope="session")
def crossed_fmu(linear_fmu: Path) -> Path:
    """The same, declaring that y1 depends on u1 and y2 on u2."""
    return with_dependencies(linear_fmu, linear_fmu.with_name("crossed.fmu"), {"y1": ["u1"], "y2": ["u2"]})
