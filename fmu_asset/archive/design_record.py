"""Of which design an FMU of ours was made, as a small file inside it."""

import json
import os
import zipfile

DESIGN_RECORD = "design.json"
"""Its name in the folder `resources`."""
_LONGEST = 10_000


def design_record(design_hash: str) -> bytes:
    """Return the content of the file."""
    return (json.dumps({"design_hash": design_hash}) + "\n").encode()


def packed_design_hash(path: str | os.PathLike[str]) -> str:
    """Return the hash of the design that an FMU was made of; empty where it does not tell."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open(f"resources/{DESIGN_RECORD}") as file:
            found = json.loads(file.read(_LONGEST))["design_hash"]
    except (OSError, KeyError, TypeError, ValueError, RuntimeError, zipfile.BadZipFile):
        return ""
    return found if isinstance(found, str) else ""
