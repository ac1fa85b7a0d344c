"""A worker process as the twin starts, watches and ends it."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

from fmu_asset.errors import FmuWorkerError
from fmu_asset.folders import end_processes

from .protocol import WORKER_NUMBER, Exit, ended, receive
from .refusals import report_descriptor
from .sandbox import Grants, landlock_version

CLOSE_LIMIT = 2.0
"""Seconds that a worker has to end by itself."""
_KILL_LIMIT = 10.0

_MEANINGS = {
    "SIGSEGV": "the FMU's code touched memory that is not its own",
    "SIGBUS": "the FMU's code touched memory that is not its own",
    "SIGABRT": "the FMU's code gave up with abort()",
    "SIGFPE": "the FMU's code divided an integer by zero or trapped a floating-point error",
    "SIGILL": "the FMU's binary was built for another processor",
    "SIGXFSZ": "the FMU wrote more than 2 GiB to one file",
    "SIGKILL": "somebody killed it, or the system ran out of memory",
}
_REMEDY = "Reset the asset, or resume the run, to go on; if it happens again, the FMU is at fault"
_CONFINED = ", or needs what its sandbox does not grant ([limits] of its binding)"


class WorkerProcess:
    """The process, its supervisor and its two pipes.

    Parameters
    ----------
    folder : Path
        Scratch folder: the working directory, and where its output goes.
    shared : str
        Folder of the extracted FMU.
    grants : Grants or None
        What it may touch beyond what every FMU may; None for no sandbox.

    Attributes
    ----------
    number : int
        Process number of the worker.
    outgoing, incoming : int
        The twin's ends of the pipes.

    Raises
    ------
    FmuWorkerError
        If it cannot be started.
    """

    def __init__(self, folder: Path, shared: str, grants: Grants | None) -> None:
        self._folder = folder
        self._remark = _CONFINED if grants is not None and landlock_version() else ""
        root = str(Path(__file__).parents[2])
        program = (
            "import sys; sys.path.append(sys.argv[1]); from fmu_asset.worker.supervisor import supervise; "
            "supervise(*sys.argv[2:])"
        )
        # One thread: the matrices are small, and results do not depend on the number of cores.
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        environment |= {"PYTHONDONTWRITEBYTECODE": "1", "TMPDIR": str(folder)}
        confined = "" if grants is None else json.dumps(asdict(grants))
        report = report_descriptor()
        watched = "" if report is None else str(report)
        try:
            with (folder / "worker.log").open("wb") as log:
                self._process = subprocess.Popen(
                    [
                        sys.executable,
                        "-P",
                        "-c",
                        program,
                        root,
                        str(folder),
                        shared,
                        confined,
                        watched,
                    ],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    bufsize=0,
                    pass_fds=() if report is None else (report,),
                    cwd=folder,
                    env=environment,
                    # What the terminal sends is for the twin alone.
                    start_new_session=True,
                )
        except OSError as error:
            raise FmuWorkerError(f"The worker process could not be started ({error}).") from error
        self._pipes = [
            pipe for pipe in (self._process.stdin, self._process.stdout) if pipe is not None
        ]
        self.outgoing, self.incoming = (pipe.fileno() for pipe in self._pipes)
        self._ended = os.pidfd_open(self._process.pid)
        first = bytearray(WORKER_NUMBER.size)
        if not receive(self.incoming, memoryview(first)):
            self.end(CLOSE_LIMIT)
            raise FmuWorkerError("The worker process ended before it began.", self._last_words())
        self.number: int = WORKER_NUMBER.unpack(first)[0]

    def kill(self) -> None:
        """End it, and whatever the FMU has started, at once."""
        if self._process.returncode is None:
            self._process.terminate()
            try:
                self._process.wait(_KILL_LIMIT)
            except subprocess.TimeoutExpired:  # the worker dies with its supervisor
                self._process.kill()
                self._process.wait()
            os.close(self._ended)
            if (
                self._process.returncode == -signal.SIGKILL
            ):  # of the worker, or of the supervisor before its work
                end_processes(self._folder)

    def end(self, limit: float) -> None:
        """Close the pipes, which tells a worker that it is needed no more, wait, and kill what is left."""
        for pipe in self._pipes:
            pipe.close()
        self._await_end(limit)
        self.kill()

    @property
    def closed(self) -> bool:
        """Whether the pipes are closed."""
        return self._pipes[0].closed

    def death(self, what: str) -> FmuWorkerError:
        """Return the error that says how it died."""
        alive = not self._await_end(CLOSE_LIMIT)
        self.kill()
        code = self._process.returncode
        if alive:
            how = "closed its pipe, or wrote something else into it"
        elif code < 0:
            name = {item.value: item.name for item in signal.Signals}.get(
                -code, "a real-time signal"
            )
            meaning = f": {_MEANINGS[name]}" if name in _MEANINGS else ""
            how = f"was ended by signal {-code} ({name}){meaning}"
        elif code == Exit.PIPES_GONE:
            how = "could not answer: the FMU's code closed files that are not its own"
        elif code == Exit.OWN_FAILURE:
            how = "failed outside the FMU"
        else:
            how = f"ended with exit status {code}: the FMU's code ended its own process"
        return FmuWorkerError(
            f"During {what} the worker process of the FMU {how}. {_REMEDY}{self._remark}.",
            self._last_words(),
        )

    def _await_end(self, limit: float) -> bool:
        """Return whether it ended in time; it is not reaped yet."""
        return self._process.returncode is not None or ended(self._ended, limit)

    def _last_words(self) -> list[str]:
        """Return the last lines of its output; of a crash of Python's, not the trace of our own code."""
        with contextlib.suppress(OSError):
            # The FMU may have put a link or a pipe there.
            log = os.open(self._folder / "worker.log", os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
            with os.fdopen(log, "rb") as file:
                file.seek(max(file.seek(0, os.SEEK_END) - 4000, 0))
                text = file.read().decode("utf-8", "replace")
            text = text.partition("Fatal Python error")[0]
            return [line for line in text.splitlines() if line.strip()][-5:]
        return []
