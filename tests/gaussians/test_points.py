"""Pixels as points: edges are found on any slant, and each place is seen best by one view."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from box_street import FACADES, BoxStreet

from weather_aug.clip.types import Frame, FrameKey
from weather_aug.gaussians import points
from weather_aug.gaussians.points import View, inside, points_world, seen_best, view_of
from weather_aug.taxonomy import BUILDING, SKY, TRAIN_ID

POST = (TRAIN_ID["pole"], (10.0, 10.2), (-2.05, -1.95), (0.0, 4.0))


def frame_of(t: int = 0, **options: object) -> Frame:
    return BoxStreet(boxes=(*FACADES, POST), **options).frame(FrameKey(t, "front"))  # type: ignore[arg-type]


def test_a_slanted_road_has_no_edges_and_its_slope_is_the_planes() -> None:
    frame = BoxStreet(boxes=()).frame(FrameKey(0, "front"))
    view = view_of(frame)
    assert view.usable[np.asarray(frame.depth_m) < 100].all()
    rows, columns = np.nonzero(view.usable & (view.depth_m < 100))
    per_row = 1 / (frame.camera.focal_px[1] * 1.6)
    assert np.allclose(view.slopes[rows, columns, 1], per_row, rtol=1e-3)
    assert np.abs(view.slopes[rows, columns, 0]).max() < 1e-3 * per_row


def test_posts_keep_their_depth_and_what_is_just_behind_them_is_skipped() -> None:
    frame = frame_of()
    assert frame.label is not None
    view, post = view_of(frame), frame.label == TRAIN_ID["pole"]
    assert post.any() and view.usable[post].all()
    beside = np.zeros_like(post)
    beside[:, 1:] |= post[:, :-1]
    beside[:, :-1] |= post[:, 1:]
    beside &= ~post & (frame.label != SKY) & (frame.depth_m > 12)  # type: ignore[operator]
    assert beside.any() and not view.usable[beside].any()


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_pixels_between_two_surfaces_are_skipped(share: float) -> None:
    frame = frame_of()
    assert frame.depth_m is not None and frame.label is not None
    post = frame.label == TRAIN_ID["pole"]
    row = 80
    edge = int(np.flatnonzero(post[row]).max()) + 1
    near, far = frame.depth_m[row, edge - 1], frame.depth_m[row, edge]
    assert far > 1.3 * near
    depth = frame.depth_m.copy()
    depth[:, edge] = share * near + (1 - share) * far
    view = view_of(replace(frame, depth_m=depth))
    assert not view.usable[row, edge] and view.usable[row, edge - 1]


def test_edges_of_pictures_and_of_what_is_known_are_no_edges() -> None:
    frame = BoxStreet(boxes=()).frame(FrameKey(0, "front"))
    assert frame.depth_m is not None
    depth = frame.depth_m.copy()
    depth[130:140, 50:60] = np.nan
    view = view_of(replace(frame, depth_m=depth))
    known = np.asarray(frame.depth_m) < 100
    known[130:140, 50:60] = False
    assert view.usable[known].all() and not view.usable[130:140, 50:60].any()


def test_labels_settle_what_is_sky() -> None:
    frame = frame_of()
    assert frame.depth_m is not None and frame.label is not None
    label, depth = frame.label.copy(), frame.depth_m.copy()
    label[:4], depth[:4] = BUILDING, np.inf
    label[4:8], depth[4:8] = SKY, 20.0
    view = view_of(replace(frame, label=label, depth_m=depth))
    assert (view.depth_m[:4] == points.SHELL_M).all() and view.usable[1:3].all()
    assert np.isinf(view.depth_m[4:8]).all() and not view.usable[4:8].any()
    blind = view_of(replace(frame, label=None, depth_m=depth))
    assert np.isinf(blind.depth_m[:4]).all() and (blind.depth_m[4:8] == 20.0).all()


def test_every_nth_pixel_is_where_it_was() -> None:
    frame = frame_of()
    whole, thin = view_of(frame), view_of(frame, 3)
    rows, columns = np.nonzero(thin.usable)
    there = points_world(whole, 3 * rows + 1, 3 * columns + 1)
    assert np.allclose(points_world(thin, rows, columns), there, atol=1e-5)
    window = view_of(frame, window=(slice(90, 150), slice(40, 200)))
    there = points_world(whole, np.array([100]), np.array([50]))
    assert np.allclose(points_world(window, np.array([10]), np.array([10])), there, atol=1e-5)
    assert np.allclose(thin.colours[5, 5], frame.image[15:18, 15:18].mean((0, 1)) / 255, atol=3e-3)


def slowly_seen_best(views: list[View]) -> list[np.ndarray]:
    """The rule of `seen_best` in plain numpy."""
    best = []
    for i, view in enumerate(views):
        rows, columns = np.nonzero(view.usable)
        places, own = points_world(view, rows, columns), view.depth_m[rows, columns].astype(float)

        def rank(depth: np.ndarray, other: View) -> np.ndarray:
            footprint = depth / (other.lens[0] * other.stride_px)
            return np.floor(np.log(footprint) / np.log(points.FOOTPRINT_RATIO))

        beaten = np.zeros(len(rows), bool)
        for j, other in enumerate(views):
            if j == i:
                continue
            pose = other.world_from_camera
            local = (places - pose[:3, 3]) @ pose[:3, :3]
            with np.errstate(all="ignore"):
                u = other.lens[0] * local[:, 0] / local[:, 2] + other.lens[2]
                v = other.lens[1] * local[:, 1] / local[:, 2] + other.lens[3]
                h, w = other.depth_m.shape
                there = (local[:, 2] >= 0.5) & (np.floor(u + 0.5) >= 0) & (np.floor(u + 0.5) < w)
                there &= (np.floor(v + 0.5) >= 0) & (np.floor(v + 0.5) < h)
            column = np.floor(np.where(there, u, 0) + 0.5).astype(int)
            row = np.floor(np.where(there, v, 0) + 0.5).astype(int)
            known = other.usable[row, column] | np.isinf(other.depth_m[row, column])
            depth = np.where(there, local[:, 2], 1.0)
            there &= known & (depth <= other.depth_m[row, column] + points.BEHIND_SHARE * own)
            mine, theirs = rank(own, view), rank(depth, other)
            beaten |= there & ((theirs < mine) | ((theirs == mine) & (j < i)))
        kept = np.zeros_like(view.usable)
        kept[rows[~beaten], columns[~beaten]] = True
        best.append(kept)
    return best


def test_each_place_is_seen_best_by_the_nearest_view_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    views = [view_of(frame_of(t)) for t in range(4)] + [view_of(frame_of(1), 2)]
    fast = seen_best(views)
    for one, other in zip(fast, slowly_seen_best(views), strict=True):
        assert (one != other).mean() < 1e-4
    # The last picture again, thinned, sees nothing better than it does whole.
    assert fast[4].sum() < 0.02 * views[4].usable.sum()
    monkeypatch.setattr(points, "BEHIND_SHARE", 0.2)
    other = slowly_seen_best(views)
    assert any((a != b).mean() > 1e-3 for a, b in zip(fast, other, strict=True))


def test_every_place_stays_seen_by_some_view() -> None:
    """A road and two walls, seen from four places: what is left covers what any view saw."""
    views = [view_of(BoxStreet(boxes=FACADES).frame(FrameKey(t, "front"))) for t in range(4)]
    best = seen_best(views)
    left = np.concatenate(
        [points_world(v, *np.nonzero(b)) for v, b in zip(views, best, strict=True)]
    )
    seen = np.concatenate([points_world(v, *np.nonzero(v.usable)) for v in views])
    near = (np.abs(seen[:, 0] - 25) < 15) & (np.abs(seen[:, 1]) < 9.5)

    def cells(places: np.ndarray) -> set[tuple[int, ...]]:
        return set(map(tuple, np.floor((places + 0.7) / 1.5).astype(int)))

    lost = cells(seen[near]) - cells(left)
    assert len(lost) <= 0.02 * len(cells(seen[near]))


def test_boxes_hold_what_is_inside() -> None:
    from weather_aug.clip.types import Box

    pose = np.eye(4)
    pose[:2, :2] = [[0, -1], [1, 0]]
    pose[:3, 3] = (10, 0, 1)
    box = Box(1, "Car", pose, (4.0, 2.0, 1.5))
    places = np.array([[10, 2.05, 1], [10, 2.15, 1], [11.04, 0, 1], [11.1, 0, 1.0]])
    assert inside(places, box).tolist() == [True, False, True, False]
    assert inside(places, box, margin_m=0.1).all()
