"""Numbers, names and formulas as the report and the summary on the terminal show them."""

import re
from collections.abc import Iterable
from math import isfinite, isnan

from discrepancy.verdict import Hypothesis, ParameterEstimate, VerdictKind, place_in_words
from discrepancy.workflow import Investigation
from reporting.pages.page_words import Words
from reporting.words import between, rounded

WORDS = Words("discrepancy.report")
"""The titles and captions of figures, and what each kind of verdict means."""

BEYOND_DOUBT = 1e6
"""Log evidence [nat] above which only "more than" is shown."""
NAMING = (VerdictKind.NAMED, VerdictKind.NAMED_IN_PART)
"""Verdicts that name what is missing, or part of it."""

UNKNOWN = "\N{EN DASH}"
"""The text of a number or a cell about which nothing is known."""

LARGEST_PLAIN_NUMBER = 1e6
"""Numbers below this are written without a power of ten."""

SHORT_UNITS = {"1": "", "m/s2": "m/s²"}


def estimate_text(estimate: ParameterEstimate) -> tuple[str, str]:
    """Return a value and its 90 % interval as texts, to two digits of the half-width."""
    if not (isfinite(estimate.low) and isfinite(estimate.high)):
        return f"{estimate.value:.4g}", "not known"
    half_width = 0.5 * (estimate.high - estimate.low)
    interval = between(estimate.low, estimate.high, half_width)
    return rounded(estimate.value, half_width), interval


def p_value_text(p_value: float) -> str:
    """Return a p-value as text."""
    if isnan(p_value):
        return "not known"
    return "< 1e-6" if p_value < 1e-6 else f"{p_value:.2g}"


def number(value: float, digits: int = 3) -> str:
    """Return a number with significant digits, or a dash where it is not known."""
    if isnan(value):
        return UNKNOWN
    text = f"{value:.{digits}g}"
    if "e+0" in text and abs(value) < LARGEST_PLAIN_NUMBER:
        text = f"{float(text):,.0f}"
    return text.replace("-", "\N{MINUS SIGN}")


def unit_text(unit: str) -> str:
    """Return a unit for people; empty for plain numbers."""
    return SHORT_UNITS.get(unit, unit)


def _effects_label(effects: Iterable[tuple[str, str, bool]]) -> str:
    """Return the label of effects: their names, places and a mark for a free shape, joined by +."""
    labels = []
    for name, place, has_free_shape in effects:
        marks = [place_in_words(place)] if place else []
        if has_free_shape:
            marks.append("free shape")
        labels.append(f"{name} ({', '.join(marks)})" if marks else name)
    return " + ".join(labels)


def hypothesis_name(hypothesis: Hypothesis) -> str:
    """Return the effects of a hypothesis in words."""
    effects = [(effect.name, effect.place, bool(effect.shape)) for effect in hypothesis.effects]
    return _effects_label(effects) or "no effect"


def added_label(investigation: Investigation) -> str:
    """Return the effects that were added to the model, in words; empty if none was."""
    if investigation.fit is None:
        return ""
    terms = investigation.fit.candidate.terms
    return _effects_label((term.effect.name, term.place, term.free_shape) for term in terms)


GREEK_LETTERS = {
    "alpha": "α",
    "beta": "β",
    "chi": "χ",
    "delta": "δ",
    "eps": "ε",
    "eta": "η",
    "kappa": "κ",
    "mu": "μ",
    "nu": "ν",
    "phi": "φ",
    "pi": "π",
    "rho": "ρ",
    "tau": "τ",
    "theta": "θ",
    "zeta": "ζ",
}
"""Letters by the names that equations of the catalogue use for them."""

_WORD = re.compile(r"\b([a-z]+)(?=\b|_)")
_POWERS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


def formula(text: str) -> str:
    """Return an equation of the catalogue with Greek letters, powers and arrows."""
    with_letters = _WORD.sub(lambda match: GREEK_LETTERS.get(match[1], match[1]), text)
    with_arrows = with_letters.replace("->", "→")
    return re.sub(r"\^(\d)(?!\w)", lambda match: match[1].translate(_POWERS), with_arrows)


def nats(evidence: float) -> str:
    """Return an evidence [nat] as text; no digits beyond `BEYOND_DOUBT`."""
    return f"{evidence:,.0f}" if abs(evidence) < BEYOND_DOUBT else f"more than {BEYOND_DOUBT:,.0f}"


def parameter_text(estimate: ParameterEstimate) -> str:
    """Return the description of a parameter, with its formula as it is printed."""
    return formula(estimate.description or estimate.name.replace("_", " "))
