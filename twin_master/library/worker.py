"""Processes that sample blocks of a grid: each holds an FMU of its own, so that one crash is one sentence."""

import os
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import IO

from fmu_asset.door.binding import load_binding
from fmu_asset.door.placement import limits_of
from fmu_asset.errors import FmuError, FmuTimeoutError, FmuWorkerError
from fmu_asset.folders import end_processes, plain_folder, remove_folder
from fmu_asset.worker.sandbox import confine
from twin_master.errors import TwinMasterError
from twin_master.library.grid import Float, GridSampler, SamplingGrid

_START_LIMIT = 120.0
_PROGRAM = (
    "import sys; sys.path.append(sys.argv[1]); from twin_master.library.worker import serve; "
    "serve(int(sys.argv[2]), *sys.argv[3:])"
)


def serve(descriptor: int, grid: str, folder: str) -> None:
    """Answer requests for blocks, (number, first, last), until the other side closes.

    Parameters
    ----------
    descriptor : int
        File descriptor of the connection.
    grid : str
        The grid as text.
    folder : str
        Folder of this process, the one in which it may write.
    """
    connection = Connection(descriptor)
    sampler: GridSampler | None = None
    try:
        while True:
            number, first, last = connection.recv()
            try:
                if sampler is None:
                    sampler = _confined_sampler(SamplingGrid.from_json(grid), folder)
                connection.send((number, sampler.block(first, last)))
            except (FmuError, TwinMasterError) as error:
                connection.send((number, error))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # nothing more is wanted
    if sampler is not None:
        sampler.close()
    sys.stderr.flush()
    # Without the interpreter's shutdown, which third-party libraries may not survive.
    os._exit(0)


def _confined_sampler(grid: SamplingGrid, folder: str) -> GridSampler:
    """Return a sampler in this process, which from now on may do what a worker of this FMU may."""
    granted = limits_of(load_binding(grid.binding), None, None, None).sandbox
    if granted is not None:
        files = (str(Path(grid.fmu).absolute()), str(Path(grid.binding).absolute()))
        confine(replace(granted, read=files + granted.read), folder, folder)
    return GridSampler(grid)


class SamplingProcess:
    """One process, as its parent has it.

    Parameters
    ----------
    grid : SamplingGrid
        What is sampled.

    Attributes
    ----------
    connection : Connection
        To be waited for.

    Raises
    ------
    FmuWorkerError
        The process cannot be started.
    """

    def __init__(self, grid: SamplingGrid) -> None:
        self._grid = grid
        self._log: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - it is closed with the process
        self._pending: list[tuple[int, int]] = []
        self._folder = plain_folder()
        ours, theirs = socket.socketpair()
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        environment["TMPDIR"] = folder = str(self._folder)
        arguments = [str(Path(__file__).parents[2]), str(theirs.fileno()), grid.to_json(), folder]
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", _PROGRAM, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=self._log,
                stderr=self._log,
                env=environment,
                pass_fds=(theirs.fileno(),),
                # What the terminal sends is for the parent alone; the process ends with its connection.
                start_new_session=True,
            )
        except OSError as error:
            ours.close()
            self._log.close()
            remove_folder(self._folder)
            raise FmuWorkerError(f"A sampling process could not be started ({error}).") from error
        finally:
            theirs.close()
        self.connection = Connection(ours.detach())
        self._deadline = time.monotonic() + _START_LIMIT

    @property
    def load(self) -> int:
        """Number of blocks that were asked for and have not come."""
        return len(self._pending)

    @property
    def deadline(self) -> float:
        """When the next block must have come, on the monotonic clock; infinity if none is awaited."""
        return self._deadline if self._pending else float("inf")

    def ask(self, number: int, first: int, last: int) -> None:
        """Ask for a block."""
        if not self._pending:
            self._deadline = time.monotonic() + _START_LIMIT + self._limit(last - first)
        self._pending.append((number, last - first))
        try:
            self.connection.send((number, first, last))
        except (BrokenPipeError, ConnectionResetError):
            raise self._died() from None

    def _limit(self, points: int) -> float:
        return points * max(self._grid.settling_steps, 1) * self._grid.step_timeout

    def take(self) -> tuple[int, Float]:
        """Return number and observations of the block that has come.

        Raises
        ------
        FmuError, InvalidObservationLibraryError
            The block failed, or the process died.
        """
        try:
            number, answer = self.connection.recv()
        except (EOFError, ConnectionResetError):
            raise self._died() from None
        self._pending.pop(0)
        if self._pending:
            self._deadline = time.monotonic() + self._limit(self._pending[0][1])
        if isinstance(answer, Exception):
            raise answer
        return number, answer

    def check_time(self) -> None:
        """Raise FmuTimeoutError if the awaited block is overdue."""
        if time.monotonic() > self.deadline:
            raise FmuTimeoutError(
                f"The FMU {self._grid.fmu} took longer than {self._grid.step_timeout:g} s a step while it "
                "was sampled; the process was stopped."
            )

    def _died(self) -> FmuWorkerError:
        code = self._process.wait()
        self._log.seek(0)
        last_words = self._log.read().decode("utf-8", "replace").strip().splitlines()[-5:]
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        return FmuWorkerError(
            f"A process that sampled the FMU {self._grid.fmu} died ({how}).", tuple(last_words)
        )

    def close(self) -> None:
        """End the process, at once if it is at work."""
        self.connection.close()
        if self._pending:
            self._process.kill()
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._log.close()
        end_processes(self._folder)
        remove_folder(self._folder)
