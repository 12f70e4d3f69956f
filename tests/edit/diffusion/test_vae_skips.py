"""The VAE in two halves is the library's VAE; skips start at nothing and join equal sizes."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from small_base import pictures

from weather_aug.edit.diffusion.base import Base, load_base
from weather_aug.edit.diffusion.one_step import latent_of_noise, noise_of_latent
from weather_aug.edit.diffusion.skips import Skips, decode, encode


@pytest.fixture(scope="module")
def base(small_base: Path) -> Base:
    return load_base(str(small_base))


def test_the_halves_are_the_librarys_own(base: Base) -> None:
    image, _ = pictures(2)
    with torch.no_grad():
        encoded = encode(base.vae, image)
        mode = base.vae.encode(image).latent_dist.mode()
        assert torch.equal(encoded.latent, mode * base.vae.config.scaling_factor)
        expected = base.vae.decode(mode).sample
        assert torch.allclose(decode(base.vae, encoded.latent), expected, atol=1e-4)


def test_untrained_skips_change_nothing(base: Base) -> None:
    image, _ = pictures()
    with torch.no_grad():
        encoded = encode(base.vae, image)
        plain = decode(base.vae, encoded.latent)
        assert torch.equal(decode(base.vae, encoded.latent, encoded.skips, Skips(base.vae)), plain)


def test_skips_join_equal_sizes_and_learn(base: Base) -> None:
    image, _ = pictures()
    skips = Skips(base.vae)
    with torch.no_grad():
        encoded = encode(base.vae, image)
    sides = [activation.shape[-1] for activation in encoded.skips]
    assert sides == [48 // 8, 48 // 4, 48 // 2, 48]
    decode(base.vae, encoded.latent, encoded.skips, skips).mean().backward()
    for conv in skips:
        assert conv.weight.grad.abs().sum() > 0


def test_skips_of_sd_turbo_have_the_published_widths() -> None:
    """512 to 512, 256 to 512, 128 to 512, 128 to 256: systems of the real size."""
    from diffusers import AutoencoderKL

    with torch.device("meta"):
        vae = AutoencoderKL(
            down_block_types=("DownEncoderBlock2D",) * 4,
            up_block_types=("UpDecoderBlock2D",) * 4,
            block_out_channels=(128, 256, 512, 512),
            layers_per_block=2,
        )
        widths = [(conv.in_channels, conv.out_channels) for conv in Skips(vae)]
    assert widths == [(512, 512), (256, 512), (128, 512), (128, 256)]


def test_one_step_and_its_inverse() -> None:
    generator = torch.Generator().manual_seed(0)
    latent, target = torch.randn(2, 1, 4, 3, 3, generator=generator, dtype=torch.float64)
    noise = noise_of_latent(latent, target, 0.0047)
    assert torch.allclose(latent_of_noise(latent, noise, 0.0047), target, atol=1e-12)
    # Of z = sqrt(a) x + sqrt(1 - a) e, the step finds x.
    mixed = 0.0047**0.5 * target + (1 - 0.0047) ** 0.5 * latent
    assert torch.allclose(latent_of_noise(mixed, latent, 0.0047), target, atol=1e-12)
