"""The file `rejected.jsonl` with the refused messages of a watch."""

import json
from pathlib import Path

from reporting.files import atomic_write_text, explained_write_errors

REJECTED_NAME = "rejected.jsonl"
REJECTED_KEPT = 10_000
"""Largest number of lines in the file, so that a flood of messages does not fill the disk."""
_TEXT_CHARACTERS = 200


class RejectedFile:
    """The refused messages, one line of JSON each; a path of None writes none."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._line_count = 0

    def append(self, message_number: int, reason: str, text: str) -> None:
        """Add a refused message, unless the file is full.

        Parameters
        ----------
        message_number : int
            The number of the message in the watch, from 1.
        reason : str
            Why it was refused.
        text : str
            The text of the message; only its beginning is stored.
        """
        if self._path is None or self._line_count >= REJECTED_KEPT:
            return
        self._line_count += 1
        record = {"message": message_number, "reason": reason, "text": text[:_TEXT_CHARACTERS]}
        with (
            explained_write_errors(self._path),
            self._path.open("a", encoding="utf-8") as file,
        ):
            file.write(json.dumps(record, ensure_ascii=True) + "\n")

    def resume(self, journalled_count: int, *, feed_is_read_again: bool) -> int:
        """Drop lines that a resumed watch will write again, and a line that a kill cut off.

        Parameters
        ----------
        journalled_count : int
            The number of refused messages up to the last line of the journal.
        feed_is_read_again : bool
            Whether the messages after that line are read, and refused, again.

        Returns
        -------
        int
            The number of messages in the file that were refused after the last line of the journal.
        """
        if self._path is None or not self._path.exists():
            return 0
        lines = self._path.read_text(encoding="utf-8").splitlines(keepends=True)
        kept_lines = lines[:journalled_count] if feed_is_read_again else lines
        kept_lines = [line for line in kept_lines if line.endswith("\n")]
        self._line_count = len(kept_lines)
        if kept_lines != lines:
            atomic_write_text(self._path, "".join(kept_lines))
        return max(len(kept_lines) - journalled_count, 0)
