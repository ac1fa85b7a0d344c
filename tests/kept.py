"""What runs of the tests share in the user's cache folder: compiled loops, reduced models and packed FMUs.

Everything lies under a hash of what it is made from, so that another clone finds it and a changed source
never meets it.
"""

import hashlib
import os
import pickle
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from importlib.metadata import distributions
from pathlib import Path
from typing import Any, TypeVar

from fe.reduction.built_once import built_once, cache_folder
from fe.runtime.reduced import ReducedModel
from fmu_asset.packing.structure_fmu import build_fmu
from reporting.files import atomic_write_bytes

ROOT = Path(__file__).parents[1]
FOLDER = cache_folder() / "tests"  # now: tests change where the cache is
FE = (ROOT / "reporting", ROOT / "fe")
"""What a reduced model is made from; docs/architecture.md says that the packages import no other."""
FMU = (*FE, ROOT / "fmu_asset")
"""What an FMU is packed from."""
DAYS = 14
"""What nobody read for so long is removed."""

# The product has numba keep loops in folders named by the content of their sources, which all clones and all
# processes that tests start share. Before numba is imported.
os.environ.setdefault("NUMBA_CACHE_DIR", str(FOLDER / "compiled"))
os.environ.setdefault("NUMBA_OPT", "1")  # compiles in three quarters of the time, and our loops are as fast

_Made = TypeVar("_Made")


def kept(name: str, build: Callable[[], _Made], places: tuple[Path, ...], inputs: object = None) -> _Made:
    """Return what `build` makes of files and inputs; of all processes and runs one makes it.

    Parameters
    ----------
    name : str
        Begins the name of its file.
    build : callable
        Makes something that can be pickled, from nothing but `places` and `inputs`.
    places : tuple of Path
        Files and folders that it is made from.
    inputs : object
        What else it is made from; its `repr` says all.
    """
    digest = hashlib.sha256(_surroundings() + repr(inputs).encode())
    for place in places:
        digest.update(_digest(place))
    path = FOLDER / f"{name}-{digest.hexdigest()[:32]}.pickle"

    def load() -> _Made:
        try:
            made: _Made = pickle.loads(path.read_bytes())
        except (pickle.UnpicklingError, EOFError) as error:
            raise OSError(f"{path} is torn") from error
        return made

    return built_once(path, load, build, lambda made: atomic_write_bytes(path, pickle.dumps(made)))


def packed(path: Path, pack: Callable[[], object], places: tuple[Path, ...], inputs: object) -> Path:
    """Return the FMU `path`, which `pack` writes unless it is kept; parameters as of `kept`."""

    def content() -> bytes:
        pack()
        return path.read_bytes()

    path.write_bytes(kept(path.stem, content, places, inputs))
    return path


def exported(script: Path) -> Path:
    """Return the FMU that pythonfmu packs of a script, beside it, as its users do."""
    path = script.with_suffix(".fmu")
    words = [sys.executable, "-m", "pythonfmu", "build", "-f", script.name]
    pack = partial(subprocess.run, words, cwd=script.parent, check=True, capture_output=True)
    return packed(path, pack, (script,), None)


def compiled_wing(model: ReducedModel, path: Path, **options: Any) -> Path:
    """Return the compiled FMU of a wing or structure, packed with further options of `build_fmu`."""
    options = {"kind": "compiled", **options}
    inputs = (hashlib.sha256(model.to_bytes()).hexdigest(), options)
    return packed(path, lambda: build_fmu(model, path, **options), FMU, inputs)


def share_machine_code(folder: Path) -> None:
    """Copy compiled loops to where the tests of this run find them, so that nobody compiles them again.

    numba creates the folder of a module's loops when it is imported. Only a folder that is still empty can be
    replaced, which needs one call of the operating system; so nobody finds half of the loops.
    """
    shared = Path(os.environ["NUMBA_CACHE_DIR"])
    for loops_of_module in folder.iterdir():
        copy = shared / f"{loops_of_module.name}.{os.getpid()}"
        shutil.copytree(loops_of_module, copy)
        try:
            copy.rename(shared / loops_of_module.name)
        except OSError:  # another process has compiled loops of this module
            shutil.rmtree(copy)


@cache  # of a hundred files, and asked for with each thing that is kept
def _digest(place: Path) -> bytes:
    """Return the digest of names and contents of a file, or of all files of a folder."""
    digest = hashlib.sha256()
    for file in sorted(place.rglob("*")) if place.is_dir() else (place,):
        if file.is_file() and "__pycache__" not in file.parts:
            content = file.read_bytes()
            digest.update(f"{file.relative_to(place.parent).as_posix()} {len(content)}\n".encode())
            digest.update(content)
    return digest.digest()


@cache
def _surroundings() -> bytes:
    """Return what everything depends on: machine, interpreter, packages, C compiler."""
    compiler = b""
    with suppress(OSError):
        compiler = subprocess.run(["cc", "--version"], capture_output=True, check=False).stdout
    packages = sorted((item.name, item.version) for item in distributions())
    return repr((platform.platform(), platform.python_version(), packages, compiler)).encode()


def remove_old() -> None:
    """Remove what nobody read for two weeks."""
    for file in FOLDER.rglob("*"):
        with suppress(OSError):  # another run removes it, too
            if file.is_file() and file.stat().st_atime < time.time() - DAYS * 86400.0:
                file.unlink()
