"""Any FMU in a process of its own: what it does wrong is one clear sentence and nobody else's trouble."""

from __future__ import annotations

import os
import signal
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fmu_asset.door.binding import Binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import FmuCallError, FmuOutputError, FmuWorkerError
from fmu_asset.packing.structure_fmu import build_fmu
from tests.fmu_asset.making import archive_of, members, run_python

FINE, NOT_A_NUMBER, _, _, RAISE, DISCARD, WANDER, TALK = map(float, range(8))
PUSHED = {"push": 1.0}


@pytest.mark.parametrize(
    ("misbehaviour", "kind", "sentence"),
    [
        (NOT_A_NUMBER, FmuOutputError, r"not finite at t = 2\.2 s: position\."),
        (DISCARD, FmuCallError, r"step 1 from t = 2\.1 s: fmi2DoStep returned Discard"),
        (RAISE, FmuCallError, r"(?s)returned Fatal.*the spring broke"),
    ],
    ids=["not a number", "discard", "fatal"],
)
def test_a_step_that_goes_wrong_is_one_sentence(
    spring_mass: Path, spring_binding: Binding, isolated: bool, misbehaviour: float, kind: Any, sentence: str
) -> None:
    with FmiAsset(spring_mass, spring_binding, isolated=isolated) as asset:
        asset.step(PUSHED)
        undisturbed = asset.step().values
        asset.reset()
        before = asset.step(PUSHED)
        with pytest.raises(kind, match=sentence):
            asset.step({"push": 7.0}, load={"misbehaviour": misbehaviour})
        if misbehaviour == DISCARD:
            after = asset.step()
            assert after.time == before.time + 0.1
            np.testing.assert_array_equal(after.values, undisturbed)
        if misbehaviour == RAISE:
            with pytest.raises(FmuWorkerError, match="reset the asset"):
                asset.step()
        asset.reset()
        assert asset.step(PUSHED).extra == {"steps": 1.0}


def test_a_killed_worker_is_a_sentence(fmu: Path, binding: Binding) -> None:
    with FmiAsset(fmu, binding) as asset:
        asset.step({"load_factor": 3.0})
        saved = asset.save_state()
        expected = asset.step({"load_factor": 2.0}).values
        assert asset.worker_process_id is not None
        os.kill(asset.worker_process_id, signal.SIGKILL)
        with pytest.raises(FmuWorkerError, match=r"step 2 from t = 2 s.*signal 9 \(SIGKILL\)"):
            asset.step()
        asset.restore_state(saved)
        np.testing.assert_array_equal(asset.step({"load_factor": 2.0}).values, expected)


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
    spring_mass: Path, spring_binding: Binding, fmu: Path, binding: Binding, capfd: pytest.CaptureFixture[str]
) -> None:
    """Neither its chatter nor its working directory nor its modules are the twin's."""
    here, path, modules = Path.cwd(), list(sys.path), set(sys.modules)
    with FmiAsset(spring_mass, spring_binding) as asset:
        asset.step(load={"misbehaviour": TALK})
        asset.step(load={"misbehaviour": WANDER})
        asset.step(load={"misbehaviour": FINE})
        assert asset.log[0] == ("OK", "the spring creaks")
    assert capfd.readouterr().out == ""
    with FmiAsset(fmu, binding, isolated=False) as wing:
        with FmiAsset(spring_mass, spring_binding, isolated=False) as asset:
            asset.step()
            assert "SpringMass" in sys.modules
        wing.step({"load_factor": 2.0})
    assert (Path.cwd(), sys.path) == (here, path)
    assert not [name for name in set(sys.modules) - modules if name.startswith(("uav_wing_", "SpringMass"))]


@pytest.mark.long
def test_a_thousand_instances_in_one_process(fmu: Path) -> None:
    """In a process of its own, since the failure that this guards against is a crash."""
    program = (
        "import sys, shutil\n"
        "from fmu_asset.archive.fmu_file import extract_fmu, read_fmu\n"
        "from fmu_asset.instances import open_instance\n"
        "from fmu_asset.instances.plan import Group, Plan\n"
        "fmu = read_fmu(sys.argv[1])\n"
        "folder = extract_fmu(fmu)\n"
        "inputs, outputs = (Group('Real', (0,), 1),), (Group('Real', (12,), 1),)\n"
        "plan = Plan(str(folder), fmu.identity, 'wing', inputs, outputs)\n"
        "for _ in range(1100):\n"
        "    instance = open_instance(plan)\n"
        "    instance.initialise(0.0, [], with_inputs=False)\n"
        "    instance.request[:] = [0.0, 1.0, 2.0]\n"
        "    instance.step()\n"
        "    instance.close()\n"
        "shutil.rmtree(folder)\n"
        "print(instance.reply[0])\n"
    )
    assert float(run_python(program, fmu)) > 0.0


def test_two_wings_in_one_process_do_not_mix(
    make_model: Any, fmu: Path, binding: Binding, tmp_path: Path
) -> None:
    other = build_fmu(make_model(1.8e5), tmp_path / "stiff.fmu").path
    with FmiAsset(fmu, binding, isolated=False) as first, FmiAsset(other, binding, isolated=False) as second:
        for _ in range(2):
            one, two = first.step({"load_factor": 3.0}), second.step({"load_factor": 3.0})
            np.testing.assert_allclose(one.values, 2.0 * two.values, rtol=1e-9)


def test_a_temporary_folder_with_odd_characters(
    fmu: Path, binding: Binding, tmp_path: Path, isolated: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    odd = tmp_path / "Flügel é # % + 翼 'x' \"y\" $z"
    odd.mkdir()
    file = archive_of(odd / "wing é.fmu", members(fmu) | {"resources/Größe ß.txt": b"x"})
    monkeypatch.setattr(tempfile, "tempdir", str(odd))
    with FmiAsset(file, binding, isolated=isolated) as asset:
        assert np.all(asset.step({"load_factor": 3.0}).values > 0.0)
