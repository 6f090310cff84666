"""The growing dataset of an on-policy run: one shard for each round, written once, as `grasp-datagen` writes its own.

Which episodes a round has is a function of seed, round and the weights that act: a round that was killed is collected
again, one that is in the manifest never is.
"""

import contextlib
import dataclasses
import math
from pathlib import Path
from typing import Any

from graspq.common.files import writable_folder
from graspq.common.provenance import versions
from graspq.common.seeding import integer_seed
from graspq.datagen.collect import Block, Collection, collected
from graspq.datagen.making import VERSIONS
from graspq.datagen.settings import CollectionSettings
from graspq.datagen.shards import check_disk
from graspq.datasets.blocks import BlockRef
from graspq.datasets.card import write_card
from graspq.datasets.dataset import open_shards
from graspq.datasets.manifest import MANIFEST_NAME, Manifest, ShardEntry, require_same, steps_file
from graspq.datasets.pool import ShardPool
from graspq.datasets.writer import commit_shard, remove_leftovers, write_shard
from graspq.objects.object_set import ObjectSet
from graspq.sim.play import Policy
from graspq.sim.task import Task
from graspq.studies.online.resolve import Plan

DATASET = "dataset"


def collection_settings(plan: Plan) -> CollectionSettings:
    """Return what determines the scenes of all rounds; they share none with a dataset of the same seed."""
    settings = CollectionSettings(
        seed=integer_seed("online/collection", plan.train.seed),
        descend_probability=plan.online.descend_probability,
        policy=plan.train.algo,
    )
    return dataclasses.replace(settings, blocks_per_shard=math.ceil(plan.online.grasps / settings.block_size))


def round_blocks(settings: CollectionSettings, grasps: int, number: int) -> list[Block]:
    """Return the blocks of round `number`, from 0: whole ones, and a short last one where there is a rest."""
    size, blocks = settings.block_size, settings.blocks_per_shard
    return [
        Block(number * blocks + index, min(size, grasps - index * size), number * grasps + index * size)
        for index in range(blocks)
    ]


@dataclasses.dataclass
class GrowingDataset:
    """The dataset folder of a run, with the rounds that are finished.

    Attributes:
        folder: of the dataset.
        manifest: as saved.
        plan: of the run.
        blocks: of each finished round.
    """

    folder: Path
    manifest: Manifest
    plan: Plan
    blocks: list[tuple[BlockRef, ...]] = dataclasses.field(default_factory=list)

    @classmethod
    def open(cls, run: Path, plan: Plan, task: Task, objects: ObjectSet, pool: ShardPool) -> "GrowingDataset":
        """Return the dataset of the run in folder `run`, begun where there is none; finished rounds are verified.

        Args:
            run: folder of the run, which the caller has locked.
            plan: of the run.
            task: of the base pool.
            objects: that fill the bins.
            pool: the base pool; its discount is taken over.

        Raises:
            UserError: what is there was made otherwise or is damaged, or the disk is too full.
        """
        folder = writable_folder(run / DATASET, "dataset")
        online: dict[str, Any] = plan.described() | {"algo": plan.train.algo, "seed": plan.train.seed}
        fresh = Manifest(
            task=task.settings.to_json(),
            settings=collection_settings(plan).described() | {"online": online},
            versions=versions(*VERSIONS, "torch"),
            object_set={"name": objects.name, "sha256": objects.digest()},
            image_shape=(task.settings.image_size, task.settings.image_size, 3),
            action=task.action,
            discount=pool.discount,
            phi_range=(-task.settings.phi_limit, task.settings.phi_limit),
        )
        remove_leftovers(folder)
        growing = cls(folder, Manifest.load(folder) if (folder / MANIFEST_NAME).is_file() else fresh, plan)
        require_same(folder, growing.manifest, fresh, "choose another run folder with --out")
        check_disk(folder, plan.online.rounds * plan.online.grasps - growing.manifest.episodes)
        objects.copy_to(folder / "objects")
        growing.manifest.save(folder)
        for entry in growing.manifest.shards:
            growing._take_up(entry)
        if growing.blocks:  # a killed writer may have left the card of the round before
            growing.manifest = write_card(folder, growing.manifest)
        return growing

    def collect(self, number: int, policy: Policy) -> ShardEntry:
        """Return the shard of round `number`, from 0, which is collected and committed if it is not there.

        Args:
            number: at most the number of finished rounds.
            policy: who acts.

        Raises:
            UserError: a block killed its worker twice, or the disk is full.
        """
        if number < len(self.blocks):
            return self.manifest.shards[number]
        settings = collection_settings(self.plan)
        blocks = round_blocks(settings, self.plan.online.grasps, number)
        work = Collection(self.manifest.task, self.folder / "objects", settings, policy)
        with contextlib.closing(collected(work, blocks, self.plan.online.where)) as found:
            by_block = dict(found)
        episodes = [episode for block in blocks for episode in by_block[block]]
        entry = write_shard(self.folder, self.manifest, blocks[0].number, len(blocks), episodes)
        self.manifest = write_card(self.folder, commit_shard(self.folder, self.manifest, entry))
        self._take_up(entry)
        return entry

    def blocks_of(self, rounds: int) -> tuple[BlockRef, ...]:
        """Return the blocks of the first `rounds` rounds, in order."""
        return tuple(ref for blocks in self.blocks[:rounds] for ref in blocks)

    def _take_up(self, entry: ShardEntry) -> None:
        self.blocks.append(open_shards([self.folder / steps_file(entry.name)]).blocks)
