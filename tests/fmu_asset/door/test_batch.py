"""Many instances of one FMU: extracted once, saved, forked and restored, as an ensemble filter does."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fmu_asset.archive.declared import FmuDescription
from fmu_asset.door import placement
from fmu_asset.door.binding import Binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import FmuStateError

from .conftest import bound

BOTH = pytest.mark.parametrize("isolated", [True, False], ids=["worker", "in process"])


def described(state: str = "auto") -> Binding:
    return bound(1.0, {"y": ("y", "m")}, control={"u": ("u", "m/s")}, header={"state": state})


@pytest.fixture
def extractions(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Return the folders into which FMUs are extracted during the test."""
    made: list[Path] = []
    extract = placement.extract_fmu

    def counting(description: FmuDescription) -> Path:
        made.append(extract(description))
        return made[-1]

    monkeypatch.setattr(placement, "extract_fmu", counting)
    return made


@BOTH
@pytest.mark.parametrize("state", ["serialised", "replay"])
def test_a_fork_goes_its_own_way(
    foreign_fmu: Any, extractions: list[Path], isolated: bool, state: str
) -> None:
    with FmiAsset(foreign_fmu("hostile2"), described(state), isolated=isolated) as asset:
        asset.step({"u": 1.0})
        asset.step({"u": 2.0})
        forks = [asset.fork() for _ in range(3)]
        for number, fork in enumerate(forks):
            assert (fork.time, fork.step_index) == (2.0, 2)
            assert fork.step({"u": float(number)}).values[0] == 3.0 + number
        # An input that is not given keeps the value that it had at the fork.
        assert asset.fork().step().values[0] == 5.0
        assert asset.step().values[0] == 5.0
        forks[0].close()
        assert forks[1].step().values[0] == 5.0
    # The folder is shared, and goes with the last one that uses it.
    assert len(extractions) == 1
    assert extractions[0].is_dir()
    assert forks[2].step().values[0] == 7.0
    for fork in forks:
        fork.close()
    assert not extractions[0].exists()


def test_siblings_have_parameters_of_their_own(foreign_fmu: Any, extractions: list[Path]) -> None:
    roles = {"control": {"u": ("In1 (rad/s)", "1")}, "parameter": {"gain": ("Lag/Gain [K]", "1")}}
    binding = bound(0.5, {"y": ("Out1", "1")}, **roles)
    with FmiAsset(foreign_fmu("lag1"), binding, parameters={"gain": 1.0}) as first:
        others = [first.sibling({"gain": float(gain)}) for gain in (2, 3)]
        values = [asset.step({"u": 1.0}).values[0] for asset in (first, *others)]
        np.testing.assert_allclose(values, (1.0 - np.exp(-1.0)) * np.array([1.0, 2.0, 3.0]), rtol=1e-12)
        for other in others:
            other.close()
    assert len(extractions) == 1


@BOTH
def test_a_new_instance_in_the_same_process(
    foreign_fmu: Any, extractions: list[Path], isolated: bool
) -> None:
    with FmiAsset(foreign_fmu("hostile2"), described(), isolated=isolated) as asset:
        asset.step()
        process = asset.worker_process_id
        for _ in range(20):
            asset.renew()
            assert asset.step({"u": 3.0}).values[0] == 3.0
        assert asset.worker_process_id == process
    assert len(extractions) == 1


def test_after_a_crash_the_files_are_extracted_again(foreign_fmu: Any, extractions: list[Path]) -> None:
    with FmiAsset(foreign_fmu("hostile2", "ABORT"), described()) as asset:
        fork = asset.fork()
        asset.step(), asset.step()
        saved = asset.save_state()
        with pytest.raises(Exception, match="SIGABRT"):
            asset.step()
        asset.restore_state(saved)
        assert len(extractions) == 2
        assert fork.step().values[0] == 1.0
        fork.close()


def test_there_is_nothing_to_fork_before_the_first_step(foreign_fmu: Any) -> None:
    with pytest.raises(FmuStateError, match="no state to save"):
        FmiAsset(foreign_fmu("hostile2"), described()).fork()


@pytest.mark.long
@pytest.mark.slow
def test_three_hundred_cycles_leave_nothing(
    foreign_fmu: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Create, run and free in this process: neither memory nor folders nor descriptors grow."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    pages, descriptors = [], []
    with FmiAsset(foreign_fmu("hostile2"), described(), isolated=False) as first:
        for number in range(300):
            with first.sibling() as asset:
                asset.step()
            if number in (99, 299):
                pages.append(int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]))
                descriptors.append(len(list(Path("/proc/self/fd").iterdir())))
    assert pages[1] - pages[0] < 200  # 4 KiB for each cycle would be 200 pages
    assert descriptors[0] == descriptors[1]
    assert not list(tmp_path.iterdir())


def test_a_closed_worker_is_gone_at_once(foreign_fmu: Any) -> None:
    asset = FmiAsset(foreign_fmu("hostile2"), described())
    asset.step()
    process = Path("/proc") / str(asset.worker_process_id)
    asset.close()
    assert not process.exists()
