"""Discriminators: what each side pays, who gets gradients, a tiny CLIP from a folder."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from small_base import pictures

from weather_aug.edit.diffusion.discriminator import (
    CLIP,
    CLIP_MEAN,
    CLIP_STD,
    ClipDiscriminator,
    PatchDiscriminator,
    discriminator_loss,
    generator_loss,
    judged,
    load_clip,
    make_discriminators,
)
from weather_aug.errors import ArgumentError, DataError


@pytest.fixture(scope="module")
def clip_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from transformers import CLIPVisionConfig, CLIPVisionModel

    folder = tmp_path_factory.mktemp("clip")
    config = CLIPVisionConfig(
        hidden_size=16,
        intermediate_size=32,
        num_hidden_layers=3,
        num_attention_heads=2,
        image_size=24,
        patch_size=8,
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(4)
        CLIPVisionModel(config).save_pretrained(folder)
    return folder


def some_logits(seed: int) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(seed)
    return tuple(torch.randn(2, 1, n, n + 1, generator=generator) * 3 for n in (5, 2))


def cost(levels: tuple[torch.Tensor, ...], real: bool) -> float:
    """Binary cross entropy in float64, a mean per level, summed over the levels."""
    total = 0.0
    for level in levels:
        shares = [1 / (1 + math.exp(-value)) for value in level.double().flatten().tolist()]
        total -= sum(math.log(p if real else 1 - p) for p in shares) / len(shares)
    return total


def gradients(network: torch.nn.Module) -> set[str]:
    return {name for name, parameter in network.named_parameters() if parameter.grad is not None}


def test_losses_are_binary_cross_entropies() -> None:
    real, fake = some_logits(0), some_logits(1)
    assert float(generator_loss(fake)) == pytest.approx(cost(fake, real=True), rel=1e-5)
    found = discriminator_loss(real, fake)
    assert float(found["real"]) == pytest.approx(cost(real, real=True), rel=1e-5)
    assert float(found["fake"]) == pytest.approx(cost(fake, real=False), rel=1e-5)
    swapped = discriminator_loss(fake, real)
    assert float(swapped["real"]) != pytest.approx(cost(real, real=True), rel=1e-5)


def test_who_knows_nothing_pays_a_bit_per_level() -> None:
    nothing = tuple(torch.zeros(1, 1, n, n) for n in (3, 2, 1))
    found = discriminator_loss(nothing, nothing)
    for loss in (*found.values(), generator_loss(nothing)):
        assert float(loss) == pytest.approx(3 * math.log(2))


def test_patches_at_two_scales() -> None:
    net = PatchDiscriminator(width=4).eval()
    image, _ = pictures(2, 32, 48)
    levels = net(image)
    assert [tuple(level.shape) for level in levels] == [(2, 1, 4, 6), (2, 1, 2, 3)]
    alone = net(image[1:])
    for both, one in zip(levels, alone, strict=True):
        assert torch.allclose(both[1:], one, atol=1e-6)
    with pytest.raises(ArgumentError, match="at least 16"):
        net(image[..., :8])


def test_its_weights_have_a_spectral_norm_of_one() -> None:
    net = make_discriminators("patch", ["snow"])["snow"].eval()
    convolutions = [layer for layer in net.modules() if isinstance(layer, torch.nn.Conv2d)]
    assert len(convolutions) == 10
    for layer in convolutions:
        largest = torch.linalg.matrix_norm(layer.weight.detach().flatten(1), 2)
        assert float(largest) == pytest.approx(1, abs=0.15)


def test_each_style_has_its_own_and_seeds_decide() -> None:
    drawn = torch.random.get_rng_state()
    one, same, other = (make_discriminators("patch", ["snow", "clear"], seed=s) for s in (1, 1, 2))
    assert torch.equal(torch.random.get_rng_state(), drawn)
    assert one.styles == ("snow", "clear")
    image, _ = pictures(1, 16, 16)
    answers = [net["snow"].eval()(image)[0] for net in (one, same, other)]
    assert torch.equal(answers[0], answers[1])
    assert not torch.equal(answers[0], answers[2])
    assert not torch.equal(answers[0], one["clear"].eval()(image)[0])
    same.load_state_dict(other.state_dict())
    assert torch.equal(same["snow"](image)[0], answers[2])


@pytest.mark.parametrize(("kind", "styles"), [("vgg", ["snow"]), ("patch", []), ("patch", "aa")])
def test_wrong_choices_are_named(kind: Any, styles: Any) -> None:
    with pytest.raises(ArgumentError, match=r"discriminator 'vgg'|styles must name"):
        make_discriminators(kind, styles)


def test_who_is_judged_learns_and_the_judge_does_not() -> None:
    net = PatchDiscriminator(width=4).eval()
    image = pictures(1, 16, 16)[0].requires_grad_()
    levels = judged(net, image)
    for ours, plain in zip(levels, net(image), strict=True):
        assert torch.equal(ours, plain)
    generator_loss(levels).backward()
    assert image.grad is not None
    assert not gradients(net)
    generator_loss(net(image)).backward()
    assert gradients(net) == {name for name, _ in net.named_parameters()}


def test_it_learns_to_tell_two_pictures() -> None:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        net = PatchDiscriminator(width=8, scales=1)
    real, fake = pictures(1, 16, 16)[0], pictures(2, 16, 16)[0][1:] * 0.3
    optimiser = torch.optim.AdamW(net.parameters(), lr=5e-3)
    sums = []
    for _ in range(30):
        loss = torch.stack(list(discriminator_loss(net(real), net(fake)).values())).sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        sums.append(loss.item())
    assert sums[-1] < 0.5 * sums[0]


def test_clip_has_a_head_on_three_layers(clip_folder: Path) -> None:
    nets = make_discriminators("clip", ["snow", "clear"], clip=clip_folder)
    net = nets["snow"]
    assert isinstance(net, ClipDiscriminator)
    assert net.layers == (1, 2, 3)
    assert net.backbone is nets["clear"].backbone
    assert not net.train().backbone.training
    image = pictures(2, 16, 32)[0].requires_grad_()
    levels = net(image)
    assert [tuple(level.shape) for level in levels] == [(2, 1, 3, 3)] * 3
    generator_loss(levels).backward()
    assert image.grad is not None
    assert float(image.grad.abs().max()) > 0
    wanted = {name for name, _ in net.named_parameters() if name.startswith("heads.")}
    assert gradients(net) == wanted


def test_clip_sees_pictures_as_it_was_trained_to(clip_folder: Path) -> None:
    net = ClipDiscriminator(load_clip(clip_folder))
    seen = net.seen(torch.full((1, 3, 16, 40), -0.5))
    assert seen.shape == (1, 3, 24, 24)
    for channel in range(3):
        wanted = (0.25 - CLIP_MEAN[channel]) / CLIP_STD[channel]
        assert seen[0, channel].flatten().tolist() == pytest.approx([wanted] * 24**2, rel=1e-5)


def test_a_head_reads_its_layer(clip_folder: Path) -> None:
    net = ClipDiscriminator(load_clip(clip_folder), layers=[2]).eval()
    image, _ = pictures(1, 24, 24)
    with torch.no_grad():
        states = net.backbone(net.seen(image), output_hidden_states=True).hidden_states[2]
        # Token 1 + row 0 * 3 + column 2.
        patches = states[0, 1:].reshape(3, 3, 16).permute(2, 0, 1)[None]
        assert torch.equal(net.heads[0](patches), net(image)[0])
    with pytest.raises(ArgumentError, match=r"layers must be in 1\.\.3"):
        ClipDiscriminator(net.backbone, layers=[4])


def test_the_backbone_is_no_part_of_the_state(clip_folder: Path) -> None:
    one, two = (make_discriminators("clip", ["snow"], clip=clip_folder, seed=s) for s in (1, 2))
    state = one.state_dict()
    assert state
    assert not [name for name in state if "backbone" in name]
    two.load_state_dict(state)
    image, _ = pictures(1, 24, 24)
    answers = [net["snow"].eval()(image) for net in (one, two)]
    assert all(torch.equal(a, b) for a, b in zip(*answers, strict=True))
    assert not [name for name in state if "backbone" in name]


def test_clip_that_is_not_there_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import huggingface_hub

    def nothing(*_: Any, **__: Any) -> str:
        raise huggingface_hub.errors.LocalEntryNotFoundError("no cache")

    monkeypatch.setattr(huggingface_hub, "snapshot_download", nothing)
    with pytest.raises(DataError, match=f"{CLIP}.*hf download {CLIP}"):
        make_discriminators("clip", ["snow"])
    with pytest.raises(DataError, match=r"no config\.json"):
        make_discriminators("clip", ["snow"], clip=tmp_path)
    (tmp_path / "config.json").write_text("{}")
    (tmp_path / "model.safetensors").write_bytes(b"no tensors")
    with pytest.raises(DataError, match="no model that can be read"):
        load_clip(tmp_path)
