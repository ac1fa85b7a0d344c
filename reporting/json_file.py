"""The one reader of JSON: whatever is wrong with a file becomes one sentence of the caller's exception."""

import json
from pathlib import Path
from typing import Any

from reporting.text_file import check_nesting, read_text, too_deep


def read_json(path: Path | str, error: type[Exception], *, what: str = "file") -> Any:
    """Return the content of a JSON file; parameters as `reporting.toml_file.read_toml`.

    Raises
    ------
    error
        The file is not there, cannot be read, is not UTF-8 or not JSON, or is nested too deeply.
    """
    subject = f"The {what} {path}"
    text = read_text(path, error, what=what)
    try:
        content = json.loads(text)
    except ValueError as cause:
        raise error(f"{subject} is not valid JSON: {cause}.") from cause
    except RecursionError:
        raise error(too_deep(subject)) from None
    check_nesting(content, subject, error)
    return content
