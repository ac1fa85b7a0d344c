"""Any FMU in a process of its own: what it does wrong is one clear sentence and nobody else's trouble."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from fmu_asset.door.binding import Binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import FmuWorkerError
from fmu_asset.packing.structure_fmu import build_fmu
from tests.fmu_asset.chain import chain_model
from tests.fmu_asset.making import archive_of, members

FINE, WANDER, TALK = 0.0, 6.0, 7.0
PUSHED = {"push": 1.0}


def test_an_interruption_leaves_no_stale_answer(
    spring_mass: Path, spring_binding: Binding, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with FmiAsset(spring_mass, spring_binding) as asset:
        expected = asset.step(PUSHED).values
        with monkeypatch.context() as patch:
            patch.setattr("fmu_asset.worker.client.WorkerInstance._await", interrupt)
            with pytest.raises(KeyboardInterrupt):
                asset.step({"push": 2.0})
        with pytest.raises(FmuWorkerError, match="interrupted; reset the asset"):
            asset.step()
        asset.reset()
        np.testing.assert_array_equal(asset.step(PUSHED).values, expected)


def test_what_an_fmu_does_to_its_process_stays_there(
    spring_mass: Path, spring_binding: Binding, fmu: Path, binding: Binding, tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Neither its chatter nor its working directory nor its modules are the twin's, or another FMU's."""
    here, path, modules = Path.cwd(), list(sys.path), set(sys.modules)
    with FmiAsset(spring_mass, spring_binding) as asset:
        for behaviour in (TALK, WANDER, FINE):
            asset.step(load={"misbehaviour": behaviour})
        assert asset.log[0] == ("OK", "the spring creaks")
    assert capfd.readouterr().out == ""
    other = build_fmu(chain_model(1.8e5), tmp_path / "stiff.fmu").path
    with FmiAsset(fmu, binding, isolated=False) as wing, FmiAsset(other, binding, isolated=False) as stiff:
        with FmiAsset(spring_mass, spring_binding, isolated=False) as asset:
            asset.step()
            assert "SpringMass" in sys.modules
        for _ in range(2):
            one, two = wing.step({"load_factor": 3.0}), stiff.step({"load_factor": 3.0})
            np.testing.assert_allclose(one.values, 2.0 * two.values, rtol=1e-9)
    assert (Path.cwd(), sys.path) == (here, path)
    assert not [name for name in set(sys.modules) - modules if name.startswith(("uav_wing_", "SpringMass"))]


def test_a_temporary_folder_with_odd_characters(
    fmu: Path, binding: Binding, tmp_path: Path, isolated: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    odd = tmp_path / "Flügel é # % + 翼 'x' \"y\" $z"
    odd.mkdir()
    file = archive_of(odd / "wing é.fmu", members(fmu) | {"resources/Größe ß.txt": b"x"})
    monkeypatch.setattr(tempfile, "tempdir", str(odd))
    with FmiAsset(file, binding, isolated=isolated) as asset:
        assert np.all(asset.step({"load_factor": 3.0}).values > 0.0)
