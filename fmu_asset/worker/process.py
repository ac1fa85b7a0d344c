"""The worker process of an FMU: the twin starts it, monitors it and ends it."""

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

from .protocol import WORKER_NUMBER, Exit, has_ended, receive
from .refusals import report_descriptor
from .sandbox import Grants, landlock_version

CLOSE_LIMIT = 2.0
"""Seconds that a worker has to end by itself."""
_KILL_LIMIT = 10.0
"""Seconds after which a supervisor that was asked to end its worker is killed."""
_LOG_BYTES = 4000
"""Length of the end of the log in which the last words are looked for."""
_LAST_LINES = 5

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
_PROGRAM = (
    "import sys; sys.path.append(sys.argv[1]); "
    "from fmu_asset.worker.supervisor import supervise; supervise(*sys.argv[2:])"
)


class WorkerProcess:
    """A worker process as the twin handles it, by its supervisor and two pipes.

    Parameters
    ----------
    folder : Path
        The scratch folder: the worker's working directory, which also has its log.
    grants : Grants or None
        The rights that the sandbox grants in addition to those of every FMU; None for no sandbox.

    Attributes
    ----------
    number : int
        The process number of the worker.
    outgoing, incoming : int
        The file descriptors of the twin's ends of the pipes.

    Raises
    ------
    FmuWorkerError
        If the worker cannot be started.
    """

    def __init__(self, folder: Path, fmu_folder: str, grants: Grants | None) -> None:
        self._folder = folder
        self._remark = ""
        if grants is not None and landlock_version():
            self._remark = _CONFINED
        # the process of the supervisor, which starts that of the worker
        self._process = self._start(fmu_folder, grants)
        pipes = (self._process.stdin, self._process.stdout)
        self._pipes = [pipe for pipe in pipes if pipe is not None]
        self.outgoing, self.incoming = (pipe.fileno() for pipe in self._pipes)
        self._end_event = os.pidfd_open(self._process.pid)
        first_message = bytearray(WORKER_NUMBER.size)
        if not receive(self.incoming, memoryview(first_message)):
            self.end(CLOSE_LIMIT)
            raise FmuWorkerError("The worker process ended before it began.", self._last_words())
        (number,) = WORKER_NUMBER.unpack(first_message)
        self.number: int = number

    def _start(self, fmu_folder: str, grants: Grants | None) -> "subprocess.Popen[bytes]":
        """Start the supervisor and return its process."""
        root = str(Path(__file__).parents[2])
        environment = {
            **os.environ,
            # one thread: matrices are small, and results do not depend on the number of cores
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
            "PYTHONDONTWRITEBYTECODE": "1",
            "TMPDIR": str(self._folder),
        }
        grants_text = "" if grants is None else json.dumps(asdict(grants))
        report = report_descriptor()
        report_text = "" if report is None else str(report)
        arguments = [root, str(self._folder), fmu_folder, grants_text, report_text]
        try:
            with (self._folder / "worker.log").open("wb") as log:
                return subprocess.Popen(
                    [sys.executable, "-P", "-c", _PROGRAM, *arguments],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    bufsize=0,
                    pass_fds=() if report is None else (report,),
                    cwd=self._folder,
                    env=environment,
                    # signals of the terminal are for the twin alone
                    start_new_session=True,
                )
        except OSError as error:
            raise FmuWorkerError(f"The worker process could not be started ({error}).") from error

    def kill(self) -> None:
        """Kill the worker and all processes that the FMU has started."""
        if self._process.returncode is not None:
            return
        self._process.terminate()
        try:
            self._process.wait(_KILL_LIMIT)
        except subprocess.TimeoutExpired:
            self._process.kill()  # the worker dies with its supervisor
            self._process.wait()
        os.close(self._end_event)
        # SIGKILL means that the worker was killed, or the supervisor before it could clean up
        if self._process.returncode == -signal.SIGKILL:
            end_processes(self._folder)

    def end(self, limit: float) -> None:
        """Close the pipes, so that the worker ends; kill it if it still runs after a limit [s]."""
        for pipe in self._pipes:
            pipe.close()
        self._wait_for_end(limit)
        self.kill()

    @property
    def closed(self) -> bool:
        """Whether the pipes are closed."""
        return self._pipes[0].closed

    def death_error(self, action: str) -> FmuWorkerError:
        """Return the error that says how the worker died; a worker that still runs is killed.

        Parameters
        ----------
        action : str
            What the worker was doing, such as "a step".
        """
        is_alive = not self._wait_for_end(CLOSE_LIMIT)
        self.kill()
        cause = self._cause_of_death(is_alive, self._process.returncode)
        return FmuWorkerError(
            f"During {action} the worker process of the FMU {cause}. {_REMEDY}{self._remark}.",
            self._last_words(),
        )

    @staticmethod
    def _cause_of_death(is_alive: bool, code: int) -> str:
        """Return how the worker died, as the end of a sentence.

        `is_alive` says that it was still running; the exit code is negative for a signal.
        """
        if is_alive:
            return "closed its pipe, or wrote something else into it"
        if code < 0:
            names = {number.value: number.name for number in signal.Signals}
            name = names.get(-code, "a real-time signal")
            meaning = f": {_MEANINGS[name]}" if name in _MEANINGS else ""
            return f"was ended by signal {-code} ({name}){meaning}"
        if code == Exit.PIPES_GONE:
            return "could not answer: the FMU's code closed files that are not its own"
        if code == Exit.OWN_FAILURE:
            return "failed outside the FMU"
        return f"ended with exit status {code}: the FMU's code ended its own process"

    def _wait_for_end(self, limit: float) -> bool:
        """Return whether the process ends within a limit [s]; it is not reaped yet."""
        return self._process.returncode is not None or has_ended(self._end_event, limit)

    def _last_words(self) -> list[str]:
        """Return the last lines of the worker's log, without Python's report of a crash."""
        with contextlib.suppress(OSError):
            # the FMU may have put a link or a pipe in the place of the log
            flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK
            log = os.open(self._folder / "worker.log", flags)
            with os.fdopen(log, "rb") as file:
                length = file.seek(0, os.SEEK_END)
                file.seek(max(length - _LOG_BYTES, 0))
                text = file.read().decode("utf-8", "replace")
            text = text.partition("Fatal Python error")[0]
            lines = [line for line in text.splitlines() if line.strip()]
            return lines[-_LAST_LINES:]
        return []
