"""The one reader of TOML, and its tables as checked records; a fault is one sentence of the caller's."""

import json
import re
import tomllib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar, cast

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError

from reporting.sentences import said
from reporting.text_file import DEEPEST_NESTING, check_nesting, decoded, read_text, too_deep
from reporting.words import counted, listing

_PART = r"""(?:[\w-]++|"(?:[^"\\\n]++|\\.)*+"?+|'[^'\n]*+'?+)"""
_TEXT = (
    r'''#[^\n]*+|"""(?:[^"\\]++|\\[\s\S]|"(?!""))*+(?:"""|\Z)|''' + r"""'''(?:[^']++|'(?!''))*+(?:'''|\Z)"""
)
_KEYS = re.compile(rf"{_TEXT}|({_PART}(?:[ \t]*+\.[ \t]*+{_PART})*+)")
"""Comments and texts of several lines, then words and dotted keys; each is gone over once, however long."""

LONGEST_ARRAY = 90
"""Characters of an array that stands in one line."""


def read_toml(path: Path | str, error: type[Exception], *, what: str = "file") -> dict[str, Any]:
    """Return the content of a TOML file.

    Parameters
    ----------
    path : Path or str
        The file; UTF-8, with or without a byte order mark.
    error : type of Exception
        What is raised, with one sentence.
    what : str
        What the file is to be, for the sentence: "wing design".

    Raises
    ------
    error
        The file is not there, cannot be read, is not UTF-8 or not TOML, is nested too deeply, or holds an
        integer that 64 bits cannot.
    """
    return parse_toml(read_text(path, error, what=what), f"The {what} {path}", error)


def parse_toml(content: bytes | str, source: str, error: type[Exception]) -> dict[str, Any]:
    """Return the content of TOML that was read elsewhere; `source` names it in the sentence of `error`."""
    text = decoded(content, source, error) if isinstance(content, bytes) else content
    # The time that `tomllib` takes for a dotted key grows with the square of its parts.
    if any(line.count(".") >= DEEPEST_NESTING for line in text.split("\n")):
        keys = (match[1] or "" for match in _KEYS.finditer(text))
        if any(key.count(".") >= DEEPEST_NESTING < len(re.findall(_PART, key)) for key in keys):
            raise error(too_deep(source))
    try:
        found = tomllib.loads(text)
    except tomllib.TOMLDecodeError as cause:
        raise error(f"{source} is not valid TOML: {cause}.") from cause
    except RecursionError:
        raise error(too_deep(source)) from None
    except ValueError:  # Python turns no text of more than 4,300 digits into an integer
        raise error(said("text.digits", subject=source)) from None
    check_nesting(found, source, error)
    _check_integers(found, "", source, error)
    return found


def _check_integers(
    node: dict[str, Any] | list[Any], place: str, subject: str, error: type[Exception]
) -> None:
    """Refuse what TOML refuses (its specification, "Integer") and `tomllib` lets through."""
    for key, item in node.items() if isinstance(node, dict) else enumerate(node, start=1):
        large = isinstance(item, int) and not -(2**63) <= item < 2**63
        if not large and not isinstance(item, dict | list):
            continue
        here = f"{place}.{key}".lstrip(".") if isinstance(node, dict) else f"{place}[{key}]"
        if large:
            raise error(said("text.bits", subject=subject, key=here, bits=item.bit_length()))
        _check_integers(item, here, subject, error)


def toml_text(content: dict[str, Any]) -> str:
    """Return plain data as TOML, of which `parse_toml` makes the same again; what is None is left out.

    Tables of tables stand in one line, longer arrays in several.
    """
    tables = {key: item for key, item in content.items() if isinstance(item, dict)}
    arrays = {
        key: item
        for key, item in content.items()
        if isinstance(item, list) and item and all(isinstance(row, dict) for row in item)
    }
    parts = [_lines({key: item for key, item in content.items() if key not in (*tables, *arrays)})]
    parts += [f"[{_key(key)}]\n{_lines(item)}" for key, item in tables.items()]
    parts += [f"[[{_key(key)}]]\n{_lines(row)}" for key, rows in arrays.items() for row in rows]
    return "\n".join(part for part in parts if part)


def _lines(table: dict[str, Any]) -> str:
    return "".join(f"{key} = {shown}\n" for key, shown in _pairs(table))


def _pairs(table: dict[str, Any]) -> list[tuple[str, str]]:
    return [(_key(key), toml_value(item)) for key, item in table.items() if item is not None]


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else toml_value(name)


def toml_value(item: Any) -> str:
    """Return a value as TOML has it."""
    if isinstance(item, str):  # the escapes of JSON are TOML's, but for DEL
        return json.dumps(item, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(item, bool):
        return str(item).lower()
    if isinstance(item, list | tuple):
        shown = list(map(toml_value, item))
        if sum(map(len, shown)) > LONGEST_ARRAY:
            return "[\n" + "".join(f"    {one},\n" for one in shown) + "]"
        return f"[{', '.join(shown)}]"
    if isinstance(item, dict):
        return f"{{ {', '.join(f'{key} = {shown}' for key, shown in _pairs(item))} }}"
    return repr(float(item) if isinstance(item, float) else item)  # of a number of NumPy, too


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


Fault = tuple[object, str]
"""Whether a table has it, and the sentence on it."""


class Section(BaseModel):
    """A table of a file: unknown keys are refused, and numbers and words are not turned into each other."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    def faults(self) -> Iterator[Fault]:
        """Yield for each fault that it may have whether it has it, and the sentence on it.

        A fault is looked for only in a table that has none of those before it.
        """
        yield from ()

    @model_validator(mode="after")
    def _refuse_faults(self) -> Self:
        for found, sentence in self.faults():
            if found:
                raise ValueError(sentence)
        return self


MISSING_KEY = "missing_key"


def missing_keys(keys: list[str], sentence: str) -> PydanticCustomError:
    """Return the error of a validator that keys are missing; several are named at once, with those of others.

    Parameters
    ----------
    keys : list of str
        The keys, as the file would have them in the table that is validated.
    sentence : str
        What is said where only one key is missing.
    """
    return PydanticCustomError(MISSING_KEY, "{sentence}", {"keys": keys, "sentence": sentence})


_Description = TypeVar("_Description")
_reader: Callable[[Any], TypeAdapter[Any]] = cache(TypeAdapter)


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
    description : type of BaseModel or dataclass
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
        return cast(_Description, _reader(description).validate_python(content))
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
    unknown = [item for item in found if item["type"] in ("extra_forbidden", "unexpected_keyword_argument")]
    if unknown:
        places = [shown(_written(item["loc"], first_index)) for item in unknown]
        are = "are not keys" if len(places) > 1 else "is not a key"
        them = "them or correct their" if len(places) > 1 else "it or correct its"
        return f"{listing(places)} {are} of {what}; remove {them} spelling"
    missing = [item for item in found if item["type"] in ("missing", "missing_argument", MISSING_KEY)]
    places = [shown(place) for item in missing for place in _missing_places(item, first_index)]
    if len(places) > 1 or (missing and missing[0]["type"] != MISSING_KEY):
        return f"{listing(places)} {'are' if len(places) > 1 else 'is'} missing"
    found = missing or found
    first = found[0]
    place = _written(first["loc"], first_index)
    before = f"{place}: " if place else ""
    if first["type"] == MISSING_KEY:
        return f"{before}{first['ctx']['sentence']}"
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


def _missing_places(item: ErrorDetails, first_index: int) -> list[str]:
    """Return the places of the keys that are missing by one error of pydantic."""
    place = _written(item["loc"], first_index)
    if item["type"] != MISSING_KEY:
        return [place]
    return [f"{place}.{key}".lstrip(".") for key in item["ctx"]["keys"]]


def _written(location: tuple[int | str, ...], first_index: int) -> str:
    """Return a place as the file has it, without pydantic's names of types."""
    text = ""
    for part in location:
        if isinstance(part, int):
            text += f"[{part + first_index}]"
        elif not re.search(r"[^\w]|^constrained", part):
            text += f".{part}" if text else part
    return text
