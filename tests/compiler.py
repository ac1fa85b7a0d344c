"""A C compiler that keeps objects: `compiler.py FOLDER COMMAND [ARGUMENT]...`.

Sources of our FMUs are the same in most of them. An object is kept by the content of its source, of the
headers beside it and of the command; what makes no shared library goes to the compiler as it is.
"""

import hashlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

folder, *command = sys.argv[1:]
units = [Path(word) for word in command if word.endswith(".c")]
if "-shared" not in command or len(units) < 2 or any(unit.name != str(unit) for unit in units):
    os.execvp(command[0], command)


def texts(file: Path, seen: dict[str, bytes]) -> dict[str, bytes]:
    """Return a source and the headers beside it that it takes in."""
    if file.name not in seen and file.is_file():
        seen[file.name] = file.read_bytes()
        for header in re.findall(rb'#include "(.*)"', seen[file.name]):
            texts(Path(header.decode()), seen)
    return seen


Path(folder).mkdir(parents=True, exist_ok=True)
flags = [word for word in command[1:] if word.startswith("-") and word[:2] not in ("-o", "-l")]
same, objects = repr((command[0], Path(command[0]).stat().st_mtime_ns, flags)), {}
for unit in units:
    content = f"{same} {sorted(texts(unit, {}).items())}"
    objects[unit.name] = Path(folder) / f"{hashlib.sha256(content.encode()).hexdigest()[:32]}.o"
missing = [name for name, kept in objects.items() if not kept.is_file()]
if missing and (failed := subprocess.run([command[0], *flags, "-c", *missing], check=False).returncode):
    sys.exit(failed)
for name in missing:
    made = objects[name].with_suffix(f".{os.getpid()}")
    shutil.copy(Path(name).with_suffix(".o"), made)
    made.replace(objects[name])  # of two processes that make it one wins
os.execvp(command[0], [str(objects.get(word, word)) for word in command])
