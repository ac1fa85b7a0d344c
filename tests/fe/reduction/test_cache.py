import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from threadpoolctl import threadpool_limits

from fe.reduction import model_cache
from fe.reduction.built_once import cache_folder
from fe.reduction.fields import WingFields
from fe.reduction.model_cache import MODELLING_ROOMS, entry, patch_arrays, reduced_model, wing_fields
from fe.reduction.settings import StructureSettings
from fe.runtime.kept_arrays import KeptArrays
from fe.wing.design import WingDesign

ROOT = Path(__file__).parents[3]


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "uav-twin"


@pytest.fixture
def builds(monkeypatch: pytest.MonkeyPatch, coarse_fields, coarse_patch_arrays) -> list[str]:
    """Names of the designs that were built; the builds themselves are replaced by finished ones."""
    built: list[str] = []

    def building(made: KeptArrays) -> Callable[..., KeptArrays]:
        def build(design: WingDesign, *_: object) -> KeptArrays:
            built.append(design.name)
            time.sleep(0.05)
            return replace(made, design_hash=design.hash)

        return build

    monkeypatch.setattr(model_cache, "build_fields", building(coarse_fields))
    monkeypatch.setattr(model_cache, "build_patch_arrays", building(coarse_patch_arrays))
    return built


def test_cache_lies_where_the_user_says(own_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert cache_folder() == own_cache
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder() == Path.home() / ".cache" / "uav-twin"


def test_what_is_unchanged_is_built_once_and_what_is_changed_anew(
    builds, coarse_design, shipped_design, monkeypatch
) -> None:
    first, again, wing = (
        make(coarse_design.changed()) for make in (reduced_model, reduced_model, wing_fields)
    )
    assert builds == [coarse_design.name]
    assert first.to_bytes() == again.to_bytes() == wing.model.to_bytes()
    assert wing.static_displacement.shape[-1] == first.static_stiffness.shape[-1]
    changed = coarse_design.changed(skin={"thickness": 0.0007})
    for _ in range(2):
        assert reduced_model(changed).design_hash == changed.hash != coarse_design.hash
        reduced_model(coarse_design, settings=StructureSettings(bound_tolerance=1e-3))
        patch_arrays(coarse_design)
        assert reduced_model().design_hash == shipped_design.hash  # the default
    assert len(builds) == 5
    monkeypatch.setattr(model_cache, "modelling_hash", lambda: "another")
    reduced_model(coarse_design)
    assert len(builds) == 6


@pytest.mark.parametrize(
    ("kind", "make"), [("wing", reduced_model), ("fields", wing_fields), ("patches", patch_arrays)]
)
@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "missing"])
def test_damaged_entry_is_built_anew(builds, coarse_design, caplog, kind, make, damage: str) -> None:
    good, path = make(coarse_design).to_bytes(), entry(kind, coarse_design.hash, None)
    content = bytearray(path.read_bytes())
    if damage == "flipped":
        content[len(content) // 3] ^= 0x55
    path.write_bytes({"cut": content[: len(content) // 2], "flipped": content}.get(damage, b""))
    if damage == "missing":
        path.unlink()
    for _ in range(2):
        assert make(coarse_design).to_bytes() == good
    assert damage == "missing" or "built anew" in caplog.text
    assert len(builds) == 1 + (kind != "wing")  # the model alone is among the fields


def test_many_at_once_build_once_and_agree(builds: list[str], coarse_design: WingDesign) -> None:
    with ThreadPoolExecutor(6) as threads:
        results = list(threads.map(lambda _: reduced_model(coarse_design).to_bytes(), range(6)))
    assert len(set(results)) == len(builds) == 1


def test_failed_build_keeps_nothing_and_the_next_succeeds(
    builds, coarse_design, own_cache, monkeypatch
) -> None:
    def failing(*_: object) -> WingFields:
        raise KeyboardInterrupt

    with monkeypatch.context() as broken:
        broken.setattr(model_cache, "build_fields", failing)
        with pytest.raises(KeyboardInterrupt):
            reduced_model(coarse_design)
    assert {path.suffix for path in own_cache.iterdir()} == {".lock"}
    reduced_model(coarse_design)
    assert len(builds) == 1


def test_without_a_place_to_keep_it_the_model_is_still_given(
    builds, coarse_design, tmp_path, monkeypatch, caplog
) -> None:
    (tmp_path / "a file").write_text("not a folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "a file"))
    assert reduced_model(coarse_design).design_hash == coarse_design.hash
    assert "could not be kept" in caplog.text


def test_every_file_that_shapes_the_model_counts_for_the_key() -> None:
    code = "import sys, fe.reduction.patch_basis; print(*(n for n in sys.modules if n.startswith('fe.')))"
    words = [sys.executable, "-c", code]
    result = subprocess.run(words, capture_output=True, text=True, check=True, cwd=ROOT)
    rooms = {name.split(".")[1] for name in result.stdout.split()}
    assert rooms - {"designs", "sentences"} == set(MODELLING_ROOMS)


@pytest.mark.slow
@pytest.mark.long
def test_a_real_build_is_reproducible_in_any_number_of_threads(
    coarse_design, coarse_fields, own_cache
) -> None:
    with threadpool_limits(2):
        wing = wing_fields(coarse_design)
    assert wing.to_bytes() == coarse_fields.to_bytes()
    assert wing.model.to_bytes() == reduced_model(coarse_design).to_bytes()
    assert len(list(own_cache.glob("*.npz"))) == 2
