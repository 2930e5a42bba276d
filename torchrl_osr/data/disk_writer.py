"""Write a data set to disk in chunks: killed, it goes on after the last whole one.

A folder beside the target has the rows so far and ``chunks.jsonl``, one line a chunk:
its rows, its part of the statistics, and how the source goes on after it. It is renamed
when it is whole. An unbroken run and one that was killed leave the same bytes.

Shapes: ``N`` rows of a chunk, ``S`` observation.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import torch
from filelock import FileLock
from tensordict import TensorDict
from torchrl import torchrl_logger
from tqdm.auto import tqdm

from torchrl_osr._files import check_disk_space
from torchrl_osr.data.chunk_statistics import merged, statistics_of
from torchrl_osr.data.manifest import sealed, unsealed
from torchrl_osr.data.on_disk import FORMAT_VERSION, MANIFEST, ROWS, TransitionsOnDisk
from torchrl_osr.data.records import RecordLayout
from torchrl_osr.data.validation import REWARD_KEY, VECTOR_KEYS, check_rows

Notes = dict[str, Any]
"""What a source says of a chunk, JSON-compatible."""

ChunkSource = Callable[[list[Notes]], Iterable[tuple[TensorDict, Notes]]]
"""Given the notes of the chunks that are written, yields those after them."""

CHUNKS = "chunks.jsonl"


def write_on_disk(
    chunks: ChunkSource,
    folder: Path | str,
    *,
    request: Mapping[str, Any] | None = None,
    describe: Callable[[list[Notes]], Mapping[str, Any]] | None = None,
    total: int | None = None,
    progress: bool = True,
) -> TransitionsOnDisk:
    """Write transitions to disk, chunk by chunk, unless they are there.

    A killed run goes on after the last chunk that was written whole, to the same bytes.
    Processes that write the same folder at once wait for one of them.

    Args:
        chunks: is called with the notes of the chunks that are written already, ``[]``
            at first, and yields those after them: transitions ``[N]``, see
            :func:`~torchrl_osr.data.check_dataset`, and notes, a dictionary that JSON
            can hold, such as ``{}``.
        folder: of the set; made with all that is above it.

    Keyword Args:
        request: JSON-compatible, what decides the rows. A set of another request is
            replaced, and what is left of another is not continued. Default: ``{}``.
        describe: is called with all notes, once all is written; its result is put into
            the manifest.
        total: number of rows, or more, for the bar and for a look at the free space
            before the work. Default: unknown.
        progress: show a progress bar when on a terminal. Default: ``True``.

    Returns:
        The set, opened.

    Raises:
        ValueError: transitions of a chunk are not what
            :func:`~torchrl_osr.data.check_dataset` expects, or of another size than
            those before, or there are none.
        OSError: the disk is full, or cannot be written.

    Examples:
        >>> import tempfile, torch
        >>> from tensordict import TensorDict
        >>> from torchrl_osr.data import write_on_disk
        >>> def rows(number):
        ...     state, no = torch.rand(100, 3), torch.zeros(100, 1, dtype=torch.bool)
        ...     after = {"observation": state, "reward": torch.ones(100, 1)}
        ...     after |= {"done": no, "terminated": no, "truncated": no}
        ...     before = {"observation": state - 0.1, "action": torch.rand(100, 2)}
        ...     return TensorDict(before | {"next": TensorDict(after, [100])}, [100])
        >>> def chunks(done):
        ...     for number in range(len(done), 5):
        ...         yield rows(number), {}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     len(write_on_disk(chunks, f"{folder}/set"))
        500
    """
    folder = Path(folder).expanduser()
    wanted = json.loads(
        json.dumps(request or {})
    )  # as the manifest's: it has no tuples
    # Without the lock first: a whole set can be read from a folder that is read-only.
    if (stored := _whole(folder, wanted)) is not None:
        return stored
    folder.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(f"{folder}.lock"):
        if (stored := _whole(folder, wanted)) is not None:
            return stored
        if folder.exists():
            torchrl_logger.warning(f"Writing {folder} anew: it is of no use.")
        partial = _Partial(folder.with_name(f".{folder.name}.partial"), wanted)
        with partial, tqdm(
            initial=partial.rows, total=total, desc=f"write {folder.name}", unit="row",
            unit_scale=True, disable=None if progress else True,
        ) as bar:  # fmt: skip
            for data, notes in chunks([line["notes"] for line in partial.lines]):
                if partial.layout is None and total is not None and len(data):
                    size = total * RecordLayout.of(data).dtype.itemsize
                    check_disk_space(folder.parent, size, f"the data set {folder.name}")
                partial.append(data, notes)
                bar.update(len(data))
            notes_of_all = [line["notes"] for line in partial.lines]
            partial.finish(describe(notes_of_all) if describe else {})
        if folder.exists():
            shutil.rmtree(folder)
        os.replace(partial.folder, folder)
        (folder / CHUNKS).unlink()
        return TransitionsOnDisk(folder)


def _whole(folder: Path, request: dict[str, Any]) -> TransitionsOnDisk | None:
    """Return the set that is there, if it is whole and of this request."""
    with suppress(OSError, ValueError):
        stored = TransitionsOnDisk(folder)
        if stored.manifest.get("request") == request:
            return stored
    return None


class _Partial:
    """The part of a set that is written so far."""

    def __init__(self, folder: Path, request: dict[str, Any]) -> None:
        self.folder, self.request = folder, request
        self.layout: RecordLayout | None = None
        self.lines: list[dict[str, Any]] = []
        folder.mkdir(exist_ok=True)
        log_bytes = self._restore()
        # What follows was being written at the kill.
        for name, size in ((CHUNKS, log_bytes), (ROWS, self.rows * self._row_bytes)):
            with (folder / name).open("ab") as file:
                file.truncate(size)
        self._log, self._rows = ((folder / name).open("ab") for name in (CHUNKS, ROWS))
        if not log_bytes:
            self._write_line({"request": request})

    @property
    def rows(self) -> int:
        """Number of rows that are written."""
        return sum(line["rows"] for line in self.lines)

    @property
    def _row_bytes(self) -> int:
        return self.layout.dtype.itemsize if self.layout else 0

    def __enter__(self) -> _Partial:
        return self

    def __exit__(self, *_: object) -> None:
        self._rows.close()
        self._log.close()

    def append(self, data: TensorDict, notes: Notes) -> None:
        """Write a chunk, and then that it is there."""
        line: dict[str, Any] = {"rows": len(data), "notes": notes}
        if len(data):
            check_rows(data)
            _check_types(data)
            layout = RecordLayout.of(data)
            if self.layout not in (None, layout):
                raise ValueError(
                    f"chunk {len(self.lines)} is of the layout {layout}; those before "
                    f"are of {self.layout}."
                )
            self.layout = layout
            line |= statistics_of(data)
        try:
            if len(data):
                self._rows.write(layout.pack(data).data)
                _sync(self._rows)
            self._write_line(line)
        except OSError as error:
            raise OSError(
                error.errno,
                f"cannot write the data set ({error.strerror}); once it can be, the "
                f"same call goes on from row {self.rows:,}",
                str(self.folder),
            ) from error
        self.lines.append(line)

    def finish(self, more: Mapping[str, Any]) -> None:
        """Write the manifest."""
        lines = [line for line in self.lines if line["rows"]]
        if self.layout is None:
            raise ValueError("there is no row to write; expected at least one.")
        statistics = merged(lines)
        with (self.folder / ROWS).open("rb") as file:
            checksum = hashlib.file_digest(file, "sha256").hexdigest()
        manifest = dict(more) | {
            "format_version": FORMAT_VERSION,
            "request": self.request,
            "num_transitions": self.rows,
            "observation_size": self.layout.observation_size,
            "action_size": self.layout.action_size,
            **statistics,
            "sha256": checksum,
        }
        with (self.folder / MANIFEST).open("w", encoding="utf-8") as out:
            json.dump(sealed(manifest), out, indent=1, allow_nan=False)
            out.flush()
            os.fsync(out.fileno())

    def _restore(self) -> int:
        """Take over what a killed run has left; return how much of the log that is."""
        log, rows = self.folder / CHUNKS, self.folder / ROWS
        content = log.read_bytes() if log.exists() else b""
        size = rows.stat().st_size if rows.exists() else 0
        taken = self._take_over(content, size)
        if taken < len(content) or self.rows * self._row_bytes < size:
            torchrl_logger.warning(
                f"{self.folder}: what follows row {self.rows:,} was not written whole, "
                f"is damaged ({CHUNKS}, {ROWS}) or of another request. Writing it anew."
            )
        return taken

    def _take_over(self, content: bytes, size: int) -> int:
        """Note the chunks that are whole; return how many bytes of the log they are."""
        taken = 0
        for raw in content.split(b"\n")[:-1]:  # a line without its end is not whole
            try:
                line = unsealed(raw.decode(), CHUNKS)
            except ValueError:
                break
            if not taken:
                if line["request"] != self.request:
                    break
            elif not self._fits(line, size):
                break
            taken += len(raw) + 1
        return taken

    def _fits(self, line: dict[str, Any], size: int) -> bool:
        """Note a chunk, if its rows have reached the disk."""
        layout = self.layout
        if line["rows"]:
            layout = RecordLayout(len(line["mean"]), line["action_size"])
        rows = self.rows + line["rows"]
        if layout and rows * layout.dtype.itemsize > size:
            return False
        self.layout = layout
        self.lines.append(line)
        return True

    def _write_line(self, line: dict[str, Any]) -> None:
        self._log.write(json.dumps(sealed(line), allow_nan=False).encode() + b"\n")
        _sync(self._log)


def _check_types(data: TensorDict) -> None:
    """Raise unless all numbers are float32: a cast might give an infinity."""
    for key in (*VECTOR_KEYS, REWARD_KEY):
        if data.get(key).dtype != torch.float32:
            raise ValueError(
                f"{key!r} has type {data.get(key).dtype}; expected torch.float32."
            )


def _sync(file: BinaryIO) -> None:
    file.flush()
    os.fsync(file.fileno())
