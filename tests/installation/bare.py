"""An environment with the wheel of this project and its dependencies without extras, and nothing else.

`python -m tests.installation.bare FOLDER` makes one and prints what each distribution takes on the disk.
"""

import os
import shutil
import subprocess
import sys
import venv
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
_MEBIBYTE = 2**20


def build_wheel(folder: Path) -> Path:
    """Build the wheel from a copy of the tracked files, so that nothing is left in the checkout."""
    source = folder / "source"
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True)
    for name in tracked.stdout.decode().split("\0"):
        if name and (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, source / name)
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--wheel-dir", str(folder)]
    subprocess.run([sys.executable, "-m", "pip", "wheel", *options, str(source)], check=True)
    (wheel,) = folder.glob("uav_twin-*.whl")
    return wheel


def dependencies_without_extras(name: str = "uav-twin") -> dict[str, metadata.Distribution]:
    """Return the installed distributions that one needs without extras, and those that these need."""
    found: dict[str, metadata.Distribution] = {}
    waiting = list(_requirements(name, ""))
    while waiting:
        requirement = waiting.pop()
        distribution = metadata.distribution(requirement.name)
        is_new = distribution.name not in found
        found[distribution.name] = distribution
        if is_new:
            waiting += _requirements(requirement.name, "")
        for extra in requirement.extras:
            waiting += _requirements(requirement.name, extra)
    return found


def _requirements(name: str, extra: str) -> Iterator[Requirement]:
    """Yield what a distribution requires on this system, without an extra or by one alone."""
    for text in metadata.requires(name) or ():
        requirement = Requirement(text)
        marker = requirement.marker
        is_wanted = marker is None or marker.evaluate({"extra": extra})
        is_core = marker is None or marker.evaluate({"extra": ""})
        if is_wanted and is_core == (extra == ""):
            yield requirement


class BareEnvironment:
    """A virtual environment with the wheel, and with its dependencies as they are installed here.

    The files of the dependencies are linked from the present environment, so that no index is needed; no
    other distribution of it can be imported.

    Parameters
    ----------
    folder : Path
        An empty folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "environment"
        venv.create(self.folder, with_pip=False)
        self.scripts = self.folder / ("Scripts" if os.name == "nt" else "bin")
        (self.python,) = list(self.scripts.glob("python.exe")) or [self.scripts / "python"]
        self.packages = Path(self.run("-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
        for distribution in dependencies_without_extras().values():
            self._link(distribution)
        wheel = build_wheel(folder)
        options = ["--no-deps", "--no-index", "--quiet", str(wheel)]
        pip = [sys.executable, "-m", "pip", "--python", str(self.python), "install"]
        subprocess.run([*pip, *options], check=True)

    def _link(self, distribution: metadata.Distribution) -> None:
        """Link the files of a distribution that stand among the packages; scripts are left out."""
        root = Path(str(distribution.locate_file("")))
        for file in distribution.files or ():
            source = root / file
            if ".." in file.parts or not source.is_file() or file.suffix == ".pyc":
                continue
            target = self.packages / file
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(source, target)
            except OSError:  # another file system
                shutil.copyfile(source, target)

    def run(self, *words: object, cwd: Path | None = None, code: int | None = 0) -> str:
        """Run Python of the environment; return what it said, and, if it must fail, its complaint."""
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        environment |= {"PYTHONUTF8": "1", "COLUMNS": "200"}
        process = subprocess.run(
            [str(self.python), "-P", *map(str, words)],
            cwd=cwd or self.folder,
            env=environment,
            capture_output=True,
            text=True,
            encoding="utf-8",
            check=False,
        )
        assert code is None or process.returncode == code, process.stderr[-3000:]
        return process.stdout + (process.stderr if code else "")

    def sizes(self) -> dict[str, float]:
        """Return the size of each package and library among the packages [MiB], the largest first."""
        sizes = {}
        for entry in self.packages.iterdir():
            files = [entry] if entry.is_file() else [path for path in entry.rglob("*") if path.is_file()]
            sizes[entry.name] = sum(path.stat().st_size for path in files) / _MEBIBYTE
        return dict(sorted(sizes.items(), key=lambda row: -row[1]))


if __name__ == "__main__":
    bare = BareEnvironment(Path(sys.argv[1]))
    sizes = bare.sizes()
    rows = [f"{sum(sizes.values()):8.1f} MiB in all"]
    rows += [f"{size:8.1f} MiB {name}" for name, size in sizes.items() if size >= 1.0]
    sys.stdout.write("\n".join(rows) + "\n")
