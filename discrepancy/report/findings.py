"""Sections on what was found: verdict, next experiment, where the gap is."""

from collections.abc import Callable
from math import isfinite, isnan

from discrepancy.judgement.conclusion import effects_text, named_effects, probability_text
from discrepancy.judgement.when import NO_GAP, when_sentence
from discrepancy.verdict import NamedEffect, Verdict, VerdictKind
from discrepancy.workflow import Investigation
from reporting.page import Page
from reporting.words import counted, listing

from . import text as words
from .figures import ReportInput
from .text import WORDS, size_sentence

LEAST_SHARE = 0.05
"""Findings in words that explain less of the excess variance are left to the file."""
SHOWN_FINDINGS = 8


def add_verdict(page: Page, content: ReportInput, picture: Callable[[], None] = lambda: None) -> None:
    """Add the verdict: effect, size and probability, its sentence, its `picture`, what is added."""
    investigation = content.investigation
    verdict = investigation.verdict
    page.add_highlights(_opening(investigation))
    page.add_notice(words.headline(verdict))
    if opening := " ".join(filter(None, (_sizes(content), closing_sentence(investigation)))):
        page.add_paragraph(opening)
    picture()
    page.add_paragraph(words.meaning(verdict))
    if shares := words.shares_sentence(verdict):
        page.add_paragraph(f"{shares} {words.remainders_sentence(verdict)}".strip())
    search = investigation.search
    catalogue = {} if search is None else {item.identifier: item for item in search.effects}
    if verdict.kind is VerdictKind.UNEXPLAINED and verdict.resembles:
        names = [catalogue[name].name if name in catalogue else name for name in verdict.resembles]
        page.add_paragraph(WORDS.say("nearest", names=names))
    for effect in {item.identifier: item for item in verdict.effects}.values():
        entry = catalogue.get(effect.identifier)
        if entry is not None:
            page.add_paragraph(WORDS.say("entry", effect=effect, entry=entry))
    sizes = WORDS.content["sizes"]
    told = {"whose": sizes.get(verdict.kind, sizes["other"]), "patch": ""}
    if content.intervals:
        of = "" if verdict.kind in words.NAMING else f" of {words.added_label(investigation)}"
        told["patch"] = f" patch.json holds the change{of} in SI units. {content.fmu}"
    if members := words.members_of(verdict):
        rows = [
            (str(place) if row is own[0] else "", *row)
            for place, own in enumerate(map(_parameters, members.values()), start=1)
            for row in own
        ]
        WORDS.add_table(page, "members", rows, **told)
    else:
        name = "added" if verdict.kind in words.NAMING else "could_be_added"
        WORDS.add_table(page, name, _parameters(verdict.effects), **told)


def _parameters(effects: tuple[NamedEffect, ...]) -> list[tuple[str, ...]]:
    """Return a row for each parameter of effects; one without parameters has a row, too."""
    rows: list[tuple[str, ...]] = []
    for effect in effects:
        head = (effect.name, effect.place or "\N{EN DASH}")
        own = (*effect.parameters, *effect.shape)
        for item in own:
            what = words.formula(item.description or item.name.replace("_", " "))
            rows.append((*head, what, *words.estimate_text(item), words.unit_text(item.unit)))
        rows += [] if own else [(*head, "", "", "", "")]
    return rows


def _opening(investigation: Investigation) -> list[tuple[str, str]]:
    """Return in large print: the effect, its size, its share, its probability."""
    verdict, proof, force = investigation.verdict, investigation.proof, investigation.verdict.force
    what = _what(verdict)
    items = [(what[:1].upper() + what[1:], WORDS.content["opening"].get(verdict.kind, verdict.kind.value))]
    if force is not None:
        items.append((f"{words.number(force.rms)} {force.unit}", f"missing at {force.port}, rms"))
        share = next((one for one in (force.held_out, force.fitted) if one is not None and one.tested), None)
        if share is not None:
            kind = "fitted" if share is force.fitted else "held-out"
            of = "its effect on predictions" if share.ahead else "it"
            law = force.law if verdict.kind in words.NAMING else f"{force.law}, which is no name"
            items.append((words.share_text(share), f"of {of} in {kind} trials is {law}"))
        elif force.ordered_by:
            share_of = f"what orders it: {100.0 * max(force.orders.values()):.0f} % of its variance"
            items.append((listing(force.ordered_by), share_of))
    elif verdict.explained is not None:  # at the scale of its share: χ²/dof counts uncertainty as expected
        before, after = words.residual_sizes(verdict.explained)
        told = f"noise deviations, rms on {verdict.explained.trials} trials, before and after"
        items.append((f"{before} → {after}", told))
    if not isnan(verdict.probability) and verdict.kind is not VerdictKind.UNEXPLAINED:
        items.append((probability_text(verdict.probability), "probability of the verdict"))
    compared = [gate for gate in verdict.gates if isfinite(gate.statistic)]
    judged = [gate for gate in compared if gate.name not in ("shape", "held-out trials")]
    if proof is None and force is None and judged:  # of gates that compare a p-value, the one that decided
        gate = next((gate for gate in judged if gate.passed is False), judged[0])
        told = f"p of the {gate.name}; a fit has at least {words.number(gate.limit)}"
        items.append((words.number(gate.statistic), told))
    return items


def _what(verdict: Verdict) -> str:
    """Return what is missing, in a few words."""
    if members := words.members_of(verdict):
        return listing(members, "or")
    without = {
        VerdictKind.NOTHING_MISSING: "nothing", VerdictKind.DATA_ERROR: "the data",
        VerdictKind.BELOW_LIMIT: "nothing that could be seen",
    }  # fmt: skip
    named = verdict.effects if verdict.kind in words.NAMING else ()
    kept = [item for item in named if not (item.shape and verdict.family)]
    found = [effects_text(kept), f"an effect of the family {verdict.family}" if verdict.family else ""]
    return without.get(verdict.kind) or listing(filter(None, found)) or "no name"


def _sizes(content: ReportInput) -> str:
    """Return how large what is missing is, in SI units, or by its parameters where none has a unit."""
    found = content.investigation
    if content.intervals and found.problem is not None and found.fit is not None:
        effects = named_effects(found.problem, found.fit)
        if sentence := size_sentence(found, effects, content.intervals):
            return sentence
    if found.verdict.kind not in words.NAMING:
        return ""
    parts = []
    for effect in found.verdict.effects:
        for item in effect.parameters:
            value, interval = words.estimate_text(item)
            what = words.formula(item.description or item.name.replace("_", " "))
            parts.append(f"{what} {value} {words.unit_text(item.unit)}".rstrip() + f" ({interval})")
    return f"Its size: {'; '.join(parts)}; 90 % intervals in brackets." if parts else ""


def closing_sentence(investigation: Investigation) -> str:
    """Return how much of the gap is closed and what is left; empty where nothing was added or scored."""
    verdict, proof = investigation.verdict, investigation.proof
    added = "It" if verdict.kind in words.NAMING else "The best hypothesis, which is no name,"
    share = None if words.rests_on_force(verdict) else verdict.explained
    if share is not None:
        return WORDS.say("closes", added=added, found=share)
    if proof is None or not words.added_label(investigation):
        return ""
    before, after, where = words.scored(proof)
    if not all(isfinite(item.chi_square_per_dof) for item in (before, after)):
        return ""
    return WORDS.say("scored", added=added, proof=proof, before=before, after=after, where=where)


def add_next(page: Page, investigation: Investigation) -> None:
    """Add the proposed experiments."""
    page.add_paragraph(WORDS.say("next"))
    if sentence := when_sentence(investigation.verdict.windows):
        page.add_paragraph(sentence)
    WORDS.add_table(page, "next", investigation.verdict.next_experiments)


def add_location(page: Page, investigation: Investigation) -> None:
    """Add where the model as it was disagrees."""
    location = investigation.location
    if location is None:
        page.add_paragraph(WORDS.say("not_searched"))
        return
    nothing = investigation.verdict.kind in NO_GAP
    significant = sum(cell.significant for cell in location.cells)
    are = "is a discovery" if significant == 1 else "are discoveries"
    told = "disagrees" if location.disagrees else "agrees" if nothing else "hidden"
    cells = counted(len(location.cells), "cell")
    page.add_paragraph(WORDS.say(told, significant=significant, cells=cells, are=are))
    findings = [item for item in location.disagreements if item.share >= LEAST_SHARE][:SHOWN_FINDINGS]
    for item in findings:
        page.add_paragraph(f"• {item.sentence}")
    WORDS.add_table(page, "tests", location.tests)
