"""Mistakes of a user, as opposed to defects of ours.

A `UserError` ends a command with one line and exit status 2; every other exception is a defect and keeps its traceback.
"""

import click


class UserError(click.ClickException, ValueError):
    """A mistake in what the user gave: the message names the value, what was expected and what to do.

    It is a `ValueError` too, so that library callers need not know click.
    """

    exit_code = 2
