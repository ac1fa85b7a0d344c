"""Models by name or file; what is no model is refused in `tests/uav_twin`."""

import shutil

from discrepancy.model_choice import ModelKind, choose_model
from discrepancy.models.lumped_file import SHIPPED_MODELS
from tests.discrepancy.rigs import MODEL


def test_models_by_name_and_file(tmp_path):
    shipped = choose_model(MODEL)
    assert shipped.kind is ModelKind.LUMPED
    assert shipped.path is None
    own = choose_model(shutil.copy(SHIPPED_MODELS / f"{MODEL}.toml", tmp_path / "rig.toml"))
    assert own.source_hash == shipped.source_hash
    assert own.label == "rig.toml"


def test_a_structure_needs_no_cache(write_beam, tmp_path, monkeypatch):
    (tmp_path / "no_folder").write_text("", encoding="utf-8")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "no_folder"))
    file = write_beam(tmp_path, {'set = "end", force': "point = [100, 10, 5], force"}, cells=2)
    assert choose_model(file).model.ports == ("tip",)
