"""Makers of archives, changed FMUs, bindings, systems, FMUs of others, and processes."""

import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import fmpy
import pytest

from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.client.binding import Binding, parse_binding
from fmu_asset.compiled.compiler import find_compiler
from fmu_asset.coupling.structure import (
    Component,
    Connection,
    Connector,
    SystemStructure,
    expand_connection,
)
from fmu_asset.errors import FmuBuildError
from fmu_asset.worker.client import WorkerInstance
from tests.kept import packed

ROOT = Path(__file__).parents[2]
HANGS = 600.0
"""After so long [s] a test hangs."""
NEVER_ANSWERED = 2.0
"""Limit [s] of a call that an FMU never answers."""
DESCRIPTION, XML = "modelDescription.xml", (".xml", ".ssd", ".ssv", ".ssm")


def has_compiler() -> bool:
    """Return whether this machine has a C compiler."""
    try:
        find_compiler()
    except FmuBuildError:
        return False
    return True


needs_compiler = pytest.mark.skipif(
    not has_compiler(), reason="there is no C compiler, which compiled FMUs are built with"
)


def limit_call_without_answer(
    patch: pytest.MonkeyPatch, name: str, number: int = 1, since: str = "initialise"
) -> None:
    """Give the one call that an FMU never answers `NEVER_ANSWERED`, and all others `HANGS`.

    So no sound call is judged by the clock of a machine that is busy.

    Parameters
    ----------
    patch : MonkeyPatch
        Ends the limits.
    name : str
        The kind of the call: "open", "initialise", "step", "run", ...
    number : int
        Its number among the calls of this kind to one worker; the first is 1.
    since : str
        The kind of the call with which counting begins anew.
    """
    ask = WorkerInstance._ask
    count: WeakKeyDictionary[WorkerInstance, int] = WeakKeyDictionary()
    last_call: WeakKeyDictionary[WorkerInstance, str] = WeakKeyDictionary()

    def ask_and_count(worker: WorkerInstance, kind: Any, call: str, content: Any) -> None:
        if call == since:
            count[worker] = 0
        if call == name and worker in count:
            count[worker] += 1
        last_call[worker] = call
        ask(worker, kind, call, content)

    def limit(worker: WorkerInstance) -> float:
        has_no_answer = last_call[worker] == name and count.get(worker) == number
        return NEVER_ANSWERED if has_no_answer else HANGS

    patch.setattr(WorkerInstance, "_ask", ask_and_count)
    patch.setattr(WorkerInstance, "_time_limit", limit)


def tables(test: str, name: str = "refused") -> dict[str, Any]:
    """Return the tables of a TOML file beside a test, by the test's `__file__`."""
    return tomllib.loads(Path(test).with_name(f"{name}.toml").read_text("utf-8"))


def members(path: Path) -> dict[str, bytes]:
    """Return the contents of an archive by name."""
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def archive_of(path: Path, contents: Mapping[str, str | bytes]) -> Path:
    """Write an archive; the inverse of `members`."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in contents.items():
            archive.writestr(
                zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED
            )  # equal each time
    return path


def edited(archive: Path, target: Path, *changes: tuple[str, str]) -> Path:
    """Write a copy of an FMU, or of an SSP file, with texts of its XML files replaced."""
    contents = members(archive)
    for old, new in changes:
        there = [name for name in contents if name.endswith(XML) and old.encode() in contents[name]]
        assert there
        contents |= {name: contents[name].replace(old.encode(), new.encode()) for name in there}
    return archive_of(target, contents)


def parameters_of(fmu: Path) -> dict[str, float]:
    """Return the parameters of an FMU with the start values that it declares."""
    return {
        v.name: float(v.start or 0.0) for v in read_fmu(fmu).variables if v.causality == "parameter"
    }


def run_python(program: str, *arguments: object, **options: Any) -> str:
    """Return what a program, run in a process of its own, writes; it must end well."""
    words = [sys.executable, "-c", program, *map(str, arguments)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


Ends = Mapping[str, tuple[Any, Any]]


def bound(step_size: float, observation: Ends, **roles: Any) -> Binding:
    """Return a binding, given variable, unit and perhaps range of each name in each role.

    `header` has further keys; `port` is a table as in the file.
    """
    header = {"name": "bound", "step_size": step_size, **roles.pop("header", {})}
    parts: dict[str, Any] = {"port": roles.pop("port")} if "port" in roles else {}
    keys = "variable", "unit", "minimum", "maximum"
    for role, ends in roles.items():
        parts[role] = {name: dict(zip(keys, end, strict=False)) for name, end in ends.items()}
    observed = {
        name: {"variables": names, "unit": unit} for name, (names, unit) in observation.items()
    }
    return parse_binding({"binding": header, "observation": observed, **parts})


def changed(
    binding: Binding, *, header: Mapping[str, object] | None = None, **tables: Any
) -> Binding:
    """Return a binding with further keys of its header, and some tables replaced."""
    record = binding.model_dump(exclude_none=True, mode="json")
    return parse_binding(record | {"binding": record["binding"] | dict(header or {})} | tables)


def system(
    components: Sequence[Component], connections: Sequence[tuple[str, str]], name: str = "test"
) -> SystemStructure:
    """Return a system; ends without a dot become connectors."""
    names = [component.name for component in components]
    joined: list[Connection] = []
    for source, target in connections:
        joined += expand_connection(source, target, names)
    connectors = dict.fromkeys(
        [Connector(c.target.variable, "output") for c in joined if not c.target.component]
        + [Connector(c.source.variable, "input") for c in joined if not c.source.component]
    )
    return SystemStructure(name, tuple(components), tuple(connectors), tuple(joined))


def watch(
    *names: str, step_size: float = 1.0, inputs: Sequence[str] = (), **header: object
) -> Binding:
    """Return a binding that observes ends of a system, all without unit."""
    control = {name: (name, "1") for name in inputs}
    return bound(
        step_size, {"all": (list(names), "1")}, control=control, header={"name": "watch", **header}
    )


# ---------------------------------------------------------------- others' FMUs

FOREIGN = Path(__file__).with_name("foreign")
MODELS = ["lag1", "room2", "fixed2", "array3", "ball2", "decay1", "swing3", "hostile2"]
"""One of each version and interface."""
HEADERS = Path(fmpy.__file__).parent / "c-code"


class Workshop:
    """Builds small FMUs of FMI 1, 2 and 3 from C, as tools of others export them, each model once.

    Parameters
    ----------
    folder : Path
        Where the FMUs are put.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._built: dict[tuple[str, tuple[str, ...]], Path] = {}

    def __call__(self, model: str, *defines: str) -> Path:
        """Return the FMU of a model, such as `ball2`, compiled with preprocessor definitions."""
        key = (model, defines)
        if key not in self._built:
            path = self._folder / f"{'_'.join([model, *defines]).lower()}.fmu"
            self._built[key] = packed(
                path, lambda: self._build(path, model, defines), (FOREIGN,), defines
            )
        return self._built[key]

    def _build(self, path: Path, model: str, defines: tuple[str, ...]) -> None:
        compiler = shutil.which("gcc") or shutil.which("cc")
        if compiler is None:
            pytest.skip("there is no C compiler (gcc or cc), which the foreign FMUs are built with")
        version = re.fullmatch(r"[a-z]+(\d)", model)
        assert version is not None
        description = (FOREIGN / f"{model}.xml").read_text(encoding="utf-8")
        exchange = ["-DMODEL_EXCHANGE"] if "<Implementation>" not in description else []
        library = path.with_suffix(".so")
        subprocess.run(
            [
                compiler,
                "-shared",
                "-fPIC",
                "-O1",
                "-w",
                f"-I{HEADERS}",
                f"-I{FOREIGN}",
                *exchange,
                f"-DIDENTIFIER={model}",
                *(f"-D{define}" for define in defines),
                str(FOREIGN / f"{model}.c"),
                str(FOREIGN / f"frame{version[1]}.c"),
                "-o",
                str(library),
                "-lm",
            ],
            check=True,
        )
        platform = fmpy.platform_tuple if version[1] == "3" else fmpy.platform
        binary = f"binaries/{platform}/{model}.so"
        archive_of(path, {DESCRIPTION: description, binary: library.read_bytes()})

    def changed(self, model: str, name: str, *changes: tuple[str, str]) -> Path:
        """Return a copy of a model's FMU with texts of its model description replaced."""
        return edited(self(model), self._folder / f"{name}.fmu", *changes)


def run_well(words: Sequence[Any], **options: Any) -> str:
    """Run a program, which must end well, and return what it prints."""
    run = subprocess.run(words, capture_output=True, text=True, check=False, **options)
    assert run.returncode == 0, run.stdout + run.stderr
    return run.stdout
