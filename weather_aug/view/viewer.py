"""A scene in a browser: its Gaussians, the recorded cameras, and weather that falls meanwhile.

Convention:
    The server holds the scene; what falls is computed for each browser's own camera, ten times a
    second, from the same particle field as `render`'s. One clock runs for everybody: particles
    follow it without end, the recorded drive (what moves in it) begins anew when it is over. A
    browser draws a preview, not `render`'s picture: see `weather_aug.view.splats` for what it
    cannot do, and it knows fog as a linear fade only.
"""

from __future__ import annotations

import socket
import threading
import time
from types import TracebackType
from typing import Any

import numpy as np

from weather_aug._extras import require
from weather_aug._keys import check_seed
from weather_aug.clip.types import Camera
from weather_aug.errors import ArgumentError, printable
from weather_aug.scene.policy import TYPES, weather_of
from weather_aug.scene.scene import WeatherScene
from weather_aug.severity import parse_severity
from weather_aug.view import splats
from weather_aug.view.standing import Standing
from weather_aug.weather import Weather

RATE_HZ = 10.0
"""How often particles and actors are placed anew."""
MOST_PARTICLES = 4000
CAPACITY = 3 * MOST_PARTICLES // 2
"""Some are just outside the picture, and their number scatters; a browser's room is fixed."""
PARTICLES_PER_M = 100.0
"""Particles are sent in centimetres: as square metres their covariances would be 0 in float16."""
EMPHASIS = 3.0


def open_viewer(
    scene: WeatherScene,
    *,
    weather: str = "snow",
    severity: float | str = "heavy",
    seed: int = 0,
    host: str = "127.0.0.1",
    port: int = 8080,
) -> Viewer:
    """Serve a scene to browsers until `Viewer.stop`.

    Args:
        scene: With its reconstruction; without, the points of the frames' depth are shown.
        weather: Type to begin with: clear, rain, snow or fog.
        severity: In [0, 1] or a name (light, moderate, heavy, extreme).
        seed: Which particles fall and which gusts blow.
        host: Address to listen on. Whoever reaches it sees the scene: keep the loopback's, and use
            an SSH tunnel from elsewhere.
        port: In 0..65535; 0 is any free one. Where it is taken, the next free one is used.

    Raises:
        MissingExtraError: If viser is not installed.
        ArgumentError: If an argument is outside what is accepted, or nobody can listen on `host`.
    """
    viser = require("viser", extra="view", to="show a scene in a browser")
    if weather not in TYPES:
        raise ArgumentError(f"weather type {printable(weather)!r} is not one of {', '.join(TYPES)}")
    start = parse_severity(severity)
    check_seed("seed", seed)
    if isinstance(port, bool) or not isinstance(port, int) or not 0 <= port <= 65535:
        raise ArgumentError(f"port must be an integer in 0..65535, got {printable(port)}")
    _check_host(host)
    server = viser.ViserServer(host=host, port=port, label=scene.name, verbose=False)
    try:
        return Viewer(server, scene, weather, start, seed)
    except BaseException:
        server.stop()
        raise


class Viewer:
    """A server that shows one scene; made by `open_viewer`. Also a context manager that stops."""

    def __init__(
        self, server: Any, scene: WeatherScene, kind: str, severity: float, seed: int
    ) -> None:
        """Use `open_viewer`."""
        self.server = server
        self._street = Standing(server, scene)
        self._controls = _Controls(server, self._street, kind, severity, seed)
        self._falling: dict[int, Any] = {}
        self._clock_s = 0.0
        self._error: BaseException | None = None
        # The first particles compile their kernels; no browser should wait for that.
        self._falling_around(self._street.camera, weather_of("snow", severity))
        self._stopping, self._stopped = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="weather-aug view", daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """URL to open."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def stop(self) -> None:
        """Close the server and its browsers' connections; twice does no harm."""
        self._stopping.set()
        self._thread.join()
        if not self._stopped.is_set():
            self._stopped.set()
            self.server.stop()

    def wait(self) -> None:
        """Return when the viewer has stopped; raise what has stopped it, if it was an error."""
        while self._thread.is_alive():
            self._thread.join(0.5)
        if self._error is not None:
            raise self._error

    def __enter__(self) -> Viewer:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def _run(self) -> None:
        try:
            before = time.monotonic()
            while not self._stopping.wait(1 / RATE_HZ):
                now = time.monotonic()
                self._show(now - before)
                before = now
        except BaseException as error:
            # A thread's error would be printed and forgotten; `wait` hands it on.
            self._error = error

    def _show(self, elapsed_s: float) -> None:
        """Let the clock run on, and show what has changed."""
        controls, street = self._controls, self._street
        self._clock_s = controls.moved_s(self._clock_s, elapsed_s)
        drive_s = self._clock_s % street.span_s
        controls.show_time(drive_s)
        weather = controls.weather
        street.show_weather(weather, controls.kind.value, float(controls.severity.value))
        street.show_parts(controls.ticked)
        street.show_actors(drive_s, controls.hidden_tracks)
        clients = self.server.get_clients()
        self._falling = {name: h for name, h in self._falling.items() if name in clients}
        for name, client in clients.items():
            self._show_falling(name, client, weather)

    def _show_falling(self, name: int, client: Any, weather: Weather) -> None:
        controls, street = self._controls, self._street
        if name in self._falling:
            self._falling[name].visible = controls.particles.value
        if not controls.particles.value or not client.camera.image_height:
            return
        camera = client.camera
        view = splats.browser_camera(
            camera.position,
            camera.wxyz,
            camera.fov,
            (camera.image_width, camera.image_height),
            street.camera,
        )
        arrays = self._falling_around(view, weather)
        if name in self._falling:
            self._falling[name].set_gaussians(*arrays)
        else:
            self._falling[name] = client.scene.add_gaussian_splats(
                "/particles", *arrays, scale=1 / PARTICLES_PER_M
            )

    def _falling_around(self, view: Camera, weather: Weather) -> splats.Splats:
        """Particles of a camera at the clock's time, padded, in centimetres."""
        found = splats.particle_splats(
            view,
            self._clock_s,
            weather,
            int(self._controls.seed.value),
            self._street.light,
            shelter=self._street.scene.shelter,
            max_particles=MOST_PARTICLES,
            emphasis=float(self._controls.emphasis.value),
        ).padded(CAPACITY)
        return found._replace(
            centres_m=found.centres_m * np.float32(PARTICLES_PER_M),
            covariances_m2=found.covariances_m2 * np.float32(PARTICLES_PER_M**2),
        )


class _Controls:
    """What people set."""

    def __init__(
        self, server: Any, street: Standing, kind: str, severity: float, seed: int
    ) -> None:
        gui = server.gui
        with gui.add_folder("weather"):
            self.kind = gui.add_dropdown("type", tuple(TYPES), initial_value=kind)
            self.severity = gui.add_slider("severity", 0.0, 1.0, 0.01, severity)
            self.seed = gui.add_number("seed", seed, step=1)
            self.emphasis = gui.add_slider(
                "emphasis", 1.0, 10.0, 0.5, EMPHASIS, hint="Factor on the opacity of particles"
            )
        with gui.add_folder("time"):
            self._time = gui.add_slider("second", 0.0, street.span_s, 0.01, 0.0)
            self._pause = gui.add_checkbox("pause", False)
        with gui.add_folder("show"):
            self.particles = gui.add_checkbox("particles", True)
            self.parts = {name: gui.add_checkbox(name, name != "cameras") for name in street.parts}
        self._tracks = {}
        if street.tracks:
            with gui.add_folder("moving"):
                self._tracks = {
                    track: gui.add_checkbox(f"{name} {track}", True)
                    for track, name in street.tracks.items()
                }
        self._shown_s = 0.0

    @property
    def weather(self) -> Weather:
        """As set now."""
        return weather_of(self.kind.value, min(max(float(self.severity.value), 0.0), 1.0))

    @property
    def ticked(self) -> dict[str, bool]:
        """Which parts of the scene are shown."""
        return {name: bool(box.value) for name, box in self.parts.items()}

    @property
    def hidden_tracks(self) -> set[int]:
        """Of what moves."""
        return {track for track, box in self._tracks.items() if not box.value}

    def moved_s(self, clock_s: float, elapsed_s: float) -> float:
        """The clock after some time, or where somebody has put it."""
        if self._time.value != self._shown_s:
            return float(self._time.value)
        return clock_s if self._pause.value else clock_s + elapsed_s

    def show_time(self, drive_s: float) -> None:
        """Put the slider where the clock is."""
        self._shown_s = round(drive_s, 2)
        self._time.value = self._shown_s


def _check_host(host: str) -> None:
    try:
        socket.create_server((host, 0)).close()
    except OSError as error:
        raise ArgumentError(
            f"cannot listen on host {printable(host)!r}: {error.strerror or error}; 127.0.0.1 is "
            "this machine alone"
        ) from None
