"""All kinds of faults, in the order of the table."""

from tests.faults.harness import Kind

KINDS: list[Kind] = []
