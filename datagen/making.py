"""Makes a dataset, or goes on making one: plan, collect, write each shard once, list it in the manifest.

Run again after any interruption it does what is missing; the bytes that result do not depend on the number of workers
or on how often it was interrupted. They depend on the settings and the versions in the manifest.
"""

import contextlib
from pathlib import Path

import click
import numpy as np
from tqdm import tqdm

from graspq.common.errors import CommandError, UserError
from graspq.common.files import LOCK_NAME, TEMPORARY_PREFIX, locked, writable_folder
from graspq.common.machine import available_cores
from graspq.common.provenance import versions
from graspq.common.text import bytes_text, counted, duration_text
from graspq.datagen.collect import Collection, collected
from graspq.datagen.settings import DatagenSettings
from graspq.datagen.shards import (
    BYTES_PER_GRASP,
    GRASPS_PER_SECOND_AND_CORE,
    check_disk,
    episodes_of,
    missing_shards,
    plan_shards,
)
from graspq.datagen.shards import Shard as PlannedShard
from graspq.datasets.card import write_card
from graspq.datasets.dataset import Shard
from graspq.datasets.episode import Episode
from graspq.datasets.manifest import MANIFEST_NAME, Manifest, require_same
from graspq.datasets.writer import commit_shard, remove_leftovers, write_shard
from graspq.objects.defaults import default_object_set
from graspq.objects.object_set import ObjectSet
from graspq.sim.task import Task, task_named

VERSIONS = ("numpy", "scipy", "pybullet", "pybullet-arm64", "pyarrow", "trimesh")
OTHERWISE = "use the same, or another --out"


def make_dataset(settings: DatagenSettings) -> Manifest:
    """Collect what is missing of a dataset, or damaged in it, and return its manifest.

    Raises:
        UserError: the folder holds something else, cannot be written to, or another process collects into it; the
            disk is too small; or a block ended two workers, after all others are done.
    """
    folder, task = settings.folder(), task_named(settings.task)
    _refuse_other_folder(folder)
    existing = _existing(folder)
    _check_space(settings, folder, existing)
    objects = _object_set(settings, task, folder, existing)
    fresh = describe(settings, task, objects)
    plan = plan_shards(settings.collection(), settings.size)
    if existing is not None:
        require_same(folder, existing, fresh, OTHERWISE)
        complete = not missing_shards(plan, existing) and existing.files
        if complete and not _damaged(folder, existing, plan):
            click.echo(f"{folder} is complete: {existing.episodes:,} grasps, {bytes_text(existing.bytes)}")
            return existing
    draw_check(task, objects, settings)
    writable_folder(folder, "dataset")
    with locked(folder, "grasp-datagen"):
        manifest = _existing(folder) or fresh
        require_same(folder, manifest, fresh, OTHERWISE)
        damaged = _damaged(folder, manifest, plan)
        for reason in damaged.values():
            click.echo(f"{reason}; it is made again", err=True)
        missing = missing_shards(plan, manifest, damaged)
        _announce(settings, folder, missing)
        remove_leftovers(folder)
        objects.copy_to(folder / "objects")
        manifest.save(folder)
        manifest = _collect(settings, folder, task, manifest, missing)
        manifest = write_card(folder, manifest)
    click.echo(
        f"{folder}: {manifest.episodes:,} grasps, {manifest.rows:,} steps, {bytes_text(manifest.bytes)}, "
        f"success rate {manifest.successes / manifest.episodes:.3f}, manifest {manifest.digest()[:16]}"
    )
    return manifest


def _existing(folder: Path) -> Manifest | None:
    return Manifest.load(folder) if (folder / MANIFEST_NAME).is_file() else None


def _damaged(folder: Path, manifest: Manifest, plan: list[PlannedShard]) -> dict[int, str]:
    """Return first block -> fault of the listed shards that are not as they were written; they are made again.

    Raises:
        UserError: one is longer than the plan would make it again.
    """
    planned, found = {shard[0].number: episodes_of([shard]) for shard in plan}, dict[int, str]()
    for entry in manifest.shards:
        shard = Shard(folder, manifest, entry)
        try:
            for path in (shard.steps, shard.episodes):
                shard.check(path)
        except CommandError as error:  # also where the disk does not give it: it is written anew
            reason = error.message.partition("; ")[0]
            if planned.get(entry.first_block, 0) < entry.episodes:
                size = entry.first_block * manifest.block_size + entry.episodes
                raise UserError(f"{reason}; ask for {size:,} grasps or more to make it again") from None
            found[entry.first_block] = reason
    return found


def describe(settings: DatagenSettings, task: Task, objects: ObjectSet) -> Manifest:
    """Return the manifest of the dataset before its first shard."""
    return Manifest(
        task=task.settings.to_json(),
        settings=settings.collection().described(),
        versions=versions(*VERSIONS),
        object_set={"name": objects.name, "sha256": objects.digest()},
        image_shape=(task.settings.image_size, task.settings.image_size, 3),
        action=task.action,
        discount=settings.discount,
        phi_range=(-task.settings.phi_limit, task.settings.phi_limit),
    )


def draw_check(task: Task, objects: ObjectSet, settings: DatagenSettings) -> None:
    """Fail now, not in a worker, where the object set cannot fill a bin.

    Raises:
        UserError: see `Task.draw`.
    """
    task.draw(objects, settings.collection().split, np.random.default_rng(0))


def _refuse_other_folder(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: a file, expected a folder to write the dataset to; choose another --out")
    if not folder.is_dir() or (folder / MANIFEST_NAME).is_file():
        return
    names = [entry.name for entry in folder.iterdir()]
    known = ("objects", LOCK_NAME)
    foreign = [name for name in names if name not in known and not name.startswith(TEMPORARY_PREFIX)]
    if foreign:
        raise UserError(f"{folder}: holds {foreign[0]!r} but no {MANIFEST_NAME}; choose an empty folder with --out")


def _object_set(settings: DatagenSettings, task: Task, folder: Path, existing: Manifest | None) -> ObjectSet:
    if settings.objects is not None:
        return ObjectSet.load(settings.objects)
    if existing is not None and (folder / "objects" / "object_set.json").is_file():
        return ObjectSet.load(folder / "objects")
    return default_object_set(task.object_set)


def _check_space(settings: DatagenSettings, folder: Path, existing: Manifest | None) -> None:
    """Refuse a disk too full for the missing grasps before anything is written."""
    place = next(parent for parent in (folder, *folder.resolve().parents) if parent.is_dir())
    check_disk(place, max(0, settings.size - (existing.episodes if existing is not None else 0)))


def _announce(settings: DatagenSettings, folder: Path, missing: list[PlannedShard]) -> None:
    grasps = episodes_of(missing)
    workers = settings.workers if settings.workers is not None else available_cores()
    seconds = grasps / (GRASPS_PER_SECOND_AND_CORE * max(1, min(workers, available_cores())))
    where = f"with {counted(workers, 'worker')}" if settings.engine == "local" else "on Ray"
    click.echo(
        f"{grasps:,} {settings.task} grasps to collect into {folder} {where}: about "
        f"{bytes_text(grasps * BYTES_PER_GRASP)} and {duration_text(seconds)} "
        f"(at {GRASPS_PER_SECOND_AND_CORE:g} grasps a second and core)"
    )


def _collect(
    settings: DatagenSettings, folder: Path, task: Task, manifest: Manifest, missing: list[PlannedShard]
) -> Manifest:
    collection = Collection(task.settings.to_json(), folder / "objects", settings.collection())
    shard_of = {block: shard for shard in missing for block in shard}
    waiting: dict[int, list[Episode]] = {}
    done = successes = 0
    with (
        tqdm(total=episodes_of(missing), unit="grasp", smoothing=0.05, dynamic_ncols=True) as bar,
        contextlib.closing(collected(collection, shard_of, settings)) as finished,
    ):
        for block, episodes in finished:
            waiting[block.number] = episodes
            done += len(episodes)
            successes += sum(episode.success for episode in episodes)
            bar.update(len(episodes))
            bar.set_postfix(success=f"{successes / done:.3f}", refresh=False)
            numbers = [other.number for other in shard_of[block]]
            if all(number in waiting for number in numbers):
                ordered = [episode for number in numbers for episode in waiting.pop(number)]
                entry = write_shard(folder, manifest, numbers[0], len(numbers), ordered)
                manifest = commit_shard(folder, manifest, entry)
    return manifest
