"""Processes that sample blocks of a grid, one for each processor.

Only our own code runs in them, so that what they send can be believed: each flies the FMU as everybody does,
in a confined worker with its limits.
"""

import os
import socket
import subprocess
import sys
import tempfile
from multiprocessing.connection import Connection
from pathlib import Path
from typing import IO

from fmu_asset.errors import FmuError, FmuWorkerError
from twin_master.errors import TwinMasterError
from twin_master.library.grid import Float, GridSampler, SamplingGrid

_PROGRAM = (
    "import sys; sys.path.append(sys.argv[1]); from twin_master.library.worker import serve; "
    "serve(int(sys.argv[2]), sys.argv[3])"
)


def serve(descriptor: int, grid: str) -> None:
    """Answer requests for blocks, (number, first, last), until the other side closes.

    Parameters
    ----------
    descriptor : int
        File descriptor of the connection.
    grid : str
        The grid as text.
    """
    connection = Connection(descriptor)
    sampler: GridSampler | None = None
    try:
        while True:
            number, first, last = connection.recv()
            try:
                if sampler is None:
                    sampler = GridSampler(SamplingGrid.from_json(grid))
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
    load : int
        Number of blocks that were asked for and have not come.

    Raises
    ------
    FmuWorkerError
        The process cannot be started.
    """

    def __init__(self, grid: SamplingGrid) -> None:
        self._grid = grid
        self._log: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - it is closed with the process
        self.load = 0
        ours, theirs = socket.socketpair()
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        arguments = [str(Path(__file__).parents[2]), str(theirs.fileno()), grid.to_json()]
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
            raise FmuWorkerError(f"A sampling process could not be started ({error}).") from error
        finally:
            theirs.close()
        self.connection = Connection(ours.detach())

    def ask(self, number: int, first: int, last: int) -> None:
        """Ask for a block."""
        self.load += 1
        try:
            self.connection.send((number, first, last))
        except (BrokenPipeError, ConnectionResetError):
            raise self._died() from None

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
        self.load -= 1
        if isinstance(answer, Exception):
            raise answer
        return number, answer

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
        if self.load:
            self._process.kill()
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._log.close()
