"""Numbers beside their nouns, names of parameters, and reasons, for sentences."""

import re
from collections.abc import Iterable


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
