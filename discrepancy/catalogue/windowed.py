"""Effects of the catalogue that act only while an event of the campaign lasts: hypotheses beside the others.

The moments are those of the campaign, in held-out trials too; nothing of them is fitted.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

from discrepancy.campaign.records import TrialKind
from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.models.wrapped import follows_windows
from fe.runtime.patch import SENSORS, ModelPatch, Window

IN_TIME = frozenset((TrialKind.RINGDOWN, TrialKind.FORCED, TrialKind.DRIVEN))


def in_events(effects: Sequence[Effect], setting: Setting) -> tuple[Effect, ...]:
    """Return the effects as they act while each event lasts, in the trials that have it; none without events.

    Effects that cannot be switched, or whose law the model cannot switch, are left out.
    """
    fitted = {trial.name for trial in setting.campaign.fitted}
    events = [event for event in setting.campaign.events if fitted.intersection(event.trials)]
    names = dict.fromkeys(event.name for event in events)
    return tuple(
        _during(effect, name, setting) for name in names for effect in effects if _switches(effect, setting)
    )


def _switches(effect: Effect, setting: Setting) -> bool:
    """Whether an effect can act in windows of this model's trials."""
    places = effect.places(setting)
    if not places or not effect.acts_on & IN_TIME:
        return False
    sizes = {item.name: item.prior.value(0.5) for item in effect.parameters}
    patch = effect.patch(setting, sizes, places[0])
    if not len(patch) or patch.has_windows or not all(item.in_windows for item in patch):
        return False
    return follows_windows(setting.model) or all(isinstance(item, SENSORS) for item in patch)


def _during(effect: Effect, event: str, setting: Setting) -> Effect:
    """Return an effect as it acts while an event lasts."""
    windows = tuple(
        Window(trial, item.time, item.until)
        for item in setting.campaign.events
        if item.name == event
        for trial in item.trials
    )
    return replace(
        effect,
        identifier=f"{effect.identifier}_during_{event}",
        name=f"{effect.name} during {event}",
        acts_on=effect.acts_on & IN_TIME,
        build=partial(_build, effect, windows),
    )


def _build(
    effect: Effect, windows: tuple[Window, ...], setting: Setting, values: Mapping[str, float], place: str
) -> ModelPatch:
    patch = effect.build(setting, values, place)
    return ModelPatch(tuple(replace(item, windows=windows) for item in patch))
