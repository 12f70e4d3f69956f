"""Plain folders: pairing, labels, depth files, and clips labelled by a teacher."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from weather_aug import taxonomy
from weather_aug.clip.folder import FolderClip
from weather_aug.clip.labelled import LabelledClip
from weather_aug.clip.open import open_clip
from weather_aug.clip.types import Clip
from weather_aug.errors import ArgumentError, ClipError, DataError
from weather_aug.taxonomy import BUILDING, IGNORE, ROAD, SKY

DATA = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "camvid-dev"
needs_camvid = pytest.mark.skipif(not DATA.is_dir(), reason="no shared CamVid data")

HEIGHT, WIDTH = 30, 40


def _label() -> NDArray[np.uint8]:
    label = np.full((HEIGHT, WIDTH), ROAD, np.uint8)
    label[:10], label[10:17] = SKY, BUILDING
    return label


def _picture(path: Path, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (90, 60, 40)).save(path)


def _labels(path: Path, label: NDArray[np.uint8] | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(_label() if label is None else label).save(path)


@needs_camvid
def test_camvid_opens_by_its_address() -> None:
    clip = open_clip(f"folder:{DATA}?images=train&labels=trainannot&taxonomy=camvid11")
    assert isinstance(clip, Clip)
    assert len(clip.keys) == 40
    frame = clip.frame(clip.keys[0])
    assert frame.image.shape == (360, 480, 3)
    assert frame.label is not None and frame.depth_m is not None
    assert set(np.unique(frame.label)) <= {*range(19), IGNORE}
    np.testing.assert_array_equal(np.isinf(frame.depth_m[frame.label == SKY]), True)
    road = frame.depth_m[frame.label == ROAD]
    assert np.isfinite(road).all() and road.min() > 2.0


def test_depth_prior_agrees_with_the_camera(tmp_path: Path) -> None:
    _picture(tmp_path / "images" / "a.png")
    _labels(tmp_path / "labels" / "a.png")
    clip = FolderClip(
        tmp_path,
        images="images",
        labels="labels",
        taxonomy="train_ids",
        pitch_deg=4.0,
        height_m=2.0,
    )
    frame = clip.frame(clip.keys[0])
    assert frame.depth_m is not None
    ray = np.linalg.inv(frame.camera.intrinsics) @ np.array([11.0, 28.0, 1.0])
    point = frame.camera.world_from_camera @ np.array([*ray * frame.depth_m[28, 11], 1.0])
    # The world's origin is on the ground.
    assert point[:3] @ clip.up_world == pytest.approx(0.0, abs=1e-4)


def test_pictures_without_labels_have_no_depth(tmp_path: Path) -> None:
    _picture(tmp_path / "a.png")
    frame = FolderClip(tmp_path).frame(FolderClip(tmp_path).keys[0])
    assert frame.label is None and frame.depth_m is None


def test_cityscapes_endings_pair(tmp_path: Path) -> None:
    for city, name in (("aachen", "a_000000_000019"), ("bonn", "b_000001_000019")):
        _picture(tmp_path / "leftImg8bit" / city / f"{name}_leftImg8bit.png")
        ids = np.full((HEIGHT, WIDTH), 7, np.uint8)
        _labels(tmp_path / "gtFine" / city / f"{name}_gtFine_labelIds.png", ids)
        _labels(tmp_path / "gtFine" / city / f"{name}_gtFine_labelTrainIds.png")
        _labels(tmp_path / "gtFine" / city / f"{name}_gtFine_instanceIds.png", ids)
        _picture(tmp_path / "gtFine" / city / f"{name}_gtFine_color.png")
    by_id = FolderClip(tmp_path, images="leftImg8bit", labels="gtFine", taxonomy="cityscapes")
    np.testing.assert_array_equal(ROAD, by_id.frame(by_id.keys[1]).label)
    by_train_id = FolderClip(tmp_path, images="leftImg8bit", labels="gtFine")
    np.testing.assert_array_equal(_label(), by_train_id.frame(by_train_id.keys[0]).label)


def test_acdc_endings_pair(tmp_path: Path) -> None:
    _picture(tmp_path / "rgb" / "GOPR0475" / "x_000041_rgb_anon.png")
    _labels(tmp_path / "gt" / "GOPR0475" / "x_000041_gt_labelTrainIds.png")
    _labels(tmp_path / "gt" / "GOPR0475" / "x_000041_gt_invIds.png")
    clip = FolderClip(tmp_path, images="rgb", labels="gt")
    np.testing.assert_array_equal(_label(), clip.frame(clip.keys[0]).label)


def test_the_ending_of_the_label_files_tells_their_taxonomy(tmp_path: Path) -> None:
    """Read as train ids, Cityscapes' 7 (road) would be a traffic sign."""
    _picture(tmp_path / "images" / "a_leftImg8bit.png")
    ids = np.full((HEIGHT, WIDTH), 7, np.uint8)
    _labels(tmp_path / "labels" / "a_gtFine_labelIds.png", ids)
    clip = FolderClip(tmp_path, images="images", labels="labels")
    np.testing.assert_array_equal(ROAD, clip.frame(clip.keys[0]).label)
    _labels(tmp_path / "labels" / "a_gtFine_labelTrainIds.png")
    both = FolderClip(tmp_path, images="images", labels="labels")
    np.testing.assert_array_equal(_label(), both.frame(both.keys[0]).label)


def test_label_files_that_do_not_tell_need_a_taxonomy(tmp_path: Path) -> None:
    _picture(tmp_path / "images" / "a.png")
    _labels(tmp_path / "labels" / "a.png")
    with pytest.raises(ArgumentError, match=r"labels do not say.*taxonomy=") as caught:
        FolderClip(tmp_path, images="images", labels="labels")
    assert all(name in str(caught.value) for name in taxonomy.TAXONOMIES)
    for name in taxonomy.TAXONOMIES:
        assert FolderClip(tmp_path, images="images", labels="labels", taxonomy=name).keys
    with pytest.raises(ClipError, match="nowhere does not exist"):
        FolderClip(tmp_path, images="images", labels="nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ClipError, match=r"empty holds no \.png"):
        FolderClip(tmp_path, images="images", labels="empty")


def test_pictures_are_a_drive_only_at_a_speed(tmp_path: Path) -> None:
    _picture(tmp_path / "a.png")
    assert not FolderClip(tmp_path).is_drive
    assert FolderClip(tmp_path, speed_m_per_s=8.0).is_drive
    assert FolderClip(tmp_path, speed_m_per_s=0.0).is_drive
    assert open_clip(f"folder:{tmp_path}?speed_m_per_s=4").is_drive  # type: ignore[attr-defined]


def test_a_picture_without_its_label_is_named(tmp_path: Path) -> None:
    for name in ("a", "b"):
        _picture(tmp_path / "images" / f"{name}.png")
    _labels(tmp_path / "labels" / "a.png")
    with pytest.raises(ClipError, match=r"images/b\.png has no label in .*labels \(1 of 2"):
        FolderClip(tmp_path, images="images", labels="labels", taxonomy="train_ids")


def test_a_label_of_another_size_names_both_files(tmp_path: Path) -> None:
    _picture(tmp_path / "images" / "a.png", (WIDTH, HEIGHT + 1))
    _labels(tmp_path / "labels" / "a.png")
    clip = FolderClip(tmp_path, images="images", labels="labels", taxonomy="train_ids")
    with pytest.raises(ClipError, match=r"labels/a\.png is 40x30, .*images/a\.png is 40x31"):
        clip.frame(clip.keys[0])


def test_unknown_ids_name_the_file(tmp_path: Path) -> None:
    _picture(tmp_path / "images" / "a.png")
    _labels(tmp_path / "labels" / "a.png", np.full((HEIGHT, WIDTH), 77, np.uint8))
    clip = FolderClip(tmp_path, images="images", labels="labels", taxonomy="train_ids")
    with pytest.raises(DataError, match=r"labels/a\.png: label id 77"):
        clip.frame(clip.keys[0])


def test_empty_folders_and_double_names_are_refused(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    with pytest.raises(ClipError, match=r"images holds no \.png"):
        FolderClip(tmp_path, images="images")
    _picture(tmp_path / "images" / "a.png")
    _picture(tmp_path / "images" / "a.jpg")
    with pytest.raises(ClipError, match="have one name"):
        FolderClip(tmp_path, images="images")


def test_depth_png_is_read_in_kitti_units_and_completed(tmp_path: Path) -> None:
    _picture(tmp_path / "images" / "a.png")
    _labels(tmp_path / "labels" / "a.png")
    steps = np.full((HEIGHT, WIDTH), 20 * 256, np.uint16)
    steps[:10] = 0
    steps[20:24, 10:20] = 0
    (tmp_path / "depth").mkdir()
    Image.fromarray(steps).save(tmp_path / "depth" / "a.png")
    clip = FolderClip(
        tmp_path, images="images", labels="labels", taxonomy="train_ids", depth="depth"
    )
    depth = clip.frame(clip.keys[0]).depth_m
    assert depth is not None
    np.testing.assert_array_equal(np.isinf(depth), _label() == SKY)
    np.testing.assert_allclose(20.0, depth[10:], rtol=1e-3)


def test_depth_npy_keeps_what_it_knows(tmp_path: Path) -> None:
    _picture(tmp_path / "images" / "a.png")
    (tmp_path / "depth").mkdir()
    metres = np.linspace(5, 50, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)[::-1].copy()
    metres[0], metres[29, 3] = np.inf, np.nan
    np.save(tmp_path / "depth" / "a.npy", metres)
    clip = FolderClip(tmp_path, images="images", depth="depth")
    depth = clip.frame(clip.keys[0]).depth_m
    assert depth is not None and depth.dtype == np.float32
    known = np.isfinite(metres)
    np.testing.assert_array_equal(metres[known].astype(np.float32), depth[known])
    assert np.isinf(depth[0]).all()
    assert metres[29, 4] < depth[29, 3] < metres[28, 3]


@pytest.mark.parametrize(
    ("array", "expected"),
    [
        (np.zeros((HEIGHT, WIDTH)), "holds no finite depth"),
        (np.ones((HEIGHT, WIDTH), np.int32), "must be floats"),
        (np.ones((3, 3)), r"depth/a\.npy is 3x3, its picture"),
        (np.array([{"a": 1}], object), "cannot be read as an array"),
    ],
)
def test_bad_depth_files_are_named(
    tmp_path: Path, array: NDArray[np.generic], expected: str
) -> None:
    _picture(tmp_path / "images" / "a.png")
    (tmp_path / "depth").mkdir()
    np.save(tmp_path / "depth" / "a.npy", array)
    clip = FolderClip(tmp_path, images="images", depth="depth")
    with pytest.raises(ClipError, match=expected):
        clip.frame(clip.keys[0])


def test_scale_shrinks_all_together(tmp_path: Path) -> None:
    _picture(tmp_path / "images" / "a.png")
    _labels(tmp_path / "labels" / "a.png")
    whole = FolderClip(tmp_path, images="images", labels="labels", taxonomy="train_ids")
    half = FolderClip(tmp_path, images="images", labels="labels", taxonomy="train_ids", scale=0.5)
    big, small = whole.frame(whole.keys[0]), half.frame(half.keys[0])
    assert small.image.shape == (15, 20, 3)
    assert small.label is not None and small.depth_m is not None and big.depth_m is not None
    assert set(np.unique(small.label)) == {ROAD, BUILDING, SKY}
    # Row 12 of the half picture lies between rows 24 and 25 of the whole one.
    between = 2 / (1 / big.depth_m[24, 5] + 1 / big.depth_m[25, 5])
    assert small.depth_m[12, 2] == pytest.approx(between, rel=1e-4)


def test_frames_are_read_only_and_repeat(tmp_path: Path) -> None:
    _picture(tmp_path / "images" / "a.png")
    _labels(tmp_path / "labels" / "a.png")
    clip = FolderClip(tmp_path, images="images", labels="labels", taxonomy="train_ids")
    first, second = clip.frame(clip.keys[0]), clip.frame(clip.keys[0])
    for name in ("image", "label", "depth_m"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(first, name)[0, 0] = 1
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_a_teacher_labels_what_has_none(tmp_path: Path) -> None:
    _picture(tmp_path / "images" / "a.png")
    clip = LabelledClip(FolderClip(tmp_path, images="images"), lambda image: _label())
    assert isinstance(clip, Clip)
    np.testing.assert_array_equal(_label(), clip.frame(clip.keys[0]).label)


def test_a_teacher_leaves_labels_and_pictures_alone(tmp_path: Path) -> None:
    _picture(tmp_path / "images" / "a.png")
    _labels(tmp_path / "labels" / "a.png")
    labelled = FolderClip(tmp_path, images="images", labels="labels", taxonomy="train_ids")
    clip = LabelledClip(labelled, lambda image: np.zeros(image.shape[:2], np.uint8))
    np.testing.assert_array_equal(_label(), clip.frame(clip.keys[0]).label)

    def spoiling(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        image[:] = 0
        return image[..., 0]

    frame = LabelledClip(FolderClip(tmp_path, images="images"), spoiling).frame(clip.keys[0])
    assert (frame.image == (90, 60, 40)).all()


@pytest.mark.parametrize(
    ("answer", "expected"),
    [
        (np.zeros((3, 3), np.uint8), "uint8 array of shape"),
        (np.zeros((HEIGHT, WIDTH), np.int64), "uint8 array of shape"),
        (np.full((HEIGHT, WIDTH), 19, np.uint8), "returned 19, which is no train id"),
        (None, "got <class 'NoneType'>"),
    ],
)
def test_a_teacher_is_checked(tmp_path: Path, answer: object, expected: str) -> None:
    _picture(tmp_path / "images" / "a.png")
    clip = LabelledClip(FolderClip(tmp_path, images="images"), lambda image: answer)
    with pytest.raises(ArgumentError, match=expected):
        clip.frame(clip.keys[0])


@needs_camvid
def test_a_label_is_read_without_its_picture() -> None:
    clip = open_clip(f"folder:{DATA}?images=val&labels=valannot&taxonomy=camvid11&scale=0.5")
    key = clip.keys[3]
    label = clip.label(key)
    assert (label == clip.frame(key).label).all()
    assert not label.flags.writeable
    assert open_clip(f"folder:{DATA}?images=val").label(key) is None
