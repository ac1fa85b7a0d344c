"""What a campaign can decide, in rows for the page and for the terminal."""

from collections.abc import Collection, Sequence
from math import isfinite

import numpy as np

from discrepancy.campaign.records import Campaign, TrialKind
from discrepancy.catalogue.entry import Effect
from discrepancy.judgement.separability import CONFUSED, DETECTED, Detectability, Separability
from reporting.words import listing

from .text import WORDS, number, unit_text


def seen_of(item: Detectability) -> tuple[str, str, str]:
    """Return whether an effect can be seen, from which size on, and its prior median."""
    seen = item.distance >= DETECTED
    visible = "yes" if seen else "larger than usual only"
    if not item.parameter:
        return visible, "at once" if seen else "not at its prior median", ""
    size, typical = (
        f"{number(value, 2)} {unit_text(item.unit)}".rstrip() for value in (item.detectable, item.typical)
    )
    return (visible, size, typical) if isfinite(item.detectable) else ("not visible", "never", typical)


def neighbours(found: Separability, name: str) -> list[str]:
    """Return the effects that these data cannot tell from one, in either direction."""
    if name not in found.identifiers:
        return []
    at = found.identifiers.index(name)
    near = np.minimum(found.distance[at], found.distance[:, at]) < CONFUSED
    return [other for place, other in enumerate(found.identifiers) if near[place] and place != at]


def group_lines(found: Separability, told: str = "the table says to which") -> list[str]:
    """Return one sentence for each confusion group, or one that there is none; `told`: where to look."""
    seen = [item for item in found.detectability if not item.reason and isfinite(item.detectable)]
    if not found.identifiers or not any(item.parameter and item.distance > 0.0 for item in seen):
        return [WORDS.say("nothing_shown")]
    if not found.groups:
        return [WORDS.say("all_apart")]
    lines = []
    for group in found.groups:
        names = [name.replace("_", " ") for name in group]
        if len(names) == 2:
            lines.append(f"These data cannot tell {names[0]} from {names[1]}.")
        else:
            lines.append(f"Confusion group, each close to at least one other ({told}): {listing(names)}.")
    return lines


def needs(
    found: Separability, campaign: Campaign, effects: Sequence[Effect], possible: Collection[TrialKind]
) -> list[str]:
    """Return sentences on what the campaign would need to decide more; `possible`: what the model follows."""
    known = {effect.identifier: effect for effect in effects}
    there = {trial.kind for trial in campaign.trials}
    lines = []
    for group in found.groups:
        acts = [known[name].acts_on for name in group if name in known]
        union: frozenset[TrialKind] = frozenset().union(*acts)
        common = frozenset(TrialKind).intersection(*acts)
        apart = [
            kind for kind in TrialKind if kind in union - common and kind in possible and kind not in there
        ]
        names = listing(name.replace("_", " ") for name in group)
        kinds = " or ".join(WORDS.content["kinds"][kind.value] for kind in apart)
        lines.append(WORDS.say("add_kinds" if apart else "vary", names=names, kinds=kinds))
    hidden = [
        item
        for item in found.detectability
        if not item.reason and item.parameter and isfinite(item.detectable) and item.distance < DETECTED
    ]
    if hidden:
        first = max(hidden, key=lambda item: item.distance)
        factor = (DETECTED / first.distance) ** 0.5 if first.distance > 0.0 else float("inf")
        unseen = [item.effect.identifier.replace("_", " ") for item in hidden]
        values = {"first": first.effect.identifier.replace("_", " "), "factor": factor, "trials": factor**2}
        lines.append(WORDS.say("unseen" if unseen[1:] else "unseen_one", unseen=listing(unseen), **values))
    unknown = [name for name, channel in campaign.channels.items() if channel.noise is None]
    lines += [WORDS.say("give_noise", names=", ".join(unknown))] if unknown else []
    return lines if campaign.held_out else [*lines, WORDS.say("hold_out")]
