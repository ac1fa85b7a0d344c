"""A user's effects with `time` and the events of a campaign, from the files to the motion."""

import re
from pathlib import Path

import numpy as np
import pytest

from discrepancy.campaign.protocol import Event
from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.writing import write_campaign
from discrepancy.catalogue.effect_file import effects_of_file
from discrepancy.catalogue.entry import Setting
from discrepancy.errors import CampaignDataError, CampaignFileError, CatalogueError
from discrepancy.models.interface import Conditions
from discrepancy.models.sensing import observe
from tests.discrepancy.rigs import one_mass
from tests.refusals import Inputs

PAGE = Path(__file__).parents[3] / "docs" / "when.md"
TRIALS = Inputs(__file__).text("trials.toml")
EVENT = '{ name = "pump_on", trial = "pumping", time = 2.5, until = 8.0 }'
TOML = f"{TRIALS}event = [{EVENT}]\n"
MODEL = one_mass(free=True)
TIME = np.linspace(0.0, 10.0, 101)


def folder_of(path, toml=TOML):
    (path / "campaign.toml").write_text(toml, encoding="utf-8")
    for name in ("a.csv", "b.csv"):
        rows = "\n".join(f"{time:.1f},0.0" for time in TIME)
        (path / name).write_text(f"time,x\n{rows}\n", encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    return read_campaign(folder_of(tmp_path_factory.mktemp("pump")))


def example():
    page = PAGE.read_text(encoding="utf-8")
    (text,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    return str(text)


def effect_of(path, text):
    (path / "effect.toml").write_text(text, encoding="utf-8")
    (found,) = effects_of_file(path / "effect.toml")
    return found


def test_the_example_of_the_page_pulls_as_it_says(campaign, tmp_path):
    effect = effect_of(tmp_path, example())
    setting = Setting(campaign, MODEL, MODEL.scales(campaign))
    assert effect.unavailable(setting) is None
    patch = effect.patch(setting, {"slope": 0.4}, "slide")
    quiet, pumping = (
        observe(MODEL, campaign, trial, patch, Conditions(np.zeros(0))).values[:, 0]
        for trial in campaign.trials
    )
    np.testing.assert_array_equal(quiet, 0.0)
    # 2 x'' = 0.4 (t - 2.5) until 8 s, then it coasts
    since, after = np.clip(TIME - 2.5, 0.0, 5.5), np.maximum(TIME - 8.0, 0.0)
    expected = 0.2 * since**3 / 6.0 + 0.2 * 5.5**2 / 2.0 * after
    np.testing.assert_allclose(pumping, expected, atol=1e-6 * expected.max())


def test_an_effect_acts_from_a_parameter_after_an_event_on(campaign, tmp_path):
    text = example().replace('kind = "port_load"', 'kind = "channel_offset"').replace("port = ", "channel = ")
    text = text.replace(
        'force = "slope * max(0, time - pump_on)"', 'offset = "slope"\nbegin = "pump_on + slope"'
    )
    text = text.replace('places = "ports"', 'places = "channels"')
    effect = effect_of(tmp_path, text)
    setting = Setting(campaign, MODEL, MODEL.scales(campaign))
    patch = effect.patch(setting, {"slope": 0.75}, "x")
    shown = observe(MODEL, campaign, campaign.trials[1], patch, Conditions(np.zeros(0))).values[:, 0]
    np.testing.assert_array_equal(shown, np.where((TIME >= 3.25) & (TIME < 8.0), 0.75, 0.0))


def test_events_survive_the_files(campaign, tmp_path):
    assert campaign.events == (Event("pump_on", ("pumping",), time=2.5, until=8.0),)
    assert campaign.event_times("pumping") == {"pump_on": 2.5, "pump_on_until": 8.0}
    assert campaign.event_times("quiet") == {}
    assert read_campaign(write_campaign(campaign, tmp_path / "again")).events == campaign.events
    every = TOML.replace('trial = "pumping", time', "time")
    assert read_campaign(folder_of(tmp_path, every)).events[0].trials == ("quiet", "pumping")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('trial = "pumping", time', 'trial = "pomping", time', "not among the trials quiet, pumping"),
        ("until = 8.0", "until = 2.0", "begins at 2.5 s and must end later, but `until` is 2 s"),
        ("time = 2.5, until = 8.0", "time = 25.0", "record of the trial 'pumping' goes from 0 to 10 s"),
        ('"pump_on"', '"pump on"', "must be of letters, digits and underscores"),
        ('trial = "pumping", time', 'trial = "quiet", trials = ["quiet"], time', "give one of the two"),
        ("until = 8.0", 'until = 8.0 }, { name = "pump_on", time = 1.0', "moment 'pump_on' in"),
        *(('name = "pump_on"', f'name = "{name}"', "means something else in an expression: rename it")
          for name in ("time", "step", "max", "lambda")),
        (f"[{EVENT}]", EVENT, "several of 'event', so write [[event]] for each, not [event]"),
        ("until = 8.0", 'until = 8.0 }, { name = "pump_on_until", time = 1.0', "'pump_on_until' in"),
        ('trial = "pumping", time', "trials = [], time", "at least 1 entry is expected, but () came"),
    ],
)  # fmt: skip
def test_wrong_events_are_refused_in_one_sentence(tmp_path, old, new, words):
    assert old in TOML
    with pytest.raises((CampaignFileError, CampaignDataError), match=re.escape(words)) as caught:
        read_campaign(folder_of(tmp_path, TOML.replace(old, new)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("time - pump_on", "time - pump_off", "unknown name 'pump_off'"),
        ('acts_on = ["driven"]', 'acts_on = ["static"]', "asks for the time of trials, but"),
        ('events = ["pump_on"]', 'events = ["slope"]', "an event must not be called 'slope'"),
        ('name = "slope"', 'name = "time"', "a parameter must not be called 'time'"),
        ('kind = "port_load"', 'kind = "point_mass"', "unknown key"),
    ],
)  # fmt: skip
def test_wrong_effects_in_time_are_refused(tmp_path, old, new, words):
    with pytest.raises(CatalogueError, match=re.escape(words)):
        effect_of(tmp_path, example().replace(old, new))


def test_an_effect_without_its_event_says_why(tmp_path):
    without = read_campaign(folder_of(tmp_path, TRIALS))
    effect = effect_of(tmp_path, example())
    reason = effect.unavailable(Setting(without, MODEL, MODEL.scales(without)))
    assert reason == (
        "No trial to fit has pump_on and pump_on_until as [[event]]; those that are fitted have none."
    )
