"""Feed damaged files to every loader of user files.

`python -m benchmarks.fuzz_loaders --count 3000 --seed 1` prints one row for each loader. A load is refused in
a sentence, or accepted; a traceback (an error that is none of the project's own, or more than one line) and a
hang (20 s of processor time) are faults. A load has 4 GB of memory. The same seed gives the same mutations.
"""

import argparse
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.fuzz_files import CONFIG_HASH, make_files
from benchmarks.fuzz_mutations import ARCHIVE, BINARY, TEXT, Mutation
from calibration.dynamics.records import read_records
from calibration.geometry import read_lengths
from calibration.result.file import load_calibration
from calibration.static.experiments import read_measurements
from calibration.wing.lab_data import read_weighed_mass
from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.library import load_catalogue
from discrepancy.files.residuals import read_residuals
from discrepancy.files.verdict import read_patch, read_verdict_file
from discrepancy.fmu_models.description import FmuModelDescription
from discrepancy.system.lumped_model import LumpedModel
from fe.runtime.reduced import ReducedModel
from fe.runtime.wing_rows import PatchArrays
from fe.structure.design import load_structure
from fe.structure.mesh_file import read_mesh
from fe.wing.design import load_design
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.client.binding import load_binding
from fmu_asset.client.history_files import read_histories
from fmu_asset.packing.patch_file import load_patch
from fmu_asset.ssp.reader import read_ssp
from scenarios import binding_files
from twin_master.assets.library_source import load_observation_library
from twin_master.assets.strain_library_source import load_strain_library
from twin_master.mission.journal import JournalFile, reading_of, records_backwards
from twin_master.report.reading import read_run as read_record
from twin_master.run_folder import read_config
from twin_master.scenario.reading import load_scenario, parse_scenario
from twin_master.store.writing import finished_run, open_run
from twin_master.workflow import check_scenario

CPU_SECONDS = 20
MEMORY = 4 * 1024**3
WALL_SECONDS = 120.0
"""Of a load that waits for ever without working."""
PACKAGES = ("calibration", "discrepancy", "fe", "fmu_asset", "reporting", "scenarios", "twin_master")


@dataclass(frozen=True)
class Loader:
    """A loader and the file that is damaged.

    Attributes
    ----------
    file : str
        In the folder of sound files; what lies in its own folder is copied with it if it has one.
    load : callable
        Takes the path of the damaged copy.
    mutations : mapping of str to Mutation
        Of its kind of file.
    """

    file: str
    load: Callable[[Path], object]
    mutations: Mapping[str, Mutation]


def _checkpoint(path: Path) -> None:
    with JournalFile(path.parent, CONFIG_HASH):
        for record, begin, _ in records_backwards(path):
            if begin:
                reading_of(record)


def _config(path: Path) -> None:
    finished_run(path.parent)
    parse_scenario(read_config(path.parent)["scenario"], str(path))


def _mesh(path: Path) -> None:
    read_mesh(path, 1e-3, "mm")


LOADERS: dict[str, Loader] = {
    "structure": Loader("structure/bracket.toml", load_structure, TEXT),
    "deck": Loader("structure/bracket.inp", _mesh, TEXT),
    "bulk data": Loader("structure/pieces.bdf", _mesh, TEXT),
    "Gmsh": Loader("structure/stiffened_panel.msh", _mesh, TEXT),
    "VTU": Loader("bracket.vtu", _mesh, TEXT),
    "scenario": Loader("scenario.toml", lambda path: check_scenario(load_scenario(path)), TEXT),
    "binding": Loader("binding.toml", load_binding, TEXT),
    "wing design": Loader("design.toml", load_design, TEXT),
    "campaign": Loader("campaign/campaign.toml", lambda path: read_campaign(path.parent), TEXT),
    "campaign table": Loader("campaign/*.csv", lambda path: read_campaign(path.parent), TEXT),
    "lumped model": Loader("lumped.toml", LumpedModel.load, TEXT),
    "FMU model": Loader("fmu_model.toml", FmuModelDescription.read, TEXT),
    "effects": Loader("effects.toml", lambda path: load_catalogue([path]), TEXT),
    "patch, analysis": Loader("verdict/patch.json", read_patch, TEXT),
    "patch, packing": Loader("verdict/patch.json", load_patch, TEXT),
    "verdict": Loader("verdict/verdict.json", read_verdict_file, TEXT),
    "residuals": Loader("verdict/residuals.nc", read_residuals, BINARY),
    "run, store": Loader("run/run.nc", lambda path: open_run(path.parent), BINARY),
    "run, report": Loader("run/run.nc", lambda path: read_record(path.parent), BINARY),
    "checkpoint": Loader("checkpoint/journal.jsonl", _checkpoint, TEXT),
    "configuration": Loader("run/config.json", _config, TEXT),
    "calibration": Loader("calibrated/calibration.nc", load_calibration, BINARY),
    "observations": Loader("library.nc", load_observation_library, BINARY),
    "strains": Loader("strains.json", load_strain_library, TEXT),
    "geometry": Loader("laboratory/step1/geometry_data.csv", read_lengths, TEXT),
    "load test": Loader("laboratory/step2/load_displacement_measurements.csv", read_measurements, TEXT),
    "mass": Loader("laboratory/step3/weighed_mass.csv", read_weighed_mass, TEXT),
    "ring-down": Loader("laboratory/step3/initialconditiondata_1.DAT", read_records, TEXT),
    "ring-down, read off": Loader("laboratory/digitised.csv", read_records, TEXT),
    "histories": Loader(
        "histories.csv", lambda path: read_histories(path, load_binding(binding_files()["uav_wing"])), TEXT
    ),
    "SSP": Loader("system.ssp", lambda path: read_ssp(path, path.parent / "fmus"), ARCHIVE),
    "FMU": Loader("pump.fmu", read_fmu, ARCHIVE),
    "reduced model": Loader("reduced.npz", ReducedModel.load, ARCHIVE),
    "wing for patches": Loader("patched.npz", PatchArrays.load, ARCHIVE),
}


def judge(load: Callable[[], object]) -> tuple[str, str]:
    """Return what a load came to: "accepted", "refused" or "traceback", and its sentence."""
    try:
        load()
    except BaseException as error:  # noqa: BLE001 - whatever comes is what is judged
        text = str(error)
        ours = type(error).__module__.partition(".")[0] in PACKAGES
        causes = [str(e) for e in (error.__cause__, error.__context__) if e is not None]
        causes += [repr(e) for e in (error.__cause__, error.__context__) if e is not None]
        foreign = any(text == cause for cause in causes) and not _from_ours(error)
        sentence = ours and text.strip() and "\n" not in text and not foreign
        return ("refused" if sentence else "traceback"), f"{type(error).__name__}: {text[:400]!r}"
    return "accepted", ""


def _from_ours(error: BaseException) -> bool:
    cause = error.__cause__ or error.__context__
    return cause is not None and type(cause).__module__.partition(".")[0] in PACKAGES


def _place(loader: Loader, files: Path, scratch: Path) -> Path:
    """Copy the file, with its folder where it has one, and return the copy's path."""
    source = sorted(files.glob(loader.file))[0]
    relative = source.relative_to(files)
    if len(relative.parts) > 1:
        large = shutil.ignore_patterns("asset", "csv", "*.vtu", "figures", "cache")
        shutil.copytree(files / relative.parts[0], scratch / relative.parts[0], ignore=large)
    else:
        shutil.copy(source, scratch / relative)
    return scratch / relative


def mutate(loader: Loader, sound: bytes, seed: tuple[int, ...]) -> tuple[str, bytes]:
    """Return the name of a mutation and what it makes of a sound file."""
    draw = np.random.default_rng(seed)
    name = list(loader.mutations)[draw.integers(len(loader.mutations))]
    return name, loader.mutations[name](sound, draw)


def _work(pipe: Connection, loader: Loader, path: Path, sound: bytes) -> None:
    """Load what is asked for, one at a time, until nothing is."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    with Path(os.devnull).open("w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
    while (seed := pipe.recv()) is not None:
        kind, content = mutate(loader, sound, seed)
        path.write_bytes(content)
        signal.setitimer(signal.ITIMER_PROF, CPU_SECONDS)
        outcome, text = judge(lambda: loader.load(path))
        signal.setitimer(signal.ITIMER_PROF, 0)
        pipe.send((kind, outcome, text, content == sound))


class Worker:
    """A process that loads damaged files, begun again when a load has ended it."""

    def __init__(self, loader: Loader, path: Path, sound: bytes) -> None:
        self._given = (loader, path, sound)
        self._begin()

    def _begin(self) -> None:
        context: Any = multiprocessing.get_context("fork")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=_work, args=(other, *self._given), daemon=True)
        self._process.start()
        other.close()

    def ask(self, seed: tuple[int, ...]) -> tuple[str, str, str, bool]:
        """Return the mutation, what it came to, the sentence, and whether the file stayed the same."""
        try:
            self._pipe.send(seed)
            if self._pipe.poll(WALL_SECONDS):
                answer: tuple[str, str, str, bool] = self._pipe.recv()
                return answer
            outcome, text = "hang", "it waits"
        except (EOFError, ConnectionError):
            self._process.join()
            hung = self._process.exitcode == -signal.SIGPROF
            outcome, text = ("hang", "20 s") if hung else ("traceback", f"exit {self._process.exitcode}")
        self.end()
        self._begin()
        return mutate(self._given[0], self._given[2], seed)[0], outcome, text, False

    def end(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()
        self._pipe.close()


def fuzz(name: str, files: Path, count: int, seed: int) -> list[tuple[int, str, str, str]]:
    """Return number, mutation, outcome and sentence of each load of damaged files."""
    loader = LOADERS[name]
    with tempfile.TemporaryDirectory(prefix="fuzz-") as scratch:
        path = _place(loader, files, Path(scratch))
        sound = path.read_bytes()
        loader.load(path)  # a loader that refuses what is sound proves nothing
        worker = Worker(loader, path, sound)
        found = []
        for number in range(count):
            kind, outcome, text, same = worker.ask((seed, list(LOADERS).index(name), number))
            found.append((number, kind, "accepted" if same else outcome, text))
        worker.end()
    return found


def main() -> int:
    """Fuzz and print the table; the exit code is 1 if there was a traceback or a hang."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=3000, help="mutations of all loaders together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--files", type=Path, default=Path(tempfile.gettempdir()) / "uav-twin-fuzz-files")
    parser.add_argument("--only", default="", help="loaders whose name contains this")
    parser.add_argument("--show", default="traceback,hang", help="outcomes that are printed one by one")
    given = parser.parse_args()
    files = make_files(given.files)
    names = [name for name in LOADERS if given.only in name and any(files.glob(LOADERS[name].file))]
    table = Table("loader", "mutations", "refused in a sentence", "accepted", "tracebacks", "hangs", "s")
    totals: Counter[str] = Counter()
    for position, name in enumerate(names):
        share = given.count // len(names) + (position < given.count % len(names))
        begin = time.perf_counter()
        found = fuzz(name, files, share, given.seed)
        counts = Counter(outcome for _, _, outcome, _ in found)
        for number, kind, outcome, text in found:
            if outcome in given.show.split(","):
                print(f"{name} {number} [{kind}] {outcome} {text}", flush=True)
        columns = [counts[key] for key in ("refused", "accepted", "traceback", "hang")]
        table.add_row(name, str(share), *map(str, columns), f"{time.perf_counter() - begin:.0f}")
        totals.update(counts)
    totals_row = [totals[key] for key in ("refused", "accepted", "traceback", "hang")]
    table.add_row("all", str(sum(totals.values())), *map(str, totals_row), "")
    Console().print(table)
    return 1 if totals["traceback"] or totals["hang"] else 0


if __name__ == "__main__":
    sys.exit(main())
