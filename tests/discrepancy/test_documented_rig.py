"""The rigs of the notebook and of the page of the cart are made, read and understood as these say."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from discrepancy.campaign.reading import read_campaign
from discrepancy.models.lumped import LumpedModel
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import investigate
from tests.discrepancy.rigs import chosen


def named(folder, campaign, *rivals):
    """Return the law of the only effect that is named with its rivals, and its place."""
    model = LumpedModel.load(folder / "model.toml")
    found = investigate(read_campaign(folder / campaign), model, chosen(*rivals), thorough=False)
    assert found.verdict.kind is VerdictKind.NAMED
    (effect,) = found.verdict.effects
    (law,) = effect.patch
    return effect.identifier, effect.place, law.coefficient


DOCS = Path(__file__).parents[2] / "docs"
DRIVEN_RIVALS = ("coulomb_friction", "quadratic_damping", "load_cell")
RIVALS = ("coulomb_friction", "structural_damping", "quadratic_damping", "clock_error")


def write_rig(page, folder, campaign):
    """Write what a page gives into a folder and run its script; return its text."""
    text = (DOCS / page).read_text(encoding="utf-8")
    script, *cells = re.findall(r"```(?:{code-cell} )?python\n(.*?)```", text, re.DOTALL)
    written = [cell.removeprefix("%%writefile ").split("\n", 1) for cell in cells if cell.startswith("%%w")]
    if not cells:  # no notebook, whose script makes the folder
        (folder / campaign).mkdir()
        names = f"{campaign}/campaign.toml", "model.toml"
        written = zip(names, re.findall(r"```toml\n(.*?)```", text, re.DOTALL), strict=True)
    (folder / "make_tables.py").write_text(script, encoding="utf-8")
    subprocess.run([sys.executable, "make_tables.py"], cwd=folder, check=True)
    for name, content in written:
        (folder / name).write_text(content, encoding="utf-8")
    return text


def test_with_the_port_friction_is_named_in_the_size_that_was_hidden(tmp_path):
    """What the notebook gives, its tables made."""
    write_rig("tutorials/name_an_effect.md", tmp_path, "my_rig")
    found = named(tmp_path, "my_rig", *RIVALS)
    # The corner of the script's friction is rounded off, that of the law is not.
    assert found == ("coulomb_friction", "slide", pytest.approx(0.16, rel=3e-3))


def test_friction_of_the_cart_is_named_in_the_size_shown_and_not_the_offset(tmp_path):
    """Its tables begin as they are shown side by side, and jitter."""
    folder, text = tmp_path, write_rig("cart_in_ten_minutes.md", tmp_path, "my_cart")
    shown = re.search(r"my_cart/rest.csv +my_cart/ride_1.csv\n(.*?)```", text, re.DOTALL)
    columns = zip(*(line.split() for line in shown.group(1).splitlines()), strict=True)
    for name, lines in zip(("rest", "ride_1"), columns, strict=True):
        made = (folder / "my_cart" / f"{name}.csv").read_text(encoding="utf-8").splitlines()
        assert tuple(made[: len(lines)]) == lines
    for trial in read_campaign(folder / "my_cart").trials:
        steps = np.diff(trial.time)
        assert 0.015 < np.std(steps) / np.mean(steps) / np.sqrt(2.0) < 0.025
    told = re.search(r"force ([\d.]+) N \(([\d.]+) to ([\d.]+)\)", text)
    value, low, high = (float(number) for number in told.groups())
    found = named(folder, "my_cart", *DRIVEN_RIVALS)
    assert found == ("coulomb_friction", "rail", pytest.approx(value, abs=0.2 * (high - low)))
