"""Arguments that are one of a few values."""

from collections.abc import Iterable
from difflib import get_close_matches

from reporting.errors import InvalidChoiceError
from reporting.words import listing


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
    words = [choice for choice in choices if isinstance(choice, str)]
    nearest_choice = nearest_word(value, words) if isinstance(value, str) else None
    advice = "" if nearest_choice is None else f"; the nearest is {nearest_choice!r}"
    raise InvalidChoiceError(f"`{name}` must be {quoted_choices}, but {value!r} was given{advice}.")


def nearest_word(word: str, known_words: Iterable[str]) -> str | None:
    """Return the known word that is most like a word; None if no known word is like it."""
    nearest_words = get_close_matches(word.lower(), list(known_words), n=1)
    return nearest_words[0] if nearest_words else None


def did_you_mean(name: str, known_names: Iterable[str]) -> str:
    """Return a question with the known name that is most like a name, for the end of a message.

    It begins with a blank; it is empty if no known name is like it.
    """
    nearest_name = nearest_word(name, known_names)
    return "" if nearest_name is None else f" Did you mean `{nearest_name}`?"
