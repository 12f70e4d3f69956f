"""Ray actors render the units: on this machine, or on a cluster that another address names.

An actor is given a unit's number, writes the unit's files itself, and answers with manifest lines;
pixels never enter the object store. Plain actors under `ray.wait`, not Ray Data: its blocks,
batches and object store are for rows that carry data, it hangs where its actors hold all cores
(ray-project/ray#44687), and it cannot count the deaths of one row. A unit at a time, because asking
costs a millisecond and a unit is what a death may cost. As actors render the same bytes and rename
them into place, a unit that was made twice is harmless.
"""

from __future__ import annotations

import faulthandler
import json
import logging
import os
import signal
import socket
import sys
import threading
import time
import traceback
import uuid
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import cv2

from weather_aug import _files
from weather_aug._extras import require
from weather_aug.errors import (
    ArgumentError,
    ConflictError,
    OutputError,
    WeatherAugError,
    printable,
)
from weather_aug.render.compose import warm_up
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers.engines import (
    LISTEN_S,
    MAX_FAILED_STARTS,
    Finished,
    Losses,
    with_note,
)
from weather_aug.writers.layout import STATE
from weather_aug.writers.lock import working
from weather_aug.writers.plan import ExportPlan
from weather_aug.writers.sample import write_unit
from weather_aug.writers.target import Target
from weather_aug.writers.worker import DONE, FAILED, READY, sendable

START_WAIT_S = 600.0
"""How long no actor at all may start: clusters that grow on demand take minutes."""
CONNECT_WAIT_S = 10.0

_OBJECT_STORE_BYTES = 100 * 2**20

Answer = tuple[str, Any]
"""READY and None, DONE and manifest lines, or FAILED and (error, traceback)."""


def run_ray(
    plan: ExportPlan,
    target: Target,
    units: Iterator[int],
    *,
    actors: int = 2,
    address: str | None = None,
    cpus_per_actor: float = 0.5,
) -> Generator[Finished, None, None]:
    """Render units in Ray actors.

    A connection to Ray that stands already is used and left open. Else one is made and ended: to
    `address`, or to a Ray of its own on this machine, which has room for `actors` by construction.
    On a cluster those that find room render, the others join when they do. Nodes need the same
    weather-aug, the scenes under the same absolute paths, and the target.

    Args:
        plan: What to render.
        target: Where to; every node must see it.
        units: Units to render.
        actors: Processes that render, at least 1.
        address: Of a cluster, as `ray.init` takes it.
        cpus_per_actor: Share of a core by which Ray places them, above 0; it limits nothing.

    Raises:
        ArgumentError: If `actors` or `cpus_per_actor` is out of range.
        MissingExtraError: If Ray is not installed.
        IntegrityError: After all other units, if one killed three actors; it names its items.
        WeatherAugError: If actors cannot be started, or the first error of an actor.
    """
    if actors < 1:
        raise ArgumentError(f"actors must be at least 1, got {actors}")
    if not 0 < cpus_per_actor < float("inf"):
        raise ArgumentError(f"cpus_per_actor must be above 0, got {cpus_per_actor}")
    # Compiled once, not by each actor on this machine at the same time.
    warm_up()
    scenes = tuple(WeatherScene(scene.path.absolute()) for scene in plan.scenes)
    # Ray that has exactly the cores of its actors would leave none for anything else.
    local_cpus = max(os.cpu_count() or 1, int(actors * cpus_per_actor) + 1)
    with _connected(address, local_cpus) as ray:
        cast = _Cast(ray, replace(plan, scenes=scenes), target, units, cpus_per_actor)
        try:
            for _ in range(actors):
                cast.hire(None)
            while cast.waiting:
                yield from cast.finished()
        finally:
            cast.stop()
    cast.losses.settle()


class Renderer:
    """What runs in an actor. Its errors are answers, so that they arrive as they were raised."""

    def __init__(self, plan: ExportPlan, target: Target, token: str, job: dict[str, Any]) -> None:
        """Keep what is rendered; `begin` checks it."""
        self._plan, self._target, self._token, self._job = plan, target, token, job
        self._held = ExitStack()

    def begin(self) -> Answer:
        """Check that this node would write the same bytes to the same place."""
        return _answer(READY, self._begin)

    def write(self, unit: int) -> Answer:
        """Render a unit and write its files."""
        return _answer(DONE, lambda: write_unit(self._plan, self._target, unit))

    def _begin(self) -> None:
        cv2.setNumThreads(1)
        _check_same_job(replace(self._plan).job, self._job)
        self._plan.check_scenes()
        token, file = self._token.encode(), _token_file(self._token)
        stored = {"size": len(token), "sha256": _files.sha256_of(token)}
        if not self._target.is_whole(file, stored, digests=True):
            raise OutputError(
                f"a Ray actor on {printable(os.uname().nodename)} does not see what the exporter "
                f"wrote to {printable(self._target, 200)}; export to a place that all nodes share"
            )
        state = self._target.state
        if (state / file).is_file():
            self._held.enter_context(working(state))


def _token_file(token: str) -> str:
    """What an exporter writes for its actors to find; shards at one output must not meet here."""
    return f"{STATE}/ray-{token}"


def _answer(kind: str, work: Callable[[], Any]) -> Answer:
    try:
        return kind, work()
    except MemoryError:
        # Like being killed for it: a fresh actor may fit, and too large a unit is quarantined.
        os._exit(1)
    except Exception as error:
        return FAILED, (sendable(error), traceback.format_exc())


def _check_same_job(found: dict[str, Any], job: dict[str, Any]) -> None:
    for name, ours in job.items():
        if json.dumps(found.get(name)) != json.dumps(ours):
            raise ConflictError(
                f"on {printable(os.uname().nodename)} the job's {name} is "
                f"{printable(found.get(name), 120)}, the exporter's is {printable(ours, 120)}; "
                "install the same weather-aug on every node"
            )


@dataclass(eq=False)
class _Seat:
    """An actor, as the exporter sees it."""

    actor: Any
    unit: int | None
    """The unit that it has, or gets as soon as it is ready."""
    ready: bool = False


class _Cast:
    """The actors at one output and the units still to be given to them."""

    def __init__(
        self,
        ray: ModuleType,
        plan: ExportPlan,
        target: Target,
        units: Iterator[int],
        cpus_per_actor: float,
    ) -> None:
        token = uuid.uuid4().hex
        target.make_folders([STATE])
        target.write_whole(_token_file(token), token.encode())
        _files.write_whole(target.state / _token_file(token), token.encode())
        self.waiting: dict[Any, _Seat] = {}
        """Who owes which answer."""
        self.losses = Losses(plan, target)
        self._ray, self._units = ray, units
        self._given = (plan, target, token, plan.job)
        # The exporter restarts actors itself: Ray's own restarts do not know which unit kills.
        self._renderer = ray.remote(Renderer).options(
            num_cpus=cpus_per_actor, max_restarts=0, scheduling_strategy="SPREAD"
        )
        self._failed_starts = 0
        self._alone_since_s = time.monotonic()

    def hire(self, unit: int | None) -> None:
        """Start an actor that gets `unit`, or the next one if None; none if nothing is left."""
        unit = next(self._units, None) if unit is None else unit
        if unit is None:
            return
        actor = self._renderer.remote(*self._given)
        self.waiting[actor.begin.remote()] = _Seat(actor, unit)

    def finished(self) -> Iterator[Finished]:
        """Wait until an actor answers or dies; give the units that were finished."""
        heard, _ = self._ray.wait(list(self.waiting), timeout=LISTEN_S)
        if not heard:
            self._check_somebody_started()
        for answer in heard:
            # Who is still waited for when an error leaves this loop is ended by `stop`.
            seat = self.waiting[answer]
            try:
                kind, value = self._ray.get(answer)
            except self._ray.exceptions.RayError as error:
                del self.waiting[answer]
                self._bury(seat, error)
                continue
            if kind == FAILED:
                raise with_note(*value)
            del self.waiting[answer]
            done = seat.unit
            if kind == READY:
                seat.ready, self._failed_starts = True, 0
            else:
                assert kind == DONE
                seat.unit = next(self._units, None)
            self._assign(seat)
            if kind == DONE and done is not None:
                yield done, value

    def stop(self) -> None:
        """End the actors that are left, whatever they do."""
        for seat in self.waiting.values():
            self._end(seat)
        self.waiting.clear()

    def _end(self, seat: _Seat) -> None:
        # One that never came to be cannot be killed, which must not hide why.
        with suppress(self._ray.exceptions.RayError):
            self._ray.kill(seat.actor)

    def _assign(self, seat: _Seat) -> None:
        """Hand an actor its unit; one without any goes home."""
        if seat.unit is None:
            self._end(seat)
        else:
            self.waiting[seat.actor.write.remote(seat.unit)] = seat

    def _bury(self, seat: _Seat, error: Exception) -> None:
        """Replace an actor that died, and count its death against the unit that it had."""
        # One that is only out of reach must not write beside its successor.
        self._end(seat)
        unit = seat.unit
        if not seat.ready:
            self._failed_starts += 1
            if self._failed_starts >= MAX_FAILED_STARTS:
                raise WeatherAugError(
                    f"Ray actors end while they start: {_last_line(error)}; every node needs this "
                    "weather-aug and the packages that it needs"
                )
        elif unit is not None and not self.losses.may_try_again(unit):
            unit = None
        self.hire(unit)

    def _check_somebody_started(self) -> None:
        now_s = time.monotonic()
        if any(seat.ready for seat in self.waiting.values()):
            self._alone_since_s = now_s
        elif now_s - self._alone_since_s > START_WAIT_S:
            total, free = self._ray.cluster_resources(), self._ray.available_resources()
            raise WeatherAugError(
                f"no Ray actor could start in {START_WAIT_S:g} s: the cluster has "
                f"{total.get('CPU', 0):g} CPUs, {free.get('CPU', 0):g} of them free; end other "
                "jobs, or give a smaller cpus_per_actor"
            )


def _last_line(error: Exception) -> str:
    """What Ray's long and coloured messages come to."""
    return printable((str(error).strip().splitlines() or [type(error).__name__])[-1], 300)


@contextmanager
def _connected(address: str | None, local_cpus: int) -> Iterator[ModuleType]:
    """Ray, connected; afterwards as connected as before, and this process as it was."""
    with ExitStack() as undone:
        undone.enter_context(_hooks_as_they_were())
        before = dict(os.environ)
        ray = require("ray", extra="ray", to="export with Ray actors")
        if not ray.is_initialized():
            undone.enter_context(_without_warnings())
            try:
                _connect(ray, address, local_cpus)
            finally:
                undone.callback(_undo_environment, before, dict(os.environ))
                undone.callback(ray.shutdown)
        yield ray


def _connect(ray: ModuleType, address: str | None, local_cpus: int) -> None:
    # A Ray that would ask or report by default does neither; its processes inherit it.
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    own: dict[str, Any] = {
        "num_cpus": local_cpus,
        "object_store_memory": _OBJECT_STORE_BYTES,
        "include_dashboard": False,
    }
    handler = signal.getsignal(signal.SIGTERM)
    try:
        _check_reachable(address)
        ray.init(
            "local" if address is None else address,
            **(own if address is None else {}),
            log_to_driver=False,
            configure_logging=False,
        )
    except (OSError, RuntimeError, ValueError) as error:
        place = "on this machine" if address is None else f"at {printable(address, 200)}"
        raise WeatherAugError(f"no Ray could be reached {place}: {error}") from error
    finally:
        # Ray's handler would end this process without a word about the export.
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, handler)


def _check_reachable(address: str | None) -> None:
    """Knock at host:port first, because `ray.init` waits for ever where nobody answers."""
    host, _, port = (address or "").rpartition("://")[2].rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_WAIT_S).close()


def _undo_environment(before: dict[str, str], during: dict[str, str]) -> None:
    """Take back what Ray set, but not what somebody else has set since."""
    for name in set(before) | set(during):
        old, new = before.get(name), during.get(name)
        if old != new and os.environ.get(name) == new:
            if old is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = old


@contextmanager
def _without_warnings() -> Iterator[None]:
    """Keep advice to who runs a cluster off stderr, where this package says one sentence."""
    logger = logging.getLogger("ray")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


@contextmanager
def _hooks_as_they_were() -> Iterator[None]:
    hook, faults = sys.excepthook, faulthandler.is_enabled()
    try:
        yield
    finally:
        sys.excepthook = hook
        if not faults:
            faulthandler.disable()
