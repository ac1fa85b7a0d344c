"""Texts on what a campaign can decide: visible effects, and effects that look alike."""

from collections.abc import Collection, Sequence
from math import isfinite

import numpy as np

from discrepancy.campaign.records import Campaign, TrialKind
from discrepancy.catalogue.entry import Effect
from discrepancy.judgement.separability import (
    CONFUSION_DISTANCE,
    DETECTION_DISTANCE,
    Detectability,
    Separability,
)
from discrepancy.report.text import number, unit_text
from reporting.words import listing

WORDS_OF_KINDS = {
    TrialKind.STATIC: "a static loading",
    TrialKind.RINGDOWN: "a ring-down",
    TrialKind.FORCED: "a forced vibration",
    TrialKind.DRIVEN: "a driven test",
    TrialKind.FLIGHT: "a flight",
}


def detectability_texts(detectability: Detectability) -> tuple[str, str, str]:
    """Return the texts on the detectability of an effect, for a row of a table.

    Returns
    -------
    visible : str
        Whether the effect is detectable at its prior median.
    least_size : str
        The least detectable size, with unit.
    median : str
        The prior median of its size, with unit; empty for an effect without a size.
    """
    is_visible = detectability.distance >= DETECTION_DISTANCE
    visible = "yes" if is_visible else "larger than usual only"
    if not detectability.parameter:
        return visible, "at once" if is_visible else "not at its prior median", ""
    unit = unit_text(detectability.unit)
    least_size = f"{number(detectability.detectable, 2)} {unit}".rstrip()
    median = f"{number(detectability.typical, 2)} {unit}".rstrip()
    if not isfinite(detectability.detectable):
        return "not visible", "never", median
    return visible, least_size, median


def confused_effects(separability: Separability, name: str) -> list[str]:
    """Return the effects that these data cannot distinguish from one, in either direction."""
    if name not in separability.identifiers:
        return []
    index = separability.identifiers.index(name)
    distance = np.minimum(separability.distance[index], separability.distance[:, index])
    is_confusable = distance < CONFUSION_DISTANCE
    return [
        other
        for other_index, other in enumerate(separability.identifiers)
        if is_confusable[other_index] and other_index != index
    ]


def group_lines(separability: Separability, hint: str = "the table says to which") -> list[str]:
    """Return the sentences on which effects a campaign cannot tell apart.

    There is one sentence for each group of effects that look alike. If there is no group, a single
    sentence says that all effects can be told apart, or that no effect would change the readings.

    Parameters
    ----------
    separability : Separability
        What the campaign can distinguish.
    hint : str
        Phrase that says where the report lists which members of a larger group look alike.
    """
    detectable = [
        detectability
        for detectability in separability.detectability
        if not detectability.reason and isfinite(detectability.detectable)
    ]
    shows_any = any(
        detectability.parameter and detectability.distance > 0.0 for detectability in detectable
    )
    if not separability.identifiers or not shows_any:
        return [
            "These trials show none of the effects that can be tested: the model predicts no "
            "motion in them. State how each trial begins and what drives it."
        ]
    if not separability.groups:
        return [
            "Every effect that can be tested here can be distinguished from every other one at its "
            "prior median."
        ]
    lines = []
    for group in separability.groups:
        names = [name.replace("_", " ") for name in group]
        if len(names) == 2:
            lines.append(f"These data cannot tell {names[0]} from {names[1]}.")
        else:
            lines.append(
                f"Confusion group, each close to at least one other ({hint}): {listing(names)}."
            )
    return lines


def campaign_needs(
    separability: Separability,
    campaign: Campaign,
    effects: Sequence[Effect],
    possible_kinds: Collection[TrialKind],
) -> list[str]:
    """Return sentences on what the campaign would need to decide more.

    Parameters
    ----------
    separability : Separability
        What the campaign can distinguish.
    campaign : Campaign
        The campaign.
    effects : sequence of Effect
        The catalogue.
    possible_kinds : collection of TrialKind
        Kinds of trials that the model follows.
    """
    effects_by_identifier = {effect.identifier: effect for effect in effects}
    missing_kinds = set(possible_kinds) - {trial.kind for trial in campaign.trials}
    sentences = []
    for group in separability.groups:
        kinds_of_effects = [
            effects_by_identifier[name].acts_on for name in group if name in effects_by_identifier
        ]
        sentences.append(_sentence_on_group(group, kinds_of_effects, missing_kinds))
    sentences += _sentences_on_hidden_effects(separability)
    without_noise = [name for name, channel in campaign.channels.items() if channel.noise is None]
    if without_noise:
        sentences.append(
            f"Give a noise record for {', '.join(without_noise)} (samples at rest, or a standard "
            "deviation with its degrees of freedom): without it the absolute gate cannot be "
            "applied, and the sizes above assume a thousandth of the range as its noise."
        )
    if not campaign.held_out:
        sentences.append(
            "Hold out a trial, or measure one more at another level: without it nothing can be "
            "proved."
        )
    return sentences


def _sentence_on_group(
    group: Sequence[str],
    kinds_of_effects: Sequence[frozenset[TrialKind]],
    missing_kinds: Collection[TrialKind],
) -> str:
    """Return the sentence that says how to distinguish the effects of a group.

    It names kinds of trials that some of the effects change and others do not. If there are none,
    it asks for other loads.

    Parameters
    ----------
    group : sequence of str
        Identifiers of the effects.
    kinds_of_effects : sequence of frozenset of TrialKind
        Kinds of trials that each effect changes.
    missing_kinds : collection of TrialKind
        Kinds that are possible and not in the campaign.
    """
    changed_by_some: frozenset[TrialKind] = frozenset().union(*kinds_of_effects)
    changed_by_all = frozenset(TrialKind).intersection(*kinds_of_effects)
    distinguishing = changed_by_some - changed_by_all
    kinds = [kind for kind in TrialKind if kind in distinguishing and kind in missing_kinds]
    names = listing(name.replace("_", " ") for name in group)
    if not kinds:
        return (
            f"To tell {names} apart, vary what was kept constant: another amplitude, sign or place "
            "of the load, a known added mass, another temperature, strain beside displacement."
        )
    texts_of_kinds = " or ".join(WORDS_OF_KINDS[kind] for kind in kinds)
    return f"To tell {names} apart, add {texts_of_kinds}: some of them act there and others do not."


def _sentences_on_hidden_effects(separability: Separability) -> list[str]:
    """Return the sentences on effects that these data would not show at their prior median.

    One sentence is on the effects that less noise would show; the others are on effects that
    unknowns can imitate within their stated deviations.
    """
    hidden = [
        detectability
        for detectability in separability.detectability
        if not detectability.reason
        and detectability.parameter
        and isfinite(detectability.detectable)
        and detectability.distance < DETECTION_DISTANCE
    ]
    hidden_by_noise = [row for row in hidden if isfinite(row.noise_factor)]
    hidden_by_unknowns = [row for row in hidden if not isfinite(row.noise_factor)]
    return [
        *_sentence_on_noise(hidden_by_noise),
        *_sentences_on_unknowns(hidden_by_unknowns),
    ]


def _sentence_on_noise(hidden: Sequence[Detectability]) -> list[str]:
    """Return the sentence on the effects that less noise would show; empty if there are none."""
    if not hidden:
        return []
    nearest = min(hidden, key=lambda detectability: detectability.noise_factor)
    factor = nearest.noise_factor
    names = [_name_in_sentence(detectability) for detectability in hidden]
    improvement = f"with noise {factor:.2g} times smaller or {factor**2:.2g} times as many trials"
    if len(names) == 1:
        return [
            f"At its prior median {names[0]} would not be detectable; it would be {improvement}."
        ]
    return [
        f"At their prior medians {listing(names)} would not be detectable; "
        f"{_name_in_sentence(nearest)} would be the first, {improvement}."
    ]


def _sentences_on_unknowns(hidden: Sequence[Detectability]) -> list[str]:
    """Return a sentence for each set of unknowns that can imitate effects, and hide them thereby.

    The unknowns imitate the effects within their stated deviations.
    """
    effects_by_unknowns: dict[tuple[str, ...], list[str]] = {}
    for detectability in hidden:
        names = effects_by_unknowns.setdefault(detectability.imitated_by, [])
        names.append(_name_in_sentence(detectability))
    sentences = []
    for unknowns, names in effects_by_unknowns.items():
        medians = "At its prior median" if len(names) == 1 else "At their prior medians"
        beginning = f"{medians} {listing(names)} would not be detectable, and less noise or more "
        if not unknowns:
            sentences.append(f"{beginning}trials would not help: these trials hardly depend on it.")
            continue
        sentences.append(
            f"{beginning}trials would not help: within what is stated, {listing(unknowns)} can "
            "change the readings alike. Calibrate these more closely, or add a channel or a kind "
            "of trial that tells them apart."
        )
    return sentences


def _name_in_sentence(detectability: Detectability) -> str:
    """Return the identifier of an effect in words."""
    return detectability.effect.identifier.replace("_", " ")
