"""Sentences added to a verdict: when there is a gap, and which effects were not compared."""

from collections.abc import Iterable, Mapping, Sequence
from math import floor, log10

from discrepancy.campaign.records import Campaign, TrialKind
from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.search.starts import are_related
from discrepancy.verdict import (
    GapWindow,
    Moment,
    NamedEffect,
    Verdict,
    VerdictKind,
)
from fe.runtime.laws.interface import PortForce
from reporting.words import listing

# ---------------------------------------------------------------- when there is a gap

KINDS_WITHOUT_GAP = (VerdictKind.NOTHING_MISSING, VerdictKind.BELOW_LIMIT)
"""Kinds of verdicts after which the model remains unchanged: no gap was detected."""
KINDS_OF_NOISE_ALONE = (VerdictKind.NAMED, VerdictKind.FAMILY, VerdictKind.GROUP)
"""Kinds of verdicts on effects whose simulation leaves only noise."""
KINDS_WITH_NAME = (VerdictKind.NAMED, VerdictKind.NAMED_IN_PART, VerdictKind.FAMILY)
"""Kinds of verdicts that name one set of effects, or its family."""
MOST_MENTIONED = 3
"""Windows that a sentence mentions one by one."""


def moment_text(moment: Moment) -> str:
    """Return a time with its 90 % interval, to two digits of its width."""
    width = moment.high - moment.low
    places = max(0, 1 - floor(log10(width))) if width > 0.0 else 6
    interval = f"{moment.low:.{places}f} to {moment.high:.{places}f}"
    return f"{moment.value:.{places}f} s ({interval})"


def window_text(window: GapWindow) -> str:
    """Return in words when a gap begins and ends."""
    if window.begin is None and window.end is None:
        return "throughout the record"
    since = "from the first sample"
    if window.begin:
        since = f"since {moment_text(window.begin)}"
    if window.end:
        return f"{since} until {moment_text(window.end)}"
    return f"{since}, to the end of the record"


def gap_times_sentence(windows: Sequence[GapWindow]) -> str:
    """Return a sentence on when model and readings disagree; empty if no window shows a gap.

    Only the windows of the model without effect count, not those of the best hypothesis.
    """
    without_effect = [window for window in windows if not window.with_effect]
    if not without_effect:
        return ""
    if all(window.begin is None and window.end is None for window in without_effect):
        return "The gap is there throughout the records."
    if len(without_effect) > MOST_MENTIONED:
        largest = max(without_effect, key=lambda window: window.size)
        count = len(without_effect)
        return f"The gap comes and goes, {count} times; the largest is {_gap_window_text(largest)}."
    # gaps that begin inside a record first, then the others; the largest of each first
    sorted_windows = sorted(without_effect, key=lambda window: (window.begin is None, -window.size))
    return f"The gap is there {'; '.join(_gap_window_text(window) for window in sorted_windows)}."


def _gap_window_text(window: GapWindow) -> str:
    """Return in words the trial, the time and the size of a gap."""
    size = f"{window.size:.2g}"
    if "e+0" in size:
        size = f"{float(size):,.0f}"
    return f"in {window.trial!r} {window_text(window)}, {size} times the noise"


def verdict_with_times(verdict: Verdict, windows: Sequence[GapWindow]) -> Verdict:
    """Return a verdict with the times of its gap or effects among its reasons, if informative."""
    times_sentence = active_windows_sentence(verdict.effects)
    is_informative = has_gap_beginning_inside(windows) or verdict.kind is VerdictKind.UNEXPLAINED
    if not times_sentence and verdict.kind not in KINDS_WITHOUT_GAP and is_informative:
        times_sentence = gap_times_sentence(windows)
    return verdict.with_reasons(times_sentence)


def has_gap_beginning_inside(windows: Sequence[GapWindow]) -> bool:
    """Return whether a gap of the model without effect begins inside a record, as by an event."""
    return any(window.begin is not None for window in windows if not window.with_effect)


def active_windows_sentence(effects: Sequence[NamedEffect]) -> str:
    """Return the sentences on effects that act only in windows of time; empty if there are none."""
    sentences = []
    for effect in effects:
        windows = effect.patch.primitives[0].windows if len(effect.patch) else ()
        if not windows:
            continue
        texts = []
        for trial, begin, end in windows:
            since = "from the first sample" if begin is None else f"from {begin:.6g} s"
            until = "on" if end is None else f"until {end:.6g} s"
            texts.append(f"{since} {until} in {trial!r}")
        mentioned_windows = "; ".join(texts[:MOST_MENTIONED])
        if len(texts) > MOST_MENTIONED:
            mentioned_windows += f"; and in {len(texts) - MOST_MENTIONED} more"
        sentences.append(f"{effect.name} acts {mentioned_windows}.")
    return " ".join(sentences)


# ---------------------------------------------------------------- what was not compared


def verdict_with_untested_effects(
    verdict: Verdict, setting: Setting, effects: Sequence[Effect]
) -> Verdict:
    """Return the verdict with a sentence on effects that may be the cause, but cannot be tested.

    Such an effect is easily mistaken for one of the verdict, and acts on trials of these kinds. But
    it could not be compared, since it needs another trial, port or place, and neither could its
    counterpart for this kind of model.

    Parameters
    ----------
    setting : Setting
        The campaign and the model, for which the effects may be available.
    """
    if verdict.kind not in (*KINDS_WITH_NAME, VerdictKind.GROUP):
        return verdict
    kinds = {trial.kind for trial in setting.campaign.trials}
    identifiers = {named_effect.identifier for named_effect in verdict.effects}
    members = [effect for effect in effects if effect.identifier in identifiers]
    tested = {effect.identifier for effect in effects if effect.unavailable(setting) is None}
    names = []
    for effect in effects:
        looks_alike = any(are_related(effect, member) for member in members)
        if effect.identifier in identifiers or not looks_alike or not effect.acts_on & kinds:
            continue
        if not {effect.identifier, effect.counterpart} & tested:
            names.append(effect.name)
    if not names:
        return verdict
    it_or_they = "it" if len(names) == 1 else "they"
    sentence = f"Not excluded, because {it_or_they} cannot be tested here: {listing(names)}."
    return verdict.with_reasons(sentence)


def verdict_with_only_sensor(verdict: Verdict, campaign: Campaign) -> Verdict:
    """Return the verdict with a sentence if the map of the only sensor would look the same.

    At rest under loads at one place, the readings of a single sensor are a curve over the load. A
    force over the displacement bends it, and so does a sensor whose readings are not in proportion.
    """
    trials = campaign.trials
    channels = {name for trial in trials for name in trial.channels}
    load_places = {trial.load_place for trial in trials}
    is_one_curve = (
        all(trial.kind is TrialKind.STATIC for trial in trials)
        and len(channels) == 1
        and len(load_places) == 1
    )
    laws = [primitive for effect in verdict.effects for primitive in effect.patch]
    is_force_over_displacement = bool(laws) and all(
        isinstance(law, PortForce) and not law.hysteretic and not law.depends_on_speed
        for law in laws
    )
    if verdict.kind not in KINDS_WITH_NAME or not (is_one_curve and is_force_over_displacement):
        return verdict
    (channel,) = channels
    sentence = (
        f"A sensor {channel} whose readings are not in proportion would look the same, whatever "
        "its curve: a second sensor, or a release, would tell."
    )
    return verdict.with_reasons(sentence)


def look_alike_remark(verdict: Verdict, compared: Iterable[Effect]) -> str | None:
    """Return a remark on effects of the catalogue that are similar to a named effect.

    Parameters
    ----------
    compared : iterable of Effect
        The effects that can act in the campaign and were compared with the named effects.

    Returns
    -------
    str or None
        One or two sentences; None if the verdict is not `VerdictKind.NAMED`.
    """
    if verdict.kind is not VerdictKind.NAMED:
        return None
    named_effects = {effect.identifier: effect.name for effect in verdict.effects}
    compared_by_identifier = {effect.identifier: effect for effect in compared}
    similar_identifiers = _similar_effects(set(named_effects), compared_by_identifier)
    compared_similar = sorted(similar_identifiers & compared_by_identifier.keys())
    does = "does" if len(named_effects) == 1 else "do together"
    names_text = " and ".join(named_effects.values())
    remark = (
        "A cause that is not in the catalogue would get the same name if it acts on these trials "
        f"as {names_text} {does}, within the noise."
    )
    if not compared_similar:
        return remark
    names = [compared_by_identifier[identifier].name for identifier in compared_similar]
    was_or_were = "was" if len(compared_similar) == 1 else "were"
    return (
        f"{remark} Of the effects that are known to look similar, {listing(names)} {was_or_were} "
        "compared and had less evidence."
    )


def _similar_effects(named_identifiers: set[str], compared: Mapping[str, Effect]) -> set[str]:
    """Return the identifiers of effects that are similar to a named one.

    The catalogue declares this for either of the two effects (`Effect.confusable`).
    """
    similar_identifiers = set()
    for identifier, effect in compared.items():
        if not named_identifiers.isdisjoint(effect.confusable):
            similar_identifiers.add(identifier)
    for identifier in named_identifiers & compared.keys():
        similar_identifiers.update(compared[identifier].confusable)
    return similar_identifiers - named_identifiers
