"""Makes a dataset, or goes on making one: plan, collect, write each shard once, list it in the manifest.

Run again after any interruption it does what is missing; the bytes that result do not depend on the number of workers
or on how often it was interrupted. They depend on the settings and the versions in the manifest.
"""

from collections.abc import Iterable
from pathlib import Path

import click
import numpy as np
from tqdm import tqdm

from graspq.common.errors import UserError
from graspq.common.files import TEMPORARY_PREFIX, writable_folder
from graspq.common.machine import available_cores
from graspq.common.provenance import versions
from graspq.datagen.plan import (
    BYTES_PER_GRASP,
    GRASPS_PER_SECOND_AND_CORE,
    ShardPlan,
    check_disk,
    human_bytes,
    human_time,
    missing_shards,
    plan_shards,
)
from graspq.datagen.settings import DatagenSettings
from graspq.datagen.workers import BlockJob, collect_blocks
from graspq.datasets.card import write_card
from graspq.datasets.episode import Episode
from graspq.datasets.manifest import MANIFEST_NAME, Manifest
from graspq.datasets.writer import commit_shard, remove_leftovers, write_shard
from graspq.objects.defaults import default_object_set
from graspq.objects.object_set import ObjectSet
from graspq.sim.task import Task, task_named

VERSIONS = ("numpy", "scipy", "pybullet", "pyarrow", "trimesh")


def make_dataset(settings: DatagenSettings) -> Manifest:
    """Collect what is missing of a dataset and return its manifest.

    Raises:
        UserError: the folder holds something else, cannot be written to, or the disk is too small.
    """
    folder, task = settings.folder(), task_named(settings.task)
    _refuse_other_folder(folder)
    existing = Manifest.load(folder) if (folder / MANIFEST_NAME).is_file() else None
    _check_space(settings, folder, existing)
    objects = _object_set(settings, task, folder, existing)
    fresh = describe(settings, task, objects)
    if existing is not None:
        _require_same(folder, existing, fresh)
    plan = plan_shards(settings.collection(), settings.size)
    missing = missing_shards(plan, existing or fresh)
    if existing is not None and not missing and existing.files:
        click.echo(f"{folder} is complete: {existing.episodes:,} grasps, {human_bytes(existing.bytes)}")
        return existing
    draw_check(task, objects, settings)
    writable_folder(folder, "dataset")
    workers = settings.workers if settings.workers is not None else available_cores()
    _announce(settings, folder, missing, workers)
    remove_leftovers(folder)
    objects.copy_to(folder / "objects")
    manifest = existing if existing is not None else fresh
    if existing is None:
        manifest.save(folder)
    manifest = _collect(settings, folder, task, manifest, missing, workers)
    manifest = write_card(folder, manifest)
    click.echo(
        f"{folder}: {manifest.episodes:,} grasps, {manifest.rows:,} steps, {human_bytes(manifest.bytes)}, "
        f"success rate {manifest.successes / manifest.episodes:.3f}, manifest {manifest.digest()[:16]}"
    )
    return manifest


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
    foreign = [name for name in names if name != "objects" and not name.startswith(TEMPORARY_PREFIX)]
    if foreign:
        raise UserError(f"{folder}: holds {foreign[0]!r} but no {MANIFEST_NAME}; choose an empty folder with --out")


def _object_set(settings: DatagenSettings, task: Task, folder: Path, existing: Manifest | None) -> ObjectSet:
    if settings.objects is not None:
        return ObjectSet.load(settings.objects)
    if existing is not None and (folder / "objects" / "object_set.json").is_file():
        return ObjectSet.load(folder / "objects")
    return default_object_set(task.object_set)


def _require_same(folder: Path, existing: Manifest, fresh: Manifest) -> None:
    """Refuse to mix data that were made differently."""
    for what, name in (
        ("task", "task"),
        ("settings", "settings"),
        ("object set", "object_set"),
        ("discount", "discount"),
        ("versions", "versions"),
    ):
        there, here = getattr(existing, name), getattr(fresh, name)
        if there == here:
            continue
        if isinstance(there, dict):
            keys = [key for key in {**there, **here} if there.get(key) != here.get(key)]
            what, there, here = f"{what} ({keys[0]})", there.get(keys[0]), here.get(keys[0])
        raise UserError(
            f"{folder}: holds a dataset with another {what}: {there} there, {here} asked for; "
            "use the same, or another --out"
        )


def _check_space(settings: DatagenSettings, folder: Path, existing: Manifest | None) -> None:
    """Refuse a disk too full for the missing grasps before anything is written."""
    place = next(parent for parent in (folder, *folder.resolve().parents) if parent.is_dir())
    check_disk(place, max(0, settings.size - (existing.episodes if existing is not None else 0)))


def _announce(settings: DatagenSettings, folder: Path, missing: list[ShardPlan], workers: int) -> None:
    grasps = sum(shard.episodes for shard in missing)
    expected = grasps * BYTES_PER_GRASP
    seconds = grasps / (GRASPS_PER_SECOND_AND_CORE * min(workers, available_cores()))
    click.echo(
        f"{grasps:,} {settings.task} grasps to collect into {folder} with {workers} worker{'s' * (workers > 1)}: "
        f"about {human_bytes(expected)} and {human_time(seconds)} "
        f"(at {GRASPS_PER_SECOND_AND_CORE:g} grasps a second and core)"
    )


def _collect(
    settings: DatagenSettings,
    folder: Path,
    task: Task,
    manifest: Manifest,
    missing: list[ShardPlan],
    workers: int,
) -> Manifest:
    shard_of = {job.block: shard for shard in missing for job in shard.jobs}
    collected: dict[int, list[Episode]] = {}
    jobs: Iterable[BlockJob] = (job for shard in missing for job in shard.jobs)
    total = sum(shard.episodes for shard in missing)
    done = successes = 0
    with tqdm(total=total, unit="grasp", smoothing=0.05, dynamic_ncols=True) as bar:
        for job, episodes in collect_blocks(jobs, task, folder / "objects", settings.collection(), workers):
            collected[job.block] = episodes
            done += len(episodes)
            successes += sum(episode.success for episode in episodes)
            bar.update(len(episodes))
            bar.set_postfix(success=f"{successes / done:.3f}", refresh=False)
            shard = shard_of[job.block]
            if all(other.block in collected for other in shard.jobs):
                ordered = [episode for other in shard.jobs for episode in collected.pop(other.block)]
                entry = write_shard(folder, manifest, shard.first_block, len(shard.jobs), ordered)
                manifest = commit_shard(folder, manifest, entry)
    return manifest
