"""The command that lists pictures to train an editor on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from weather_aug.cli.terminal import say, to_people
from weather_aug.errors import ArgumentError


@dataclass(frozen=True)
class ListPairs:
    """List pairs of clear pictures and pictures in a weather, for train-editor."""

    dataset: Positional[Literal["acdc", "muses", "bdd100k", "folder"]]
    """What lies in `root`; folder is {clear,rain,snow,fog}/{train,val}/NAME.png, with
    labels/{train,val}/NAME.png."""
    root: Positional[Path]
    """Folder of the data set, as unpacked."""
    out: Path
    """File to write, one pair a line."""
    held_out: tuple[Path, ...] = ()
    """More pictures, or folders of them, that must not be trained on."""
    drop_leaks: bool = False
    """Leave out training pairs with a held-out picture, instead of refusing the list."""
    images: Literal["10k", "100k"] = "10k"
    """Which pictures of BDD100K: 10k have labels, 100k have none and are many."""
    clear: bool = False
    """List each clear training picture with itself, too, so that the adapter learns to leave a
    picture as it is, and blends of weathers fade to that; for objective paired."""
    seed: int = 0
    """Which clear picture is drawn for one in a weather where none is of the same place."""

    def run(self) -> None:
        """Read the pictures, look for leaks, write the list and say what is in it."""
        from weather_aug.edit.diffusion import leakage, pair_lists
        from weather_aug.edit.diffusion.pairs import SPLITS, with_clear, write_pairs

        if self.images != "10k" and self.dataset != "bdd100k":
            raise ArgumentError("--images is for bdd100k")
        if self.seed and self.dataset == "acdc":
            raise ArgumentError("--seed is not for acdc, whose pictures have reference frames")
        watched = to_people()
        if self.dataset == "acdc":
            listed = pair_lists.acdc_pairs(self.root, progress=watched)
        elif self.dataset == "muses":
            listed = pair_lists.muses_pairs(self.root, seed=self.seed, progress=watched)
        elif self.dataset == "bdd100k":
            listed = pair_lists.bdd100k_pairs(
                self.root, images=self.images, seed=self.seed, progress=watched
            )
        else:
            listed = pair_lists.folder_pairs(self.root, seed=self.seed, progress=watched)
        if self.drop_leaks:
            whole = listed
            listed = leakage.without_leaks(whole, self.held_out)
            dropped = len(whole.pairs) - len(listed.pairs)
            say(f"{dropped} training pairs left out, a picture of which is held out")
        else:
            leakage.check_no_leak(listed, self.held_out)
        if self.clear:
            listed = with_clear(listed)
        write_pairs(self.out, listed)
        counts = listed.counts()
        for style in listed.styles:
            by_split = (f"{counts.get((style, split), 0)} {split}" for split in SPLITS)
            say(f"{style}: {', '.join(by_split)}")
        labelled = sum(None not in (p.source_label, p.target_label) for p in listed.pairs)
        aligned = sum(pair.aligned for pair in listed.pairs)
        told = f"{aligned} aligned, {labelled} with both labels"
        say(f"{len(listed.pairs)} pairs ({told}) in {self.out}")
