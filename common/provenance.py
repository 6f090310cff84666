"""What a result was made with: versions of the packages that can change it, and the revision of this code."""

import functools
import importlib.metadata
import platform
import subprocess
from pathlib import Path

import graspq


def versions(*packages: str) -> dict[str, str]:
    """Return the installed versions of graspq, Python and the named distributions; those not installed are left out."""
    found = {"graspq": graspq.__version__, "python": platform.python_version()}
    for package in packages:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


@functools.cache
def code_revision() -> str:
    """Return the revision of this code; see `revision_of`."""
    return revision_of(Path(__file__).resolve().parent.parent)


def revision_of(root: Path) -> str:
    """Return the git commit of a source tree, with `+changes` when it differs from it, or `unknown` outside git."""
    if not (root / ".git").exists():
        return "unknown"
    try:
        commit = _git(root, "rev-parse", "HEAD")
        return commit + ("+changes" if _git(root, "status", "--porcelain") else "")
    except (OSError, subprocess.SubprocessError):
        return "unknown"


def _git(root: Path, *arguments: str) -> str:
    done = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True, timeout=20)
    return done.stdout.strip()
