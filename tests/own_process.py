"""Functions that tests run in a process of its own, which is killed or kills itself.

The process of the tests has threads: those of Dask, tensorstore and BLAS. A fork of it has their locks
and none of the threads, and breaks down at random. Therefore a fresh interpreter is forked, which has
imported what the functions need and has no other thread.
"""

import io
import multiprocessing
import os
import signal
from collections.abc import Callable
from functools import _lru_cache_wrapper, lru_cache
from multiprocessing.process import BaseProcess
from types import MethodType
from typing import Any

import cloudpickle

HANGS = 600
"""After so long [s] something hangs; nothing here takes a second on a machine that is not busy."""

_IMPORTED_ONCE = [
    "scipy.interpolate",
    "tests.twin_master.watch.conftest",
    "twin_master.fleet.flight",
    "twin_master.viewer.flight",
    "twin_master.workflow",
]
"""What the functions import: the fresh interpreter does so once, for all processes."""

_SERVER = multiprocessing.get_context("forkserver")
_SERVER.set_forkserver_preload(_IMPORTED_ONCE)


def started(run: Callable[[], object]) -> BaseProcess:
    """Return a new process, which runs a function with copies of everything that it refers to."""
    pickled = io.BytesIO()
    _Pickler(pickled).dump(run)
    process = _SERVER.Process(target=_run, args=(pickled.getvalue(), dict(os.environ)))
    process.start()
    return process


def ended_by(run: Callable[[], object]) -> int | None:
    """Run a function in a process of its own; return its exit code, or minus the signal that ended it."""
    process = started(run)
    process.join()
    return process.exitcode


def _run(pickled: bytes, environment: dict[str, str]) -> None:
    """Run a pickled function in the environment of the tests; end if it hangs."""
    signal.alarm(HANGS)
    os.environ.clear()
    os.environ.update(environment)
    cloudpickle.loads(pickled)()


class _Pickler(cloudpickle.Pickler):
    """Pickles functions of any kind, and methods whose values an object keeps."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, _lru_cache_wrapper) and isinstance(obj.__wrapped__, MethodType):
            return _with_cache, (obj.__wrapped__, obj.cache_parameters()["maxsize"])
        return super().reducer_override(obj)


def _with_cache(method: MethodType, size: int) -> Callable[..., object]:
    """Return a method whose values are kept, of which none is known yet."""
    return lru_cache(size)(method)
