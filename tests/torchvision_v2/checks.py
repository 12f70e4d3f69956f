"""RandomWeather in a v2.Compose, against the real torchvision.

Run by `test_torchvision.py` in a process of its own, and named so that nobody collects it where
torchvision is absent.
"""

from __future__ import annotations

import copy
import pickle
import random
from collections.abc import Callable
from typing import Any

import numpy as np
import PIL.Image
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_clip import TinyClip
from torch.utils.data import DataLoader, Dataset
from torchvision import tv_tensors
from torchvision.transforms import v2

from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.errors import ArgumentError, DataError, WeatherAugError
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.taxonomy import IGNORE
from weather_aug.transforms import draws
from weather_aug.transforms.torchvision import (
    Depth,
    RandomWeather,
    SampleKey,
    SceneKey,
    Unmarked,
)

SNOW = WeatherPolicy({"snow": 1}, severity=(0.9, 1.0), falling=1.0)
FOG = WeatherPolicy({"fog": 1}, severity=(1.0, 1.0))
CLEAR = WeatherPolicy({"clear": 1})
NAME = SampleKey(5)
FRONT = FrameKey(0, "front")
SIZE = (48, 64)


def frame_at(time_index: int = 0) -> Frame:
    return TinyClip().frame(FrameKey(time_index, "front"))


def image_of(frame: Frame) -> tv_tensors.Image:
    return tv_tensors.Image(torch.from_numpy(frame.image.transpose(2, 0, 1).copy()))


@pytest.fixture
def image() -> tv_tensors.Image:
    return image_of(frame_at())


@pytest.fixture
def mask() -> tv_tensors.Mask:
    return tv_tensors.Mask(torch.from_numpy(frame_at().label.copy()))


@pytest.fixture
def depth() -> Depth:
    return Depth(torch.from_numpy(frame_at().depth_m.astype(np.float32)))


def always(policy: WeatherPolicy = SNOW, **how: Any) -> RandomWeather:
    return RandomWeather(policy, p=1.0, **how)


def bits(tensor: torch.Tensor) -> bytes:
    return tensor.contiguous().numpy().tobytes()


def test_the_line_of_the_readme(image: Any, mask: Any) -> None:
    policy = WeatherPolicy.rain(mm_per_h=(20, 75))
    transform = v2.Compose(
        [RandomWeather(policy, p=0.7), v2.RandomCrop(32), v2.RandomHorizontalFlip()]
    )
    done, marked = transform(image, mask)
    assert (type(done), type(marked)) == (tv_tensors.Image, tv_tensors.Mask)
    assert (done.shape, marked.shape) == ((3, 32, 32), (32, 32))
    assert "p=0.7" in repr(transform)


# Pictures


def test_every_kind_of_picture_gets_the_same_weather(image: Any, mask: Any) -> None:
    weather = always()
    expected = weather(image, mask, NAME)[0]
    assert type(expected) is tv_tensors.Image
    assert (expected.dtype, expected.shape) == (torch.uint8, image.shape)
    assert (expected != image).float().mean() > 0.5

    plain = weather(image.as_subclass(torch.Tensor), mask, NAME)[0]
    assert type(plain) is torch.Tensor
    assert torch.equal(plain, expected)

    floats = weather(v2.functional.to_dtype(image, torch.float32, scale=True), mask, NAME)[0]
    assert (type(floats), floats.dtype) == (tv_tensors.Image, torch.float32)
    assert torch.equal(floats, v2.functional.to_dtype(expected, torch.float32, scale=True))

    pil = weather(v2.functional.to_pil_image(image), mask, NAME)[0]
    assert isinstance(pil, PIL.Image.Image)
    assert (np.asarray(pil).transpose(2, 0, 1) == expected.numpy()).all()

    video = weather(tv_tensors.Video(image[None]), tv_tensors.Mask(mask[None]), NAME)[0]
    assert type(video) is tv_tensors.Video
    assert torch.equal(video[0], expected)


class Marked(tv_tensors.Image):
    """A caller's own class."""


def test_wraps_are_kept(image: Any, mask: Any) -> None:
    done, marked = always(FOG)(Marked(image), mask)
    assert (type(done), type(marked)) == (Marked, tv_tensors.Mask)


def layouts(image: torch.Tensor) -> dict[str, torch.Tensor]:
    last = image.permute(1, 2, 0).contiguous().permute(2, 0, 1)
    wide = torch.cat([image, image], dim=-1)[..., : image.shape[-1]]
    return {"contiguous": image.contiguous(), "channels last": last, "a part": wide}


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_the_layout_does_not_matter(image: Any, mask: Any, dtype: torch.dtype) -> None:
    plain = v2.functional.to_dtype(image, dtype, scale=True).as_subclass(torch.Tensor)
    given = layouts(plain)
    assert not all(each.is_contiguous() for each in given.values())
    done = {name: always()(each, mask, NAME)[0] for name, each in given.items()}
    assert all(each.is_contiguous() for each in done.values())
    assert len({bits(each) for each in done.values()}) == 1


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 1), (33, 17)])
@pytest.mark.parametrize("policy", [SNOW, FOG])
def test_odd_sizes(image: Any, mask: Any, size: tuple[int, int], policy: WeatherPolicy) -> None:
    done, marked = always(policy)(*v2.CenterCrop(size)(image, mask))
    assert (done.shape, marked.shape) == ((3, *size), size)


def test_clear_weather_gives_the_same_numbers(image: Any, mask: Any) -> None:
    for exact in (image, v2.functional.to_dtype(image, torch.float32, scale=True)):
        done, marked = always(CLEAR)(exact, mask)
        assert bits(done) == bits(exact)
        assert bits(marked) == bits(mask)


def test_what_the_weather_leaves_alone_keeps_its_finer_value(image: Any, mask: Any) -> None:
    exact = v2.functional.to_dtype(image, torch.float32, scale=True)
    fine = tv_tensors.Image((exact + 0.3 / 255).clamp(0, 1))
    done, _ = always(CLEAR)(fine, mask)
    assert bits(done) == bits(fine)
    assert torch.equal(always(FOG)(fine, mask, NAME)[1], always(FOG)(exact, mask, NAME)[1])
    both = [always(FOG)(each, mask, NAME)[0] for each in (fine, exact)]
    assert float((both[0] - both[1]).abs().max()) < 0.4 / 255


def unchanged(transform: Callable[..., Any], *sample: torch.Tensor) -> bool:
    before = [bits(each) for each in sample]
    done = [each for each in transform(*sample, NAME) if isinstance(each, torch.Tensor)]
    apart = {each.data_ptr() for each in done[:2]}.isdisjoint(each.data_ptr() for each in sample)
    return apart and before == [bits(each) for each in sample]


def test_inputs_are_not_changed(image: Any, mask: Any, depth: Any) -> None:
    assert unchanged(always(FOG), image, mask, depth)
    assert unchanged(always(CLEAR), image, mask, depth)
    assert unchanged(always(SNOW), image.permute(0, 1, 2), mask, depth)

    class InPlace(RandomWeather):
        def transform(self, inpt: Any, params: Any) -> Any:
            done = super().transform(inpt, params)
            return inpt.copy_(done) if isinstance(inpt, torch.Tensor) else done

    assert not unchanged(InPlace(FOG, p=1.0), image, mask, depth)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_tensors_come_back_on_their_device(image: Any, mask: Any) -> None:
    expected = always(FOG)(image, mask, NAME)
    done = always(FOG)(
        tv_tensors.Image(image, device="cuda"), tv_tensors.Mask(mask, device="cuda"), NAME
    )
    assert [each.device.type for each in done[:2]] == ["cuda", "cuda"]
    assert all(torch.equal(a.cpu(), b) for a, b in zip(done[:2], expected[:2], strict=True))


# Masks and depth


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int16, torch.int32, torch.int64])
@pytest.mark.parametrize("leading", [(), (1,)])
def test_the_mask_says_what_can_be_seen(
    image: Any, mask: Any, depth: Any, dtype: torch.dtype, leading: tuple[int, ...]
) -> None:
    typed = tv_tensors.Mask(mask.to(dtype).reshape(*leading, *SIZE))
    _, marked, _ = always(FOG)(image, typed, depth)
    assert (type(marked), marked.dtype, marked.shape) == (tv_tensors.Mask, dtype, typed.shape)
    assert marked.is_contiguous()
    hidden = marked != typed
    assert hidden.any()
    assert (marked[hidden] == IGNORE).all()
    assert (depth.reshape(typed.shape)[hidden] > 60).all()


def test_the_ignore_index_is_the_callers(image: Any, mask: Any, depth: Any) -> None:
    _, usual, _ = always(FOG)(image, mask, depth, NAME)[:3]
    signed = tv_tensors.Mask(mask.long())
    _, own, _ = always(FOG, ignore_index=-1)(image, signed, depth, NAME)[:3]
    assert torch.equal(own == -1, usual == IGNORE)
    with pytest.raises(ArgumentError, match="cannot hold ignore_index -1"):
        always(FOG, ignore_index=-1)(image, mask, depth)


def test_depth_decides_and_is_handed_on(image: Any, mask: Any, depth: Any) -> None:
    near, far = (Depth(torch.full(SIZE, metres)) for metres in (2.0, 500.0))
    assert torch.equal(always(FOG)(image, mask, near)[1], mask)
    done = always(FOG)(image, mask, far)
    assert not torch.equal(done[1], mask)
    assert done[2] is far
    assert always(FOG)(image, mask, depth)[2] is depth


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
@pytest.mark.parametrize("leading", [(), (1,)])
def test_depth_of_any_float_type(
    image: Any, mask: Any, dtype: torch.dtype, leading: tuple[int, ...]
) -> None:
    metres = torch.linspace(4, 512, 48).round().bfloat16().float()[:, None].expand(SIZE)
    expected = always(FOG)(image, mask, Depth(metres), NAME)
    done = always(FOG)(image, mask, Depth(metres.to(dtype).reshape(*leading, *SIZE)), NAME)
    assert torch.equal(done[0], expected[0])
    assert torch.equal(done[1], expected[1])


def test_depth_alone_is_enough(image: Any, depth: Any) -> None:
    assert not torch.equal(always(FOG)(image, depth)[0], image)


@pytest.mark.parametrize("kind", [Depth, Unmarked])
def test_v2_moves_depth_as_a_mask(depth: Any, kind: type) -> None:
    given = kind(depth)
    moves = {
        "flip": (v2.RandomHorizontalFlip(p=1.0), depth.flip(-1)),
        "crop": (v2.CenterCrop((20, 30)), depth[14:34, 17:47]),
        "resize": (v2.Resize((24, 32)), depth[::2, ::2]),
        "type": (v2.ToDtype(torch.float32, scale=True), depth),
        "affine": (v2.RandomAffine(degrees=(0, 0)), depth),
    }
    for name, (move, expected) in moves.items():
        done = move(given)
        assert (type(done), done.dtype) == (kind, torch.float32), name
        assert torch.equal(done.as_subclass(torch.Tensor), expected.as_subclass(torch.Tensor)), name


def test_a_pipeline_crops_everything_alike(image: Any, mask: Any, depth: Any) -> None:
    """What comes after the weather sees the weathered picture, mask and depth as one."""
    weather = always(FOG)
    whole = weather(image, mask, depth, NAME)
    pipeline = v2.Compose([weather, v2.CenterCrop((32, 40)), v2.RandomHorizontalFlip(p=1.0)])
    for part, all_of_it in zip(pipeline(image, mask, depth, NAME)[:3], whole[:3], strict=True):
        assert torch.equal(part, all_of_it[..., 8:40, 12:52].flip(-1))


def test_the_camera_is_the_callers(image: Any, mask: Any) -> None:
    camera = TinyClip().camera(FRONT)
    done = always()(image, mask, NAME, camera)
    assert done[3] is camera
    assert not torch.equal(done[0], always()(image, mask, NAME)[0])


# Structures


def test_everything_else_is_handed_on_as_it_is(image: Any, mask: Any) -> None:
    boxes = tv_tensors.BoundingBoxes([[1, 2, 30, 40]], format="XYXY", canvas_size=SIZE)
    others = {
        "boxes": boxes,
        "labels": torch.tensor([3]),
        "instances": Unmarked(torch.arange(48 * 64).reshape(1, *SIZE)),
        "name": "street",
        "array": np.zeros((48, 64, 3), np.uint8),
        "nothing": None,
        "key": NAME,
        "object": object(),
    }
    if hasattr(tv_tensors, "KeyPoints"):
        others["points"] = tv_tensors.KeyPoints([[3.0, 4.0]], canvas_size=SIZE)
    done = always(FOG)({"image": image, "mask": mask, **others})
    assert list(done) == ["image", "mask", *others]
    assert all(done[name] is value for name, value in others.items())
    assert not torch.equal(done["mask"], mask)


def test_any_structure_comes_back(image: Any, mask: Any) -> None:
    expected = always(FOG)(image, mask, NAME)
    for sample in (
        {"image": image, "target": {"mask": mask, "key": NAME}},
        [image, [mask, {"key": NAME}]],
        ((image,), (mask, NAME)),
        {"key": NAME, "mask": mask, "image": image},
    ):
        done = always(FOG)(sample)
        given, spec = torch.utils._pytree.tree_flatten(sample)
        found, found_spec = torch.utils._pytree.tree_flatten(done)
        assert found_spec == spec
        for inpt, out in zip(given, found, strict=True):
            wanted = expected[0] if inpt is image else expected[1] if inpt is mask else inpt
            assert out is wanted or torch.equal(out, wanted)


@pytest.mark.filterwarnings("ignore:depth is guessed")
def test_one_picture_alone(image: Any) -> None:
    done = v2.Compose([always(), v2.ToDtype(torch.float32, scale=True)])(image)
    assert (type(done), done.dtype) == (tv_tensors.Image, torch.float32)


# Draws


def test_probability_zero_hands_the_same_objects_on(image: Any, mask: Any) -> None:
    done = RandomWeather(SNOW, p=0)(image, mask)
    assert done[0] is image
    assert done[1] is mask


def weathered(transform: RandomWeather, image: Any, mask: Any, count: int) -> list[Any]:
    done = [transform(image, mask, SampleKey(number))[0] for number in range(count)]
    return [None if each is image else bits(each) for each in done]


def test_probability_is_kept_and_tells_nothing_about_the_weather(image: Any, mask: Any) -> None:
    by_p = {p: weathered(RandomWeather(SNOW, p=p), image, mask, 200) for p in (0.3, 0.6, 1.0)}
    for p, tolerance in ((0.3, 37), (0.6, 39), (1.0, 0)):  # 5.6 standard deviations
        assert abs(200 * p - sum(each is not None for each in by_p[p])) <= tolerance
    for rare, often in ((0.3, 0.6), (0.6, 1.0)):
        pairs = zip(by_p[rare], by_p[often], strict=True)
        assert all(few is None or few == many for few, many in pairs)


def generators() -> tuple[Any, ...]:
    numpy_state = np.random.get_state()  # noqa: NPY002 - the global state is what is tested
    return random.getstate(), numpy_state[1].tolist(), torch.get_rng_state().tolist()


def reads_no_generator(transform: RandomWeather, image: Any, mask: Any) -> bool:
    results = []
    for seed in range(5):
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        torch.manual_seed(seed)
        state = generators()
        again = copy.deepcopy(transform)
        results.append(
            (*(bits(again(image, mask, NAME)[0]) for _ in range(3)), bits(again(image, mask)[0]))
        )
        if generators() != state:
            return False
    return len(set(results)) == 1


def test_global_generators_are_neither_read_nor_moved(image: Any, mask: Any) -> None:
    assert reads_no_generator(RandomWeather(SNOW, p=0.5), image, mask)
    assert reads_no_generator(always(), image, mask)

    class Gated(RandomWeather):
        """As v2's own transforms decide on p."""

        def make_params(self, flat_inputs: list[Any]) -> dict[str, Any]:
            self.p = float(torch.rand(1))
            return super().make_params(flat_inputs)

    assert not reads_no_generator(Gated(SNOW), image, mask)


def test_a_name_decides_alone(image: Any, mask: Any) -> None:
    names = [0, 1, -1, "0", "a", ("a", 1), ("a", "1"), (0, 0)]
    first, again = always(seed=3), always(seed=3)
    one = {name: bits(first(image, mask, SampleKey(name))[0]) for name in names}
    always_moving = [again(image, mask) for _ in range(3)]
    two = {name: bits(again(image, mask, SampleKey(name))[0]) for name in reversed(names)}
    assert one == two
    assert len({*one.values(), *(bits(each[0]) for each in always_moving)}) == len(names) + 3


def test_seed_and_epoch_decide(image: Any, mask: Any) -> None:
    found = []
    for seed in (0, 1):
        weather = always(seed=seed)
        for epoch in (0, 1, 0):
            weather.set_epoch(epoch)
            found.append(bits(weather(image, mask, NAME)[0]))
    assert found[0] == found[2]
    assert found[3] == found[5]
    assert len(set(found)) == 4


@given(number=st.integers(-(2**63), 2**63 - 1), text=st.text(max_size=9))
def test_a_key_survives_pickling(number: int, text: str) -> None:
    key = SampleKey((number, text))
    again = pickle.loads(pickle.dumps(key))
    assert again == key
    assert hash(again) == hash(key)


class Streets(Dataset[Any]):
    """What users write: the transform is made once and copied into the workers."""

    def __init__(self, transform: Any, named: bool) -> None:
        self.transform, self.named = transform, named

    def __len__(self) -> int:
        return 8

    def __getitem__(self, index: int) -> Any:
        image, mask = image_of(frame_at()), tv_tensors.Mask(torch.from_numpy(frame_at().label + 0))
        name = [SampleKey(index)] if self.named else []
        image, mask, *_ = self.transform(image, mask, *name)
        return image, mask


def epoch_of(loader: DataLoader[Any]) -> list[bytes]:
    return [bits(image) for images, _ in loader for image in images]


def loader_of(dataset: Dataset[Any], workers: int, **how: Any) -> DataLoader[Any]:
    # Forked, because the declared schemas are of this process.
    context = {"multiprocessing_context": "fork", "timeout": 120} if workers else {}
    return DataLoader(dataset, num_workers=workers, **context, **how)


forks = pytest.mark.filterwarnings(
    # Python 3.12 warns of it wherever torch has threads.
    "ignore:This process .* is multi-threaded, use of fork:DeprecationWarning"
)


@forks
def test_the_number_of_workers_does_not_matter(image: Any) -> None:
    pipeline = v2.Compose([RandomWeather(SNOW, p=0.7), v2.ToDtype(torch.float32, scale=True)])
    streets = Streets(pipeline, named=True)
    alone = epoch_of(loader_of(streets, 0, batch_size=1))
    assert alone == epoch_of(loader_of(streets, 2, batch_size=1))
    assert alone == epoch_of(loader_of(streets, 2, batch_size=3))
    assert len(set(alone)) > 2
    assert alone != epoch_of(loader_of(Streets(pipeline, named=False), 2, batch_size=1))


@forks
def test_workers_do_not_draw_the_same_weather(monkeypatch: pytest.MonkeyPatch) -> None:
    streets = Streets(always(), named=False)
    assert len(set(epoch_of(loader_of(streets, 2, batch_size=2)))) == 8
    monkeypatch.setattr(draws, "worker_seed", lambda: 0)
    assert len(set(epoch_of(loader_of(streets, 2, batch_size=2)))) == 4


@forks
def test_an_epoch_reaches_persistent_workers() -> None:
    weather = always()
    loader = loader_of(Streets(weather, named=True), 2, batch_size=4, persistent_workers=True)
    fresh = always()
    for epoch in (0, 3):
        weather.set_epoch(epoch)
        fresh.set_epoch(epoch)
        assert epoch_of(loader) == epoch_of(loader_of(Streets(fresh, named=True), 0, batch_size=4))


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda t: pickle.loads(pickle.dumps(t))])
def test_a_copy_goes_on_alike(clone: Callable[[Any], Any], image: Any, mask: Any) -> None:
    weather = RandomWeather(SNOW, p=0.8, seed=4, fps=5, camera_height_m=1.2)
    weather.set_epoch(2)
    weather(image, mask)
    again = clone(weather)
    for sample in ((image, mask), (image, mask, NAME), (image, mask)):
        assert torch.equal(weather(*sample)[0], again(*sample)[0])
    assert repr(again) == repr(weather)
    again.set_epoch(3)
    assert weather.draws.epoch == 2


# Batches and videos


def test_a_batch_shares_one_draw(image: Any, mask: Any, depth: Any) -> None:
    other = image_of(frame_at(3))
    masks = tv_tensors.Mask(torch.stack([mask, mask]))
    depths = Depth(torch.stack([depth, depth * 0.5]))
    batch = tv_tensors.Image(torch.stack([image, other]))
    done, marked, _, _ = always(FOG)(batch, masks, depths, NAME)
    assert (type(done), done.shape) == (tv_tensors.Image, (2, 3, *SIZE))
    for number, picture in enumerate((image, other)):
        alone = always(FOG)(picture, mask, Depth(depths[number]), NAME)
        assert torch.equal(done[number], alone[0])
        assert torch.equal(marked[number], alone[1])
    wide = tv_tensors.Mask(masks[:, None]), Depth(depths[:, None])
    plain = always(FOG)(batch.as_subclass(torch.Tensor), *wide, NAME)
    assert torch.equal(plain[0], done)


def test_a_video_is_a_drive(image: Any, mask: Any) -> None:
    """The same drops fly on: pictures of a standing scene differ, the first is as if alone."""
    still = tv_tensors.Video(torch.stack([image] * 3))
    masks = tv_tensors.Mask(torch.stack([mask] * 3))
    weather = always(fps=10)
    done = weather(still, masks, NAME)[0]
    assert (type(done), done.shape) == (tv_tensors.Video, still.shape)
    assert torch.equal(done[0], weather(image, mask, NAME)[0])
    assert len({bits(each) for each in done}) == 3
    slow = always(fps=5)(still, masks, NAME)[0]
    assert torch.equal(slow[1], done[2]), "half the rate, twice the time"
    batch = weather(tv_tensors.Image(still), masks, NAME)[0]
    assert len({bits(each) for each in batch}) == 1


def test_a_video_is_weathered_as_a_stack(mask: Any) -> None:
    frames = [frame_at(number) for number in range(3)]
    video = tv_tensors.Video(torch.stack([image_of(frame) for frame in frames]))
    masks = tv_tensors.Mask(torch.stack([torch.from_numpy(f.label + 0) for f in frames]))
    depths = Depth(torch.stack([torch.from_numpy(f.depth_m + 0) for f in frames]))
    cameras = [frame.camera for frame in frames]
    weather = always(fps=10)
    done, marked, _, _, _ = weather(video, masks, depths, cameras, NAME)
    pixels = [frame.image for frame in frames]
    drawn = weather.weathering.draw(weather.draws.key(np.stack(pixels), NAME.name))
    expected = weather.weathering.render_stack(
        pixels,
        drawn,
        fps=10,
        masks=[frame.label for frame in frames],
        depths=[frame.depth_m.astype(np.float32) for frame in frames],
        cameras=cameras,
    )
    for number, each in enumerate(expected):
        assert (done[number].numpy() == each.image.transpose(2, 0, 1)).all()
        assert (marked[number].numpy() == each.mask).all()


def test_videos_of_a_batch_begin_alike(image: Any, mask: Any) -> None:
    videos = tv_tensors.Video(image.expand(2, 3, *image.shape))
    masks = tv_tensors.Mask(mask.expand(2, 3, 1, *SIZE))
    done, marked, _ = always()(videos, masks, NAME)
    assert (done.shape, marked.shape) == (videos.shape, masks.shape)
    assert torch.equal(done[0], done[1])
    assert not torch.equal(done[0, 0], done[0, 1])


# Scenes


def test_a_scene_gives_the_full_effect(tiny_scene: Any) -> None:
    frame = tiny_scene.frame(tiny_scene.keys[3])
    image = image_of(frame)
    mask = tv_tensors.Mask(torch.from_numpy(frame.label + 0))
    weather = always(scenes=[tiny_scene.path])
    done, marked, *_ = weather(image, mask, SceneKey(frame.key), NAME)
    drawn = weather.weathering.draw(weather.draws.key(frame.image, NAME.name))
    shot = tiny_scene.render(frame.key, drawn.weather, seed=drawn.seed)
    assert (done.numpy() == shot.image.transpose(2, 0, 1)).all()
    assert (marked.numpy() == shot.label).all()
    again = pickle.loads(pickle.dumps(weather))
    assert torch.equal(again(image, mask, SceneKey(str(frame.key)), NAME)[0], done)
    batch = tv_tensors.Image(image[None].expand(2, -1, -1, -1))
    both = weather(batch, [SceneKey(frame.key), SceneKey(frame.key)], NAME)[0]
    assert torch.equal(both[1], done)
    with pytest.raises(ArgumentError, match="no frame"):
        weather(image, mask, SceneKey((99, "front")))
    with pytest.raises(ArgumentError, match="before flips"):
        weather(image.flip(-1), SceneKey(frame.key))
    with pytest.raises(ArgumentError, match="needs scenes"):
        always()(image, SceneKey(frame.key))


# Refusals


REFUSED: dict[str, tuple[Callable[[Any, Any], Any], str]] = {
    "no picture": (lambda i, m: (m, NAME), "needs a picture"),
    "an array": (lambda i, m: (i.numpy(), m), "needs a picture"),
    "two pictures": (lambda i, m: (i, i, m), "one picture, got 2"),
    "a PIL mask": (
        lambda i, m: (i, PIL.Image.fromarray(m.numpy())),
        "wrap masks as tv_tensors.Mask",
    ),
    "a plain mask": (lambda i, m: (i, m[:] + 0), "looks like a mask"),
    "two plain tensors": (lambda i, m: (i[:] + 0, m[None] + 0), r"\(1, 48, 64\) looks like a mask"),
    "an array for a mask": (
        lambda i, m: (v2.functional.to_pil_image(i), m.numpy()),
        "looks like a mask",
    ),
    "two masks": (lambda i, m: (i, m, m), "one mask, got 2: wrap depth as Depth"),
    "two depths": (lambda i, m: (i, Depth(m.float()), Depth(m.float())), "one depth, got 2"),
    "two names": (lambda i, m: (i, m, NAME, NAME), "one SampleKey, got 2"),
    "two cameras": (
        lambda i, m: (i, m, TinyClip().camera(FRONT), TinyClip().camera(FRONT)),
        "one Camera for each of 1 pictures, got 2",
    ),
    "one camera for two": (
        lambda i, m: (torch.stack([i, i]), TinyClip().camera(FRONT)),
        "one Camera for each of 2 pictures, got 1",
    ),
    "grey": (lambda i, m: (i[:1], m), r"shape \(..., 3, H, W\), got \(1, 48, 64\)"),
    "channels last": (lambda i, m: (i.permute(1, 2, 0), m), r"got \(48, 64, 3\)"),
    "no pixels": (lambda i, m: (i[:, :0], m), "must have shape"),
    "an empty batch": (lambda i, m: (i[None][:0],), "must have shape"),
    "grey PIL": (
        lambda i, m: (PIL.Image.fromarray(m.numpy()), m),
        r"mode L; convert it with image.convert\('RGB'\)",
    ),
    "doubles": (lambda i, m: (i.double() / 255, m), r"got torch.float64; put v2.ToDtype\("),
    "halves": (lambda i, m: (i.half() / 255, m), "got torch.float16"),
    "normalised": (lambda i, m: (i.float() / 255 - 0.5, m), "before normalisation"),
    "0..255": (lambda i, m: (i.float(), m), r"in \[0, 1\]"),
    "a gradient": (
        lambda i, m: ((i.as_subclass(torch.Tensor) / 255).requires_grad_(), m),
        "must not require a gradient",
    ),
    "a small mask": (lambda i, m: (i, tv_tensors.Mask(m[1:])), "mask must have the picture's"),
    "instance masks": (
        lambda i, m: (i, tv_tensors.Mask(torch.stack([m, m]))),
        r"got \(2, 48, 64\)",
    ),
    "a float mask": (lambda i, m: (i, tv_tensors.Mask(m.float())), "mask must be an integer"),
    "a bool mask": (lambda i, m: (i, tv_tensors.Mask(m > 3)), "mask must be an integer"),
    "whole metres": (lambda i, m: (i, m, Depth(m)), "depth must be a float array"),
    "a small depth": (lambda i, m: (i, m, Depth(m[1:].float())), "depth must have the picture's"),
    "a sparse depth": (lambda i, m: (i, m, Depth(m.float() * 0)), "complete the depth first"),
    "an unknown id": (lambda i, m: (i, tv_tensors.Mask(m * 0 + 77)), "77"),
    "a camera of another size": (
        lambda i, m: (i, m, Camera(np.diag([50.0, 50, 1]), np.eye(4), 32, 32)),
        "camera",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_weathered_is_refused(case: str, image: Any, mask: Any) -> None:
    sample, says = REFUSED[case]
    with pytest.raises((ArgumentError, DataError), match=says):
        always()(*sample(image, mask))


def test_a_gradient_nobody_asks_for_is_no_matter(image: Any, mask: Any) -> None:
    wanted = (image.as_subclass(torch.Tensor) / 255).requires_grad_()
    with torch.no_grad():
        assert not always()(wanted, mask)[0].requires_grad


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ({"p": 1.5}, "p must be"),
        ({"p": "often"}, "p must be"),
        ({"fps": 0}, "fps must be"),
        ({"seed": 0.5}, "seed must be"),
        ({"scenes": "folder"}, "scenes must be a sequence"),
        ({"policy": 3}, "WeatherPolicy"),
        ({"speed": (1, 2)}, "there is no argument speed"),
        ({"taxonomy": "mine"}, "mine"),
    ],
)
def test_arguments_are_checked_when_it_is_made(how: dict[str, Any], says: str) -> None:
    with pytest.raises(WeatherAugError, match=says):
        RandomWeather(**how)


@pytest.mark.parametrize("name", [1.5, None, (0, 1.5), 2**70])
def test_a_name_is_integers_and_strings(name: Any) -> None:
    with pytest.raises(ArgumentError, match="sample_key"):
        SampleKey(name)


def test_flat_arguments_are_those_of_weathering() -> None:
    weather = RandomWeather(SNOW.to_dict(), hfov_deg=90, taxonomy=None, unknown_ids="ignore")
    assert weather.weathering.policy == SNOW
    assert weather.weathering.hfov_deg == 90
    assert weather.weathering.ids.taxonomy is None
