"""The images that files of matches name, below one folder."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from torch import Tensor

from tensor_stereo.paths import check_folder

_IMAGES_AT_ONCE = 8  # that stay in memory: a file names an image for all of its pairs


class ImageFolder:
    """Images by their names in a file of matches, which are paths below a folder.

    Args:
        root: The folder.

    Raises:
        FileNotFoundError: If it is missing.

    >>> import tempfile, torch
    >>> from tensor_stereo.datasets.images import write_image
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_image(f"{folder}/a.png", torch.zeros(1, 4, 5, dtype=torch.uint8))
    ...     ImageFolder(Path(folder)).read("a.png").shape
    torch.Size([1, 4, 5])
    """

    def __init__(self, root: Path) -> None:
        self.root = check_folder("images", root)
        self._read = lru_cache(_IMAGES_AT_ONCE)(self._decode)

    def read(self, name: str) -> Tensor:
        """(C, H, W) uint8.

        Raises:
            FileNotFoundError: If there is no such image.
            ValueError: If the name leads out of the folder, or the file is no image.
        """
        return self._read(name)

    def find(self, stem: str) -> str | None:
        """The name of the only image directly in the folder that is called so without its ending; None otherwise."""
        found = [path.name for path in self.root.glob("*") if path.stem == stem and path.is_file()]
        return found[0] if len(found) == 1 else None

    def _decode(self, name: str) -> Tensor:
        from tensor_stereo.datasets.images import read_image

        path = Path(name)
        if path.is_absolute() or ".." in path.parts or not path.parts:
            raise ValueError(f"images must be named by paths below {self.root}, got {name!r}")
        if not (self.root / path).is_file():  # DISK leaves endings out
            beside = [one for one in (self.root / path.parent).glob("*") if one.stem == path.name and one.is_file()]
            path = path.with_name(beside[0].name) if len(beside) == 1 else path
        return read_image(self.root / path)
