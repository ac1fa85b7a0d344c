"""Numbers beside their nouns and their uncertainties, names of parameters, and reasons, for sentences."""

import re
from collections.abc import Iterable, Mapping
from math import floor, isfinite, log10
from typing import Any

LONGEST_FACT = 60
"""Letters of a fact that `brief` tells."""


def counted(count: int, noun: str, plural: str | None = None) -> str:
    """Return a count with its noun: "1 trial", "2 trials".

    Parameters
    ----------
    count : int
        How many.
    noun : str
        Of one.
    plural : str, optional
        Of any other number; `noun` with an "s" if left out.
    """
    return f"{count} {noun if count == 1 else plural or f'{noun}s'}"


def brief(record: object, **facts: object) -> str:
    """Return a record in one line, for `__repr__`: its class, and facts by name.

    Long text is cut; of a collection of names its length and the first three are told.
    """
    return f"{type(record).__name__}({', '.join(f'{name}={_short(fact)}' for name, fact in facts.items())})"


def _short(fact: object) -> str:
    if isinstance(fact, float):
        return f"{fact:.4g}"
    if isinstance(fact, Mapping | list | tuple):
        first = [_short(item) for item in list(fact)[:3]] + ["..."] * (len(fact) > 3)
        return f"{len(fact)} ({', '.join(first)})" if first else "none"
    if isinstance(fact, str) and len(fact) > LONGEST_FACT:
        return f"{fact[: LONGEST_FACT - 3]}..."
    return str(fact)


def be(count: int) -> str:
    """Return "is" for one and "are" for any other count."""
    return "is" if count == 1 else "are"


def listing(words: Iterable[str], joint: str = "and") -> str:
    """Return words as "a, b and c", or with another `joint`."""
    found = list(words)
    if len(found) < 2:
        return "".join(found)
    return f"{', '.join(found[:-1])} {joint} {found[-1]}"


def one_line(reason: object) -> str:
    """Return what a foreign error says as one line without its full stop, to stand in a sentence."""
    return " ".join(str(reason).split()).removesuffix(".")


def parameter_title(name: str) -> str:
    """Return the name of a parameter in words, "young_modulus_factor" as "Young modulus factor"."""
    return re.sub(r"\byoung\b", "Young", name.replace("_", " "))


def number(value: Any) -> str:
    """Return a figure as printed: text as it is, five significant digits, a dash for none."""
    if value is None:
        return "—"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.5g}".replace("-", "−") if isinstance(value, float) else str(value)


def rounded(value: float, deviation: float) -> str:
    """Return a value with as many decimals as two digits of its deviation need."""
    if not isfinite(value):
        return "—"
    if not (deviation > 0.0 and isfinite(deviation)):
        return f"{value:.6g}".replace("-", "−")
    decimals = 1 - floor(log10(deviation))
    if abs(value) >= 1e6 or deviation < 1e-6:
        digits = max(2, floor(log10(max(abs(value), deviation))) + decimals + 1)
        return f"{value:.{min(digits, 12) - 1}e}"
    return f"{value:z.{max(decimals, 0)}f}".replace("-", "−")  # nothing is less than none


def plus_minus(value: float, deviation: float) -> str:
    """Return mean ± standard deviation."""
    return f"{rounded(value, deviation)} ± {rounded(deviation, deviation)}"


def between(low: float, high: float, deviation: float | None = None) -> str:
    """Return an interval with as many decimals as its width or another deviation needs."""
    spread = high - low if deviation is None else deviation
    return f"{rounded(low, spread)} to {rounded(high, spread)}"


def capital(text: str) -> str:
    """Return the text with its first letter capital."""
    return text[:1].upper() + text[1:]


def small(text: str) -> str:
    """Return the text with its first letter small, to stand in a sentence."""
    return text[:1].lower() + text[1:]
