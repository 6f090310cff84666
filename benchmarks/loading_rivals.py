"""Usual ways to read shuffled transitions (s, a, r, s'), each as one would write it: the rivals of `loading.py`.

Each makes its own copy of the data in a folder, which is not timed, and gives a factory of one epoch's batches:
dictionaries of tensors with `image` and `next_image`, uint8 [B, H, W, C] (LeRobot's: float32 [B, C, H, W] in [0, 1]).
"""

import io
import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from PIL import Image
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from graspq.datasets.pool import ShardPool

Batch = dict[str, Tensor]
Epoch = Callable[[], Iterable[Batch]]
LABELS = ("action", "reward", "terminal", "step", "mc_return")
SHUFFLE_BUFFER = 10_000
WORKERS = 2  # processes of each rival


class Frames:
    """The labels of all rows of a pool in memory, and their pictures one block after the other."""

    def __init__(self, pool: ShardPool) -> None:
        self.pool = pool
        records = [pool.read_columns(ref, LABELS) for ref in pool.blocks]
        self.columns = {name: np.concatenate([block[name] for block in records]) for name in LABELS}
        terminal = self.columns["terminal"].astype(bool)
        self.next_row = np.arange(len(terminal)) + ~terminal
        self.files = [str(path) for path in dict.fromkeys(ref.path for ref in pool.blocks)]

    def pictures(self) -> Iterator[npt.NDArray[np.uint8]]:
        """Yield the pictures, uint8 [H, W, C], in the order of the rows."""
        for ref in self.pool.blocks:
            yield from self.pool.read_block(ref).images

    def stacked(self, pictures: list[bytes]) -> Tensor:
        """Return pictures, raw RGB or PPM with a header before it, as uint8 [B, H, W, C]."""
        shape = self.pool.image_shape
        raw = b"".join(picture[-math.prod(shape) :] for picture in pictures)
        return torch.from_numpy(np.frombuffer(raw, np.uint8).reshape(-1, *shape).copy())


def as_png(picture: npt.NDArray[np.uint8]) -> bytes:
    """Return a picture as the bytes of a PNG file, of Pillow's default compression."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "png")
    return file.getvalue()


def shuffled(copy: Callable[[Frames, Path], Dataset[Batch]]) -> Callable[[Frames, Path, int], Epoch]:
    """Return what reads a copy of the data by PyTorch's own `DataLoader`, shuffled over all rows."""

    def epoch_of(frames: Frames, folder: Path, batch_size: int) -> Epoch:
        dataset = copy(frames, folder)
        collate = getattr(dataset, "collate", None)
        return lambda: DataLoader(dataset, batch_size, True, num_workers=WORKERS, drop_last=True, collate_fn=collate)

    return epoch_of


def hugging_face() -> Any:
    """Return Hugging Face's `datasets`, without bars of progress.

    Raises:
        ImportError: it is not installed.
    """
    import datasets

    datasets.disable_progress_bars()
    return datasets


class PngFiles(Dataset[Batch]):
    """PNG files, one a frame, a thousand in a folder; s' is the next file."""

    def __init__(self, frames: Frames, folder: Path) -> None:
        self.frames, self.folder = frames, folder
        for row, picture in enumerate(frames.pictures()):
            self._path(row).parent.mkdir(parents=True, exist_ok=True)
            self._path(row).write_bytes(as_png(picture))

    def _path(self, row: int) -> Path:
        return self.folder / f"{row // 1000:04d}" / f"{row:07d}.png"

    def _picture(self, row: int) -> Tensor:
        with Image.open(self._path(row)) as image:
            return torch.from_numpy(np.array(image))

    def __len__(self) -> int:
        return len(self.frames.next_row)

    def __getitem__(self, row: int) -> Batch:
        pictures = {"image": self._picture(row), "next_image": self._picture(int(self.frames.next_row[row]))}
        return pictures | {name: torch.as_tensor(values[row]) for name, values in self.frames.columns.items()}


class MapStyleRows(Dataset[Batch]):
    """The memory-mapped copy that Hugging Face's `load_dataset` makes of Parquet files.

    `__getitems__` fetches a whole batch at once, as their `DataLoader` guide advises.
    """

    def __init__(self, frames: Frames, folder: Path) -> None:
        rows = hugging_face().load_dataset("parquet", data_files=frames.files, split="train", cache_dir=str(folder))
        self.rows, self.images = rows.select_columns(["image", *LABELS]), rows.select_columns(["image"])
        self.frames, self.collate = frames, lambda batch: batch

    def __len__(self) -> int:
        return len(self.frames.next_row)

    def __getitems__(self, indices: list[int]) -> Batch:
        """Return a batch."""
        batch, following = self.rows[indices], self.images[self.frames.next_row[indices].tolist()]
        labels = {name: torch.as_tensor(np.asarray(batch[name])) for name in LABELS}
        pictures = {"image": batch["image"], "next_image": following["image"]}
        return labels | {name: self.frames.stacked(values) for name, values in pictures.items()}


class Pairs:
    """Makes transitions of streamed batches of rows; a batch's last row waits for the next batch.

    A row that the next one does not continue is left out: a look at the head of the stream, or an epoch that was broken
    off, leaves one behind.
    """

    def __init__(self) -> None:
        self.held: dict[str, list[Any]] = {}

    def __call__(self, batch: dict[str, list[Any]]) -> dict[str, list[Any]]:
        """Return the transitions that a batch of rows completes."""
        batch = {name: [*self.held.get(name, []), *values] for name, values in batch.items()}
        self.held = {name: values[-1:] for name, values in batch.items()}
        image, terminal, step = batch["image"], batch["terminal"], batch["step"]
        rows = [row for row in range(len(image) - 1) if terminal[row] or step[row + 1] == step[row] + 1]
        following = [image[row if terminal[row] else row + 1] for row in rows]
        return {name: [values[row] for row in rows] for name, values in batch.items()} | {"next_image": following}


def hugging_face_stream(frames: Frames, folder: Path, batch_size: int) -> Epoch:
    """Hugging Face `datasets`, streamed from the pool's Parquet files through a shuffle buffer."""
    datasets, files = hugging_face(), frames.files

    def collate(rows: list[dict[str, Any]]) -> Batch:
        labels = {name: torch.as_tensor(np.asarray([row[name] for row in rows])) for name in LABELS}
        return labels | {name: frames.stacked([row[name] for row in rows]) for name in ("image", "next_image")}

    def epoch() -> Iterable[Batch]:
        stream = datasets.load_dataset("parquet", data_files=files, split="train", streaming=True)
        stream = stream.map(Pairs(), batched=True).shuffle(seed=0, buffer_size=SHUFFLE_BUFFER // max(WORKERS, 1))
        return DataLoader(stream, batch_size, num_workers=min(WORKERS, len(files)), drop_last=True, collate_fn=collate)

    return epoch


class LeRobotRows(Dataset[Batch]):
    """Random access as LeRobotDataset v3 does it, without its package (it needs Python 3.12).

    Frames are PNG bytes in Parquet, loaded by Hugging Face `datasets` with a transform of every value to a tensor; a
    sample is one row lookup, and one more for the frames at `delta_timestamps` [0, 1 / fps], s and s', all decoded.

    Source: `LeRobotDataset.__getitem__`, `_query_hf_dataset` and `hf_transform_to_torch` of LeRobot.
    """

    def __init__(self, frames: Frames, folder: Path) -> None:
        datasets, path = hugging_face(), folder / "file-000.parquet"
        folder.mkdir(parents=True, exist_ok=True)
        columns = {name: pa.array(list(values)) for name, values in frames.columns.items()}
        pq.write_table(pa.table({"image": pa.array(map(as_png, frames.pictures())), **columns}), path)
        rows = datasets.Dataset.from_parquet(str(path), cache_dir=str(folder / "cache"))
        self.next_row = frames.next_row
        self.rows = rows.cast_column("image", datasets.Image())
        self.images = self.rows.select_columns(["image"])
        self.rows.set_transform(to_tensors)
        self.images.set_transform(to_tensors)

    def __len__(self) -> int:
        return len(self.next_row)

    def __getitem__(self, row: int) -> Batch:
        images = torch.stack(self.images[[row, int(self.next_row[row])]]["image"])
        return {**self.rows[row], "image": images[0], "next_image": images[1]}


def to_tensors(batch: dict[str, list[Any]]) -> dict[str, list[Tensor]]:
    """Return every value as a tensor; a picture as torchvision's ToTensor does."""

    def tensor(value: Any) -> Tensor:
        if not isinstance(value, Image.Image):
            return torch.tensor(value)
        return torch.from_numpy(np.array(value)).permute(2, 0, 1).contiguous().float().div(255)

    return {name: [tensor(value) for value in values] for name, values in batch.items()}
