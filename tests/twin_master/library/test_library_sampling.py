"""Sampling an FMU into an observation library: values, processes, kills, memories, crashes."""

import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fmu_asset.errors import FmuCallError, FmuTimeoutError, FmuWorkerError
from fmu_asset.packing.contents import build_script_fmu
from tests.kept import ROOT
from tests.refusals import Inputs
from twin_master.assets.library_source import load_observation_library
from twin_master.errors import MissionInputError
from twin_master.library.grid import SamplingGrid, grid_of_fmu
from twin_master.library.sampling import blocks_folder, sample_library

FINE, LAG, COUNT, DIE, SLEEP, REFUSE, SLOW = (float(mode) for mode in range(7))
WEAR, GAIN, PUSH = (0.0, 0.25, 0.5), (0.9, 1.0, 1.1), (2.0, 4.0)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("wayward")
    fmu = build_script_fmu(Path(__file__).with_name("wayward.py"), folder / "wayward.fmu").path
    return fmu, Inputs(__file__).folder / "wayward.toml"


def grid(files: tuple[Path, Path], mode: float = FINE, **changes: object) -> SamplingGrid:
    texts = [
        f"wear={','.join(map(str, WEAR))}",
        f"gain={','.join(map(str, GAIN))}",
        f"push={','.join(map(str, PUSH))}",
        f"mode={mode}",
    ]
    return replace(grid_of_fmu(*files, texts), **changes)  # type: ignore[arg-type]


def finished(out: Path) -> int:
    """Points of a library that is being sampled whose observations are on disk."""
    try:
        return int(np.isfinite(np.load(blocks_folder(out) / "observations.npy", mmap_mode="r")[:, 0]).sum())
    except (OSError, ValueError):
        return 0


def test_the_library_holds_what_the_formula_says_with_names_and_units(files, tmp_path):
    outcome = sample_library(grid(files), tmp_path / "lever.nc", workers=1)
    expected = np.array([[[g * p / (1.0 + w) for p in PUSH] for w in WEAR] for g in GAIN])
    np.testing.assert_allclose(outcome.library.values[..., 0], expected, rtol=1e-15)
    np.testing.assert_allclose(outcome.library.values[..., 1], 2e3 * expected, rtol=1e-15)
    assert not blocks_folder(outcome.path).exists()
    with xr.open_dataset(outcome.path, engine="h5netcdf") as stored:
        assert stored["observation"].dims == ("draw", "wear", "control", "sensor")
        assert stored["wear"].attrs["units"] == "1"
        assert list(stored["sensor"].values) == ["shown", "double"]
        assert list(stored["sensor_unit"].values) == ["m", "mm"]
        assert stored["control_push"].attrs["units"] == "N"
        assert float(stored["observation"].sel(wear=0.25)[1, 1, 0]) == 3.2
    read = load_observation_library(outcome.path)
    np.testing.assert_array_equal(read.values, outcome.library.values)
    assert (read.parameter, read.draws.tolist(), read.controls) == (
        "gain", list(GAIN), ("push = 2, mode = 0", "push = 4, mode = 0"),
    )  # fmt: skip


def test_what_an_interrupted_sampling_finished_is_kept(files, tmp_path, request):
    """Interrupted, resumed, and killed. What a shell starts in the background would ignore SIGINT."""
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, former))
    slow = grid(files, SLOW, draws=tuple(np.linspace(0.8, 1.2, 20)))
    whole = sample_library(slow, tmp_path / "whole.nc", workers=1)
    fmu, binding = files
    out = tmp_path / "part.nc"
    command = [sys.executable, "-m", "uav_twin", "library", "sample", "--quiet", "--workers", "1"]
    command += ["--fmu", str(fmu), "--binding", str(binding), "--out", str(out), "--grid", "wear=0,0.25,0.5"]
    command += ["--grid", "gain=0.8:1.2:20", "--grid", "push=2,4", "--grid", f"mode={SLOW}"]
    for wanted, end, resume in ((5, signal.SIGINT, []), (10, signal.SIGKILL, ["--resume"])):
        process = subprocess.Popen([*command, *resume], cwd=ROOT, stderr=subprocess.PIPE)
        while finished(out) < 2 * wanted and process.poll() is None:
            time.sleep(0.01)
        process.send_signal(end)
        words = process.communicate()[1].decode()
        if end == signal.SIGINT:
            assert process.returncode == 130
            assert words.startswith("Interrupted; finished blocks are kept")
            assert "Traceback" not in words
    assert not out.exists()
    with pytest.raises(MissionInputError, match=r"part\.nc\.blocks holds the finished blocks"):
        sample_library(slow, out)
    with pytest.raises(MissionInputError, match=r"another FMU, binding, grid .*\(draws\)"):
        sample_library(grid(files, SLOW), out, resume=True)
    outcome = sample_library(slow, out, workers=2, resume=True)
    assert wanted <= outcome.kept_blocks < outcome.block_count
    assert out.read_bytes() == whole.path.read_bytes()


def test_what_is_damaged_is_sampled_again(files, tmp_path, monkeypatch):
    """To the same bytes, whatever the number of processes."""
    some = grid(files, draws=tuple(np.linspace(0.8, 1.2, 30)))  # in blocks of three points
    whole = sample_library(some, tmp_path / "whole.nc", workers=3)

    def full_disk(*_: object) -> None:
        raise KeyboardInterrupt

    for out in (tmp_path / "block.nc", tmp_path / "file.nc"):
        with monkeypatch.context() as patch:
            patch.setattr("twin_master.library.sampling.write_observation_library", full_disk)
            with pytest.raises(KeyboardInterrupt):
                sample_library(some, out, workers=1)
        kept = blocks_folder(out) / "observations.npy"
        if out.stem == "block":
            np.load(kept, mmap_mode="r+")[3] = np.nan
        else:
            kept.write_bytes(kept.read_bytes()[:-8])
        outcome = sample_library(some, out, workers=1, resume=True)
        assert outcome.block_count - outcome.kept_blocks == (
            1 if out.stem == "block" else outcome.block_count
        )
        assert out.read_bytes() == whole.path.read_bytes()


def test_an_fmu_that_remembers_is_refused_and_sampled_from_a_fresh_start(files, tmp_path):
    for mode in (LAG, COUNT):
        with pytest.raises(MissionInputError, match=r"remembers earlier steps: at wear = .*--settle"):
            sample_library(grid(files, mode), tmp_path / "lever.nc", workers=1, replace_existing=True)
    with pytest.raises(MissionInputError, match="has not settled after 3 steps"):
        sample_library(
            grid(files, LAG, settling_steps=3), tmp_path / "lever.nc", workers=1, replace_existing=True
        )
    lagging = grid(files, LAG, settling_steps=40)
    settled = sample_library(lagging, tmp_path / "lever.nc", workers=1, replace_existing=True)
    exact = sample_library(grid(files), tmp_path / "exact.nc", workers=1)
    np.testing.assert_allclose(settled.library.values, exact.library.values, rtol=1e-11)
    assert settled.library.settling_steps == 40


def test_a_refused_point_a_crash_and_a_hanging_fmu_are_one_sentence_each(files, tmp_path):
    out = tmp_path / "lever.nc"
    with pytest.raises(
        FmuCallError, match=r"at wear = 0\.5, control push = [24], mode = 5, gain = 0\.9: .*Discard"
    ):
        sample_library(grid(files, REFUSE), out, workers=2)
    # What came before is kept, so that the user can mend the FMU's surroundings and go on.
    assert finished(out)
    with pytest.raises(FmuWorkerError, match=r"at or soon after wear = .*ended by signal 6 \(SIGABRT\)"):
        sample_library(grid(files, DIE), out, workers=1, replace_existing=True)
    with pytest.raises(FmuTimeoutError, match=r"longer than 0\.1 s for a step"):
        sample_library(grid(files, SLEEP, step_timeout=0.1), out, workers=1, replace_existing=True)
    assert not out.exists()


def test_what_does_not_fit_is_named_before_anything_is_started(files, tmp_path):
    out = tmp_path / "lever.nc"
    for changes, words in Inputs(__file__).refused("grids"):
        with pytest.raises(MissionInputError, match=words):
            sample_library(grid(files, **changes), out, workers=1)
    with pytest.raises(MissionInputError, match="suffix"):
        sample_library(grid(files), tmp_path / "lever.csv", workers=1)
    with pytest.raises(MissionInputError, match="at least 1"):
        sample_library(grid(files), out, workers=0)
    out.write_bytes(b"a library")
    with pytest.raises(MissionInputError, match="exists"):
        sample_library(grid(files), out, workers=1)
    assert [path.name for path in tmp_path.iterdir()] == ["lever.nc"]
