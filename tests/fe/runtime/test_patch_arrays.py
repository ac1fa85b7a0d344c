"""The arrays of a wing for patches: file, checks, cache."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fe.reduction import model_cache
from fe.reduction.model_cache import entry
from fe.reduction.patch_basis import PatchSettings
from fe.runtime.errors import ReducedModelFileError
from fe.runtime.patch_arrays import PatchArrays
from fe.wing.design import WingDesign
from fe.wing.patch_operators import area_shares, strip_edges


def test_a_file_gives_the_arrays_back(coarse_patch_arrays: PatchArrays, tmp_path: Path) -> None:
    path = tmp_path / "wing.npz"
    coarse_patch_arrays.save(path)
    again = PatchArrays.load(path)
    for item in fields(PatchArrays):
        one, other = getattr(coarse_patch_arrays, item.name), getattr(again, item.name)
        assert np.array_equal(one, other), item.name
    assert again.to_bytes() == coarse_patch_arrays.to_bytes()


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("load_tip", lambda _: np.full(3, np.nan), "array"),
        ("flap_spring", lambda _: 0.0, "flap_spring"),
        ("straight_chord_line", lambda _: 2.0, "straight_chord_line"),
        ("weight", lambda _: np.zeros(2), "weight"),
        ("strip_of", lambda strips: np.array([99, *strips[1:]]), "strips"),
        ("stations", lambda stations: stations[::-1].copy(), "must rise"),
    ],
)
def test_wrong_arrays_are_refused(
    coarse_patch_arrays: PatchArrays, name: str, change: Callable[[Any], object], message: str
) -> None:
    with pytest.raises(ReducedModelFileError, match=message):
        replace(coarse_patch_arrays, **{name: change(getattr(coarse_patch_arrays, name))})


def test_strip_edges_are_mesh_lines_ends_included() -> None:
    lines = np.array([0.0, 0.003, 0.1, 0.25, 0.5, 0.52, 0.8, 1.0])
    edges = strip_edges(lines, 4)
    assert edges.tolist() == [0.0, 0.25, 0.5, 0.8, 1.0]
    assert strip_edges(lines, 100).tolist() == lines.tolist()


def test_area_shares_integrate_a_parabola_on_each_cell() -> None:
    stations = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    weights = area_shares(stations, 2.0, 1.0)
    # mean of y^2 with chord 2 - y: (2/3 - 1/4) / 1.5
    assert weights @ stations**2 == pytest.approx((2.0 / 3.0 - 0.25) / 1.5, rel=1e-12)


def test_the_cache_builds_once(
    coarse_design: WingDesign,
    coarse_patch_arrays: PatchArrays,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    built = []

    def build(design: WingDesign, *_: object) -> PatchArrays:
        built.append(design.hash)
        return coarse_patch_arrays

    monkeypatch.setattr(model_cache, "build_patch_arrays", build)
    first = model_cache.patch_arrays(coarse_design)
    assert model_cache.patch_arrays(coarse_design).to_bytes() == first.to_bytes()
    assert built == [coarse_design.hash]
    other = PatchSettings(vectors=30)
    assert entry("patches", coarse_design.hash, None) != entry("patches", coarse_design.hash, other)
    (file,) = (tmp_path / "uav-twin").glob("patches-*.npz")
    file.write_bytes(b"rubbish")
    model_cache.patch_arrays(coarse_design)
    assert len(built) == 2
    assert "not usable" in caplog.text
