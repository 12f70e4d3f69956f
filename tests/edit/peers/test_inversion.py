"""Edit-friendly inversion: the picture comes back, plain guidance is the plain inversion."""

import numpy as np
import pytest
import torch

from weather_aug.edit.diffusion.base import load_base
from weather_aug.edit.peers import inversion
from weather_aug.edit.peers.inversion import (
    MOST_Z,
    SHIFT,
    Schedule,
    draw,
    edited_latent,
    noised,
    posterior_mean,
    schedule,
)
from weather_aug.errors import ArgumentError

SHAPE = (4, 6, 9)
BETAS = np.linspace(0.00085**0.5, 0.012**0.5, 1000) ** 2
ALPHA_BARS = torch.from_numpy(np.cumprod(1 - BETAS))
SOURCE, TARGET = torch.full((1, 3, 5), 0.3).double(), torch.full((1, 3, 5), -0.7).double()


def predict(samples, step, embeddings):
    """A model that hears its text, its step and its neighbours."""
    text = embeddings.mean(dim=(1, 2))[:, None, None, None]
    return torch.tanh(0.8 * samples + text) + 0.1 * samples.roll(1, dims=3) * step / 1000


def start(seed=0, steps=4):
    generator = torch.Generator().manual_seed(seed)
    latent = torch.randn(1, *SHAPE, generator=generator, dtype=torch.float64)
    return latent, draw(range(steps), SHAPE, generator).double()


def run(latent, noise, *, texts=(SOURCE, TARGET), weight=1.5, most_z=None, shift=SHIFT):
    plan = schedule(len(noise), shift)
    return edited_latent(
        latent, noise, predict, texts, plan, ALPHA_BARS, weight=weight, most_z=most_z
    )


def plain(latent, noise):
    """The plain inversion, by scalar loops over steps in numpy and another form of the mean.

    First all z of the source, then the target's trajectory with them: as its authors write it.
    """
    bars = ALPHA_BARS.numpy()
    steps = np.rint(np.linspace(799, 199, len(noise))).astype(int)
    x0 = latent[0].numpy()
    path = []
    for step, one in zip(steps - SHIFT, noise.numpy(), strict=True):
        path.append(x0 if step <= 0 else np.sqrt(bars[step]) * x0 + np.sqrt(1 - bars[step]) * one)
    path.append(x0)

    def mean(sample, index, text):
        noise_in = predict(torch.from_numpy(sample)[None], steps[index], text)[0].numpy()
        bar = bars[steps[index]]
        after = bars[steps[index + 1]] if index + 1 < len(steps) else 1.0
        beta = 1 - bar / after
        # Ho et al. 2020, equation 11: the same mean, from the noise alone.
        return (sample - beta / np.sqrt(1 - bar) * noise_in) / np.sqrt(bar / after)

    z = [path[i + 1] - mean(path[i], i, SOURCE) for i in range(len(steps))]
    sample = path[0]
    for index in range(len(steps)):
        sample = mean(sample, index, TARGET) + z[index]
    return torch.from_numpy(sample)[None]


def check_the_picture_comes_back(seed, weight):
    latent, noise = start(seed)
    back = run(latent, noise, texts=(SOURCE, SOURCE), weight=weight)
    torch.testing.assert_close(back, latent, rtol=0, atol=1e-9)


@pytest.mark.parametrize("weight", [0.0, 1.0, 1.5, 7.0])
def test_the_picture_comes_back_whatever_the_weight(weight):
    check_the_picture_comes_back(0, weight)


def test_no_weight_for_the_target_gives_the_picture_back():
    latent, noise = start()
    torch.testing.assert_close(run(latent, noise, weight=0.0), latent, rtol=0, atol=1e-9)


def test_a_path_that_does_not_end_at_the_picture_is_caught(monkeypatch):
    def unfinished(*given):
        path = noised(*given)
        return (*path[:-1], path[-2])

    monkeypatch.setattr(inversion, "noised", unfinished)
    monkeypatch.setattr(inversion, "SHIFT", 0)
    latent, noise = start()
    with pytest.raises(AssertionError):
        back = run(latent, noise, texts=(SOURCE, SOURCE), shift=0)
        torch.testing.assert_close(back, latent, rtol=0, atol=1e-9)


def check_plain(seed, steps):
    latent, noise = start(seed, steps)
    ours = run(latent, noise, weight=1.0)
    torch.testing.assert_close(ours, plain(latent, noise), rtol=0, atol=1e-9)


@pytest.mark.parametrize("steps", [2, 3, 4, 7])
def test_guidance_of_one_is_the_plain_inversion(steps):
    check_plain(1, steps)


def test_a_wrong_mean_is_caught(monkeypatch):
    def never_ending(sample, noise, step, following, alpha_bars):
        return posterior_mean(sample, noise, step, following or 1, alpha_bars)

    monkeypatch.setattr(inversion, "posterior_mean", never_ending)
    with pytest.raises(AssertionError):
        check_plain(1, 4)


def test_a_schedule_without_its_shift_is_caught(monkeypatch):
    monkeypatch.setattr(inversion, "SHIFT", 0)
    latent, noise = start(1)
    with pytest.raises(AssertionError):
        ours = run(latent, noise, weight=1.0, shift=0)
        torch.testing.assert_close(ours, plain(latent, noise), rtol=0, atol=1e-9)


def test_guidance_strengthens_the_edit():
    latent, noise = start(2)
    moved = [
        float((run(latent, noise, weight=weight) - latent).norm()) for weight in (0.5, 1, 1.5, 2)
    ]
    assert moved == sorted(moved) and moved[-1] > 1.5 * moved[1]


def test_the_mean_is_that_of_the_librarys_sampler(monkeypatch):
    diffusers = pytest.importorskip("diffusers")
    sampler = diffusers.DDPMScheduler(
        beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", clip_sample=False
    )
    monkeypatch.setattr(
        "diffusers.schedulers.scheduling_ddpm.randn_tensor",
        lambda shape, **kind: torch.zeros(shape, dtype=kind["dtype"]),
    )
    plan = schedule(4)
    sampler.set_timesteps(timesteps=list(plan.steps))
    sample, noise = start()[0], start(3)[0]
    for step, following in zip(plan.steps, (*plan.steps[1:], None), strict=True):
        theirs = sampler.step(noise, step, sample).prev_sample
        ours = posterior_mean(sample, noise, step, following, sampler.alphas_cumprod.double())
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-5)  # their schedule is float32


def test_steps_are_the_authors():
    assert schedule(4) == Schedule((799, 599, 399, 199), (599, 399, 199, -1))
    assert schedule(3) == Schedule((799, 499, 199), (599, 299, -1))
    for count in (1, 0, 602):
        with pytest.raises(ArgumentError, match="steps"):
            schedule(count)


def test_latents_have_the_noise_of_earlier_steps():
    latent, noise = start()
    plan = schedule(4)
    path = noised(latent, noise, plan, ALPHA_BARS)
    for step, one, mixed in zip(plan.noise_steps[:3], noise, path, strict=False):
        bar = float(ALPHA_BARS[step])
        expected = bar**0.5 * latent[0] + (1 - bar) ** 0.5 * one
        torch.testing.assert_close(mixed[0], expected)
    # From step 0 on there is no noise: the last step starts at the picture itself.
    assert torch.equal(path[3], latent) and torch.equal(path[4], latent)


def test_the_last_z_is_bounded():
    latent, noise = start()
    free, bounded = (run(latent, noise, texts=(SOURCE, SOURCE), most_z=m) for m in (None, MOST_Z))
    lost = latent - bounded
    assert lost.abs().max() > 1e-3
    torch.testing.assert_close(free, latent, rtol=0, atol=1e-9)
    kept = run(latent, noise, texts=(SOURCE, SOURCE), most_z=1e3)
    torch.testing.assert_close(kept, latent, rtol=0, atol=1e-9)
    # What is left of z has the authors' norm at their size.
    assert MOST_Z * (4 * 64 * 64) ** 0.5 == pytest.approx(15.5)


def test_a_real_network_gives_the_latent_back(tiny_sd):
    base = load_base(str(tiny_sd))
    generator = torch.Generator().manual_seed(0)
    latent = torch.randn(1, 4, 7, 13, generator=generator)
    noise = draw(range(4), latent.shape[1:], generator)
    text, other = base.embed(["a street", "a street in snow"]).split(1)

    def unet(samples, step, embeddings):
        return base.unet(samples, step, encoder_hidden_states=embeddings).sample

    with torch.inference_mode():
        for weight in (1.0, 1.5, 4.0):
            back = edited_latent(
                *(latent, noise, unet, (text, text), schedule(4), base.alpha_bars),
                weight=weight,
                most_z=None,
            )
            torch.testing.assert_close(back, latent, rtol=0, atol=1e-4)
        moved = edited_latent(
            *(latent, noise, unet, (text, other), schedule(4), base.alpha_bars),
            weight=1.5,
            most_z=None,
        )
    assert float((moved - latent).abs().max()) > 1e-3
