"""CLIP-S and CLIP-DS: the formulas in float64, and pictures and texts through a tiny real CLIP."""

from __future__ import annotations

import json
import math
import shutil
import socket

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image
from tiny_clip_model import SIDE, build_tiny_clip

from weather_aug.edit.diffusion.spec import CLEAR, PROMPTS
from weather_aug.errors import ArgumentError, DataError
from weather_aug.scores import clip
from weather_aug.scores.clip import clip_ds, clip_s, load_encoder

ROUNDING = 1e-12
VECTOR = arrays(np.float64, 6, elements=st.floats(-4, 4)).filter(lambda v: np.abs(v).max() > 0.1)
SCALE = st.floats(1e-3, 1e3)


def cosine(a, b):
    """By the textbook, number by number."""
    dot = math.fsum(x * y for x, y in zip(a, b, strict=True))
    return dot / math.sqrt(math.fsum(x * x for x in a) * math.fsum(y * y for y in b))


def unit(vector):
    return vector / np.linalg.norm(vector)


def check_s(picture, text):
    assert clip_s(picture, text) == pytest.approx(cosine(picture, text), abs=ROUNDING)


def check_ds(edited, clear, text_edited, text_clear):
    expected = cosine(unit(edited) - unit(clear), unit(text_edited) - unit(text_clear))
    got = clip_ds(edited, clear, text_edited, text_clear)
    assert got == pytest.approx(expected, abs=1e-9)


@given(picture=VECTOR, text=VECTOR)
def test_clip_s_is_the_cosine(picture, text):
    check_s(picture, text)


@given(edited=VECTOR, clear=VECTOR, text_edited=VECTOR, text_clear=VECTOR)
def test_clip_ds_is_the_cosine_of_the_changes(edited, clear, text_edited, text_clear):
    assume(np.linalg.norm(unit(edited) - unit(clear)) > 1e-3)
    assume(np.linalg.norm(unit(text_edited) - unit(text_clear)) > 1e-3)
    check_ds(edited, clear, text_edited, text_clear)
    turned = clip_ds(clear, edited, text_edited, text_clear)
    assert turned == pytest.approx(-clip_ds(edited, clear, text_edited, text_clear), abs=ROUNDING)


@given(vectors=st.tuples(*[VECTOR] * 4), scales=st.tuples(*[SCALE] * 4))
def test_lengths_of_embeddings_do_not_matter(vectors, scales):
    assume(np.linalg.norm(unit(vectors[0]) - unit(vectors[1])) > 1e-3)
    assume(np.linalg.norm(unit(vectors[2]) - unit(vectors[3])) > 1e-3)
    scaled = [scale * vector for scale, vector in zip(scales, vectors, strict=True)]
    assert clip_ds(*scaled) == pytest.approx(clip_ds(*vectors), abs=1e-9)
    assert clip_s(*scaled[:2]) == pytest.approx(clip_s(*vectors[:2]), abs=ROUNDING)


@pytest.mark.parametrize("size", [1e-200, 1e200])
def test_nor_do_extreme_ones(size):
    vector = np.array([3.0, 4.0])
    assert clip_s(size * vector, vector) == 1


@given(picture=VECTOR, scale=SCALE, texts=st.tuples(VECTOR, VECTOR))
def test_what_was_not_edited_has_no_direction(picture, scale, texts):
    assume(np.linalg.norm(unit(texts[0]) - unit(texts[1])) > 1e-3)
    assert clip_ds(scale * picture, picture, *texts) == 0


def test_an_edit_as_told_has_1_against_it_minus_1_aside_0():
    clear, told, aside = np.eye(3)
    texts = told, clear
    assert clip_ds(told, clear, *texts) == pytest.approx(1)
    assert clip_ds(clear, told, *texts) == pytest.approx(-1)
    assert clip_ds(clear + told + aside, clear + told, *texts) == pytest.approx(0, abs=ROUNDING)
    assert clip_ds(aside, clear, *texts) == pytest.approx(0.5)


def test_many_pictures_have_one_text():
    rng = np.random.default_rng(0)
    edited, clear = rng.normal(size=(2, 3, 5, 8))
    texts = rng.normal(size=(2, 8))
    found = clip_ds(edited, clear, *texts)
    assert found.shape == (3, 5)
    assert found[1, 2] == pytest.approx(clip_ds(edited[1, 2], clear[1, 2], *texts))
    assert clip_s(edited, texts[0]).shape == (3, 5)


ONE, OTHER = np.array([1.0, 0.0]), np.array([0.0, 1.0])


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: clip_s(0 * ONE, ONE), "pictures has an embedding of length 0"),
        (lambda: clip_s(ONE, ONE * np.nan), "text must be finite"),
        (lambda: clip_s(ONE, np.ones(3)), "2 and 3 numbers"),
        (lambda: clip_s(1.0, ONE), "pictures must be"),
        (lambda: clip_ds(ONE, OTHER, ONE, 2 * ONE), "give two texts"),
    ],
)
def test_what_does_not_fit_is_refused(call, says):
    with pytest.raises(ArgumentError, match=says):
        call()


def subtracted_before_normalising(monkeypatch):
    right = clip._unit

    def wrong(name, embeddings):
        if name in ("edited", "clear", "text_edited", "text_clear"):
            return np.asarray(embeddings)
        return right(name, embeddings)

    monkeypatch.setattr(clip, "_unit", wrong)


def dot_for_cosine(monkeypatch):
    monkeypatch.setattr(clip, "_unit", lambda name, embeddings: np.asarray(embeddings))


@pytest.mark.parametrize("fault", [subtracted_before_normalising, dot_for_cosine])
def test_a_fault_in_the_formulas_is_found_out(fault, monkeypatch):
    vectors = np.random.default_rng(1).normal(size=(4, 6)) * [[1], [3], [1], [2]]
    check_ds(*vectors)
    check_s(*vectors[:2])
    fault(monkeypatch)
    with pytest.raises(AssertionError):
        check_ds(*vectors)
        check_s(*vectors[:2])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return build_tiny_clip(tmp_path_factory.mktemp("clip") / "tiny")


@pytest.fixture(scope="module")
def encoder(folder):
    return load_encoder(folder)


def pictures(count=3, height=40, width=70):
    rng = np.random.default_rng(2)
    return [rng.integers(0, 256, (height, width, 3)).astype(np.uint8) for _ in range(count)]


def by_hand(image):
    """(1, 3, SIDE, SIDE): shorter side resized, middle cut out, OpenAI's mean and spread."""
    height, width = image.shape[:2]
    size = (SIDE, int(SIDE * height / width))
    if height < width:
        size = (int(SIDE * width / height), SIDE)
    resized = np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BICUBIC))
    top, left = (resized.shape[0] - SIDE) // 2, (resized.shape[1] - SIDE) // 2
    square = resized[top : top + SIDE, left : left + SIDE] / 255.0
    mean = np.array([0.48145466, 0.4578275, 0.40821073])
    spread = np.array([0.26862954, 0.26130258, 0.27577711])
    return ((square - mean) / spread).transpose(2, 0, 1)[None]


def test_embeddings_are_the_models_own(encoder):
    """Of pixels prepared by hand, through the model's forward, which normalises."""
    import torch

    images = [*pictures(2), *pictures(1, height=70, width=40)]
    texts = ["rain in snow", "snow"]
    tokens = encoder.tokenizer(texts, padding=True, return_tensors="pt")
    pixels = torch.from_numpy(np.concatenate([by_hand(image) for image in images])).float()
    with torch.no_grad():
        output = encoder.model(**tokens, pixel_values=pixels)
    found = encoder.pictures(images)
    assert found.shape == (3, 12)
    assert found.dtype == np.float64
    theirs = output.image_embeds.numpy()
    assert found / np.linalg.norm(found, axis=1, keepdims=True) == pytest.approx(theirs, abs=1e-5)
    said = encoder.texts(texts)
    theirs = output.text_embeds.numpy()
    assert said / np.linalg.norm(said, axis=1, keepdims=True) == pytest.approx(theirs, abs=1e-5)


def test_padding_does_not_matter(encoder):
    alone = encoder.texts(["snow"])
    beside = encoder.texts(["snow", "a far longer text about rain in the sun"])
    assert alone[0] == pytest.approx(beside[0], abs=1e-6)


def test_too_long_a_text_is_cut(encoder):
    assert np.isfinite(encoder.texts(["rain " * 200])).all()


def test_batches_do_not_matter(encoder, monkeypatch):
    images = pictures(5)
    whole = encoder.pictures(images)
    monkeypatch.setattr(clip, "BATCH", 2)
    assert encoder.pictures(images) == pytest.approx(whole, abs=1e-6)


def test_from_pictures_to_scores(encoder):
    clear, edited = pictures(2), [image // 2 for image in pictures(2)]
    before, after = encoder.pictures(clear), encoder.pictures(edited)
    normal, snowy = encoder.texts([PROMPTS[CLEAR], PROMPTS["snow"]])
    assert (np.abs(clip_s(after, snowy)) < 1).all()
    assert (np.abs(clip_ds(after, before, snowy, normal)) > 0).all()
    assert (clip_ds(before, before, snowy, normal) == 0).all()


def test_pictures_are_not_changed(encoder):
    images = pictures(1)
    kept = images[0].copy()
    encoder.pictures(images)
    assert (images[0] == kept).all()


def test_a_picture_three_pixels_wide_is_one(encoder):
    assert np.isfinite(encoder.pictures([np.zeros((3, 3, 3), np.uint8)])).all()


def test_nothing_to_embed_is_refused(encoder):
    with pytest.raises(ArgumentError, match="images is empty"):
        encoder.pictures([])
    with pytest.raises(ArgumentError, match=r"images\[0\] must be uint8"):
        encoder.pictures([np.zeros((4, 4, 3))])
    for nothing in ([], "snow"):
        with pytest.raises(ArgumentError, match="prompts must be a list"):
            encoder.texts(nothing)


@pytest.fixture
def offline(monkeypatch):
    def refused(*_, **__):
        raise AssertionError("the network was asked")

    monkeypatch.setattr(socket.socket, "connect", refused)


@pytest.mark.parametrize("source", [clip.CLIP_LARGE, "no/such-model", "/no/such/folder"])
def test_missing_weights_are_told_in_one_sentence(source, offline):
    with pytest.raises(DataError) as caught:
        load_encoder(source)
    said = str(caught.value)
    assert source in said
    assert "licence: MIT" in said
    assert f"hf download {clip.CLIP_LARGE}" in said
    assert "\n" not in said


def broken(folder, tmp_path, name, text):
    at = tmp_path / "broken"
    shutil.copytree(folder, at)
    if text is None:
        (at / name).unlink()
    else:
        (at / name).write_text(text, encoding="utf-8")
    return at


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("model.safetensors", None),
        ("model.safetensors", "nonsense"),
        ("config.json", "{"),
        ("preprocessor_config.json", None),
    ],
)
def test_a_broken_folder_is_told(folder, tmp_path, name, text):
    with pytest.raises(DataError, match="holds no CLIP model that can be read"):
        load_encoder(broken(folder, tmp_path, name, text))


def test_pickles_are_not_read(folder, tmp_path):
    import torch

    at = broken(folder, tmp_path, "model.safetensors", None)
    torch.save({}, at / "pytorch_model.bin")
    with pytest.raises(DataError, match="no CLIP model"):
        load_encoder(at)


def test_a_model_without_its_vision_is_refused(folder, tmp_path):
    """The library would fill it with random numbers, and every score be noise."""
    from safetensors.numpy import load_file, save_file

    at = broken(folder, tmp_path, "model.safetensors", None)
    weights = load_file(folder / "model.safetensors")
    kept = {name: value for name, value in weights.items() if "vision" not in name}
    save_file(kept, at / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(DataError, match="no CLIP model"):
        load_encoder(at)


@pytest.mark.parametrize("name", ["tokenizer.json", "tokenizer_config.json"])
def test_a_model_without_its_tokenizer_is_refused(folder, tmp_path, name):
    at = broken(folder, tmp_path, name, None)
    if name == "tokenizer.json":
        with pytest.raises(DataError, match="no CLIP model"):
            load_encoder(at)
    else:
        # What is left tells enough.
        texts = ["snow", "rain"]
        assert load_encoder(at).texts(texts) == pytest.approx(load_encoder(folder).texts(texts))


def test_another_kind_of_model_is_refused(folder, tmp_path):
    config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    config["vision_config"]["hidden_size"] = 24
    at = broken(folder, tmp_path, "config.json", json.dumps(config))
    with pytest.raises(DataError, match="no CLIP model"):
        load_encoder(at)
