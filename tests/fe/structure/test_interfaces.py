"""Interfaces of two parts: springs in series in closed form, and the merged mesh as their limit."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from fe.runtime.errors import FiniteElementError, MeshError
from fe.runtime.patch import InterfaceCompliance, ModelPatch
from fe.structure.affine import natural_frequencies, static_responses
from fe.structure.changed_file import changed_tables
from fe.structure.operators import assemble_structure
from reporting.formats.toml_file import toml_text
from tests.meshes import box

WriteBeam = Callable[..., Path]

HALVES = """set = [
    { name = "left", of = "cells", box = [[0, 0, 0], [50, 20, 10]] },
    { name = "right", of = "cells", box = [[50, 0, 0], [100, 20, 10]] },
    { name = "first", of = "cells", box = [[0, 0, 0], [25, 20, 10]] },"""
SLENDER = {
    "set = [": HALVES,
    "poisson_ratio = 0.33": "poisson_ratio = 0.0",
    "free = true": "free = false",
    "mass = 0.05": "mass = 1e-9",
}
ALONG = {
    "force = [0, 0, 1]": "force = [1, 0, 0]",
    "10, 5], direction = [0, 0, 1] }]\nacc": "10, 5], direction = [1, 0, 0] }]\nacc",
}
PUSH = 50.0
"""Nominal force at the end [N]."""
ARM = 0.05
"""Distance of the force from the interface [m]."""


class Answers(NamedTuple):
    """Displacement of the end under the force, strains of the gauges, and natural frequencies."""

    end: float
    strain: np.ndarray
    frequency: np.ndarray


def with_joint(file: Path, keys: str = "", parts: str = '"left", "right"') -> Path:
    """Add an interface to a structure file."""
    row = f'\n[[interface]]\nname = "joint"\nparts = [{parts}]\n{keys}\n'
    file.write_text(file.read_text(encoding="utf-8") + row, encoding="utf-8")
    return file


def answers(file: Path) -> Answers:
    structure = assemble_structure(file)
    pushed = static_responses(structure)["pushed"]
    return Answers(
        end=float(pushed.output[0]),
        strain=pushed.strain,
        frequency=natural_frequencies(structure, 4).frequency,
    )


@pytest.mark.parametrize("stiffness", [2e7, 1e12])
def test_a_bar_in_series_with_a_normal_spring(
    write_beam: WriteBeam, tmp_path: Path, stiffness: float
) -> None:
    """The end of the bar moves by F L / (E A) + F / k, down to the merged bar."""
    file = with_joint(write_beam(tmp_path, SLENDER | ALONG), f"normal = {stiffness}")
    area = 0.02 * 0.01
    assert answers(file).end == pytest.approx(
        PUSH * 0.1 / (7e10 * area) + PUSH / stiffness, rel=1e-9
    )


def test_a_hinge_adds_the_turn_of_its_spring_and_no_strain(
    write_beam: WriteBeam, tmp_path: Path
) -> None:
    merged = answers(write_beam(tmp_path, SLENDER))
    hinged = answers(with_joint(write_beam(tmp_path, SLENDER), "bending = [400.0, 0]"))
    assert hinged.end - merged.end == pytest.approx(PUSH * ARM**2 / 400.0, rel=1e-9)
    assert hinged.strain == pytest.approx(merged.strain, rel=1e-9)


def test_shear_between_the_parts_moves_the_end_by_its_spring(
    write_beam: WriteBeam, tmp_path: Path
) -> None:
    merged = answers(write_beam(tmp_path, SLENDER))
    loose = answers(with_joint(write_beam(tmp_path, SLENDER), "tangential = 1e6"))
    assert loose.end - merged.end == pytest.approx(PUSH / 1e6, rel=1e-9)


def test_an_interface_without_springs_is_the_merged_mesh(
    write_beam: WriteBeam, tmp_path: Path
) -> None:
    merged = answers(write_beam(tmp_path, SLENDER))
    joined = answers(with_joint(write_beam(tmp_path, SLENDER)))
    assert joined.end == pytest.approx(merged.end, rel=1e-11)
    assert joined.strain == pytest.approx(merged.strain, rel=1e-9)
    assert joined.frequency == pytest.approx(merged.frequency, rel=1e-9)


def test_parts_with_nodes_of_their_own_are_joined_as_those_that_share_them(
    write_beam: WriteBeam, tmp_path: Path
) -> None:
    """Two boxes, each meshed alone, touch where the interface is."""
    import meshio

    shared = answers(with_joint(write_beam(tmp_path, SLENDER), "normal = 1e7\nbending = 500.0"))
    points, cells = box("hexahedron20", (2, 1, 1))
    half = points * [50.0, 20.0, 10.0]
    mesh = meshio.Mesh(
        np.concatenate((half, half + np.array([50.0, 0.0, 0.0]))),
        [("hexahedron20", np.concatenate((cells, cells + len(points))))],
    )
    file = with_joint(write_beam(tmp_path, SLENDER), "normal = 1e7\nbending = 500.0")
    meshio.write(tmp_path / "beam.vtu", mesh)
    touching = answers(file)
    assert touching.end == pytest.approx(shared.end, rel=1e-9)
    assert touching.frequency == pytest.approx(shared.frequency, rel=1e-8)


def test_a_patch_of_an_interface_is_written_into_the_file(
    write_beam: WriteBeam, tmp_path: Path
) -> None:
    file = with_joint(write_beam(tmp_path, SLENDER), "bending = [800.0, 0]")
    patch = ModelPatch(
        (InterfaceCompliance("joint", "rs", 1.0 / 800.0), InterfaceCompliance("joint", "n", 1e-8))
    )
    changed = tmp_path / "changed.toml"
    changed.write_text(toml_text(changed_tables(file, patch, tmp_path)), encoding="utf-8")
    expected = with_joint(write_beam(tmp_path, SLENDER), "bending = [400.0, 0]\nnormal = 1e8")
    assert answers(changed).end == pytest.approx(answers(expected).end, rel=1e-9)


@pytest.mark.parametrize(
    ("parts", "sentence"),
    [
        ('"left", "left"', "two different parts are expected"),
        ('"left", "first"', "share elements"),
        ('"first", "outer"', "have no node in common"),
        ('"first", "right"', "have no node in common"),
        ('"left", "nose"', "no set of cells named 'nose'"),
    ],
)
def test_parts_that_do_not_touch_are_refused(
    write_beam: WriteBeam, tmp_path: Path, parts: str, sentence: str
) -> None:
    with pytest.raises(FiniteElementError, match=sentence):
        assemble_structure(with_joint(write_beam(tmp_path, SLENDER), parts=parts))


def test_a_support_at_the_interface_is_refused(write_beam: WriteBeam, tmp_path: Path) -> None:
    root = 'name = "root", of = "nodes", box = [[0, 0, 0], '
    clamped = {root + "[0,": root + "[50,"}
    with pytest.raises(MeshError, match="nodes that a support holds"):
        assemble_structure(with_joint(write_beam(tmp_path, SLENDER | clamped)))
