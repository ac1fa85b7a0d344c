"""A model by its name or file."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from discrepancy.errors import ModelError
from discrepancy.model_choice import ModelKind, choose_model
from tests.discrepancy.rigs import MODEL


def test_models_by_name_and_file(tmp_path: Path) -> None:
    shipped = choose_model(MODEL)
    assert shipped.kind is ModelKind.LUMPED
    assert shipped.path is None
    text = (Path(__file__).parents[2] / "discrepancy" / "lumped_models" / f"{MODEL}.toml").read_text(
        encoding="utf-8"
    )
    file = tmp_path / "rig.toml"
    file.write_text(text, encoding="utf-8")
    own = choose_model(file)
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
def test_models_that_cannot_be_used(name: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "table.csv").write_text("a,b\n", encoding="utf-8")
    (tmp_path / "broken.toml").write_text("mass = [", encoding="utf-8")
    (tmp_path / "design.toml").write_text("name = 'half a wing'\n", encoding="utf-8")
    with pytest.raises(ModelError, match=message):
        choose_model(tmp_path / name if "." in name else name)


def test_a_structure_needs_no_cache(write_beam: Callable[..., Path], tmp_path: Path) -> None:
    (tmp_path / "no_folder").write_text("", encoding="utf-8")
    file = write_beam(tmp_path, {'set = "end", force': "point = [100, 10, 5], force"}, cells=2)
    program = (
        "import sys; from discrepancy.model_choice import choose_model; "
        "print(choose_model(sys.argv[1]).model.ports())"
    )
    found = subprocess.run(
        [sys.executable, "-c", program, str(file)],
        env=os.environ | {"XDG_CACHE_HOME": str(tmp_path / "no_folder")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.stdout.strip() == "('tip',)", found.stderr
