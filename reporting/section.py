"""Tables of files as checked records: strict sections, and one sentence for what is wrong with them."""

import re
from typing import Annotated, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from reporting.words import counted, listing

_SHOWN_LENGTH = 60
_EXPECTED = {
    "tuple_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "string_type": "a text in quotes",
    "string_too_short": "a text that is not empty",
    "int_type": "an integer",
    "int_parsing": "an integer",
    "int_from_float": "an integer",
    "float_type": "a number",
    "float_parsing": "a number",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "finite_number": "a finite number",
}
"""What is expected, by pydantic's type of error, where its own words are those of Python."""


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0)]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0)]
Name = Annotated[str, Field(min_length=1, max_length=200)]


class Section(BaseModel):
    """A table of a file: unknown keys are refused, and numbers and words are not turned into each other."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


def require(met: object, otherwise: str) -> None:
    """Refuse a table with a sentence, in validators; raises `ValueError`."""
    if not met:
        raise ValueError(otherwise)


_Description = TypeVar("_Description", bound=BaseModel)


def checked(
    description: type[_Description],
    content: object,
    source: str,
    error: type[Exception],
    *,
    what: str,
    first_index: int = 1,
) -> _Description:
    """Return the content of a file as its description.

    Parameters
    ----------
    description : type of BaseModel
        What the file may hold.
    content : object
        What it holds.
    source : str
        Where it comes from, for the sentence.
    error : type of Exception
        What is raised, with one sentence.
    what : str
        What it is, with its article, for the sentence: "a lumped model".
    first_index : int
        Where the entries of a list are counted from.

    Raises
    ------
    error
        The sentence names `source`, the place, what came and what was expected.
    """
    try:
        return description.model_validate(content)
    except ValidationError as cause:
        raise error(f"{source}: {_sentence(cause, what, first_index)}.") from None


def shown(value: object) -> str:
    """Return a value as it can stand in a sentence, shortened if it is long."""
    try:
        text = repr(value)
    except ValueError:  # an integer of thousands of digits
        return "a number of thousands of digits"
    return text if len(text) <= _SHOWN_LENGTH else f"{text[: _SHOWN_LENGTH - 3]}..."


def _sentence(error: ValidationError, what: str, first_index: int) -> str:
    found = error.errors(include_url=False)
    # A misspelt key shows up twice, as unknown and as missing: the unknown one tells more.
    for kinds, one, several in (
        (("extra_forbidden", "unexpected_keyword_argument"),
         f"is not a key of {what}; remove it or correct its spelling",
         f"are not keys of {what}; remove them or correct their spelling"),
        (("missing", "missing_argument"), "is missing", "are missing"),
    ):  # fmt: skip
        if places := [shown(_written(item["loc"], first_index)) for item in found if item["type"] in kinds]:
            return f"{listing(places)} {several if places[1:] else one}"
    first = found[0]
    place = _written(first["loc"], first_index)
    before = f"{place}: " if place else ""
    if first["type"] == "value_error":
        return f"{before}{first['ctx']['error']}"
    if first["type"] == "tuple_type" and isinstance(first["input"], dict):
        return f"there can be several of {place!r}, so write [[{place}]] for each, not [{place}]"
    if first["type"] == "too_short":
        least = first["ctx"]["min_length"]
        message = f"at least {counted(least, 'entry', 'entries')} {'is' if least == 1 else 'are'} expected"
    elif first["type"] in _EXPECTED:
        message = f"{_EXPECTED[first['type']]} is expected"
    else:
        message = first["msg"][0].lower() + first["msg"][1:]
    return f"{before}{message}, but {shown(first['input'])} came"


def _written(location: tuple[int | str, ...], first_index: int) -> str:
    """Return a place as the file has it, without pydantic's names of types."""
    text = ""
    for part in location:
        if isinstance(part, int):
            text += f"[{part + first_index}]"
        elif not re.search(r"[^\w]|^constrained", part):
            text += f".{part}" if text else part
    return text
