"""Arguments that are one of a few values."""

from collections.abc import Iterable
from difflib import get_close_matches

from .errors import InvalidChoiceError
from .words import listing


def require_one_of(value: object, allowed: Iterable[object], name: str) -> None:
    """Refuse an argument that is not one of the allowed values.

    Parameters
    ----------
    value : object
        The argument.
    allowed : iterable of object
        The allowed values, such as `get_args` of a `Literal`.
    name : str
        The name of the argument, for the message.

    Raises
    ------
    InvalidChoiceError
        If the value is not allowed; the message lists the choices and names the nearest word.
    """
    choices = list(allowed)
    for choice in choices:
        # 1 == True == 1.0 in Python, so the types must agree, too.
        if type(value) is type(choice) and value == choice:
            return
    quoted_choices = listing(map(repr, choices), "or")
    advice = _nearest_word_advice(value, choices)
    raise InvalidChoiceError(f"`{name}` must be {quoted_choices}, and {value!r} came{advice}.")


def _nearest_word_advice(value: object, choices: list[object]) -> str:
    if not isinstance(value, str):
        return ""
    words = [choice for choice in choices if isinstance(choice, str)]
    nearest_words = get_close_matches(value.lower(), words, n=1)
    if not nearest_words:
        return ""
    return f"; the nearest is {nearest_words[0]!r}"
