"""The FMU of a structure against the reduced model that was packed, quasi-static and in motion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fe.reduction.reduced_basis import Reduction
from fe.runtime.reduced import ReducedModel
from fe.runtime.state import WING
from fe.runtime.transient import ModalIntegrator
from fe.structure.operators import Structure
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.check import check_file
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import FmuBuildError
from fmu_asset.packing.structure_fmu import build_fmu
from fmu_asset.slaves.table import structure_table
from fmu_asset.structures.binding import structure_binding


@pytest.fixture(scope="module")
def model(beam_reduction: Reduction) -> ReducedModel:
    """The reduced beam."""
    return beam_reduction.model


@pytest.fixture(scope="module")
def fmu(model: ReducedModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its FMU."""
    return build_fmu(model, tmp_path_factory.mktemp("fmu") / "beam.fmu").path


def _inputs(model: ReducedModel, steps: int) -> list[dict[str, float]]:
    random = np.random.default_rng(11)
    return [
        {name: float(random.uniform(*model.validity[name])) for name in (*model.controls, *model.regions)}
        for _ in range(steps)
    ]


def _step(asset: FmiAsset, model: ReducedModel, chosen: dict[str, float]) -> Any:
    control, health = ({name: chosen[name] for name in names} for names in (model.controls, model.regions))
    return asset.step(control, health)


def test_every_step_is_that_of_the_model(model: ReducedModel, fmu: Path, beam: Structure) -> None:
    """Quasi-static: strains, displacements and bounds to 1e-12 of the largest; accelerations are zero."""
    with FmiAsset(
        fmu, structure_binding(beam.design), parameters={"e": 1.06, "pump": 0.03}, isolated=False
    ) as asset:
        for chosen in _inputs(model, 20):
            seen = _step(asset, model, chosen)
            found = model.static_response({**chosen, "e": 1.06, "pump": 0.03})
            wanted = [*found.strain, *found.displacement, 0.0]
            np.testing.assert_allclose(
                seen.values, wanted, rtol=1e-12, atol=1e-12 * np.abs(found.strain).max()
            )
            assert seen.extra["strain_error_bound"] == pytest.approx(found.strain_error_bound, rel=1e-12)


def test_motion_is_that_of_the_model(model: ReducedModel, fmu: Path, beam: Structure) -> None:
    """Transient, health changing on the way; a state that is restored goes on to the bit."""
    steps = _inputs(model, 12)
    for number in range(1, 6):  # the load jumps while health stays
        steps[number] |= {name: steps[0][name] for name in model.regions}
    binding = structure_binding(beam.design)
    binding = binding.model_copy(update={"binding": binding.binding.model_copy(update={"step_size": 1e-3})})
    seen, kept = [], b""
    with FmiAsset(fmu, binding, parameters={"response": 2}, isolated=False) as asset:
        for number, chosen in enumerate(steps):
            if number == 8:
                kept = asset.save_state()
            seen.append(_step(asset, model, chosen).values)
        asset.restore_state(kept)
        after = [_step(asset, model, chosen).values for chosen in steps[8:]]
    assert np.array_equal(after, seen[8:])
    motion = ModalIntegrator(model, model.nominal, *model.damping)
    state = motion.at_rest(model.load_coefficients(model.nominal))
    wanted, health = [], dict.fromkeys(model.regions, 0.0)
    for chosen in steps:
        vector = model.vector(chosen)
        if health != (health := {name: chosen[name] for name in model.regions}):
            before, motion = motion, ModalIntegrator(model, vector, *model.damping)
            state = motion.take_over(state, before)
        state = motion.advance(state, 1e-3, model.load_coefficients(vector))
        wanted.append(motion.outputs(state))
    largest = np.abs(wanted).max(axis=0)
    np.testing.assert_allclose(np.array(seen) / largest, np.array(wanted) / largest, atol=1e-12, rtol=0)
    assert largest[-1] > 1.0  # m/s^2


def test_the_check_of_the_file_finds_nothing(fmu: Path) -> None:
    findings = {check: verdict for check, verdict, _ in check_file(read_fmu(fmu))}
    assert set(findings.values()) == {"ok"}
    assert {"fmpy validate", "content", "units", "ranges"} <= set(findings)


def test_a_structure_of_the_wings_name_is_no_wing(model: ReducedModel) -> None:
    table, roles = structure_table(replace(model, name=WING), {})
    assert roles.displacement_bound == "displacement_error_bound"
    assert [row.name for row in table] == [row.name for row in structure_table(model, {})[0]]


def test_equal_models_make_equal_bytes_and_bad_starts_are_refused(
    model: ReducedModel, fmu: Path, tmp_path: Path
) -> None:
    assert build_fmu(model, tmp_path / "again.fmu").path.read_bytes() == fmu.read_bytes()
    with pytest.raises(FmuBuildError, match="'z9'"):
        build_fmu(model, tmp_path / "z9.fmu", start={"z9": 1.0})
    with pytest.raises(FmuBuildError, match=r"health\.z1"):
        build_fmu(model, tmp_path / "z1.fmu", start={"health.z1": 0.9})
