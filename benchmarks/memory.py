"""The resident memory of a process."""

from pathlib import Path

from graspq.common.errors import UserError

_STATUS = Path("/proc/self/status")


def resident_bytes() -> int:
    """Return the resident memory of this process.

    Raises:
        UserError: the system has no /proc.
    """
    if not _STATUS.is_file():
        raise UserError(f"--part memory: {_STATUS} is not there, memory is measured on Linux alone")
    line = next(line for line in _STATUS.read_text().splitlines() if line.startswith("VmRSS:"))
    return int(line.split()[1]) * 1024
