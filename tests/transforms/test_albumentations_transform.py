"""RandomWeather in an albumentations pipeline: reproducible, replayable, honest on its inputs."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import albumentations as A
import cv2
import numpy as np
import pytest
from tiny_clip import TinyClip
from torch.utils.data import DataLoader, Dataset

from weather_aug.clip.types import Camera, FrameKey
from weather_aug.errors import ArgumentError, DataError
from weather_aug.render.options import RenderOptions
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.taxonomy import IGNORE, SKY, taxonomy
from weather_aug.transforms.albumentations import RandomWeather
from weather_aug.transforms.picture import default_camera

DATA = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "camvid-dev"
SNOW = WeatherPolicy({"snow": 1}, severity=(0.9, 1.0), falling=1.0)
FOG = WeatherPolicy({"fog": 1}, severity=(1.0, 1.0))

Sample = dict[str, Any]


@pytest.fixture
def sample() -> Sample:
    """Picture, mask and true depth of the tiny street, and something else of the caller's."""
    frame = TinyClip().frame(FrameKey(0, "front"))
    return {
        "image": frame.image.copy(),
        "mask": frame.label.copy(),
        "depth": frame.depth_m.copy(),
        "name": "street",
    }


def pipeline(policy: WeatherPolicy = SNOW, seed: int | None = 7, **options: Any) -> A.Compose:
    weather = RandomWeather(policy, p=options.pop("p", 1.0), **options)
    return A.Compose([weather], additional_targets={"depth": "mask"}, seed=seed)


def test_a_pipeline_weathers_the_picture_and_keeps_the_rest(sample: Sample) -> None:
    done = pipeline()(**sample)
    assert (done["image"].dtype, done["image"].shape) == (np.uint8, sample["image"].shape)
    assert (done["image"] != sample["image"]).any()
    assert done["depth"].dtype == np.float32
    assert done["depth"].tobytes() == sample["depth"].tobytes()
    assert done["name"] == "street"


def test_the_mask_says_what_can_be_seen(sample: Sample) -> None:
    done = pipeline(FOG)(**sample)
    hidden = done["mask"] != sample["mask"]
    assert hidden.any()
    assert (done["mask"][hidden] == IGNORE).all()
    assert (sample["depth"][hidden] > 60).all()
    assert done["depth"].tobytes() == sample["depth"].tobytes()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int16, np.int32, np.int64])
def test_the_mask_keeps_its_type(sample: Sample, dtype: type) -> None:
    done = pipeline(FOG)(**sample | {"mask": sample["mask"].astype(dtype)})
    assert done["mask"].dtype == dtype
    assert (done["mask"] == pipeline(FOG)(**sample)["mask"]).all()


def test_inputs_are_not_changed(sample: Sample) -> None:
    before = {name: sample[name].tobytes() for name in ("image", "mask", "depth")}
    done = pipeline()(**sample)
    assert {name: sample[name].tobytes() for name in before} == before
    assert not np.shares_memory(done["image"], sample["image"])


def test_probability_zero_changes_nothing(sample: Sample) -> None:
    done = pipeline(p=0.0)(**sample)
    assert all((done[name] == sample[name]).all() for name in ("image", "mask", "depth"))


def test_probability_is_kept(sample: Sample) -> None:
    half = pipeline(p=0.5)
    changed = sum((half(**sample)["image"] != sample["image"]).any() for _ in range(200))
    assert 60 <= changed <= 140  # 5.6 standard deviations about 100


def test_clear_weather_gives_the_same_bytes(sample: Sample) -> None:
    done = pipeline(WeatherPolicy({"clear": 1}))(**sample)
    assert done["image"].tobytes() == sample["image"].tobytes()
    assert done["mask"].tobytes() == sample["mask"].tobytes()


def test_the_pipelines_seed_decides(sample: Sample) -> None:
    pipelines = [pipeline(seed=seed) for seed in (1, 1, 2)]
    runs = [[each(**sample)["image"].tobytes() for _ in range(3)] for each in pipelines]
    assert runs[0] == runs[1]
    assert len({*runs[0], *runs[2]}) == 6


def test_global_generators_do_not_matter(sample: Sample) -> None:
    np.random.seed(0)  # noqa: NPY002 - the global state is what is tested
    expected = pipeline()(**sample)["image"]
    np.random.seed(1)  # noqa: NPY002
    state = np.random.get_state()[1].tolist()  # noqa: NPY002
    assert (pipeline()(**sample)["image"] == expected).all()
    assert np.random.get_state()[1].tolist() == state  # noqa: NPY002


def test_effects_are_left_out_by_name(sample: Sample) -> None:
    rain = WeatherPolicy({"rain": 1}, severity=(1.0, 1.0), falling=1.0)
    whole = pipeline(rain)(**sample)["image"]
    options = RenderOptions(max_particles=900, without=("relight", "sky", "film", "mirror"))
    less = pipeline(rain, options=options)
    assert (less(**sample)["image"] != whole).any()
    assert (pipeline(rain, options=RenderOptions())(**sample)["image"] == whole).all()
    again = A.from_dict(json.loads(json.dumps(A.to_dict(less))))
    less.set_random_seed(3)
    again.set_random_seed(3)
    assert (less(**sample)["image"] == again(**sample)["image"]).all()
    few = RandomWeather(options=options, max_particles=7).weathering.options
    assert few == replace(options, max_particles=7)
    assert RandomWeather(options=options).weathering.options == options


def test_depth_comes_from_the_call_where_it_is_given(sample: Sample) -> None:
    near = sample | {"depth": np.full_like(sample["depth"], 2.0)}
    far = sample | {"depth": np.full_like(sample["depth"], 500.0)}
    assert (pipeline(FOG)(**near)["mask"] == sample["mask"]).all()
    assert (pipeline(FOG)(**far)["mask"] != sample["mask"]).any()


def test_without_depth_the_mask_gives_a_prior(sample: Sample) -> None:
    del sample["depth"]
    done = pipeline(FOG)(**sample)
    hidden = done["mask"] != sample["mask"]
    rows = np.nonzero(hidden)[0]
    assert 0 < hidden.mean() < 0.5
    assert rows.max() < sample["mask"].shape[0] * 0.75, "the road before the car is near"


def test_depth_alone_is_enough(sample: Sample) -> None:
    del sample["mask"]
    assert (pipeline()(**sample)["image"] != sample["image"]).any()


def test_the_camera_comes_from_the_call_where_it_is_given(sample: Sample) -> None:
    camera = TinyClip().camera(FrameKey(0, "front"))
    own = pipeline()(**sample, camera=camera)
    assert own["camera"] is camera
    assert (own["image"] != pipeline()(**sample)["image"]).any()


def test_the_default_camera_sees_sixty_degrees_and_drives_ahead() -> None:
    camera = default_camera((480, 640), 10.0)
    assert np.degrees(2 * np.arctan(320 / camera.focal_px[0])) == pytest.approx(60)
    assert camera.principal_px == (319.5, 239.5)
    assert camera.velocity_m_per_s.tolist() == [0, 0, 10]


def test_speed_leans_the_streaks(sample: Sample) -> None:
    rain = WeatherPolicy({"rain": 1}, severity=(1.0, 1.0), falling=1.0)
    stands = pipeline(rain, speed_m_per_s=(0.0, 0.0))(**sample)["image"]
    drives = pipeline(rain, speed_m_per_s=(30.0, 30.0))(**sample)["image"]
    assert (stands != drives).any()


class Weathered(Dataset[Any]):
    """What users write: the pipeline is made once and copied into the workers."""

    def __init__(self, sample: Sample, length: int = 8, p: float = 1.0) -> None:
        self.sample, self.length = sample, length
        self.pipeline = pipeline(p=p)

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> Any:
        return self.pipeline(**self.sample)["image"]


@pytest.mark.filterwarnings(
    # Loaders fork by default on Linux; Python 3.12 warns of it wherever torch has threads.
    "ignore:This process .* is multi-threaded, use of fork:DeprecationWarning"
)
def test_two_workers_do_not_draw_the_same_weather(sample: Sample) -> None:
    """Stock albumentations 2.0.8 repeats itself: each worker has a copy of one generator."""
    loader = DataLoader(Weathered(sample), batch_size=None, num_workers=2, timeout=60)
    pictures = [picture.numpy().tobytes() for picture in loader]
    assert len(pictures) == 8
    assert len(set(pictures)) == 8


@pytest.mark.filterwarnings(
    "ignore:This process .* is multi-threaded, use of fork:DeprecationWarning"
)
def test_two_workers_do_not_decide_alike(sample: Sample) -> None:
    """Whether there is weather at all is not the same in both, sample after sample."""
    dataset = Weathered(sample, length=32, p=0.5)
    loader = DataLoader(dataset, batch_size=None, num_workers=2, timeout=60)
    decided = [bool((picture.numpy() != sample["image"]).any()) for picture in loader]
    assert decided[::2] != decided[1::2]
    assert 4 <= sum(decided) <= 28


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"image": np.zeros((48, 64, 3), np.float64)}, "image must be uint8, or float32"),
        ({"image": np.full((48, 64, 3), 1.1, np.float32)}, "image must be finite and in"),
        ({"image": np.zeros((48, 64, 1), np.uint8)}, r"image must have shape \(H, W, 3\)"),
        ({"mask": np.full((48, 64), 7.5, np.float32)}, "mask must be an integer"),
        ({"mask": np.zeros((48, 64), np.int8)}, "mask must be an integer array"),
        ({"mask": np.zeros((48, 64), bool)}, "mask must be an integer array"),
        ({"depth": np.full((48, 64), 7, np.uint16)}, "depth must be a float array"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_cannot_be_weathered_is_refused(sample: Sample, change: Sample, says: str) -> None:
    with pytest.raises(ArgumentError, match=says):
        pipeline()(**sample | change)


@pytest.mark.parametrize("unknown", [-1, 19, 1000])
def test_ids_that_are_no_classes_are_faults_or_ignored(sample: Sample, unknown: int) -> None:
    mask = sample["mask"].astype(np.int32)
    mask[:5] = unknown
    with pytest.raises(DataError, match=str(unknown)):
        pipeline(FOG)(**sample | {"mask": mask})
    done = pipeline(FOG, unknown_ids="ignore")(**sample | {"mask": mask})
    assert set(np.unique(done["mask"])) <= {*np.unique(mask), IGNORE}


@pytest.mark.parametrize("name", ["mask", "depth"])
def test_another_size_is_refused_by_name(sample: Sample, name: str) -> None:
    weather = RandomWeather(SNOW, p=1.0)
    with pytest.raises(ArgumentError, match=f"{name} must have the image's shape"):
        weather(**sample | {name: sample[name][:-1]})


def test_a_camera_of_another_size_is_refused(sample: Sample) -> None:
    camera = Camera(np.diag([50.0, 50, 1]), np.eye(4), 32, 32)
    with pytest.raises(DataError, match="camera"):
        RandomWeather(SNOW, p=1.0)(image=sample["image"], mask=sample["mask"], camera=camera)


@pytest.mark.parametrize("kind", ["image", "images", "volume", "volumes"])
def test_a_second_picture_is_refused_when_the_pipeline_is_made(kind: str) -> None:
    """It came back as the first picture."""
    with pytest.raises(ArgumentError, match="'right' is another picture"):
        A.Compose([A.HorizontalFlip(), RandomWeather(SNOW)], additional_targets={"right": kind})


@pytest.mark.parametrize(
    ("name", "axes", "along"),
    [
        ("images", (None,), True),
        ("volume", (None,), True),
        ("volume", (None,), False),
        ("volumes", (None, None), False),
    ],
)
def test_a_second_picture_is_refused_at_the_call(
    sample: Sample, name: str, axes: tuple[None, ...], along: bool
) -> None:
    data = {name: sample["image"][axes]} | ({"image": sample["image"]} if along else {})
    with pytest.raises(ArgumentError, match=f"'{name}' is another picture"):
        pipeline()(**data, mask=sample["mask"])


def test_a_call_without_a_picture_is_refused(sample: Sample) -> None:
    with pytest.raises(ArgumentError, match="pass image="):
        pipeline()(mask=sample["mask"])


def test_only_the_mask_is_marked(sample: Sample) -> None:
    """Boxes, points, instance maps and lists of masks pass through: weather moves nothing."""
    instances = np.arange(48 * 64, dtype=np.int32).reshape(48, 64) + 1000
    others = {
        "instances": instances,
        "ids": sample["mask"],
        "mask3d": sample["mask"][None],
        "masks": [sample["mask"] % 2, sample["mask"] % 3],
        "bboxes": np.array([[1.0, 2.0, 30.0, 40.0]]),
        "keypoints": np.array([[3.0, 4.0], [50.0, 40.0]]),
    }
    compose = A.Compose(
        [RandomWeather(FOG, p=1.0)],
        bbox_params=A.BboxParams("pascal_voc", label_fields=["classes"]),
        keypoint_params=A.KeypointParams("xy"),
        additional_targets={"depth": "mask", "instances": "mask", "ids": "mask"},
    )
    done = compose(**sample, **others, classes=["car"])
    assert (done["mask"] == IGNORE).any()
    for name, value in others.items():
        # Compose itself scales boxes to [0, 1] and back, in float32.
        assert np.allclose(done[name], value, rtol=0, atol=1e-4), name
    assert done["instances"].dtype == np.int32
    assert done["classes"] == ["car"]


def holed(depth: np.ndarray, share: float, hole: float) -> np.ndarray:
    """The depth with `share` of its finite pixels lost."""
    lost = np.random.default_rng(3).random(depth.shape) < share
    return np.where(lost & np.isfinite(depth), np.float32(hole), depth)


@pytest.mark.parametrize("hole", [np.nan, 0.0, -1.0, -np.inf])
@pytest.mark.parametrize("masked", [True, False])
def test_a_sparse_depth_is_refused_not_taken_for_far(
    sample: Sample, hole: float, masked: bool
) -> None:
    if not masked:
        del sample["mask"]
    for share in (0.6, 1.0):
        with pytest.raises(ArgumentError, match="complete the depth first"):
            pipeline(FOG)(**sample | {"depth": holed(sample["depth"], share, hole)})
    pipeline(FOG)(**sample | {"depth": holed(sample["depth"], 0.4, hole)})


def test_infinite_depth_is_sky_only_where_the_mask_allows(sample: Sample) -> None:
    half = sample | {"depth": holed(sample["depth"], 0.6, np.inf)}
    with pytest.raises(ArgumentError, match="complete the depth first"):
        pipeline()(**half)
    pipeline()(**half | {"mask": np.full((48, 64), IGNORE, np.uint8)})
    del half["mask"]
    pipeline()(**half)
    with pytest.raises(ArgumentError, match="on 0% of the pixels"):
        pipeline()(image=sample["image"], depth=np.full((48, 64), np.inf, np.float32))


def test_a_picture_of_sky_alone_needs_no_depth(sample: Sample) -> None:
    nothing = {"mask": np.full((48, 64), SKY, np.uint8), "depth": np.zeros((48, 64), np.float32)}
    assert pipeline(FOG)(**sample | nothing)["image"].shape == (48, 64, 3)


def test_without_albumentations_the_error_names_the_extra() -> None:
    code = (
        "import sys; sys.modules['albumentations'] = None\n"
        "from weather_aug.errors import MissingExtraError\n"
        "try:\n    import weather_aug.transforms.albumentations\n"
        "except MissingExtraError as error:\n    print(error)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert "pip install 'weather-aug[albumentations]'" in run.stdout, run.stderr


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"policy": {"types": {"hail": 1}}}, "hail"),
        ({"policy": {"wetness": 1}}, "no field wetness"),
        ({"speed_m_per_s": (0.0, 1000.0)}, "speed_m_per_s"),
        ({"speed_m_per_s": (9.0, 3.0)}, "speed_m_per_s"),
        ({"camera_height_m": 0.0}, "camera_height_m"),
        ({"hfov_deg": 1.0}, "hfov_deg"),
        ({"max_particles": -1}, "max_particles"),
        ({"taxonomy": "mars"}, "mars"),
        ({"ignore_index": 2**40}, "ignore_index"),
        ({"unknown_ids": "guess"}, "unknown_ids"),
        ({"scenes": "scenes/0000"}, "scenes must be a sequence"),
        ({"fps": 0.0}, "fps"),
        ({"seed": 0.5}, "seed must be an integer"),
        ({"p": 1.5}, "p must be a finite number"),
        ({"options": "fast"}, "options must be RenderOptions"),
        ({"options": {"speed": 3}}, "no field speed"),
        ({"options": {"without": ["rainbow"]}}, "rainbow"),
    ],
    ids=str,
)
def test_bad_arguments_are_refused_at_once(arguments: dict[str, Any], says: str) -> None:
    with pytest.raises(ArgumentError, match=says):
        RandomWeather(**arguments)


@pytest.mark.skipif(not DATA.is_dir(), reason="the CamVid sample is not beside the repository")
@pytest.mark.parametrize("policy", [SNOW, FOG], ids=["snow", "fog"])
def test_a_real_picture(policy: WeatherPolicy) -> None:
    path = min((DATA / "train").glob("*.png"))
    image = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
    ids = cv2.imread(str(DATA / "trainannot" / path.name), cv2.IMREAD_UNCHANGED)
    mask = taxonomy("camvid11").train_ids(ids, where=path.name)
    done = pipeline(policy)(image=image, mask=mask)
    assert done["image"].shape == image.shape
    assert np.abs(done["image"].astype(int) - image).mean() > 5
    assert set(np.unique(done["mask"])) <= {*np.unique(mask), IGNORE}
    own = pipeline(policy, taxonomy="camvid11", ignore_index=11)(image=image, mask=ids)
    assert own["image"].tobytes() == done["image"].tobytes()
    assert (own["mask"] == np.where(done["mask"] == mask, ids, 11)).all()
    assert (done["mask"][-20:] == mask[-20:]).mean() > 0.9, "the road before the car stays"
