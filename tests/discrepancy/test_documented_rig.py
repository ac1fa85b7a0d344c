"""The rigs of the notebook and of the page of the cart are made, read and understood as these say."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import library
from discrepancy.judgement.when import look_alike_remark
from discrepancy.models.lumped import LumpedModel
from discrepancy.verdict import NamedEffect, Verdict, VerdictKind
from discrepancy.workflow import checked, investigate, without_port
from fe.runtime.patch import ModelPatch

DOCS = Path(__file__).parents[2] / "docs"
DRIVEN_RIVALS = ("coulomb_friction", "quadratic_damping", "load_cell")
RIVALS = ("coulomb_friction", "structural_damping", "quadratic_damping", "clock_error")


def write_rig(text, folder, campaign_folder):
    """Write what a page gives into a folder and run its script; return the folder."""
    (folder / campaign_folder).mkdir()
    (script,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    campaign, model = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    (folder / "make_tables.py").write_text(script, encoding="utf-8")
    (folder / campaign_folder / "campaign.toml").write_text(campaign, encoding="utf-8")
    (folder / "model.toml").write_text(model, encoding="utf-8")
    subprocess.run([sys.executable, "make_tables.py"], cwd=folder, check=True)
    return folder


def write_notebook_rig(text, folder):
    """Make the tables of the notebook and write its files into a folder, which is returned."""
    tables, *cells = re.findall(r"```{code-cell} python\n(.*?)```", text, re.DOTALL)
    (folder / "make_tables.py").write_text(tables, encoding="utf-8")
    subprocess.run([sys.executable, "make_tables.py"], cwd=folder, check=True)
    for cell in cells:
        first, _, rest = cell.partition("\n")
        if first.startswith("%%writefile "):
            (folder / first.split()[1]).write_text(rest, encoding="utf-8")
    return folder


def check_tables(text, folder, names):
    """Compare the beginnings of tables with those that a page shows side by side."""
    shown = re.search(
        rf"{' +'.join(f'{folder.name}/{name}.csv' for name in names)}\n(.*?)```", text, re.DOTALL
    )
    assert shown
    columns = zip(*(line.split() for line in shown.group(1).splitlines()), strict=True)
    for name, lines in zip(names, columns, strict=True):
        made = (folder / f"{name}.csv").read_text(encoding="utf-8").splitlines()
        assert tuple(made[: len(lines)]) == lines


def check_force(text, verdict):
    """Compare the force of the only effect with the one that a page shows."""
    shown = re.search(r"force ([\d.]+) N \(([\d.]+) to ([\d.]+)\)", text)
    assert shown
    value, low, high = (float(number) for number in shown.groups())
    (law,) = verdict.effects[0].patch
    assert law.coefficient == pytest.approx(value, abs=0.2 * (high - low))


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """A folder with what the notebook gives, its tables made."""
    text = (DOCS / "tutorials" / "name_an_effect.md").read_text(encoding="utf-8")
    return write_notebook_rig(text, tmp_path_factory.mktemp("rig"))


def test_without_a_port_friction_cannot_be_tested_and_that_is_said(rig):
    with_port = (rig / "model.toml").read_text(encoding="utf-8")
    (rig / "no_port.toml").write_text(with_port[: with_port.index("[[port]]")], encoding="utf-8")
    model = LumpedModel.load(rig / "no_port.toml")
    campaign, faults = checked(read_campaign(rig / "my_rig"), model)
    assert faults == ()
    (remark,) = without_port(Setting(campaign, model, model.scales(campaign)), library())
    assert remark.startswith("Not tested for lack of a port: Coulomb friction, ")
    assert "declare a [[port]] in the model's file, such as vector = [1]" in remark


def test_with_the_port_look_alikes_are_remarked_on(rig):
    model = LumpedModel.load(rig / "model.toml")
    campaign, _ = checked(read_campaign(rig / "my_rig"), model)
    setting = Setting(campaign, model, model.scales(campaign))
    able = [effect for effect in library() if effect.unavailable(setting) is None]
    (friction,) = (effect for effect in able if effect.identifier == "coulomb_friction")
    named = NamedEffect(friction.identifier, friction.name, "slide", friction.family, (), (), ModelPatch())
    remark = look_alike_remark(Verdict(VerdictKind.NAMED, "-", 1.0, 1.0, effects=(named,)), able)
    assert "acts on these trials as Coulomb friction does" in remark
    assert "bouc_wen_hysteresis, free_play, joint_micro_slip, structural_damping were compared" in remark


def test_with_the_port_friction_is_named_in_the_size_that_was_hidden(rig):
    effects = tuple(effect for effect in library() if effect.identifier in RIVALS)
    model = LumpedModel.load(rig / "model.toml")
    found = investigate(read_campaign(rig / "my_rig"), model, effects, thorough=False)
    assert found.verdict.kind is VerdictKind.NAMED
    (effect,) = found.verdict.effects
    assert (effect.identifier, effect.place) == ("coulomb_friction", "slide")
    (law,) = effect.patch
    # The corner of the script's friction is rounded off, that of the law is not.
    assert law.coefficient == pytest.approx(0.16, rel=3e-3)


@pytest.fixture(scope="module")
def cart_text():
    return (DOCS / "cart_in_ten_minutes.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def cart(cart_text, tmp_path_factory):
    return write_rig(cart_text, tmp_path_factory.mktemp("cart"), "my_cart")


def test_the_tables_of_the_cart_begin_as_they_are_shown_and_jitter(cart_text, cart):
    check_tables(cart_text, cart / "my_cart", ("rest", "ride_1"))
    for trial in read_campaign(cart / "my_cart").trials:
        steps = np.diff(trial.time)
        assert 0.015 < np.std(steps) / np.mean(steps) / np.sqrt(2.0) < 0.025


def test_friction_of_the_cart_is_named_in_the_size_shown_and_not_the_offset(cart_text, cart):
    effects = tuple(effect for effect in library() if effect.identifier in DRIVEN_RIVALS)
    found = investigate(
        read_campaign(cart / "my_cart"), LumpedModel.load(cart / "model.toml"), effects, thorough=False
    )
    assert found.verdict.kind is VerdictKind.NAMED
    assert [(effect.identifier, effect.place) for effect in found.verdict.effects] == [
        ("coulomb_friction", "rail")
    ]
    check_force(cart_text, found.verdict)
