"""Versions and revisions that results are noted with."""

import re
import subprocess

import graspq
from graspq.common.provenance import revision_of, versions


def test_versions_name_what_is_installed_and_leave_out_what_is_not():
    found = versions("numpy", "no-such-package")
    assert found["graspq"] == graspq.__version__
    assert "numpy" in found
    assert "no-such-package" not in found


def test_the_revision_is_the_commit_and_says_when_the_tree_differs_from_it(tmp_path):
    assert revision_of(tmp_path) == "unknown"

    def git(*words):
        given = ["git", "-C", str(tmp_path), "-c", "user.name=n", "-c", "user.email=e", *words]
        return subprocess.run(given, check=True, capture_output=True, text=True).stdout.strip()

    git("init", "-q")
    assert revision_of(tmp_path) == "unknown", "no commit yet"
    (tmp_path / "file").write_text("one")
    git("add", "file")
    git("commit", "-q", "-m", "first")
    assert re.fullmatch("[0-9a-f]{40}", revision_of(tmp_path)) and revision_of(tmp_path) == git("rev-parse", "HEAD")
    (tmp_path / "file").write_text("two")
    assert revision_of(tmp_path) == git("rev-parse", "HEAD") + "+changes"
