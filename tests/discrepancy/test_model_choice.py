"""Files that hold nonsense, and models by name or file: one sentence that names file and key."""

import shutil

import pytest

from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.effect_file import effects_of_file
from discrepancy.errors import DiscrepancyError, ModelError
from discrepancy.model_choice import ModelKind, choose_model
from discrepancy.models.fmu_file import FmuModelDescription
from discrepancy.models.lumped_file import SHIPPED_MODELS, LumpedDescription
from tests.discrepancy.rigs import MODEL


def test_models_by_name_and_file(tmp_path):
    shipped = choose_model(MODEL)
    assert shipped.kind is ModelKind.LUMPED
    assert shipped.path is None
    own = choose_model(shutil.copy(SHIPPED_MODELS / f"{MODEL}.toml", tmp_path / "rig.toml"))
    assert own.source_hash == shipped.source_hash
    assert own.label == "rig.toml"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("no_such_rig", "three_mass_chain"),
        ("missing.toml", "no model file"),
        ("missing.nc", "no model file"),
        ("wing.fmu", "is an FMU"),
        ("table.csv", "is no model"),
        ("broken.toml", "not valid TOML"),
        ("design.toml", "design"),
    ],
)
def test_models_that_cannot_be_used(name, message, tmp_path):
    (tmp_path / "table.csv").write_text("a,b\n", encoding="utf-8")
    (tmp_path / "broken.toml").write_text("mass = [", encoding="utf-8")
    (tmp_path / "design.toml").write_text("name = 'half a wing'\n", encoding="utf-8")
    with pytest.raises(ModelError, match=message):
        choose_model(tmp_path / name if "." in name else name)


def test_a_structure_needs_no_cache(write_beam, tmp_path, monkeypatch):
    (tmp_path / "no_folder").write_text("", encoding="utf-8")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "no_folder"))
    file = write_beam(tmp_path, {'set = "end", force': "point = [100, 10, 5], force"}, cells=2)
    assert choose_model(file).model.ports == ("tip",)


# ---------------------------------------------------------------- tOML files that hold nonsense


@pytest.mark.parametrize(
    "read",
    [
        lambda path: read_campaign(path.parent),
        LumpedDescription.read,
        FmuModelDescription.read,
        effects_of_file,
    ],
)
@pytest.mark.parametrize("depth", [40, 3000])
def test_what_is_nested_too_deeply_is_refused(tmp_path, read, depth):
    path = tmp_path / "campaign.toml"
    path.write_text(f"format = 1\nkind = {'[' * depth}1{']' * depth}\n", encoding="utf-8")
    with pytest.raises(DiscrepancyError, match=r"campaign.toml is nested deeper than 32"):
        read(path)
