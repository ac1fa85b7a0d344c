"""A structure from a mesh as a compiled FMU: the sources of the wing, and the outputs of the Python FMU."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fe.runtime.reduced import ReducedModel
from fmu_asset.check import check_fmu
from fmu_asset.packing.structure_fmu import build_fmu, recorded_content_hash

OK, DISCARD, ERROR = 0, 2, 3
DRIVER = Path(__file__).with_name("driver.c")


@pytest.fixture(scope="module")
def pair(
    compiled_beam: Path, beam_model: ReducedModel, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Path]:
    """The beam as a compiled FMU, and as one that runs in Python."""
    return compiled_beam, build_fmu(beam_model, tmp_path_factory.mktemp("pair") / "python.fmu").path


def _fly(slave: Any, model: ReducedModel, seed: int, response: int) -> list[list[float]]:
    """Parameters, inputs and steps at random: health mostly stays, a load is often none at all."""
    rng = np.random.default_rng(seed)
    inputs = [v for v in slave.description.variables if v.causality == "input"]
    start = {name: float(rng.uniform(*model.validity[name])) for name in ("e", "push", "pump")}
    start |= {"mass__pump": start.pop("pump"), "damping__alpha": float(rng.choice([0.0, 5.0, 2e4]))}
    slave.fmu.reset()
    assert slave.start(response=response, **start) == OK, slave.log
    seen, time, values = [slave.everything()], 0.0, [0.0] * len(inputs)
    for _ in range(20):
        for number, variable in enumerate(inputs):
            if rng.random() < 0.4:
                values[number] = float(rng.uniform(variable.minimum, variable.maximum))
        if rng.random() < 0.3:
            values[0] = 0.0
        size = float(rng.choice([1e-5, 1e-3, 0.1]))
        slave.fmu.setReal([v.reference for v in inputs], values)
        assert slave.status_of(slave.fmu.doStep, time, size) == OK, slave.log
        time += size
        seen.append(slave.everything())
    return seen


def test_outputs_equal_those_of_the_python_fmu(
    pair: tuple[Path, Path], beam_model: ReducedModel, open_slave: Callable[..., Any]
) -> None:
    """Strains, displacements, accelerations, both bounds, frequencies, damping ratios: to 1e-12."""
    slaves = [open_slave(path) for path in pair]
    names = [v.name for v in slaves[0].description.variables if v.kind == "Real"]
    for seed in range(8):
        for response in (1, 2):
            ours, expected = (np.array(_fly(slave, beam_model, seed, response)) for slave in slaves)
            scale = np.maximum(np.abs(expected).max(axis=0), 1e-300)
            strain = max(size for name, size in zip(names, scale, strict=True) if name.startswith("strain."))
            for number, name in enumerate(names):
                # a bound is made of outputs that cancel: its digits end where theirs do
                moved = scale[names.index("displacement.tip")]
                limits = {"strain_error_bound": strain, "displacement_error_bound": moved}
                apart = np.abs(ours[:, number] - expected[:, number]).max()
                assert apart <= 1e-12 * limits.get(name, scale[number]), name
            assert (np.abs(ours[1:, names.index("acceleration.shake")]).max() > 0.0) == (response == 2)
    for slave in slaves:
        slave.close()


def test_a_compiled_fmu_bounds_as_python_does(
    compiler: list[str], plate_model: ReducedModel, tmp_path: Path, open_slave: Any
) -> None:
    compiled = build_fmu(plate_model, tmp_path / "compiled.fmu", kind="compiled").path
    slave, rng = open_slave(compiled), np.random.default_rng(3)
    assert slave.start(response=1) == 0, slave.log
    place, names = slave.reference, [v.name for v in slave.description.variables if v.kind == "Real"]
    for number in range(5):
        values = {name: float(rng.uniform(*plate_model.validity[name])) for name in plate_model.regions}
        values |= {"pull": 2e4, "bend": -30.0 * number}
        inputs = [place.get(name, place.get(f"health.{name}")) for name in values]
        slave.fmu.setReal(inputs, list(values.values()))
        assert slave.status_of(slave.fmu.doStep, 0.1 * number, 0.1) == 0, slave.log
        seen, found = dict(zip(names, slave.everything(), strict=True)), plate_model.static_response(values)
        for kind in ("strain", "displacement"):
            wanted = getattr(found, f"{kind}_error_bound")
            assert seen[f"{kind}_error_bound"] == pytest.approx(wanted, rel=1e-6)
    slave.close()


def test_no_check_finds_anything(compiled_beam: Path) -> None:
    check = check_fmu(compiled_beam)
    assert check.passed, check.problems
    assert "warning" not in {finding.verdict for finding in check.findings}
    declared, actual = recorded_content_hash(compiled_beam)
    assert declared == actual


def test_modes_that_coincide_are_those_of_python(
    compiler: list[str], beam_model: ReducedModel, tmp_path: Path, open_slave: Callable[..., Any]
) -> None:
    """A double mode, two 1e-7 apart, two 1e-3, whatever the loss: motion and frequencies to 1e-9."""
    size = beam_model.modal_load.shape[1]
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(size, size)))[0]
    squares = 1e6 * np.arange(1.0, size + 1.0) ** 2
    squares[2], squares[4] = squares[1], squares[3] * (1.0 + 1e-7)
    squares[6] = squares[5] * 1.001
    shares = np.full(len(beam_model.modal_stiffness), 1.0 / len(beam_model.modal_stiffness))
    masses = np.zeros_like(beam_model.modal_mass)
    masses[0] = np.eye(size)
    model = replace(
        beam_model,
        modal_stiffness=np.multiply.outer(shares, (turn * squares) @ turn.T),
        modal_mass=masses,
        cross_mass=np.zeros_like(beam_model.cross_mass),
    )
    slaves = [
        open_slave(build_fmu(model, tmp_path / f"{kind}.fmu", kind=kind).path)
        for kind in ("compiled", "python")
    ]
    for seed in range(3):
        ours, expected = (np.array(_fly(slave, model, seed, 2)) for slave in slaves)
        scale = np.maximum(np.abs(expected).max(axis=0), 1e-300)
        assert (np.abs(ours - expected).max(axis=0) <= 1e-9 * scale).all()
    for slave in slaves:
        slave.close()
