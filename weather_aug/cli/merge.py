"""The command that puts exports beside a Cityscapes root, by links."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from weather_aug.cli.terminal import complain, say, to_people
from weather_aug.cli.values import check_local


@dataclass(frozen=True)
class Merge:
    """Link a Cityscapes root and exports into one labelled source; run again to repair it."""

    root: Positional[Path]
    """Cityscapes, converted to train ids; or an export."""
    exports: Positional[tuple[Path, ...]]
    """Finished exports in the layout cityscapes."""
    out: Path
    """Folder of the merge; root and exports are only read."""
    hard: bool = False
    """Make hard links instead of symbolic ones; one disk has to hold all."""

    def run(self) -> None:
        """Merge and say what the result holds."""
        from weather_aug.taxonomy import CLASSES
        from weather_aug.writers.cityscapes import MIN_PIXELS
        from weather_aug.writers.merge import merge_cityscapes

        check_local(self.root, *self.exports, self.out)
        report = merge_cityscapes(
            self.root, self.exports, self.out, hard=self.hard, progress=to_people()
        )
        own = report.samples - report.exported
        say(f"{report.samples} labelled pictures ({own} + {report.exported}) in {self.out}")
        say(f"{report.linked} links made, {report.removed} removed")
        if report.dropped_classes:
            names = ", ".join(CLASSES[train_id] for train_id in report.dropped_classes)
            complain(
                f"warning: rare-class sampling leaves out {names}: no label has more than "
                f"{MIN_PIXELS} pixels of it"
            )
