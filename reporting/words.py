"""Numbers, lists of words and names of parameters, as sentences show them."""

import re
from collections.abc import Iterable, Mapping, Sequence
from math import floor, isfinite, log10

LONGEST_FACT = 60
"""Longest text of a value in `brief`, in characters."""

WHOLE_FROM, POWERS_FROM = 1e3, 1e7
"""Numbers from which on the whole part is written, and from which on a power of ten."""

MOST_LISTED = 30
"""Largest number of words that `comma_list` writes out."""
MOST_LISTED_ROWS = 5
"""Largest number of rows that `rows_of_table` writes out."""

_LISTED_ITEMS = 3  # of a collection in `brief`


def in_one_line(text: str) -> str:
    """Return a text without line breaks and repeated blanks."""
    return " ".join(text.split())


def counted(count: int, noun: str, plural: str | None = None) -> str:
    """Return a count with its noun: "1 trial", "2 trials".

    Parameters
    ----------
    count : int
        The number of things.
    noun : str
        The noun in the singular.
    plural : str, optional
        The noun in the plural; `noun` with an "s" by default.
    """
    if count == 1:
        return f"{count} {noun}"
    return f"{count} {plural or f'{noun}s'}"


def brief(record: object, **facts: object) -> str:
    """Return a description of a record in one line, for `__repr__`.

    It consists of the name of the class and of some values. Long texts are shortened; a collection
    is shown by its length and its first three entries.

    Parameters
    ----------
    record : object
        The object to describe.
    **facts : object
        The values to show, by name.
    """
    pairs = ", ".join(f"{name}={_short(value)}" for name, value in facts.items())
    return f"{type(record).__name__}({pairs})"


def _short(value: object) -> str:
    """Return a value as a short text."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping | list | tuple):
        return _short_collection(list(value))
    if isinstance(value, str) and len(value) > LONGEST_FACT:
        return f"{value[: LONGEST_FACT - 3]}..."
    return str(value)


def _short_collection(entries: list[object]) -> str:
    """Return the length of a collection and its first entries as a text."""
    if not entries:
        return "none"
    texts = [_short(entry) for entry in entries[:_LISTED_ITEMS]]
    if len(entries) > _LISTED_ITEMS:
        texts.append("...")
    return f"{len(entries)} ({', '.join(texts)})"


def is_or_are(count: int) -> str:
    """Return "is" for one and "are" for any other count."""
    return "is" if count == 1 else "are"


def listing(words: Iterable[str], joint: str = "and", most: int | None = None) -> str:
    """Return words as "a, b and c", or with another `joint`; those beyond `most` as "3 more"."""
    texts = list(words)
    if most is not None and len(texts) > most:
        texts = [*texts[:most], f"{len(texts) - most} more"]
    if len(texts) < 2:
        return "".join(texts)
    return f"{', '.join(texts[:-1])} {joint} {texts[-1]}"


def comma_list(words: Iterable[object]) -> str:
    """Return words as "a, b, c", or "none"; a long list is cut after its first words."""
    texts = [str(word) for word in words]
    listed = ", ".join(texts[:MOST_LISTED]) or "none"
    if len(texts) > MOST_LISTED:
        return f"{listed} and {len(texts) - MOST_LISTED} more"
    return listed


def rows_of_table(indices: Sequence[int]) -> str:
    """Return which rows of a table are meant: "row 8", "rows 8, 9 and 12", "rows 8, 9 and 3 more".

    Parameters
    ----------
    indices : sequence of int
        The indices of the rows, from 0. The text counts from 1, without the line of headings.
    """
    numbers = [str(index + 1) for index in indices]
    if len(numbers) > MOST_LISTED_ROWS:
        further_count = len(numbers) - MOST_LISTED_ROWS + 1
        numbers = [*numbers[: MOST_LISTED_ROWS - 1], f"{further_count} more"]
    return f"{'row' if len(indices) == 1 else 'rows'} {listing(numbers)}"


_LONG_HASH = re.compile(r"(SHA-256 [0-9a-f]{12})[0-9a-f]{52}")


def with_short_hashes(text: str) -> str:
    """Return a text for people, in which a SHA-256 has its first 12 digits; files keep all 64."""
    return _LONG_HASH.sub(r"\1", text)


def one_line(reason: object) -> str:
    """Return the message of a foreign error as one line without full stop."""
    return " ".join(str(reason).split()).removesuffix(".")


def parameter_title(name: str) -> str:
    """Return the name of a parameter in words: "young_modulus_factor" as "Young modulus factor"."""
    return re.sub(r"\byoung\b", "Young", name.replace("_", " "))


def number(value: object) -> str:
    """Return a table cell: a float as `significant` writes it, a text as it is, a dash for None."""
    if value is None:
        return "—"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return significant(value)
    return str(value)


def significant(value: float) -> str:
    """Return a number with three significant digits, and its whole part from 1,000 on.

    The whole part is kept because large numbers of reports, such as logarithms of evidence, are
    compared by their difference.
    """
    if WHOLE_FROM <= abs(value) < POWERS_FROM:
        return _with_minus_sign(f"{value:.0f}")
    return _with_minus_sign(f"{value:.3g}")


def rounded(value: float, deviation: float) -> str:
    """Return a value as text, with the decimals that its standard deviation justifies.

    The last decimal is the second significant digit of the standard deviation.

    Parameters
    ----------
    value, deviation : float
        The value and its standard deviation, in one unit.
    """
    if not isfinite(value):
        return "—"
    if not (deviation > 0.0 and isfinite(deviation)):
        return _with_minus_sign(f"{value:.6g}")
    decimal_places = 1 - floor(log10(deviation))
    if abs(value) >= 1e6 or deviation < 1e-6:
        leading_exponent = floor(log10(max(abs(value), deviation)))
        digits = max(2, leading_exponent + decimal_places + 1)
        return f"{value:.{min(digits, 12) - 1}e}"
    # The option "z" writes a rounded negative zero without its sign.
    return _with_minus_sign(f"{value:z.{max(decimal_places, 0)}f}")


def _with_minus_sign(text: str) -> str:
    """Return a number with the minus sign of typography in the place of the hyphen."""
    return text.replace("-", "−")


def plus_minus(value: float, deviation: float) -> str:
    """Return mean ± standard deviation."""
    return f"{rounded(value, deviation)} ± {rounded(deviation, deviation)}"


def between(low: float, high: float, deviation: float | None = None) -> str:
    """Return an interval as text, with as many decimals as its width or a deviation needs."""
    if deviation is None:
        deviation = high - low
    return f"{rounded(low, deviation)} to {rounded(high, deviation)}"


def capital(text: str) -> str:
    """Return the text with a capital first letter."""
    return text[:1].upper() + text[1:]


def small(text: str) -> str:
    """Return the text with a small first letter, for use inside a sentence."""
    return text[:1].lower() + text[1:]
