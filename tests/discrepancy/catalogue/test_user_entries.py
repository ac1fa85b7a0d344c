"""Effects of a user: TOML files and entry points."""

import sys

import numpy as np
import pytest

from discrepancy.catalogue.library import effect_by_identifier, library, load_catalogue
from discrepancy.errors import CatalogueError
from discrepancy.models.interface import Conditions
from discrepancy.models.sensing import observe
from fe.runtime.patch import PointMass
from tests.refusals import Inputs

INPUTS = Inputs(__file__)
PYLON = INPUTS.text("pylon.toml")

BUFFER = INPUTS.text("buffer.toml")


@pytest.fixture
def write(tmp_path):
    def file(text):
        path = tmp_path / "mine.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return file


def test_a_file_with_one_effect(write, setting):
    catalogue = load_catalogue([write(PYLON)], installed=False)
    assert len(catalogue) == len(library()) + 1
    pylon = effect_by_identifier("store_pylon", catalogue)
    assert pylon.unavailable(setting) is None
    assert pylon.places(setting) == ("",)
    (mass,) = pylon.patch(setting, {"mass_ratio": 0.2})
    assert mass == PointMass(pytest.approx(0.02 * setting.scales.modal_mass), setting.scales.length / 2.0)
    trial = setting.campaign.trials[3]
    patch = pylon.patch(setting, {"mass_ratio": 0.2})
    seen = observe(setting.model, setting.campaign, trial, patch, Conditions(np.ones(1)))
    assert np.max(np.abs(seen.values - trial.values)) > 1e-4


def test_a_file_with_several_effects_places_and_a_family(write, setting):
    buffer, gauge = load_catalogue([write(BUFFER)], installed=False)[-2:]
    assert buffer.places(setting) == ("root", "tip", "span")
    spring, damper = buffer.patch(setting, {"share": 0.05}, "tip")
    port = setting.scales.ports["tip"]
    assert (spring.port, spring.exponent, spring.side) == ("tip", 2.0, 1)
    assert spring.coefficient == pytest.approx(0.05 * port.stiffness * port.displacement)
    assert damper.displacement_exponent == 0.0
    (free, _) = buffer.patch(setting, {"share": 0.05, "power": 3.5}, "tip")
    assert free.exponent == 3.5
    assert gauge.patch(setting, {"g": 0.8}).to_list() == [
        {"kind": "sensor_gain", "channel": "g0", "gain": 0.5, "quantity": ""}
    ]


def test_an_effect_whose_place_is_no_port(write, setting):
    text = BUFFER.replace('places = "ports"', 'places = ["flap"]')
    buffer = load_catalogue([write(text)], installed=False)[-2]
    with pytest.raises(CatalogueError, match="has no port 'flap'; it has root, tip, span"):
        buffer.patch(setting, {"share": 0.05}, "flap")


@pytest.mark.parametrize(("old", "new", "sentence"), INPUTS.refused("effect"))
def test_a_bad_entry_is_refused_with_one_sentence(write, old, new, sentence):
    assert old in PYLON
    with pytest.raises(CatalogueError) as caught:
        load_catalogue([write(PYLON.replace(old, new, 1))], installed=False)
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_effects_as_objects(tmp_path):
    with pytest.raises(CatalogueError, match="cannot be read"):
        load_catalogue([tmp_path / "none.toml"], installed=False)
    assert load_catalogue(library()[:0], installed=False) == library()
    with pytest.raises(CatalogueError, match="2 effects with the identifier"):
        load_catalogue(library()[:1], installed=False)


def test_an_installed_package_adds_effects(tmp_path, monkeypatch):
    """A package on the path with metadata of its own, as pip would leave it."""
    (tmp_path / "pylons.py").write_text(
        "from dataclasses import replace\n"
        "from discrepancy.catalogue.library import library\n"
        "def one():\n    return replace(library()[0], identifier='pylon')\n"
        "def two():\n    return [replace(library()[1], identifier=name) for name in ('hinge', 'bolt')]\n"
        "def wrong():\n    return [3]\n"
        "def broken():\n    raise RuntimeError('no licence')\n",
        encoding="utf-8",
    )
    info = tmp_path / "pylons-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: pylons\nVersion: 1.0\n", encoding="utf-8")
    points = info / "entry_points.txt"
    points.write_text("[uav_twin.effects]\none = pylons:one\ntwo = pylons:two\n", encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "pylons", raising=False)
    names = [effect.identifier for effect in load_catalogue()]
    assert names[-3:] == ["pylon", "hinge", "bolt"]
    for name, sentence in (
        ("wrong", "returned a int"),
        ("broken", "failed: RuntimeError: no licence"),
        ("absent", "failed: AttributeError"),
    ):
        points.write_text(f"[uav_twin.effects]\n{name} = pylons:{name}\n", encoding="utf-8")
        with pytest.raises(CatalogueError, match=f"entry point '{name}' .*{sentence}"):
            load_catalogue()
    sys.modules.pop("pylons", None)


def test_values_that_no_primitive_can_have(write, setting):
    text = BUFFER.replace('side = "2 - 1"', 'side = "0.5 * power"')
    buffer = load_catalogue([write(text)], installed=False)[-2]
    assert next(iter(buffer.patch(setting, {"share": 0.05}, "tip"))).side == 1
    with pytest.raises(CatalogueError, match="side must be a number"):
        buffer.patch(setting, {"share": 0.05, "power": 2.5}, "tip")
