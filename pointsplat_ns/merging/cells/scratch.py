"""A folder of finished steps, so that work that was killed resumes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.io.files import one_line, read_text, replacing, require_space, write_json, write_tensors


class Scratch:
    """A folder whose files are complete, or not there.

    Args:
        folder: it is created. If it holds steps of other work, these are removed.
        work: description of the work, as JSON has it: all that its steps depend on.
        size: bytes of all steps together; they must be free for new work.

    Raises:
        SceneError: if the folder cannot be used, or the disk has no room for it.
    """

    def __init__(self, folder: Path, work: Mapping[str, object], size: int = 0):
        self.folder = folder
        known = folder / "work.json"
        try:
            same = known.is_file() and json.loads(read_text(known)) == work
        except ValueError:
            same = False
        try:
            if not same and folder.exists():
                shutil.rmtree(folder)
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise SceneError(f"{folder}: cannot be used ({error.strerror or one_line(error)})") from error
        if not same:
            require_space(folder, folder, size)
            write_json(work, known)

    def tensors(self, name: str, make: Callable[[], Mapping[str, Tensor]]) -> dict[str, Tensor]:
        """The tensors of a step, which is taken if it was not before."""
        self.make(name, make)
        return self.known(name)

    def make(self, name: str, make: Callable[[], Mapping[str, Tensor]]) -> None:
        """Take a step, unless it was taken before."""
        if not self.has(name):
            write_tensors(self._path(name), make(), {})

    def has(self, name: str) -> bool:
        """Whether a step was taken that gave tensors."""
        return self._path(name).is_file()

    def known(self, name: str) -> dict[str, Tensor]:
        """The tensors of a step that was taken. Raises SceneError if its file is gone or damaged."""
        from safetensors import SafetensorError
        from safetensors.torch import load_file

        try:
            return load_file(self._path(name))
        except (OSError, SafetensorError) as error:
            raise SceneError(f"{self.folder}: damaged ({one_line(error)}); remove it and start again") from error

    def drop(self, name: str) -> None:
        """Remove the tensors of a step, if they are there."""
        self._path(name).unlink(missing_ok=True)

    def file(self, name: str, make: Callable[[Path], None]) -> Path:
        """The file of a step, which is taken if it was not before: ``make`` writes to a path that is renamed then."""
        path = self.folder / name
        if not path.is_file():
            with replacing(path) as part:
                make(part)
        return path

    def remove(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.safetensors"
