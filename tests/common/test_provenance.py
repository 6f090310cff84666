import graspq
from graspq.common.provenance import code_revision, versions


def test_versions_name_what_is_installed_and_leave_out_what_is_not():
    found = versions("numpy", "no-such-package")
    assert found["graspq"] == graspq.__version__
    assert "numpy" in found
    assert "no-such-package" not in found


def test_the_revision_is_a_commit_or_unknown():
    revision = code_revision()
    assert revision == "unknown" or len(revision.removesuffix("+changes")) == 40
