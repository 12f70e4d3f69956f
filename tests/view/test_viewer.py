"""The server of a scene: it answers, sends what falls around a browser's camera, and stops."""

from __future__ import annotations

import http.client
import re
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tiny_reconstruction import TRACK_ID, tiny_reconstruction

from weather_aug.cli import main
from weather_aug.errors import ArgumentError, MissingExtraError
from weather_aug.gaussians.types import Reconstruction
from weather_aug.scene.scene import WeatherScene
from weather_aug.view import viewer as module
from weather_aug.view.viewer import CAPACITY, PARTICLES_PER_M, Viewer, open_viewer

messages = pytest.importorskip("viser._messages", reason="viser is not installed: extra view")

PATIENCE_S = 20.0


class Reconstructed(WeatherScene):
    """A scene with a reconstruction of a street like its own."""

    reconstruction: Reconstruction | None = None  # type: ignore[assignment]


def reconstructed(scene: WeatherScene) -> WeatherScene:
    found = Reconstructed(scene.path)
    found.reconstruction = tiny_reconstruction(styles=("snow",))
    return found


@pytest.fixture(params=["points", "gaussians"])
def viewer(request: pytest.FixtureRequest, tiny_scene: WeatherScene) -> Iterator[Viewer]:
    scene = reconstructed(tiny_scene) if request.param == "gaussians" else tiny_scene
    with open_viewer(scene, weather="snow", seed=5, port=0) as found:
        yield found


class Browser:
    """What a browser would say and hear, without drawing it."""

    def __init__(self, viewer: Viewer) -> None:
        import viser
        from websockets.sync.client import connect

        self._socket = connect(
            viewer.address.replace("http", "ws"),
            subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
            max_size=None,
            compression=None,
        )

    def look(self, **changes: Any) -> None:
        """Tell the server of a camera that looks along x, 1.5 m over the road."""
        import msgspec.msgpack

        camera = {
            "wxyz": (0.5, -0.5, 0.5, -0.5),
            "position": (0.0, 0.0, 1.5),
            "fov": 1.0,
            "near": 0.05,
            "far": 1000.0,
            "image_height": 540,
            "image_width": 960,
            "look_at": (5.0, 0.0, 1.5),
            "up_direction": (0.0, 0.0, 1.0),
        }
        message = messages.ViewerCameraMessage(**(camera | changes))
        self._socket.send(msgspec.msgpack.encode(message.as_serializable_dict()))

    def close(self) -> None:
        """As when the tab is closed."""
        self._socket.close()


@pytest.fixture
def browser(viewer: Viewer) -> Iterator[Browser]:
    found = Browser(viewer)
    yield found
    found.close()


def awaited(value: Callable[[], Any]) -> Any:
    """The first value that is true."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        found = value()
        if found:
            return found
        time.sleep(0.05)
    raise AssertionError("it did not come to be")


def places(viewer: Viewer) -> NDArray[np.float32]:
    """(N, 3) of the visible particles that the only browser has, metres."""
    (handle,) = awaited(lambda: list(viewer._falling.values()))
    buffer = handle.buffer.copy()
    assert len(buffer) == CAPACITY
    opacity = buffer[:, 7] >> 24
    centres = buffer[:, :3].copy().view(np.float32)
    found: NDArray[np.float32] = centres[opacity > 0] / PARTICLES_PER_M
    return found


def test_it_answers_and_stops(viewer: Viewer) -> None:
    host, port = viewer.server.get_host(), viewer.server.get_port()
    assert (host, viewer.address) == ("127.0.0.1", f"http://127.0.0.1:{port}")
    connection = http.client.HTTPConnection(host, port, timeout=PATIENCE_S)
    connection.request("GET", "/")
    answer = connection.getresponse()
    assert answer.status == 200
    assert b"<html" in answer.read().lower()
    connection.close()
    viewer.stop()
    viewer.stop()
    viewer.wait()
    with pytest.raises(OSError):
        http.client.HTTPConnection(host, port, timeout=1).connect()


def test_it_falls_around_the_browsers_camera_and_moves(viewer: Viewer, browser: Browser) -> None:
    browser.look()
    before = places(viewer)
    assert len(before) > 300
    assert np.quantile(before[:, 0], 0.01) > 0
    assert np.quantile(before[:, 0], 0.99) < 70
    awaited(lambda: not np.array_equal(places(viewer), before))
    browser.look(position=(1000.0, 0.0, 1.5), look_at=(1005.0, 0.0, 1.5))
    awaited(lambda: places(viewer)[:, 0].min() > 900)


def test_what_is_set_is_shown(viewer: Viewer, browser: Browser) -> None:
    browser.look()
    snow = len(places(viewer))
    viewer._controls._pause.value = True
    awaited(lambda: viewer._clock_s == (time.sleep(0.3), viewer._clock_s)[1])
    viewer._controls._time.value = 7.5
    awaited(lambda: viewer._clock_s == 7.5)
    viewer._controls.kind.value = "fog"
    awaited(lambda: len(places(viewer)) == 0)
    viewer._controls.kind.value = "snow"
    awaited(lambda: len(places(viewer)) > snow // 2)
    viewer._controls.particles.value = False
    (handle,) = viewer._falling.values()
    awaited(lambda: not handle.visible)
    viewer._controls.parts["scene"].value = False
    awaited(lambda: not viewer._street._background.visible)


def test_a_closed_browser_is_forgotten(viewer: Viewer) -> None:
    browser = Browser(viewer)
    browser.look()
    awaited(lambda: viewer._falling)
    browser.close()
    awaited(lambda: not viewer._falling)


def colours(handle: Any) -> NDArray[np.uint8]:
    """(N, 3) of the splats of a handle."""
    rgba: NDArray[np.uint8] = handle.buffer[:, 7:8].copy().view(np.uint8)
    return rgba[:, :3]


def test_gaussians_have_the_colours_of_the_weather_and_actors_go(tiny_scene: WeatherScene) -> None:
    scene = reconstructed(tiny_scene)
    reconstruction = scene.reconstruction
    assert reconstruction is not None
    with open_viewer(scene, weather="clear", port=0) as viewer:
        viewer._controls._pause.value = True
        street = viewer._street
        assert len(street._background.buffer) == len(reconstruction.background)
        assert len(street._sky) == 6
        own = colours(street._background).mean()
        viewer._controls.kind.value = "snow"
        awaited(lambda: colours(street._background).mean() > own + 20)
        actors = street._actors
        assert len(actors.buffer) == len(reconstruction.actor_gaussians)
        start = actors.buffer[:, 0].copy().view(np.float32).mean()
        viewer._controls._time.value = 0.5
        awaited(lambda: actors.buffer[:, 0].copy().view(np.float32).mean() > start + 2)
        viewer._controls._tracks[TRACK_ID].value = False
        awaited(lambda: not (actors.buffer[:, 7] >> 24).any())


def test_what_stops_the_viewer_is_handed_on(
    tiny_scene: WeatherScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An error in the thread would else be a browser in which nothing moves any more."""

    def broken(*_: object) -> None:
        raise RuntimeError("planted")

    with open_viewer(tiny_scene, port=0) as viewer:
        monkeypatch.setattr(module._Controls, "moved_s", broken)
        with pytest.raises(RuntimeError, match="planted"):
            viewer.wait()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"weather": "hail"}, "hail.*clear, rain"),
        ({"severity": "awful"}, "awful"),
        ({"port": 70000}, "0..65535"),
        ({"port": True}, "0..65535"),
        ({"seed": 0.5}, "seed"),
        ({"host": "256.0.0.1"}, "cannot listen on host '256.0.0.1'"),
    ],
)
def test_what_cannot_be_served_is_refused(
    tiny_scene: WeatherScene, changes: dict[str, Any], says: str
) -> None:
    with pytest.raises(ArgumentError, match=says):
        open_viewer(tiny_scene, **({"port": 0} | changes))


def test_without_viser_its_extra_is_named(
    tiny_scene: WeatherScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingExtraError, match=re.escape("weather-aug[view]")):
        open_viewer(tiny_scene, port=0)


def test_the_command_prints_the_address_and_ends_with_ctrl_c(
    tiny_scene: WeatherScene, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(self: Viewer) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Viewer, "wait", interrupted)
    main(["view", str(tiny_scene.path), "--weather", "rain", "--severity", "0.4", "--port", "0"])
    said = capsys.readouterr().out
    assert re.search(r"open http://127\.0\.0\.1:\d+ in a browser", said)
    assert "closed" in said
