"""Other ways to read shuffled transitions (s, a, r, s'), each as one would write it: the rivals of `loading.py`.

Each makes its own copy of the data in a folder of its own, which is not timed, and gives a factory of one epoch's
batches. A batch is a dictionary of tensors with `image` and `next_image`; all but LeRobot's, whose own transform gives
float32 [B, C, H, W] in [0, 1], have uint8 [B, H, W, C].
"""

import io
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

Epoch = Callable[[], Iterable[dict[str, Tensor]]]
LABELS = ("action", "reward", "terminal", "step", "mc_return")
SHUFFLE_BUFFER = 10_000


class Table:
    """The labels of all rows of a pool in memory, and their pictures one block after the other."""

    def __init__(self, pool: ShardPool) -> None:
        self.pool = pool
        records = [pool.read_columns(ref, (*LABELS, "episode_id")) for ref in pool.blocks]
        self.columns = {name: np.concatenate([block[name] for block in records]) for name in records[0]}
        terminal = self.columns["terminal"].astype(bool)
        self.next_row = np.arange(len(terminal)) + ~terminal

    def __len__(self) -> int:
        return len(self.next_row)

    def labels(self, row: int) -> dict[str, Tensor]:
        """Return the labels of a row as tensors."""
        return {name: torch.as_tensor(self.columns[name][row]) for name in LABELS}

    def pictures(self) -> Iterator[npt.NDArray[np.uint8]]:
        """Yield the pictures, uint8 [H, W, C], in the order of the rows."""
        for ref in self.pool.blocks:
            yield from self.pool.read_block(ref).images


def as_png(picture: npt.NDArray[np.uint8]) -> bytes:
    """Return a picture as the bytes of a PNG file, of Pillow's default compression."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "png")
    return file.getvalue()


class PngFiles(Dataset[dict[str, Tensor]]):
    """A map-style dataset over PNG files, one a frame; s' is the next file."""

    def __init__(self, table: Table, folder: Path) -> None:
        self.table, self.folder = table, folder
        for row, picture in enumerate(table.pictures()):
            path = self.path(row)
            path.parent.mkdir(parents=True, exist_ok=True)
            if not path.exists():
                path.write_bytes(as_png(picture))

    def path(self, row: int) -> Path:
        """Return the file of a row; a thousand in a folder."""
        return self.folder / f"{row // 1000:04d}" / f"{row:07d}.png"

    def picture(self, row: int) -> Tensor:
        """Return a row's picture, uint8 [H, W, C]."""
        with Image.open(self.path(row)) as image:
            return torch.from_numpy(np.array(image))

    def __len__(self) -> int:
        return len(self.table)

    def __getitem__(self, row: int) -> dict[str, Tensor]:
        pictures = {"image": self.picture(row), "next_image": self.picture(int(self.table.next_row[row]))}
        return pictures | self.table.labels(row)


def shuffled(dataset: Dataset[dict[str, Tensor]], batch_size: int, workers: int) -> Epoch:
    """Return an epoch's factory: PyTorch's own loader, shuffled over all rows, with so many worker processes."""
    return lambda: DataLoader(dataset, batch_size, shuffle=True, num_workers=workers, drop_last=True)


def png_files(table: Table, folder: Path, batch_size: int, workers: int) -> Epoch:
    """Return an epoch's factory of a PyTorch `Dataset` and `DataLoader` over PNG files."""
    return shuffled(PngFiles(table, folder), batch_size, workers)


def shard_files(pool: ShardPool) -> list[str]:
    """Return the steps tables of a pool."""
    return [str(path) for path in dict.fromkeys(ref.path for ref in pool.blocks)]


class MapStyleRows(Dataset[dict[str, Tensor]]):
    """Hugging Face `datasets`, map-style: the memory-mapped Arrow copy that `load_dataset` makes of the Parquet files.

    `__getitems__` fetches a whole batch at once, as their `DataLoader` guide advises.
    """

    def __init__(self, rows: Any, next_row: npt.NDArray[np.int64], shape: tuple[int, int, int]) -> None:
        self.rows, self.frames = rows.select_columns(["image", *LABELS]), rows.select_columns(["image"])
        self.next_row, self.shape = next_row, shape

    def __len__(self) -> int:
        return len(self.next_row)

    def __getitems__(self, indices: list[int]) -> dict[str, Tensor]:
        """Return a batch."""
        batch, following = self.rows[indices], self.frames[self.next_row[indices].tolist()]
        labels = {name: torch.as_tensor(np.asarray(batch[name])) for name in LABELS}
        pictures = {"image": batch["image"], "next_image": following["image"]}
        return {name: _stacked(values, self.shape) for name, values in pictures.items()} | labels


def hugging_face_map(pool: ShardPool, folder: Path, batch_size: int, workers: int) -> Epoch:
    """Return an epoch's factory of Hugging Face `datasets`, map-style, on the pool's Parquet files."""
    import datasets

    datasets.disable_progress_bars()
    rows = datasets.load_dataset("parquet", data_files=shard_files(pool), split="train", cache_dir=str(folder))
    terminal = np.asarray(rows["terminal"])
    dataset = MapStyleRows(rows, np.arange(len(rows)) + ~terminal, pool.image_shape)
    return lambda: DataLoader(
        dataset, batch_size, shuffle=True, num_workers=workers, drop_last=True, collate_fn=lambda batch: batch
    )


class _Pairs:
    """Makes transitions of streamed batches of rows; a batch's last row waits for the next batch.

    A row that the next one does not continue is left out: a look at the head of the stream, or an epoch that was broken
    off, leaves one behind.
    """

    def __init__(self) -> None:
        self.held: dict[str, list[Any]] = {}

    def __call__(self, batch: dict[str, list[Any]]) -> dict[str, list[Any]]:
        batch = {name: [*self.held.get(name, []), *values] for name, values in batch.items()}
        self.held = {name: values[-1:] for name, values in batch.items()}
        image, terminal, step = batch["image"], batch["terminal"], batch["step"]
        rows = [row for row in range(len(image) - 1) if terminal[row] or step[row + 1] == step[row] + 1]
        following = [image[row if terminal[row] else row + 1] for row in rows]
        return {name: [values[row] for row in rows] for name, values in batch.items()} | {"next_image": following}


def hugging_face_stream(pool: ShardPool, batch_size: int, workers: int) -> Epoch:
    """Return an epoch's factory of Hugging Face `datasets`, streamed through a shuffle buffer."""
    import datasets

    datasets.disable_progress_bars()
    files, shape = shard_files(pool), pool.image_shape

    def collate(rows: list[dict[str, Any]]) -> dict[str, Tensor]:
        labels = {name: torch.as_tensor(np.asarray([row[name] for row in rows])) for name in LABELS}
        return {name: _stacked([row[name] for row in rows], shape) for name in ("image", "next_image")} | labels

    def epoch() -> Iterable[dict[str, Tensor]]:
        stream = datasets.load_dataset("parquet", data_files=files, split="train", streaming=True)
        stream = stream.map(_Pairs(), batched=True).shuffle(seed=0, buffer_size=SHUFFLE_BUFFER // max(workers, 1))
        return DataLoader(stream, batch_size, num_workers=min(workers, len(files)), drop_last=True, collate_fn=collate)

    return epoch


class LeRobotRows(Dataset[dict[str, Tensor]]):
    """Random access as LeRobotDataset v3 does it, without its package (it needs Python 3.12).

    Frames are PNG bytes in Parquet, loaded by Hugging Face `datasets` with a transform of every value to a tensor; a
    sample is one row lookup, and one more for the frames at `delta_timestamps` [0, 1 / fps], s and s', all decoded.

    Source: `LeRobotDataset.__getitem__`, `_query_hf_dataset` and `hf_transform_to_torch` of LeRobot.
    """

    def __init__(self, table: Table, folder: Path) -> None:
        import datasets

        datasets.disable_progress_bars()
        self.next_row = table.next_row
        features = datasets.Features(
            {
                "image": datasets.Image(),
                "action": datasets.Sequence(datasets.Value("float32"), length=4),
                "reward": datasets.Value("float32"),
                "terminal": datasets.Value("bool"),
                "step": datasets.Value("int64"),
                "mc_return": datasets.Value("float32"),
            }
        )
        path = folder / "data" / "chunk-000" / "file-000.parquet"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            self._write(table, path)
        self.rows = datasets.Dataset.from_parquet(str(path), features=features, cache_dir=str(folder / "cache"))
        self.frames = self.rows.select_columns(["image"])
        self.rows.set_transform(_to_torch)
        self.frames.set_transform(_to_torch)

    @staticmethod
    def _write(table: Table, path: Path) -> None:
        pictures = [{"bytes": as_png(picture), "path": None} for picture in table.pictures()]
        image = pa.array(pictures, pa.struct([("bytes", pa.binary()), ("path", pa.string())]))
        action = pa.FixedSizeListArray.from_arrays(pa.array(table.columns["action"].ravel()), 4)
        others = {name: pa.array(table.columns[name]) for name in ("reward", "terminal", "step", "mc_return")}
        temporary = path.with_suffix(".writing")
        pq.write_table(pa.table({"image": image, "action": action, **others}), temporary)
        temporary.rename(path)

    def __len__(self) -> int:
        return len(self.next_row)

    def __getitem__(self, row: int) -> dict[str, Tensor]:
        item = self.rows[row]
        frames = torch.stack(self.frames[[row, int(self.next_row[row])]]["image"])
        return {**item, "image": frames[0], "next_image": frames[1]}


def _to_torch(batch: dict[str, list[Any]]) -> dict[str, list[Tensor]]:
    def tensor(value: Any) -> Tensor:
        if not isinstance(value, Image.Image):
            return torch.tensor(value)
        # What torchvision's ToTensor does.
        return torch.from_numpy(np.array(value)).permute(2, 0, 1).contiguous().float().div(255)

    return {name: [tensor(value) for value in values] for name, values in batch.items()}


def lerobot_style(table: Table, folder: Path, batch_size: int, workers: int) -> Epoch:
    """Return an epoch's factory of LeRobot-style random access with PyTorch's loader."""
    return shuffled(LeRobotRows(table, folder), batch_size, workers)


def _stacked(pictures: list[bytes], shape: tuple[int, int, int]) -> Tensor:
    joined = np.frombuffer(b"".join(pictures), np.uint8).reshape(-1, *shape)
    return torch.from_numpy(joined.copy())
