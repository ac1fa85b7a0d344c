"""Effects of a user: TOML files, entry points, `time` and the events of a campaign."""

import math
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from discrepancy.campaign.protocol import Event
from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.writing import write_campaign
from discrepancy.catalogue.effect_file import effects_of_file
from discrepancy.catalogue.library import effect_by_identifier, library, load_catalogue, variants_in_events
from discrepancy.errors import CatalogueError
from discrepancy.system.response import Conditions
from discrepancy.system.sensing import observe
from fe.runtime.patch import PointMass
from tests.discrepancy.rigs import campaign_folder, one_mass, setting_of
from tests.refusals import Inputs, refused

INPUTS = Inputs(__file__)
PYLON, BUFFER = INPUTS.text("pylon.toml"), INPUTS.text("buffer.toml")
(PUMP_PULL,) = re.findall(
    r"```toml\n(.*?)```",
    (Path(__file__).parents[3] / "docs" / "explanation" / "when.md").read_text("utf-8"),
    re.DOTALL,
)


@pytest.fixture
def write(tmp_path):
    def file(text):
        path = tmp_path / "mine.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return file


def test_what_cannot_be_built_says_once_where(setting):
    effect = effect_by_identifier("coulomb_friction", library())
    with pytest.raises(CatalogueError, match="is not a finite number") as caught:
        effect.patch(setting, {"friction_ratio": math.nan}, setting.model.ports[0])
    assert str(caught.value).count("primitives 1") == 1


def test_a_file_with_one_effect_adds_it_to_the_catalogue(write, setting):
    catalogue = load_catalogue([write(PYLON)], installed=False)
    pylon = effect_by_identifier("store_pylon", catalogue)
    (mass,) = pylon.patch(setting, {"mass_ratio": 0.2})
    assert len(catalogue) == len(library()) + 1
    assert (pylon.unavailable(setting), pylon.places(setting)) == (None, ("",))
    assert mass == PointMass(pytest.approx(0.02 * setting.scales.modal_mass), setting.scales.length / 2.0)


@pytest.fixture
def family(write):
    """The two effects of a file: a buffer at ports, and a gauge."""
    return load_catalogue([write(BUFFER)], installed=False)[-2:]


def test_an_effect_of_a_file_is_built_at_a_port(family, setting):
    buffer, _ = family
    spring, damper = buffer.patch(setting, {"share": 0.05}, "tip")
    port = setting.scales.ports["tip"]
    assert (spring.port, spring.exponent, spring.side) == ("tip", 2.0, 1)
    assert spring.coefficient == pytest.approx(0.05 * port.stiffness * port.displacement)
    assert damper.displacement_exponent == 0.0


def test_an_effect_of_a_file_has_places_and_a_free_shape(family, setting):
    buffer, _ = family
    (spring, _) = buffer.patch(setting, {"share": 0.05, "power": 3.5}, "tip")
    assert buffer.places(setting) == ("root", "tip", "span")
    assert spring.exponent == 3.5


def test_a_second_effect_of_a_file_is_built(family, setting):
    _, gauge = family
    gain = {"kind": "sensor_gain", "channel": "g0", "gain": 0.5, "quantity": ""}
    assert gauge.patch(setting, {"g": 0.8}).to_list() == [gain]


NO_PORT = ('places = "ports"', 'places = ["flap"]')
NO_SIDE = ('side = "2 - 1"', 'side = "0.5 * power"')


@pytest.mark.parametrize(
    ("change", "place", "sentence"),
    [
        (NO_PORT, "flap", "has no port 'flap'; it has root, tip, span"),
        (NO_SIDE, "tip", "side must be a number"),
    ],
    ids=["a place that is not a port", "a value that no primitive can have"],
)
def test_an_effect_that_cannot_be_built_is_refused(write, setting, change, place, sentence):
    buffer = load_catalogue([write(BUFFER.replace(*change))], installed=False)[-2]
    with pytest.raises(CatalogueError, match=sentence):
        buffer.patch(setting, {"share": 0.05, "power": 2.5}, place)


def test_a_value_that_is_possible_at_the_canonical_shape_alone_is_built_there(write, setting):
    buffer = load_catalogue([write(BUFFER.replace(*NO_SIDE))], installed=False)[-2]
    assert next(iter(buffer.patch(setting, {"share": 0.05}, "tip"))).side == 1


@pytest.mark.parametrize(
    ("good", "old", "new", "sentence"),
    [
        (good, *row)
        for good, table in ((PYLON, "effect"), (PUMP_PULL, "in_time"))
        for row in INPUTS.refused(table)
    ],
)
def test_a_bad_entry_is_refused_with_one_sentence(write, good, old, new, sentence):
    assert old in good
    with refused(CatalogueError, re.escape(sentence)):
        load_catalogue([write(good.replace(old, new, 1))], installed=False)


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


# ---------------------------------------------------------------- time and events

MODEL, TIME = one_mass(free=True), np.linspace(0.0, 10.0, 101)


@pytest.fixture(scope="module")
def pump(tmp_path_factory):
    return read_campaign(campaign_folder(tmp_path_factory.mktemp("pump"), "pump"))


def test_the_example_of_the_page_pulls_as_it_says(pump, write):
    """And says why it is not offered without its event."""
    (effect,) = effects_of_file(write(PUMP_PULL))
    setting = setting_of(pump, MODEL)
    assert effect.unavailable(setting) is None
    patch = effect.patch(setting, {"slope": 0.4}, "slide")
    quiet, pumping = (
        observe(MODEL, pump, trial, patch, Conditions(np.zeros(0))).values[:, 0] for trial in pump.trials
    )
    np.testing.assert_array_equal(quiet, 0.0)
    # 2 x'' = 0.4 (t - 2.5) until 8 s, then it coasts
    since, after = np.clip(TIME - 2.5, 0.0, 5.5), np.maximum(TIME - 8.0, 0.0)
    expected = 0.2 * since**3 / 6.0 + 0.2 * 5.5**2 / 2.0 * after
    np.testing.assert_allclose(pumping, expected, atol=1e-6 * expected.max())
    without = replace(pump, events=())
    assert effect.unavailable(setting_of(without, MODEL)) == (
        "No trial to fit has pump_on and pump_on_until as [[event]]; those that are fitted have none."
    )


def test_an_effect_acts_from_a_parameter_after_an_event_on(pump, write):
    text = PUMP_PULL.replace('kind = "port_load"', 'kind = "channel_offset"').replace("port = ", "channel = ")
    text = text.replace(
        'force = "slope * max(0, time - pump_on)"', 'offset = "slope"\nbegin = "pump_on + slope"'
    )
    (effect,) = effects_of_file(write(text.replace('places = "ports"', 'places = "channels"')))
    patch = effect.patch(setting_of(pump, MODEL), {"slope": 0.75}, "x")
    shown = observe(MODEL, pump, pump.trials[1], patch, Conditions(np.zeros(0))).values[:, 0]
    np.testing.assert_array_equal(shown, np.where((TIME >= 3.25) & (TIME < 8.0), 0.75, 0.0))


def test_events_survive_the_files(pump, tmp_path):
    assert pump.events == (Event("pump_on", ("pumping",), time=2.5, until=8.0),)
    assert read_campaign(write_campaign(pump, tmp_path / "again")).events == pump.events


def test_an_event_has_its_moments_in_its_trial_alone(pump):
    assert pump.event_times("pumping", ["pump_on"]) == [{"pump_on": 2.5, "pump_on_until": 8.0}]
    assert pump.event_times("quiet", ["pump_on"]) == []


def test_an_event_without_a_trial_is_of_all_trials(tmp_path):
    of_all = ("campaign.toml", 'trial = "pumping", time', "time")
    (event,) = read_campaign(campaign_folder(tmp_path / "a", "pump", of_all)).events
    assert event.trials == ("quiet", "pumping")


TWICE = (
    Event("pump_on", ("pumping",), time=1.0, until=3.0),
    Event("pump_on", ("pumping",), time=6.0, until=8.0),
)


def test_an_event_may_happen_several_times_in_a_trial(tmp_path):
    again = 'until = 8.0 }, { name = "pump_on", trial = "pumping", time = 9.0'
    campaign = read_campaign(campaign_folder(tmp_path, "pump", ("campaign.toml", "until = 8.0", again)))
    assert [event.time for event in campaign.events] == [2.5, 9.0]


def test_a_pull_of_ones_own_acts_anew_each_time_that_its_event_happens(pump, write):
    (effect,) = effects_of_file(write(PUMP_PULL))
    campaign = replace(pump, events=TWICE)
    patch = effect.patch(setting_of(campaign, MODEL), {"slope": 0.4}, "slide")
    moved = observe(MODEL, campaign, campaign.trials[1], patch, Conditions(np.zeros(0))).values[:, 0]
    expected = np.zeros_like(TIME)
    for event in TWICE:  # 2 x'' = 0.4 (t - begin) until the end, then it coasts
        since, after = np.clip(TIME - event.time, 0.0, 2.0), np.maximum(TIME - event.until, 0.0)
        expected += 0.2 * since**3 / 6.0 + 0.2 * 2.0**2 / 2.0 * after
    np.testing.assert_allclose(moved, expected, atol=1e-6 * expected.max())


def test_an_effect_during_an_event_acts_in_all_of_its_intervals(pump, write):
    text = PUMP_PULL.replace('kind = "port_load"', 'kind = "channel_offset"').replace("port = ", "channel = ")
    text = text.replace('events = ["pump_on"]', "").replace('places = "ports"', 'places = "channels"')
    text = re.sub("force = .*\n(begin|end) = .*\n((begin|end) = .*\n)?", 'offset = "slope"\n', text)
    campaign = replace(pump, events=TWICE)
    (during,) = variants_in_events(effects_of_file(write(text)), setting_of(campaign, MODEL))
    patch = during.patch(setting_of(campaign, MODEL), {"slope": 0.75}, "x")
    shown = observe(MODEL, campaign, campaign.trials[1], patch, Conditions(np.zeros(0))).values[:, 0]
    is_on = ((TIME >= 1.0) & (TIME < 3.0)) | ((TIME >= 6.0) & (TIME < 8.0))
    np.testing.assert_array_equal(shown, np.where(is_on, 0.75, 0.0))
