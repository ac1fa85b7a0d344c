"""Arguments that are one of a few values."""

from collections.abc import Iterable
from difflib import get_close_matches

from .errors import InvalidChoiceError
from .words import listing


def one_of(value: object, allowed: Iterable[object], name: str) -> None:
    """Refuse an argument that is none of the allowed values.

    Parameters
    ----------
    value : object
        The argument.
    allowed : iterable of object
        Values that it may have, such as `get_args` of its `Literal`.
    name : str
        Name of the argument, for the sentence.

    Raises
    ------
    InvalidChoiceError
        If it is none of them; the sentence lists them and names the nearest word.
    """
    choices = [*allowed]
    if any(type(value) is type(choice) and value == choice for choice in choices):
        return
    words = [choice for choice in choices if isinstance(choice, str)]
    nearest = get_close_matches(value.lower(), words, n=1) if isinstance(value, str) else []
    advice = f"; the nearest is {nearest[0]!r}" if nearest else ""
    raise InvalidChoiceError(
        f"`{name}` must be {listing(map(repr, choices), 'or')}, and {value!r} came{advice}."
    )
