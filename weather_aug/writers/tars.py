"""Tars of samples as WebDataset reads them, the same bytes for the same samples.

A sample is the members whose names agree up to the first dot, in a row; the rest of the name is the
key that a loader finds them by:

    <base>.image.png  <base>.label.png  …  <base>.json (the recipe)

WebDataset's decoders "rgb8", "rgb" and "pil" give a label three channels, and its default decoder
unpickles whatever is called so. Take the bytes and decode them, labels and 16-bit planes unchanged:

    sample["label.png"]    cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    sample["json"]         json.loads(data)

A tar that ends too early is read as a shorter data set without an error; only its size and digest
tell, which manifest and `verify_export` hold.
"""

from __future__ import annotations

import io
import tarfile
from typing import Any

from weather_aug import _files

MODE = 0o644


class Tar:
    """A tar being filled in memory; nothing in it tells who made it, when or where."""

    def __init__(self) -> None:
        self._buffer = io.BytesIO()
        # GNU's format has names of any length; up to 100 bytes its members are plain ustar's.
        self._tar = tarfile.open(fileobj=self._buffer, mode="w", format=tarfile.GNU_FORMAT)

    def add(self, name: str, data: bytes) -> dict[str, Any]:
        """Append a file; what the manifest says of it comes back.

        Returns:
            Its name, the offset of its first byte in the tar, its size in bytes, its SHA-256.
        """
        member = tarfile.TarInfo(name)
        member.size, member.mode, member.mtime = len(data), MODE, 0
        self._tar.addfile(member, io.BytesIO(data))
        padded = -(-len(data) // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE
        return {
            "name": name,
            "offset": self._buffer.tell() - padded,
            "size": len(data),
            "sha256": _files.sha256_of(data),
        }

    def closed(self) -> bytes:
        """The whole tar; nothing can be added any more."""
        self._tar.close()
        return self._buffer.getvalue()
