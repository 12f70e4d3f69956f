"""Networks from files, in silence: what the libraries tell their own users is not ours to print."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from weather_aug._extras import require
from weather_aug.edit.weights import readable
from weather_aug.errors import DataError, printable

_TO = "read the networks of an editor"


def read_network(kind: Any, folder: Path, **options: Any) -> Any:
    """A network of diffusers or transformers; safetensors only, nothing fetched, nothing missing.

    Args:
        kind: Its class, with `from_pretrained`.
        folder: With its config.json and weights.
        **options: Of `from_pretrained`.

    Raises:
        DataError: If the files are no such network, or hold a part of its weights.
        MissingExtraError: If diffusers or transformers are not installed.
    """
    with readable(folder), quiet_libraries():
        network, info = kind.from_pretrained(
            folder,
            local_files_only=True,
            use_safetensors=True,
            output_loading_info=True,
            **options,
        )
    # The libraries draw what is missing at random, and only log it.
    missing = sorted(info["missing_keys"])
    if missing:
        raise DataError(
            f"{printable(folder, 200)}: {len(missing)} of the weights are missing, such as "
            f"{printable(missing[0], 100)}; fetch the model again"
        )
    return network


@contextmanager
def quiet_libraries() -> Iterator[None]:
    """Without bars and notices of diffusers and transformers; their settings come back after."""
    diffusers = require("diffusers.utils.logging", extra="edit", to=_TO)
    transformers = require("transformers.utils.logging", extra="edit", to=_TO)
    levels = [(library, library.get_verbosity()) for library in (diffusers, transformers)]
    had_bars = diffusers.is_progress_bar_enabled()

    def no_bar(_: Any, args: Any, kwargs: Any) -> Any:
        return transformers.EmptyTqdm(*args, **kwargs)

    # Not its disable_progress_bar, which speaks for huggingface_hub as well.
    hook = transformers.set_tqdm_hook(no_bar)
    try:
        diffusers.disable_progress_bar()
        for library, _ in levels:
            library.set_verbosity_error()
        yield
    finally:
        transformers.set_tqdm_hook(hook)
        if had_bars:
            diffusers.enable_progress_bar()
        for library, level in levels:
            library.set_verbosity(level)
