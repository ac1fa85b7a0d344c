r"""Points in the line protocol of InfluxDB, read and written.

A line is ``measurement[,tag=value...] field=value[,field=value...] [timestamp]``. A backslash
escapes the characters that separate: comma and blank in the measurement; these and ``=`` in tags
and names of fields; ``"`` and ``\`` in a text, which stands in double quotes. Before any other
character a backslash is literal. A number is floating-point, ``12i`` an integer, ``12u`` an
unsigned one; ``t``, ``T``, ``true``, ``True``, ``TRUE`` and the like with f are Booleans. A line
that begins with ``#`` is a comment. (InfluxData, *Line protocol reference*.)
"""

import re
from collections.abc import Mapping

from twin_master.feeds.points import FieldValue, Point

# No character is taken back once it is matched (`++`), so that an escaped one never separates
_MEASUREMENT = re.compile(r"(?:\\[, ]|[^, \n])++")
_NAME = re.compile(r"(?:\\[,= ]|[^,= \n])++")
_TEXT = re.compile(r'"((?:\\["\\]|[^"])*+)"')
_BARE_VALUE = re.compile(r"[^, \n]++")
_BLANKS = re.compile(r" +")
_TIMESTAMP = re.compile(r"[+-]?\d+")
_FLOAT = re.compile(r"[+-]?(?:(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?|nan|inf(?:inity)?)", re.IGNORECASE)
_INTEGER = re.compile(r"([+-]?\d+)i")
_UNSIGNED = re.compile(r"(\d+)u")
_TRUTH_VALUES = dict.fromkeys(("t", "T", "true", "True", "TRUE"), True) | dict.fromkeys(
    ("f", "F", "false", "False", "FALSE"), False
)
_LOOK = re.compile(r'\s*(?:#|[^\s{"\[#,][^"\n]*? (?:\\.|[^\s=,\\])+=)')
"""The beginning of a text in line protocol: a comment, or a measurement, a blank, and `name=`."""
_EQUALS_SIGN = re.compile("=")
_END = re.compile(r"\Z")
_SHOWN_CHARACTERS = 40


def looks_like_line_protocol(text: str) -> bool:
    """Return whether a text begins like line protocol, unlike JSON and CSV."""
    return _LOOK.match(text) is not None


class _Scanner:
    """A line that is read from left to right."""

    def __init__(self, line: str) -> None:
        self._line = line
        self._position = 0

    def take(self, pattern: re.Pattern[str], meaning: str) -> re.Match[str]:
        """Return the next piece of the line; raise an error unless it matches the pattern."""
        match = pattern.match(self._line, self._position)
        if match is None:
            remaining = self._line[self._position :][:_SHOWN_CHARACTERS]
            found = f"`{remaining}` was given" if remaining else "the line ends"
            raise ValueError(f"{meaning} is expected at column {self._position + 1}, but {found}")
        self._position = match.end()
        return match

    def skip(self, character: str) -> bool:
        """Skip a character if it is the next one; return whether it is."""
        if self.is_before(character):
            self._position += 1
            return True
        return False

    def is_before(self, character: str) -> bool:
        """Return whether a character is the next one."""
        return self._line.startswith(character, self._position)

    def skip_blanks(self) -> bool:
        """Skip blanks; return whether there are any."""
        match = _BLANKS.match(self._line, self._position)
        if match is not None:
            self._position = match.end()
        return match is not None

    @property
    def is_at_end(self) -> bool:
        """Whether the whole line is read."""
        return self._position == len(self._line)


def parse_line(line: str) -> Point | None:
    """Return the point in a line of line protocol; None if the line is empty or a comment.

    Parameters
    ----------
    line : str
        The line, with or without its line feed. Its timestamp keeps the unit of the writer.

    Raises
    ------
    ValueError
        If the line is not in line protocol.
    """
    line = line.strip(" \r\n")
    if not line or line.startswith("#"):
        return None
    scanner = _Scanner(line)
    measurement = _unescape(scanner.take(_MEASUREMENT, "a measurement")[0], ", ")
    tags: dict[str, str] = {}
    while scanner.skip(","):
        name = _take_name(scanner, "the name of a tag")
        _refuse_repetition(name, tags)
        tags[name] = _unescape(scanner.take(_NAME, "the value of a tag")[0], ",= ")
    scanner.take(_BLANKS, "a blank before the fields")
    fields: dict[str, FieldValue] = {}
    while True:
        name = _take_name(scanner, "the name of a field")
        _refuse_repetition(name, fields)
        fields[name] = _take_value(scanner)
        if not scanner.skip(","):
            break
    timestamp = None
    if scanner.skip_blanks():
        timestamp = int(scanner.take(_TIMESTAMP, "a timestamp")[0])
    if not scanner.is_at_end:
        scanner.take(_BLANKS, "a blank, a comma or the end of the line")
        scanner.take(_END, "the end of the line")
    return Point(measurement, fields, tags, timestamp)


def _take_name(scanner: _Scanner, meaning: str) -> str:
    """Return the next name of a line, and skip the `=` after it."""
    name = _unescape(scanner.take(_NAME, meaning)[0], ",= ")
    scanner.take(_EQUALS_SIGN, "`=`")
    return name


def _refuse_repetition(name: str, values: Mapping[str, object]) -> None:
    """Raise an error if a line has already a value for a name."""
    if name in values:
        raise ValueError(f"`{name[:_SHOWN_CHARACTERS]}` is given twice")


def _take_value(scanner: _Scanner) -> FieldValue:
    """Return the next value of a field."""
    if scanner.is_before('"'):
        text = scanner.take(_TEXT, "a text in double quotes")[1]
        return re.sub(r'\\(["\\])', r"\1", text)
    text = scanner.take(_BARE_VALUE, "the value of a field")[0]
    if text in _TRUTH_VALUES:
        return _TRUTH_VALUES[text]
    integer = _INTEGER.fullmatch(text) or _UNSIGNED.fullmatch(text)
    if integer is not None:
        return int(integer[1])
    if _FLOAT.fullmatch(text) is None:
        raise ValueError(
            f"`{text[:_SHOWN_CHARACTERS]}` is not a value: a text stands in double quotes"
        )
    return float(text)


def _unescape(text: str, characters: str) -> str:
    """Return a name without the backslashes before some characters."""
    return re.sub(rf"\\([{re.escape(characters)}])", r"\1", text)


def write_line(point: Point) -> str:
    """Return a point as a line of line protocol, without a line feed.

    Raises
    ------
    ValueError
        If it has no fields, or a name that line protocol cannot express: an empty one, one with a
        line feed, or one with a backslash at its end or before an escaped character.
    """
    if not point.fields:
        raise ValueError("a point needs at least one field")
    series = [_escape(point.measurement, ", ")]
    for name, tag in point.tags.items():
        series.append(f"{_escape(name, ',= ')}={_escape(tag, ',= ')}")
    values = []
    for name, value in point.fields.items():
        values.append(f"{_escape(name, ',= ')}={_value_text(value)}")
    line = f"{','.join(series)} {','.join(values)}"
    if point.timestamp is None:
        return line
    return f"{line} {int(point.timestamp)}"


def _escape(name: str, characters: str) -> str:
    """Return a name with a backslash before some characters."""
    is_ambiguous = re.search(rf"\\(?:[{re.escape(characters)}]|\Z)|[\r\n]", name)
    if not name or is_ambiguous:
        raise ValueError(f"{name!r:.60} cannot be a name in line protocol")
    return re.sub(rf"([{re.escape(characters)}])", r"\\\1", name)


def _value_text(value: FieldValue) -> str:
    """Return the value of a field in line protocol."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return f"{value}i"
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, str) and not re.search(r"[\r\n]", value):
        escaped = re.sub(r'(["\\])', r"\\\1", value)
        return f'"{escaped}"'
    raise ValueError(f"{value!r:.60} cannot be a value in line protocol")
