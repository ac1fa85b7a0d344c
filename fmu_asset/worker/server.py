"""The worker's side: it imports fmpy, and of the project `errors`, `instances` and this folder only."""

from __future__ import annotations

import errno
import faulthandler
import json
import os
import select
import signal
import sys
import traceback

import numpy as np

from ..errors import FmuError, FmuWorkerError
from ..instances import open_instance
from ..instances.base import FmuInstance
from ..instances.plan import Plan
from ..instances.series import Series
from .guard import Household, restrict
from .protocol import (
    FAILURE,
    HEADER,
    OWN_FAILURE,
    PART,
    PIPES_GONE,
    QUICK,
    RESULT,
    Operation,
    look,
    receive,
    send,
)

_STEP, _RUN, _OPEN, _RENEW, _CLOSE, _LOG = (
    int(operation)
    for operation in (
        Operation.STEP,
        Operation.RUN,
        Operation.OPEN,
        Operation.RENEW,
        Operation.CLOSE,
        Operation.LOG,
    )
)


def serve(incoming: int, outgoing: int, folder: str) -> None:
    """Answer requests until the pipe closes; then remove the folders that nobody else removes.

    Parameters
    ----------
    incoming, outgoing : int
        File descriptors of the pipes.
    folder : str
        The scratch folder of this worker.
    """
    # The twin decides what an interruption means; the worker ends when its pipe closes.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    faulthandler.enable()
    restrict()
    household = Household(incoming, folder)
    asked = False
    instance: FmuInstance | None = None
    plan: Plan | None = None
    header = bytearray(HEADER.size)
    header_view = memoryview(header)
    reply_header = bytearray(HEADER.size)
    request = reply = memoryview(b"")
    poll = select.poll()
    poll.register(incoming, select.POLLIN | select.POLLHUP)
    try:
        while receive(incoming, header_view):
            operation, _, length = HEADER.unpack(header)
            try:
                if operation == _STEP:
                    if not receive(incoming, request) or instance is None:
                        break
                    instance.step()
                    payload: bytes | memoryview = reply
                else:
                    content = bytearray(length)
                    asked = operation == _CLOSE
                    if not receive(incoming, memoryview(content)) or asked:
                        break
                    if operation in (_OPEN, _RENEW):
                        if operation == _OPEN:
                            plan = Plan.from_json(bytes(content))
                            household.shared = plan.folder
                        if instance is not None:
                            instance.close()
                        instance = None
                        if plan is not None:
                            instance = open_instance(plan)
                            request = memoryview(instance.request).cast("B")
                            reply = memoryview(instance.reply).cast("B")
                    if operation == _RUN and instance is not None:
                        payload = _run(instance, content, outgoing)
                    else:
                        payload = _answer(operation, bytes(content), instance, reply)
                logged = instance is not None and instance.has_log and operation != _LOG
                HEADER.pack_into(reply_header, 0, RESULT, logged, len(payload))
            except FmuError as error:
                lost = instance is None or instance.lost
                payload = json.dumps([type(error).__name__, error.sentence, error.messages, lost]).encode()
                HEADER.pack_into(reply_header, 0, FAILURE, 0, len(payload))
            send(outgoing, reply_header, payload)
            if operation in QUICK:
                look(poll)
        if instance is not None:
            instance.close()
    except BrokenPipeError:
        pass  # the twin is gone
    except OSError as error:
        os._exit(PIPES_GONE if error.errno == errno.EBADF else OWN_FAILURE)
    except BaseException:  # noqa: BLE001 - the twin reads the last words in worker.log
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(OWN_FAILURE)
    household.leave(asked=asked)


def _run(instance: FmuInstance, content: bytearray, outgoing: int) -> memoryview:
    """Make the steps of a message; send replies in parts, and return those that are not sent yet."""
    requests = np.frombuffer(content).reshape(-1, len(instance.request))
    series = Series(requests, np.empty((len(requests), len(instance.reply))))
    sent = 0

    def rest() -> memoryview:
        nonlocal sent
        begin, sent = sent, series.done
        return series.replies[begin * series.reply_size : sent * series.reply_size]

    def report() -> None:
        part = rest()
        send(outgoing, HEADER.pack(PART, instance.has_log, len(part)), part)

    try:
        instance.run(series, report)
    except FmuError:
        report()
        raise
    return rest()


def _answer(
    operation: int, content: bytes, instance: FmuInstance | None, reply: memoryview
) -> bytes | memoryview:
    if instance is None:
        raise FmuWorkerError("The worker was asked before it had an FMU.")
    if operation == Operation.INITIALISE:
        setting = json.loads(content)
        inputs = bytes.fromhex(setting["inputs"])
        if inputs:
            memoryview(instance.request).cast("B")[16:] = inputs
        instance.initialise(setting["start_time"], setting["parameters"], with_inputs=bool(inputs))
    elif operation == Operation.READ:
        instance.read()
        return reply
    elif operation == Operation.SAVE:
        return instance.save()
    elif operation == Operation.RESTORE:
        instance.restore(content)
    elif operation == Operation.RESET:
        instance.reset()
    elif operation == Operation.LOG:
        return json.dumps(instance.take_log()).encode()
    return b""
