"""The rig of docs/rig_in_ten_minutes.md is made, read and understood as the page says."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import library
from discrepancy.judgement.look_alikes import look_alike_remark
from discrepancy.models.lumped import LumpedModel
from discrepancy.verdict import NamedEffect, Verdict, VerdictKind
from discrepancy.workflow import checked, investigate, without_port
from fe.runtime.patch import ModelPatch

PAGE = Path(__file__).parents[2] / "docs" / "rig_in_ten_minutes.md"
RIVALS = ("coulomb_friction", "structural_damping", "quadratic_damping", "clock_error")


@pytest.fixture(scope="module")
def text() -> str:
    return PAGE.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def rig(text: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the page gives, its script run."""
    folder = tmp_path_factory.mktemp("rig")
    (folder / "my_rig").mkdir()
    (script,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    campaign, model, port = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    (folder / "make_tables.py").write_text(script, encoding="utf-8")
    (folder / "my_rig" / "campaign.toml").write_text(campaign, encoding="utf-8")
    (folder / "model.toml").write_text(model, encoding="utf-8")
    (folder / "with_port.toml").write_text(f"{model}\n{port}", encoding="utf-8")
    subprocess.run([sys.executable, "make_tables.py"], cwd=folder, check=True)
    return folder


def test_the_tables_begin_as_they_are_shown(text: str, rig: Path) -> None:
    shown = re.search(r"my_rig/rest.csv +my_rig/weights.csv +my_rig/release_1.csv\n(.*?)```", text, re.DOTALL)
    assert shown
    columns = zip(*(line.split() for line in shown.group(1).splitlines()), strict=True)
    for name, lines in zip(("rest", "weights", "release_1"), columns, strict=True):
        made = (rig / "my_rig" / f"{name}.csv").read_text(encoding="utf-8").splitlines()
        assert tuple(made[: len(lines)]) == lines


def test_without_a_port_the_remark_is_the_one_shown(text: str, rig: Path) -> None:
    model = LumpedModel.load(rig / "model.toml")
    campaign, faults = checked(read_campaign(rig / "my_rig"), model)
    assert faults == ()
    (remark,) = without_port(Setting(campaign, model, model.scales(campaign)), library())
    assert f"Note: {remark}" in text


def test_with_the_port_the_remark_on_look_alikes_is_the_one_shown(text: str, rig: Path) -> None:
    model = LumpedModel.load(rig / "with_port.toml")
    campaign, _ = checked(read_campaign(rig / "my_rig"), model)
    setting = Setting(campaign, model, model.scales(campaign))
    able = [effect for effect in library() if effect.unavailable(setting) is None]
    (friction,) = (effect for effect in able if effect.identifier == "coulomb_friction")
    named = NamedEffect(friction.identifier, friction.name, "slide", friction.family, (), (), ModelPatch())
    remark = look_alike_remark(Verdict(VerdictKind.NAMED, "-", 1.0, 1.0, effects=(named,)), able)
    assert f"Note: {remark}" in text


def test_with_the_port_friction_is_named_in_the_size_shown(text: str, rig: Path) -> None:
    effects = tuple(effect for effect in library() if effect.identifier in RIVALS)
    model = LumpedModel.load(rig / "with_port.toml")
    found = investigate(read_campaign(rig / "my_rig"), model, effects, thorough=False)
    assert found.verdict.kind is VerdictKind.NAMED
    assert [(effect.identifier, effect.place) for effect in found.verdict.effects] == [
        ("coulomb_friction", "slide")
    ]
    shown = re.search(r"force ([\d.]+) N \(([\d.]+) to ([\d.]+)\)", text)
    assert shown
    value, low, high = (float(number) for number in shown.groups())
    (law,) = found.verdict.effects[0].patch
    assert law.coefficient == pytest.approx(value, abs=0.2 * (high - low))  # type: ignore[attr-defined]
