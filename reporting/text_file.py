"""Text files of users: UTF-8 with or without a byte order mark."""

from pathlib import Path

DEEPEST_NESTING = 32
"""Deepest nesting of tables and lists in a document; no format of ours needs a third of it."""


def read_text(
    path: Path | str, error: type[Exception], *, what: str = "file", otherwise: str | None = None
) -> str:
    """Return the text of a file without its byte order mark.

    Parameters
    ----------
    path : Path or str
        The path of the file.
    what : str
        What the file should be, for the message: "wing design".
    otherwise : str, optional
        The encoding of a file that is not UTF-8.

    Raises
    ------
    error
        If the file does not exist, cannot be read, or is not text in UTF-8.
    """
    content = read_bytes(path, error, what=what)
    return decoded(content, f"The {what} {path}", error, otherwise)


def read_bytes(path: Path | str, error: type[Exception], *, what: str = "file") -> bytes:
    """Return the content of a file; raises `error` as `read_text`."""
    try:
        return Path(path).read_bytes()
    except OSError as cause:
        raise error(f"The {what} {path} cannot be read: {cause.strerror or cause}.") from cause
    except ValueError:  # the path holds a zero byte
        raise error(f"{str(path)!r} is not a name of a {what}.") from None


def decoded(
    content: bytes, subject: str, error: type[Exception], otherwise: str | None = None
) -> str:
    """Return bytes as text.

    Parameters
    ----------
    content : bytes
        The content of a file.
    subject : str
        The beginning of the message, such as "The wing design wing.toml".
    otherwise : str, optional
        The encoding of bytes that are not UTF-8.

    Raises
    ------
    error
        If the bytes are not text in UTF-8.
    """
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as cause:
        if otherwise is None:
            raise error(
                f"{subject} is not text in UTF-8 ({cause.reason} at byte {cause.start + 1}): "
                "save it as UTF-8."
            ) from cause
        text = content.decode(otherwise)
    if "\0" in text:
        raise error(f"{subject} is not text: it holds a zero byte; save it as UTF-8.")
    return text


def check_nesting(content: object, subject: str, error: type[Exception]) -> None:
    """Refuse a document nested deeper than `DEEPEST_NESTING`; it would exhaust Python's stack.

    Parameters
    ----------
    content : object
        The dictionaries and lists of a parsed document.
    subject : str
        The beginning of the message.
    """
    level = [content]
    for _ in range(DEEPEST_NESTING):
        next_level: list[object] = []
        for node in level:
            if isinstance(node, dict):
                next_level.extend(node.values())
            elif isinstance(node, list):
                next_level.extend(node)
        level = next_level
        if not level:
            return
    raise error(too_deep(subject))


def too_deep(subject: str) -> str:
    """Return the message for a document that is nested too deeply."""
    return f"{subject} is nested deeper than {DEEPEST_NESTING} tables or lists within each other."
