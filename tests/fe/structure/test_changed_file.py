"""The file of a structure under a patch is that of the changed structure."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fmpy import simulate_fmu
from fmpy.validation import validate_fmu

from fe.full.factorisation import Factorisation, lowest_eigenpairs
from fe.reduction.change_basis import with_changes
from fe.reduction.model_cache import reduced_model
from fe.reduction.reduced_basis import reduce_structure
from fe.runtime.arrays import FloatArray
from fe.runtime.changed_structure import ChangedStructure
from fe.runtime.errors import InvalidDesignError, InvalidPatchError
from fe.runtime.patch import (
    GaugeOffset,
    LoadGain,
    LoadTilt,
    ModelPatch,
    PlaceMass,
    RegionStiffnessLoss,
    SupportCompliance,
)
from fe.structure.changed_file import changed_tables
from fe.structure.operators import assemble_structure
from fmu_asset.packing.structure_fmu import build_fmu
from reporting.formats.toml_file import read_toml, toml_text

WriteBeam = Callable[..., Path]


def written(file: Path, folder: Path, patch: ModelPatch) -> Path:
    """Write the file of a structure under a patch into another folder."""
    folder.mkdir()
    changed = folder / "changed.toml"
    changed.write_text(toml_text(changed_tables(file, patch, folder)))
    return changed


def full_answers(file: Path) -> tuple[FloatArray, FloatArray]:
    """Return outputs at rest under 50 N of the load, and natural frequencies, of the full model."""
    full = assemble_structure(file)
    rows = np.concatenate((full.gauge_output.toarray(), full.displacement_output.toarray()))
    outputs = rows @ Factorisation(full.stiffness()).solve(full.load("pushed", 50.0))
    squares, _ = lowest_eigenpairs(full.stiffness(), full.mass(full.masses), 4)
    return outputs, np.sqrt(squares) / (2.0 * np.pi)


def test_a_file_states_a_support_that_yields_a_mass_and_a_load_that_leans(
    write_beam: WriteBeam, tmp_path: Path
) -> None:
    file = write_beam(tmp_path, cells=2)
    yielding = assemble_structure(file, yielding=True)
    model = with_changes(yielding, reduce_structure(yielding.with_held_supports()))
    patch = ModelPatch(
        (
            SupportCompliance("root", "ry", 1e-3),
            SupportCompliance("root", "z", 1e-7),
            PlaceMass(model.mass_places[-1], 0.02),
            LoadTilt("push", "y", 0.1),
        )
    )
    outputs, frequencies = full_answers(written(file, tmp_path / "changed", patch))
    structure = ChangedStructure(model, model.vector({}), patch)
    of_push = model.load_factors[:, 0] == 1 + model.controls.index("push")
    load = 50.0 * model.changed_load(model.whole_load[of_push].sum(axis=0), "push", patch)
    displacements = structure.basis @ structure.static(structure.basis.T @ load)
    expected = model.whole_output[: len(outputs)] @ displacements
    assert outputs == pytest.approx(expected, rel=2e-3, abs=2e-3 * np.abs(expected[:1]).max())
    assert frequencies[:3] == pytest.approx(structure.modes.frequency[:3], rel=2e-3)


def test_a_file_states_a_patch_that_lost_stiffness_and_a_mass_beside_a_point(
    write_beam: WriteBeam, tmp_path: Path
) -> None:
    """The mass lies 3 mm beside a named point at the tip."""
    file = write_beam(tmp_path, cells=4)
    yielding = assemble_structure(file, yielding=True)
    model = with_changes(yielding, reduce_structure(yielding.with_held_supports()))
    place = int(np.argmax(model.mass_points[:, 0] * (model.mass_reaches > 0.0)))
    along = -3e-3 * float(np.sign(model.mass_axes[place, 0, 0]))
    patch = ModelPatch(
        (
            RegionStiffnessLoss(model.loss_places[-1], 0.4),
            PlaceMass(model.mass_places[place], 0.005, along=along),
        )
    )
    of_region = ModelPatch((RegionStiffnessLoss("z1", 0.2),))
    changed = written(file, tmp_path / "changed", patch + of_region)
    (*_, mass) = read_toml(changed, InvalidDesignError, what="structure file")["mass"]
    expected_point = model.mass_points[place] + along * model.mass_axes[place, 0]
    assert mass["point"] == pytest.approx(1e3 * expected_point, abs=0.5)
    outputs, frequencies = full_answers(changed)
    structure = ChangedStructure(model, model.vector({"z1": 0.2}), patch)
    of_push = model.load_factors[:, 0] == 1 + model.controls.index("push")
    load = 50.0 * structure.basis.T @ model.whole_load[of_push].sum(axis=0)
    expected = model.whole_output[: len(outputs)] @ structure.basis @ structure.static(load)
    assert outputs == pytest.approx(expected, rel=2e-3, abs=2e-3 * np.abs(expected[:1]).max())
    assert frequencies[:2] == pytest.approx(structure.modes.frequency[:2], rel=2e-3)


def test_a_file_states_the_length_over_which_stiffness_was_lost(
    write_beam: WriteBeam, tmp_path: Path
) -> None:
    """A gauge on the cells reads more than their mean strain, by the compliance of two thirds."""
    file = write_beam(tmp_path, cells=2)
    readings = []
    for extent in (1.0, 0.5):
        patch = ModelPatch((RegionStiffnessLoss("z1", 0.4, extent),))
        outputs, _ = full_answers(written(file, tmp_path / f"extent {extent}", patch))
        readings.append(outputs)
    ratios = readings[1] / readings[0]
    added = 0.4 / 0.6
    expected_ratio = (1.0 + added / 0.5) / (1.0 + added)
    assert ratios[0] == pytest.approx(expected_ratio)
    assert ratios[1:] == pytest.approx(np.ones(len(ratios) - 1))


def test_an_fmu_of_the_written_file_carries_a_loss_and_a_mass(
    write_beam: WriteBeam, tmp_path: Path
) -> None:
    """Its displacement at rest and its frequencies are those of the full model of the file."""
    file = write_beam(tmp_path, cells=4)
    patch = ModelPatch(
        (
            RegionStiffnessLoss("around (37.5, 10, 5) mm", 0.4),
            PlaceMass("the point (75, 20, 0) mm", 0.03),
        )
    )
    changed = written(file, tmp_path / "changed", patch)
    fmu = tmp_path / "changed.fmu"
    build_fmu(reduced_model(changed), fmu)
    assert validate_fmu(str(fmu)) == []
    names = ["displacement.tip", "frequency[1]", "frequency[2]"]
    values = {"push": 50.0, "load_factor": 0.0}
    result = simulate_fmu(str(fmu), stop_time=0.01, start_values=values, output=names)
    tip, *fmu_frequencies = [float(result[name][-1]) for name in names]
    (*_, expected_tip), frequencies = full_answers(changed)
    assert tip == pytest.approx(expected_tip, rel=2e-3)
    assert fmu_frequencies == pytest.approx(frequencies[:2], rel=1e-3)
    (*_, plain_tip), plain_frequencies = full_answers(file)
    assert tip > 1.05 * plain_tip
    assert frequencies[0] < 0.97 * plain_frequencies[0]


def test_a_file_states_a_gauge_beside_its_place(write_beam: WriteBeam, tmp_path: Path) -> None:
    file = write_beam(tmp_path, cells=2)
    patch = ModelPatch((GaugeOffset("g1", "along", 2e-3),))
    (gauge, *_) = changed_tables(file, patch, tmp_path)["gauge"]
    assert gauge["point"] == pytest.approx([22.0, 10.0, 10.0])


@pytest.mark.parametrize(
    ("primitive", "sentence"),
    [
        (PlaceMass("root", -0.1), "a mass must be positive"),
        (RegionStiffnessLoss("around", 0.3), "the mesh has no cells 'around'"),
        (LoadGain(0.1, 0.0), "it has no table for this"),
    ],
)
def test_what_a_file_cannot_state_is_refused(
    write_beam: WriteBeam, tmp_path: Path, primitive: PlaceMass, sentence: str
) -> None:
    with pytest.raises(InvalidPatchError, match=sentence):
        changed_tables(write_beam(tmp_path), ModelPatch((primitive,)), tmp_path)
