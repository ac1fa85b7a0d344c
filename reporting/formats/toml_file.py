"""The one reader of TOML, and the validation of its tables.

A fault of a file is one sentence of the caller's exception.

Messages name the location in the file, what it holds and what was expected.
"""

import json
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Self, TypeAlias, TypeVar, cast

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError

from reporting.choices import nearest_word
from reporting.formats import known_keys
from reporting.text_file import DEEPEST_NESTING, check_nesting, decoded, read_text, too_deep
from reporting.words import counted, is_or_are, listing, small

# Possessive quantifiers (`*+`) keep the time of these patterns linear in the length of the text.
_KEY_PART = r"""(?:[\w-]++|"(?:[^"\\\n]++|\\.)*+"?+|'[^'\n]*+'?+)"""
_COMMENT = r"#[^\n]*+"
_LONG_TEXT = r'''"""(?:[^"\\]++|\\[\s\S]|"(?!""))*+(?:"""|\Z)'''
_LONG_LITERAL_TEXT = r"""'''(?:[^']++|'(?!''))*+(?:'''|\Z)"""
_DOTTED_KEY = rf"({_KEY_PART}(?:[ \t]*+\.[ \t]*+{_KEY_PART})*+)"
_KEYS = re.compile(f"{_COMMENT}|{_LONG_TEXT}|{_LONG_LITERAL_TEXT}|{_DOTTED_KEY}")
"""Comments and texts of several lines, which are skipped, or a dotted key, which is group 1."""

TomlTable: TypeAlias = dict[str, Any]
"""A table of TOML. Its type is open, because the reader of a file checks what the file holds."""

LONGEST_ARRAY = 90
"""Largest number of characters in the entries of an array that is written in one line."""

_TYPE_NAME = re.compile(r"[^\w]|^constrained")
"""What the names of types have that pydantic adds to locations, such as "list[float]"."""
_LONGEST_SHOWN_VALUE = 60  # in a message, in characters


def read_toml(path: Path | str, error: type[Exception], *, what: str = "file") -> TomlTable:
    """Return the content of a TOML file.

    Parameters
    ----------
    path : Path or str
        The file; UTF-8, with or without a byte order mark.
    what : str
        What the file should be, for the message: "wing design".

    Raises
    ------
    error
        If the file does not exist, cannot be read, is not UTF-8 or not TOML, is nested too deeply,
        or holds an integer that does not fit in 64 bits.
    """
    return parse_toml(read_text(path, error, what=what), f"The {what} {path}", error)


def parse_toml(content: bytes | str, source: str, error: type[Exception]) -> TomlTable:
    """Parse a TOML text, and refuse what is nested too deeply or has too large integers.

    Parameters
    ----------
    source : str
        Where the text is from; begins the message.
    error : type of Exception
        The exception to raise, for the reasons of `read_toml`.
    """
    text = decoded(content, source, error) if isinstance(content, bytes) else content
    if _has_too_long_key(text):
        raise error(too_deep(source))
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as cause:
        raise error(f"{source} is not valid TOML: {cause}.") from cause
    except RecursionError:
        raise error(too_deep(source)) from None
    except ValueError:  # Python turns no text of more than 4,300 digits into an integer
        raise error(
            f"{source} holds an integer of thousands of digits, but TOML allows 64 bits."
        ) from None
    check_nesting(document, source, error)
    _check_integers(document, "", source, error)
    return document


def _has_too_long_key(text: str) -> bool:
    """Return whether a text has a dotted key with more parts than tables may be nested.

    Such a key is refused before parsing, since the time that `tomllib` takes for a dotted key grows
    with the square of the number of its parts.
    """
    if all(line.count(".") < DEEPEST_NESTING for line in text.split("\n")):
        return False
    for match in _KEYS.finditer(text):
        key = match[1] or ""
        # Points inside quotes separate no parts; the count of points is the faster test.
        has_many_points = key.count(".") >= DEEPEST_NESTING
        if has_many_points and len(re.findall(_KEY_PART, key)) > DEEPEST_NESTING:
            return True
    return False


def _check_integers(
    node: dict[str, object] | list[object], location: str, source: str, error: type[Exception]
) -> None:
    """Refuse integers beyond 64 bits in a part of a document, which has the given location.

    TOML refuses them (its specification, "Integer"), but `tomllib` does not.
    """
    entries = list(node.items()) if isinstance(node, dict) else list(enumerate(node, start=1))
    for key, value in entries:
        if not isinstance(value, int | dict | list):
            continue
        if isinstance(node, dict):
            location_of_value = f"{location}.{key}".lstrip(".")
        else:
            location_of_value = f"{location}[{key}]"
        if not isinstance(value, int):
            _check_integers(value, location_of_value, source, error)
        elif not -(2**63) <= value < 2**63:
            raise error(
                f"{source}: `{location_of_value}` is an integer of {value.bit_length()} bits, but "
                "TOML allows 63 in addition to the sign."
            )


def toml_text(content: Mapping[str, object]) -> str:
    """Return plain data as TOML, from which `parse_toml` returns the same data.

    Values that are None are left out, and do not come back. A table inside a table is written in
    one line, a long array in several.
    """
    values: dict[str, object] = {}
    tables: dict[str, dict[str, object]] = {}
    arrays_of_tables: dict[str, list[dict[str, object]]] = {}
    for key, value in content.items():
        if isinstance(value, dict):
            tables[key] = value
        elif isinstance(value, list) and value and all(isinstance(row, dict) for row in value):
            arrays_of_tables[key] = value
        else:
            values[key] = value
    sections = [_key_value_lines(values)]
    for key, table in tables.items():
        sections.append(f"[{_toml_key(key)}]\n{_key_value_lines(table)}")
    for key, rows in arrays_of_tables.items():
        for row in rows:
            sections.append(f"[[{_toml_key(key)}]]\n{_key_value_lines(row)}")
    return "\n".join(section for section in sections if section)


def _key_value_lines(table: dict[str, object]) -> str:
    """Return a line "key = value" for each value that is not None."""
    return "".join(f"{pair}\n" for pair in _key_value_pairs(table))


def _key_value_pairs(table: dict[str, object]) -> list[str]:
    """Return "key = value" for each value that is not None."""
    return [
        f"{_toml_key(key)} = {toml_value(value)}"
        for key, value in table.items()
        if value is not None
    ]


def _toml_key(name: str) -> str:
    """Return a key as TOML writes it: bare if possible, else in quotes."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else toml_value(name)


def toml_value(value: object) -> str:
    """Return a value as text of TOML; NumPy's numbers are written as those of Python."""
    if isinstance(value, str):
        # The escapes of JSON are those of TOML, except for DEL.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return _toml_array([toml_value(entry) for entry in value])
    if isinstance(value, dict):
        return f"{{ {', '.join(_key_value_pairs(value))} }}"
    if isinstance(value, float):
        return repr(float(value))
    return repr(value)


def _toml_array(entries: list[str]) -> str:
    """Return an array of TOML texts, in several lines if it is long."""
    if sum(len(entry) for entry in entries) > LONGEST_ARRAY:
        lines = "".join(f"    {entry},\n" for entry in entries)
        return f"[\n{lines}]"
    return f"[{', '.join(entries)}]"


_EXPECTED_TYPES = {
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
"""What a file should hold, by pydantic's type of error, where its message has words of Python."""


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0)]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0)]
Name = Annotated[str, Field(min_length=1, max_length=200)]


Check = tuple[object, str]
"""Whether a check of a table has failed (any true value), and the message that is then raised."""


class Section(BaseModel):
    """The model of a table in a file; it refuses unknown keys, and converts no text to a number."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        strict=True,
        use_attribute_docstrings=known_keys.TEXTS_ARE_READ,
    )

    def checks(self) -> Iterator[Check]:
        """Yield (has failed, message) of each check of the table.

        The message of the first check that has failed is raised, and later checks are not
        evaluated. So a check may rely on those before it.
        """
        yield from ()

    @model_validator(mode="after")
    def _refuse_failed_checks(self) -> Self:
        for has_failed, message in self.checks():
            if has_failed:
                raise ValueError(message)
        return self


MISSING_KEY = "missing_key"
"""Type of the errors of pydantic that `missing_keys` returns."""


def missing_keys(keys: list[str], sentence: str) -> PydanticCustomError:
    """Return the error with which a validator reports missing keys.

    If several keys of a file are missing, one message names them all.

    Parameters
    ----------
    keys : list of str
        The keys, relative to the table that is validated.
    sentence : str
        The message if only one key of the file is missing.
    """
    return PydanticCustomError(MISSING_KEY, "{sentence}", {"keys": keys, "sentence": sentence})


_Model = TypeVar("_Model")


_validator_of: Callable[[type], TypeAdapter[object]] = cache(TypeAdapter)
"""Makes the validator of a model once: pydantic takes long to make one."""


def validate(
    model: type[_Model],
    content: object,
    source: str,
    error: type[Exception],
    *,
    what: str,
    first_index: int = 1,
    all_faults: bool = False,
) -> _Model:
    """Return the content of a file as a record of a model.

    Parameters
    ----------
    model : type of BaseModel or dataclass
        The model, which describes what the file may hold.
    content : object
        The content of the file.
    source : str
        The name of the file; begins the message.
    what : str
        What the file describes, with its article, for the message: "a lumped model".
    first_index : int
        The number of the first entry of a list in messages.
    all_faults : bool
        Whether the message states all faults, instead of the one that helps the user most.

    Raises
    ------
    error
        If the content does not fit the model. The message states the file, the location in it, what
        is there and what is expected.
    """
    try:
        record = _validator_of(model).validate_python(content)
    except ValidationError as cause:
        if all_faults:
            message = _message_of_all_faults(cause, model, what, first_index)
        else:
            message = _validation_message(cause, model, what, first_index)
        full_stop = "" if message.endswith("?") else "."
        raise error(f"{source}: {message}{full_stop}") from None
    # The validator of a model returns a record of this model.
    return cast(_Model, record)


def short_repr(value: object) -> str:
    """Return the `repr` of a value for a message, shortened if it is long."""
    try:
        text = repr(value)
    except ValueError:  # an integer of thousands of digits
        return "a number of thousands of digits"
    if len(text) <= _LONGEST_SHOWN_VALUE:
        return text
    return f"{text[: _LONGEST_SHOWN_VALUE - 3]}..."


_UNKNOWN_KEY_TYPES = ("extra_forbidden", "unexpected_keyword_argument")
_WORD_TYPES = ("literal_error", "enum")
_MISSING_KEY_TYPES = ("missing", "missing_argument", MISSING_KEY)


def _validation_message(error: ValidationError, model: object, what: str, first_index: int) -> str:
    """Return the message about the fault, among those of pydantic, that helps the user most.

    Unknown keys come first, then all missing keys, then the first value that does not fit. The
    parameters are those of `validate`.
    """
    faults = error.errors(include_url=False)
    # A misspelt key is reported twice, as unknown and as missing; the unknown key tells more.
    unknown_key_faults = [fault for fault in faults if fault["type"] in _UNKNOWN_KEY_TYPES]
    if unknown_key_faults:
        return _unknown_keys_message(unknown_key_faults, model, what, first_index)
    missing_key_faults = [fault for fault in faults if fault["type"] in _MISSING_KEY_TYPES]
    if not missing_key_faults:
        return _value_message(faults[0], first_index)
    keys = []
    for fault in missing_key_faults:
        keys += [short_repr(location) for location in _missing_locations(fault, first_index)]
    if missing_key_faults[0]["type"] == MISSING_KEY and len(keys) <= 1:
        return _value_message(missing_key_faults[0], first_index)
    return f"{listing(keys)} {is_or_are(len(keys))} missing"


def _message_of_all_faults(
    error: ValidationError, model: object, what: str, first_index: int
) -> str:
    """Return the message about all faults that pydantic found, one for each place in the file.

    A misspelt key is reported twice, as unknown and as missing. So keys that are missing in a table
    with unknown keys are left out. The parameters are those of `validate`.
    """
    faults = error.errors(include_url=False)
    unknown = [fault for fault in faults if fault["type"] in _UNKNOWN_KEY_TYPES]
    tables_with_unknown_keys = {fault["loc"][:-1] for fault in unknown}
    messages = {}
    for fault in unknown:
        messages[fault["loc"]] = _unknown_keys_message([fault], model, what, first_index)
    for fault in faults:
        location = fault["loc"]
        if fault["type"] in _MISSING_KEY_TYPES:
            if location[:-1] in tables_with_unknown_keys:
                continue
            keys = [short_repr(key) for key in _missing_locations(fault, first_index)]
            messages.setdefault(location, f"{listing(keys)} {is_or_are(len(keys))} missing")
        else:
            messages.setdefault(location, _value_message(fault, first_index))
    return "; ".join(messages.values())


def _unknown_keys_message(
    faults: list[ErrorDetails], model: object, what: str, first_index: int
) -> str:
    """Return the message about keys that the model does not have."""
    keys = [short_repr(_location_in_file(fault["loc"], first_index)) for fault in faults]
    if len(keys) > 1:
        return f"{listing(keys)} are not keys of {what}; remove them or correct their spelling"
    *table_location, key = faults[0]["loc"]
    # A key that a record has, but no file, is known; it must not be proposed in its own place.
    other_keys = {*known_keys.keys_of_table(model, tuple(table_location))} - {key}
    nearest_key = nearest_word(str(key), sorted(other_keys))
    if nearest_key is not None:
        return f"{keys[0]} is not a key of {what}; the nearest is `{nearest_key}`"
    return f"{keys[0]} is not a key of {what}; remove it or correct its spelling"


def _value_message(fault: ErrorDetails, first_index: int) -> str:
    """Return the message about a value that does not fit its model."""
    location = _location_in_file(fault["loc"], first_index)
    prefix = f"{location}: " if location else ""
    kind = fault["type"]
    if kind == MISSING_KEY:
        return f"{prefix}{fault['ctx']['sentence']}"
    if kind == "value_error":
        return f"{prefix}{fault['ctx']['error']}"
    if kind == "tuple_type" and isinstance(fault["input"], dict):
        return (
            f"there can be several of {location!r}, "
            f"so write [[{location}]] for each, not [{location}]"
        )
    if kind == "too_short":
        least = fault["ctx"]["min_length"]
        entries = counted(least, "entry", "entries")
        expectation = f"at least {entries} {is_or_are(least)} expected"
    elif kind in _EXPECTED_TYPES:
        expectation = f"{_EXPECTED_TYPES[kind]} is expected"
    else:
        expectation = small(fault["msg"])
    message = f"{prefix}{expectation}, but {short_repr(fault['input'])} was given"
    if kind in _WORD_TYPES and isinstance(fault["input"], str):
        words = re.findall(r"'([^']*)'", fault["ctx"]["expected"])
        word = nearest_word(fault["input"], words)
        return message if word is None else f"{message}; the nearest is {word!r}"
    return message


def _missing_locations(fault: ErrorDetails, first_index: int) -> list[str]:
    """Return the locations of missing keys that one fault of pydantic names."""
    location = _location_in_file(fault["loc"], first_index)
    if fault["type"] != MISSING_KEY:
        return [location]
    return [f"{location}.{key}".lstrip(".") for key in fault["ctx"]["keys"]]


def _location_in_file(location: tuple[int | str, ...], first_index: int) -> str:
    """Return a location of pydantic as messages write it, such as "tables[1].key".

    Names of types, which pydantic adds to its locations, are left out. The entries of a list are
    numbered from `first_index`.
    """
    text = ""
    for step in location:
        if isinstance(step, int):
            text += f"[{step + first_index}]"
        elif not _TYPE_NAME.search(step):
            text += f".{step}" if text else step
    return text
