"""What the reader of a campaign says of its records in time: their stamps, their begin, their noise."""

from collections.abc import Mapping

from discrepancy.campaign.noise import noise_model
from discrepancy.campaign.records import Channel, Start, Trial, TrialKind
from discrepancy.campaign.sampling import spacing_sentence
from discrepancy.errors import said
from reporting.words import counted


def remarks_on(channels: Mapping[str, Channel], trials: tuple[Trial, ...]) -> list[str]:
    """Return the sentences on the trials of a campaign, in one order."""
    uneven = spacing_sentence({trial.name: trial.time for trial in trials if trial.is_dynamic})
    found = [] if uneven is None else [uneven]
    return [*found, *_begins(trials), *_not_whitened(channels, trials)]


_BEGINS = {
    Start.SETTLED: "taken to begin at rest under what acts at the first sample",
    Start.STILL: "taken to begin at rest under nothing",
    Start.UNKNOWN: "begun in a state that is fitted",
}
_ASSUMED = ' (assumed: say `begins`, "settled", "still" or "unknown")'


def _begins(trials: tuple[Trial, ...]) -> list[str]:
    """Return what is said or assumed of how trials begin, one sentence for each kind of begin."""
    groups: dict[tuple[Start, bool], list[str]] = {}
    for trial in trials:
        matters = trial.kind is TrialKind.DRIVEN or (trial.kind is TrialKind.FORCED and trial.force[0] != 0.0)
        if matters or not trial.begin_assumed:
            groups.setdefault((trial.begins, trial.begin_assumed), []).append(repr(trial.name))
    found = []
    for (begins, assumed), names in groups.items():
        several, are = ("", "is") if len(names) == 1 else ("s", "are")
        how = _BEGINS[begins] + (_ASSUMED if assumed else "")
        found.append(f"The trial{several} {', '.join(names)} {are} {how}.")
    return found


def _not_whitened(channels: Mapping[str, Channel], trials: tuple[Trial, ...]) -> list[str]:
    """Return a sentence for each channel whose coloured noise cannot be whitened in some trial."""
    found = []
    for name, channel in channels.items():
        noise = noise_model(channel, 1.0)
        there = (trial for trial in trials if name in trial.channels)
        where = [trial.name for trial in there if noise.stays_coloured(trial)]
        if where:
            trials_there = f"{counted(len(where), 'trial')} {', '.join(map(repr, where))}"
            found.append(said("remarks.not_whitened", channel=name, trials=trials_there))
    return found
