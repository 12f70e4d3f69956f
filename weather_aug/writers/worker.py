"""The worker process: renders the units it is given, and never outlives its parent."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import traceback
from multiprocessing.connection import Connection

import cv2

from weather_aug.writers.lock import working
from weather_aug.writers.plan import ExportPlan
from weather_aug.writers.sample import write_unit
from weather_aug.writers.target import Target

READY, DONE, FAILED = "ready", "done", "failed"


def work(plan: ExportPlan, target: Target, pipe: Connection) -> None:
    """Answer unit numbers from `pipe` with (DONE, lines) until None comes.

    An error ends the worker; it goes to the parent as (FAILED, (error, traceback)).
    """
    # Ctrl-C reaches the whole process group; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    # One worker a core: threads of its own would only take the others' time.
    cv2.setNumThreads(1)
    try:
        with working(target.state):
            parent = multiprocessing.parent_process()
            if parent is None or not parent.is_alive():
                return
            plan.check_scenes()
            pipe.send((READY, None))
            while (unit := pipe.recv()) is not None:
                pipe.send((DONE, write_unit(plan, target, unit)))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
    except MemoryError:
        # Like being killed for it: a fresh worker may fit, and too large an item is quarantined.
        os._exit(1)
    except Exception as error:
        pipe.send((FAILED, (sendable(error), traceback.format_exc())))


def _leave_with_parent() -> None:
    """End this process, mid-write if need be, when its parent is gone.

    What a worker half wrote is a temporary file, which the next run removes.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def sendable(error: Exception) -> Exception:
    """The error itself if it survives a pipe, else one that says the same."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
