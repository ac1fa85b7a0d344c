"""The FMU of a structure against the reduced model that was packed, quasi-static and in motion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from fe.reduction.reduced_basis import Reduction
from fe.runtime.reduced import ReducedModel
from fe.runtime.state import WING
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.check import check_file
from fmu_asset.errors import FmuBuildError
from fmu_asset.packing.structure_fmu import build_fmu
from fmu_asset.slaves.table import structure_table


@pytest.fixture(scope="module")
def model(beam_reduction: Reduction) -> ReducedModel:
    """The reduced beam."""
    return beam_reduction.model


@pytest.fixture(scope="module")
def fmu(model: ReducedModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its FMU."""
    return build_fmu(model, tmp_path_factory.mktemp("fmu") / "beam.fmu").path


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
