"""`grasp-data`: says what is in datasets, verifies them, draws their episodes.

The work is done in `manifest`, `verify` and `show`.
"""

from dataclasses import dataclass
from pathlib import Path

import click
from tqdm import tqdm

from graspq.common.errors import UserError
from graspq.common.options import Group, Settings, options_from, setting, with_version
from graspq.common.text import aligned, bytes_text, counted
from graspq.datasets.columns import quantities
from graspq.datasets.manifest import Manifest


@dataclass(frozen=True)
class InfoSettings(Settings):
    """Settings of `grasp-data info`."""

    path: tuple[Path, ...] = setting(help="dataset folders", positional=True, metavar="PATH...")


@dataclass(frozen=True)
class VerifySettings(Settings):
    """Settings of `grasp-data verify`."""

    path: Path = setting(help="dataset folder", positional=True, metavar="PATH")
    workers: int | None = setting(
        None, help="Processes; all cores if not given, 0 for this one.", minimum=0, maximum=4096
    )


@dataclass(frozen=True)
class ShowSettings(Settings):
    """Settings of `grasp-data show`."""

    path: Path = setting(help="dataset folder", positional=True, metavar="PATH")
    episodes: int = setting(4, help="Number of episodes, 1 to 100.", minimum=1, maximum=100)
    out: Path = setting(Path("strip.png"), help="The picture to write, PNG.")
    success: bool = setting(False, help="Only successful episodes.")
    failure: bool = setting(False, help="Only failed episodes.")
    seed: int = setting(0, help="Which episodes are drawn is a function of it.", minimum=0)


@click.group(cls=Group)
@with_version
def main() -> None:
    """Look at datasets of grasps and verify them."""


@main.command()
@options_from(InfoSettings)
def info(settings: InfoSettings) -> None:
    """Print what datasets hold, from their manifests."""
    manifests = [Manifest.load(path) for path in settings.path]
    described = [_described(path, manifest) for path, manifest in zip(settings.path, manifests, strict=True)]
    click.echo(aligned([[name, *(values[name] for values in described)] for name in described[0]]))


@main.command()
@options_from(VerifySettings)
def verify(settings: VerifySettings) -> int:
    """Check every byte and every label of a dataset; exit status 2 and a line for each fault."""
    from graspq.datasets.verify import verify as verify_dataset

    total = Manifest.load(settings.path).bytes
    with tqdm(total=total, unit="B", unit_scale=True, desc="verify", disable=None) as bar:
        report = verify_dataset(settings.path, bar.update, settings.workers)
    for line in report.notes:
        click.echo(f"note: {line}")
    for line in report.faults:
        click.echo(f"fault: {line}", err=True)
    checked = f"{report.files:,} files, {bytes_text(report.bytes)}"
    if report.faults:
        remedy = "the command that made the dataset makes bad shards again"
        click.echo(f"{settings.path}: {counted(len(report.faults), 'fault')} in {checked}; {remedy}", err=True)
        return 2
    click.echo(f"{settings.path}: no fault in {checked}")
    return 0


@main.command()
@options_from(ShowSettings)
def show(settings: ShowSettings) -> None:
    """Draw film strips of some episodes with their actions and labels."""
    # Imported late: the other commands must not wait for matplotlib.
    from graspq.datasets.show import choose_episodes, save_strips

    manifest = Manifest.load(settings.path)
    outcome = None if settings.success == settings.failure else settings.success
    episodes = choose_episodes(settings.path, settings.episodes, settings.seed, outcome)
    name = settings.path.resolve().name
    save_strips(settings.out, episodes, manifest, f"{manifest.task_name} grasping · {name}")
    click.echo(f"{settings.out}: {counted(len(episodes), 'episode')}")


def _described(path: Path, manifest: Manifest) -> dict[str, str]:
    if not manifest.shards:
        raise UserError(f"{path}: the dataset has no finished shard yet; run the command that makes it again")
    return {
        "dataset": str(path),
        "format": str(manifest.format_version),
        "task": manifest.task_name,
        "episodes": f"{manifest.episodes:,}",
        "rows": f"{manifest.rows:,}",
        "success rate": f"{manifest.successes / manifest.episodes:.4f}",
        "mean steps": f"{manifest.rows / manifest.episodes:.2f}",
        "size": bytes_text(manifest.bytes),
        "bytes per frame": f"{manifest.bytes / manifest.rows:.0f}",
        "shards": f"{len(manifest.shards):,}",
        "image": " x ".join(map(str, manifest.image_shape)),
        "object set": str(manifest.object_set["name"]),
        "discount": f"{manifest.discount:g}",
        "action limits": quantities(manifest.action.limits, manifest.action.units),
        "manifest digest": manifest.digest()[:16],
    }
