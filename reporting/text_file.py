"""Text files of users: UTF-8 with or without a byte order mark, and one sentence for what is none."""

from pathlib import Path

from reporting.sentences import said

DEEPEST_NESTING = 32
"""Tables and lists within each other that a document may hold; no format of this project needs a third."""


def read_text(
    path: Path | str, error: type[Exception], *, what: str = "file", otherwise: str | None = None
) -> str:
    """Return the text of a file without its byte order mark.

    Parameters
    ----------
    path : Path or str
        The file.
    error : type of Exception
        What is raised, with one sentence.
    what : str
        What the file is to be, for the sentence: "wing design".
    otherwise : str, optional
        The encoding to take where the file is not UTF-8.

    Raises
    ------
    error
        The file is not there, cannot be read, or is not text in UTF-8.
    """
    return decoded(read_bytes(path, error, what=what), f"The {what} {path}", error, otherwise)


def read_bytes(path: Path | str, error: type[Exception], *, what: str = "file") -> bytes:
    """Return the content of a file; raises `error` as `read_text`."""
    try:
        return Path(path).read_bytes()
    except OSError as cause:
        raise error(f"The {what} {path} cannot be read: {cause.strerror or cause}.") from cause
    except ValueError:
        raise error(f"{str(path)!r} is no name of a {what}.") from None


def decoded(content: bytes, subject: str, error: type[Exception], otherwise: str | None = None) -> str:
    """Return bytes as text; `subject` begins the sentence of the `error` where they are not UTF-8."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as cause:
        if otherwise is None:
            byte = cause.start + 1
            raise error(said("text.encoding", subject=subject, cause=cause, byte=byte)) from cause
        text = content.decode(otherwise)
    if "\0" in text:
        raise error(f"{subject} is not text: it holds a zero byte; save it as UTF-8.")
    return text


def check_nesting(content: object, subject: str, error: type[Exception]) -> None:
    """Refuse a document deeper than `DEEPEST_NESTING`: what is read from it would exhaust Python's stack."""
    level: list[object] = [content]
    for _ in range(DEEPEST_NESTING):
        level = [
            item
            for node in level
            if isinstance(node, dict | list)
            for item in (node.values() if isinstance(node, dict) else node)
        ]
        if not level:
            return
    raise error(too_deep(subject))


def too_deep(subject: str) -> str:
    """Return the sentence for a document that is nested too deeply."""
    return f"{subject} is nested deeper than {DEEPEST_NESTING} tables or lists within each other."
